"""Labels while points without names come in: a simulated person whose points are shuffled in every frame."""
import numpy as np
import pytest
from people_bodies import kept, small_people

from completion import LabelStream
from completion.mocap.labelling.assignment import certainty
from completion.mocap.labelling.body_search import Placement
from completion.mocap.labelling.live_matching import SEEN_SD, Expected, intersect, match, shift_groups
from completion.mocap.marker_sets.named import load_layout
from model.human_poses import human_poses
from scanprep.geometry import rotations

RATE = 100.0
FRAMES = 160
NOISE = 0.0005                       # metres, of a camera system


@pytest.fixture(scope="module")
def subject():
    return small_people().subject(None)


@pytest.fixture(scope="module")
def layout():
    return load_layout("cmu41", small_people().template, kept())


@pytest.fixture(scope="module")
def motion(subject, layout):
    """Poses (T, J, 3), places (T, 3) and markers (T, L, 3) of a person who walks from pose to pose."""
    keys = human_poses(subject.template, subject.skeleton, 6, np.random.default_rng(3))[[1, 2, 4]]
    keys[:, 0] = [0.3, 0.0, 0.1], [0.3, 0.1, 0.5], [0.3, 0.0, 0.8]
    t = np.linspace(0, len(keys) - 1.001, FRAMES)
    i, share = np.floor(t).astype(int), 0.5 - 0.5 * np.cos(np.pi * (t % 1))
    between = rotations.log(np.swapaxes(rotations.exp(keys[i]), -1, -2) @ rotations.exp(keys[i + 1]))
    poses = rotations.compose(keys[i], share[:, None, None] * between)
    trans = np.stack([1.2 * np.arange(FRAMES) / RATE, 0.1 * np.sin(3 * t), 0 * t], axis=1)
    markers = np.stack([layout.place(subject.template.with_vertices(v)) for v in subject.vertices(poses, trans)])
    # each marker a little beside where the layout has it, all the time
    rng = np.random.default_rng(0)
    return poses, trans, markers + rng.normal(0, 0.003, markers.shape[1:]) + rng.normal(0, NOISE, markers.shape)


def shuffled(markers, seed=0, missing=0.0, ghosts=0):
    """Points (T, N, 3) in another order in every frame, and which marker (T, N) each is, -1 of a ghost."""
    rng = np.random.default_rng(seed)
    T, L = markers.shape[:2]
    points = np.where(rng.random((T, L, 1)) < missing, np.nan, markers)
    low, high = markers.min(axis=1, keepdims=True), markers.max(axis=1, keepdims=True)
    points = np.concatenate([points, low + rng.random((T, ghosts, 3)) * (high - low)], axis=1)
    names = np.broadcast_to(np.r_[np.arange(L), np.full(ghosts, -1)], points.shape[:2])
    order = np.argsort(rng.random(points.shape[:2]), axis=1)
    return np.take_along_axis(points, order[..., None], axis=1), np.take_along_axis(names, order, axis=1)


def pushed(stream, points):
    return [stream.push(frame) for frame in points]


def labels(frames, names):
    """(T, L) which marker the point of each label truly is, -2 without a point."""
    columns = np.stack([frame.columns for frame in frames])
    return np.where(columns >= 0, np.take_along_axis(names, np.maximum(columns, 0), axis=1), -2)


def share_right(frames, points, names):
    """Of the markers that are there, those under their own label."""
    truly = labels(frames, names)
    there = (names >= 0) & np.isfinite(points[..., 0])
    return (truly == np.arange(truly.shape[1])).sum() / there.sum()


@pytest.fixture(scope="module")
def clean(subject, layout, motion):
    points, names = shuffled(motion[2])
    return pushed(LabelStream(subject, layout, RATE), points), points, names


def test_shuffled_points_get_their_labels_and_the_body_its_pose(subject, motion, clean):
    frames, points, names = clean
    assert share_right(frames, points, names) == 1
    assert all(frame.found for frame in frames)
    body = subject.vertices(np.array([f.pose for f in frames]), np.array([f.trans for f in frames]))
    assert np.linalg.norm(body - subject.vertices(*motion[:2]), axis=2).mean(axis=1).max() < 0.008
    assert np.mean([frame.confidence > 0.9 for frame in frames]) > 0.99


def test_the_order_of_points_does_not_matter_and_no_later_frame_is_looked_at(subject, layout, motion, clean):
    frames, _, names = clean
    other = motion[2][:40].copy()
    other[30:] += 5.0
    again = pushed(LabelStream(subject, layout, RATE), other)
    for i, frame in enumerate(again[:30]):
        np.testing.assert_array_equal(names[i, frames[i].columns], frame.columns)
        np.testing.assert_allclose(frame.pose, frames[i].pose, atol=1e-6)
        np.testing.assert_allclose(frame.confidence, frames[i].confidence, atol=1e-6)


def test_missing_points_and_ghosts_do_little(subject, layout, motion):
    points, names = shuffled(motion[2], 1, missing=0.2, ghosts=5)
    points = np.concatenate([points, np.tile([1.0, 0.3, 1.0], (FRAMES, 1, 1))], axis=1)           # a reflection at rest
    names = np.concatenate([names, np.full((FRAMES, 1), -1)], axis=1)
    frames = pushed(LabelStream(subject, layout, RATE), points)
    assert share_right(frames, points, names) > 0.99                                              # a foot at first
    assert share_right(frames[30:], points[30:], names[30:]) > 0.998
    ghosts = labels(frames, names) == -1
    assert ghosts.sum() < 0.001 * ghosts.size
    assert not (ghosts[:-2] & ghosts[1:-1] & ghosts[2:]).any()                                    # none for long
    assert np.isfinite([frame.pose for frame in frames]).all()


