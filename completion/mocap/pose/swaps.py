"""Swapped markers: which labels were swapped when, decided over the whole sequence, or frame by frame in a stream.

Two sources of evidence. Tracks tell from frame to frame which label continues where another was; no body is needed.
The simulated markers of a body tell which label belongs to a stretch of track.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import median_filter

from .marked_body import AnimateConfig, distances_apart, median_of_known

# Costs are half squared standard deviations, that is negative log-likelihoods.
TORN = 10.0                          # largest cost of a jump in a track
AWAY = 8.0                           # largest cost of a marker far from its place on the body
CHANGE = 4.0                         # cost of each change of a label
WORTH = 2.0                          # least gain for which labels are swapped
DEVIATION = 0.008                    # metres: standard deviation of a marker from its place, in each direction
MEMORY = 0.1                         # seconds over which that deviation hardly changes, so its frames count as one
# Hysteresis in a stream: labels are swapped when at most ENTER of the distance is left, and swapped back below LEAVE.
ENTER, LEAVE = 0.5, 1.0
AT_ONCE = 64                         # frames whose costs of all pairs are in memory


class Tracks:
    """Tracks (T, L, 3) of labels, metres, NaN where one was not seen.

    From frame to frame a track is predicted by the mean of its velocities before and after, which is exact for constant
    acceleration. The miss is `off` (T, L), metres, NaN where the label is not seen in both frames; its usual size is
    `sd`. A track has `jumped` (T, L) where it misses by far more, and is `open` where it is not known to go on.
    """

    def __init__(self, positions: np.ndarray, rate: float) -> None:
        least_jump, jump_sds = 0.006, 5.0                               # a jump: at least 6 mm and 5 usual misses
        self.positions, self.rate = positions, rate
        # velocities before and after each frame, and the last frame in which each label was seen
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
        """Replace the positions (T, n, 3) of some columns (n,)."""
        other = Tracks(positions, self.rate)
        self.positions = self.positions.copy()
        for name in ("positions", "_after", "_before", "_last", "off", "sd", "open", "jumped"):
            getattr(self, name)[:, columns] = getattr(other, name)

    def _usual(self) -> np.ndarray:
        """Compute the usual miss (T, L): the median within 12 frames, and no less than over the whole sequence."""
        floor, sds_to_median = 0.002, 1.5                               # metres; median of a distance to its sd, nearly
        near = median_filter(np.nan_to_num(self.off), size=(25, 1), mode="nearest")
        whole = [np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else 0.0 for x in self.off.T]
        return np.maximum(floor, sds_to_median * np.maximum(near, whole))

    def links(self, times: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """Compute the cost that labels `after` continue, in frames `times`, the tracks of labels `before`.

        The cost is at most `TORN`, which a label that appears has too, and 0 where the label `after` is not seen. In a
        gap the track may have accelerated. The three arguments are arrays that broadcast to one shape.
        """
        acceleration, longest = 10.0, 0.25          # m/s² within a gap; seconds, longer gaps tell nothing
        last = self._last[times - 1, before]
        gap = times - last
        # the miss at the end of the gap, and its standard deviation, which grows with the gap
        way = gap[..., None] * _mean_of_known(self._before[last, before], self._after[times, after])
        off = np.linalg.norm(self.positions[times, after] - self.positions[last, before] - way, axis=-1)
        usual = np.maximum(self.sd[last, before], self.sd[times, after])
        sd = 0.5 * (gap + 1) * usual + 0.5 * acceleration * ((gap - 1) / self.rate)**2
        cost = np.nan_to_num(off**2 / (2 * sd**2), nan=TORN) + 3 * np.log(sd / usual)
        cost = np.where((last < 0) | (gap > longest * self.rate + 1), TORN, np.minimum(cost, TORN))
        return np.where(np.isnan(self.positions[times, after, 0]), 0.0, cost)

    def loose_ends(self, a: int, b: int) -> np.ndarray:
        """Return frames (n,), the first included, at which a pair may be swapped: neither track continues there."""
        free = self.jumped[:, [a, b]] | self.open[:, [a, b]]
        loose = free.all(axis=1)
        loose &= ~(self.open[:, a] & self.open[:, b] & np.append(loose[1:], False))        # of a gap only its end
        loose[0] = True
        return np.flatnonzero(loose)


def _median_of_next(steps: np.ndarray) -> np.ndarray:
    """Compute the median (T - 1, L, 3) of three successive steps, or of the known ones; NaN without any."""
    padded = np.concatenate([steps, np.full((2, *steps.shape[1:]), np.nan)])
    a, b, c = (padded[i:len(steps) + i] for i in range(3))
    return np.fmax(np.fmin(a, b), np.fmin(np.fmax(a, b), c))


def _mean_of_known(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Compute the mean of two velocities, or the known one, or zero."""
    known = np.isfinite(a[..., :1]).astype(int) + np.isfinite(b[..., :1])
    return (np.nan_to_num(a) + np.nan_to_num(b)) / np.maximum(known, 1)


