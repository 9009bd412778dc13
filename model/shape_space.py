"""The space of body shapes: principal components of the shape deformation S."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh

AT_ONCE = 20_000                     # entries of S that are worked on together, so that they stay in the cache


@dataclass(frozen=True, eq=False)
class ShapeSpace:
    """S of every triangle: mean (F, 3, 3), plus components (K, F, 3, 3) for one standard deviation of each beta.

    `variances` (K,) are those of S over the training set along the components, largest first; `total_variance` is in
    all directions.

    [SCAPE] Eq. 7
    """

    mean: np.ndarray
    components: np.ndarray
    variances: np.ndarray
    total_variance: float

    @property
    def count(self) -> int:
        """K, the number of components."""
        return len(self.components)

    @property
    def explained(self) -> np.ndarray:
        """(K,) share of the total variance that the first 1..K components explain."""
        return np.cumsum(self.variances) / max(self.total_variance, np.finfo(float).tiny)

    def gradients(self, betas: np.ndarray | None) -> np.ndarray:
        """Compute S (F, 3, 3) of betas (k,), k ≤ K, in standard deviations; None is the template's own body, S = I.

        [SCAPE] Eq. 7
        """
        if betas is None:
            return np.broadcast_to(np.eye(3), self.mean.shape).copy()
        betas = np.asarray(betas, dtype=np.float64)
        self._check(betas, 1)
        S = self.mean.ravel().astype(np.float64)
        U = self.components[:len(betas)].reshape(len(betas), S.size)
        for start in range(0, S.size, AT_ONCE):
            S[start:start + AT_ONCE] += betas @ U[:, start:start + AT_ONCE].astype(np.float64)
        return S.reshape(self.mean.shape)

    def _check(self, betas: np.ndarray, dimensions: int) -> None:
        """Raise ValueError for betas (..., k) that this space does not have."""
        if betas.ndim != dimensions or betas.shape[-1] > self.count:
            raise ValueError(f"betas: expected at most {self.count} numbers, got shape {betas.shape}")
        if not np.isfinite(betas).all():
            raise ValueError("betas: expected finite numbers")

    def betas_of(self, S: np.ndarray) -> np.ndarray:
        """Project shape deformations (P, F, 3, 3) onto the components, which are orthogonal: betas (P, K).

        [SCAPE] Eq. 7
        """
        flat = self.components.reshape(self.count, self.mean.size)
        return np.stack([flat @ (one - self.mean).ravel() for one in S]) / (flat**2).sum(axis=1)

    def first(self, count: int | None) -> ShapeSpace:
        """Keep the first `count` components; None keeps all."""
        return ShapeSpace(self.mean, self.components[:count], self.variances[:count], self.total_variance)

    @staticmethod
    def empty(n_faces: int) -> ShapeSpace:
        """Build the space without components: only the template's own body."""
        mean = np.broadcast_to(np.eye(3, dtype=np.float32), (n_faces, 3, 3)).copy()
        return ShapeSpace(mean, np.zeros((0, n_faces, 3, 3), dtype=np.float32), np.zeros(0), 0.0)


def body_volumes(template: Mesh, bodies: np.ndarray) -> np.ndarray:
    """Compute the volumes (P,) of bodies (P, N, 3), cubic metres; of a body with holes, about its centroid."""
    return np.array([template.with_vertices(body - body.mean(axis=0)).volume for body in bodies])


def learn_shape_space(S: np.ndarray, components: int, volumes: np.ndarray | None = None) -> ShapeSpace:
    """Compute principal components of shape deformations (P, F, 3, 3), fewer where the people do not span as many.

    The sign of a component is free. With the volumes (P,) of the people it is chosen so that a positive beta means more
    volume.

    [SCAPE] Eq. 7
    """
    P, mean = len(S), S.mean(axis=0, dtype=np.float64)
    more = None if volumes is None else volumes - volumes.mean()
    return principal_shapes(mean, S - mean, P, min(components, P - 1), more)


def principal_shapes(mean: np.ndarray, off: np.ndarray, count: float, components: int,
                     volumes: np.ndarray | None = None) -> ShapeSpace:
    """Compute principal components from deviations (R, F, 3, 3) whose products sum to `count` times the covariance.

    `volumes` (R,) are deviations of the volume; they choose the signs as in `learn_shape_space`.

    [SCAPE] Eq. 7
    """
    rows = off.reshape(len(off), -1)
    # R deviations are far fewer than 9F entries: PCA by the small Gram matrix (R, R)
    gram = np.asarray(rows @ rows.T, dtype=np.float64) / count
    variances, modes = np.linalg.eigh(gram)
    variances, modes = np.maximum(variances[::-1], 0), modes[:, ::-1]
    # directions with no variance but rounding are no components
    K = min(components, int((variances > 1e-9 * max(variances[0], 1e-30)).sum()))
    # unit variance of betas: component k is one standard deviation, Σ_p modes[p, k] off[p] / √count
    directions = modes[:, :K].T.astype(rows.dtype) @ rows / np.sqrt(count)
    if volumes is not None:
        directions *= np.where(volumes @ modes[:, :K] < 0, -1, 1)[:, None]
    return ShapeSpace(mean.astype(np.float32), directions.reshape(K, *mean.shape).astype(np.float32),
                      variances[:K], float(variances.sum()))


def add_people(S: np.ndarray, volumes: np.ndarray, prior: np.ndarray, prior_volumes: np.ndarray, worth: float,
               components: int) -> ShapeSpace:
    """Compute principal components of people together with a prior that counts as `worth` people.

    Mean and covariance are the posterior ones of a normal-inverse-Wishart prior.

    Parameters
    ----------
    S : (P, F, 3, 3) float
        Shape deformations of the people, of whom there may be none.
    volumes : (P,) float, cubic metres
        Volumes of the people.
    prior : (1 + K, F, 3, 3) float
        The prior's mean person, then the body one standard deviation along each of its components.
    prior_volumes : (1 + K,) float, cubic metres
        Volumes of the same bodies.
    worth : float
        The prior counts as so many people.
    components : int
        Most components to keep.

    Returns
    -------
    ShapeSpace

    [SCAPE] Eq. 7
    """
    P, known = len(S), prior[0].astype(np.float64)
    own = S.mean(axis=0, dtype=np.float64) if P else known
    mean = (P * own + worth * known) / (P + worth)
    apart, volume = np.sqrt(P * worth / (P + worth)), float(volumes.mean()) if P else float(prior_volumes[0])
    # deviations whose products sum to the scatter: people from their mean, prior components, and mean from mean
    off = np.concatenate([S - own, np.sqrt(worth) * (prior[1:] - known), apart * (own - known)[None]])
    of_volume = np.r_[volumes - volume, np.sqrt(worth) * (prior_volumes[1:] - prior_volumes[0]),
                      apart * (volume - prior_volumes[0])]
    return principal_shapes(mean, off.astype(np.float32), P + worth, components, of_volume)
