"""Normal volume, displacement map, subdivision and reconstruction, on spheres whose heights are known."""
import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image
from png_writer import save_rgb16
from scanned_shapes import BUMPY as R
from scanned_shapes import bumpy_radius, globe, mushroom
from scipy.spatial.transform import Rotation

from model.statue.control.chart import make_chart
from model.statue.control.model import FOLDED, HOLE, MEASURED, OUTSIDE, ControlModel, DisplacementMap
from model.statue.detail.displacement import bake_displacement, coverage_shares, unfold_control
from model.statue.detail.maps import read_map, write_map
from model.statue.detail.normal_volume import from_normal_volume, interpolate, limits, not_inverted, to_normal_volume
from model.statue.detail.reconstruction import (
    Reconstruction,
    displace_surface,
    find_inverted,
    in_folds,
    reconstruction_error,
)
from model.statue.detail.subdivision import INNER, chart_places, subdivide_adaptive, subdivide_uniform
from model.statue.detail.texels import bake_texture, continue_chart, find_texels, scan_look
from model.statue.fit import StatueConfig
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError
from scanprep.geometry.surface import Surface

SIZE = 192


def rms(distances):
    return np.sqrt(np.mean(distances**2))


@pytest.fixture(scope="module")
def control():
    mesh, meridian = globe(12, 20, R)
    return ControlModel(mesh, None, None, make_chart(mesh, [meridian]), {}, (), (), (), None)


@pytest.fixture(scope="module")
def scan():
    mesh = globe(160, 300, 1.0)[0]
    return mesh.with_vertices(bumpy_radius(mesh.vertices)[:, None] * mesh.vertices)


@pytest.fixture(scope="module")
def baked(control, scan):
    return bake_displacement(control, scan, SIZE)


@pytest.fixture(scope="module")
def places(control):
    """Pixels of the image, and their points and normals on the control sphere."""
    texels = find_texels(control.mesh, control.chart, SIZE)
    return texels, *interpolate(control.mesh, texels.faces, texels.bary)


def test_points_come_back_from_the_normal_volume(control):
    rng = np.random.default_rng(0)
    p, faces, bary = control.mesh.sample(3000, rng)
    d = rng.uniform(-0.05, 0.05, len(p))
    points = p + d[:, None] * interpolate(control.mesh, faces, bary)[1]
    found = to_normal_volume(control.mesh, points, 0.06)
    assert found.inside.all() and (found.solutions == 1).all()
    back = from_normal_volume(control.mesh, found.faces, found.bary, found.heights)
    np.testing.assert_allclose(back, points, atol=1e-9)
    np.testing.assert_allclose(found.heights, d, atol=1e-9)
    same = found.faces == faces                              # others lie on an edge
    assert same.mean() > 0.99
    np.testing.assert_allclose(found.bary[same], bary[same], atol=1e-8)
    middle = to_normal_volume(globe(6, 8, 0.05)[0], np.zeros((1, 3)) + 0.003, 0.06)
    assert middle.solutions[0] > 1                           # amid a ring it is reached from several triangles


def test_inside_a_flat_body_the_nearer_side_is_taken_and_the_other_one_is_the_limit():
    """A disc 2 cm thick: from 4 mm above its middle 6 mm to the upper side; heights go 3/4 of the way to the other."""
    ball, _ = globe(24, 40, 0.05)
    disc = ball.with_vertices(ball.vertices * [1, 1, 0.2])
    found = to_normal_volume(disc, np.array([[0.001, 0.002, 0.004]]), 0.03)
    assert found.solutions.tolist() == [2] and found.heights[0] == pytest.approx(-0.006, abs=1e-4)
    low, high = limits(disc, np.array([[0.001, 0.002, 0.01]]), np.array([[0.0, 0, 1]]), 0.03)
    assert low[0] == pytest.approx(-0.75 * 0.02, rel=0.01) and high[0] == pytest.approx(0.03)


def test_triangles_of_a_ball_are_inverted_near_its_middle():
    """Moved inwards by a share s of the radius an area is (1 - s)² of itself: a twentieth at 0.776."""
    ball, _ = globe(24, 40, 0.05)
    faces = np.arange(200, 240)
    for share, good in ((-0.9, False), (-0.8, False), (-0.7, True), (2.0, True)):
        heights = np.full(40, share * 0.05)
        assert (not_inverted(ball, faces, np.full((40, 3), 1 / 3), heights) == good).all(), share


