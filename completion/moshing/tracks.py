"""Where the tracks of markers jump, and which label carries on the track of which: no body is needed."""
from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

STEPS = 3                            # differences from frame to frame that make a velocity, on either side
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

    def __init__(self, positions: np.ndarray, floor: float, jump: float) -> None:
        self.positions = positions
        steps = np.diff(positions, axis=0)
        missing = np.full((1, *positions.shape[1:]), np.nan)
        self._after = np.concatenate([_median_of_next(steps), missing])
        self._before = np.concatenate([missing, _median_of_next(steps[::-1])[::-1]])
        self.off = np.full(positions.shape[:2], np.nan)
        self.off[1:] = _length(steps - _mean_of_known(self._before[:-1], self._after[1:]))
        self.sd = self._usual(floor)
        self.open = np.isnan(self.off)
        self.jumped = np.nan_to_num(self.off) > np.maximum(jump, JUMPS * self.sd)

    def _usual(self, floor: float) -> np.ndarray:
        """The usual size (T, L) of what is off: around that time, and no less than over all of it."""
        near = median_filter(np.nan_to_num(self.off), size=(2 * NEAR + 1, 1), mode="nearest")
        whole = [np.median(x[np.isfinite(x)]) if np.isfinite(x).any() else 0.0 for x in self.off.T]
        return np.maximum(floor, USUAL * np.maximum(near, whole))

    def links(self, times: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
        """What it counts that labels `after` go on, in frames `times`, where labels `before` were in those before.

        Half squared standard deviations, no more than `TORN`; as much for one that appears, nothing where no label
        `after` is seen. The three are arrays of one shape, after broadcasting.
        """
        step = self.positions[times, after] - self.positions[times - 1, before]
        off = _length(step - _mean_of_known(self._before[times - 1, before], self._after[times, after]))
        sd = np.maximum(self.sd[times, before], self.sd[times, after])
        cost = np.minimum(np.nan_to_num(off**2 / (2 * sd**2), nan=TORN), TORN)
        return np.where(np.isnan(self.positions[times, after, 0]), 0.0, cost)


def _median_of_next(steps: np.ndarray) -> np.ndarray:
    """The median (T - 1, L, 3) of this and the next steps that are known; NaN without any."""
    padded = np.concatenate([steps, np.full((STEPS - 1, *steps.shape[1:]), np.nan)])
    ordered = np.sort(np.stack([padded[i:len(steps) + i] for i in range(STEPS)]), axis=0)           # NaN comes last
    known = np.isfinite(ordered).sum(axis=0)
    below = np.take_along_axis(ordered, np.maximum(known - 1, 0)[None] // 2, axis=0)
    above = np.take_along_axis(ordered, np.minimum(known // 2, STEPS - 1)[None], axis=0)
    return np.where(known > 0, 0.5 * (below + above)[0], np.nan)


def _mean_of_known(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The mean of two velocities, or the one that is known, or zero."""
    known = np.isfinite(a[..., :1]).astype(int) + np.isfinite(b[..., :1])
    return (np.nan_to_num(a) + np.nan_to_num(b)) / np.maximum(known, 1)


def _length(x: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("...d,...d->...", x, x))
