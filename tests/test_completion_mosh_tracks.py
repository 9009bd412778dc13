"""Exchanges, slips and noise of tracks of markers, without a body."""

import numpy as np
import pytest
from marker_faults import FRAMES, LABELS, RATE, exchanged

from completion.mocap.artefacts.results import BadSpan, list_swaps
from completion.mocap.artefacts.slips import find_bad, without_lost_limbs
from completion.mocap.pose.swaps import AWAY, TORN, Tracks, find_order, marker_levels
from scanprep.geometry import rotations


def wavy(labels=6, frames=120):
    """Tracks that swing about places 5 cm apart."""
    t = np.arange(frames) / RATE
    sway = 0.3 * np.sin(4 * t[:, None] + 0.1 * np.arange(labels))
    out = np.stack([sway, 0.2 * np.cos(3 * t)[:, None] + 0 * sway, 0.05 * np.arange(labels) + 0 * sway], axis=2)
    return out + np.random.default_rng(0).normal(0, 0.0003, out.shape)


def tracked(positions):
    return find_order(positions, RATE)


# ---- tracks

def test_over_a_gap_a_track_may_have_been_accelerated():
    """Half squared deviations, and three times the logarithm by which they have grown: 2 mm a frame, 10 m/s² unseen."""
    positions = np.zeros((60, 1, 3))
    positions[40:] += [0.0, 0.01, 0.0]
    for gap in (2, 6, 11):
        holed = positions.copy()
        holed[41 - gap:40] = np.nan
        sd = 0.002 * (gap + 1) / 2 + 10 / 2 * ((gap - 1) / RATE)**2
        cost = Tracks(holed, RATE).links(np.array([40]), np.array([0]), np.array([0]))[0]
        assert cost == pytest.approx(min(0.01**2 / (2 * sd**2) + 3 * np.log(sd / 0.002), TORN))


def test_labels_cost_half_squared_deviations_from_their_place_and_no_more_than_away():
    places, sd = np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [np.nan, 0, 0]]), 0.008
    seen = np.array([[0.008, 0, 0], [0, -0.016, 0], [0, 0, 0.5], [np.nan, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(marker_levels(places, seen, np.array(sd)), [0.5, 2, AWAY, 0, AWAY])


# ---- exchanges from tracks alone

def test_pairs_are_put_right_and_their_spans_are_exact():
    positions = wavy()
    faulty = positions.copy()
    exchanged(faulty, 0, 1, 20, 44)
    exchanged(faulty, 2, 5, 0, 9)
    exchanged(faulty, 1, 3, 70, 119)
    order = tracked(faulty)
    np.testing.assert_array_equal(np.take_along_axis(faulty, order[..., None], axis=1), positions)
    spans = [(e.first, e.second, e.begin, e.end) for e in list_swaps(order, np.ones((120, 6), bool), tuple("ABCDEF"))]
    assert spans == [("C", "F", 0, 9), ("A", "B", 20, 44), ("B", "D", 70, 119)]


def test_a_cycle_of_labels_comes_apart_into_pairs():
    positions = wavy()
    faulty = positions.copy()
    faulty[30:60, [0, 2, 3, 5]] = positions[30:60, [2, 3, 5, 0]]
    order = tracked(faulty)
    np.testing.assert_array_equal(np.take_along_axis(faulty, order[..., None], axis=1), positions)
    found = list_swaps(order, np.ones((120, 6), bool), tuple("ABCDEF"))
    assert len(found) == 3 and {(e.begin, e.end) for e in found} == {(30, 59)}


def test_exchanges_do_not_depend_on_the_order_of_labels_or_the_frame_of_space():
    faulty = wavy()
    exchanged(faulty, 0, 1, 20, 44)
    faulty[60:70, 3] = np.nan
    shuffle = np.array([3, 0, 5, 1, 4, 2])
    R = rotations.exp(np.array([0.4, -1.0, 2.0]))
    other = tracked((faulty @ R.T + [1.0, -2.0, 0.5])[:, shuffle])
    np.testing.assert_array_equal(shuffle[other], tracked(faulty)[:, shuffle])


def test_an_exchange_is_found_though_a_label_is_out_of_sight_when_it_begins():
    positions = wavy()
    faulty = positions.copy()
    exchanged(faulty, 1, 4, 50, 89)
    faulty[48:53, 1] = np.nan
    order = tracked(faulty)
    seen = np.isfinite(faulty[..., 0])
    mended = np.take_along_axis(faulty, order[..., None], axis=1)
    right = np.isclose(mended, positions, atol=1e-12).all(axis=2) | np.isnan(mended[..., 0])
    assert right.all()
    assert [(e.begin, e.end) for e in list_swaps(order, seen, tuple("ABCDEF"))] == [(50, 89)]


def test_what_flickers_or_is_gone_is_not_exchanged():
    positions = wavy()
    positions[40, 2] += 0.05                                         # to where the next one is, which stays
    positions[80:90, 3] += 0.3
    positions[20:60, 5] = np.nan
    assert (tracked(positions) == np.arange(6)).all()


# ---- bad spans

def bad(local, jumps=None):
    jumps = np.zeros(local.shape[:2]) if jumps is None else jumps
    return find_bad(local, local, jumps, LABELS[:local.shape[1]], RATE)


def quiet(seed=0):
    return np.random.default_rng(seed).normal(0, 0.001, (FRAMES, 5, 3)) + np.array([0.01, -0.01, 0.0])


def test_a_slip_is_found_at_its_frame_and_a_slow_change_is_none():
    local = quiet()
    local[70:, 2] += [0.015, 0.015, -0.01]
    local[:, 4] += 0.05 * np.linspace(0, 1, FRAMES)[:, None]          # drifts
    assert [(s.label, s.kind, s.begin, s.end) for s in bad(local)] == []          # 2 cm without a jump may be the body
    jumps = np.zeros(local.shape[:2])
    jumps[70, 2] = 0.0235
    (found,) = bad(local, jumps)
    assert (found.label, found.kind, found.begin, found.end) == ("M2", "slipped", 70, FRAMES - 1)
    assert abs(found.distance - np.sqrt(0.00055)) < 0.001


def test_noise_and_strays_are_found_with_their_ends():
    local, jumps = quiet(), np.zeros((FRAMES, 5))
    local[50:90, 1] += np.random.default_rng(3).normal(0, 0.01, (40, 3))
    local[100:110, 3] += [0.0, 0.15, 0.0]
    jumps[[100, 110], 3] = 0.15
    noisy, stray = bad(local, jumps)
    assert (noisy.label, noisy.kind, stray.label, stray.kind) == ("M1", "noisy", "M3", "stray")
    assert abs(noisy.begin - 50) <= 2 and abs(noisy.end - 89) <= 2
    assert (stray.begin, stray.end) == (100, 109) and abs(stray.distance - 0.15) < 0.002


def test_a_limb_that_is_lost_is_no_fault_of_its_markers():
    spans = tuple(BadSpan(label, "stray", 10, 20, 0.1) for label in ("M0", "M1", "M2"))
    alone = BadSpan("M4", "stray", 10, 40, 0.2)
    slip = BadSpan("M0", "slipped", 50, 99, 0.03)
    near = np.zeros((5, 5), bool)
    near[:4, :4] = near[4, 4] = True
    assert without_lost_limbs((*spans, alone, slip), near, LABELS[:5]) == (alone, slip)
    assert without_lost_limbs(spans[:2], near, LABELS[:5]) == spans[:2]
