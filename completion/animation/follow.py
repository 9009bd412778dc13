"""Motion of a known body from markers, frame by frame and then as a whole."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from model.linear import Subject
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh

from .. import energy
from ..bodies import FixedBody
from ..energy import MovingPoints
from ..markers.files import MarkerSequence
from ..markers.layout import MarkerLayout
from ..motion import Motion
from ..priors import gaussian_prior
from ..solve import MinimiseConfig, minimise
from ..starts import search
from .smooth import smooth_sequence

Progress = Callable[[int, int], None]
PREDICTION = 10.0                    # variance of a prediction from two uncertain frames, against the acceleration's
STARTS = 2                           # that are followed to their end


@dataclass(frozen=True)
class AnimateConfig:
    """Settings of `animate`.

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
    start_axes : int
        Directions of the training poses along which the first frame is searched.
    angle_acceleration : float, radians per second squared
        How strongly joints accelerate, as a standard deviation.
    place_acceleration : float, metres per second squared
        The same for the place.
    momentum : float in [0, 1]
        Share of the velocity that the prediction keeps.
    iterations : int
        Most steps for a frame.
    lost : float, metres
        Median residual of a frame above which it is searched anew.
    smoothing : int
        Rounds over the whole sequence afterwards; 0 leaves the frame-by-frame solution.
    """

    marker_sd: float = 0.01
    outlier: float = 0.06
    prior_weight: float = 0.3
    prior_shrinkage: float = 0.3
    start_axes: int = 6
    angle_acceleration: float = 60.0
    place_acceleration: float = 15.0
    momentum: float = 0.9
    iterations: int = 3
    lost: float = 0.08
    smoothing: int = 1


def animate(subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig | None = None,
            progress: Progress | None = None) -> Motion:
    """The motion of a body that carries markers.

    Each frame starts from a prediction at constant velocity and is solved by Levenberg-Marquardt on the
    predicted mesh's own marker points; markers that are missing count nothing, those far off count little.

    Parameters
    ----------
    subject : Subject
        The person, of known shape.
    markers : MarkerSequence
    layout : MarkerLayout
        Where on the body the markers sit. Markers that only one of the two knows are left out.
    progress : callable, optional
        Called with (done, total) frames.

    Raises
    ------
    ValueError
        Fewer than 3 markers in common, no frame with 3 of them, a layout of another body.

    [SCAPE] §8
    """
    follower = MarkerFollower(subject, markers, layout, config or AnimateConfig())
    first = follower.first_frame()
    x = np.empty((len(markers.positions), follower.body.n_angles + 3))
    settled = np.zeros(len(x), dtype=bool)
    x[first] = follower.start(first)
    done = 0
    for way in (range(first, len(x)), range(first - 1, -1, -1)):
        back = -1 if way.step > 0 else 1
        for t in way:
            past = [x[i] for i in (t + back, t + 2 * back) if (first <= i < t if back < 0 else t < i <= first)]
            x[t], settled[t] = follower.frame(t, past or [x[first]])
            done += 1
            if progress:
                progress(done, len(x))
    for _ in range(follower.config.smoothing):
        x = smooth_sequence(follower, x)
    pose, trans, _ = follower.body.split(x)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    residuals[:, follower.rows] = np.linalg.norm(follower.positions(x) - follower.targets, axis=2)
    return Motion(pose.copy(), trans.copy(), subject.betas, markers.rate, residuals, markers.labels,
                  converged=settled)


class MarkerFollower:
    """The markers of a sequence as points that move with a body.

    Parameters
    ----------
    subject : Subject
    markers : MarkerSequence
    layout : MarkerLayout
    config : AnimateConfig
    """

    def __init__(self, subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig
                 ) -> None:
        labels = layout.matched(markers.labels)
        self.config = config
        self.body = FixedBody(subject)
        self.rows = np.array([markers.labels.index(label) for label in labels])
        self.targets = markers.positions[:, self.rows]
        self.rate = markers.rate
        known = layout.select(labels)
        self.distances = np.asarray(known.distances)
        ids, weights = supports(subject.template, known)
        self._follow = self.body.follow(ids, np.zeros(self.body.n_angles + 3), weights)
        self._supports = subject.points(ids, weights)
        self.prior = gaussian_prior(self.body.pose_mean, self.body.pose_covariance, config.prior_shrinkage)
        self.inertia = np.full(self.body.n_angles + 3, (config.angle_acceleration / self.rate**2)**-2)
        self.inertia[-3:] = (config.place_acceleration / self.rate**2)**-2

    def follow(self, x: np.ndarray) -> MovingPoints:
        """The markers for unknowns (..., P)."""
        return energy.above_skin(self._follow(x), self.distances)

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Where the body puts the markers (..., L, 3), metres, for unknowns (..., P)."""
        pose, trans, _ = self.body.split(x)
        return energy.lifted(self._supports.evaluate(pose, trans), self.distances)

    def first_frame(self) -> int:
        """The first frame with nearly as many markers as ever."""
        seen = (~np.isnan(self.targets[..., 0])).sum(axis=1)
        if seen.max(initial=0) < 3:
            raise ValueError(f"markers: expected a frame with at least 3 known markers, the best has "
                             f"{seen.max(initial=0)}")
        return int(np.argmax(seen >= max(3, 0.9 * seen.max())))

    def start(self, t: int) -> np.ndarray:
        """Unknowns (P,) of a frame from nothing but its markers."""
        config = self.config
        x, _ = search(self.body, self.follow, self.targets[t], config.marker_sd, self.prior, config.start_axes)
        weights = np.full(len(self.rows), config.marker_sd**-2)
        end = minimise(lambda x: [energy.point_to_point(self.follow(x), self.targets[t], weights),
                                  energy.pose_prior(x, self.prior, config.prior_weight)],
                       x[:STARTS], MinimiseConfig(iterations=30))
        return end.x[np.argmin(end.energy)]

    def frame(self, t: int, past: list[np.ndarray]) -> tuple[np.ndarray, bool]:
        """Unknowns (P,) of a frame that follows others (the nearest first), and whether it settled."""
        expected = self.predict(past)
        there = ~np.isnan(self.targets[t, :, 0])
        if not there.any():
            return expected, False
        x, settled = self.solve(t, expected)
        if there.sum() >= 3 and self._median(t, x) > self.config.lost:
            anew, found = self.solve(t, self.start(t))
            if self._median(t, anew) < 0.7 * self._median(t, x):
                return anew, found
        return x, settled

    def solve(self, t: int, expected: np.ndarray) -> tuple[np.ndarray, bool]:
        """The best unknowns (P,) of a frame near the expected ones, and whether they settled."""
        config = self.config
        weights = self.weights(t, self.positions(expected))

        def energies(x: np.ndarray) -> list[energy.Residual]:
            return [energy.point_to_point(self.follow(x), self.targets[t], weights),
                    energy.pose_prior(x, self.prior, config.prior_weight),
                    energy.stay_near(x, expected, self.inertia / PREDICTION)]

        end = minimise(energies, expected[None], MinimiseConfig(config.iterations, 1e-4, 1e-2))
        return end.x[0], bool(end.converged[0])

    def weights(self, t: int, positions: np.ndarray) -> np.ndarray:
        """Weights (L,) of the markers of a frame, low for outliers.

        What is common to all markers does not make an outlier: the body may be a step behind.
        """
        off = positions - self.targets[t]
        off = off - np.nan_to_num(np.nanmedian(off, axis=0))
        squared = np.nan_to_num((off**2).sum(axis=1))
        scale = max(self.config.outlier, 3 * np.sqrt(np.median(squared[~np.isnan(off[:, 0])])))**2
        return (scale / (scale + squared))**2 / self.config.marker_sd**2

    def predict(self, past: list[np.ndarray]) -> np.ndarray:
        """Unknowns (P,) expected from one or two frames before, at slowly falling velocity."""
        near = past[0].copy()
        turn = rotations.exp(near[:-3].reshape(-1, 3))
        if len(past) > 1:
            keep = self.config.momentum
            step = rotations.log(np.swapaxes(rotations.exp(past[1][:-3].reshape(-1, 3)), -1, -2) @ turn)
            turn = turn @ rotations.exp(keep * step)
            near[-3:] += keep * (near[-3:] - past[1][-3:])
        near[:-3] = rotations.log(turn).ravel()
        return near

    def _median(self, t: int, x: np.ndarray) -> float:
        return float(np.nanmedian(np.linalg.norm(self.positions(x) - self.targets[t], axis=1)))


