"""Which frames of a motion tell most about the shape of the person who moves."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.body import BodyModel
from model.priors import gaussian_prior
from scanprep.ranges import Count, Positive, Settings, Share

from ..marker_sets.layout import MarkerLayout
from .linear import support
from .points import BodyPoints


@dataclass(frozen=True)
class FrameConfig(Settings):
    """Settings of `informative_frames`.

    Attributes
    ----------
    n_betas : int
        Betas that are looked for, at most.
    marker_sd : float, metres
        How far a marker is from where the body puts it, anew in every frame.
    place_sd : float, metres
        How far it sits from its usual place, the same in all frames; 0 if that is known.
    prior_weight : float
        Factor on the pose prior.
    prior_shrinkage : float in [0, 1]
        See `gaussian_prior`.
    candidates : int
        Frames that are looked at, at most, evenly spaced.
    """

    n_betas: int = 40
    marker_sd: Positive = 0.005
    place_sd: float = 0.01
    prior_weight: float = 1.0
    prior_shrinkage: Share = 0.3
    candidates: Count = 120


class FrameInformation:
    """What each frame tells of what is the same in all of them: betas, and where each marker really sits.

    Unknowns c are the betas and, in the frame of the part that carries it, the offset of each marker from its usual
    place. The pose of a frame is eliminated: with A, D the derivatives by pose and by c, over the standard deviation
    of a marker, the frame adds `Dᵀ (I - A (AᵀA + Λ)⁻¹ Aᵀ) D` to what is known.

    Parameters
    ----------
    model : BodyModel
        With betas.
    poses : (T, J, 3) float, radians
        Roughly.
    layout : MarkerLayout
    betas : (k,) float, optional
        The body, roughly; else the mean person.
    seen : (T, L) bool, optional
        Which markers of the layout are seen in which frame; else all.
    config : FrameConfig, optional
    """

    def __init__(self, model: BodyModel, poses: np.ndarray, layout: MarkerLayout, betas: np.ndarray | None = None,
                 seen: np.ndarray | None = None, config: FrameConfig | None = None) -> None:
        config = config or FrameConfig()
        poses, K, L = _checked(model, poses, layout, seen), min(config.n_betas, model.n_betas), len(layout.labels)
        ids, weights = support(layout)
        points = BodyPoints(model.points(ids, weights, K))
        x = np.zeros((len(poses), points.n_unknowns))
        x[:, :points.n_angles] = poses.reshape(len(poses), -1)
        if betas is not None:
            x[:, points.n_angles + 3:][:, :len(betas)] = betas[:K]
        carrier = model.skeleton.part_of_vertex(model.template)[ids[np.arange(L), weights.argmax(axis=1)]]
        prior = gaussian_prior(model.pose_mean, model.pose_covariance, config.prior_shrinkage)
        own = np.zeros((points.n_angles + 3, points.n_angles + 3))
        n = len(prior.mean)
        own[:n, :n] = config.prior_weight * prior.whitening.T @ prior.whitening
        own[np.r_[:3, n:n + 3], np.r_[:3, n:n + 3]] += 1.0           # one place or another, to a metre and a radian
        places = 3 * L if config.place_sd else 0
        self.known = np.diag(np.r_[np.ones(K), np.full(places, 1 / max(config.place_sd, 1e-9)**2)])
        self.each = np.empty((len(poses), K + places, K + places))
        for t in range(len(poses)):
            J = points.follow(x[t:t + 1]).jacobian[0]
            turn = model.skeleton.part_rotations(poses[t])[carrier]
            D = np.zeros((L, 3, K + places))
            D[..., :K] = J[..., points.n_angles + 3:]
            if places:
                D[:, :, K:].reshape(L, 3, L, 3)[np.arange(L), :, np.arange(L)] = turn
            there = np.ones(L) if seen is None else seen[t]
            scale = (there / config.marker_sd)[:, None, None]
            A, B = ((scale * a).reshape(3 * L, -1) for a in (J[..., :points.n_angles + 3], D))
            AtB = A.T @ B
            self.each[t] = B.T @ B - AtB.T @ np.linalg.solve(A.T @ A + own, AtB)
        change = model.shape_jacobian(model.pose_mean)[..., :K]
        change = (change - change.mean(axis=0)).reshape(-1, K)
        self._root = np.zeros((K + places, K))
        values, vectors = np.linalg.eigh(change.T @ change / len(model.template.vertices))
        self._root[:K] = vectors * np.sqrt(np.maximum(values, 0))

    def expected_error(self, frames: np.ndarray | list[int]) -> float:
        """Root mean squared distance of the surface that these frames leave by what betas stay unknown, metres."""
        return float(np.sqrt(self._left((self.known + self.each[frames].sum(axis=0))[None])[0]))

    def best(self, count: int, among: np.ndarray) -> np.ndarray:
        """(count,) frames, the next always the one that leaves the least error with those before."""
        chosen: list[int] = []
        now = self.known.copy()
        while len(chosen) < min(count, len(among)):
            open_ = np.setdiff1d(among, chosen)
            chosen.append(int(open_[np.argmin(self._left(now + self.each[open_]))]))
            now += self.each[chosen[-1]]
        return np.array(chosen)

    def _left(self, information: np.ndarray) -> np.ndarray:
        """Expected mean squared distance for informations (n, c, c): the trace of covariance and surface."""
        solved = np.linalg.solve(information, np.broadcast_to(self._root, (len(information), *self._root.shape)))
        return np.asarray((solved * self._root).sum(axis=(-1, -2)))


def informative_frames(model: BodyModel, poses: np.ndarray, layout: MarkerLayout, count: int,
                       betas: np.ndarray | None = None, seen: np.ndarray | None = None,
                       config: FrameConfig | None = None) -> np.ndarray:
    """The frames from which the shape of a person can be told best, the most telling first.

    Chosen one after the other, so that the surface that is expected from all of them together is nearest to the true
    one (A-optimal), with poses and the places of the markers unknown.

    Parameters
    ----------
    model : BodyModel
        With betas.
    poses : (T, J, 3) float, radians
        Roughly; those of the mean person will do.
    layout : MarkerLayout
    count : int
    betas : (k,) float, optional
        The body, roughly; else the mean person.
    seen : (T, L) bool, optional
        Which markers of the layout are seen in which frame; else all.
    config : FrameConfig, optional

    Returns
    -------
    (count,) int
        Fewer where there are fewer frames.

    Raises
    ------
    ValueError
        A model without betas, poses or `seen` of another shape, a count below 1.
    """
    config = config or FrameConfig()
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    poses = _checked(model, poses, layout, seen)
    among = np.unique(np.linspace(0, len(poses) - 1, max(count, config.candidates)).round().astype(int))
    found = FrameInformation(model, poses[among], layout, betas, None if seen is None else np.asarray(seen)[among],
                             config)
    return among[found.best(count, np.arange(len(among)))]


def _checked(model: BodyModel, poses: np.ndarray, layout: MarkerLayout, seen: np.ndarray | None) -> np.ndarray:
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    poses, J = np.asarray(poses, dtype=np.float64), len(model.skeleton.parents)
    if poses.ndim != 3 or not len(poses) or poses.shape[1:] != (J, 3) or not np.isfinite(poses).all():
        raise ValueError(f"poses: expected finite numbers of shape (T, {J}, 3), got shape {poses.shape}")
    if seen is not None and np.shape(seen) != (len(poses), len(layout.labels)):
        raise ValueError(f"seen: expected shape {(len(poses), len(layout.labels))}, got {np.shape(seen)}")
    return poses
