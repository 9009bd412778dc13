import numpy as np
import pytest
from scanned_shapes import SIX, ball, bumpy, view

from scanprep.alignment.views import align_views
from scanprep.fusion.tsdf import MergeConfig, merge_views
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

COARSE = MergeConfig(voxel=0.005)


@pytest.fixture(scope="module")
def shape():
    return bumpy(5)


@pytest.fixture(scope="module")
def views(shape):
    return [view(shape, d) for d in SIX]


def test_six_views_of_a_ball_become_the_ball():
    exact = ball(5)
    merged = merge_views([view(exact, d) for d in SIX], COARSE)
    assert np.abs(np.linalg.norm(merged.vertices, axis=1) - 0.1).max() < 0.0008
    assert merged.is_closed and merged.is_edge_manifold
    assert merged.volume == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.01)


def test_noise_averages_out(shape):
    rng = np.random.default_rng(0)
    noisy = [view(shape, d, rng, noise=0.001) for d in SIX]
    merged = merge_views(noisy, COARSE)
    before = np.mean([Surface(shape).closest(mesh.vertices).distances.mean() for mesh, _ in noisy])
    assert Surface(shape).closest(merged.vertices).distances.mean() < 0.7 * before


def test_what_no_view_saw_stays_open(shape, views):
    merged = merge_views(views[:1], COARSE)
    camera = views[0][1]
    at = Surface(shape).closest(merged.vertices)
    facing = np.einsum("nd,nd->n", shape.face_normals[at.faces], camera - at.points)
    assert not merged.is_closed
    assert facing.min() > 0


def test_nothing_hangs_by_a_vertex(shape):
    ragged = merge_views([view(shape, SIX[0], np.random.default_rng(0), 0.004)], COARSE)
    assert not ragged.is_closed and ragged.is_vertex_manifold


def test_order_of_views_does_not_matter(views):
    a, b = merge_views(views, COARSE), merge_views(views[::-1], COARSE)
    assert np.array_equal(a.faces, b.faces)
    assert np.abs(a.vertices - b.vertices).max() < 1e-9


def test_colours_are_carried(views):
    def painted(mesh):
        return Mesh(mesh.vertices, mesh.faces, np.clip(mesh.vertices / 0.4 + 0.5, 0, 1))

    merged = merge_views([(painted(m), c) for m, c in views], COARSE)
    assert np.abs(merged.colors - np.clip(merged.vertices / 0.4 + 0.5, 0, 1)).max() < 0.03


def test_views_are_checked(views):
    with pytest.raises(ValueError, match="views: expected at least one"):
        merge_views([])
    with pytest.raises(ValueError, match="camera position"):
        merge_views([(views[0][0], np.zeros(2))])
    with pytest.raises(ValueError, match="no surface is left"):
        merge_views([(views[0][0], -views[0][1])], COARSE)
    with pytest.raises(ValueError, match="voxel"):
        MergeConfig(voxel=0.0)


def test_rough_cameras_are_aligned(shape, views):
    rng = np.random.default_rng(3)
    rough, truth = [], []
    for number, (mesh, camera) in enumerate(views):
        R, t = rotations.exp(0.04 * rng.normal(size=3) * bool(number)), 0.004 * rng.normal(size=3) * bool(number)
        rough.append((mesh.with_vertices(mesh.vertices @ R.T + t), camera @ R.T + t))
        truth.append(mesh.vertices)
    aligned = align_views(rough)
    before, after = (max(np.linalg.norm(mesh.vertices - t, axis=1).mean()
                         for (mesh, _), t in zip(found, truth, strict=True)) for found in (rough, aligned.views))
    assert aligned.converged
    assert before > 0.004
    assert after < 0.0006
    assert np.array_equal(aligned.views[0][0].vertices, rough[0][0].vertices)
    for (mesh, camera), start in zip(aligned.views, rough, strict=True):       # the camera moves with its view
        R, t = rotations.procrustes(start[0].vertices, mesh.vertices)
        assert np.allclose(start[0].vertices @ R.T + t, mesh.vertices) and np.allclose(R @ start[1] + t, camera)
