"""What a frame is expected to be before its markers are seen, and how strongly that is believed."""
from __future__ import annotations

from typing import Protocol

import numpy as np

from .marked_body import MarkedBody
from .settings import AnimateConfig

LOOSE = 10.0                         # variance of a prediction from two uncertain frames, against the acceleration's
ACCELERATION = np.array([[0.25, 0.5], [0.5, 1.0]])   # place and velocity after one frame of constant acceleration


class Prediction(Protocol):
    """Expects a frame from those before it; unknowns x (P,) as in `MarkedBody`, the unit of time is a frame."""

    def begin(self, x: np.ndarray) -> None:
        """Start at rest."""
        ...

    def expect(self) -> tuple[np.ndarray, np.ndarray]:
        """Unknowns (P,) of the next frame, and the information (P, P) about them."""
        ...

    def update(self, x: np.ndarray, measured: np.ndarray) -> None:
        """What the next frame has come out as, and the Gauss-Newton matrix (P, P) of its markers alone."""
        ...


def inertia(config: AnimateConfig, rate: float, n_unknowns: int) -> np.ndarray:
    """Information (P,) of the change of velocity from frame to frame."""
    out = np.full(n_unknowns, (config.angle_acceleration / rate**2)**-2)
    out[-3:] = (config.place_acceleration / rate**2)**-2
    return out


class VelocityPrediction:
    """The frame before, moved on at its slowly falling velocity; the same trust in it always.

    Parameters
    ----------
    body : MarkedBody
    config : AnimateConfig
    rate : float, frames per second
    """

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float) -> None:
        self.body, self.momentum = body, config.momentum
        self.information = np.diag(inertia(config, rate, body.n_unknowns) / LOOSE)

    def begin(self, x: np.ndarray) -> None:
        self.x, self.velocity = x, np.zeros_like(x)

    def expect(self) -> tuple[np.ndarray, np.ndarray]:
        return self.body.retract(self.x, self.momentum * self.velocity), self.information

    def update(self, x: np.ndarray, measured: np.ndarray) -> None:
        self.velocity = self.body.step_to(self.x, x)
        self.x = x


class KalmanPrediction:
    """A Kalman filter over turns and velocities, the Gauss-Newton matrix of the markers as information.

    Where markers are missing, what the last ones told about the joints together is not lost at once.

    Parameters
    ----------
    body : MarkedBody
    config : AnimateConfig
    rate : float, frames per second
    """

    def __init__(self, body: MarkedBody, config: AnimateConfig, rate: float) -> None:
        self.body, self.momentum = body, config.momentum
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
        for block, share in ((place, ACCELERATION[0, 0]), (cross, ACCELERATION[0, 1]), (speed, ACCELERATION[1, 1])):
            block[np.diag_indices(len(block))] += share * self.noise
        self._ahead = place, cross, speed
        self._expected = self.body.retract(self.x, m * self.velocity)
        information = np.linalg.inv(place)
        self._information = 0.5 * (information + information.T)
        return self._expected, self._information

    def update(self, x: np.ndarray, measured: np.ndarray) -> None:
        _, cross, speed = self._ahead
        gain = self._information @ cross                                # of the velocity, by the place
        self.velocity = self.momentum * self.velocity + self.body.step_to(self._expected, x) @ gain
        place = np.linalg.inv(self._information + measured)
        self.place = 0.5 * (place + place.T)
        known = self.place @ gain
        speed = speed - cross.T @ gain + gain.T @ known
        self.speed = 0.5 * (speed + speed.T)                            # rounding grows where it is not symmetric
        self.cross = known
        self.x = x


KINDS: dict[str, type[VelocityPrediction] | type[KalmanPrediction]] = {
    "velocity": VelocityPrediction, "kalman": KalmanPrediction}


def make_prediction(body: MarkedBody, config: AnimateConfig, rate: float) -> Prediction:
    """The prediction that the settings name.

    Raises
    ------
    ValueError
        A name that is not known.
    """
    if config.prediction not in KINDS:
        raise ValueError(f"prediction: expected one of {', '.join(KINDS)}, got '{config.prediction}'")
    return KINDS[config.prediction](body, config, rate)
