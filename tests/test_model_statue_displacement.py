"""Normal volume, displacement map, subdivision and reconstruction, on spheres whose heights are known."""
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from model.statue.control.chart import make_chart
from model.statue.control.model import FOLDED, HOLE, MEASURED, OUTSIDE, ControlModel, DisplacementMap
from model.statue.detail.displacement import DisplacementConfig, bake, coverage_shares, unfold_control
from model.statue.detail.errors import in_folds, inverted_triangles, remaining_error, surface_error
from model.statue.detail.maps import read_map, write_map
from model.statue.detail.normal_volume import from_normal_volume, interpolate, solve_triangles, to_normal_volume
from model.statue.detail.reconstruction import Reconstruction, VertexRotations, displaced_surface
from model.statue.detail.subdivision import chart_places, subdivide, subdivide_adaptive
from model.statue.detail.texels import bake_texture, continue_chart, find_texels, scan_look
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import bilinear

R = 0.2                                # metres, of the control sphere
SIZE = 192


def ball(rings, sectors, radius):
    """A sphere of rings and sectors, and its meridian from pole to pole."""
    t, a = np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(sectors) / sectors
    t, a = (v.ravel() for v in np.meshgrid(t, a, indexing="ij"))
    around = np.stack([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)], axis=1)
    vertices = np.concatenate([[[0, 0, 1]], around, [[0, 0, -1]]])
    number = 1 + np.arange((rings - 1) * sectors).reshape(rings - 1, sectors)
    a, b = number, np.roll(number, -1, axis=1)
    last = len(vertices) - 1
    faces = [np.stack([np.zeros(sectors, int), a[0], b[0]], 1), np.stack([np.full(sectors, last), b[-1], a[-1]], 1)]
    for k in range(rings - 2):
        faces += [np.stack([a[k], a[k + 1], b[k + 1]], 1), np.stack([a[k], b[k + 1], b[k]], 1)]
    return Mesh(radius * vertices, np.concatenate(faces)), np.r_[0, number[:, 0], last]


def bumpy(directions):
    """Radius of a bumpy sphere in a direction (..., 3), unit."""
    x, y, z = np.moveaxis(directions, -1, 0)
    return R + 0.006 * np.sin(9 * x) * np.cos(7 * y) + 0.004 * np.sin(8 * z + 1)


@pytest.fixture(scope="module")
def control():
    mesh, meridian = ball(12, 20, R)
    return ControlModel(mesh, None, None, make_chart(mesh, [meridian]), {}, (), (), (), None)


@pytest.fixture(scope="module")
def scan():
    mesh, _ = ball(160, 300, 1.0)
    return mesh.with_vertices(bumpy(mesh.vertices)[:, None] * mesh.vertices)


@pytest.fixture(scope="module")
def baked(control, scan):
    return bake(control, scan, DisplacementConfig(size=SIZE))


# ---- normal volume

def slowly(mesh, points, reach):
    """Least height of each point over all triangles, by numpy's roots of a fitted cubic."""
    out = np.full(len(points), np.inf)
    for face in mesh.faces:
        v, n = mesh.vertices[face], mesh.vertex_normals[face]
        for i, p in enumerate(points):
            at = np.linspace(-1, 1, 4)
            cubic = np.polyfit(at, [np.linalg.det(v - p + reach * x * n) for x in at], 3)
            for d in reach * np.roots(cubic[np.argmax(np.abs(cubic) > 1e-14 * np.abs(cubic).max()):]):
                w = (v + d.real * n).T
                b = np.linalg.lstsq(np.vstack([w, np.ones(3)]), np.r_[p, 1], rcond=None)[0]
                if abs(d.imag) < 1e-9 * reach and abs(d) <= reach and (b > -1e-7).all():
                    out[i] = min(out[i], abs(d))
    return out