def test_heights_of_a_bumpy_sphere_are_those_of_its_formula(places, baked):
    texels, p, n = places
    assert (baked.coverage.ravel()[texels.pixels[texels.inside]] == MEASURED).all()
    assert (baked.coverage == OUTSIDE).sum() == SIZE**2 - texels.inside.sum()
    found = p + baked.heights.ravel()[texels.pixels, None] * n
    far = np.linalg.norm(found, axis=1)
    np.testing.assert_allclose(far, bumpy_radius(found / far[:, None]), atol=6e-5)      # the scan's own chords


def test_beside_the_chart_the_surface_goes_on(control):
    """Points just outside a border are places just across the seam, as far from it."""
    mesh, chart, flat = control.mesh, control.chart, control.chart.flat
    face, side = np.nonzero(flat.edge_use[flat.face_edges] == 1)
    a, b, c = (chart.uv[chart.faces[face, (side + k) % 3]] for k in range(3))
    middle, scale = 0.5 * (a + b), 0.02
    f, bary = continue_chart(mesh, chart, middle + scale * (middle - c))
    assert (f != face).all()
    corners = [mesh.vertices[mesh.faces[face, (side + k) % 3]] for k in range(3)]
    there = np.einsum("nc,ncd->nd", bary, mesh.corners[f])
    edge = 0.5 * (corners[0] + corners[1])
    far, wanted = np.linalg.norm(there - edge, axis=1), scale * np.linalg.norm(edge - corners[2], axis=1)
    np.testing.assert_allclose(far, wanted, rtol=1e-6)
    assert (np.einsum("nd,nd->n", there - edge, edge - corners[2]) > 0).all()


def test_overlapping_views_are_one_surface(control, scan, baked):
    """Two sheets 2 mm apart, nothing seen from inside between them: their mean, not a fold."""
    both = Mesh(np.concatenate([scan.vertices, 1.01 * scan.vertices]),
                np.concatenate([scan.faces, scan.faces + len(scan.vertices)]))
    upper, found = (bake_displacement(control, one, SIZE)
                    for one in (scan.with_vertices(1.01 * scan.vertices), both))
    assert coverage_shares(control, found)["folded"] == 0
    inside = found.coverage == MEASURED
    np.testing.assert_allclose(found.heights[inside], 0.5 * (baked.heights + upper.heights)[inside], atol=1e-6)


def test_a_hole_over_the_seam_is_filled_as_high_as_all_around_it(control, places):
    """A sphere 8 mm outside of the control sphere, without its side at x > 5 cm, where the seam runs."""
    ball, texels = globe(80, 120, R + 0.008)[0], places[0]
    cut = ball.submesh(ball.corners.mean(axis=1)[:, 0] < 0.05)[0]
    found = bake_displacement(control, cut, SIZE)
    kind, heights = (of.ravel()[texels.pixels[texels.inside]] for of in (found.coverage, found.heights))
    known = heights[kind == MEASURED]
    assert (kind == HOLE).mean() > 0.2 and known.min() > 0.007
    assert (heights[kind == HOLE] >= known.min()).all() and (heights[kind == HOLE] <= known.max()).all()


