"""Pose a body by dragging: joints between trunk and a point turn until the point is where the mouse wants it."""
from __future__ import annotations

import numpy as np

from model.features import twists
from model.linear import PointOperator
from model.priors import whitening

from .movable import MovableBody

HOLD, USUAL = 0.05, 0.02             # weights of two priors: the pose when grabbed, and the model's own poses


class Drag:
    """A vertex that the user drags.

    Parameters
    ----------
    body : MovableBody
        The body.
    vertex : int
        Vertex that was grabbed.
    betas : (K,) float or None
        Shape of the body.
    pose : (J, 3) float, radians
        Pose at the start of the drag.
    """

    def __init__(self, body: MovableBody, vertex: int, betas: np.ndarray | None, pose: np.ndarray) -> None:
        self.operator: PointOperator = body.point(vertex, betas)
        self.part = int(body.part_of_vertex[vertex])
        # only the joints between the part and the root turn
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
        """Compute pose (J, 3) and trans (3,) that bring the vertex towards a target (3,), metres.

        A few Gauss-Newton steps, each shortened until the energy falls. A vertex of the root part moves the whole body.
        """
        here = self.operator.evaluate(pose, trans)[0]
        way = target - here                         # at most a quarter of the body's size at a time
        target = here + way * min(1.0, 0.25 * self.size / max(float(np.linalg.norm(way)), 1e-9))
        if not len(self.columns):
            return pose, trans + target - here

        def pose_residuals(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            """Return the distance of the turning joints from the start of the drag, and from the mean pose."""
            x = pose.ravel()[self.columns]
            return x - self.start[self.columns], x - self.mean[self.columns]

        near = 0.01  # metres: a point this far from its target costs 1
        def energy(pose: np.ndarray) -> float:
            """Compute the weighted squares: distance from the target, and both priors."""
            held, usual = pose_residuals(pose)
            miss = (self.operator.evaluate(pose, trans)[0] - target) / near
            return float(miss @ miss + HOLD * held @ self.precision @ held + USUAL * usual @ self.precision @ usual)

        # four steps per mouse event suffice, as the next event goes on from here
        for _ in range(4):
            y, J = self.operator.jacobian(pose, trans)
            miss, J = (y[0] - target) / near, J[0][:, self.columns] / near
            held, usual = pose_residuals(pose)
            H = J.T @ J + (HOLD + USUAL) * self.precision
            g = J.T @ miss + self.precision @ (HOLD * held + USUAL * usual)
            step = -np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(len(H)), g)
            step *= min(1.0, 0.4 / max(float(np.abs(step).max()), 1e-12))    # radians: largest turn of a joint
            # take the longest of these fractions of the step that lowers the energy
            for shorter in (1, 3, 9, 27, 81):
                candidate = pose.copy()
                candidate.ravel()[self.columns] += step / shorter
                if energy(candidate) < energy(pose):
                    pose = candidate
                    break
        # keep angles below half a turn
        out = pose.copy()
        out[1:] = twists(pose)[1:]
        return out, trans
