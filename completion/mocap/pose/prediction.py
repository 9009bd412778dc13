"""What a frame is expected to be before its markers are seen, and how strongly that is believed.

Unknowns x (P,) are those of `MarkedBody`, the unit of time is a frame. A prediction begins at rest; `expect` gives the
next frame and the information (P, P) about it, `update` takes what it came out as and the Gauss-Newton matrix (P, P) of
its markers alone.
"""
from __future__ import annotations

import numpy as np

from .marked_body import MarkedBody
from .settings import AnimateConfig
from .smooth import inertia

LOOSE = 10.0                         # variance of a prediction from two uncertain frames, against the acceleration's


class VelocityPrediction:
    """The frame before, moved on at its slowly falling velocity; the same trust in it always."""

    momentum = 0.95                  # share of the velocity that is kept

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float) -> None:
        self.body = body
        self.information = np.diag(inertia(config, rate, body.n_unknowns) / LOOSE)

    def begin(self, x: np.ndarray) -> None:
        self.x, self.velocity = x, np.zeros_like(x)

    def expect(self) -> tuple[np.ndarray, np.ndarray]:
        return self.body.retract(self.x, self.momentum * self.velocity), self.information

    def update(self, x: np.ndarray, measured: np.ndarray) -> None:
        self.velocity = self.body.step_to(self.x, x)
        self.x = x


class KalmanPrediction:
    """A Kalman filter over rotations and velocities, the Gauss-Newton matrix of the markers as information.

    Where markers are missing, what the last ones told about the joints together is not lost at once.
    """

    momentum = VelocityPrediction.momentum

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float) -> None:
        self.body = body
        self.noise = 1 / inertia(config, rate, body.n_unknowns)

    def begin(self, x: np.ndarray) -> None:
        self.x, self.velocity = x, np.zeros_like(x)
        self.place = np.diag(LOOSE * self.noise)                       # covariances (P, P) of place, both, velocity
        self.cross = 0 * self.place
        self.speed = np.diag(LOOSE * self.noise)

    def expect(self) -> tuple[np.ndarray, np.ndarray]:
        m = self.momentum
        kept = m * m * self.speed
        place = self.place + m * (self.cross + self.cross.T) + kept
        cross, speed = m * self.cross + kept, kept
        for block, share in ((place, 0.25), (cross, 0.5), (speed, 1.0)):  # after one frame of constant acceleration
            block[np.diag_indices(len(block))] += share * self.noise
        self._ahead = cross, speed
        self._expected = self.body.retract(self.x, m * self.velocity)
        information = np.linalg.inv(place)
        self._information = 0.5 * (information + information.T)
        return self._expected, self._information

    def update(self, x: np.ndarray, measured: np.ndarray) -> None:
        cross, speed = self._ahead
        gain = self._information @ cross                                # of the velocity, by the place
        self.velocity = self.momentum * self.velocity + self.body.step_to(self._expected, x) @ gain
        place = np.linalg.inv(self._information + measured)
        self.place = 0.5 * (place + place.T)
        known = self.place @ gain
        speed = speed - cross.T @ gain + gain.T @ known
        self.speed = 0.5 * (speed + speed.T)                            # rounding grows where it is not symmetric
        self.cross = known
        self.x = x


def prediction_of(body: MarkedBody, config: AnimateConfig, rate: float) -> VelocityPrediction | KalmanPrediction:
    """The prediction that the settings name."""
    kinds: dict[str, type[VelocityPrediction] | type[KalmanPrediction]] = {
        "velocity": VelocityPrediction, "kalman": KalmanPrediction}
    if config.prediction not in kinds:
        raise ValueError(f"prediction: expected one of {', '.join(kinds)}, got '{config.prediction}'")
    return kinds[config.prediction](body, config, rate)
