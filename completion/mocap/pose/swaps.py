"""Which labels were swapped when: pairs decided over the whole sequence, or frame by frame in a stream.

A track tells from one frame to the next which label goes on where another was; no body is needed for that. Where the
body has the markers tells which label belongs to a stretch of track.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from .marked_body import AnimateConfig, distances_apart, median_of_known

TORN = 10.0                          # most that a torn track counts, in half squared standard deviations
AWAY = 8.0                           # most that a marker away from its place counts, in half squared deviations
CHANGE = 4.0                         # what each change of a label must be worth, likewise
WORTH = 2.0                          # least gain for which labels are swapped
DEVIATION = 0.008                    # metres from its usual place on the body that a marker lies, in each direction
MEMORY = 0.1                         # seconds that this distance stays much the same
ENTER, LEAVE = 0.5, 1.0              # share of the distance left when labels of a stream are swapped, and put back
AT_ONCE = 64                         # frames whose levels of all pairs are held


class Tracks:
    """Tracks (T, L, 3) of labels, metres, NaN where one was not seen.

    From one frame to the next a track moves at the mean of its velocities before and after, which misses no more
    than a change of acceleration: it is `off` (T, L) metres, usually `sd`, NaN where it is not seen in both. It
    `jumped` (T, L), or is `open`: not known to go on. A label that takes over another's track goes on from its place.
    """

    def __init__(self, positions: np.ndarray, rate: float) -> None:
        least_jump, jump_sds = 0.006, 5.0                               # metres, and standard deviations
        self.positions, self.rate = positions, rate
        steps = np.diff(positions, axis=0)
        missing = np.full((1, *positions.shape[1:]), np.nan)
        self._after = np.concatenate([_median_of_next(steps), missing])
        self._before = np.concatenate([missing, _median_of_next(steps[::-1])[::-1]])
        seen = np.isfinite(positions[..., 0])
        self._last = np.maximum.accumulate(np.where(seen, np.arange(len(positions))[:, None], -1), axis=0)
        self.off = np.full(positions.shape[:2], np.nan)
        self.off[1:] = np.linalg.norm(steps - _mean_of_known(self._before[:-1], self._after[1:]), axis=-1)
        self.sd = self._usual()
        self.open = np.isnan(self.off)
        self.jumped = np.nan_to_num(self.off) > np.maximum(least_jump, jump_sds * self.sd)

    def change(self, columns: np.ndarray, positions: np.ndarray) -> None:
        """Have other positions (T, n, 3) in some columns (n,)."""
        other = Tracks(positions, self.rate)
        self.positions = self.positions.copy()
        for name in ("positions", "_after", "_before", "_last", "off", "sd", "open", "jumped"):
            getattr(self, name)[:, columns] = getattr(other, name)

    def _usual(self) -> np.ndarray:
        """The usual size (T, L) of what is off: within 12 frames of that time, and no less than over all of it."""
        floor, sds_to_median = 0.002, 1.5                               # metres; of a distance, nearly
        near = median_filter(np.nan_to_num(self.off), size=(25, 1), mode="nearest")
        whole = [np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else 0.0 for x in self.off.T]
        return np.maximum(floor, sds_to_median * np.maximum(near, whole))

    def links(self, times: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """What it counts that labels `after` go on, in frames `times`, where labels `before` were until then.

        Half squared standard deviations, at most `TORN`, as for a label that appears; nothing where no label `after` is
        seen. Over a gap a track may have taken another way. The three are arrays of one shape, after broadcasting.
        """
        acceleration, longest = 10.0, 0.25          # m/s² out of sight; seconds of a gap beyond which nothing is told
        last = self._last[times - 1, before]
        gap = times - last
        way = gap[..., None] * _mean_of_known(self._before[last, before], self._after[times, after])
        off = np.linalg.norm(self.positions[times, after] - self.positions[last, before] - way, axis=-1)
        usual = np.maximum(self.sd[last, before], self.sd[times, after])
        sd = 0.5 * (gap + 1) * usual + 0.5 * acceleration * ((gap - 1) / self.rate)**2
        cost = np.nan_to_num(off**2 / (2 * sd**2), nan=TORN) + 3 * np.log(sd / usual)
        cost = np.where((last < 0) | (gap > longest * self.rate + 1), TORN, np.minimum(cost, TORN))
        return np.where(np.isnan(self.positions[times, after, 0]), 0.0, cost)

    def loose_ends(self, a: int, b: int) -> np.ndarray:
        """Frames (n,), the first among them, from which on a pair may be swapped: neither track goes on there."""
        free = self.jumped[:, [a, b]] | self.open[:, [a, b]]
        loose = free.all(axis=1)
        loose &= ~(self.open[:, a] & self.open[:, b] & np.append(loose[1:], False))        # of a gap its end alone
        loose[0] = True
        return np.flatnonzero(loose)


def _median_of_next(steps: np.ndarray) -> np.ndarray:
    """The median (T - 1, L, 3) of this and the next two steps, or one of those that are known; NaN without any."""
    padded = np.concatenate([steps, np.full((2, *steps.shape[1:]), np.nan)])
    a, b, c = (padded[i:len(steps) + i] for i in range(3))
    return np.fmax(np.fmin(a, b), np.fmin(np.fmax(a, b), c))


def _mean_of_known(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The mean of two velocities, or the one that is known, or zero."""
    known = np.isfinite(a[..., :1]).astype(int) + np.isfinite(b[..., :1])
    return (np.nan_to_num(a) + np.nan_to_num(b)) / np.maximum(known, 1)


