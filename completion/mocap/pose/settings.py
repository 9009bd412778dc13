"""What may be chosen when markers are followed."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from scanprep.ranges import FLAG, Positive, Settings, Share, Signed

from ...smoothing import inertia

RATE = 120.0                         # frames per second for which the weight of the velocity is meant


@dataclass(frozen=True)
class AnimateConfig(Settings):
    """Settings of `animate` and `MarkerStream`.

    Attributes
    ----------
    marker_sd : float, metres
        How far a marker lies from where the body would put it.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight, at least; on a body that fits badly
        it is three times the median residual.
    prior_weight : float
        Factor on the pose prior: small, it speaks for joints that no marker sees.
    prior_shrinkage : float in [0, 1]
        See `gaussian_prior`.
    angle_acceleration : float, radians per second squared
        How strongly joints accelerate, as a standard deviation.
    place_acceleration : float, metres per second squared
        The same for the place.
    smoothing : int
        Rounds over the whole sequence; 0 leaves the frame-by-frame solution.
    low_pass : float, hertz
        Cut-off of a Butterworth filter without lag on the result; 0 is none.
    ground : bool
        Feet do not sink into the floor and do not slide while they stand on it.
    floor : four numbers, optional
        A unit normal that points up, and the height of the floor along it, metres; else both come from the motion.
    """

    marker_sd: Positive = 0.01
    outlier: Positive = 0.06
    prior_weight: float = 0.3
    prior_shrinkage: Share = 0.3
    angle_acceleration: Positive = 60.0
    place_acceleration: Positive = 15.0
    smoothing: int = 2
    low_pass: float = 0.0
    ground: Annotated[bool, FLAG] = False
    floor: tuple[Signed, Signed, Signed, Signed] | None = None

    def inertia(self, rate: float, n_unknowns: int) -> np.ndarray:
        """Information (P,) of the change of velocity from frame to frame."""
        return inertia(n_unknowns, rate, self.angle_acceleration, self.place_acceleration)