def test_who_leaves_is_found_again_elsewhere_turned_and_in_another_pose(subject, layout, motion):
    markers = motion[2]
    R = rotations.exp(np.array([0, 0, 2.5]))
    back = (markers[100:150] - markers[100].mean(axis=0)) @ R.T + [3.0, -2.0, 0.9]
    first, _ = shuffled(markers[:20], 2)
    second, names_2 = shuffled(back, 3)
    ghosts = np.random.default_rng(4).random((100, 5, 3)) * 2
    stream = LabelStream(subject, layout, RATE)
    here, away, again = (pushed(stream, points) for points in (first, ghosts, second))
    assert all(frame.found for frame in here)
    assert not any(frame.found for frame in away[60:])
    assert sum((frame.columns >= 0).sum() for frame in away) <= 2
    assert np.isnan(away[-1].pose).all() and not away[-1].confidence.any()
    assert again[0].found and share_right(again, second, names_2) > 0.99


def test_empty_frames_are_bridged(subject, layout, motion):
    points, names = shuffled(motion[2])
    points[60:68] = np.nan
    stream = LabelStream(subject, layout, RATE)
    frames = [stream.push(np.zeros((0, 3)) if 64 <= t < 68 else frame) for t, frame in enumerate(points)]
    assert share_right(frames, points, names) > 0.99
    assert all(frame.found and np.isfinite(frame.pose).all() for frame in frames)
    assert (frames[62].columns == -1).all() and not frames[62].confidence.any()


@pytest.mark.parametrize("fault", ["foot turned about", "whole body turned about"])
def test_a_body_that_was_found_wrongly_is_noticed_and_sought_anew(subject, layout, motion, fault):
    poses, trans, markers = motion
    points, names = shuffled(markers)
    stream = LabelStream(subject, layout, RATE)
    pose = poses[0].copy()
    if fault == "foot turned about":
        pose[subject.skeleton.names.index("foot_left")] = [0.0, 0.0, 2.2]
    else:
        pose[0] = rotations.compose(np.array([0, 0, np.pi]), pose[0])
    x = stream.body.body.join(pose, trans[0])
    x[-3:] += markers[0].mean(axis=0) - stream.body.positions(x).mean(axis=0)
    stream._go_on_from(Placement(x, np.full(len(layout.labels), -1), 0.1))
    frames = pushed(stream, points)
    assert share_right(frames[:3], points[:3], names[:3]) < 0.99                                  # there is a fault
    assert share_right(frames[100:], points[100:], names[100:]) > 0.995


def test_wrong_arguments_are_told(subject, layout):
    for rate in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="rate"):
            LabelStream(subject, layout, rate)
    with pytest.raises(ValueError, match="layout: expected at least 10"):
        LabelStream(subject, layout.select(layout.labels[:9]), RATE)
    stream = LabelStream(subject, layout, RATE)
    for wrong in (np.zeros(3), np.zeros((4, 2)), np.zeros((2, 4, 3))):
        with pytest.raises(ValueError, match="points: expected shape"):
            stream.push(wrong)


def expected(places, sd):
    return Expected(np.asarray(places, dtype=float), np.tile(np.eye(3) / sd**2, (len(places), 1, 1)))


def test_two_predictions_are_joined_without_new_certainty():
    one = expected(np.eye(3), 0.01)
    same = intersect(one, one, np.arange(3))
    np.testing.assert_allclose(same.places, one.places)
    np.testing.assert_allclose(same.precision, one.precision)
    joined = intersect(one, expected([[1, 0, 0.03]], 0.02), np.array([0]))                        # a fifth of the way
    np.testing.assert_allclose(joined.places, [[1, 0, 0.006], [0, 1, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(joined.precision[0], 0.5 * (1e4 + 2500) * np.eye(3))


def test_matches_are_within_what_is_known_of_a_marker():
    points = np.array([[0, 0, 0.03], [5, 5, 5]])
    assert match(expected([[0, 0, 0]], SEEN_SD), points, False)[0] == [-1]                        # 7.5 deviations
    assert match(expected([[0, 0, 0]], 0.02), points, False)[0] == [0]
    assert match(expected([[0, 0, 0]], 0.5), points, False)[0] == [0]
    assert match(expected([[0, 0, 0]], 0.5), points, True)[0] == [-1]                             # it may be anywhere


def test_confidence_is_half_where_two_points_are_alike():
    cost = np.array([[1.0, 1.0, 20.0], [20.0, 20.0, 0.0]])
    np.testing.assert_allclose(certainty(cost, np.array([0, 2]), 9.0), [0.5, 1 / (1 + np.exp(-9.0))])
    assert certainty(cost, np.array([-1, 2]), 9.0)[0] == 0


def test_markers_that_moved_on_together_keep_their_labels():
    # four in a row, 6 cm apart, all of which went 6 cm along the row; the body may be off by 4 cm as a whole
    row = np.arange(4)[:, None] * np.array([[0.06, 0, 0]]) + [0, 0.02, 0] * (np.arange(4) % 2)[:, None]
    points = row + [0.06, 0, 0]
    slopes = np.tile(np.eye(3), (4, 1, 1))                                                        # of the place alone
    covariance = 0.04**2 * np.eye(3)
    spread = np.full(4, 0.005**2)
    there = expected(row, np.hypot(0.04, 0.005))
    next_one = np.array([-1, 0, 1, 2])
    np.testing.assert_array_equal(shift_groups(there, slopes, covariance, spread, points, next_one), np.arange(4))
    # where each moves for itself, that is no reason
    tight = 0.001**2 * np.eye(3)
    np.testing.assert_array_equal(shift_groups(there, slopes, tight, spread, points, next_one), next_one)
