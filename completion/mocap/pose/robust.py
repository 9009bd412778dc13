"""Which markers are believed: weights that outliers lose, and labels that two markers have swapped."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanprep.console import Metric
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import HAND, Judgement, extent, size, unit_problem

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from .settings import AnimateConfig
from .swaps import DEVIATION, find_order

DOUBTFUL = 0.018                     # of the size, 25 mm on a man; good motions are 4 to 25 mm off, shuffled frames 31
# Sizes a second at which the median marker moves, 7 m/s on a man, over steps of so many seconds. Walking has 1, running
# 4; a walk told ten times too fast 12, one with shuffled frames 15. Noise of a millimetre moves a marker by 0.05 m/s.
HASTY, STEP = 5.0, 1 / 30
ENTER, LEAVE = 0.5, 1.0              # share of the distance that remains when labels are swapped, and put back


def marker_weights(positions: np.ndarray, targets: np.ndarray, sd: float, outlier: float
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Factors (..., L) on the squared distances of markers, 0 where nothing was seen, and which count: above a quarter.

    Places and targets are (..., L, 3), metres, NaN where a marker was not seen; `sd` and `outlier` as in
    `AnimateConfig`. What is common to all markers does not make an outlier: the body may be a step behind.
    """
    squared, scale = distances_apart(positions, targets, outlier)
    share = np.where(np.isnan(squared), 0.0, (scale**2 / (scale**2 + squared))**2)
    return share / sd**2, share > 0.25


