"""Which frames tell most of the shape: information by hand, the best frame, what is not seen."""
import numpy as np
import pytest
from completion_bodies import worm_with_prior

from completion.mocap.marker_selection.frames import FrameConfig, FrameInformation, informative_frames
from completion.mocap.marker_selection.points import BodyPoints
from completion.mocap.marker_sets.layout import MarkerLayout
from model.fitting import spread_vertices
from model.priors import gaussian_prior

MODEL = worm_with_prior()
LAYOUT = MarkerLayout(tuple(f"M{i}" for i in range(9)), spread_vertices(MODEL.template.vertices, 9), 0.0)
POSES = MODEL.pose_mean + np.random.default_rng(2).normal(0, 0.4, (12, 4, 3))
KNOWN = FrameConfig(place_sd=0.0)


def test_information_is_the_schur_complement_of_the_pose():
    found = FrameInformation(MODEL, POSES, LAYOUT, config=KNOWN)
    points, prior = BodyPoints(MODEL.points(LAYOUT.vertices)), gaussian_prior(MODEL.pose_mean, MODEL.pose_covariance)
    for t in (0, 7):
        x = np.r_[POSES[t].ravel(), np.zeros(6)][None]
        J = points.follow(x).jacobian[0].reshape(-1, 18) / KNOWN.marker_sd
        H = J.T @ J
        H[:12, :12] += prior.whitening.T @ prior.whitening
        H[np.r_[:3, 12:15], np.r_[:3, 12:15]] += 1
        assert np.allclose(np.linalg.inv(np.linalg.inv(H)[15:, 15:]), found.each[t], rtol=1e-6)


def test_more_frames_never_tell_less_and_the_first_is_the_best_alone():
    for config in (KNOWN, FrameConfig()):
        found = FrameInformation(MODEL, POSES, LAYOUT, config=config)
        order = informative_frames(MODEL, POSES, LAYOUT, 12, config=config)
        assert sorted(order) == list(range(12))
        left = [found.expected_error(order[:n]) for n in range(13)]
        assert (np.diff(left) < 0).all()
        assert left[1] == pytest.approx(min(found.expected_error([t]) for t in range(12)))
        second = min(found.expected_error([int(order[0]), t]) for t in range(12) if t != order[0])
        assert left[2] == pytest.approx(second)


def test_unknown_places_leave_more_and_other_poses_then_tell_more_than_the_same_again():
    known, unknown = (FrameInformation(MODEL, POSES, LAYOUT, config=c) for c in (KNOWN, FrameConfig(place_sd=0.02)))
    assert unknown.expected_error(list(range(12))) > 1.5 * known.expected_error(list(range(12)))
    again = FrameInformation(MODEL, np.repeat(POSES[:1], 4, axis=0), LAYOUT, config=FrameConfig(place_sd=0.02))
    assert unknown.expected_error(unknown.best(4, np.arange(12))) < 0.9 * again.expected_error([0, 1, 2, 3])


def test_a_frame_in_which_nothing_is_seen_tells_nothing():
    seen = np.ones((12, 9), bool)
    seen[:6] = False
    found = FrameInformation(MODEL, POSES, LAYOUT, seen=seen)
    assert found.expected_error(list(range(6))) == pytest.approx(found.expected_error([]))
    assert (informative_frames(MODEL, POSES, LAYOUT, 6, seen=seen) >= 6).all()


def test_the_choice_does_not_depend_on_the_order_of_frames():
    order = np.random.default_rng(1).permutation(12)
    first = informative_frames(MODEL, POSES, LAYOUT, 4)
    assert (order[informative_frames(MODEL, POSES[order], LAYOUT, 4)] == first).all()
    few = informative_frames(MODEL, POSES, LAYOUT, 2, config=FrameConfig(candidates=5))
    assert set(few) <= set(np.linspace(0, 11, 5).round().astype(int))


def test_wrong_input_is_told():
    with pytest.raises(ValueError, match=r"poses: expected finite numbers of shape \(T, 4, 3\), got shape \(12, 3"):
        informative_frames(MODEL, POSES[:, :3], LAYOUT, 2)
    with pytest.raises(ValueError, match=r"seen: expected shape \(12, 9\), got \(12, 8\)"):
        informative_frames(MODEL, POSES, LAYOUT, 2, seen=np.ones((12, 8)))
    with pytest.raises(ValueError, match="count: expected at least 1, got 0"):
        informative_frames(MODEL, POSES, LAYOUT, 0)
