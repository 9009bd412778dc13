"""Markers without names: which point is which marker, of people who were made here, so that it is known."""
import numpy as np
import pytest
from labelling import RATE, person, share_right, shuffled, unnamed

from completion.mocap.labelling.assignment import find_displaced, mean_offsets
from completion.mocap.labelling.label import GHOST, UNKNOWN, label_markers, label_people
from completion.mocap.labelling.tracks import has_tracks, link_points
from completion.mocap.marker_sets.layout import MarkerLayout


@pytest.fixture(scope="module")
def one():
    return person()


@pytest.fixture(scope="module")
def labelled(one):
    """A known person, 5% of the observations gone, two ghosts in every frame, everything shuffled."""
    subject, layout, places = one
    rng = np.random.default_rng(5)
    places = np.where(rng.random(places.shape[:2])[..., None] < 0.05, np.nan, places)
    ghosts = places[:, :2] * 0 + rng.uniform(-0.8, 0.8, (len(places), 2, 3)) + np.nanmean(places, axis=1)[:, None]
    points, truth = shuffled(np.concatenate([places, np.nan_to_num(ghosts, nan=0.7)], axis=1))
    truth = np.where(truth < places.shape[1], truth, -1)
    truth[~np.isfinite(points[..., 0])] = -2
    return label_markers(subject, unnamed(points), layout), points, truth


def test_points_that_are_shuffled_in_every_frame_get_their_labels(labelled):
    found, _, truth = labelled
    assert share_right(found.columns, truth) > 0.99
    assert found.markers.positions.shape == (*found.columns.shape, 3)
    assert (found.confidence[found.columns >= 0] > 0.9).mean() > 0.97
    assert (found.confidence[found.columns < 0] == 0).all()
    for row in found.columns:                                        # no point has two labels
        assert len(np.unique(row[row >= 0])) == (row >= 0).sum()


def test_ghosts_stay_without_a_label(labelled):
    found, points, truth = labelled
    assert found.unlabelled[truth == -1].mean() > 0.95
    assert not found.unlabelled[~np.isfinite(points[..., 0])].any()


@pytest.mark.slow
def test_labels_do_not_depend_on_where_the_person_stands_nor_faces(one):
    subject, layout, places = one
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) if np.ptp(subject.template.vertices, axis=0).argmax() == 2 \
        else np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    points, truth = shuffled(places[::6] @ turn.T + [3.0, 2.0, 1.0])
    found = label_markers(subject, unnamed(points, RATE / 6), layout)
    assert share_right(found.columns, truth) > 0.99


@pytest.mark.slow
def test_known_labels_are_kept(one):
    """Even wrong ones: whoever says them has to be believed."""
    subject, layout, places = one
    points, truth = shuffled(places[:30])
    known = np.full(truth.shape, UNKNOWN)
    first, second = layout.labels.index("LFHD"), layout.labels.index("RFHD")
    known[truth == second] = first
    known[truth == first] = GHOST
    found = label_markers(subject, unnamed(points), layout, known)
    frames = np.arange(len(points))
    assert (truth[frames, found.columns[:, first]] == second).all()
    assert found.unlabelled[truth == first].all()


@pytest.mark.slow
def test_two_people_who_pass_each_other_keep_their_markers():
    (a, layout, first), (b, _, second) = person(0), person(1)
    up = np.ptp(a.template.vertices, axis=0).argmax()
    along = np.zeros(3)
    along[(up + 1) % 3] = 1.0
    way = np.linspace(-1.0, 1.0, len(first))[:, None, None] * along
    across = np.zeros(3)
    across[(up + 2) % 3] = 0.35
    first = first - first.mean(axis=1, keepdims=True) + way + across
    second = second - second.mean(axis=1, keepdims=True) - way - across
    points, truth = shuffled(np.concatenate([first, second], axis=1))
    found = label_people([(a, layout), (b, layout)], unnamed(points))
    columns = np.concatenate([each.columns for each in found], axis=1)
    other = np.concatenate([each.columns for each in found[::-1]], axis=1)
    assert max(share_right(columns, truth), share_right(other, truth)) > 0.98


@pytest.mark.slow
def test_what_is_no_person_is_refused(one):
    subject, layout, places = one
    with pytest.raises(ValueError, match="expected a frame with at least 10 points, the best has 9"):
        label_markers(subject, unnamed(places[:, :9]), layout)
    heap = np.random.default_rng(0).uniform(-3, 3, (2, 41, 3))
    with pytest.raises(ValueError, match="no body with these markers was found"):
        label_markers(subject, unnamed(heap), layout)
    with pytest.raises(ValueError, match="metres taken for millimetres"):
        label_markers(subject, unnamed(places[:4] * 1000), layout)
    with pytest.raises(ValueError, match=r"known: expected \(60, 41\)"):
        label_markers(subject, unnamed(places), layout, np.zeros((3, 41), dtype=int))


def test_tracks_are_cut_rather_than_confused():
    """Two points that meet: either track may go on with either, so both end."""
    t = np.linspace(-1, 1, 41)[:, None]
    a, b = np.c_[t, 0 * t, 0 * t], np.c_[0 * t, t, 0 * t]
    tracks = link_points(np.stack([a, b], axis=1), 100.0)
    assert len(np.unique(tracks)) > 2 and tracks[0, 0] != tracks[-1, 1]
    apart = link_points(np.stack([a, b + 5], axis=1), 100.0)
    assert len(np.unique(apart)) == 2
    assert has_tracks(np.stack([a, b + 5], axis=1), 100.0)


def test_a_marker_that_is_worn_elsewhere_is_found_on_its_part():
    rng = np.random.default_rng(0)
    T = 40
    angle = np.linspace(0, 2, T)
    turns = np.zeros((T, 3, 3, 3))
    turns[..., 0, 0] = turns[..., 1, 1] = np.cos(angle)[:, None]
    turns[..., 0, 1], turns[..., 1, 0] = -np.sin(angle)[:, None], np.sin(angle)[:, None]
    turns[..., 2, 2] = 1
    rest = np.array([[0.1, 0, 0], [0.1, 0.1, 0], [0.1, 0, 0.2]])
    places = np.einsum("tlij,lj->tli", turns, rest)
    off = np.array([0.0, 0.05, 0.1])
    points = places.copy()
    points[:, 2] += np.einsum("tij,j->ti", turns[:, 2], off)
    points = np.concatenate([points, rng.uniform(-0.3, 0.3, (T, 2, 3))], axis=1)
    columns = np.tile([0, 1, -1], (T, 1))
    found = find_displaced(points, columns, places, turns, np.zeros(3, dtype=int))
    assert np.allclose(found[2], off, atol=0.005) and not found[:2].any()
    offsets, deviations = mean_offsets(points, np.tile([0, 1, 2], (T, 1)), places, turns)
    assert np.allclose(offsets[2], off, atol=1e-9) and np.allclose(deviations, 0, atol=1e-9)


@pytest.mark.slow
def test_a_layout_of_few_markers_is_enough(one):
    """The lower body alone: eight markers of each leg and four of the hips."""
    subject, layout, places = one
    legs = [label for label in layout.labels if label[1:] in
            ("FWT", "BWT", "KNE", "ANK", "HEE", "MT5", "TOE", "SHN", "THI")]
    rows = [layout.labels.index(label) for label in legs]
    points, truth = shuffled(places[::6, rows])
    found = label_markers(subject, unnamed(points, RATE / 6), layout.select(legs))
    assert share_right(found.columns, truth) > 0.95
    assert isinstance(found.layout, MarkerLayout)