def supports(template: Mesh, layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Three points of the skin for each marker: below it, and two around it that span its tangent plane.

    The two are weighted sums of the ring of neighbours, with cosines and sines of the angle about the normal
    as weights, so that their cross product is a smooth normal that moves with the body.

    Returns
    -------
    (3 L, k) int
        Vertices, padded by repeats.
    (3 L, k) float
        Weights; each row sums to 1.
    """
    base = layout.vertices.reshape(len(layout.labels), -1)
    weights = np.ones(base.shape) if layout.weights is None else layout.weights
    if base.max(initial=0) >= len(template.vertices):
        raise ValueError(f"layout: expected vertices of 0..{len(template.vertices) - 1}, got {base.max()}")
    adjacency = template.vertex_adjacency
    rows: list[tuple[np.ndarray, np.ndarray]] = []
    for mine, share in zip(base, weights, strict=True):
        centre = int(mine[np.argmax(share)])
        ring = adjacency.indices[adjacency.indptr[centre]:adjacency.indptr[centre + 1]]
        spokes = template.vertices[ring] - template.vertices[centre]
        normal = template.vertex_normals[centre]
        u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        u /= np.linalg.norm(u)
        plane = spokes @ np.stack([u, np.cross(normal, u)]).T
        direction = plane / np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12)
        rows.append((mine, share))
        for axis in range(2):
            pull = direction[:, axis] / len(ring)
            rows.append((np.concatenate([mine, ring, [centre]]), np.concatenate([share, pull, [-pull.sum()]])))
    width = max(len(ids) for ids, _ in rows)
    ids = np.array([np.pad(i, (0, width - len(i)), mode="edge") for i, _ in rows])
    return ids, np.array([np.pad(w, (0, width - len(w))) for _, w in rows])