def test_points_come_back_from_the_normal_volume(control):
    rng = np.random.default_rng(0)
    p, faces, bary = control.mesh.sample(3000, rng)
    d = rng.uniform(-0.05, 0.05, len(p))
    points = p + d[:, None] * interpolate(control.mesh, faces, bary)[1]
    found = to_normal_volume(control.mesh, points, 0.06)
    assert found.inside.all()
    assert (found.solutions == 1).all()
    back = from_normal_volume(control.mesh, found.faces, found.bary, found.heights)
    np.testing.assert_allclose(back, points, atol=1e-9)
    np.testing.assert_allclose(found.heights, d, atol=1e-9)
    same = found.faces == faces                              # others lie on an edge
    assert same.mean() > 0.99
    np.testing.assert_allclose(found.bary[same], bary[same], atol=1e-8)


def test_the_least_height_over_all_triangles_is_found():
    rng = np.random.default_rng(1)
    small, _ = ball(5, 6, 0.1)
    crooked = small.with_vertices(small.vertices + 0.015 * rng.normal(size=small.vertices.shape))
    points = rng.uniform(-0.15, 0.15, (40, 3))
    found, slow = to_normal_volume(crooked, points, 0.06), slowly(crooked, points, 0.06)
    upright = found.inside                                   # the slow way takes turned-over triangles too
    assert (np.abs(found.heights[upright]) >= slow[upright] - 1e-9).all()
    assert np.mean(np.abs(np.abs(found.heights[upright]) - slow[upright]) < 1e-9) > 0.8
    assert np.isinf(slow).any()
    assert not found.inside[np.isinf(slow)].any()
    assert np.isnan(found.heights[~found.inside]).all()
    assert not found.solutions[~found.inside].any()


def test_a_point_amid_a_ring_is_reached_from_several_triangles():
    found = to_normal_volume(ball(6, 8, 0.05)[0], np.zeros((1, 3)) + 0.003, 0.06)
    assert found.solutions[0] > 1


def test_the_plane_of_the_paper_is_an_approximation(control):
    """Plane parallel to the triangle through the point: at a displaced corner it is exact, amid the triangle not."""
    p, faces, bary = control.mesh.sample(300, np.random.default_rng(2))
    mesh = control.mesh.with_vertices(control.mesh.vertices * [1, 1, 1.6])           # normals that rise unevenly
    p, n = interpolate(mesh, faces, bary)
    points = p + 0.04 * n
    N = mesh.face_normals[faces]
    rise = np.einsum("nd,nd->n", mesh.vertex_normals[mesh.faces[faces, 0]], N)
    plane = np.einsum("nd,nd->n", points - mesh.corners[faces, 0], N) / rise
    pair, exact, _ = solve_triangles(mesh, faces, points, 0.06)
    assert len(pair) == len(points)
    np.testing.assert_allclose(exact, 0.04, atol=1e-10)
    assert np.abs(plane - 0.04).max() > 5e-4


# ---- map

def test_heights_of_a_bumpy_sphere_are_those_of_its_formula(control, scan, baked):
    texels = find_texels(control.mesh, control.chart, SIZE)
    assert (baked.coverage.ravel()[texels.pixels[texels.inside]] == MEASURED).all()
    assert (baked.coverage == OUTSIDE).sum() == SIZE**2 - texels.inside.sum()
    p, n = interpolate(control.mesh, texels.faces, texels.bary)
    for k in np.random.default_rng(3).choice(len(p), 60, replace=False):
        def off(d, k=k):
            x = p[k] + d * n[k]
            return np.linalg.norm(x) - bumpy(x / np.linalg.norm(x))
        true = brentq(off, -0.04, 0.06)
        assert baked.heights.ravel()[texels.pixels[k]] == pytest.approx(true, abs=6e-5)      # the scan's own chords


@pytest.fixture(scope="module")
def fine_map(control, scan):
    return bake(control, scan, DisplacementConfig(size=768))


def test_both_ways_to_the_map_agree(control, scan, fine_map):
    """Heights of scan vertices by the cubic, and of pixels at the same place by rays."""
    points = scan.vertices[1:-1:97]                          # without the poles, where the seam ends and normals kink
    there = to_normal_volume(control.mesh, points, 0.05)
    heights = bilinear(fine_map.heights, chart_places(control.chart, there.faces, there.bary))
    np.testing.assert_allclose(heights, there.heights, atol=1e-4)
    assert remaining_error(control, fine_map, scan, 2000).rms < 3e-5


