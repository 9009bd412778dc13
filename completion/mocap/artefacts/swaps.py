"""Which labels have been exchanged when: pairs decided over the whole sequence, from tracks and from the body."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..results import Exchange
from ..settings import FaultConfig
from .tracks import Tracks

AWAY = 8.0                           # most that a marker away from its place counts, in half squared deviations
MINORITY = 2.0                       # times the doubt of a change that a whole sequence of exchanged labels counts
WORTH = 2.0                          # least gain for which labels are exchanged
PASSES = 12                          # in which longer cycles come apart into pairs


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the markers of a sequence tell about their labels.

    Attributes
    ----------
    positions : (T, L, 3) float, metres
        As they came.
    levels : (T, L, L) float
        What it counts that the label of a column is the marker of a row, in one frame, zero where nothing is known.
    rate : float, frames per second
    """

    positions: np.ndarray
    levels: np.ndarray
    rate: float


def marker_levels(places: np.ndarray, positions: np.ndarray, config: FaultConfig, rate: float) -> np.ndarray:
    """The levels (T, L, L) of `Evidence` from where the body has the markers.

    What a marker is off changes slowly, so that the frames of `config.memory` count as one.

    Parameters
    ----------
    places, positions : (T, L, 3) float, metres
        NaN for markers that the body does not know, which are taken to be nowhere near, or that were not seen.
    """
    squared = sum((places[:, :, None, d] - positions[:, None, :, d])**2 for d in range(3))
    assert isinstance(squared, np.ndarray)
    share = min(1.0, 1 / (config.memory * rate))
    cost = share * np.minimum(np.nan_to_num(squared / (2 * config.deviation**2), nan=AWAY), AWAY)
    return cost * np.isfinite(positions[:, None, :, 0])


def find_order(evidence: Evidence, config: FaultConfig) -> np.ndarray:
    """Which column (T, L) each marker is to be taken from.

    The best pair and span is exchanged, then the best of what is left, until nothing gains: of a longer cycle
    each exchange puts one marker right.
    """
    T, L = evidence.positions.shape[:2]
    order = np.tile(np.arange(L), (T, 1))
    tracks = Tracks(evidence.positions, evidence.rate, config.floor, config.jump)
    levels, touched = evidence.levels.copy(), set(range(L))
    for _ in range(PASSES):
        found = _best_spans(tracks, levels, touched, config)
        touched = set()
        for _, a, b, swapped in sorted(found, key=lambda f: -f[0]):
            if not touched & {a, b}:
                two, every = np.array([a, b]), np.arange(L)
                order[np.ix_(swapped, two)] = order[np.ix_(swapped, two[::-1])]
                levels[np.ix_(swapped, every, two)] = levels[np.ix_(swapped, every, two[::-1])]
                touched |= {a, b}
        if not touched:
            break
        columns = np.array(sorted(touched))
        tracks.changed(columns, np.take_along_axis(evidence.positions, order[:, columns, None], axis=1))
    return order


def _best_spans(tracks: Tracks, levels: np.ndarray, touched: set[int], config: FaultConfig
                ) -> list[tuple[float, int, int, np.ndarray]]:
    """Gain, pair and frames (n,) of all pairs with a label of `touched` that gain by being exchanged."""
    own = np.einsum("tll->tl", levels)
    out = []
    for a, b in sorted(pairs_that_jump(tracks, touched) | _pairs_that_fit(own, levels, touched, config)):
        begins = loose_ends(tracks, a, b)
        gain = own[:, a] + own[:, b] - levels[:, a, b] - levels[:, b, a]
        total, swapped = best_stretches(tracks, a, b, begins, np.add.reduceat(gain, begins), config)
        if total > WORTH:
            out.append((total, a, b, swapped))
    return out


def loose_ends(tracks: Tracks, a: int, b: int) -> np.ndarray:
    """Frames (n,), the first among them, from which on a pair may be exchanged: neither track goes on there."""
    free = tracks.jumped[:, [a, b]] | tracks.open[:, [a, b]]
    loose = free.all(axis=1)
    loose &= ~(tracks.open[:, a] & tracks.open[:, b] & np.append(loose[1:], False))        # of a gap its end alone
    loose[0] = True
    return np.flatnonzero(loose)


