"""Find markers that slip, jitter or stray, by their offset in the frame of their body part over the sequence."""
from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.ndimage import binary_dilation, median_filter

from ..pose.marked_body import median_of_known, stretches
from .results import BadKind, BadSpan

SLIP_SUDDEN = 0.6                    # least share of a slip that happens within a tenth of a second
# metres: least lasting displacement, least distance of a stray marker, and least jitter (median length of the second
# difference); with these tests/benchmarks/mosh_artefacts.py finds all slipped, stray and noisy markers
SLIP, STRAY, NOISE = 0.015, 0.06, 0.012


def find_bad(off: np.ndarray, alone: np.ndarray, jumps: np.ndarray, labels: tuple[str, ...], rate: float
             ) -> tuple[BadSpan, ...]:
    """Find the bad spans of markers with offsets (T, L, 3), metres, in the frames of their parts, NaN where not seen.

    `off` is for a body that follows all markers, `alone` for one that follows the others; `jumps` (T, L), metres.
    """
    noise_usual, stray_usual, joined = 5.0, 4.0, 0.1        # times the usual size; spans 0.1 s apart are one
    # usual offset of each frame, and the jitter of each track
    usual = median_of_known(np.linalg.norm(off - median_of_known(off, 0), axis=2))
    tracks = [off[:, i][np.isfinite(off[:, i, 0])] for i in range(len(labels))]
    # jitter: length of the second difference, repeated at the ends
    jitter = [np.pad(np.linalg.norm(np.diff(track, 2, axis=0), axis=1), 1, mode="edge") if len(track) > 2
              else np.zeros(len(track)) for track in tracks]
    known = [np.median(q) for q in jitter if len(q)]
    limit = max(NOISE, noise_usual * float(np.median(known))) if known else NOISE
    out: list[BadSpan] = []
    for i, label in enumerate(labels):
        visible = np.flatnonzero(np.isfinite(off[:, i, 0]))
        if len(visible) < 3:
            continue
        own, leap, gap = off[visible, i], jumps[visible, i], np.r_[False, np.diff(visible) > 1]
        # the three kinds, in this order: a later one is looked for outside the earlier ones
        noisy = _noisy(jitter[i], limit, rate)
        slip = _slip(alone[visible, i], ~noisy, leap, SLIP, rate)
        before = ~noisy & (np.arange(len(visible)) < slip)
        middle = np.median(own[before] if before.any() else own, axis=0)
        away = np.linalg.norm(own - middle, axis=1)
        stray = _stray(away, np.maximum(STRAY, stray_usual * usual[visible]), leap, gap) & before
        slipped = np.arange(len(visible)) >= slip
        # frames of each kind as spans
        kinds: tuple[tuple[BadKind, np.ndarray], ...] = (("noisy", noisy), ("slipped", slipped), ("stray", stray))
        for kind, bad in kinds:
            out += [BadSpan(label, kind, int(visible[r[0]]), int(visible[r[-1]]), float(np.median(away[r])))
                    for r in stretches(np.flatnonzero(bad), visible, max(1.0, joined * rate))]
    return tuple(sorted(out, key=lambda s: (s.begin, s.label)))


def without_lost_limbs(spans: tuple[BadSpan, ...], near: np.ndarray, labels: tuple[str, ...]) -> tuple[BadSpan, ...]:
    """Drop spans in which half the markers of a limb, `near` (L, L), are bad: there the pose is at fault."""
    count = len(labels)
    begin, end = (np.array([getattr(span, name) for span in spans], dtype=int) for name in ("begin", "end"))
    of = np.array([labels.index(span.label) for span in spans], dtype=int)
    kept = []
    for i, span in enumerate(spans):
        # labels that are bad for more than half of this span, at the same time
        common = np.minimum(end, end[i]) - np.maximum(begin, begin[i]) + 1
        with_it = 2 * common > span.end - span.begin + 1
        together = np.bincount(of[with_it], minlength=count) > 0
        limb = near[of[i]]
        if span.kind == "slipped" or (together & limb).sum() < max(3, 0.5 * limb.sum()):
            kept.append(span)
    return tuple(kept)


