"""How far each vertex of a completed mesh may be from the truth."""
from __future__ import annotations

import numpy as np
from scipy.special import gammainc

from model.fitting.bodies import FixedBody
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh

# Chosen so that the stated probabilities fit best (least Brier score at 5, 10, 20 and 40 mm) on completed half views
# of tuning bodies: 14 poses of a known man and 7 men of unknown shape, none of which the models were learned from.
BEYOND = 0.0075                      # metres: what the model cannot explain far from all data, and its share of the
LEFT_OUT = 0.85                      # error of poses that were left out of learning, where that is known


def posterior_error(body: FixedBody, x: np.ndarray, precision: np.ndarray) -> np.ndarray:
    """Standard deviation (N,), metres, of every vertex of the predicted mesh.

    The covariance of the unknowns, the inverse of the Gauss-Newton matrix with all priors in it (Laplace's
    approximation), is pushed through the derivatives of the vertices: what the data leave open in the pose shows in
    the hand that nobody saw.

    `x` (P,); `precision` (P, P).
    """
    ridge = 1e-9 * np.diag(precision).max()
    root = np.linalg.inv(np.linalg.cholesky(precision + ridge * np.eye(len(x))))      # rootᵀ root is the covariance
    ids = np.arange(len(body.template.vertices))
    spread = root @ body.near(ids, x).columns(x)[1].reshape(len(x), -1)
    return np.sqrt(np.einsum("pi,pi->i", spread, spread).reshape(3, -1).sum(axis=0))


def distance_to_seen(mesh: Mesh, seen: np.ndarray) -> np.ndarray:
    """Way (N,), metres, along the surface from every vertex to the nearest one that was seen; inf where none leads."""
    if not seen.any():
        return np.full(len(mesh.vertices), np.inf)
    return SurfaceGraph(mesh).nearest(np.flatnonzero(seen))[0]


def estimate_error(posterior: np.ndarray, away: np.ndarray, rms: float, left_out: float | None = None) -> np.ndarray:
    """Root mean square distance (N,), metres, of vertices from the truth.

    Where the scan was, that is the distance to the true surface, and as large as the scan's own from the completed
    mesh. Away from it two things add up, as squares: what pose and shape leave open, and what no pose and shape of
    the model can follow. Near the scan the free surface carries the data over, so both set in gradually.

    `posterior` (N,), metres, see `posterior_error`; `away` (N,), metres, distance from what was seen, along the
    surface; `rms`, metres, distance of the scan points that were used to the completed mesh; `left_out`, metres, what
    the model said of poses that it was not learned from, where that is known.
    """
    beyond = BEYOND if left_out is None else LEFT_OUT * left_out
    # metres along the surface from the data, within which errors set in
    sets_in = 1 - np.exp(-away / 0.014)
    # metres: no scan is better
    near = max(0.0005, 0.0 if np.isnan(rms) else rms)
    # real errors against those that the fit believes in, as it is not quite linear
    return np.sqrt(near**2 + sets_in * ((1.4 * posterior)**2 + beyond**2))


def probability_within(error: np.ndarray, tolerance: float) -> np.ndarray:
    """Probability (N,) that a vertex is within a tolerance of the truth, metres, when its error (N,) is as expected.

    The error is taken as Gaussian and alike in all three directions.
    """
    return np.asarray(gammainc(1.5, 1.5 * (tolerance / error)**2))
