"""Faults that were put into markers of a body come back, exactly, and nothing else does."""

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior
from marker_faults import FRAMES, LABELS, RATE, exchanged

from completion.mocap.artefacts.find import Simulation, ambiguous_swap, find_artefacts
from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.follow import animate
from completion.mocap.pose.swaps import Tracks


@pytest.fixture(scope="module")
def subject():
    return worm_with_prior().subject(None)


@pytest.fixture(scope="module")
def layout():
    vertices = np.random.default_rng(4).choice(396, 30, replace=False)
    return MarkerLayout(LABELS, vertices, 0.012)


@pytest.fixture(scope="module")
def moved(subject, layout):
    """Poses and places of a motion, its markers, and the part that each sits on."""
    t = np.arange(FRAMES) / RATE
    poses = MEAN + np.sin(2 * np.pi * t[:, None, None] + np.arange(4)[:, None]) * np.array([0.05, 0.3, 0.2])
    trans = np.stack([1.2 * t, 0 * t, 0 * t], axis=1)
    meshes = subject.vertices(poses, trans)
    positions = np.stack([layout.place(subject.template.with_vertices(v)) for v in meshes])
    positions += np.random.default_rng(0).normal(0, 0.0003, positions.shape)
    part = subject.skeleton.part_of_vertex(subject.template)[layout.vertices]
    return poses, trans, positions, subject.skeleton.part_rotations(poses)[:, part]


def changed(positions):
    return MarkerSequence(positions, LABELS, RATE)


def neighbours(positions):
    """The two markers that are closest to each other, and a far one."""
    apart = np.linalg.norm(positions[0, :, None] - positions[0], axis=2) + 9 * np.eye(30)
    a, b = (int(i) for i in np.unravel_index(apart.argmin(), apart.shape))
    apart[apart > 5] = 0
    return a, b, int(apart[a].argmax())


def test_a_clean_sequence_has_no_faults(subject, layout, moved):
    _, _, positions, _ = moved
    ticks = []
    found = find_artefacts(subject, changed(positions), layout, progress=lambda *at: ticks.append(at))
    assert found.swaps == () and found.bad == () and len(ticks) == 1
    np.testing.assert_array_equal(found.repaired.positions, positions)
    assert np.linalg.norm(found.simulated - positions, axis=2).max() < 0.008 and found.weights.min() > 0.9


def test_faults_of_all_kinds_together(subject, layout, moved):
    _, _, positions, turned = moved
    a, b, far = neighbours(positions)
    rest = [i for i in range(30) if i not in (a, b, far)]
    slipped, noisy, stray, gone = rest[:4]
    faulty = positions.copy()
    exchanged(faulty, a, b, 20, 79)
    exchanged(faulty, a, far, 100, 140)
    faulty[60:, slipped] += turned[60:, slipped] @ np.array([0.0, 0.03, 0.02])
    faulty[40:100, noisy] += np.random.default_rng(2).normal(0, 0.01, (60, 3))
    faulty[90:120, stray] += [0.2, -0.1, 0.1]
    faulty[30:60, gone] = np.nan
    found = find_artefacts(subject, changed(faulty), layout)
    assert {(frozenset((e.first, e.second)), e.begin, e.end) for e in found.swaps} == {
        (frozenset((LABELS[a], LABELS[b])), 20, 79), (frozenset((LABELS[a], LABELS[far])), 100, 140)}
    spans = {s.label: s for s in found.bad}
    assert {label: s.kind for label, s in spans.items()} == {
        LABELS[slipped]: "slipped", LABELS[noisy]: "noisy", LABELS[stray]: "stray"}
    assert (spans[LABELS[slipped]].begin, spans[LABELS[slipped]].end) == (60, FRAMES - 1)
    assert (spans[LABELS[stray]].begin, spans[LABELS[stray]].end) == (90, 119)
    assert abs(spans[LABELS[noisy]].begin - 40) <= 2 and abs(spans[LABELS[noisy]].end - 99) <= 2
    assert abs(spans[LABELS[slipped]].distance - np.sqrt(0.0013)) < 0.008
    np.testing.assert_array_equal(found.repaired.positions[:, [a, b, far]], positions[:, [a, b, far]])
    assert not found.repaired.seen[60:, slipped].any() and not found.repaired.seen[90:120, stray].any()
    filled = found.virtual()
    assert filled.seen.all() and np.linalg.norm(filled.positions - positions, axis=2).max() < 0.012
    assert found.weights[60:, slipped].max() == 0 and found.weights[:60, slipped].min() > 0.5