def test_the_map_goes_on_across_the_seam(control, fine_map):
    """The same places of the seam read from either side of the chart."""
    flat, mesh = control.chart.flat, control.mesh
    border = flat.edges[flat.edge_use == 1]
    t = np.linspace(0, 1, 7)[:, None, None]
    uv = ((1 - t) * control.chart.uv[border[:, 0]] + t * control.chart.uv[border[:, 1]]).reshape(-1, 2)
    vertex = np.zeros(len(control.chart.uv), int)
    vertex[control.chart.faces] = mesh.faces
    ends = np.sort(vertex[border], axis=1)
    at = ((1 - t) * mesh.vertices[vertex[border[:, 0]]] + t * mesh.vertices[vertex[border[:, 1]]]).reshape(-1, 3)
    heights = bilinear(fine_map.heights, uv)
    assert len(np.unique(ends, axis=0)) == len(border) // 2
    nearest = np.linalg.norm(at[:, None] - at[None], axis=2) + np.eye(len(at))
    other = nearest.argmin(axis=1)
    np.testing.assert_allclose(nearest[np.arange(len(at)), other], 0, atol=1e-12)
    assert np.abs(heights - heights[other]).max() < 2e-4                 # of 10 mm, at pixels of 1 mm


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
    np.testing.assert_allclose(np.linalg.norm(there - edge, axis=1),
                               scale * np.linalg.norm(edge - corners[2], axis=1), rtol=1e-6)
    ahead = np.einsum("nd,nd->n", there - edge, edge - corners[2])
    assert (ahead > 0).all()


def test_overlapping_views_are_one_surface(control, scan):
    """Two sheets 2 mm apart, nothing seen from inside between them: their mean, not a fold."""
    both = Mesh(np.concatenate([scan.vertices, 1.01 * scan.vertices]),
                np.concatenate([scan.faces, scan.faces + len(scan.vertices)]))
    lower, upper, found = (bake(control, one, DisplacementConfig(size=SIZE))
                           for one in (scan, scan.with_vertices(1.01 * scan.vertices), both))
    assert coverage_shares(control, found)["folded"] == 0
    inside = found.coverage == MEASURED
    np.testing.assert_allclose(found.heights[inside], 0.5 * (lower.heights + upper.heights)[inside], atol=1e-6)


def test_a_hole_is_told_and_filled_from_around_it(control, scan):
    cut = scan.submesh(scan.corners.mean(axis=1)[:, 0] < 0.15)[0]
    found = bake(control, cut, DisplacementConfig(size=SIZE))
    texels = find_texels(control.mesh, control.chart, SIZE)
    p, _ = interpolate(control.mesh, texels.faces, texels.bary)
    kind = found.coverage.ravel()[texels.pixels]
    sure = texels.inside & (np.abs(p[:, 0] - 0.145) > 0.01)
    assert (kind[sure] == np.where(p[sure, 0] > 0.145, HOLE, MEASURED)).all()
    share = (1 - 0.15 / R) / 2                               # of a sphere's area beyond a plane
    assert coverage_shares(control, found)["hole"] == pytest.approx(share, rel=0.15)
    heights = found.heights.ravel()[texels.pixels]
    assert heights[kind == HOLE].max() <= heights[kind == MEASURED].max()
    assert heights[kind == HOLE].min() >= heights[kind == MEASURED].min()


