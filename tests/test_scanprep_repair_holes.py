from itertools import pairwise

import numpy as np
import pytest
from scanned_shapes import ball, bumpy, joined, pierced

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.surface import Surface
from scanprep.repair.hole_filling import FillConfig, fill_holes, fill_report, filling_judgement
from scanprep.repair.intersections import intersecting_faces
from scanprep.repair.loops import triangulate_loop
from scanprep.repair.manifold import repair


def all_triangulations(i, k):
    if k - i < 2:
        yield []
        return
    for m in range(i + 1, k):
        for left in all_triangulations(i, m):
            for right in all_triangulations(m, k):
                yield [(i, m, k), *left, *right]


def area(points, triangles):
    a, b, c = points[np.asarray(triangles)].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.parametrize("seed", range(6))
def test_nearly_flat_loops_get_the_smallest_area_of_all_triangulations(seed):
    rng = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(8) + rng.uniform(-0.3, 0.3, 8)) / 8
    points = np.stack([np.cos(angle), np.sin(angle), 1e-3 * rng.normal(size=8)], axis=1)
    rim = np.tile([0.0, 0.0, 1.0], (8, 1))
    found = triangulate_loop(points, rim, np.zeros((8, 8), dtype=bool))
    every = list(all_triangulations(0, 7))
    assert len(every) == 132
    assert area(points, found) == pytest.approx(min(area(points, t) for t in every), rel=1e-9)


def test_a_groove_is_continued_to_its_bottom():
    """Two walls of a groove, cut off above its bottom: the patch goes down to where they meet, and makes no lid."""
    along, depth, opening = np.linspace(0, 0.10, 11), 0.08, 0.03
    bottom_ends = [[0.0, 0.0, -depth]], [[0.10, 0.0, -depth]]

    def wall(side):
        return np.stack([along, side * opening + 0 * along, 0 * along], axis=1)

    points = np.concatenate([wall(-1), bottom_ends[1], wall(1)[::-1], bottom_ends[0]])
    n = len(points)
    ahead = np.roll(points, -1, axis=0) - points
    rim = np.zeros((n, 3))
    for i in range(n):               # beyond the rim the walls and the ends go straight on
        middle = (points[i] + points[(i + 1) % n]) / 2
        if abs(middle[1]) > 0.99 * opening:
            rim[i] = np.cross(ahead[i], [0, np.sign(middle[1]) * opening, depth])
        else:
            rim[i] = np.cross(ahead[i], [np.sign(middle[0] - 0.05), 0, 0.0])
        rim[i] *= -1
        rim[i] /= np.linalg.norm(rim[i])
    found = triangulate_loop(points, rim, np.zeros((n, n), dtype=bool))
    at_bottom = points[found].mean(axis=1)[:, 2]
    assert len(found) == n - 2
    edges = {frozenset(e) for t in found.tolist() for e in pairwise([*t, t[0]])}
    assert frozenset((11, n - 1)) in edges
    assert at_bottom.max() < -0.02


def test_new_triangles_are_as_small_as_those_around():
    whole = ball(4)
    holed = pierced(whole, [0.1, 0, 0], 0.06)
    filled = fill_holes(holed)
    new = Mesh(filled.vertices, filled.faces[len(holed.faces):])
    assert 0.6 < new.edge_lengths.mean() / holed.mean_edge < 1.4
    assert np.median(new.face_areas) == pytest.approx(np.median(holed.face_areas), rel=0.5)


def test_a_hole_in_a_plane_stays_plane():
    x, y = np.meshgrid(np.arange(16.0), np.arange(16.0))
    number = np.arange(256).reshape(16, 16)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    plane = Mesh(0.01 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), faces)
    holed = pierced(plane, [0.08, 0.07, 0], 0.035)
    filled = fill_holes(holed, FillConfig(max_edges=40))
    assert [len(loop) for loop in filled.boundary_loops] == [60]       # the outer border is longer than allowed
    assert np.abs(filled.vertices[:, 2]).max() < 1e-9
    assert filled.face_normals[:, 2].min() > 0.999
    assert filled.face_areas.sum() == pytest.approx(plane.face_areas.sum(), rel=1e-9)