def test_the_motion_of_repaired_markers_is_the_clean_one(subject, layout, moved):
    poses, trans, positions, _ = moved
    rng = np.random.default_rng(5)
    faulty, pairs = positions.copy(), rng.permutation(30)[:12].reshape(-1, 2)
    for a, b in pairs:
        begin = int(rng.integers(0, 100))
        exchanged(faulty, a, b, begin, begin + int(rng.integers(20, 50)))
    meshes = subject.vertices(poses, trans)
    found = find_artefacts(subject, changed(faulty), layout)
    assert len(found.swaps) == 6

    def error(sequence):
        motion = animate(subject, sequence, layout)
        return np.linalg.norm(motion.vertices(subject) - meshes, axis=2).mean()

    assert error(found.repaired) < 1.05 * error(changed(positions))
    given = find_artefacts(subject, changed(positions), layout, animate(subject, changed(positions), layout))
    assert given.swaps == () and given.bad == ()


def test_what_a_person_before_has_told_is_begun_with(subject, layout, moved):
    _, _, positions, turns = moved
    faulty = positions.copy()
    exchanged(faulty, *neighbours(positions)[:2], 40, 99)
    faulty[60:, 20] += turns[60:, 20] @ [0.03, 0, 0]
    first = find_artefacts(subject, changed(faulty), layout)
    motion = animate(subject, first.repaired, layout)
    again = find_artefacts(subject, changed(faulty), layout, motion, known=first)
    assert [vars(e) for e in again.swaps] == [vars(e) for e in first.swaps]
    assert [(b.label, b.kind, b.begin) for b in again.bad] == [(b.label, b.kind, b.begin) for b in first.bad]
    np.testing.assert_array_equal(again.repaired.positions, first.repaired.positions)
    near = animate(subject, first.repaired, layout, near=motion)
    assert np.linalg.norm(near.vertices(subject) - motion.vertices(subject), axis=2).max() < 1e-3


def test_an_exchange_with_a_label_that_no_layout_knows(subject, layout, moved):
    _, _, positions, _ = moved
    few = layout.select(LABELS[:25])
    faulty = positions.copy()
    exchanged(faulty, 3, 28, 50, 99)
    found = find_artefacts(subject, changed(faulty), few)
    assert [(e.first, e.second, e.begin, e.end) for e in found.swaps] == [("M3", "M28", 50, 99)]
    np.testing.assert_array_equal(found.repaired.positions, positions)
    assert found.labels == LABELS[:25] and found.bad == ()


def test_close_labels_are_tried_both_ways(subject, layout, moved):
    """Between two gaps the tracks say nothing, and the body may have followed either."""
    _, _, positions, _ = moved
    a, b, _ = neighbours(positions)
    faulty = positions.copy()
    exchanged(faulty, a, b, 40, 109)
    for end in (40, 110):
        faulty[end - 15:end + 15, [a, b]] = np.nan
    body = Simulation(subject, changed(faulty), layout)
    x = body.follow(faulty)
    swapped = ambiguous_swap(body, x, Tracks(faulty, RATE), a, b)
    there = np.isfinite(faulty[:, a, 0])
    np.testing.assert_array_equal(swapped[there[swapped]], np.arange(55, 95))


def test_a_motion_of_other_length_is_refused(subject, layout, moved):
    _, _, positions, _ = moved
    motion = animate(subject, changed(positions).frames(slice(0, 20)), layout)
    with pytest.raises(ValueError, match="motion: expected 160 frames as the markers have, got 20"):
        find_artefacts(subject, changed(positions), layout, motion)