@pytest.fixture(scope="module")
def mushroom():
    """A sphere with a round mushroom on it: stem 24 mm, cap 36 mm wide, 20 mm high."""
    mesh, _ = ball(400, 80, 1.0)
    t = np.arccos(np.clip(mesh.vertices[:, 2], -1, 1))
    a = np.arctan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    s = t / np.pi                                            # along the profile from the top
    profile = np.array([(0, .22), (.012, .2195), (.017, .216), (.018, .213), (.017, .210), (.013, .2085), (.012, .206),
                        (.012, .202), (.014, np.sqrt(R**2 - .014**2))])
    way = np.r_[0, np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))]
    way *= 0.25 / way[-1]
    r, z = (np.interp(s, way, profile[:, k]) for k in range(2))
    polar = np.arcsin(.014 / R) + (s - 0.25) / 0.75 * (np.pi - np.arcsin(.014 / R))
    below = s > 0.25
    r, z = np.where(below, R * np.sin(polar), r), np.where(below, R * np.cos(polar), z)
    return Mesh(np.stack([r * np.cos(a), r * np.sin(a), z], axis=1), mesh.faces)


def test_vectors_mend_an_overhang_and_nothing_else(control, mushroom):
    found = bake(control, mushroom, DisplacementConfig(size=384, vectors=True))
    texels = find_texels(control.mesh, control.chart, 384)
    p, _ = interpolate(control.mesh, texels.faces, texels.bary)
    off = np.hypot(p[:, 0], p[:, 1]) + np.where(p[:, 2] > 0, 0, 1)            # from the axis of the mushroom
    kind = found.coverage.ravel()[texels.pixels]
    assert off[kind == FOLDED].max() < 0.024
    assert (kind[texels.inside & (off > 0.024)] == MEASURED).all()
    assert (2 * np.pi * R**2) * 0.001 < coverage_shares(control, found)["folded"] * (4 * np.pi * R**2) < 0.03**2
    moved = found.vectors.reshape(-1, 3)[texels.pixels].any(axis=1)
    assert off[moved].max() < 0.06
    fine = subdivide(control.mesh, control.chart, 4)
    plain, bent = (Reconstruction(control, m, fine).mesh() for m in (replace(found, vectors=None), found))
    assert surface_error(bent, mushroom, 50_000).rms < 0.6 * surface_error(plain, mushroom, 50_000).rms
    inverted = inverted_triangles(control, control.mesh.vertices, fine, bent.vertices)
    assert len(inverted)                                     # the underside of the cap
    folds = in_folds(control, found, fine)
    assert folds[inverted].all()
    assert in_folds(control, replace(found, vectors=None), fine).mean() < folds.mean() < 0.05
    shelf = mushroom.vertices[np.hypot(mushroom.vertices[:, 0], mushroom.vertices[:, 1]) > 0.0165]
    shelf = shelf[shelf[:, 2] > 0.205]                       # the cap's rim, beyond what heights can say
    far = [Surface(mesh).closest(shelf).distances.mean() for mesh in (plain, bent)]
    assert far[0] > 0.002
    assert far[1] < 0.6 * far[0]


def test_a_control_mesh_that_is_folded_inside_the_scan_is_drawn_out(control, scan):
    near = np.linalg.norm(control.mesh.vertices - [0, R, 0], axis=1) < 0.35 * R
    dented = replace(control, mesh=control.mesh.with_vertices(
        control.mesh.vertices - np.where(near[:, None], [0, 0.8 * R, 0], 0)))
    config = DisplacementConfig(size=128)
    out = unfold_control(dented, scan, config)
    rms, folded = [], []
    for one in (dented, out):
        found = bake(one, scan, config)
        folded.append(coverage_shares(one, found)["folded"])
        built = Reconstruction(one, found, subdivide(one.mesh, one.chart, 3)).mesh()
        rms.append(surface_error(built, scan, 20_000).rms)
    assert folded[1] < 0.2 * folded[0]
    assert rms[1] < 0.1 * rms[0]
    moved = np.linalg.norm(out.mesh.vertices - dented.mesh.vertices, axis=1) > 0
    assert not moved[control.mesh.vertices[:, 1] < 0].any()
    assert (unfold_control(control, scan, config).mesh.vertices == control.mesh.vertices).all()


# ---- subdivision

