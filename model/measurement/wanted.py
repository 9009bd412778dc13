"""The most probable body with given measurements."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ..body import BodyModel
from .catalogue import CATALOGUE, named
from .measure import measure
from .tapes import Tapes

EXACT = 2e-4                         # metres: a measurement that is met


@dataclass(frozen=True, eq=False)
class WantedBody:
    """The body of `body_with_measurements`.

    Attributes
    ----------
    betas : (K,) float, standard deviations
    vertices : (N, 3) float, metres
        In the pose of the template.
    wanted, reached : dict of name to float, metres
    deviations : float
        How far the body is from the mean person, standard deviations.
    rarer : float
        Share of people who are as far from the mean, or farther, in what was asked for.
    """

    betas: np.ndarray
    vertices: np.ndarray
    wanted: dict[str, float]
    reached: dict[str, float]
    deviations: float
    rarer: float

    @property
    def missed(self) -> dict[str, float]:
        """Metres between what was reached and what was wanted, where they are apart."""
        return {name: self.reached[name] - value for name, value in self.wanted.items()
                if abs(self.reached[name] - value) > EXACT}


def checked_wanted(given: Mapping[str, float]) -> dict[str, float]:
    """Metres by names of the catalogue, of a user's words; ValueError for what is unknown or no person has."""
    wanted = dict[str, float]()
    for word, value in given.items():
        for name in named(word):
            low, high = CATALOGUE[name].low, CATALOGUE[name].high
            if not low <= value <= high:
                raise ValueError(f"{word}={value:g}: expected {low:g} to {high:g} m, which people measure there")
            wanted[name] = float(value)
    if not wanted:
        raise ValueError("expected at least one measurement, such as stature=1.80")
    return wanted


def body_with_measurements(model: BodyModel, tapes: Tapes, given: Mapping[str, float]) -> WantedBody:
    """The body nearest to the mean person that has some measurements: the most probable one.

    Betas of least norm under linear conditions, with the derivative of every measurement made anew where the body is,
    until they are met (Gauss-Newton). Measurements that contradict each other, or the model, are met as nearly as
    they can be.

    Parameters
    ----------
    model : BodyModel
        With shape components.
    tapes : Tapes
        Of its template.
    given : name to float, metres
        `waist` means the waist girth, `thigh` that of both thighs.

    Raises
    ------
    ValueError
        A model without shape components, a measurement that is unknown, that the template does not have, or that no
        person has.
    """
    from scipy.stats import chi2

    if not model.n_betas:
        raise ValueError("model: it has no shape components, so it has one body only")
    wanted = checked_wanted(given)
    lacking = [f"{name}: {tapes.missing.get(name, 'not found on the template')}" for name in wanted
               if name not in tapes.found]
    if lacking:
        raise ValueError(f"cannot be measured on this template: {'; '.join(lacking)}")
    pose = np.zeros((len(model.skeleton.parents), 3))
    moves = model.shape_jacobian(pose)                                     # the same for all betas
    base = model.vertices(pose, np.zeros(model.n_betas))
    goal = np.array(list(wanted.values()))

    def readings_at(betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What is measured there, and its derivative by the betas."""
        found = measure(base + moves @ betas, tapes, tapes.axes, only=wanted)
        for name in wanted:
            if name not in found.readings:
                raise ValueError(f"{name}: cannot be measured on the body with these measurements: "
                                 f"{found.missing[name]}")
        return (np.array([found.values[name] for name in wanted]),
                np.stack([found.readings[name].along(moves) for name in wanted]))

    betas, best, least = np.zeros(model.n_betas), np.zeros(model.n_betas), np.inf
    for _ in range(40):
        values, slopes = readings_at(betas)
        off = goal - values
        if np.abs(off).max() < least:
            best, least = betas, float(np.abs(off).max())
        if np.abs(off).max() < 0.1 * EXACT:
            break
        ahead = slopes.T @ np.linalg.solve(slopes @ slopes.T + (0.1 * EXACT)**2 * np.eye(len(goal)),
                                           off + slopes @ betas)
        # 8 standard deviations, of all betas together: what no model is asked to reach
        ahead *= min(1.0, 8.0 / max(float(np.linalg.norm(ahead)), 1e-12))
        step = ahead - betas
        betas = betas + step * min(1.0, 3.0 / max(float(np.linalg.norm(step)), 1e-12))
    (values, slopes), far = readings_at(best), float(np.linalg.norm(best))
    free = int(np.linalg.matrix_rank(slopes, tol=0.05 * np.linalg.norm(slopes, 2)))     # left and right say the same
    return WantedBody(best, base + moves @ best, wanted, dict(zip(wanted, values.tolist(), strict=True)), far,
                      float(chi2.sf(far**2, free)))
