"""Common interface of bodies with known and unknown shape: unknowns in, points with derivatives out."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from ..bilinear import PosedPoints
from ..body import BodyModel
from ..human_poses import human_poses
from ..linear import PointOperator, Subject
from .energy import MovingPoints, moving_points

Follow = Callable[[np.ndarray], MovingPoints]


class NearPoints(Protocol):
    """Surface points (L,) of a body near some unknowns, as a function of them."""

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(L, 3) metres, of unknowns (P,)."""
        ...

    def columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (L, 3) and their derivatives (P, 3, L)."""
        ...


class FixedBody:
    """A body of known shape; the unknowns are x = (pose (3J), trans (3))."""

    n_betas = 0

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.template: Mesh = subject.template
        self.skeleton: Skeleton = subject.skeleton
        self.n_angles = 3 * len(subject.skeleton.parents)
        if subject.pose_mean is None or subject.pose_covariance is None:
            raise ValueError("subject: expected one that a model made, with its pose prior")
        self.pose_mean, self.pose_covariance = subject.pose_mean, subject.pose_covariance
        none = np.zeros((0, *subject.pose_mean.shape))
        self.pose_examples = none if subject.pose_examples is None else subject.pose_examples
        self.left_out_error = subject.left_out_error

    @cached_property
    def known_poses(self) -> np.ndarray:
        """(M, J, 3) radians: the body's training poses, and for a person 150 poses that people take."""
        people = human_poses(self.template, self.skeleton, 150, np.random.default_rng(0))
        return self.pose_examples if people is None else np.concatenate([self.pose_examples, people])

    @cached_property
    def _known_rotations(self) -> np.ndarray:
        """(M, J, 3, 3) of the joints in the known poses."""
        return rotations.exp(self.known_poses)

    def joints_from_known(self, pose: np.ndarray) -> np.ndarray:
        """Compute by how much each joint of a pose (J, 3) differs from its nearest known rotation, (J,) radians.

        It is 0 for the root.
        """
        if not len(self.known_poses):
            return np.zeros(len(pose))
        trace = np.einsum("mjab,jab->mj", self._known_rotations, rotations.exp(pose)).max(axis=0)   # 1 + 2 cos
        away = np.arccos(np.clip((trace - 1) / 2, -1, 1))
        away[0] = 0
        return away

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Split unknowns (..., P) into pose (..., J, 3), trans (..., 3) and betas (..., K)."""
        n = self.n_angles
        return x[..., :n].reshape(*x.shape[:-1], -1, 3), x[..., n:n + 3], x[..., n + 3:]

    def join(self, pose: np.ndarray, trans: np.ndarray) -> np.ndarray:
        """Join pose (..., J, 3) and trans (..., 3) to unknowns (..., P), with betas of zero."""
        betas = np.zeros((*trans.shape[:-1], self.n_betas))
        return np.concatenate([pose.reshape(*pose.shape[:-2], -1), trans, betas], axis=-1)

    def fix_shape(self, x: np.ndarray) -> FixedBody:
        """The body with the shape it has at x (P,), as one of known shape."""
        return self

    def some(self, ids: np.ndarray) -> FixedBody:
        """Restrict the body to these vertices (L,), which are numbered anew from 0."""
        return self._of(replace(self.subject, operator=self.subject.points(ids)))

    def _of(self, subject: Subject) -> FixedBody:
        """Build the body of another subject with the same known poses."""
        out = FixedBody(subject)
        out.known_poses, out._known_rotations = self.known_poses, self._known_rotations
        return out

    def in_metres(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Unknowns (P,) of the body at its own size, and what the scan has to be multiplied with for it."""
        return x, 1.0

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        pose, trans, _ = self.split(x)
        return self.subject.vertices(pose, trans).astype(np.float64)

    def follow(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> Follow:
        """Build surface points as a function of the unknowns (B, P), valid near x (P,)."""
        operator = self.subject.points(vertex_ids, weights)

        def move(x: np.ndarray) -> MovingPoints:
            pose, trans, _ = self.split(x)
            return moving_points(*operator.jacobian(pose, trans))

        return move

    def near(self, vertex_ids: np.ndarray, x: np.ndarray) -> NearPoints:
        """Build surface points as `follow` does, for one body at a time."""
        every = np.array_equal(vertex_ids, np.arange(self.subject.n_vertices))
        return PosedPoints(self._every if every else self.subject.points(vertex_ids))

    @cached_property
    def _every(self) -> PointOperator:
        """All vertices in float64."""
        return self.subject.operator.astype(np.float64)

    def gather(self, vertex_ids: np.ndarray, x: np.ndarray) -> tuple[NearPoints, np.ndarray]:
        """Build points near x (P,) that include vertices (L,), which may repeat; return them and the number of each.

        Beyond half of the body's vertices all are taken, since choosing takes longer than moving the others.
        """
        used, at = np.unique(vertex_ids, return_inverse=True)
        count = self.subject.n_vertices
        return (self.near(np.arange(count), x), vertex_ids) if 2 * len(used) > count else (self.near(used, x), at)


class ShapedBody(FixedBody):
    """A body of unknown shape; the unknowns are x = (pose (3J), trans (3), betas (K)).

    Vertices are affine in betas with a matrix D that depends on the pose. Stitching D is expensive, so it is done at an
    anchor pose. From there bones carry D to nearby poses, rigidly with its part. The derivative by the pose is that of
    the subject that was built last. Only derivatives are approximate; at x itself the positions are those of the model.
    """

    RENEW = 4.0                      # standard deviations that betas may move before the subject is built anew
    TURN = 1.2                       # radians that a part may turn before D is stitched anew

    def __init__(self, model: BodyModel) -> None:
        self.model, self.n_betas = model, model.n_betas
        self.template, self.skeleton = model.template, model.skeleton
        self.n_angles = 3 * len(model.skeleton.parents)
        self.pose_mean, self.pose_covariance = model.pose_mean, model.pose_covariance
        self.pose_examples, self.left_out_error = model.pose_examples, model.info.get("left_out_error")
        self._at, self.subject = np.zeros(self.n_betas), model.mean_subject
        self._anchor: Anchor | None = None
        self._last = (np.zeros(0), np.zeros((0, 3)))

    def fix_shape(self, x: np.ndarray) -> FixedBody:
        """The body with the shape it has at x (P,), as one of known shape."""
        betas = self.split(x)[2]
        return self._of(self.subject if np.array_equal(betas, self._at) else self.model.subject(betas))

    def some(self, ids: np.ndarray) -> FixedBody:
        return RoughBody(self, ids)

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        if not np.array_equal(x, self._last[0]):
            pose, trans, betas = self.split(x)
            self._last = x.copy(), self.model.vertices(pose, betas, trans)
        return self._last[1]

    def follow(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> Follow:
        """Surface points as a function of the unknowns (B, P), valid near x (P,)."""
        near = self._carry(vertex_ids, x, weights)

        def move(x: np.ndarray) -> MovingPoints:
            pose, trans, betas = self.split(x)
            positions, d_pose = near.operator.jacobian(pose, trans)
            shift = near.gap + np.einsum("ldk,...k->...ld", near.D, betas - near.at)
            return moving_points(positions + shift, d_pose, near.D)

        return move

    def near(self, vertex_ids: np.ndarray, x: np.ndarray) -> NearPoints:
        return self._carry(vertex_ids, x)

    def _carry(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> CarriedPoints:
        pose, trans, betas = self.split(x)
        # derivatives by pose and by betas are renewed only when they have become too old
        if np.linalg.norm(betas - self._at) > self.RENEW:
            self._at = betas.copy()
            self.subject = self.model.subject(betas)
        if self._anchor is None or self._anchor.largest_angle(pose) > self.TURN:
            self._anchor = anchor_at(self.model, pose)
        operator, at = self.subject.points(vertex_ids, weights), self._at
        # positions are exact at x: the gap corrects the linearised ones
        D, y = self._anchor.carry(vertex_ids.ravel(), pose), self.vertices(x)[vertex_ids]
        D = D.reshape(*vertex_ids.shape, *D.shape[1:])
        if weights is not None:
            D, y = np.einsum("lk,lkdb->ldb", weights, D), np.einsum("lk,lkd->ld", weights, y)
        return CarriedPoints(operator, at, D, y - operator.evaluate(pose, trans) - D @ (betas - at))


@dataclass(frozen=True, eq=False)
class CarriedPoints:
    """Points of an operator (L,) at betas `at` (K,), shifted by a gap (L, 3) and by D (L, 3, K) times other betas."""

    operator: PointOperator
    at: np.ndarray
    D: np.ndarray
    gap: np.ndarray | float

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(L, 3) metres, of unknowns (P,)."""
        pose, trans, betas = self._split(x)
        return self.operator.evaluate(pose, trans) + self.gap + self.D @ (betas - self.at)

    def columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (L, 3) and their derivatives (P, 3, L)."""
        pose, trans, betas = self._split(x)
        y, by_pose = self.operator.columns(pose, trans)
        by_place = np.broadcast_to(np.eye(3)[..., None], (3, 3, len(y)))
        return (y + self.gap + self.D @ (betas - self.at),
                np.concatenate([by_pose, by_place, np.swapaxes(self.D, 0, 2)]))

    def _split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n = 3 * len(self.operator.skeleton.parents)
        return x[:n].reshape(-1, 3), x[n:n + 3], x[n + 3:]


class RoughBody(ShapedBody):
    """Some vertices of a body of unknown shape, for a search: the effect of betas at rest is carried by the bones.

    It is never stitched again, and accurate to about a centimetre.
    """

    def __init__(self, whole: ShapedBody, ids: np.ndarray) -> None:
        super().__init__(whole.model)
        self.known_poses, self._known_rotations = whole.known_poses, whole._known_rotations
        self.ids, self._mean = ids, whole.fix_shape(np.zeros(self.n_angles + 3 + self.n_betas)).subject
        self.subject = replace(self._mean, operator=self._mean.points(ids))
        rest = anchor_at(self.model, np.zeros((len(self.skeleton.parents), 3)))
        self._rest = rest.some(ids)
        if whole._anchor is None:
            whole._anchor = rest                     # a good first anchor, since it is already computed

    def fix_shape(self, x: np.ndarray) -> FixedBody:
        betas = self.split(x)[2]
        return self._of(self.model.subject(betas) if betas.any() else self._mean).some(self.ids)

    def vertices(self, x: np.ndarray) -> np.ndarray:
        pose, trans, betas = self.split(x)
        return self.subject.vertices(pose, trans) + self._rest.shift_by_betas(pose, betas)

    def _carry(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> CarriedPoints:
        assert weights is None, "single vertices only"
        D = self._rest.carry(vertex_ids, self.split(x)[0])
        return CarriedPoints(self.subject.points(vertex_ids), np.zeros(self.n_betas), D, 0.0)


class ResizedBody(FixedBody):
    """A body scaled by a factor, so that the lengths of the search, in metres, are those of a person.

    It is scaled about the root's joint, which stays in place.
    """

    def __init__(self, inner: FixedBody, factor: float) -> None:
        own = inner.fix_shape(np.zeros(inner.n_angles + 3 + inner.n_betas)).subject
        super().__init__(replace(own, operator=own.operator.scale_by(factor),
                                 template=own.template.with_vertices(factor * own.template.vertices),
                                 skeleton=replace(own.skeleton, joints=factor * own.skeleton.joints)))
        self.inner, self.factor, self.n_betas = inner, factor, inner.n_betas
        self.known_poses = inner.known_poses

    def fix_shape(self, x: np.ndarray) -> FixedBody:
        """The body with the shape it has at x (P,), as one of known shape."""
        return ResizedBody(self.inner.fix_shape(x), self.factor)

    def some(self, ids: np.ndarray) -> FixedBody:
        return ResizedBody(self.inner.some(ids), self.factor)

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        return resize(self.inner.vertices(x), self.subject.origin + self.split(x)[1], self.factor)

    def near(self, vertex_ids: np.ndarray, x: np.ndarray) -> NearPoints:
        return ResizedPoints(self.inner.near(vertex_ids, x), self.subject.origin, self.n_angles, self.factor)

    def in_metres(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Unknowns (P,) of the body at its own size, and what the scan has to be multiplied with for it."""
        out, place = x.copy(), slice(self.n_angles, self.n_angles + 3)
        out[place] = (self.subject.origin + x[place]) / self.factor - self.subject.origin
        return out, 1 / self.factor


@dataclass(frozen=True, eq=False)
class ResizedPoints:
    """Points of a body with all lengths times a factor."""

    inner: NearPoints
    origin: np.ndarray               # (3,) metres, where the root's joint stands without a place
    n_angles: int
    factor: float

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(L, 3) metres, of unknowns (P,)."""
        return resize(self.inner.positions(x), self.origin + x[self.n_angles:self.n_angles + 3], self.factor)

    def columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (L, 3) and their derivatives (P, 3, L)."""
        y, columns = self.inner.columns(x)
        columns = self.factor * columns
        columns[self.n_angles:self.n_angles + 3] = np.eye(3)[..., None]        # the place is not resized
        return resize(y, self.origin + x[self.n_angles:self.n_angles + 3], self.factor), columns


def resize(points: np.ndarray, about: np.ndarray, factor: float) -> np.ndarray:
    """Scale points (L, 3) about a point (3,) by a factor."""
    return about + factor * (points - about)


@dataclass(frozen=True, eq=False)
class Anchor:
    """The derivative of vertices by betas at one pose, carried to other poses by the bones; made by `anchor_at`.

    Each vertex keeps its derivative in the frame of its part, relative to the part's joint. Stitching takes a quarter
    of a second, carrying a millisecond. With joints turned by half a radian the error is a twentieth.
    """

    skeleton: Skeleton
    part: np.ndarray                 # (L,) of each vertex
    R: np.ndarray                    # (J, 3, 3), rotations of the parts
    joints: np.ndarray               # (J, 3, K), derivative of the joints
    local: np.ndarray                # (L, 3, K), of the vertices, less that of their parts' joints

    def largest_angle(self, pose: np.ndarray) -> float:
        """Compute the largest angle, radians, by which a part is turned from the anchor at a pose (J, 3)."""
        R = self.skeleton.part_rotations(pose)
        return float(np.linalg.norm(rotations.log(np.swapaxes(self.R, 1, 2) @ R), axis=1).max())

    def some(self, ids: np.ndarray) -> Anchor:
        """Restrict the anchor to some vertices (L,)."""
        return replace(self, part=self.part[ids], local=self.local[ids])

    def carry(self, ids: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Compute the derivative (L, 3, K) of some vertices at a pose (J, 3)."""
        return self._carry(self.local[ids], self.part[ids], self.joints, pose)

    def shift_by_betas(self, pose: np.ndarray, betas: np.ndarray) -> np.ndarray:
        """Compute the shift (L, 3), metres, of the vertices by betas (K,) at a pose (J, 3)."""
        return self._carry((self.local @ betas)[..., None], self.part, (self.joints @ betas)[..., None], pose)[..., 0]

    def _carry(self, local: np.ndarray, part: np.ndarray, at_joints: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Carry vectors of vertices (L, 3, k) and joints (J, 3, k) to a pose, with the rotations of the parts."""
        parents = self.skeleton.parents
        turn = self.skeleton.part_rotations(pose) @ np.swapaxes(self.R, 1, 2)
        joints = at_joints.copy()
        for j in range(1, len(parents)):
            p = parents[j]
            joints[j] = joints[p] + turn[p] @ (at_joints[j] - at_joints[p])
        return turn[part] @ local + joints[part]


def anchor_at(model: BodyModel, pose: np.ndarray) -> Anchor:
    """Compute the derivative of all vertices of a model by its betas at a pose (J, 3)."""
    part = model.skeleton.part_of_vertex(model.template)
    D = model.shape_jacobian(pose) if pose.any() else model.rest_shape_jacobian
    joints = (model.joint_regressor @ D.reshape(len(D), -1)).reshape(-1, *D.shape[1:])
    return Anchor(model.skeleton, part, model.skeleton.part_rotations(pose), joints, D - joints[part])


def as_body(body: BodyModel | Subject) -> FixedBody:
    """Wrap a model (unknown shape) or a subject (known shape) in the common interface."""
    if isinstance(body, Subject):
        return FixedBody(body)
    if isinstance(body, BodyModel):
        return ShapedBody(body) if body.n_betas else FixedBody(body.subject(None))
    raise ValueError(f"body: expected a BodyModel or a Subject, got {type(body).__name__}")


def at_rest(model: BodyModel) -> Mesh:
    """Compute the mean person, or the character, in the pose of the template."""
    pose = np.zeros((len(model.skeleton.parents), 3))
    mean = np.zeros(model.n_betas) if model.n_betas else None
    return model.template.with_vertices(model.vertices(pose, mean), model.template.up)
