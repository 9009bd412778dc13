"""What may be chosen when marker sets are designed."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from scanprep.ranges import Count, Positive, Settings, Share

Direction = Literal["both", "remove", "add"]


@dataclass(frozen=True)
class DesignConfig(Settings):
    """Settings of `design_markers`.

    Eq. 26 has no prior; without one fewer markers than a third of the unknowns have no answer. So betas are held to
    the mean person and poses to the usual ones, as far as `marker_sd` lets them.

    Attributes
    ----------
    count : int
        Markers of the set that is wanted.
    through : ints
        Further counts at which the curve must have a set of just that size; pairs go two at a time.
    direction : "both", "remove" or "add"
        Take markers away, begin with none, or do both and keep the better set.
    n_betas : int, optional
        Betas that are estimated, the first ones; all when not given.
    joint : bool
        Betas are common to the bodies of a person; else each body is estimated by itself, as in the paper.
    marker_sd : float, metres
        How far a marker may lie from where the body would put it.
    shape_weight : float
        Factor on the squared length of the betas.
    prior_weight : float
        Factor on the pose prior.
    prior_shrinkage : float in [0, 1]
        See `gaussian_prior`.
    surface : int
        Vertices, well spread, that stand for all of them while sets are compared, each for those nearest to it.
    fit_surface : int
        The same for the first fit of the model to each whole body.
    fit_iterations : int
        Most steps of that fit, and of a full refit.
    exchanges : int
        Rounds in which each marker of the set, or pair, is tried against those left out.
    checks : ints
        Counts at which the set of the curve is estimated again without linearising.
    """

    count: Count = 47
    through: tuple[Count, ...] = ()
    direction: Direction = "both"
    n_betas: int | None = None
    joint: bool = False
    marker_sd: Positive = 0.005
    shape_weight: float = 1.0
    prior_weight: float = 1.0
    prior_shrinkage: Share = 0.3
    surface: Count = 1000
    fit_surface: Count = 400
    fit_iterations: Count = 20
    exchanges: int = 1
    checks: tuple[Count, ...] = ()
