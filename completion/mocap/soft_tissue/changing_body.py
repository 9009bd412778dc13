"""Bodies whose betas change in every frame: their vertices, and the places of their markers with derivatives."""
from __future__ import annotations

import numpy as np

from model.body import BodyModel
from model.linear import check_pose, posed_product
from scanprep.geometry import rotations

from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import BATCH, MarkedBody, System, supports

AT_ONCE = 32                         # bodies that are made together


def changing_bodies(model: BodyModel, poses: np.ndarray, betas: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """Vertices (T, N, 3), metres, each frame with betas of its own (T, k), exact."""
    poses, trans = check_pose(model.skeleton, poses, trans)
    if betas.ndim != 2 or len(betas) != len(poses) or betas.shape[1] > model.n_betas:
        raise ValueError(f"betas: expected ({len(poses)}, k) with k at most {model.n_betas}, got {betas.shape}")
    out = np.empty((len(poses), len(model.template.vertices), 3))
    for start in range(0, len(poses), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        out[some] = model.bodies_of(poses[some], betas[some])
    out += (model.skeleton.joints[0] + trans)[:, None]
    return out


def skin_movement(model: BodyModel, changes: np.ndarray) -> np.ndarray:
    """How far changes of betas (T, k) move every vertex (N,), metres: the root of the mean square over time.

    In the mean pose; other poses turn the movement, and hardly lengthen it.
    """
    D = model.shape_jacobian(model.pose_mean)[..., :changes.shape[1]]
    moment = changes.T @ changes / max(len(changes), 1)
    return np.sqrt(np.maximum(np.einsum("ndk,ndk->n", D @ moment, D), 0.0))


def skin_metric(model: BodyModel, slopes: np.ndarray) -> np.ndarray:
    """(K, K): `Δ @ metric @ Δ` is how far a change Δ of betas moves the skin, squared, square metres.

    The mean over the surface, areas as on the template; `slopes` (N, 3, K) are the vertices' derivatives by betas.
    """
    areas = model.template.vertex_areas
    D = (np.sqrt(areas / areas.sum())[:, None, None] * slopes).reshape(-1, slopes.shape[-1])
    return np.asarray(D.T @ D)


class ChangingBody:
    """A person with markers whose betas change by Δ = z @ directions around their own.

    Markers are affine in z, `y(θ) + D(θ) z`, and D (3L, K) is a linear function of products of features and rotations:
    for a batch of poses it is one matrix product. The derivative by the pose is that of the person's own shape.

    The directions (K, K) are rows of betas; `slopes` (N, 3, K) are derivatives of all vertices by betas in the mean
    pose, from which the turning of the skin is known.
    """

    def __init__(self, model: BodyModel, betas: np.ndarray, layout: MarkerLayout, directions: np.ndarray,
                 slopes: np.ndarray, prior_weight: float, prior_shrinkage: float) -> None:
        self.marked = MarkedBody(model.subject(betas), layout, prior_weight, prior_shrinkage)
        self.directions = directions
        self.count, self.n_betas = self.marked.count, len(directions)
        self.terms = model.terms
        self._flat = self._along(model, layout, slopes)

    def _along(self, model: BodyModel, layout: MarkerLayout, slopes: np.ndarray) -> np.ndarray:
        """(3M, K L): the change of the markers along the directions, normals included."""
        ids, weights = supports(model.template, layout)
        basis = model.points(ids[::3], weights[::3], self.n_betas).shape_basis
        distances = np.asarray(layout.distances)
        if distances.any():
            mean = self.marked.body.subject.vertices(model.pose_mean)
            corners, by_betas = (np.einsum("lk,lk...->l...", weights, of[ids]) for of in (mean, slopes))
            turning = normal_slopes(corners, by_betas)
            part = model.skeleton.part_of_vertex(model.template)[ids[::3, 0]]
            R = model.skeleton.part_rotations(model.pose_mean)
            plain = self.terms.features.constant[self.terms.feature] == 1
            for i, p in enumerate(part):
                row = np.flatnonzero(plain & (self.terms.part == p))[0]
                basis[:, row, i] += distances[i] * (R[p].T @ turning[i]).T
        K, M, L, _ = basis.shape
        along = (self.directions @ basis.reshape(K, -1)).reshape(K, M, L, 3)
        return np.ascontiguousarray(along.transpose(1, 3, 0, 2)).reshape(3 * M, -1)

    def slopes(self, pose: np.ndarray) -> np.ndarray:
        """Derivative (B, K, 3, L) of the markers by z at poses (B, J, 3), metres."""
        D = posed_product(self.terms, self._flat, pose)
        return D.reshape(len(pose), 3, self.n_betas, self.count).swapaxes(1, 2)

    def positions(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Where the body puts the markers (T, L, 3), metres, for unknowns (T, P) and changes z (T, K)."""
        pose, trans, _ = self.marked.body.split(x)
        y = np.empty((len(x), self.count, 3))
        for start in range(0, len(x), BATCH):
            some = slice(start, start + BATCH)
            D = self.slopes(pose[some])
            y[some] = np.swapaxes(self.marked.shapes.evaluate(pose[some], trans[some]), 1, 2)
            moved = z[some, None] @ D.reshape(len(D), self.n_betas, -1)
            y[some] += np.swapaxes(moved.reshape(len(D), 3, -1), 1, 2)
        return y

    def system(self, x: np.ndarray, z: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> System:
        """Markers and pose prior at x (B, P), z (B, K): energy (B,), half its gradient (B, P + K), its matrix.

        Markers are to be at targets (B, L, 3), metres, NaN where not seen; weights (B, L) are on squared metres.
        """
        pose, trans, _ = self.marked.body.split(x)
        y, by_turn = self.marked.shapes.columns(pose, trans)
        D = self.slopes(pose)
        y += (z[:, None] @ D.reshape(len(x), self.n_betas, -1)).reshape(y.shape)
        (B, n), P, L = by_turn.shape[:2], x.shape[1], self.count
        root, residual = _weighed(y, targets, weights)
        A = np.empty((B, P + self.n_betas, 3, L))
        np.multiply(by_turn, root[:, None], out=A[:, :n])
        A[:, n:P] = np.eye(3)[:, :, None] * root[:, None]
        np.multiply(D, root[:, None], out=A[:, P:])
        A = A.reshape(B, P + self.n_betas, -1)
        energy, gradient, hessian = (residual**2).sum(axis=1), (A @ residual[..., None])[..., 0], A @ A.swapaxes(1, 2)
        prior = self.marked.prior_system(pose)
        gradient[:, :n] += prior[1]
        hessian[:, :n, :n] += prior[2]
        return energy + prior[0], gradient, hessian

    def change_system(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Half the gradient (B, K) of the markers by z, at z = 0, and its matrix (B, K, K); as for `system`."""
        pose, trans, _ = self.marked.body.split(x)
        root, residual = _weighed(self.marked.shapes.evaluate(pose, trans), targets, weights)
        A = (self.slopes(pose) * root[:, None]).reshape(len(x), self.n_betas, -1)
        return (A @ residual[..., None])[..., 0], A @ A.swapaxes(1, 2)


def _weighed(y: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Roots of the weights (B, 1, L), 0 where nothing was seen, and the residuals (B, 3L) of places (B, 3, L)."""
    missing = np.isnan(targets[..., 0])
    root = np.sqrt(np.where(missing, 0.0, weights))[:, None]
    return root, (root * np.where(missing[:, None], 0.0, y - np.swapaxes(targets, -1, -2))).reshape(len(y), -1)


def normal_slopes(corners: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """Derivative (L, 3, K) of unit normals by betas, from three points of the skin each (3L, 3), and theirs (3L, 3, K).
    """
    p = corners.reshape(-1, 3, 3)
    J = slopes.reshape(*p.shape, -1)
    u, v = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    c = np.cross(u, v)
    length = np.linalg.norm(c, axis=-1)[:, None]
    n = c / length
    tangent = (np.eye(3) - n[:, :, None] * n[:, None, :]) / length[..., None]
    return np.asarray(tangent @ (rotations.hat(u) @ (J[:, 2] - J[:, 0]) - rotations.hat(v) @ (J[:, 1] - J[:, 0])))