@pytest.mark.parametrize("level", range(5))
def test_a_split_of_every_edge_has_four_times_the_vertices_less_six(control, level):
    fine = subdivide(control.mesh, control.chart, level)
    count = len(control.mesh.vertices)
    for _ in range(level):
        count = 4 * count - 6
    assert len(fine.parent) == count
    mesh = fine.mesh(control.mesh)
    assert mesh.is_closed
    assert mesh.is_edge_manifold
    np.testing.assert_allclose(mesh.face_areas.sum(), control.mesh.face_areas.sum())
    np.testing.assert_allclose(fine.chart.flat.face_areas.sum(), control.chart.flat.face_areas.sum())
    corners = fine.chart.uv[fine.chart.faces]                # where each vertex is, seen from its triangles
    own = chart_places(control.chart, fine.parent, fine.bary)
    inner = (fine.parent[fine.faces] == fine.face_parent[:, None])
    np.testing.assert_allclose(corners[inner], own[fine.faces][inner], atol=1e-12)


@pytest.fixture(scope="module")
def one_bump(control):
    """Heights of a bump of 10 mm at one place, as a map."""
    texels = find_texels(control.mesh, control.chart, SIZE)
    p, _ = interpolate(control.mesh, texels.faces, texels.bary)
    heights = 0.01 * np.exp(-np.sum((p - [0, 0.2, 0])**2, axis=1) / 0.03**2)
    return DisplacementMap(texels.image(heights.astype(np.float32)),
                           texels.image(np.where(texels.inside, MEASURED, OUTSIDE).astype(np.uint8), OUTSIDE))


def test_adaptive_subdivision_splits_where_the_surface_bends_without_a_crack(control, one_bump):
    displaced = displaced_surface(control, one_bump)
    fine = subdivide_adaptive(control.mesh, control.chart, displaced, 3e-4, 4)
    mesh = fine.mesh(control.mesh)
    assert mesh.is_closed
    assert mesh.is_edge_manifold
    assert len(fine.parent) - len(mesh.edges) + len(fine.faces) == 2
    np.testing.assert_allclose(mesh.face_areas.sum(), control.mesh.face_areas.sum())
    even = subdivide(control.mesh, control.chart, 4)
    assert len(fine.faces) < 0.25 * len(even.faces)
    far = mesh.corners.mean(axis=1)[:, 1] < 0
    assert np.isin(mesh.face_areas[far], control.mesh.face_areas).all()              # nothing happens behind
    detailed = Reconstruction(control, one_bump, fine).mesh()
    truth = Reconstruction(control, one_bump, even).mesh()
    assert Surface(detailed).closest(truth.vertices).distances.max() < 3.5e-4
    fewer = subdivide_adaptive(control.mesh, control.chart, displaced, 1e-3, 4)
    assert len(fewer.faces) < len(fine.faces)


# ---- reconstruction

def test_reconstruction_comes_nearer_to_the_scan_with_every_level(control, scan, baked):
    errors = [surface_error(Reconstruction(control, baked, subdivide(control.mesh, control.chart, level)).mesh(), scan,
                            20_000) for level in range(4)]
    for coarse, fine in pairwise(errors):
        assert fine.mean < 0.5 * coarse.mean
        assert fine.mean <= fine.rms <= fine.max
    assert errors[3].mean < 1e-4


def test_errors_of_a_larger_sphere_are_the_difference_of_the_radii():
    found = surface_error(ball(80, 160, 0.203)[0], ball(80, 160, 0.2)[0], 20_000)
    assert found.mean == pytest.approx(0.003, abs=3e-5)
    assert found.rms == pytest.approx(0.003, abs=3e-5)


def test_detail_turns_and_moves_with_the_control_mesh(control, mushroom):
    found = bake(control, mushroom, DisplacementConfig(size=SIZE, vectors=True))
    fine = subdivide(control.mesh, control.chart, 3)
    build = Reconstruction(control, found, fine)
    turn, shift = Rotation.from_rotvec([0.3, -1, 2]), np.array([1, 2, 3.0])
    rest, v = build(control.mesh.vertices), np.array(control.mesh.vertices)
    np.testing.assert_allclose(build(turn.apply(v) + shift), turn.apply(rest) + shift, atol=1e-9)
    rotations = VertexRotations(control.mesh, np.arange(0, len(v), 3))
    turned = rotations(turn.apply(v), turn.apply(np.array(control.mesh.vertex_normals)))
    np.testing.assert_allclose(turned, np.tile(turn.as_matrix(), (len(turned), 1, 1)), atol=1e-9)
    displaced = displaced_surface(control, found)(fine.parent, fine.bary)
    np.testing.assert_allclose(rest, displaced, atol=1e-9)
    with pytest.raises(ValueError, match="control_vertices"):
        build(v[1:])


