"""Whose body it is: betas from the markers of some frames."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points
from scanprep.ranges import Count, Positive, Settings, Share

from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from .shape_fit import ShapeFit

Progress = Callable[[int, int], None]
CANDIDATES = 400                     # frames among which those to use are chosen
ROUNDS = 4                           # of weighing outliers anew
LOOK = (1, 3)                        # before these rounds loose markers are looked for


@dataclass(frozen=True)
class MarkerShapeConfig(Settings):
    """Settings of `subject_from_markers`.

    Attributes
    ----------
    n_betas : int
        Betas that are looked for, at most; the others stay zero. Markers sit a centimetre or two from where the
        layout has them, which many betas would take for shape.
    frames : int
        Frames that are used, spread over the poses of the sequence.
    marker_sd : float, metres
        How far a marker lies from where the body would put it.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight.
    shape_weight : float
        Factor on the squared length of the betas.
    prior_weight : float
        Factor on the pose prior.
    prior_shrinkage : float in [0, 1]
        See `gaussian_prior`.
    start_axes : int
        Directions of the training poses along which the pose of each frame is searched.
    iterations : int
        Most steps of the joint solution, for each weighing of outliers.
    loose_reach : float, metres
        How far from its usual place a marker is looked for that the layout calls loose; 0 leaves it there.
    """

    n_betas: int = 40
    frames: Count = 12
    marker_sd: Positive = 0.01
    outlier: Positive = 0.06
    shape_weight: float = 1.0
    prior_weight: float = 0.3
    prior_shrinkage: Share = 0.3
    start_axes: int = 6
    iterations: Count = 12
    loose_reach: float = 0.2


@dataclass(frozen=True, eq=False)
class MarkerSubject:
    """The shape of a person who carries markers.

    Attributes
    ----------
    betas : (k,) float
    frames : (B,) int
        Those that were used.
    poses : (B, J, 3) float, radians
        In these frames.
    trans : (B, 3) float, metres
    residuals : (B, L) float, metres
        Distance of each marker of the sequence from where the body puts it, NaN where it counted nothing.
    labels : L strings
    layout : MarkerLayout
        The one that was given, loose markers where they are on this person.
    converged : bool
    iterations : int
    """

    betas: np.ndarray
    frames: np.ndarray
    poses: np.ndarray
    trans: np.ndarray
    residuals: np.ndarray
    labels: tuple[str, ...]
    layout: MarkerLayout
    converged: bool
    iterations: int

    @property
    def residual(self) -> float:
        """The mean distance, metres."""
        return float(np.nanmean(self.residuals))


def subject_from_markers(model: BodyModel, markers: MarkerSequence, layout: MarkerLayout,
                         config: MarkerShapeConfig | None = None, progress: Progress | None = None) -> MarkerSubject:
    """The betas with which a body carries the markers of a sequence best, in any of its poses.

    Frames are chosen by farthest points among the poses; betas, common to them, and the pose and place of each
    are solved for together by Levenberg-Marquardt, without touching the mesh. A marker that sits elsewhere than
    in the layout does so in all frames, so betas are held to zero as if there were one frame.

    Parameters
    ----------
    model : BodyModel
    markers : MarkerSequence
    layout : MarkerLayout
        On the model's template. Markers that only one of the two knows are left out.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    ValueError
        A model without betas, fewer than 3 markers in common, no frame with 3 of them, a layout of another body.

    [SCAPE] §8
    """
    config = config or MarkerShapeConfig()
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    labels = layout.matched(markers.labels)
    columns = [markers.labels.index(label) for label in labels]
    chosen = spread_frames(markers.positions[:, columns], config.frames)
    fit = ShapeFit(model, layout.select(labels), markers.positions[chosen][:, columns], config)
    total = len(chosen) + ROUNDS
    tell = progress or (lambda done, total: None)
    start = fit.starts(lambda done: tell(done, total))
    x, steps = start, 0
    for i in range(ROUNDS):
        if i in LOOK:
            fit.find_loose(x)
        x, converged, taken = fit.joint(x)
        steps += taken
        tell(len(chosen) + i + 1, total)
    residuals = np.full((len(chosen), len(markers.labels)), np.nan)
    residuals[:, columns] = np.linalg.norm(fit.markers(x).positions - fit.targets, axis=2)
    pose, trans, _ = fit.body.split(x)
    return MarkerSubject(x[0, -fit.n_betas:].copy(), chosen, rotations.log(rotations.exp(pose)), trans.copy(),
                         residuals, markers.labels, layout.moved(fit.found), converged, steps)


def spread_frames(positions: np.ndarray, count: int) -> np.ndarray:
    """Frames (B,) in which the markers (T, L, 3) are well seen and stand to each other in many ways.

    The first is the most usual one; each further one is farthest from those before, by the distances between
    markers.

    Raises
    ------
    ValueError
        No frame with at least 3 markers.
    """
    seen = (~np.isnan(positions[..., 0])).sum(axis=1)
    if seen.max(initial=0) < 3:
        raise ValueError(f"markers: expected a frame with at least 3 known markers, the best has "
                         f"{seen.max(initial=0)}")
    good = np.flatnonzero(seen >= max(3, 0.9 * seen.max()))
    good = good[np.unique(np.linspace(0, len(good) - 1, CANDIDATES).round().astype(int))]
    first, second = np.triu_indices(positions.shape[1], 1)
    apart = np.linalg.norm(positions[good][:, first] - positions[good][:, second], axis=2)
    there = ~np.isnan(apart)
    middle = np.where(there, apart, 0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    apart = np.where(there, apart - middle, 0)
    return good[np.sort(farthest_points(apart, count, np.argmin((apart**2).sum(axis=1))))]
