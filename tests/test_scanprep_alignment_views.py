import numpy as np
import pytest
from scanned_shapes import SIX, bumpy, view

from scanprep.alignment.view_poses import place_by_landmarks
from scanprep.alignment.views import align_views
from scanprep.geometry import rotations


@pytest.fixture(scope="module")
def views():
    return [view(bumpy(4), d, spacing=0.005) for d in SIX]


def moved(views, rng, turn=1.0, shift=0.5):
    """Every view in a frame of its own, and the frames."""
    out, frames = [], []
    for mesh, camera in views:
        R, t = rotations.exp(turn * rng.normal(size=3)), shift * rng.normal(size=3)
        out.append((mesh.with_vertices(mesh.vertices @ R.T + t), R @ camera + t))
        frames.append((R, t))
    return out, frames


def worst(found, frames, views):
    """Largest mean distance of a view from where the first one says it belongs."""
    R, t = frames[0]
    return max(np.linalg.norm(mesh.vertices - (true.vertices @ R.T + t), axis=1).mean()
               for (mesh, _), (true, _) in zip(found, views, strict=True))


def test_views_without_cameras_but_with_rough_landmarks(views):
    rng = np.random.default_rng(1)
    lost, frames = moved(views, rng)
    points = bumpy(3).vertices[[3, 70, 150, 210, 300]]
    clicked = [{str(k): R @ p + t + 0.0003 * rng.normal(size=3) for k, p in enumerate(points)} for R, t in frames]
    assert worst(lost, frames, views) > 0.3
    found = align_views(lost, landmarks=clicked)
    assert found.overlap.min() > 0.5 and found.conflict.max() < 0.01
    assert found.converged or not found.trusted.any()            # a smooth lump settles slowly; that is told
    assert worst(found.views, frames, views) < 0.005


def test_a_failure_is_told(views):
    lost, frames = moved(views, np.random.default_rng(2), turn=1.0, shift=0.05)
    found = align_views(lost)
    assert worst(found.views, frames, views) > 0.02
    assert not found.trusted.all()


def test_a_single_view_is_where_it_is(views):
    found = align_views(views[:1])
    assert found.trusted.all() and np.array_equal(found.views[0][0].vertices, views[0][0].vertices)


def test_too_few_landmarks_are_refused(views):
    with pytest.raises(ValueError, match="one mapping for each of 6 views, got 1"):
        align_views(views, landmarks=[{}])
    with pytest.raises(ValueError, match=r"view 1 shares 2 .* at least three"):
        place_by_landmarks([{c: np.eye(3)[k % 3] for k, c in enumerate("abc")}, {c: np.ones(3) for c in "ab"}], 2)
    line = {str(k): np.array([0.1 * k, 0.0, 0.0]) for k in range(5)}
    with pytest.raises(ValueError, match="not on one line"):
        place_by_landmarks([line, line], 2)