def test_holes_that_touch_in_a_vertex():
    whole = ball(3)
    centre = 17
    around = np.flatnonzero((whole.faces == centre).any(axis=1))
    order = [around[0]]
    while len(order) < len(around):              # walk the fan
        order.append(next(f for f in around if f not in order
                          and len(set(whole.faces[f]) & set(whole.faces[order[-1]])) == 2))
    holed = whole.submesh(np.setdiff1d(np.arange(len(whole.faces)), [order[0], order[len(order) // 2]]))[0]
    assert not holed.is_vertex_manifold
    filled = fill_holes(holed)
    assert filled.is_closed and template_problem(filled) is None
    assert filled.volume == pytest.approx(whole.volume, rel=1e-3)


def test_a_border_of_hundreds_of_edges():
    whole = ball(6, 0.5)
    holed = pierced(whole, [0.5, 0, 0], 0.35)
    assert len(holed.boundary_loops[0]) > 200
    filled = fill_holes(holed)
    assert filled.is_closed and template_problem(filled) is None
    new = filled.vertices[len(holed.vertices):]
    assert np.abs(np.linalg.norm(new, axis=1) - 0.5).max() < 0.05
    at = Surface(whole).closest(new)
    assert (np.einsum("nd,nd->n", filled.vertex_normals[len(holed.vertices):], whole.face_normals[at.faces])
            > 0.5).all()


def test_filling_moves_along_with_the_mesh():
    holed = pierced(bumpy(4), [0.1, 0, 0], 0.05)
    R, t = rotations.exp(np.array([0.4, -1.1, 0.3])), np.array([0.2, -3.0, 1.0])
    filled = fill_holes(holed)
    moved = fill_holes(holed.with_vertices(2 * holed.vertices @ R.T + t))
    back = (moved.vertices - t) @ R / 2
    assert Surface(filled).closest(back).distances.max() < 0.001


def test_what_cannot_be_filled_is_refused():
    with pytest.raises(ValueError, match="without triangles"):
        fill_holes(Mesh(np.zeros((3, 3)), np.empty((0, 3), dtype=int)))
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]])
    fan = Mesh(points, [[0, 1, 2], [1, 0, 3], [0, 1, 4]])
    with pytest.raises(ValueError, match="at most two triangles at an edge"):
        fill_holes(fan)


def test_a_closed_mesh_comes_back():
    whole = ball(2)
    assert np.array_equal(fill_holes(whole).faces, whole.faces)


def ring_mesh(point, rows, columns, closed_rows=False):
    """A surface over a grid of angles (u around, v along), closed around."""
    u = 2 * np.pi * np.arange(columns) / columns
    v = 2 * np.pi * np.arange(rows) / rows if closed_rows else np.linspace(0, 1, rows)
    grid = np.array([[point(a, b) for a in u] for b in v]).reshape(-1, 3)
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b = number, np.roll(number, -1, axis=1)
    d, c = np.roll(number, -1, axis=0), np.roll(b, -1, axis=0)
    keep = slice(None) if closed_rows else slice(0, -1)
    faces = np.concatenate([np.stack(t, axis=-1)[keep].reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return Mesh(grid, faces)


def torus(columns=40, rows=80):
    return ring_mesh(lambda u, v: [(0.1 + 0.035 * np.cos(u)) * np.cos(v), (0.1 + 0.035 * np.cos(u)) * np.sin(v),
                                   -0.035 * np.sin(u)], rows, columns, closed_rows=True)


@pytest.mark.parametrize("spot", [[0.135, 0, 0], [0.065, 0, 0], [0.1, 0, 0.035]])
def test_round_saddle_and_flat_places_of_a_torus(spot):
    """Outside it is round, inside a saddle, on top in between."""
    whole = torus()
    assert whole.volume > 0 and whole.is_closed
    holed = pierced(whole, spot, 0.03)
    report = fill_report(holed)
    new = report.mesh.vertices[len(holed.vertices):]
    apart = np.hypot(np.hypot(new[:, 0], new[:, 1]) - 0.1, new[:, 2]) - 0.035
    assert len(new) > 15 and np.abs(apart).max() < 0.003 and np.abs(apart).mean() < 0.0012
    assert report.mesh.is_closed and template_problem(report.mesh) is None
    assert len(intersecting_faces(report.mesh)) == 0 and report.holes[0].intersections == 0


def test_a_limb_that_was_cut_through_is_joined():
    def limb(u, v):
        return [(0.05 + 0.01 * v) * np.cos(u), (0.05 + 0.01 * v) * np.sin(u), 0.5 * v]

    whole = ring_mesh(limb, 51, 30)
    height = whole.corners.mean(axis=1)[:, 2]
    cut = whole.submesh(np.abs(height - 0.25) > 0.03)[0]
    assert len(cut.boundary_loops) == 4
    joined = fill_report(cut)
    assert joined.mesh.is_closed and template_problem(joined.mesh) is None
    assert len(joined.holes) == 3                     # both ends, and one patch for the two borders of the cut
    new = joined.mesh.vertices[len(cut.vertices):]
    band = new[np.abs(new[:, 2] - 0.25) < 0.028]
    assert len(band) > 50
    assert np.abs(np.linalg.norm(band[:, :2], axis=1) - 0.05 - 0.02 * band[:, 2]).max() < 0.004
    apart = fill_report(cut, FillConfig(join=False))
    assert apart.mesh.vertex_component.max() == 1 and len(apart.holes) == 4


def test_crossing_triangles_are_found_as_by_another_library():
    import igl

    rng = np.random.default_rng(0)
    soup = Mesh(rng.uniform(size=(120, 1, 3)).repeat(3, axis=1).reshape(-1, 3) + 0.15 * rng.normal(size=(360, 3)),
                np.arange(360).reshape(-1, 3))
    found = {tuple(pair) for pair in intersecting_faces(soup).tolist()}
    expected = {(i, k) for i in range(120) for k in range(i + 1, 120)
                if igl.tri_tri_intersection_test_3d(*soup.corners[[i, k]].reshape(6, 1, 3))[0]}
    assert 50 < len(found) and found == expected
    some = np.arange(40)
    assert {tuple(p) for p in intersecting_faces(soup, some).tolist()} == {p for p in found if min(p) < 40}


def test_neighbours_cross_only_when_folded_or_pierced():
    v = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.9, 0.9, 0], [0.3, 0.3, -1], [0.3, 0.3, 1], [0.3, 0.2, 0],
                  [-1, -1, 0.2]], float)
    assert len(intersecting_faces(Mesh(v, [[0, 1, 2], [2, 1, 3]]))) == 0
    assert len(intersecting_faces(Mesh(v, [[0, 1, 2], [1, 0, 6]]))) == 1                 # folded flat onto it
    assert len(intersecting_faces(Mesh(v, [[0, 1, 2], [0, 4, 5]]))) == 1                 # at a vertex, through it
    assert len(intersecting_faces(Mesh(v, [[0, 1, 2], [0, 4, 7]]))) == 0


