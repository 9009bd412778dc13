"""Markers that slip, jitter or stray: what they are off in the frame of their body part, over the whole sequence."""
from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import binary_dilation, median_filter

from ..pose.marked_body import median_of_known, stretches
from .results import ArtefactConfig, BadKind, BadSpan

SLIP_SUDDEN = 0.6                    # share of the lasting displacement that comes within a tenth of a second


def find_bad(off: np.ndarray, alone: np.ndarray, jumps: np.ndarray, labels: tuple[str, ...], config: ArtefactConfig,
             rate: float) -> tuple[BadSpan, ...]:
    """The bad spans of markers that are off (T, L, 3), metres, in the frames of their parts, NaN where not seen.

    `off` is as the body follows all, `alone` as it would the others; `jumps` (T, L), metres, is how far tracks jump.
    """
    noise_usual, stray_usual, joined = 5.0, 4.0, 0.1        # times what is usual; seconds between spans that are one
    usual = median_of_known(np.linalg.norm(off - median_of_known(off, 0), axis=2))
    tracks = [off[:, i][np.isfinite(off[:, i, 0])] for i in range(len(labels))]
    # second differences, those at the ends repeated
    jitter = [np.pad(np.linalg.norm(np.diff(track, 2, axis=0), axis=1), 1, mode="edge") if len(track) > 2
              else np.zeros(len(track)) for track in tracks]
    known = [np.median(q) for q in jitter if len(q)]
    limit = max(config.noise, noise_usual * float(np.median(known))) if known else config.noise
    out: list[BadSpan] = []
    for i, label in enumerate(labels):
        seen = np.flatnonzero(np.isfinite(off[:, i, 0]))
        if len(seen) < 3:
            continue
        mine, leap, gap = off[seen, i], jumps[seen, i], np.r_[False, np.diff(seen) > 1]
        noisy = _noisy(jitter[i], limit, rate)
        slip = _slip(alone[seen, i], ~noisy, leap, config.slip, rate)
        before = ~noisy & (np.arange(len(seen)) < slip)
        middle = np.median(mine[before] if before.any() else mine, axis=0)
        away = np.linalg.norm(mine - middle, axis=1)
        stray = _stray(away, np.maximum(config.stray, stray_usual * usual[seen]), leap, gap) & before
        slipped = np.arange(len(seen)) >= slip
        kinds: tuple[tuple[BadKind, np.ndarray], ...] = (("noisy", noisy), ("slipped", slipped), ("stray", stray))
        for kind, bad in kinds:
            out += [BadSpan(label, kind, int(seen[r[0]]), int(seen[r[-1]]), float(np.median(away[r])))
                    for r in stretches(np.flatnonzero(bad), seen, max(1.0, joined * rate))]
    return tuple(sorted(out, key=lambda s: (s.begin, s.label)))


def without_lost_limbs(spans: tuple[BadSpan, ...], near: np.ndarray, labels: tuple[str, ...]) -> tuple[BadSpan, ...]:
    """Spans but those in which half the markers of a limb, `near` (L, L), are bad: there the body is at fault."""
    count = len(labels)
    begin, end = (np.array([getattr(span, name) for span in spans], dtype=int) for name in ("begin", "end"))
    of = np.array([labels.index(span.label) for span in spans], dtype=int)
    kept = []
    for i, span in enumerate(spans):
        common = np.minimum(end, end[i]) - np.maximum(begin, begin[i]) + 1
        with_it = 2 * common > span.end - span.begin + 1
        together = np.bincount(of[with_it], minlength=count) > 0
        limb = near[of[i]]
        if span.kind == "slipped" or (together & limb).sum() < max(3, 0.5 * limb.sum()):
            kept.append(span)
    return tuple(kept)


