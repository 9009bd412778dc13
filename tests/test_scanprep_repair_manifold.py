import numpy as np
import pytest
from scanned_shapes import ball, bumpy, joined

from scanprep.geometry.mesh import Mesh, template_problem
from scanprep.geometry.remeshing import smooth_taubin
from scanprep.geometry.surface import Surface
from scanprep.repair.manifold import (
    drop_small_components,
    orient_triangles,
    repair,
)


def soup(mesh):
    return Mesh(mesh.corners.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


@pytest.mark.parametrize("spoil", ["double", "flipped double", "flat", "fin", "unused", "piece", "soup"])
def test_each_defect_is_removed(spoil):
    mesh = bumpy(3)
    v, f = mesh.vertices, mesh.faces
    middle = (v[f[5, 0]] + v[f[5, 1]]) / 2
    bad = {"double": Mesh(v, np.concatenate([f, f[3:9]])),
           "flipped double": Mesh(v, np.concatenate([f, f[3:9, ::-1]])),
           "flat": Mesh(np.concatenate([v, [middle]]), np.concatenate([f, [[f[5, 0], f[5, 1], len(v)]]])),
           "fin": Mesh(np.concatenate([v, [1.01 * v[f[5, 0]]]]), np.concatenate([f, [[f[5, 0], f[5, 1], len(v)]]])),
           "unused": Mesh(np.concatenate([v, [[9.0, 9, 9]]]), f),
           "piece": joined(mesh, ball(1, 0.02)),
           "soup": soup(mesh)}[spoil]
    assert template_problem(bad) is not None
    good = repair(bad)
    assert template_problem(good) is None
    assert len(good.faces) >= len(f) - 1
    assert Surface(good).closest(v).distances.max() < 0.5 * mesh.mean_edge


def test_repair_twice_is_repair_once():
    rng = np.random.default_rng(0)
    mesh = bumpy(3)
    stray = rng.integers(0, len(mesh.vertices), (40, 3))
    once = repair(Mesh(mesh.vertices, np.concatenate([mesh.faces[rng.random(len(mesh.faces)) > 0.1], stray])))
    assert template_problem(once) is None
    twice = repair(once)
    assert np.array_equal(once.corners, twice.corners) and len(once.vertices) == len(twice.vertices)


@pytest.mark.parametrize("share", [0.05, 0.4])
def test_turned_triangles_are_turned_back(share):
    rng = np.random.default_rng(4)
    mesh = bumpy(4)
    turned = rng.random(len(mesh.faces)) < share
    mixed = Mesh(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces))
    good = repair(mixed)
    assert good.is_closed and template_problem(good) is None and len(good.faces) == len(mesh.faces)
    assert good.volume == pytest.approx(mesh.volume, rel=1e-12)


def test_a_piece_that_is_inside_out_keeps_its_side():
    inside_out = Mesh(ball(2).vertices, ball(2).faces[:, ::-1])
    assert orient_triangles(inside_out) is inside_out
    both = joined(ball(3), inside_out)
    assert np.array_equal(orient_triangles(both).faces, both.faces)


def moebius(count=60):
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    across = np.stack([np.cos(angle / 2) * np.cos(angle), np.cos(angle / 2) * np.sin(angle), np.sin(angle / 2)], axis=1)
    middle = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
    vertices = np.concatenate([middle + 0.3 * across, middle - 0.3 * across])
    i = np.arange(count)
    a, b = i, i + count
    c, d = np.where(i < count - 1, i + 1, count), np.where(i < count - 1, i + 1 + count, 0)
    return Mesh(vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([c, b, d], axis=1)]))


@pytest.mark.parametrize("seed", range(6))
def test_whatever_comes_in_comes_out_manifold(seed):
    """Shared and doubled vertices, needles, folds, strays and turned triangles all at once."""
    rng = np.random.default_rng(seed)
    mesh = joined(bumpy(3), ball(2, 0.05), moebius(20))
    v, f = mesh.vertices.copy(), mesh.faces
    near = rng.integers(0, len(v), (60, 2))
    v[near[:, 0]] = v[near[:, 1]] + 1e-9 * rng.normal(size=(60, 3))      # far vertices pulled onto each other
    stray = rng.integers(0, len(v), (200, 3))
    f = np.concatenate([f, f[:50, ::-1], f[50:90], stray])
    f = f[rng.permutation(len(f))]
    f = np.where(rng.random(len(f))[:, None] < 0.2, f[:, ::-1], f)
    good = repair(Mesh(v, f))
    assert template_problem(good) is None
    kept = {tuple(np.round(p, 6)) for p in v}
    assert all(tuple(np.round(p, 6)) in kept for p in good.vertices)      # nothing was made up


def test_nothing_left_is_an_error():
    with pytest.raises(ValueError, match="no triangle is left"):
        repair(Mesh(np.zeros((3, 3)), [[0, 1, 2]]))


def test_pieces_are_dropped_by_size():
    mesh = joined(ball(3), ball(2, 0.05), ball(0, 0.01))
    sizes = [len(ball(d).vertices) for d in (3, 2, 0)]
    for share, kept in ((0.0, sizes), (0.1, sizes[:2]), (1.0, sizes[:1])):
        assert len(drop_small_components(mesh, share).vertices) == sum(kept)
    assert len(repair(mesh, min_component=0.1).vertices) == sum(sizes[:2])


def test_smoothing_takes_noise_off_and_keeps_the_size():
    rng = np.random.default_rng(3)
    exact = ball(4)
    noisy = exact.with_vertices(exact.vertices * (1 + 0.01 * rng.normal(size=(len(exact.vertices), 1))))
    even = smooth_taubin(noisy, 10)
    off = np.linalg.norm(even.vertices, axis=1) - 0.1
    assert off.std() < 0.4 * 0.001
    assert abs(off.mean()) < 2e-4
