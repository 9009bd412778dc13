"""Markers that slip, jitter or stray: what they are off in the frame of their body part, over the whole sequence."""
from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_dilation, median_filter

from .results import BadSpan, BadKind
from .settings import FaultConfig

SLIP_WINDOW = 0.3                    # seconds on either side of a slip
SLIP_SUDDEN = 0.6                    # share of the lasting displacement that comes within that time
SLIP_LASTS = 0.85                    # share of the frames before and after that lie on their side of its middle
NOISE_WINDOW = 0.15                  # seconds, over which jitter is a median
NOISE_USUAL = 5.0                    # times the usual jitter
STRAY_USUAL = 4.0                    # times the usual distance of the markers of a frame
STRAY_JUMPED = 0.5                   # share of the limit that does where a track jumps away and back
STRAY_SMOOTH = 2.0                   # times the limit that it takes where no track jumps
JOINED = 0.1                         # seconds between two spans of a kind that are one


def find_bad(local: np.ndarray, jumped: np.ndarray, labels: tuple[str, ...], config: FaultConfig, rate: float
             ) -> tuple[BadSpan, ...]:
    """The bad spans of markers.

    Parameters
    ----------
    local : (T, L, 3) float, metres
        From the simulated marker to the measured one, in the frame of its part; NaN where it was not seen.
    jumped : (T, L) bool
        Where the track jumps.
    labels : L strings
    rate : float, frames per second
    """
    usual = np.nan_to_num(_median(np.linalg.norm(local - _median(local), axis=2), axis=1))
    jitter = [_jitter(local[:, i][np.isfinite(local[:, i, 0])]) for i in range(len(labels))]
    known = [np.median(q) for q in jitter if len(q)]
    limit = max(config.noise, NOISE_USUAL * float(np.median(known))) if known else config.noise
    out: list[BadSpan] = []
    for i, label in enumerate(labels):
        seen = np.flatnonzero(np.isfinite(local[:, i, 0]))
        if len(seen) < 3:
            continue
        off, torn = local[seen, i], jumped[seen, i]
        noisy = _noisy(jitter[i], limit, rate)
        slip = _slip(off, ~noisy, config.slip, rate)
        before = ~noisy & (np.arange(len(seen)) < slip)
        middle = np.median(off[before] if before.any() else off, axis=0)
        away = np.linalg.norm(off - middle, axis=1)
        gap = np.r_[False, np.diff(seen) > 1]
        stray = _stray(away, np.maximum(config.stray, STRAY_USUAL * usual[seen]), torn, gap) & before
        kinds: tuple[tuple[BadKind, np.ndarray], ...] = (
            ("noisy", noisy), ("slipped", np.arange(len(seen)) >= slip), ("stray", stray))
        for kind, bad in kinds:
            out += _spans(label, kind, seen, bad, away, JOINED * rate)
    return tuple(sorted(out, key=lambda s: (s.begin, s.label)))


def _jitter(off: np.ndarray) -> np.ndarray:
    """Second differences (n,) of a track (n, 3), those at its ends repeated."""
    if len(off) < 3:
        return np.zeros(len(off))
    return np.pad(np.linalg.norm(np.diff(off, 2, axis=0), axis=1), 1, mode="edge")