def test_triangles_that_are_turned_over_are_found(control, baked):
    fine = subdivide(control.mesh, control.chart, 2)
    x = Reconstruction(control, baked, fine)(control.mesh.vertices)
    assert not len(inverted_triangles(control, control.mesh.vertices, fine, x))
    turned = x.copy()
    face = 1000
    a, b, c = fine.faces[face]
    turned[a] += 2.2 * (0.5 * (x[b] + x[c]) - x[a])
    assert face in inverted_triangles(control, control.mesh.vertices, fine, turned)


# ---- files

def test_files_give_back_the_map(tmp_path, control, mushroom):
    found = bake(control, mushroom, DisplacementConfig(size=64, vectors=True))
    write_map(tmp_path, found)
    back = read_map(tmp_path)
    for name in ("heights", "coverage", "vectors"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name))
    write_map(tmp_path, replace(found, vectors=None))
    assert read_map(tmp_path).vectors is None


def test_the_grey_image_holds_heights_to_half_a_step(tmp_path, baked):
    import json

    write_map(tmp_path, baked)
    header = json.loads((tmp_path / "displacement.json").read_text())
    grey = np.asarray(Image.open(tmp_path / "displacement.png")).astype(float)
    inside = baked.coverage != OUTSIDE
    error = np.abs((grey - header["zero"]) * header["scale"] - baked.heights)[inside]
    assert header["scale"] / 4 < error.max() <= header["scale"] / 2 * 1.0001
    assert header["scale"] < 5e-7


def save_rgb16(path, image):
    """A coloured PNG of 16 bits, each row with another filter, which Pillow cannot write."""
    import struct
    import zlib

    height, width, channels = image.shape
    raw = image.astype(">u2").view(np.uint8).reshape(height, -1).astype(int)
    step, lines = 2 * channels, []
    for y in range(height):
        a = np.r_[np.zeros(step, int), raw[y, :-step]]
        b = raw[y - 1] if y else np.zeros_like(raw[y])
        c = np.r_[np.zeros(step, int), b[:-step]]
        p = a + b - c
        near = [np.abs(p - v) for v in (a, b, c)]
        paeth = np.where((near[0] <= near[1]) & (near[0] <= near[2]), a, np.where(near[1] <= near[2], b, c))
        guess = [0, a, b, (a + b) // 2, paeth][y % 5]
        lines.append(bytes([y % 5]) + ((raw[y] - guess) % 256).astype("u1").tobytes())

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0))
                     + chunk(b"IDAT", zlib.compress(b"".join(lines))) + chunk(b"IEND", b""))


def test_an_edited_image_edits_exactly_there(tmp_path, control, baked):
    write_map(tmp_path, baked)
    grey = np.asarray(Image.open(tmp_path / "displacement.png")).copy()
    assert (read_map(tmp_path, tmp_path / "displacement.png").heights == baked.heights).all()
    square = (slice(80, 100), slice(90, 110))
    grey[square] -= 4000
    Image.fromarray(grey).save(tmp_path / "edited.png")
    edited = read_map(tmp_path, tmp_path / "edited.png")
    change = edited.heights.astype(float) - baked.heights
    there = np.zeros(change.shape, bool)
    there[square] = True
    assert (change[~there] == 0).all()
    np.testing.assert_allclose(change[there], change[there].mean(), rtol=1e-4)
    assert change[there].mean() < -3e-4
    fine = subdivide(control.mesh, control.chart, 3)
    moved = np.linalg.norm(Reconstruction(control, edited, fine).mesh().vertices
                           - Reconstruction(control, baked, fine).mesh().vertices, axis=1) > 0
    uv = chart_places(control.chart, fine.parent, fine.bary) * SIZE
    x, y = uv[:, 0], SIZE - uv[:, 1]
    around = (x > 89.5) & (x < 110.5) & (y > 79.5) & (y < 100.5)
    assert moved.any()
    np.testing.assert_array_equal(moved, around)
    save_rgb16(tmp_path / "rgb.png", np.repeat(grey[:, :, None], 3, axis=2))
    np.testing.assert_array_equal(read_map(tmp_path, tmp_path / "rgb.png").heights, edited.heights)


