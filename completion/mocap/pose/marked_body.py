"""A body that carries markers: the inner loop of animation, with the pose prior and the normals that lift markers.

How far each marker is believed is told here as well: outliers lose their weight.

Derivatives are by small rotations of every joint from the right, `R_parent exp(pose) exp(d)`, so that no chart ends at
a half turn.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np

from model.features import twists
from model.fitting import energy
from model.fitting.bodies import FixedBody
from model.linear import Subject
from model.priors import gaussian_prior
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, Minimum, levenberg_marquardt, retract_pose, step_between
from scanprep.geometry.mesh import Mesh
from scanprep.ranges import FLAG, Positive, Settings, Share, Signed

from ...smoothing import inertia, solve_coupled_steps
from ..marker_sets.layout import MarkerLayout
from .part_shapes import PartShapes, part_shapes

BATCH = 64                           # frames whose parts are held at once
MOST = 512                           # frames that are solved, each by itself, at once
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


class MarkedBody:
    """A body of known shape with markers; unknowns are x = (pose (3J), trans (3)).

    A step (P,) rotates every joint from the right, `exp(pose) exp(d)`, so that nothing happens at a half turn.
    """

    def __init__(self, subject: Subject, layout: MarkerLayout, prior_weight: float, prior_shrinkage: float) -> None:
        self.body = FixedBody(subject)
        self.count = len(layout.labels)
        self.n_unknowns = self.body.n_angles + 3
        ids, weights = supports(subject.template, layout)
        self.shapes = marker_shapes(subject, ids, weights, np.asarray(layout.distances))
        self.prior = gaussian_prior(self.body.pose_mean, self.body.pose_covariance, prior_shrinkage)
        self._precision = prior_weight * self.prior.whitening.T @ self.prior.whitening

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Where the body puts the markers (..., L, 3), metres, for unknowns (..., P)."""
        pose, trans, _ = self.body.split(x.reshape(-1, x.shape[-1]))
        y = np.empty((len(pose), self.count, 3))
        for some in batches(len(pose)):
            y[some] = np.swapaxes(self.shapes.evaluate(pose[some], trans[some]), 1, 2)
        return y.reshape(*x.shape[:-1], self.count, 3)

    def system(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, stiff: float = 1.0) -> Dense:
        """Markers (B, L, 3), weighted (B, L), and the pose prior, with a factor, at unknowns (B, P). [SCAPE] §8"""
        pose, trans, _ = self.body.split(x)
        return self.with_prior(point_system(*self.shapes.columns(pose, trans), targets, weights), pose, stiff)

    def solve(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, iterations: int, tolerance: float,
              stiff: float = 1.0) -> Minimum[np.ndarray]:
        """The best unknowns near x (B, P), each row by itself; arguments as of `system`, without B if all are alike."""
        targets, weights = (np.broadcast_to(of, (len(x), *of.shape[-k:])) for of, k in ((targets, 2), (weights, 1)))
        ends = [levenberg_marquardt(partial(self.system, targets=targets[some], weights=weights[some], stiff=stiff),
                                    x[some], iterations, tolerance, retract=self.retract)
                for some in batches(len(x), MOST)]
        return ends[0] if len(ends) == 1 else Minimum(
            np.concatenate([end.x for end in ends]),
            Dense(*map(np.concatenate, zip(*(end.equations for end in ends), strict=True))),
            np.concatenate([end.converged for end in ends]), max(end.iterations for end in ends))

    def with_prior(self, data: Dense, pose: np.ndarray, stiff: float = 1.0) -> Dense:
        """Equations whose first unknowns are those of poses (B, J, 3), and the pose prior."""
        pose, (energy, gradient, hessian) = twists(pose), data
        B, n = len(pose), self.body.n_angles
        local = rotations.inverse_right_jacobian(pose)                                           # dpose = local d
        off = pose.reshape(B, n) - self.prior.mean
        precision = stiff * self._precision
        pull = off @ precision
        gradient[:, :n] += (pull.reshape(B, -1, 1, 3) @ local).reshape(B, n)
        half = precision.reshape(n, -1, 3).swapaxes(0, 1) @ local                          # (B, J, n, 3)
        half = half.reshape(B, -1, n // 3, 3, 3).swapaxes(-1, -2)                                # transposed rows
        hessian[:, :n, :n] += (half @ local[:, None]).transpose(0, 1, 3, 2, 4).reshape(B, n, n)
        return Dense(energy + (pull * off).sum(axis=1), gradient, hessian)

    def retract(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The unknowns (..., P) after a step (..., P); poses come out at most a half turn long."""
        return retract_pose(self.body.n_angles)(x, step)

    def smooth_step(self, x: np.ndarray, stiffness: np.ndarray, system: Callable[..., Dense], *of_frames: np.ndarray
                    ) -> np.ndarray:
        """Frames (T, P) that follow each other after one Gauss-Newton step, coupled as of `solve_coupled_steps`.

        `system` makes the equations of some frames from their unknowns and their rows of `of_frames`.
        """
        if len(x) < 3:
            return x

        def equations(near: slice) -> tuple[np.ndarray, np.ndarray]:
            n, P = len(x[near]), x.shape[1]
            gradient, hessian = np.empty((n, P)), np.empty((n, P, P))
            for some in batches(n):
                rows = (values[near][some] for values in (x, *of_frames))
                _, gradient[some], hessian[some] = system(*rows)
            return gradient, hessian

        step = solve_coupled_steps(x, equations, stiffness)
        # radians or metres that a step may go
        return self.retract(x, step * np.minimum(1, 0.5 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12)))

    def step_to(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The step (..., P) that leads from unknowns (..., P) to others."""
        return step_between(x, goal, self.body.n_angles)


def batches(count: int, size: int = BATCH) -> Iterator[slice]:
    """So many frames, some at a time."""
    return (slice(start, start + size) for start in range(0, count, size))


def point_system(y: np.ndarray, columns: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Dense:
    """The equations of points at y (B, 3, L), derivatives (B, P, 3, L), that are to be at targets (B, L, 3) or NaN.

    `weights` (B, L) are factors on the squared distance. The derivatives are used up.
    """
    (B, P), missing = columns.shape[:2], np.isnan(targets[..., 0])
    root = np.sqrt(np.where(missing, 0.0, weights))[:, None]
    residual = (root * np.where(missing[:, None], 0.0, y - np.swapaxes(targets, -1, -2))).reshape(B, -1)
    columns *= root[:, None]
    A = columns.reshape(B, P, -1)
    return Dense((residual**2).sum(axis=1), (A @ residual[..., None])[..., 0], A @ np.swapaxes(A, -1, -2))


def marker_weights(positions: np.ndarray, targets: np.ndarray, sd: float, outlier: float
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Factors (..., L) on the squared distances of markers, 0 where nothing was seen, and which count: above a quarter.

    Places and targets are (..., L, 3), metres, NaN where a marker was not seen; `sd` and `outlier` as in
    `AnimateConfig`. What is common to all markers does not make an outlier: the body may be a step behind.
    """
    squared, scale = distances_apart(positions, targets, outlier)
    share = np.where(np.isnan(squared), 0.0, (scale**2 / (scale**2 + squared))**2)
    return share / sd**2, share > 0.25


def distances_apart(positions: np.ndarray, targets: np.ndarray, outlier: float) -> tuple[np.ndarray, np.ndarray]:
    """Squared distances (..., L) without what is common to all, and the length (..., 1) that makes an outlier."""
    off = positions - targets
    off = off - median_of_known(off, -2)[..., None, :]
    squared = np.einsum("...d,...d->...", off, off)
    # metres; a marker farther off is an outlier on however bad a fit
    return squared, np.maximum(outlier, np.minimum(3 * np.sqrt(median_of_known(squared)), 5.0))[..., None]


def median_of_known(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """The median of values that are not NaN, 0 without any; on few values much faster than numpy's."""
    ordered = np.sort(values, axis=axis)                                # NaN comes last
    seen = (~np.isnan(ordered)).sum(axis=axis, keepdims=True)
    low, high = np.maximum((seen - 1) // 2, 0), np.minimum(seen // 2, values.shape[axis] - 1)
    both = np.take_along_axis(ordered, low, axis=axis) + np.take_along_axis(ordered, high, axis=axis)
    return np.where(seen > 0, 0.5 * both, 0.0).squeeze(axis)


def stretches(rows: np.ndarray, times: np.ndarray | None = None, apart: float = 1.0) -> list[np.ndarray]:
    """Growing rows (n,) as stretches of which none is farther `apart` from the one before, by number or in `times`."""
    gaps = np.diff(rows if times is None else times[rows]) > apart
    return np.split(rows, np.flatnonzero(gaps) + 1) if len(rows) else []


def marker_misfit(apart: np.ndarray, outlier: float) -> np.ndarray:
    """(...) how badly markers (..., L), metres off, fit, of 0 to 1; each outlier counts the same."""
    squared = apart**2
    return np.nanmean(squared / (outlier**2 + squared), axis=-1)


def judge_markers(positions: np.ndarray, targets: np.ndarray, order: np.ndarray, outlier: float
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (..., L), metres, of the markers as they came, and which were believed under their own label."""
    residuals = np.linalg.norm(positions - targets, axis=-1)
    squared, scale = distances_apart(positions, targets, outlier)
    return residuals, (squared < scale**2) & (order == np.arange(order.shape[-1]))


def marker_shapes(subject: Subject, vertex_ids: np.ndarray, weights: np.ndarray, distances: np.ndarray
                  ) -> PartShapes:
    """Markers at distances (L,), metres, above the skin as local shapes; points (3L, k) are those of `supports`.

    The exact normal, of `energy.above_skin`, is no linear function of the body's features: over poses drawn from the
    prior it is regressed on the rotation of the part that it follows best and the lifted twists of that part's joints.
    """
    shapes = part_shapes(subject.points(vertex_ids[::3], weights[::3]))
    if not distances.any():
        return shapes
    poses = _sample_poses(subject)
    supports = subject.points(vertex_ids, weights).evaluate(poses)
    normals = energy.rise_above_skin(supports, np.ones(len(distances))) - supports[:, ::3]         # (S, L, 3)
    back = np.swapaxes(shapes.skeleton.part_rotations(poses), -1, -2)
    local = (back[:, :, None] @ normals[:, None, ..., None])[..., 0]                      # (S, J, L, 3)
    part = np.argmin(local.var(axis=0).sum(axis=-1), axis=0)
    raised = shapes.lift.evaluate(twists(poses))
    offsets, bends = np.empty((len(part), 3)), []
    for i, p in enumerate(part):
        joints = [j for q, j in shapes.bends if q == p]
        known = raised[:, joints].reshape(len(poses), -1)
        wanted, middle = local[:, p, i], known.mean(axis=0)
        A = known - middle
        # the ridge holds a normal to its part where the poses say little
        slope = np.linalg.solve(A.T @ A + 1e-2 * len(poses) * np.eye(A.shape[1]), A.T @ (wanted - wanted.mean(axis=0)))
        offsets[i] = distances[i] * (wanted.mean(axis=0) - middle @ slope)
        bends.append(dict(zip(joints, distances[i] * slope.reshape(len(joints), shapes.lift.width, 3), strict=True)))
    shapes.lift_off(part, offsets, bends)
    return shapes


def _sample_poses(subject: Subject) -> np.ndarray:
    """Poses (S, J, 3) of the prior, the root at rest."""
    assert subject.pose_mean is not None and subject.pose_covariance is not None, "a subject with a pose prior"
    prior = gaussian_prior(subject.pose_mean, subject.pose_covariance)
    samples = 120  # poses from which the turning of the normals is learned
    draws = np.random.default_rng(0).standard_normal((samples, len(prior.whitening)))
    poses = np.zeros((samples, len(prior.mean)))
    poses[:, 3:] = prior.mean[3:] + np.linalg.solve(prior.whitening[:, 3:], draws.T).T
    return poses.reshape(samples, -1, 3)


def supports(template: Mesh, layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Three points of the skin for each marker, below it and two around it that span its tangent plane.

    Vertices (3L, k), padded by repeats, and weights (3L, k), rows of which sum to 1. A marker on a triangle has its
    plane; for one on a vertex the two are sums of the ring, by cosine and sine of the angle about the normal.
    """
    base, weights = layout.skin
    if base.max(initial=0) >= len(template.vertices):
        raise ValueError(f"layout: expected vertices of 0..{len(template.vertices) - 1}, got {base.max()}")
    rows: list[tuple[np.ndarray, np.ndarray]] = []
    for mine, share in zip(base, weights, strict=True):
        if len(set(mine.tolist())) == 3:
            rows += [(mine, share + side) for side in _sides(template, mine)]
            continue
        centre = int(mine[np.argmax(share)])
        ring, plane = ring_around(template, centre)
        direction = plane / np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12)
        rows.append((mine, share))
        for axis in range(2):
            pull = direction[:, axis] / len(ring)
            rows.append((np.concatenate([mine, ring, [centre]]), np.concatenate([share, pull, [-pull.sum()]])))
    return pad_combinations(rows)


def ring_around(mesh: Mesh, centre: int) -> tuple[np.ndarray, np.ndarray]:
    """The neighbours (n,) of a vertex, and how they lie about it in its tangent plane (n, 2), metres."""
    adjacency, normal = mesh.vertex_adjacency, mesh.vertex_normals[centre]
    ring = adjacency.indices[adjacency.indptr[centre]:adjacency.indptr[centre + 1]]
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    u /= np.linalg.norm(u)
    return ring, (mesh.vertices[ring] - mesh.vertices[centre]) @ np.stack([u, np.cross(normal, u)]).T


def pad_combinations(rows: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Points as vertices and weights of different number, as two arrays (n, k), padded by repeats and zeros."""
    width = max(len(ids) for ids, _ in rows)
    return (np.array([np.pad(ids, (0, width - len(ids)), mode="edge") for ids, _ in rows]),
            np.array([np.pad(weights, (0, width - len(weights))) for _, weights in rows]))


def _sides(template: Mesh, corners: np.ndarray) -> np.ndarray:
    """(3, 3) what leads from the place of a marker to its three supports, as weights of the corners of its triangle.

    The supports turn about the outward normal, whichever way round the corners (3,) are named.
    """
    p = template.vertices[corners]
    outward = np.cross(p[1] - p[0], p[2] - p[0]) @ template.vertex_normals[corners].sum(axis=0) >= 0
    sides = np.array([[0, 0, 0], [-1, 1, 0], [-1, 0, 1]])
    return sides if outward else sides[[0, 2, 1]]