def _noisy(jitter: np.ndarray, limit: float, rate: float) -> np.ndarray:
    """Frames (n,) bool of a track that jitters, to the first and last frame that it does."""
    width = 2 * round(0.5 * NOISE_WINDOW * rate) + 1
    wide = median_filter(jitter, size=width, mode="nearest") > limit
    rough = jitter > limit
    reach = binary_dilation(wide, iterations=width // 2) if wide.any() else wide
    out = np.zeros(len(jitter), dtype=bool)
    for run in _runs(reach):
        some = run[rough[run]]
        if len(some):
            out[some[0]:some[-1] + 1] = True
    return out


def _slip(off: np.ndarray, clean: np.ndarray, least: float, rate: float) -> int:
    """From which frame on a track (n, 3) stays displaced; n when it does not."""
    n, width = len(off), max(3, round(SLIP_WINDOW * rate))
    some = np.flatnonzero(clean)
    if len(some) < 3 * width:
        return n
    track = off[some]
    smooth = median_filter(track, size=(width, 1), mode="nearest")
    half = width // 2
    step = np.zeros_like(track)
    step[half + 1:len(track) - half] = smooth[2 * half + 1:] - smooth[:len(track) - 2 * half - 1]
    size = np.linalg.norm(step, axis=1)
    best, found = 0.0, n
    while (k := int(size.argmax())) and size[k] >= SLIP_SUDDEN * least:
        worth, at = _lasting(track, k, step[k], least, width)
        if worth > best:
            best, found = worth, int(some[at])
        size[max(0, k - width):k + width] = 0
    return found


def _lasting(track: np.ndarray, k: int, step: np.ndarray, least: float, width: int) -> tuple[float, int]:
    """How well a step at k parts a track (n, 3) in two, zero when it is no slip, and its exact place."""
    before, after = np.median(track[:k], axis=0), np.median(track[k:], axis=0)
    way = after - before
    far = float(np.linalg.norm(way))
    if far < least or step @ way < SLIP_SUDDEN * far**2:
        return 0.0, k
    share = (track - before) @ way / far**2
    if (share[:k] < 0.5).mean() < SLIP_LASTS or (share[k:] > 0.5).mean() < SLIP_LASTS:
        return 0.0, k
    share = np.clip(share, 0, 1)
    cost = np.r_[0, np.cumsum(share)] + np.r_[np.cumsum((1 - share)[::-1])[::-1], 0]
    near = np.arange(max(1, k - width), min(len(track), k + width))
    return far**2 * k * (len(track) - k) / len(track), int(near[cost[near].argmin()])


def _stray(away: np.ndarray, limit: np.ndarray, jumped: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Frames (n,) bool of a marker that is somewhere else, from one tear of its track to the next.

    Parameters
    ----------
    away, limit : (n,) float, metres
        From its usual place, and how far that may be.
    jumped, gap : (n,) bool
        The track jumps from the frame before to this one, or was out of sight between them.
    """
    out = away > STRAY_SMOOTH * limit
    cuts = np.flatnonzero(jumped | gap)
    ends = np.r_[0, cuts, len(away)]
    for begin, end in zip(ends[:-1], ends[1:], strict=True):
        if begin == end:
            continue
        tears = [jumped[begin] or gap[begin], end < len(away) and (jumped[end] or gap[end])]
        leaps = jumped[begin] or (end < len(away) and bool(jumped[end]))
        share = np.median(away[begin:end] / limit[begin:end])
        out[begin:end] |= share > (STRAY_JUMPED if all(tears) and leaps else 1.0 if any(tears) else STRAY_SMOOTH)
    return out


def _spans(label: str, kind: BadKind, seen: np.ndarray, bad: np.ndarray, away: np.ndarray, joined: float
           ) -> list[BadSpan]:
    """The spans of frames `seen` (n,) that are bad (n,), near ones joined."""
    at = np.flatnonzero(bad)
    runs = np.split(at, np.flatnonzero(np.diff(seen[at]) > max(1.0, joined)) + 1) if len(at) else []
    return [BadSpan(label, kind, int(seen[r[0]]), int(seen[r[-1]]), float(np.median(away[r]))) for r in runs]


def _runs(mask: np.ndarray) -> list[np.ndarray]:
    """The stretches of true values."""
    at = np.flatnonzero(mask)
    return np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(at) else []


def _median(values: np.ndarray, axis: int = 0) -> np.ndarray:
    """The median of values that are not NaN; NaN without any."""
    ordered = np.sort(values, axis=axis)
    known = np.isfinite(ordered).sum(axis=axis, keepdims=True)
    last = values.shape[axis] - 1
    below, above = (np.take_along_axis(ordered, np.clip(i, 0, last), axis=axis) for i in ((known - 1) // 2, known // 2))
    return np.squeeze(0.5 * (below + np.where(known > 0, above, np.nan)), axis=axis)