def test_unusable_edited_images_are_refused(tmp_path, baked):
    write_map(tmp_path, baked)
    grey = np.asarray(Image.open(tmp_path / "displacement.png"))
    colors = np.repeat(grey[:, :, None], 3, axis=2)
    colors[5, 5, 1] += 1
    save_rgb16(tmp_path / "colors.png", colors)
    Image.fromarray((grey >> 8).astype(np.uint8)).save(tmp_path / "eight.png")
    Image.fromarray(grey[:100]).save(tmp_path / "small.png")
    (tmp_path / "no.png").write_bytes(b"no image")
    whole = (tmp_path / "colors.png").read_bytes()
    (tmp_path / "cut.png").write_bytes(whole[:len(whole) // 2])
    wanted = f"expected an image of {SIZE} x {SIZE} pixels with 16 bits of grey"
    for name, came in (("colors", "its channels differ"), ("eight", f"{SIZE} x {SIZE} pixels with 8 bits"),
                       ("small", f"{SIZE} x 100 pixels"), ("no", "cannot read it"), ("cut", "cannot read it"),
                       ("missing", "no such file")):
        with pytest.raises(StorageError, match=wanted) as told:
            read_map(tmp_path, tmp_path / f"{name}.png")
        assert came in str(told.value)
        assert f"{name}.png" in str(told.value)
    (tmp_path / "coverage.png").write_bytes((tmp_path / "small.png").read_bytes())
    with pytest.raises(StorageError, match=r"coverage.png: expected uint8 numbers of shape"):
        read_map(tmp_path)


def test_unusable_input_is_told(control, scan):
    with pytest.raises(ValueError, match="at least one triangle"):
        bake(control, Mesh(scan.vertices, np.zeros((0, 3), int)))
    with pytest.raises(ValueError, match="size"):
        bake(control, scan, DisplacementConfig(size=3))
    with pytest.raises(ValueError, match="level"):
        subdivide(control.mesh, control.chart, -1)
    with pytest.raises(ValueError, match="tolerance"):
        subdivide_adaptive(control.mesh, control.chart, lambda faces, bary: bary, 0, 1)
    with pytest.raises(ValueError, match="reach"):
        to_normal_volume(control.mesh, scan.vertices, 0)
    with pytest.raises(ValueError, match="colours"):
        scan_look(scan)


# ---- colours

def test_colours_lie_where_they_are_on_the_scan(control, scan, baked):
    painted = Mesh(scan.vertices, scan.faces, 0.5 + 2 * scan.vertices)
    texels = find_texels(control.mesh, control.chart, SIZE)
    p, n = interpolate(control.mesh, texels.faces, texels.bary)
    places = p + baked.heights.ravel()[texels.pixels, None] * n
    image = bake_texture(control, baked, scan_look(painted)).reshape(-1, 3)[texels.pixels] / 255
    np.testing.assert_allclose(image, 0.5 + 2 * places, atol=0.004)

    def half(places, normals):
        return 0.5 + 2 * places, (places[:, 2] > 0).astype(float)
    filled = bake_texture(control, baked, half).reshape(-1, 3)[texels.pixels] / 255
    known = places[:, 2] > 0
    np.testing.assert_allclose(filled[known], 0.5 + 2 * places[known], atol=0.004)
    assert filled[~known, 2] == pytest.approx(0.5, abs=0.02)              # the rim's colour
