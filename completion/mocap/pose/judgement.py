"""Judge motions from markers: distrusted markers, implausible speed, a body far from its markers."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanprep.console import Metric
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import HAND, Judgement, extent, size
from scanprep.plausible import too_fast, unit_problem

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout


def markers_told(motions: Sequence[Motion]) -> Metric:
    """Return which markers are in the mean distance of motions of one body."""
    seen = {label for motion in motions for label, column in zip(motion.labels, motion.residuals.T, strict=True)
            if np.isfinite(column).any()}
    out = sorted({label for motion in motions for label in motion.distrusted})
    without = f", without {', '.join(out)}" if out else ""
    return Metric("markers in the mean distance", f"{len(seen) - len(out)} of {len(seen)}{without}")


def find_distrusted_markers(motions: Sequence[Motion]) -> tuple[str, ...]:
    """Return a doubt for markers that are distrusted throughout the motions of one body."""
    out = sorted({label for motion in motions for label in motion.distrusted})
    return (f"{', '.join(out)} distrusted in most frames: misplaced? They are not in the mean distance",
            ) if out else ()


def hardly_seen(motions: Sequence[Motion]) -> tuple[str, ...]:
    """Return a doubt where most frames show too few markers to place a body."""
    sparse = sum(int((np.isfinite(motion.residuals).sum(axis=1) < 3).sum()) for motion in motions)
    frames = sum(len(motion.residuals) for motion in motions)
    return (f"{sparse} of {frames} frames show fewer than 3 markers: the body there is carried over from the others",
            ) if sparse > frames / 2 else ()


def judge_motions(person: Judgement, own: Judgement, motions: Sequence[Motion], body: Mesh) -> Judgement:
    """Merge the judgement of motions with that of the `person` found from the same markers.

    For a body far from its markers, a strange size of the person is an effect and not the cause, so it comes last.
    """
    return own.merge(person) if mean_off(motions) > HAND * size(body) else person.merge(own)


def mean_off(motions: Sequence[Motion]) -> float:
    """Compute the mean distance of all markers from their simulated places, metres; 0 without any."""
    seen = [motion.residuals[np.isfinite(motion.residuals)] for motion in motions]
    return float(np.concatenate(seen).mean()) if any(map(len, seen)) else 0.0


def doubt_frames(motions: Sequence[Motion], body: Mesh) -> tuple[str, ...]:
    """Return doubts for frames that did not settle, and for those where half the markers are a hand's width off."""
    settled = np.concatenate([motion.converged[np.isfinite(motion.residuals).any(axis=1)] for motion in motions])
    doubts = list[str]()
    # walks, a jump and a ball game settle in 75 to 100% of the frames
    if len(settled) and settled.mean() < 0.5:
        doubts.append(f"only {100 * settled.mean():.0f}% of the frames settled: too fast for the rate, markers that "
                      "slide, or another body?")
    # of at least three markers, as one alone may be a ghost
    off = [float(np.median(row[np.isfinite(row)])) for motion in motions for row in motion.residuals
           if np.isfinite(row).sum() >= 3]
    far = sum(distance > HAND * size(body) for distance in off)
    if far:
        doubts.append(f"in {far} of {len(off)} frames half of the markers are far from where the body has them, up to "
                      f"{1000 * max(off):.0f} mm: the body is lost there")
    return tuple(doubts)


def motion_doubts(motions: Sequence[Motion], markers: Sequence[MarkerSequence], body: Mesh) -> tuple[str, ...]:
    """Return reasons to look at motions of one body from markers; `body` is the model's template."""
    reasons = [*hardly_seen(motions), *doubt_frames(motions, body), *find_distrusted_markers(motions)]
    off = mean_off(motions)
    # 0.018 of the size, 25 mm on a man: good motions are 4 to 25 mm off, shuffled frames 31
    if off > 0.018 * size(body):
        reasons.append(f"the markers are {1000 * off:.0f} mm from where the body has them")
    return (*filter(None, (too_fast(marker_speed(one), size(body)) for one in markers)), *reasons)


def marker_speed(markers: MarkerSequence) -> float:
    """Compute the median speed of all markers, metres per second, over steps of about 1/30 s."""
    step = max(1, round(markers.rate / 30))
    moved = np.linalg.norm(markers.positions[step:] - markers.positions[:-step], axis=2)
    known = moved[np.isfinite(moved)]
    return float(np.median(known)) * markers.rate / step if len(known) else 0.0


def motion_problem(motion: Motion, body: Mesh, layout: MarkerLayout, markers: MarkerSequence) -> str | None:
    """Return why a motion from markers means nothing, with the likely cause, or None; `body` is the template."""
    seen = np.isfinite(motion.residuals)
    if not seen.any():
        return "no marker of the layout was ever seen: markers of another layout?"
    # the size of the box of markers tells a wrong unit; at most some 50 frames are looked at
    known = layout.match_labels(markers.labels, 0)
    columns = [markers.labels.index(label) for label in known]
    sampled = markers.positions[:: max(1, len(seen) // 50), columns]
    counts = np.isfinite(sampled[..., 0]).sum(axis=1)
    # the median over full frames: a ghost marker makes the box of its frame arbitrarily large
    spans = [extent(frame) for frame in sampled[counts >= 0.9 * counts.max()]]
    wrong = unit_problem(float(np.nanmedian(spans)), extent(layout.select(known).place(body)), "the markers span a box")
    # 0.025 of the size, 34 mm on a man: good motions are 4 to 25 mm off, those with swapped sides 36 to 60
    off, far = float(motion.residuals[seen].mean()), 0.025 * size(body)
    if wrong is None and off <= far:
        return None
    believed = 100 * float(motion.trusted[seen].mean())
    return (f"the markers are {1000 * off:.0f} mm from where the body has them, {100 * motion.converged.mean():.0f}% "
            f"of the frames converged and {believed:.0f}% of the markers are believed; "
            + (wrong or too_fast(marker_speed(markers), size(body))
               or "labels mixed up, left and right exchanged, another layout, or another model?"))