def _noisy(jitter: np.ndarray, limit: float, rate: float) -> np.ndarray:
    """Frames (n,) bool of a track that jitters, to the first and last frame that it does."""
    width = 2 * round(0.5 * 0.15 * rate) + 1                    # 0.15 seconds, over which jitter is a median
    wide = median_filter(jitter, size=width, mode="nearest") > limit
    rough = jitter > limit
    reach = binary_dilation(wide, iterations=width // 2) if wide.any() else wide
    out = np.zeros(len(jitter), dtype=bool)
    for run in stretches(np.flatnonzero(reach)):
        some = run[rough[run]]
        if len(some) > width // 2:
            out[some[0]:some[-1] + 1] = True
    return out


def _slip(off: np.ndarray, clean: np.ndarray, jumps: np.ndarray, least: float, rate: float) -> int:
    """From which frame on a track (n, 3) stays displaced; n when it does not."""
    n, lag = len(off), max(1, round(0.5 * 0.1 * rate))          # in a tenth of a second a slip is over
    stays = max(3, round(0.25 * rate))                          # frames that a marker is seen before and after
    usual = 3.0                                                 # times the usual change within that time
    some = np.flatnonzero(clean)
    if len(some) < 2 * stays:
        return n
    track = off[some]
    smooth = median_filter(track, size=(2 * lag + 1, 1), mode="nearest")
    step = np.zeros_like(track)
    step[stays:len(track) - stays] = (smooth[2 * lag:] - smooth[:-2 * lag])[stays - lag:len(track) - stays - lag]
    size = np.linalg.norm(step, axis=1)
    size[size < max(SLIP_SUDDEN * least, usual * float(np.median(size)))] = 0
    best, found = 0.0, n
    while size[k := int(size.argmax())] > 0:
        worth, at = _lasting(track, jumps[some], k, step[k], least, lag)
        if worth > best:
            best, found = worth, int(some[at])
        size[max(0, k - 2 * lag):k + 2 * lag] = 0
    return found


def _lasting(track: np.ndarray, jumps: np.ndarray, k: int, step: np.ndarray, least: float, lag: int
             ) -> tuple[float, int]:
    """How well a step at k parts a track (n, 3) in two, zero when it is no slip, and its exact place.

    Where the track itself jumps, less is needed: a body that fits worse from some time on makes no track jump.
    """
    leap, smooth = 0.5, 2.0         # share of it that a jump of the track is at least; times `least` without a jump
    with_jump, without = 0.65, 0.85                             # shares of the frames on either side that keep to it
    before, after = np.median(track[:k], axis=0), np.median(track[k:], axis=0)
    way = after - before
    far = float(np.linalg.norm(way))
    near = np.arange(max(1, k - 2 * lag), min(len(track), k + 2 * lag))
    jumped = leap * far < jumps[near].max() < far / leap
    if far < (least if jumped else smooth * least) or step @ way < SLIP_SUDDEN * far**2:
        return 0.0, k
    share = (track - before) @ way / far**2
    lasts = with_jump if jumped else without
    if (share[:k] < 0.5).mean() < lasts or (share[k:] > 0.5).mean() < lasts:
        return 0.0, k
    share = np.clip(share, 0, 1)
    cost = np.r_[0, np.cumsum(share)] + np.r_[np.cumsum((1 - share)[::-1])[::-1], 0]
    at = near[jumps[near].argmax() if jumped else cost[near].argmin()]
    return far**2 * k * (len(track) - k) / len(track), int(at)


def _stray(away: np.ndarray, limit: np.ndarray, jumps: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Frames (n,) bool of a marker that is somewhere else, from one tear of its track to the next.

    All (n,): metres from its usual place and how far that may be; how far its track jumps there; after a gap.
    """
    leap, jumped = 0.5, 0.5         # share of the displacement that a jump is; of the limit that does between two jumps
    stray_smooth = 3.0  # times the limit that a stray takes where no track jumps
    out = away > stray_smooth * limit
    ends = np.r_[0, np.flatnonzero((jumps > 0) | gap), len(away)]
    leaps, gaps = np.r_[jumps, 0.0], np.r_[gap, False]
    for begin, end in pairwise(ends):
        if begin == end:
            continue
        far = float(np.median(away[begin:end]))
        torn = [leaps[at] > leap * far for at in (begin, end)]
        open_ended = [gaps[at] or at in (0, len(away)) for at in (begin, end)]
        both = all(a or b for a, b in zip(torn, open_ended, strict=True))
        share = jumped if all(torn) else 1.0 if any(torn) and both else stray_smooth
        out[begin:end] |= far > share * np.median(limit[begin:end])
    return out
