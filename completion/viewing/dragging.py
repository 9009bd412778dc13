"""A pose by dragging: joints between the trunk and a point of the body turn until the point is where it is wanted."""
from __future__ import annotations

import numpy as np

from model.features import twists
from model.linear import PointOperator
from model.priors import whitening

from .movable import MovableBody

HOLD, USUAL = 0.05, 0.02             # weights of the pose it had, and of poses the model was learned from


class Drag:
    """A vertex in the user's hand.

    Parameters
    ----------
    body : MovableBody
    vertex : int
    betas : (K,) float or None
    pose : (J, 3) float, radians
        When the hand took hold.
    """

    def __init__(self, body: MovableBody, vertex: int, betas: np.ndarray | None, pose: np.ndarray) -> None:
        self.operator: PointOperator = body.point(vertex, betas)
        self.part = int(body.part_of_vertex[vertex])
        chain, part = list[int](), self.part
        while part > 0:
            chain.append(part)
            part = int(body.skeleton.parents[part])
        self.columns = np.concatenate([3 * j + np.arange(3) for j in sorted(chain)] or [np.zeros(0, dtype=int)])
        self.start, self.mean = pose.ravel().copy(), body.model.pose_mean.ravel()
        W = whitening(body.model.pose_covariance)[:, self.columns]
        self.precision = W.T @ W
        self.size = float(np.ptp(body.model.template.vertices, axis=0).max())

    def drag_to(self, pose: np.ndarray, trans: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pose (J, 3) and trans (3,) that bring the vertex towards a target (3,), metres; the trunk moves as a whole.

        A few Gauss-Newton steps, each taken only as far as the energy falls.
        """
        here = self.operator.evaluate(pose, trans)[0]
        way = target - here                         # a point moves at most a quarter of the body's size at a time
        target = here + way * min(1.0, 0.25 * self.size / max(float(np.linalg.norm(way)), 1e-9))
        if not len(self.columns):
            return pose, trans + target - here

        def away(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            x = pose.ravel()[self.columns]
            return x - self.start[self.columns], x - self.mean[self.columns]

        near = 0.01  # metres: a point this far from where it is wanted costs 1
        def energy(pose: np.ndarray) -> float:
            held, usual = away(pose)
            off = (self.operator.evaluate(pose, trans)[0] - target) / near
            return float(off @ off + HOLD * held @ self.precision @ held + USUAL * usual @ self.precision @ usual)

        for _ in range(4):
            y, J = self.operator.jacobian(pose, trans)
            off, J = (y[0] - target) / near, J[0][:, self.columns] / near
            held, usual = away(pose)
            H = J.T @ J + (HOLD + USUAL) * self.precision
            g = J.T @ off + self.precision @ (HOLD * held + USUAL * usual)
            step = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(len(H)), g)
            step *= min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12))         # radians that a joint turns at a time
            for shorter in (1, 3, 9, 27, 81):
                tried = pose.copy()
                tried.ravel()[self.columns] += step / shorter
                if energy(tried) < energy(pose):
                    pose = tried
                    break
        out = pose.copy()
        out[1:] = twists(pose)[1:]
        return out, trans
