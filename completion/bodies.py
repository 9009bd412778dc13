"""One face for bodies of known and of unknown shape: unknowns in, points with derivatives out."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .energy import MovingPoints, moving_points

Follow = Callable[[np.ndarray], MovingPoints]


class FixedBody:
    """A body of known shape; unknowns are x = (pose (3J), trans (3)).

    Parameters
    ----------
    subject : Subject
    """

    n_betas = 0

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self.template: Mesh = subject.template
        self.skeleton: Skeleton = subject.skeleton
        self.n_angles = 3 * len(subject.skeleton.parents)
        if subject.pose_mean is None or subject.pose_covariance is None:
            raise ValueError("subject: expected one that a model made, with its pose prior")
        self.pose_mean, self.pose_covariance = subject.pose_mean, subject.pose_covariance

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

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        pose, trans, _ = self.split(x)
        return self.subject.vertices(pose, trans).astype(np.float64)

    def follow(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> Follow:
        """Surface points as a function of the unknowns (B, P), valid near x (P,).

        Parameters
        ----------
        vertex_ids, weights
            As for `Subject.points`.
        """
        operator = self.subject.points(vertex_ids, weights)

        def move(x: np.ndarray) -> MovingPoints:
            pose, trans, _ = self.split(x)
            return moving_points(*operator.jacobian(pose, trans))

        return move


class ShapedBody(FixedBody):
    """A body of unknown shape; unknowns are x = (pose (3J), trans (3), betas (K)).

    Vertices are affine in betas with a matrix that turns with the pose. Between two calls of `follow` that
    matrix is held, and the fast path of the last subject gives the derivative by the pose; the subject is
    built anew when betas have gone some way from it.

    Parameters
    ----------
    model : BodyModel
    renew : float
        Length of the step in betas, in standard deviations, after which the subject is rebuilt.
    """

    def __init__(self, model: BodyModel, renew: float = 0.5) -> None:
        self.model, self.renew = model, renew
        self.n_betas = model.n_betas
        self.template, self.skeleton = model.template, model.skeleton
        self.n_angles = 3 * len(model.skeleton.parents)
        self.pose_mean, self.pose_covariance = model.pose_mean, model.pose_covariance
        self._at = np.zeros(self.n_betas)
        self.subject = model.subject(self._at)

    def held(self, x: np.ndarray) -> FixedBody:
        """The body with the shape it has at x (P,), as one of known shape."""
        return FixedBody(self.model.subject(self.split(x)[2]))

    def vertices(self, x: np.ndarray) -> np.ndarray:
        """The predicted mesh (N, 3) of unknowns (P,)."""
        pose, trans, betas = self.split(x)
        return self.model.vertices(pose, betas, trans)

    def follow(self, vertex_ids: np.ndarray, x: np.ndarray, weights: np.ndarray | None = None) -> Follow:
        """Surface points as a function of the unknowns (B, P), valid near x (P,)."""
        pose, _, betas = self.split(x)
        if np.linalg.norm(betas - self._at) > self.renew:
            self._at = betas.copy()
            self.subject = self.model.subject(betas)
        operator, at = self.subject.points(vertex_ids, weights), self._at
        D = self.model.shape_jacobian(pose, vertex_ids=vertex_ids.ravel())
        D = D.reshape(*vertex_ids.shape, *D.shape[1:])
        if weights is not None:
            D = np.einsum("lk,lkdb->ldb", weights, D)

        def move(x: np.ndarray) -> MovingPoints:
            pose, trans, betas = self.split(x)
            positions, d_pose = operator.jacobian(pose, trans)
            shift = np.einsum("ldk,...k->...ld", D, betas - at)
            return moving_points(positions + shift, d_pose, D)

        return move


def as_body(body: BodyModel | Subject) -> FixedBody:
    """The face for a model (shape unknown) or a subject (shape known).

    Raises
    ------
    ValueError
        Neither of the two.
    """
    if isinstance(body, Subject):
        return FixedBody(body)
    if isinstance(body, BodyModel):
        return ShapedBody(body) if body.n_betas else FixedBody(body.subject(None))
    raise ValueError(f"body: expected a BodyModel or a Subject, got {type(body).__name__}")