def apply_order(positions: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Markers (T, L, 3) under the labels that an order (T, L) gives them."""
    return np.take_along_axis(positions, order[..., None], axis=1)


@dataclass(frozen=True, eq=False)
class Seats:
    """Where the body has the markers: places (T, L, 3), metres, NaN where unknown, then nowhere near.

    A marker lies off them by a standard `deviation` (T,), metres, in each direction; a level counts `share` times.
    """

    places: np.ndarray
    deviation: np.ndarray
    share: float

    def levels(self, frames: slice, rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """What it counts (n, R, C) that labels at positions (n, C, 3) are the markers of rows: see `marker_levels`."""
        return self.share * marker_levels(self.places[frames, rows, None], positions[:, None],
                                          self.deviation[frames, None, None])

    def own(self, positions: np.ndarray, rows: slice | list[int] = slice(None)) -> np.ndarray:
        """What it counts (T, R) that labels at positions (T, R, 3) are the markers of some rows, one each."""
        return self.share * marker_levels(self.places[:, rows], positions, self.deviation[:, None])


def marker_levels(places: np.ndarray, positions: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """What it counts (...) that a label is a marker: half squared deviations, at most `AWAY`; places (..., 3)."""
    squared = sum((places[..., d] - positions[..., d])**2 for d in range(3))
    cost = np.minimum(np.nan_to_num(squared / (2 * deviation**2), nan=AWAY), AWAY)
    return np.asarray(cost * np.isfinite(positions[..., 0]))


def find_order(positions: np.ndarray, rate: float, places: np.ndarray | None = None,
               deviation: float | np.ndarray = DEVIATION) -> np.ndarray:
    """Which column (T, L) each marker is to be taken from, by its track and by places (T, L, 3) on a body, if any.

    A marker lies off its place by a standard `deviation`, metres, one for all or for each frame. The frames of
    `MEMORY` count as one. The best pair and span is swapped, then the best of what is left, until nothing gains: of a
    longer cycle each swap puts one marker right.
    """
    T, L = positions.shape[:2]
    order, tracks = np.tile(np.arange(L), (T, 1)), Tracks(positions, rate)
    seats = None if places is None else Seats(places, np.broadcast_to(deviation, T), min(1.0, 1 / (MEMORY * rate)))
    touched = set(range(L))
    for _ in range(12):                                                 # longer cycles come apart into pairs
        found = _best_spans(tracks, seats, touched)
        touched = set()
        for _, a, b, swapped in sorted(found, key=lambda f: -f[0]):
            if not touched & {a, b}:
                two = np.array([a, b])
                order[np.ix_(swapped, two)] = order[np.ix_(swapped, two[::-1])]
                touched |= {a, b}
        if not touched:
            break
        columns = np.array(sorted(touched))
        tracks.change(columns, apply_order(positions, order[:, columns]))
    return order


def _best_spans(tracks: Tracks, seats: Seats | None, touched: set[int]) -> list[tuple[float, int, int, np.ndarray]]:
    """Gain, pair and frames (n,) of all pairs with a label of `touched` that gain by being swapped."""
    pairs, at = pairs_that_jump(tracks, touched), tracks.positions
    own = np.zeros(at.shape[:2]) if seats is None else seats.own(at)
    if seats is not None:
        pairs |= _pairs_that_fit(seats, at, own, np.array(sorted(touched)))
    out = []
    for a, b in sorted(pairs):
        begins = tracks.loose_ends(a, b)
        gain = own[:, a] + own[:, b] - (0.0 if seats is None else seats.own(at[:, [b, a]], [a, b]).sum(axis=1))
        total, swapped = best_stretches(tracks, a, b, begins, np.add.reduceat(gain, begins))
        if total > WORTH:
            out.append((total, a, b, swapped))
    return out


def best_stretches(tracks: Tracks, a: int, b: int, begins: np.ndarray, gains: np.ndarray) -> tuple[float, np.ndarray]:
    """What it gains to swap a pair in some of the stretches that begin at frames (m,), and in which frames (n,)."""
    lengths = np.diff(np.r_[begins, len(tracks.positions)])
    minority = 2.0                                  # changes that swapping the labels of the whole sequence counts
    gains = gains - minority * CHANGE * lengths / lengths.sum()
    stay, switch = (tracks.links(begins[1:], np.array([[a], [b]]), np.array(after)).sum(axis=0)
                    for after in ([[a], [b]], [[b], [a]]))
    total, swapped = _two_states(gains, stay, switch)
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


def _pairs_that_fit(seats: Seats, positions: np.ndarray, own: np.ndarray, rows: np.ndarray) -> set[tuple[int, int]]:
    """Pairs with a label of some rows that over some stretch lie where the body has the other one."""
    T, L = own.shape
    total, least, best = (np.zeros((1, len(rows), L)) for _ in range(3))   # up to here; the least so far; most since
    for start in range(0, T, AT_ONCE):
        some = slice(start, start + AT_ONCE)
        there = seats.levels(some, rows, positions[some])
        back = there if len(rows) == L else seats.levels(some, np.arange(L), positions[some][:, rows])
        gain = own[some][:, rows, None] + own[some][:, None] - there - np.swapaxes(back, 1, 2)
        run = np.cumsum(np.concatenate([total, gain]), axis=0)
        low = np.minimum.accumulate(np.concatenate([least, run[1:]]), axis=0)
        best = np.maximum(best, (run - low).max(axis=0))
        total, least = run[-1:], low[-1:]
    fit = best[0] > CHANGE + WORTH
    fit[np.arange(len(rows)), rows] = False
    return {(min(a, b), max(a, b)) for a, b in ((int(rows[i]), int(b)) for i, b in np.argwhere(fit))}


def _two_states(gains: np.ndarray, stay: np.ndarray, switch: np.ndarray) -> tuple[float, np.ndarray]:
    """The best way through stretches (n + 1) of a pair as labelled or swapped: what it gains, and where (n + 1).

    `gains` (n + 1,) are of being swapped in a stretch; `stay`, `switch` (n,) what remaining and changing cost.
    """
    value, came = np.array([0.0, gains[0]]), np.zeros((len(stay), 2), dtype=int)
    for i, (remain, change) in enumerate(zip(stay, switch, strict=True)):
        onward = np.stack([value - remain, value[::-1] - change - CHANGE])
        came[i] = onward.argmax(axis=0)
        value = onward.max(axis=0) + [0.0, gains[i + 1]]
    state = int(value.argmax())
    gained = float(value[state] + stay.sum())
    states = [state]
    for from_other in came[::-1]:
        state = 1 - state if from_other[state] else state
        states.append(state)
    return gained, np.array(states[::-1], dtype=bool)


def label_order(positions: np.ndarray, targets: np.ndarray, rate: float, outlier: float) -> np.ndarray:
    """Which column (T, L) each marker is taken from, the body having them at places (T, L, 3), by `find_order`."""
    squared, scale = distances_apart(positions, targets, outlier)
    if ((squared > (0.5 * scale)**2).sum(axis=1) < 2).all():            # nothing is far off, or everything is believed
        return np.tile(np.arange(targets.shape[1]), (len(targets), 1))
    shift = median_of_known(positions - targets, -2)[..., None, :]
    # on a body that fits badly a marker is as much farther from its place as one must be to be an outlier
    deviation = DEVIATION * scale[..., 0] / AnimateConfig.outlier
    return find_order(targets, rate, positions - shift, deviation)


class LabelWatch:
    """Pairs of markers, of so many, that have swapped their labels, told frame by frame for streams.

    A pair is swapped when that removes most of the distance of both from where the body would put them, and put back
    when the labels as they came fit better again. No scores of `find_order`: a body that has leapt is far from all.
    """

    def __init__(self, count: int, outlier: float) -> None:
        self.outlier = outlier
        self.order = np.arange(count)

    def update(self, positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Which column (L,) each marker is taken from, for places on the body and markers as they came (L, 3)."""
        taken = targets[self.order]
        squared, scale = distances_apart(positions, taken, self.outlier)
        suspect = squared > (0.5 * scale)**2                            # never of NaN
        changed = self.order != np.arange(len(self.order))
        if suspect.sum() < 2 and not changed.any():
            return self.order
        shift = median_of_known(positions - taken, 0)
        some = np.flatnonzero((suspect | changed) & ~np.isnan(squared))
        apart = np.linalg.norm(positions[some, None] - shift - taken[some], axis=2)
        for i, j in zip(*np.triu_indices(len(some), 1), strict=True):
            now, then = apart[i, i] + apart[j, j], apart[i, j] + apart[j, i]
            a, b = some[i], some[j]
            back = self.order[a] == b
            if then < (LEAVE if back else ENTER) * now and (back or max(apart[i, j], apart[j, i]) < 0.5 * scale[0]):
                self.order[[a, b]] = self.order[[b, a]]
                taken[[a, b]] = taken[[b, a]]
                apart[:, [i, j]] = apart[:, [j, i]]
        return self.order
