"""One face for bodies of known and of unknown shape: unknowns in, points with derivatives out."""
from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from model.body import BodyModel
from model.human_poses import human_poses
from model.linear import Subject
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .energy import MovingPoints, moving_points

Follow = Callable[[np.ndarray], MovingPoints]
PEOPLE = 150                         # poses that people take, beside those a body was seen in


class FixedBody:
    """A body of known shape; unknowns are x = (pose (3J), trans (3))."""

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
        """(M, J, 3) radians, that the body was seen in, and for a person as many as `PEOPLE` that people take."""
        people = human_poses(self.template, self.skeleton, PEOPLE, np.random.default_rng(0))
        return self.pose_examples if people is None else np.concatenate([self.pose_examples, people])

    def joints_from_known(self, pose: np.ndarray) -> np.ndarray:
        """(J,) radians by which each joint of a pose (J, 3) is turned from the nearest known one; 0 for the root."""
        if not len(self.known_poses):
            return np.zeros(len(pose))
        turns = np.swapaxes(rotations.exp(self.known_poses), -1, -2) @ rotations.exp(pose)
        away = np.linalg.norm(rotations.log(turns), axis=-1).min(axis=0)
        away[0] = 0
        return away

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pose (..., J, 3), trans (..., 3) and betas (..., K)."""
        n = self.n_angles
        return x[..., :n].reshape(*x.shape[:-1], -1, 3), x[..., n:n + 3], x[..., n + 3:]

    def join(self, pose: np.ndarray, trans: np.ndarray) -> np.ndarray:
        """Unknowns (..., P) from pose (..., J, 3) and trans (..., 3), betas zero."""
        betas = np.zeros((*trans.shape[:-1], self.n_betas))
        return np.concatenate([pose.reshape(*pose.shape[:-2], -1), trans, betas], axis=-1)

    def held(self, x: np.ndarray) -> FixedBody:
        """The body with the shape it has at x (P,), as one of known shape."""
        return self

    def in_metres(self, x: np.ndarray) -> tuple[np.ndarray, float]:
        """Unknowns (P,) of the body at its own size, and what the scan has to be multiplied with for it."""
        return x, 1.0

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        pose, trans, _ = self.split(x)
        return self.subject.vertices(pose, trans).astype(np.float64)

    def follow(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> Follow:
        """Surface points as a function of the unknowns (B, P), valid near x (P,)."""
        operator = self.subject.points(vertex_ids, weights)

        def move(x: np.ndarray) -> MovingPoints:
            pose, trans, _ = self.split(x)
            return moving_points(*operator.jacobian(pose, trans))

        return move


class ShapedBody(FixedBody):
    """A body of unknown shape; unknowns are x = (pose (3J), trans (3), betas (K)).

    Vertices are affine in betas with a matrix D that turns with the pose. Stitching D is the dear part, so it is
    done at an anchor pose, and from there D is carried to nearby poses as bones carry skin: rigidly with its part,
    and along with the joint it hangs on. The derivative by the pose is that of the last subject that was built. Only
    derivatives are approximate in this way; at x itself the places are those of the model.

    `turn` radians, how far a part may turn before D is stitched anew.
    """

    def __init__(self, model: BodyModel, renew: float = 2.0, turn: float = 0.7) -> None:
        self.model, self.renew, self.turn = model, renew, turn
        self.n_betas = model.n_betas
        self.template, self.skeleton = model.template, model.skeleton
        self.n_angles = 3 * len(model.skeleton.parents)
        self.pose_mean, self.pose_covariance = model.pose_mean, model.pose_covariance
        self.pose_examples, self.left_out_error = model.pose_examples, model.info.get("left_out_error")
        self._at = np.zeros(self.n_betas)
        self.subject = model.subject(self._at)
        self._anchor: Anchor | None = None
        self._last = (np.zeros(0), np.zeros((0, 3)))

    def held(self, x: np.ndarray) -> FixedBody:
        """The body with the shape it has at x (P,), as one of known shape."""
        return FixedBody(self.model.subject(self.split(x)[2]))

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        if not np.array_equal(x, self._last[0]):
            pose, trans, betas = self.split(x)
            self._last = x.copy(), self.model.vertices(pose, betas, trans)
        return self._last[1]

    def follow(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> Follow:
        """Surface points as a function of the unknowns (B, P), valid near x (P,)."""
        pose, trans, betas = self.split(x)
        if np.linalg.norm(betas - self._at) > self.renew:
            self._at = betas.copy()
            self.subject = self.model.subject(betas)
        if self._anchor is None or self._anchor.turned(pose) > self.turn:
            self._anchor = Anchor(self.model, pose)
        operator, at = self.subject.points(vertex_ids, weights), self._at
        D, y = self._anchor.carried(vertex_ids.ravel(), pose), self.vertices(x)[vertex_ids]
        D = D.reshape(*vertex_ids.shape, *D.shape[1:])
        if weights is not None:
            D, y = np.einsum("lk,lkdb->ldb", weights, D), np.einsum("lk,lkd->ld", weights, y)
        gap = y - operator.evaluate(pose, trans) - D @ (betas - at)

        def move(x: np.ndarray) -> MovingPoints:
            pose, trans, betas = self.split(x)
            positions, d_pose = operator.jacobian(pose, trans)
            shift = gap + np.einsum("ldk,...k->...ld", D, betas - at)
            return moving_points(positions + shift, d_pose, D)

        return move


class Anchor:
    """The derivative of all vertices by betas at one pose, carried to other poses as bones carry skin.

    A vertex keeps its place in the frame of its part, and the part hangs on its joint. Stitching costs a quarter of
    a second, carrying a millisecond; with joints turned by half a radian it is off by a twentieth.

    `pose` (J, 3), radians.
    """

    def __init__(self, model: BodyModel, pose: np.ndarray) -> None:
        self.skeleton = model.skeleton
        self.part = model.skeleton.part_of_vertex(model.template)
        self.R = model.skeleton.part_rotations(pose)
        D = model.shape_jacobian(pose)
        self.joints = np.einsum("jn,ndk->jdk", model.joint_regressor.toarray(), D)
        self.local = D - self.joints[self.part]

    def turned(self, pose: np.ndarray) -> float:
        """The largest angle by which a part is turned at a pose (J, 3), radians."""
        R = self.skeleton.part_rotations(pose)
        return float(np.linalg.norm(rotations.log(np.swapaxes(self.R, 1, 2) @ R), axis=1).max())

    def carried(self, ids: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(L, 3, K) of some vertices at a pose (J, 3)."""
        parents = self.skeleton.parents
        turn = self.skeleton.part_rotations(pose) @ np.swapaxes(self.R, 1, 2)
        joints = self.joints.copy()
        for j in range(1, len(parents)):
            p = parents[j]
            joints[j] = joints[p] + turn[p] @ (self.joints[j] - self.joints[p])
        return turn[self.part[ids]] @ self.local[ids] + joints[self.part[ids]]


def as_body(body: BodyModel | Subject) -> FixedBody:
    """The face for a model (shape unknown) or a subject (shape known)."""
    if isinstance(body, Subject):
        return FixedBody(body)
    if isinstance(body, BodyModel):
        return ShapedBody(body) if body.n_betas else FixedBody(body.subject(None))
    raise ValueError(f"body: expected a BodyModel or a Subject, got {type(body).__name__}")


def at_rest(model: BodyModel, betas: np.ndarray | None = None) -> Mesh:
    """The body with betas (k,), else the mean person or character, in the pose of the template."""
    pose = np.zeros((len(model.skeleton.parents), 3))
    mean = np.zeros(model.n_betas) if model.n_betas else None
    return model.template.with_vertices(model.vertices(pose, mean if betas is None else betas))