def best_stretches(tracks: Tracks, a: int, b: int, begins: np.ndarray, gains: np.ndarray, config: FaultConfig
                   ) -> tuple[float, np.ndarray]:
    """What it gains to exchange a pair, and in which frames (n,).

    Parameters
    ----------
    begins : (m,) int
        Of stretches in which the pair is exchanged or not.
    gains : (m,) float
        Of each when it is exchanged, as the places of the markers tell.
    """
    lengths = np.diff(np.r_[begins, len(tracks.positions)])
    gains = gains - MINORITY * config.doubt * lengths / lengths.sum()
    stay, switch = (tracks.links(begins[1:], np.array([[a], [b]]), np.array(after)).sum(axis=0)
                    for after in ([[a], [b]], [[b], [a]]))
    total, swapped = _two_states(gains, stay, switch, config.doubt)
    return total, np.flatnonzero(np.repeat(swapped, lengths))


def pairs_that_jump(tracks: Tracks, touched: set[int]) -> set[tuple[int, int]]:
    """Pairs with a label of `touched` that once go on where the other was, better than where they were themselves."""
    pairs: set[tuple[int, int]] = set()
    free = tracks.jumped | tracks.open
    for t in np.flatnonzero(tracks.jumped[:, sorted(touched)].any(axis=1)):
        some = np.flatnonzero(free[t])
        cost = tracks.links(np.full((1, 1), t), some[:, None], some[None])
        stay = np.diag(cost)
        better = cost + cost.T < stay[:, None] + stay - 1
        better &= tracks.jumped[t, some][:, None] | tracks.jumped[t, some]
        pairs |= {(int(some[i]), int(some[j])) for i, j in np.argwhere(np.triu(better, 1))}
    return {pair for pair in pairs if touched & set(pair)}


def _pairs_that_fit(own: np.ndarray, levels: np.ndarray, touched: set[int], config: FaultConfig
                    ) -> set[tuple[int, int]]:
    """Pairs of labels that over some stretch lie where the body has the other one."""
    pairs: set[tuple[int, int]] = set()
    if not levels.any():
        return pairs
    for a in touched:
        total = np.zeros((len(own) + 1, own.shape[1]))
        np.cumsum(own[:, [a]] + own - levels[:, a] - levels[:, :, a], axis=0, out=total[1:])
        best = (total - np.minimum.accumulate(total, axis=0)).max(axis=0)
        pairs |= {(min(a, int(b)), max(a, int(b))) for b in np.flatnonzero(best > config.doubt + WORTH) if b != a}
    return pairs


def _two_states(gains: np.ndarray, stay: np.ndarray, switch: np.ndarray, doubt: float) -> tuple[float, np.ndarray]:
    """The best way through stretches (n + 1) of a pair as labelled or exchanged: what it gains, and where (n + 1).

    Parameters
    ----------
    gains : (n + 1,) float
        Of being exchanged in a stretch.
    stay, switch : (n,) float
        Costs of remaining as it is, or of changing, between two stretches.
    doubt : float
        Further cost of each change.
    """
    value, came = np.array([0.0, gains[0]]), np.zeros((len(stay), 2), dtype=int)
    for i, (remain, change) in enumerate(zip(stay, switch, strict=True)):
        onward = np.stack([value - remain, value[::-1] - change - doubt])
        came[i] = onward.argmax(axis=0)
        value = onward.max(axis=0) + [0.0, gains[i + 1]]
    state = int(value.argmax())
    gained = float(value[state] + stay.sum())
    states = [state]
    for from_other in came[::-1]:
        state = 1 - state if from_other[state] else state
        states.append(state)
    return gained, np.array(states[::-1], dtype=bool)


def listed(order: np.ndarray, seen: np.ndarray, labels: tuple[str, ...]) -> tuple[Exchange, ...]:
    """The exchanges that an order (T, L) is made of; a longer cycle is a chain of pairs.

    Parameters
    ----------
    seen : (T, L) bool
        As the labels came; an exchange begins and ends where one of the two is seen.
    """
    frames: dict[tuple[int, int], list[int]] = {}
    for t in np.flatnonzero((order != np.arange(order.shape[1])).any(axis=1)):
        left = order[t].copy()
        for a in range(len(left)):
            while left[a] != a:                                        # puts one label right at a time
                b = int(left[a])
                left[a], left[b] = left[b], b
                frames.setdefault((min(a, b), max(a, b)), []).append(int(t))
    out = []
    for (a, b), times in frames.items():
        for run in np.split(np.array(times), np.flatnonzero(np.diff(times) > 1) + 1):
            there = run[seen[run, a] | seen[run, b]]
            if len(there):
                out.append(Exchange(labels[a], labels[b], int(there[0]), int(there[-1])))
    return tuple(sorted(out, key=lambda e: (e.begin, e.first, e.second)))
