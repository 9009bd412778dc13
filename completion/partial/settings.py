"""Settings of `complete`."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from model.fitting.settings import ScanFitConfig
from scanprep.ranges import Signed

Method = Literal["joint", "alternation"]


@dataclass(frozen=True)
class CompletionConfig(ScanFitConfig):
    """Settings of `complete`, in addition to those of the fit of a body to a scan.

    Attributes
    ----------
    method : {"joint", "alternation"}
        "joint" solves for all unknowns at once by Levenberg-Marquardt. "alternation" solves for rotations, surface and
        shape in turns, as the paper does; it takes SCAPE models only and has no priors, contact or free space.
    surface_weight : float
        w_Z of [SCAPE] Eq. 10: how strongly each measured point attracts the completed surface.
    viewpoint : (3,) floats, metres, or one for each view, optional
        Position of the camera; estimated when not given.
    free_scale : bool
        The unit of the scan is unknown: one scale factor is estimated together with pose, place and shape.
    fill_colors : bool
        Spread the colours of the scan smoothly over what was not seen, which is grey otherwise.
    tolerance : float, metres
        Distance from the truth within which a vertex counts as right in `Completion.confidence`.

    Examples
    --------
    >>> CompletionConfig(rounds=5).method
    'joint'

    [SCAPE] Eq. 10
    """

    method: Method = "joint"
    surface_weight: float = 1.0
    viewpoint: tuple[Signed, Signed, Signed] | tuple[tuple[Signed, Signed, Signed], ...] | None = None
    free_scale: bool = False
    fill_colors: bool = False
    tolerance: float = 0.01

    @classmethod
    def from_paper(cls) -> CompletionConfig:
        """Return the settings of the paper: correspondences from a few markers, then blocks solved in turns.

        Three things differ from the paper. The initialisation is the best of several, from landmarks, typical poses
        and limbs in other poses. w_Z and w_T, which it does not print, are ours, and distant points count less. Soles
        are pressed onto a scan that ends flat around the feet.

        [SCAPE] §7
        """
        return cls(method="alternation", correspondences=True)
