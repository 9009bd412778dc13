"""Body with markers: the inner loop of animation, with the pose prior and the normals that lift markers off the skin.

The robust weights of markers are here as well: outliers lose their weight.

Derivatives are by small rotations d of every joint from the right, `R_parent exp(pose) exp(d)`, so that nothing special
happens at a half turn.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from model.features import twists
from model.fitting import energy
from model.fitting.bodies import FixedBody
from model.linear import Subject, check_subject
from model.priors import SHRINKAGE, gaussian_prior
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, Minimum, levenberg_marquardt, retract_pose, step_between
from scanprep.geometry.mesh import Mesh
from scanprep.ranges import Positive, Settings

from ...smoothing import inertia, solve_coupled_steps
from ..marker_sets.layout import MarkerLayout
from .part_shapes import PartShapes, part_shapes

BATCH = 64                           # frames whose derivatives are in memory at once
MOST = 512                           # frames that are solved at once, each by itself
RATE = 120.0                         # frames per second for which [MoSh] means the weight of the velocity
PLACE_ACCELERATION = 15.0            # m/s², sd of the acceleration of the place: one and a half times gravity


@dataclass(frozen=True)
class AnimateConfig(Settings):
    """Settings of `animate` and `MarkerStream`.

    Attributes
    ----------
    marker_sd : float, metres
        Standard deviation of a marker from its simulated place.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight, at least. On a body that fits badly it grows
        to three times the median residual.
    prior_weight : float
        Factor on the pose prior. It is small, so the prior matters only for joints that no marker sees.
    angle_acceleration : float, radians per second squared
        Standard deviation of the acceleration of joint angles.
    low_pass : float, hertz
        Cut-off of a Butterworth filter without lag on the result; 0 is none.
    ground : bool
        Foot contact: feet do not sink into the floor and do not slide while they stand on it.
    published : bool
        As in [MoSh]: a pose prior without shrinkage, and places that are not smoothed.

    Examples
    --------
    >>> AnimateConfig(ground=True).marker_sd
    0.01

    [SCAPE] §8
    """

    marker_sd: Positive = 0.01
    outlier: Positive = 0.06
    prior_weight: float = 0.3
    angle_acceleration: Positive = 60.0
    low_pass: float = 0.0
    ground: bool = False
    published: bool = False

    @classmethod
    def from_weights(cls, data: float, pose: float, velocity: float) -> AnimateConfig:
        """Convert weights for squared centimetres, for the pose prior and for squared radians to settings.

        A weight is an inverse variance. That of the change of velocity from frame to frame is meant for 120 frames per
        second; at another rate it allows the same acceleration.

        [MoSh] Eq. 17, Eq. 21, Eq. 22
        """
        return cls(marker_sd=0.01 * data**-0.5, prior_weight=pose, angle_acceleration=RATE**2 * velocity**-0.5)

    @property
    def prior_shrinkage(self) -> float:
        """Share in [0, 1] by which the covariance of the poses is shrunk, see `gaussian_prior`."""
        return 0.0 if self.published else SHRINKAGE

    def inertia(self, rate: float, n_unknowns: int) -> np.ndarray:
        """Compute the information (P,) of the change of velocity from frame to frame."""
        # 1e6: so large that places are not smoothed
        return inertia(n_unknowns, rate, self.angle_acceleration, 1e6 if self.published else PLACE_ACCELERATION)


class MarkedBody:
    """Body of known shape with markers; unknowns are x = (pose (3J), trans (3)).

    A step (P,) rotates every joint from the right, `exp(pose) exp(d)`, so a half turn is nothing special.
    """

    def __init__(self, subject: Subject, layout: MarkerLayout, prior_weight: float,
                 prior_shrinkage: float = SHRINKAGE) -> None:
        self.body = FixedBody(check_subject(subject))
        self.count = len(layout.labels)
        self.n_unknowns = self.body.n_angles + 3
        ids, weights = supports(subject.template, layout)
        self.part_of_marker = subject.skeleton.part_of_vertex(subject.template)[layout.nearest]
        self.shapes = marker_shapes(subject, ids, weights, np.asarray(layout.distances))
        self.prior = gaussian_prior(self.body.pose_mean, self.body.pose_covariance, prior_shrinkage)
        self._precision = prior_weight * self.prior.whitening.T @ self.prior.whitening

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Compute the simulated markers (..., L, 3), metres, for unknowns (..., P)."""
        pose, trans, _ = self.body.split(x.reshape(-1, x.shape[-1]))
        y = np.empty((len(pose), self.count, 3))
        for some in batches(len(pose)):
            y[some] = np.swapaxes(self.shapes.evaluate(pose[some], trans[some]), 1, 2)
        return y.reshape(*x.shape[:-1], self.count, 3)

    def system(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, stiff: float = 1.0) -> Dense:
        """Build the equations of markers (B, L, 3), weights (B, L), and `stiff` times the pose prior at x (B, P)."""
        pose, trans, _ = self.body.split(x)
        return self.with_prior(point_system(*self.shapes.columns(pose, trans), targets, weights), pose, stiff)

    def solve(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, iterations: int, tolerance: float,
              stiff: float = 1.0) -> Minimum[np.ndarray]:
        """Solve for unknowns near x (B, P), each row by itself; arguments of `system`, without B if equal for all."""
        targets, weights = (np.broadcast_to(of, (len(x), *of.shape[-k:])) for of, k in ((targets, 2), (weights, 1)))
        ends = [levenberg_marquardt(partial(self.system, targets=targets[some], weights=weights[some], stiff=stiff),
                                    x[some], iterations, tolerance, retract=self.retract)
                for some in batches(len(x), MOST)]
        return ends[0] if len(ends) == 1 else Minimum(
            np.concatenate([end.x for end in ends]),
            Dense(*map(np.concatenate, zip(*(end.equations for end in ends), strict=True))),
            np.concatenate([end.converged for end in ends]), max(end.iterations for end in ends))

    def with_prior(self, data: Dense, pose: np.ndarray, stiff: float = 1.0) -> Dense:
        """Add the pose prior to equations whose first unknowns are those of poses (B, J, 3)."""
        pose, (energy, gradient, hessian) = twists(pose), data
        B, n = len(pose), self.body.n_angles
        # a joint that turns by d from the right changes its pose vector by dpose = local d
        local = rotations.inverse_right_jacobian(pose)
        off = pose.reshape(B, n) - self.prior.mean
        precision = stiff * self._precision
        pull = off @ precision
        gradient[:, :n] += (pull.reshape(B, -1, 1, 3) @ local).reshape(B, n)
        # localᵀ precision local, block by block of joints
        half = precision.reshape(n, -1, 3).swapaxes(0, 1) @ local                          # (B, J, n, 3)
        half = half.reshape(B, -1, n // 3, 3, 3).swapaxes(-1, -2)                                # transposed rows
        hessian[:, :n, :n] += (half @ local[:, None]).transpose(0, 1, 3, 2, 4).reshape(B, n, n)
        return Dense(energy + (pull * off).sum(axis=1), gradient, hessian)

    def retract(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Apply a step (..., P) to unknowns (..., P); pose vectors come out at most a half turn long."""
        return retract_pose(self.body.n_angles)(x, step)

    def smooth_step(self, x: np.ndarray, stiffness: np.ndarray, system: Callable[..., Dense], *of_frames: np.ndarray
                    ) -> np.ndarray:
        """Take one Gauss-Newton step of successive frames (T, P), coupled over time by `solve_coupled_steps`.

        `system` builds the equations of some frames from their unknowns and their rows of `of_frames`.
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
        # 0.5 radians or metres: longest step, so that one bad frame cannot throw the body off
        return self.retract(x, step * np.minimum(1, 0.5 / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12)))

    def step_to(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Compute the step (..., P) that leads from unknowns x (..., P) to a goal (..., P)."""
        return step_between(x, goal, self.body.n_angles)


def batches(count: int, size: int = BATCH) -> Iterator[slice]:
    """Yield slices of at most `size` frames that cover `count` frames."""
    return (slice(start, start + size) for start in range(0, count, size))


def point_system(y: np.ndarray, columns: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Dense:
    """Build the equations of points at y (B, 3, L), with derivatives (B, P, 3, L), and targets (B, L, 3) or NaN.

    `weights` (B, L) are factors on the squared distance. The array of derivatives is overwritten.
    """
    (B, P), missing = columns.shape[:2], np.isnan(targets[..., 0])
    root = np.sqrt(np.where(missing, 0.0, weights))[:, None]
    residual = (root * np.where(missing[:, None], 0.0, y - np.swapaxes(targets, -1, -2))).reshape(B, -1)
    columns *= root[:, None]
    A = columns.reshape(B, P, -1)
    return Dense((residual**2).sum(axis=1), (A @ residual[..., None])[..., 0], A @ np.swapaxes(A, -1, -2))


def marker_weights(positions: np.ndarray, targets: np.ndarray, sd: float, outlier: float
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Compute Geman-McClure weights (..., L) of squared distances, and which markers count: above a quarter.

    Positions and targets are (..., L, 3), metres, NaN for a marker that was not seen: its weight is 0. `sd` and
    `outlier` are as in `AnimateConfig`. An offset common to all markers makes no outlier: the body may be late.
    """
    squared, scale = distances_apart(positions, targets, outlier)
    share = np.where(np.isnan(squared), 0.0, (scale**2 / (scale**2 + squared))**2)
    return share / sd**2, share > 0.25


def distances_apart(positions: np.ndarray, targets: np.ndarray, outlier: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute squared distances (..., L) without the common offset, and the scale (..., 1) of an outlier, metres."""
    off = positions - targets
    off = off - median_of_known(off, -2)[..., None, :]
    squared = np.einsum("...d,...d->...", off, off)
    # 3 medians; at most 5 m, beyond which a marker is an outlier on any fit
    return squared, np.maximum(outlier, np.minimum(3 * np.sqrt(median_of_known(squared)), 5.0))[..., None]


def median_of_known(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Compute the median without NaN, 0 where all are NaN; on few values much faster than numpy's."""
    ordered = np.sort(values, axis=axis)                                # NaN comes last
    seen = (~np.isnan(ordered)).sum(axis=axis, keepdims=True)
    low, high = np.maximum((seen - 1) // 2, 0), np.minimum(seen // 2, values.shape[axis] - 1)
    both = np.take_along_axis(ordered, low, axis=axis) + np.take_along_axis(ordered, high, axis=axis)
    return np.where(seen > 0, 0.5 * both, 0.0).squeeze(axis)


def stretches(rows: np.ndarray, times: np.ndarray | None = None, apart: float = 1.0) -> list[np.ndarray]:
    """Split growing rows (n,) where successive ones are more than `apart` apart, by number or in `times`."""
    gaps = np.diff(rows if times is None else times[rows]) > apart
    return np.split(rows, np.flatnonzero(gaps) + 1) if len(rows) else []


def marker_misfit(apart: np.ndarray, outlier: float) -> np.ndarray:
    """Compute the misfit (...) from 0 to 1 of markers (..., L) metres off; all outliers count the same."""
    squared = apart**2
    return np.nanmean(squared / (outlier**2 + squared), axis=-1)


def judge_markers(positions: np.ndarray, targets: np.ndarray, order: np.ndarray, outlier: float
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Compute residuals (..., L), metres, of the raw markers, and which are trusted under their own label."""
    residuals = np.linalg.norm(positions - targets, axis=-1)
    squared, scale = distances_apart(positions, targets, outlier)
    return residuals, (squared < scale**2) & (order == np.arange(order.shape[-1]))


def marker_shapes(subject: Subject, vertex_ids: np.ndarray, weights: np.ndarray, distances: np.ndarray
                  ) -> PartShapes:
    """Return markers at distances (L,), metres, above the skin as local shapes; points (3L, k) are those of `supports`.

    The exact normal of `energy.above_skin` is not linear in the features of the body. So it is regressed, over poses
    drawn from the prior: on the rotation of the part that it follows best, and on the twists of that part's joints.
    """
    shapes = part_shapes(subject.points(vertex_ids[::3], weights[::3]))
    if not distances.any():
        return shapes
    # exact normals in the sampled poses, in the frame of each part; the best part is that with the least variance
    poses = _sample_poses(subject)
    supports = subject.points(vertex_ids, weights).evaluate(poses)
    normals = energy.rise_above_skin(supports, np.ones(len(distances))) - supports[:, ::3]         # (S, L, 3)
    back = np.swapaxes(shapes.skeleton.part_rotations(poses), -1, -2)
    local = (back[:, :, None] @ normals[:, None, ..., None])[..., 0]                      # (S, J, L, 3)
    part = np.argmin(local.var(axis=0).sum(axis=-1), axis=0)
    # for each marker a linear regression on the lifted twists
    raised = shapes.lift.evaluate(twists(poses))
    offsets, bends = np.empty((len(part), 3)), []
    for i, p in enumerate(part):
        joints = [j for q, j in shapes.bends if q == p]
        features = raised[:, joints].reshape(len(poses), -1)
        normal, middle = local[:, p, i], features.mean(axis=0)
        A = features - middle
        # the ridge, 1% per sample, keeps a normal fixed to its part where the poses tell little
        slope = np.linalg.solve(A.T @ A + 1e-2 * len(poses) * np.eye(A.shape[1]), A.T @ (normal - normal.mean(axis=0)))
        offsets[i] = distances[i] * (normal.mean(axis=0) - middle @ slope)
        bends.append(dict(zip(joints, distances[i] * slope.reshape(len(joints), shapes.lift.width, 3), strict=True)))
    shapes.lift_off(part, offsets, bends)
    return shapes


def _sample_poses(subject: Subject) -> np.ndarray:
    """Draw poses (S, J, 3) from the prior, with the root at rest."""
    assert subject.pose_mean is not None and subject.pose_covariance is not None, "a subject with a pose prior"
    prior = gaussian_prior(subject.pose_mean, subject.pose_covariance)
    samples = 120  # poses for the regression of the normals
    draws = np.random.default_rng(0).standard_normal((samples, len(prior.whitening)))
    poses = np.zeros((samples, len(prior.mean)))
    poses[:, 3:] = prior.mean[3:] + np.linalg.solve(prior.whitening[:, 3:], draws.T).T
    return poses.reshape(samples, -1, 3)


def supports(template: Mesh, layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Return three points of the skin for each marker: below it, and two around it that span the tangent plane.

    They are vertices (3L, k), padded by repeats, with weights (3L, k) whose rows sum to 1. A marker on a triangle uses
    its plane. For a marker on a vertex, the two points are sums over the ring, by cosine and sine of the angle round
    the normal.
    """
    base, weights = layout.skin
    if base.max(initial=0) >= len(template.vertices):
        raise ValueError(f"layout: expected vertices of 0..{len(template.vertices) - 1}, got {base.max()}")
    rows: list[tuple[np.ndarray, np.ndarray]] = []
    for corners, share in zip(base, weights, strict=True):
        if len(set(corners.tolist())) == 3:
            # offsets along two edges, which turn about the outward normal in whatever order the corners are given
            p = template.vertices[corners]
            outward = np.cross(p[1] - p[0], p[2] - p[0]) @ template.vertex_normals[corners].sum(axis=0) >= 0
            sides = np.array([[0, 0, 0], [-1, 1, 0], [-1, 0, 1]])[[0, 1, 2] if outward else [0, 2, 1]]
            rows += [(corners, share + side) for side in sides]
            continue
        # on a vertex: the neighbours pull by the direction in which they lie
        centre = int(corners[np.argmax(share)])
        ring, plane = ring_around(template, centre)
        direction = plane / np.maximum(np.linalg.norm(plane, axis=1, keepdims=True), 1e-12)
        rows.append((corners, share))
        for axis in range(2):
            pull = direction[:, axis] / len(ring)
            rows.append((np.concatenate([corners, ring, [centre]]), np.concatenate([share, pull, [-pull.sum()]])))
    return pad_combinations(rows)


def ring_around(mesh: Mesh, centre: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the neighbours (n,) of a vertex, and their coordinates (n, 2), metres, in its tangent plane."""
    adjacency, normal = mesh.vertex_adjacency, mesh.vertex_normals[centre]
    ring = adjacency.indices[adjacency.indptr[centre]:adjacency.indptr[centre + 1]]
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    u /= np.linalg.norm(u)
    return ring, (mesh.vertices[ring] - mesh.vertices[centre]) @ np.stack([u, np.cross(normal, u)]).T


def pad_combinations(rows: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Pad points of different numbers of vertices and weights to two arrays (n, k), by repeats and zeros."""
    width = max(len(ids) for ids, _ in rows)
    return (np.array([np.pad(ids, (0, width - len(ids)), mode="edge") for ids, _ in rows]),
            np.array([np.pad(weights, (0, width - len(weights))) for _, weights in rows]))
