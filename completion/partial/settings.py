"""Settings of `complete`."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from model.fitting.settings import ScanFitConfig
from scanprep.ranges import Signed

Method = Literal["joint", "alternation"]


@dataclass(frozen=True)
class CompletionConfig(ScanFitConfig):
    """Settings of `complete`; those of bringing the body to the scan, and more.

    Attributes
    ----------
    method : {"joint", "alternation"}
        All unknowns at once by Levenberg-Marquardt, or rotations, surface and shape in turns as the paper does; the
        latter takes SCAPE models only, and neither priors, contact nor free space.
    surface_weight : float
        w_Z of Eq. 10: how strongly each measured point draws the completed surface.
    viewpoint : (3,) floats, metres, or one for each view, optional
        Where the scan was seen from; found by itself when not given.
    free_scale : bool
        The unit of the scan is not known: one factor is found together with pose, place and shape.
    fill_colors : bool
        The colours of a scan are spread over what was not seen, which else is grey.
    tolerance : float, metres
        Distance from the truth within which a vertex counts as right in `Completion.confidence`.
    """

    method: Method = "joint"
    surface_weight: float = 1.0
    viewpoint: tuple[Signed, Signed, Signed] | tuple[tuple[Signed, Signed, Signed], ...] | None = None
    free_scale: bool = False
    fill_colors: bool = False
    tolerance: float = 0.01

    @classmethod
    def from_paper(cls) -> CompletionConfig:
        """The paper's way: a few markers become correspondences, then rotations, surface and shape in turns.

        Not as in the paper: the start is the best of several, from landmarks, typical poses and limbs held otherwise.
        w_Z and w_T, which it does not print, are ours, and points that lie far from the body count less. Soles are
        pressed to a scan that ends flat around the feet.

        [SCAPE] §7
        """
        return cls(method="alternation", correspondences=True)