def distances_apart(positions: np.ndarray, targets: np.ndarray, outlier: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances (..., L) without what is common to all, and the length (..., 1) that makes an outlier."""
    off = positions - targets
    off = off - known_median(off, -2)[..., None, :]
    squared = np.einsum("...d,...d->...", off, off)
    # metres; a marker farther off is an outlier on however bad a fit
    return squared, np.maximum(outlier, np.minimum(3 * np.sqrt(known_median(squared)), 5.0))[..., None]


def known_median(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """The median of values that are not NaN, 0 without any; on few values much faster than numpy's."""
    ordered = np.sort(values, axis=axis)                                # NaN comes last
    seen = (~np.isnan(ordered)).sum(axis=axis, keepdims=True)
    low, high = np.maximum((seen - 1) // 2, 0), np.minimum(seen // 2, values.shape[axis] - 1)
    both = np.take_along_axis(ordered, low, axis=axis) + np.take_along_axis(ordered, high, axis=axis)
    return np.where(seen > 0, 0.5 * both, 0.0).squeeze(axis)


def runs(mask: np.ndarray) -> list[np.ndarray]:
    """The stretches (n,) of true values."""
    at = np.flatnonzero(mask)
    return np.split(at, np.flatnonzero(np.diff(at) > 1) + 1) if len(at) else []


def misfit(apart: np.ndarray, outlier: float) -> np.ndarray:
    """(...) how badly markers (..., L), metres off, fit, of 0 to 1; each outlier counts the same."""
    squared = apart**2
    return np.nanmean(squared / (outlier**2 + squared), axis=-1)


def judge(positions: np.ndarray, targets: np.ndarray, order: np.ndarray, outlier: float
          ) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (..., L), metres, of the markers as they came, and which were believed under their own label."""
    residuals = np.linalg.norm(positions - targets, axis=-1)
    squared, scale = distances_apart(positions, targets, outlier)
    return residuals, (squared < scale**2) & (order == np.arange(order.shape[-1]))


def label_order(positions: np.ndarray, targets: np.ndarray, rate: float, outlier: float) -> np.ndarray:
    """Which column (T, L) each marker is taken from, the body having them at places (T, L, 3), by `find_order`."""
    squared, scale = distances_apart(positions, targets, outlier)
    if ((squared > (0.5 * scale)**2).sum(axis=1) < 2).all():            # nothing is far off, or everything is believed
        return np.tile(np.arange(targets.shape[1]), (len(targets), 1))
    shift = known_median(positions - targets, -2)[..., None, :]
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

    def forget(self) -> None:
        """Take the labels as they come."""
        self.order = np.arange(len(self.order))

    def update(self, positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Which column (L,) each marker is taken from, for places on the body and markers as they came (L, 3)."""
        taken = targets[self.order]
        squared, scale = distances_apart(positions, taken, self.outlier)
        suspect = squared > (0.5 * scale)**2                            # never of NaN
        changed = self.order != np.arange(len(self.order))
        if suspect.sum() < 2 and not changed.any():
            return self.order
        shift = known_median(positions - taken, 0)
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


def markers_told(motions: Sequence[Motion]) -> Metric:
    """Over which markers the mean distance of motions of one body is taken."""
    seen = {label for motion in motions for label, column in zip(motion.labels, motion.residuals.T, strict=True)
            if np.isfinite(column).any()}
    out = sorted({label for motion in motions for label in motion.distrusted})
    without = f", without {', '.join(out)}" if out else ""
    return Metric("markers in the mean distance", f"{len(seen) - len(out)} of {len(seen)}{without}")


def hardly_believed(motions: Sequence[Motion]) -> tuple[str, ...]:
    """A reason to look at motions of one body: markers that are distrusted throughout."""
    out = sorted({label for motion in motions for label in motion.distrusted})
    return (f"{', '.join(out)} hardly ever believed: not worn where the layout says, and not in the mean distance",
            ) if out else ()


def hardly_seen(motions: Sequence[Motion]) -> tuple[str, ...]:
    """A reason to look at motions: most of their frames show too few markers to place a body."""
    few = sum(int((np.isfinite(motion.residuals).sum(axis=1) < 3).sum()) for motion in motions)
    frames = sum(len(motion.residuals) for motion in motions)
    return (f"{few} of {frames} frames show fewer than 3 markers: the body there is carried over from the others",
            ) if few > frames / 2 else ()


def judge_motions(person: Judgement, own: Judgement, motions: Sequence[Motion], body: Mesh) -> Judgement:
    """What motions are worth, by themselves and by the `person` that was found from the same markers.

    On a body that is nowhere near its markers, the size of the person is no cause but an effect, and told last.
    """
    return own.joined(person) if mean_off(motions) > HAND * size(body) else person.joined(own)


def mean_off(motions: Sequence[Motion]) -> float:
    """Mean distance of all markers from where the body has them, metres; 0 without any."""
    found = [motion.residuals[np.isfinite(motion.residuals)] for motion in motions]
    return float(np.concatenate(found).mean()) if any(map(len, found)) else 0.0


def motion_doubts(motions: Sequence[Motion], markers: Sequence[MarkerSequence], body: Mesh) -> tuple[str, ...]:
    """Reasons to look at motions of one body, made from markers; `body` is the model's template."""
    reasons = [*hardly_seen(motions), *hardly_believed(motions)]
    off = mean_off(motions)
    if off > DOUBTFUL * size(body):
        reasons.append(f"the markers are {1000 * off:.0f} mm from where the body has them")
    return (*filter(None, (haste(one, body) for one in markers)), *reasons)


def haste(markers: MarkerSequence, body: Mesh) -> str | None:
    """Why markers of a recording cannot have moved so, with the likely cause; None where they can."""
    speed = marker_speed(markers)
    return f"the markers move at {speed:.0f} m/s: frames in another order, or the wrong rate?" \
        if speed > HASTY * size(body) else None


def marker_speed(markers: MarkerSequence) -> float:
    """Median speed of all markers, metres per second, over steps of about a thirtieth of a second."""
    step = max(1, round(markers.rate * STEP))
    moved = np.linalg.norm(markers.positions[step:] - markers.positions[:-step], axis=2)
    known = moved[np.isfinite(moved)]
    return float(np.median(known)) * markers.rate / step if len(known) else 0.0


def motion_problem(motion: Motion, body: Mesh, layout: MarkerLayout, markers: MarkerSequence) -> str | None:
    """Why a motion from markers of a layout means nothing, and the likely cause; `body` is the model's template."""
    seen = np.isfinite(motion.residuals)
    if not seen.any():
        return "no marker of the layout was ever seen: markers of another layout?"
    known = layout.matched(markers.labels, 0)
    columns = [markers.labels.index(label) for label in known]
    spans = [extent(frame) for frame in markers.positions[:: max(1, len(seen) // 50), columns]]
    # the median: a ghost that shows in a few frames has no say in the unit
    wrong = unit_problem(float(np.nanmedian(spans)), extent(layout.select(known).place(body)),
                         "the markers span a box")
    # of the size, 34 mm on a man; good motions 4 to 25, sides swapped 36 to 60
    off, far = float(motion.residuals[seen].mean()), 0.025 * size(body)
    if wrong is None and off <= far:
        return None
    believed = 100 * float(motion.trusted[seen].mean())
    return (f"the markers are {1000 * off:.0f} mm from where the body has them, {100 * motion.converged.mean():.0f}% "
            f"of the frames converged and {believed:.0f}% of the markers are believed; "
            + (wrong or haste(markers, body)
               or "labels mixed up, left and right exchanged, another layout, or another model?"))