@pytest.mark.parametrize("seed", range(3))
def test_reports_of_ragged_holes_count_what_crosses(seed):
    """Random teeth along the rim: nothing existing moves, and what could not be kept apart is told."""
    rng = np.random.default_rng(seed)
    whole = bumpy(4)
    middle = whole.corners.mean(axis=1)
    centre = middle[rng.integers(len(middle))]
    teeth = 0.045 * rng.uniform(0.95, 1.05, len(middle))
    holed = repair(whole.submesh(np.linalg.norm(middle - centre, axis=1) > teeth)[0])
    report = fill_report(holed)
    assert report.mesh.is_closed and report.mesh.is_edge_manifold
    assert sum(hole.intersections for hole in report.holes) == len(intersecting_faces(report.mesh)) < 20
    assert np.array_equal(report.mesh.vertices[:len(holed.vertices)], holed.vertices)
    assert np.array_equal(report.mesh.faces[:len(holed.faces)], holed.faces)


def test_patches_of_sheets_that_lie_over_each_other_are_no_good():
    """Views side by side, not merged: each is closed across the others."""
    shell = pierced(ball(3), [[0, 0, 0.1]], 0.09)
    turned = Mesh(shell.vertices @ rotations.exp(np.array([np.pi, 0, 0])).T, shell.faces)
    both = joined(shell, turned)
    for mesh, verdict in ((shell, "good"), (both, "failed")):
        report = fill_report(mesh, FillConfig(join=False))
        judged = filling_judgement(report.holes, len(report.mesh.faces) - len(mesh.faces))
        assert judged.verdict == verdict and (verdict == "good" or "scape prep merge" in judged.why)
