"""Where the tracks of markers jump, and which label carries on the track of which: no body is needed."""
from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

ACCELERATION = 10.0                  # metres per second squared, of a marker that is out of sight
LONGEST = 0.25                       # seconds out of sight, beyond which a track tells nothing
NEAR = 12                            # frames on either side from which the usual jump of a track is taken
USUAL = 1.5                          # standard deviations to a median distance, nearly
JUMPS = 5.0                          # standard deviations that are a jump
TORN = 10.0                          # most that a torn track counts, in half squared standard deviations


class Tracks:
    """Tracks (T, L, 3) of labels, metres, NaN where one was not seen.

    From one frame to the next a track moves at the mean of its velocities before and after, which misses no more
    than a change of acceleration. A label that takes over another's track goes on from that one's place.

    Parameters
    ----------
    positions : (T, L, 3) float, metres
    rate : float, frames per second
    floor : float, metres
        Least standard deviation of a track around its prediction.
    jump : float, metres
        Least distance from the prediction that is a jump.

    Attributes
    ----------
    off : (T, L) float, metres
        From the prediction; NaN where the label is not seen both in this frame and the one before.
    sd : (T, L) float, metres
        The usual size of `off` around that time.
    jumped, open : (T, L) bool
        The track does not go on here; it is not known whether it does.
    """

    def __init__(self, positions: np.ndarray, rate: float, floor: float, jump: float) -> None:
        self.positions, self.rate, self.floor, self.least = positions, rate, floor, jump
        steps = np.diff(positions, axis=0)
        missing = np.full((1, *positions.shape[1:]), np.nan)
        self._after = np.concatenate([_median_of_next(steps), missing])
        self._before = np.concatenate([missing, _median_of_next(steps[::-1])[::-1]])
        seen = np.isfinite(positions[..., 0])
        self._last = np.maximum.accumulate(np.where(seen, np.arange(len(positions))[:, None], -1), axis=0)
        self.off = np.full(positions.shape[:2], np.nan)
        self.off[1:] = _length(steps - _mean_of_known(self._before[:-1], self._after[1:]))
        self.sd = self._usual(floor)
        self.open = np.isnan(self.off)
        self.jumped = np.nan_to_num(self.off) > np.maximum(jump, JUMPS * self.sd)

    def changed(self, columns: np.ndarray, positions: np.ndarray) -> None:
        """Have other positions (T, n, 3) in some columns (n,)."""
        other = Tracks(positions, self.rate, self.floor, self.least)
        self.positions = self.positions.copy()
        for name in ("positions", "_after", "_before", "_last", "off", "sd", "open", "jumped"):
            getattr(self, name)[:, columns] = getattr(other, name)

    def _usual(self, floor: float) -> np.ndarray:
        """The usual size (T, L) of what is off: around that time, and no less than over all of it."""
        near = median_filter(np.nan_to_num(self.off), size=(2 * NEAR + 1, 1), mode="nearest")
        whole = [np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else 0.0 for x in self.off.T]
        return np.maximum(floor, USUAL * np.maximum(near, whole))

    def links(self, times: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """What it counts that labels `after` go on, in frames `times`, where labels `before` were until then.

        Half squared standard deviations, no more than `TORN`; as much for one that appears, nothing where no label
        `after` is seen. Over a gap a track may have taken another way, the farther the longer it was. The three are
        arrays of one shape, after broadcasting.
        """
        last = self._last[times - 1, before]
        gap = times - last
        way = gap[..., None] * _mean_of_known(self._before[last, before], self._after[times, after])
        off = _length(self.positions[times, after] - self.positions[last, before] - way)
        usual = np.maximum(self.sd[last, before], self.sd[times, after])
        sd = 0.5 * (gap + 1) * usual + 0.5 * ACCELERATION * ((gap - 1) / self.rate)**2
        cost = np.nan_to_num(off**2 / (2 * sd**2), nan=TORN) + 3 * np.log(sd / usual)
        cost = np.where((last < 0) | (gap > LONGEST * self.rate + 1), TORN, np.minimum(cost, TORN))
        return np.where(np.isnan(self.positions[times, after, 0]), 0.0, cost)


def _median_of_next(steps: np.ndarray) -> np.ndarray:
    """The median (T - 1, L, 3) of this and the next two steps, or one of those that are known; NaN without any."""
    padded = np.concatenate([steps, np.full((2, *steps.shape[1:]), np.nan)])
    a, b, c = (padded[i:len(steps) + i] for i in range(3))
    return np.fmax(np.fmin(a, b), np.fmin(np.fmax(a, b), c))


def _mean_of_known(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The mean of two velocities, or the one that is known, or zero."""
    known = np.isfinite(a[..., :1]).astype(int) + np.isfinite(b[..., :1])
    return (np.nan_to_num(a) + np.nan_to_num(b)) / np.maximum(known, 1)


def _length(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("...d,...d->...", x, x))