@pytest.mark.parametrize(("rise", "kind"), [(0.002, MEASURED), (0.02, HOLE)])
def test_an_island_in_a_hole_counts_where_it_continues_the_surface_and_is_no_thorn(control, places, rise, kind):
    """Lone pixels made thorns of 75 mm at ragged holes."""
    ball, (texels, p, _) = globe(160, 300, R)[0], places
    on_ball = R * p / np.linalg.norm(p, axis=1, keepdims=True)
    pole = on_ball[np.flatnonzero(texels.inside)[texels.inside.sum() // 2]]
    apart = np.linalg.norm(ball.corners.mean(axis=1) - pole, axis=1)
    island = ball.with_vertices(ball.vertices * (1 + rise / R)).submesh(apart < 0.005)[0]
    cut = ball.submesh(apart > 0.03)[0]
    found = bake_displacement(control, Mesh(np.concatenate([cut.vertices, island.vertices]), np.concatenate(
        [cut.faces, island.faces + len(cut.vertices)])), SIZE)
    middle = texels.pixels[texels.inside & (np.linalg.norm(on_ball - pole, axis=1) < 0.002)]
    assert len(middle) and (found.coverage.ravel()[middle] == kind).all()
    heights = bake_displacement(control, cut, SIZE).heights
    assert np.abs(found.heights - heights).max() < (0.003 if kind == MEASURED else 0.0005)


def test_an_overhang_is_folded_and_nothing_else(control):
    """A mushroom; triangles that its heights invert are among those in the fold."""
    found, texels = bake_displacement(control, mushroom(R), 384), find_texels(control.mesh, control.chart, 384)
    p, _ = interpolate(control.mesh, texels.faces, texels.bary)
    off = np.hypot(p[:, 0], p[:, 1]) + np.where(p[:, 2] > 0, 0, 1)            # from the axis of the mushroom
    kind = found.coverage.ravel()[texels.pixels]
    assert off[kind == FOLDED].max() < 0.024
    assert (kind[texels.inside & (off > 0.024)] == MEASURED).all()
    assert (2 * np.pi * R**2) * 0.001 < coverage_shares(control, found)["folded"] * (4 * np.pi * R**2) < 0.03**2
    fine = subdivide_uniform(control.mesh, control.chart, 4)
    x, folds = Reconstruction(control, found, fine)(control.mesh.vertices), in_folds(control, found, fine)
    assert 0 < folds.mean() < 0.05 and folds[find_inverted(control, control.mesh.vertices, fine, x)].all()


@pytest.mark.slow
def test_a_control_mesh_that_is_folded_inside_the_scan_is_drawn_out(control, scan):
    near = np.linalg.norm(control.mesh.vertices - [0, R, 0], axis=1) < 0.35 * R
    dented = replace(control, mesh=control.mesh.with_vertices(
        control.mesh.vertices - np.where(near[:, None], [0, 0.8 * R, 0], 0)))
    out = unfold_control(dented, scan, 128)
    maps = [(one, bake_displacement(one, scan, 128)) for one in (dented, out)]
    before, after = (coverage_shares(*pair)["folded"] for pair in maps)
    assert after < 0.2 * before
    before, after = (rms(reconstruction_error(Reconstruction(one, found, subdivide_uniform(
        one.mesh, one.chart, 3)).mesh(), scan)) for one, found in maps)
    assert after < 0.1 * before
    behind = control.mesh.vertices[:, 1] < 0
    assert (out.mesh.vertices[behind] == dented.mesh.vertices[behind]).all()
    assert (unfold_control(control, scan, 128).mesh.vertices == control.mesh.vertices).all()


@pytest.mark.parametrize("level", range(5))
def test_a_split_of_every_edge_has_four_times_the_vertices_less_six(control, level):
    fine = subdivide_uniform(control.mesh, control.chart, level)
    count = len(control.mesh.vertices)
    for _ in range(level):
        count = 4 * count - 6
    assert len(fine.parent) == count
    mesh = fine.mesh(control.mesh)
    assert mesh.is_closed and mesh.is_edge_manifold
    np.testing.assert_allclose(mesh.face_areas.sum(), control.mesh.face_areas.sum())
    np.testing.assert_allclose(fine.chart.flat.face_areas.sum(), control.chart.flat.face_areas.sum())
    corners = fine.chart.uv[fine.chart.faces]                # where each vertex is, seen from its triangles
    own = chart_places(control.chart, fine.parent, fine.bary)
    inner = fine.parent[fine.faces] == fine.face_parent[:, None]
    np.testing.assert_allclose(corners[inner], own[fine.faces][inner], atol=1e-12)


def test_adaptive_subdivision_splits_where_the_surface_bends_without_a_crack(control, places):
    """Of a bump of 10 mm at one place."""
    texels, p, _ = places
    heights = 0.01 * np.exp(-np.sum((p - [0, 0.2, 0])**2, axis=1) / 0.03**2)
    one_bump = DisplacementMap(
        texels.image(heights.astype(np.float32)),
        texels.image(np.where(texels.inside, MEASURED, OUTSIDE).astype(np.uint8), OUTSIDE))
    displaced = displace_surface(control, one_bump)
    fine = subdivide_adaptive(control.mesh, control.chart, displaced, 3e-4, 4)
    mesh = fine.mesh(control.mesh)
    assert mesh.is_closed and mesh.is_edge_manifold
    assert len(fine.parent) - len(mesh.edges) + len(fine.faces) == 2
    np.testing.assert_allclose(mesh.face_areas.sum(), control.mesh.face_areas.sum())
    even = subdivide_uniform(control.mesh, control.chart, 4)
    assert len(fine.faces) < 0.25 * len(even.faces)
    far = mesh.corners.mean(axis=1)[:, 1] < 0
    assert np.isin(mesh.face_areas[far], control.mesh.face_areas).all()              # nothing happens behind
    detailed = Reconstruction(control, one_bump, fine).mesh()
    truth = Reconstruction(control, one_bump, even).mesh()
    assert Surface(detailed).closest(truth.vertices).distances.max() < 3.5e-4
    assert len(subdivide_adaptive(control.mesh, control.chart, displaced, 1e-3, 4).faces) < len(fine.faces)


@pytest.mark.parametrize("place", INNER.tolist(), ids=["middle", "corner 0", "corner 1", "corner 2"])
def test_a_triangle_is_split_where_the_surface_rises_inside_it_alone(control, place):
    """A cone on one triangle, flat along its sides: in four, and the three beside it in two."""
    def displaced(faces, bary):
        p, n = interpolate(control.mesh, faces, bary)
        cone = np.maximum(0, 0.01 - 0.1 * np.linalg.norm(bary - place, axis=1))       # of 0.1 in barycentric numbers
        return p + (np.where(faces == 77, cone, 0))[:, None] * n
    for tolerance, more in ((0.009, 6), (0.011, 0)):
        fine = subdivide_adaptive(control.mesh, control.chart, displaced, tolerance, 1)
        assert len(fine.faces) == len(control.mesh.faces) + more
        assert (np.bincount(fine.face_parent)[77] == 4) == bool(more)


@pytest.mark.parametrize("face", [77, 201])
@pytest.mark.parametrize("whole", range(3))
def test_between_two_split_sides_runs_the_shorter_diagonal(control, face, whole):
    """Cones stand on the middles of two sides of a triangle; its side from corner `whole` to the next stays whole."""
    a, b, top = np.roll(control.mesh.corners[face], -whole, axis=0)
    feet = np.stack([a + top, b + top]) / 2

    def displaced(faces, bary):
        p, n = interpolate(control.mesh, faces, bary)
        return p + np.maximum(0, 0.01 - np.linalg.norm(p[:, None] - feet, axis=2).min(axis=1))[:, None] * n
    fine = subdivide_adaptive(control.mesh, control.chart, displaced, 0.005, 1)
    mine, x = fine.faces[fine.face_parent == face], fine.points(control.mesh)
    assert len(mine) == 3
    sides, used = np.unique(np.sort(mine[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0, return_counts=True)
    inner = np.linalg.norm(x[sides[used == 2, 0]] - x[sides[used == 2, 1]], axis=1)
    ways = [np.linalg.norm(feet[1] - a), np.linalg.norm(feet[0] - b)]
    np.testing.assert_allclose(np.sort(inner), np.sort([np.linalg.norm(feet[0] - feet[1]), min(ways)]), atol=1e-9)


def test_reconstruction_comes_nearer_to_the_scan_with_every_level(control, scan, baked):
    errors = [reconstruction_error(Reconstruction(control, baked, subdivide_uniform(
        control.mesh, control.chart, level)).mesh(), scan).mean() for level in range(4)]
    assert all(fine < 0.5 * coarse for coarse, fine in pairwise(errors)) and errors[3] < 1e-4
    larger = reconstruction_error(globe(80, 160, 0.203)[0], globe(80, 160, 0.2)[0])
    assert [larger.mean(), rms(larger)] == pytest.approx([0.003] * 2, abs=3e-5)       # the difference of the radii


def test_detail_turns_and_moves_with_the_control_mesh(control, baked):
    fine = subdivide_uniform(control.mesh, control.chart, 3)
    build = Reconstruction(control, baked, fine)
    turn, shift = Rotation.from_rotvec([0.3, -1, 2]), np.array([1, 2, 3.0])
    rest, v = build(control.mesh.vertices), np.array(control.mesh.vertices)
    np.testing.assert_allclose(build(turn.apply(v) + shift), turn.apply(rest) + shift, atol=1e-9)
    np.testing.assert_allclose(rest, displace_surface(control, baked)(fine.parent, fine.bary), atol=1e-9)


def test_files_give_back_the_map(tmp_path, baked):
    """And the grey image holds its heights to half a step."""
    write_map(tmp_path, baked)
    back = read_map(tmp_path)
    for name in ("heights", "coverage"):
        np.testing.assert_array_equal(getattr(back, name), getattr(baked, name))
    header = json.loads((tmp_path / "displacement.json").read_text())
    grey = np.asarray(Image.open(tmp_path / "displacement.png")).astype(float)
    inside, step = back.coverage != OUTSIDE, header["scale"]
    error = np.abs((grey - header["zero"]) * step - back.heights)[inside]
    assert step / 4 < error.max() <= step / 2 * 1.0001
    assert step == pytest.approx(np.abs(back.heights[inside]).max() / 32767)


def test_an_edited_image_edits_exactly_there(tmp_path, control, baked):
    write_map(tmp_path, baked)
    grey = np.asarray(Image.open(tmp_path / "displacement.png")).copy()
    assert (read_map(tmp_path, tmp_path / "displacement.png").heights == baked.heights).all()
    there = np.zeros(grey.shape, bool)
    there[80:100, 90:110] = True
    Image.fromarray(grey - np.where(there, 4000, 0).astype(np.uint16)).save(tmp_path / "edited.png")
    edited = read_map(tmp_path, tmp_path / "edited.png")
    change = edited.heights.astype(float) - baked.heights
    assert (change[~there] == 0).all() and change[there].mean() < -3e-4
    np.testing.assert_allclose(change[there], change[there].mean(), rtol=1e-4)
    fine = subdivide_uniform(control.mesh, control.chart, 3)
    moved = (Reconstruction(control, edited, fine).mesh().vertices
             != Reconstruction(control, baked, fine).mesh().vertices).any(axis=1)
    x, y = (chart_places(control.chart, fine.parent, fine.bary) * [SIZE, -SIZE] + [0, SIZE]).T
    around = (x > 89.5) & (x < 110.5) & (y > 79.5) & (y < 100.5)
    assert moved.any()
    np.testing.assert_array_equal(moved, around)
    grey[there] -= 4000
    save_rgb16(tmp_path / "rgb.png", np.repeat(grey[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(read_map(tmp_path, tmp_path / "rgb.png").heights, edited.heights)


@pytest.mark.parametrize(("name", "came"), [
    ("colors", "its channels differ"), ("eight", f"{SIZE} x {SIZE} pixels with 8 bits"),
    ("small", f"{SIZE} x 100 pixels"), ("cut", "cannot read it"), ("missing", "no such file")])
def test_unusable_edited_images_are_refused(tmp_path, baked, name, came):
    write_map(tmp_path, baked)
    path, grey = tmp_path / f"{name}.png", np.asarray(Image.open(tmp_path / "displacement.png"))
    colors = np.repeat(grey[:, :, None], 3, axis=2)
    colors[5, 5, 1] += 1
    save_rgb16(tmp_path / "colors.png", colors)
    Image.fromarray((grey >> 8).astype(np.uint8)).save(tmp_path / "eight.png")
    Image.fromarray(grey[:100]).save(tmp_path / "small.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "colors.png").read_bytes()[:2000])
    wanted = "expected an image" + ("" if name == "missing" else f" of {SIZE} x {SIZE} pixels with 16 bits of grey")
    with pytest.raises(StorageError, match=wanted) as told:
        read_map(tmp_path, path)
    assert came in str(told.value) and path.name in str(told.value)
    (tmp_path / "coverage.png").write_bytes((tmp_path / "small.png").read_bytes())
    with pytest.raises(StorageError, match=r"coverage.png: expected uint8 numbers of shape"):
        read_map(tmp_path)


@pytest.mark.parametrize(("call", "word"), [
    (lambda c, scan: bake_displacement(c, Mesh(scan.vertices, np.zeros((0, 3), int))), "at least one triangle"),
    (lambda c, scan: StatueConfig(size=3), "size"),
    (lambda c, scan: scan_look(scan), "colours")])
def test_unusable_input_is_told(control, scan, call, word):
    with pytest.raises(ValueError, match=word):
        call(control, scan)


def test_colours_lie_where_they_are_on_the_scan(control, scan, baked, places):
    texels, p, n = places
    painted = Mesh(scan.vertices, scan.faces, 0.5 + 2 * scan.vertices)
    wanted = 0.5 + 2 * (p + baked.heights.ravel()[texels.pixels, None] * n)
    image = bake_texture(control, baked, scan_look(painted)).reshape(-1, 3)[texels.pixels] / 255
    np.testing.assert_allclose(image, wanted, atol=0.004)
    filled = bake_texture(control, baked, lambda points, normals: (0.5 + 2 * points, (points[:, 2] > 0).astype(float)))
    filled, known = filled.reshape(-1, 3)[texels.pixels] / 255, wanted[:, 2] > 0.5
    np.testing.assert_allclose(filled[known], wanted[known], atol=0.004)
    assert filled[~known, 2] == pytest.approx(0.5, abs=0.02)              # the rim's colour
