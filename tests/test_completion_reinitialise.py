"""A limb whose markers are all taken for outliers comes back; markers that lie do not move the body."""
import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior

from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.initialise import reinitialise_frames
from completion.mocap.pose.marked_body import AnimateConfig, MarkedBody

CONFIG = AnimateConfig(prior_weight=1e-3)
LOST = np.arange(10, 16)


@pytest.fixture(scope="module")
def body():
    subject = worm_with_prior().subject(np.array([0.5, -0.5, 0.2]))
    vertices = np.random.default_rng(4).choice(396, 30, replace=False)
    return MarkedBody(subject, MarkerLayout(tuple(f"M{i}" for i in range(30)), vertices, 0.012), 1e-3, 0.3)


@pytest.fixture(scope="module")
def true(body):
    t = np.arange(30) / 100
    poses = MEAN + np.sin(2 * np.pi * t[:, None, None] + np.arange(4)[:, None]) * np.array([0.05, 0.3, 0.2])
    return body.body.join(poses, np.stack([1.2 * t, 0 * t, 0 * t], axis=1))


def lost_limb(x):
    out = x.copy()
    out[LOST, -6:-3] += [0.0, 2.2, 0.0]                               # the last joint, bent by 126 degrees
    return out


def test_a_lost_limb_comes_back_and_nothing_else_moves(body, true):
    targets, start = body.positions(true), lost_limb(true)
    far = np.linalg.norm(body.positions(start) - targets, axis=2)
    assert ((far[LOST] > 2 * CONFIG.outlier).sum(axis=1) >= 3).all()
    found = reinitialise_frames(body, start, targets, CONFIG)
    assert np.abs(body.positions(found) - targets).max() < 2e-3
    others = np.setdiff1d(np.arange(30), LOST)
    assert (found[others] == start[others]).all()


def test_with_markers_missing(body, true):
    targets = body.positions(true)
    targets[12, ::2] = np.nan
    found = reinitialise_frames(body, lost_limb(true), targets, CONFIG)
    assert np.abs(body.positions(found) - body.positions(true))[LOST].max() < 5e-3


def test_markers_that_lie_apart_move_nothing(body, true):
    targets = body.positions(true)
    targets[LOST[:, None], [3, 11, 19]] += np.random.default_rng(1).normal(0, 0.5, (len(LOST), 3, 3))
    assert (reinitialise_frames(body, true, targets, CONFIG) == true).all()


def test_without_a_good_frame_it_stays(body, true):
    targets = body.positions(true) + np.random.default_rng(2).normal(0, 1.0, (30, 30, 3))
    assert (reinitialise_frames(body, true, targets, CONFIG) == true).all()