def apply_order(positions: np.ndarray, order: np.ndarray) -> np.ndarray:
    """Return markers (T, L, 3) under the labels that an order (T, L) gives them."""
    return np.take_along_axis(positions, order[..., None], axis=1)


@dataclass(frozen=True, eq=False)
class Seats:
    """Places (T, L, 3) of the markers on the body, metres, NaN where unknown, which counts as far away.

    A marker is off by a standard `deviation` (T,), metres, in each direction; costs are multiplied by `share`.
    """

    places: np.ndarray
    deviation: np.ndarray
    share: float

    def levels(self, frames: slice, rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Compute costs (n, R, C) that labels at positions (n, C, 3) are the markers of rows: see `marker_levels`."""
        return self.share * marker_levels(self.places[frames, rows, None], positions[:, None],
                                          self.deviation[frames, None, None])

    def own(self, positions: np.ndarray, rows: slice | list[int] = slice(None)) -> np.ndarray:
        """Compute costs (T, R) that labels at positions (T, R, 3) are the markers of some rows, one each."""
        return self.share * marker_levels(self.places[:, rows], positions, self.deviation[:, None])


def marker_levels(places: np.ndarray, positions: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """Compute the cost (...) that a label is a marker with places (..., 3): at most `AWAY`, 0 where not seen."""
    squared = sum((places[..., d] - positions[..., d])**2 for d in range(3))
    cost = np.minimum(np.nan_to_num(squared / (2 * deviation**2), nan=AWAY), AWAY)
    return np.asarray(cost * np.isfinite(positions[..., 0]))


def find_order(positions: np.ndarray, rate: float, places: np.ndarray | None = None,
               deviation: float | np.ndarray = DEVIATION) -> np.ndarray:
    """Find the column (T, L) of each marker, by its track and by places (T, L, 3) on a body, if any.

    A marker is off its place by a standard `deviation`, metres, one for all or for each frame. The frames of `MEMORY`
    count as one. The best pair and span is swapped, then the best of the rest, until nothing gains. In a longer cycle
    each swap corrects one marker.
    """
    T, L = positions.shape[:2]
    order, tracks = np.tile(np.arange(L), (T, 1)), Tracks(positions, rate)
    seats = None if places is None else Seats(places, np.broadcast_to(deviation, T), min(1.0, 1 / (MEMORY * rate)))
    touched = set(range(L))
    for _ in range(12):                                                 # rounds: longer cycles need several swaps
        candidates = _best_spans(tracks, seats, touched)
        touched = set()
        # swap the best pairs that share no label, then update their tracks
        for _, a, b, swapped in sorted(candidates, key=lambda f: -f[0]):
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
    """Return gain, pair and frames (n,) of all pairs with a label of `touched` that gain by a swap."""
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
    """Find the stretches, beginning at frames (m,), in which to swap a pair; return the gain and frames (n,)."""
    lengths = np.diff(np.r_[begins, len(tracks.positions)])
    minority = 2.0                                  # a swap of the whole sequence costs as much as 2 changes
    gains = gains - minority * CHANGE * lengths / lengths.sum()
    stay, switch = (tracks.links(begins[1:], np.array([[a], [b]]), np.array(after)).sum(axis=0)
                    for after in ([[a], [b]], [[b], [a]]))
    total, swapped = _two_states(gains, stay, switch)
    return total, np.flatnonzero(np.repeat(swapped, lengths))


def pairs_that_jump(tracks: Tracks, touched: set[int]) -> set[tuple[int, int]]:
    """Return pairs with a label of `touched` whose tracks once continue each other better than themselves."""
    pairs: set[tuple[int, int]] = set()
    free = tracks.jumped | tracks.open
    for t in np.flatnonzero(tracks.jumped[:, sorted(touched)].any(axis=1)):
        candidates = np.flatnonzero(free[t])
        cost = tracks.links(np.full((1, 1), t), candidates[:, None], candidates[None])
        stay = np.diag(cost)
        better = cost + cost.T < stay[:, None] + stay - 1
        better &= tracks.jumped[t, candidates][:, None] | tracks.jumped[t, candidates]
        pairs |= {(int(candidates[i]), int(candidates[j])) for i, j in np.argwhere(np.triu(better, 1))}
    return {pair for pair in pairs if touched & set(pair)}


def _pairs_that_fit(seats: Seats, positions: np.ndarray, own: np.ndarray, rows: np.ndarray) -> set[tuple[int, int]]:
    """Return pairs with a label of some rows that over a stretch lie at each other's place on the body."""
    T, L = own.shape
    total, least, best = (np.zeros((1, len(rows), L)) for _ in range(3))   # up to here; the least so far; most since
    for start in range(0, T, AT_ONCE):
        some = slice(start, start + AT_ONCE)
        there = seats.levels(some, rows, positions[some])
        back = there if len(rows) == L else seats.levels(some, np.arange(L), positions[some][:, rows])
        gain = own[some][:, rows, None] + own[some][:, None] - there - np.swapaxes(back, 1, 2)
        # best gain over any stretch: the largest rise of the running sum above its minimum so far
        run = np.cumsum(np.concatenate([total, gain]), axis=0)
        low = np.minimum.accumulate(np.concatenate([least, run[1:]]), axis=0)
        best = np.maximum(best, (run - low).max(axis=0))
        total, least = run[-1:], low[-1:]
    fit = best[0] > CHANGE + WORTH
    fit[np.arange(len(rows)), rows] = False
    return {(min(a, b), max(a, b)) for a, b in ((int(rows[i]), int(b)) for i, b in np.argwhere(fit))}


def _two_states(gains: np.ndarray, stay: np.ndarray, switch: np.ndarray) -> tuple[float, np.ndarray]:
    """Find the best sequence of states (n + 1), as labelled or swapped, and its gain, by the Viterbi algorithm.

    `gains` (n + 1,) are those of a swapped stretch; `stay` and `switch` (n,) are costs between stretches.
    """
    value, came = np.array([0.0, gains[0]]), np.zeros((len(stay), 2), dtype=int)
    for i, (remain, change) in enumerate(zip(stay, switch, strict=True)):
        onward = np.stack([value - remain, value[::-1] - change - CHANGE])
        came[i] = onward.argmax(axis=0)
        value = onward.max(axis=0) + [0.0, gains[i + 1]]
    # trace the states back from the better end
    state = int(value.argmax())
    gained = float(value[state] + stay.sum())
    states = [state]
    for from_other in came[::-1]:
        state = 1 - state if from_other[state] else state
        states.append(state)
    return gained, np.array(states[::-1], dtype=bool)


def label_order(positions: np.ndarray, targets: np.ndarray, rate: float, outlier: float) -> np.ndarray:
    """Find the column (T, L) of each marker by `find_order`, with simulated markers (T, L, 3) on a body."""
    squared, scale = distances_apart(positions, targets, outlier)
    if ((squared > (0.5 * scale)**2).sum(axis=1) < 2).all():            # a swap puts at least two markers far off
        return np.tile(np.arange(targets.shape[1]), (len(targets), 1))
    shift = median_of_known(positions - targets, -2)[..., None, :]
    # on a body that fits badly the deviation grows like the scale of outliers
    deviation = DEVIATION * scale[..., 0] / AnimateConfig.outlier
    return find_order(targets, rate, positions - shift, deviation)


class LabelWatch:
    """Swapped pairs among `count` markers, found frame by frame in streams.

    A pair is swapped when that removes most of the distance of both from their simulated places. It is swapped back
    when the original labels fit better again. The costs of `find_order` would not do: after a jump all are large.
    """

    def __init__(self, count: int, outlier: float) -> None:
        self.outlier = outlier
        self.order = np.arange(count)

    def update(self, positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Return the column (L,) of each marker, for simulated and measured markers (L, 3)."""
        taken = targets[self.order]
        squared, scale = distances_apart(positions, taken, self.outlier)
        suspect = squared > (0.5 * scale)**2                            # false for NaN
        changed = self.order != np.arange(len(self.order))
        if suspect.sum() < 2 and not changed.any():
            return self.order
        shift = median_of_known(positions - taken, 0)
        candidates = np.flatnonzero((suspect | changed) & ~np.isnan(squared))
        apart = np.linalg.norm(positions[candidates, None] - shift - taken[candidates], axis=2)
        # swap a pair if that leaves much less distance
        for i, j in zip(*np.triu_indices(len(candidates), 1), strict=True):
            now, then = apart[i, i] + apart[j, j], apart[i, j] + apart[j, i]
            a, b = candidates[i], candidates[j]
            back = self.order[a] == b
            if then < (LEAVE if back else ENTER) * now and (back or max(apart[i, j], apart[j, i]) < 0.5 * scale[0]):
                self.order[[a, b]] = self.order[[b, a]]
                taken[[a, b]] = taken[[b, a]]
                apart[:, [i, j]] = apart[:, [j, i]]
        return self.order
