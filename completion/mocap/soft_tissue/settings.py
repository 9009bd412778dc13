"""Settings of soft tissue. [MoSh] Eq. 24"""
from __future__ import annotations

from dataclasses import dataclass

from scanprep.ranges import Positive, Settings


@dataclass(frozen=True)
class SoftTissueConfig(Settings):
    """Settings of `follow_soft_tissue`.

    Weights stand on squared centimetres, as in the paper, whose own are `published()`. They are those by which the
    poses were found before, see `MoshConfig`.

    Attributes
    ----------
    data : float
        Weight of the markers against their simulation, when poses are found.
    pose : float
        Weight of the pose prior; the paper's is 1.
    velocity : float
        Weight of the squared change of velocity from frame to frame, 120 frames a second; the paper's is 6.25.
    marker_sd : float, metres
        How far a marker lies from where the moving skin has it: what cameras are off.
    reach : float, metres
        Along the skin: where the movement of two points is correlated by 0.6.
    temporal_smoothness : float
        Weight of the squared second difference of the movement from frame to frame, 120 frames a second, against that
        of the movement itself.
    shape_change : float
        Weight of the squared change of the betas from the person's own, the paper's is 0.25: the betas change in every
        frame, as in the paper. 0: the skin moves instead, as `marker_sd`, `reach` and `temporal_smoothness` say.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight.
    """

    data: Positive = 2.0
    pose: float = 0.3
    velocity: Positive = 57600.0
    marker_sd: Positive = 0.001
    reach: Positive = 0.09
    temporal_smoothness: float = 2.0
    shape_change: float = 0.0
    outlier: Positive = 0.06

    @classmethod
    def published(cls) -> SoftTissueConfig:
        """The weights of [MoSh] Eq. 24, whose betas change in every frame."""
        return cls(data=0.75, pose=1.0, velocity=6.25, outlier=1000.0, shape_change=0.25)
