"""A scan whose unit nobody knows: one factor is found together with pose, place and shape."""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial import cKDTree

from model.fitting import energy
from model.fitting.bodies import FixedBody, Follow, NearPoints
from model.fitting.energy import MovingPoints
from model.fitting.named_points import anneal
from model.fitting.scan import spread_points
from model.fitting.starts import all_rotations
from model.priors import gaussian_prior, typical_poses
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, levenberg_marquardt, normal_equations

from .settings import CompletionConfig

LOOSE = 0.3                          # standard deviation of the logarithm of what the first guess is off by
POINTS = 1500                        # that show how far a scan extends


class ScaledBody(FixedBody):
    """A body that may be smaller or larger; unknowns are those of the body, then how much it is scaled down.

    The last unknown stands with the betas, so their prior holds it too: x[-1] = log(factor) / LOOSE, where lengths
    of the scan times `factor` are metres.
    """

    def __init__(self, inner: FixedBody) -> None:
        self.inner, self.n_betas = inner, inner.n_betas + 1
        self.template, self.skeleton, self.n_angles = inner.template, inner.skeleton, inner.n_angles
        self.pose_mean, self.pose_covariance = inner.pose_mean, inner.pose_covariance
        self.pose_examples, self.known_poses = inner.pose_examples, inner.known_poses
        self.left_out_error = inner.left_out_error
        self.subject = inner.subject

    def fix_shape(self, x: np.ndarray) -> FixedBody:
        """The body with the shape and size it has at x (P,), as one of known shape."""
        subject = self.inner.fix_shape(x[:-1]).subject
        return self._of(replace(subject, operator=subject.operator.scale_by(float(np.exp(-LOOSE * x[-1])))))

    def some(self, ids: np.ndarray) -> FixedBody:
        return ScaledBody(self.inner.some(ids))

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        stand = self.subject.origin + x[self.n_angles:self.n_angles + 3]
        return stand + np.exp(-LOOSE * x[-1]) * (self.inner.vertices(x[:-1]) - stand)

    def follow(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> Follow:
        """Surface points as a function of the unknowns (B, P), valid near x (P,)."""
        inner, first = self.inner.follow(vertex_ids, x[:-1], weights), self.n_angles

        def move(x: np.ndarray) -> MovingPoints:
            found = inner(x[..., :-1])
            smaller = np.exp(-LOOSE * x[..., -1])[..., None, None]
            stand = (self.subject.origin + x[..., first:first + 3])[..., None, :]
            off = smaller * (found.positions - stand)
            J = np.concatenate([smaller[..., None] * found.jacobian, -LOOSE * off[..., None]], axis=-1)
            J[..., first:first + 3] = np.eye(3)
            return MovingPoints(stand + off, J)

        return move

    def near(self, vertex_ids: np.ndarray, x: np.ndarray) -> NearPoints:
        return _OneByOne(self.follow(vertex_ids, x))

    def in_metres(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Unknowns (P-1,) of the body at its own size, and what the scan has to be multiplied with for it."""
        factor = float(np.exp(LOOSE * x[-1]))
        out, place = x[:-1].copy(), slice(self.n_angles, self.n_angles + 3)
        out[place] = factor * (self.subject.origin + x[place]) - self.subject.origin
        return out, factor


@dataclass(frozen=True, eq=False)
class _OneByOne:
    """Points that follow many unknowns, for one at a time."""

    follow: Follow

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(L, 3) metres, of unknowns (P,)."""
        return self.follow(x[None]).positions[0]

    def columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (L, 3) and their derivatives (P, 3, L)."""
        found = self.follow(x[None])
        return found.positions[0], np.swapaxes(found.jacobian[0], 0, 2)


def rough_scale(body: FixedBody, points: np.ndarray) -> float:
    """Metres per unit of a scan, from how far its points (n, 3) extend; good to a tenth or so.

    Poses the body was learned from are looked at from all sides; those that extend in the scan's proportions, long,
    wide and deep, say how large it is.
    """
    some = points[spread_points(points, POINTS)]
    size, form = _extent(some[None])
    poses = _usual_poses(body)
    ids = spread_points(body.template.vertices, POINTS)
    places = body.subject.points(ids).evaluate(poses, np.zeros((len(poses), 3)))
    part = body.skeleton.part_of_vertex(body.template)[ids]
    R = body.skeleton.part_rotations(poses)[:, part]
    normals = (R @ body.template.vertex_normals[ids][:, :, None])[..., 0]
    directions = 40  # from which each pose is looked at
    toward = all_rotations(directions)[:, :, 0]
    sizes, forms = [], []
    for y, n in zip(places, normals, strict=True):
        seen = (toward @ n.T > 0.15).astype(float)
        each = _extent(np.repeat(y[None], len(seen) + 1, axis=0), np.vstack([seen, np.ones(len(y))]))
        sizes.append(each[0])
        forms.append(each[1])
    alike = 25  # views of poses that extend like the scan
    _, near = cKDTree(np.vstack(forms)).query(form[0], min(alike, len(forms) * (directions + 1)))
    return float(np.median(np.concatenate(sizes)[near]) / size[0])


def _usual_poses(body: FixedBody) -> np.ndarray:
    """(M, J, 3) those the body was learned from, where it keeps them, and steps along their main directions."""
    # main directions of the poses
    typical = typical_poses(body.pose_mean, body.pose_covariance, 4)
    return np.concatenate([body.pose_examples, typical]) if len(body.pose_examples) else typical


def _extent(points: np.ndarray, weights: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Root mean square distance (B,) from the middle, and its shares (B, 3) along the main axes."""
    w = np.ones(points.shape[:2]) if weights is None else weights
    w = w / w.sum(axis=1, keepdims=True)
    off = points - (w[:, :, None] * points).sum(axis=1, keepdims=True)
    spreads = np.sqrt(np.maximum(np.linalg.eigvalsh(np.swapaxes(off, 1, 2) @ (w[:, :, None] * off)), 0))
    size = np.linalg.norm(spreads, axis=1)
    return size, spreads / size[:, None]


def landmark_scale(body: FixedBody, vertices: np.ndarray, points: np.ndarray, config: CompletionConfig) -> float:
    """What to multiply landmarks (L, 3) with, which are roughly in metres, to be in metres more closely."""
    scaled = ScaledBody(body)
    prior = gaussian_prior(body.pose_mean, body.pose_covariance)
    poses = _usual_poses(body)
    here = body.subject.points(vertices).evaluate(poses, np.zeros((len(poses), 3)))
    start, misfit = [], []
    for pose, at in zip(poses, here, strict=True):
        R, _ = rotations.procrustes(at, points)
        a, b = (at - at.mean(axis=0)) @ R.T, points - points.mean(axis=0)
        factor = float((a * b).sum() / (b * b).sum())
        misfit.append(((a - factor * b)**2).sum())
        turned = pose.copy()
        turned[0] = rotations.log(R @ rotations.exp(pose[0]))
        stand = points.mean(axis=0) + R @ (body.subject.origin - at.mean(axis=0)) / factor - body.subject.origin
        start.append(np.concatenate([turned.ravel(), stand, np.zeros(body.n_betas), [np.log(factor) / LOOSE]]))
    # poses that meet the landmarks best and are followed up
    x = np.array(start)[np.argsort(misfit)[:12]]
    follow = scaled.follow(vertices, np.r_[x[0, :-1 - body.n_betas], np.zeros(body.n_betas + 1)])
    weights = np.full(len(points), config.landmark_sd**-2)

    def equations(x: np.ndarray, stiff: float) -> Dense:
        return normal_equations([energy.point_to_point(follow(x), points, weights),
                                 energy.pose_prior_term(x, prior, stiff),
                                 energy.shape_prior(x, body.n_angles + 3)])

    found = anneal(lambda x, stiff: levenberg_marquardt(partial(equations, stiff=stiff), x, 8, 1e-3), x)
    return float(np.exp(LOOSE * found.x[np.argmin(found.energy), -1]))
