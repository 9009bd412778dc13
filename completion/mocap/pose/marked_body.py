"""A body that carries markers: where they are, and the normal equations of a batch of frames."""
from __future__ import annotations

import numpy as np

from model.features import twists
from model.linear import Subject
from model.priors import gaussian_prior
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense
from scanprep.geometry.mesh import Mesh

from ...bodies import FixedBody
from ...energy import MovingPoints, moving_points
from ..marker_sets.layout import MarkerLayout
from . import fast_rotations as turns
from .marker_points import PartShapes, marker_shapes

System = tuple[np.ndarray, np.ndarray, np.ndarray]                      # energy, half its gradient, Gauss-Newton matrix
BATCH = 64                           # frames whose parts are held at once


class MarkedBody:
    """A body of known shape with markers; unknowns are x = (pose (3J), trans (3)), steps are small turns.

    A step (P,) turns every joint from the right, `exp(pose) exp(d)`, so that nothing happens at a half turn.

    Parameters
    ----------
    subject : Subject
    layout : MarkerLayout
    prior_weight, prior_shrinkage : float
        See `AnimateConfig`.
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
        pose, trans, _ = self.body.split(x)
        pose, trans = pose.reshape(-1, *pose.shape[-2:]), trans.reshape(-1, 3)
        y = np.empty((len(pose), 3, self.count))
        for start in range(0, len(pose), BATCH):
            some = slice(start, start + BATCH)
            y[some] = self.shapes.evaluate(pose[some], trans[some])
        return np.swapaxes(y, -1, -2).reshape(*x.shape[:-1], self.count, 3)

    def follow(self, x: np.ndarray) -> MovingPoints:
        """The markers for unknowns (B, P), with their derivatives by the unknowns themselves."""
        pose, trans, _ = self.body.split(x)
        y, by_turn = self.shapes.columns(pose, trans)
        B, J = pose.shape[:2]
        by_turn = np.moveaxis(by_turn.reshape(B, J, 3, 3, self.count), 2, -1)                    # (B, J, 3, L, 3)
        by_pose = by_turn @ rotations.right_jacobian(pose)[:, :, None]
        return moving_points(np.swapaxes(y, -1, -2),
                             by_pose.transpose(0, 3, 2, 1, 4).reshape(B, self.count, 3, 3 * J))

    def system(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, stiff: float = 1.0) -> Dense:
        """Markers and pose prior: energy (B,), half its gradient (B, P) and Gauss-Newton matrix (B, P, P).

        Parameters
        ----------
        x : (B, P) float
        targets : (B, L, 3) float, metres
            NaN where a marker was not seen.
        weights : (B, L) float
            Factor on the squared distance.
        stiff : float
            Further factor on the pose prior.

        [SCAPE] §8
        """
        pose, trans, _ = self.body.split(x)
        n = self.body.n_angles
        energy, gradient, hessian = point_system(self.shapes, pose, trans, targets, weights)
        prior = self.prior_system(pose, stiff)
        gradient[:, :n] += prior[1]
        hessian[:, :n, :n] += prior[2]
        return Dense(energy + prior[0], gradient, hessian)

    def prior_system(self, pose: np.ndarray, stiff: float = 1.0) -> System:
        """The pose prior at poses (B, J, 3): energy (B,), half its gradient (B, 3J), its matrix (B, 3J, 3J)."""
        pose = twists(pose)
        B, n = len(pose), self.body.n_angles
        local = rotations.inverse_right_jacobian(pose)                                           # dpose = local d
        off = pose.reshape(B, n) - self.prior.mean
        precision = stiff * self._precision
        pull = off @ precision
        gradient = (pull.reshape(B, -1, 1, 3) @ local).reshape(B, n)
        half = precision.reshape(n, -1, 3).swapaxes(0, 1) @ local                          # (B, J, n, 3)
        half = half.reshape(B, -1, n // 3, 3, 3).swapaxes(-1, -2)                                # transposed rows
        hessian = (half @ local[:, None]).transpose(0, 1, 3, 2, 4).reshape(B, n, n)
        return (pull * off).sum(axis=1), gradient, hessian

    def retract(self, x: np.ndarray, step: np.ndarray) -> np.ndarray:
        """The unknowns (..., P) after a step (..., P); poses come out at most a half turn long."""
        n = self.body.n_angles
        out = x + step
        out[..., :n] = turns.compose(*(a[..., :n].reshape(-1, 3) for a in (x, step))).reshape(*x.shape[:-1], n)
        return out

    def step_to(self, x: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """The step (..., P) that leads from unknowns (..., P) to others."""
        n = self.body.n_angles
        out = goal - x
        out[..., :n] = turns.compose(*(a[..., :n].reshape(-1, 3) for a in (-x, goal))).reshape(*x.shape[:-1], n)
        return out


def point_system(shapes: PartShapes, pose: np.ndarray, trans: np.ndarray, targets: np.ndarray, weights: np.ndarray
                 ) -> System:
    """Points that are to be at their targets (B, L, 3): energy (B,), half its gradient, Gauss-Newton matrix.

    Parameters
    ----------
    pose, trans : (B, J, 3), (B, 3) float
    targets : (B, L, 3) float, metres
        NaN where there is none.
    weights : (B, L) float
        Factor on the squared distance.
    """
    y, by_turn = shapes.columns(pose, trans)
    (B, n), L = by_turn.shape[:2], shapes.count
    missing = np.isnan(targets[..., 0])
    root = np.sqrt(np.where(missing, 0.0, weights))[:, None]
    residual = (root * np.where(missing[:, None], 0.0, y - np.swapaxes(targets, -1, -2))).reshape(B, -1)
    columns = np.empty((B, n + 3, 3, L))
    np.multiply(by_turn, root[:, None], out=columns[:, :n])
    columns[:, n:] = np.eye(3)[:, :, None] * root[:, None]
    A = columns.reshape(B, n + 3, -1)
    return (residual**2).sum(axis=1), (A @ residual[..., None])[..., 0], A @ np.swapaxes(A, -1, -2)


def supports(template: Mesh, layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Three points of the skin for each marker: below it, and two around it that span its tangent plane.

    A marker on a triangle has the triangle's own plane. For one on a vertex the two are weighted sums of the ring of
    neighbours, with cosines and sines of the angle about the normal as weights, so that their cross product is a
    smooth normal that moves with the body.

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
        if len(set(mine.tolist())) == 3:
            rows += [(mine, share + side) for side in _sides(template, mine)]
            continue
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


def _sides(template: Mesh, corners: np.ndarray) -> np.ndarray:
    """(3, 3) what leads from the place of a marker to its three supports, as weights of the corners of its triangle.

    The supports turn about the outward normal, whichever way round the corners (3,) are named.
    """
    p = template.vertices[corners]
    outward = np.cross(p[1] - p[0], p[2] - p[0]) @ template.vertex_normals[corners].sum(axis=0) >= 0
    sides = np.array([[0, 0, 0], [-1, 1, 0], [-1, 0, 1]])
    return sides if outward else sides[[0, 2, 1]]