def _noisy(jitter: np.ndarray, limit: float, rate: float) -> np.ndarray:
    """Return a mask (n,) of frames in which a track jitters, from the first to the last rough frame."""
    width = 2 * round(0.5 * 0.15 * rate) + 1                    # 0.15 s: jitter is judged by its median over that
    wide = median_filter(jitter, size=width, mode="nearest") > limit
    rough = jitter > limit
    reach = binary_dilation(wide, iterations=width // 2) if wide.any() else wide
    out = np.zeros(len(jitter), dtype=bool)
    for run in stretches(np.flatnonzero(reach)):
        rough_frames = run[rough[run]]
        if len(rough_frames) > width // 2:
            out[rough_frames[0]:rough_frames[-1] + 1] = True
    return out


def _slip(off: np.ndarray, clean: np.ndarray, jumps: np.ndarray, least: float, rate: float) -> int:
    """Find the frame from which a track (n, 3) stays displaced; n if it does not."""
    n, lag = len(off), max(1, round(0.5 * 0.1 * rate))          # 0.1 s: duration of a slip
    stays = max(3, round(0.25 * rate))                          # 0.25 s: least time before and after
    usual = 3.0                                                 # least step, over the median step
    clean_frames = np.flatnonzero(clean)
    if len(clean_frames) < 2 * stays:
        return n
    # change of the smoothed track over the duration of a slip
    track = off[clean_frames]
    smooth = median_filter(track, size=(2 * lag + 1, 1), mode="nearest")
    step = np.zeros_like(track)
    step[stays:len(track) - stays] = (smooth[2 * lag:] - smooth[:-2 * lag])[stays - lag:len(track) - stays - lag]
    size = np.linalg.norm(step, axis=1)
    size[size < max(SLIP_SUDDEN * least, usual * float(np.median(size)))] = 0
    # test the largest steps first, and keep the one that separates the track best
    best, found = 0.0, n
    while size[k := int(size.argmax())] > 0:
        worth, at = _lasting(track, jumps[clean_frames], k, step[k], least, lag)
        if worth > best:
            best, found = worth, int(clean_frames[at])
        size[max(0, k - 2 * lag):k + 2 * lag] = 0
    return found


def _lasting(track: np.ndarray, jumps: np.ndarray, k: int, step: np.ndarray, least: float, lag: int
             ) -> tuple[float, int]:
    """Score how well a step at frame k separates a track (n, 3), 0 if it is no slip, and find its exact frame.

    Where the raw track jumps, less evidence is needed: a body that fits worse from some time on makes no track jump.
    """
    leap, smooth = 0.5, 2.0         # least jump over the displacement; least displacement over `least` without a jump
    with_jump, without = 0.65, 0.85                             # least share of frames on the right side of the step
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
    # the frame at which a step explains the track best
    share = np.clip(share, 0, 1)
    cost = np.r_[0, np.cumsum(share)] + np.r_[np.cumsum((1 - share)[::-1])[::-1], 0]
    at = near[jumps[near].argmax() if jumped else cost[near].argmin()]
    return far**2 * k * (len(track) - k) / len(track), int(at)


def _stray(away: np.ndarray, limit: np.ndarray, jumps: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of frames in which a marker strays, from one break of its track to the next.

    All are (n,): distance from its usual place and its limit, jump of the track, metres; whether after a gap.
    """
    leap, jumped = 0.5, 0.5         # least jump over the displacement; factor on the limit between two jumps
    stray_smooth = 3.0  # factor on the limit where no track jumps
    out = away > stray_smooth * limit
    ends = np.r_[0, np.flatnonzero((jumps > 0) | gap), len(away)]
    leaps, gaps = np.r_[jumps, 0.0], np.r_[gap, False]
    for begin, end in pairwise(ends):
        if begin == end:
            continue
        # a piece between two breaks needs a smaller displacement if it really jumped there
        far = float(np.median(away[begin:end]))
        torn = [leaps[at] > leap * far for at in (begin, end)]
        open_ended = [gaps[at] or at in (0, len(away)) for at in (begin, end)]
        both = all(a or b for a, b in zip(torn, open_ended, strict=True))
        share = jumped if all(torn) else 1.0 if any(torn) and both else stray_smooth
        out[begin:end] |= far > share * np.median(limit[begin:end])
    return out
