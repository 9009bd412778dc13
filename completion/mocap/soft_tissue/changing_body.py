"""Bodies whose betas change in every frame: their vertices, and the places of their markers with derivatives."""
from __future__ import annotations

import numpy as np

from model.body import BodyModel
from model.linear import check_pose
from scanprep.geometry.least_squares import Dense

from ...energy import MovingPoints, above_skin
from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import MarkedBody, batches, point_system, supports

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
    """(K, K): `Δ @ metric @ Δ` is how far a change Δ of betas moves the skin, square metres, the mean by area."""
    areas = model.template.vertex_areas
    D = (np.sqrt(areas / areas.sum())[:, None, None] * slopes).reshape(-1, slopes.shape[-1])
    return np.asarray(D.T @ D)


class ChangingBody:
    """A person with markers whose betas change by Δ = z @ directions (K, K) around their own.

    Markers are affine in z, `y(θ) + D(θ) z`, D (3L, K). `slopes` (N, 3, K) of all vertices by betas in the mean pose
    tell how the skin turns.
    """

    def __init__(self, model: BodyModel, betas: np.ndarray, layout: MarkerLayout, directions: np.ndarray,
                 slopes: np.ndarray, prior_weight: float, prior_shrinkage: float) -> None:
        self.marked = MarkedBody(model.subject(betas), layout, prior_weight, prior_shrinkage)
        self.directions = directions
        self.count, self.n_betas = self.marked.count, len(directions)
        ids, weights = supports(model.template, layout)
        self._skin = model.points(ids[::3], weights[::3], self.n_betas).along(directions)
        self._part = model.skeleton.part_of_vertex(model.template)[ids[::3, 0]]
        self._turning = self._normals(model, ids, weights, np.asarray(layout.distances), slopes)

    def _normals(self, model: BodyModel, ids: np.ndarray, weights: np.ndarray, distances: np.ndarray,
                 slopes: np.ndarray) -> np.ndarray:
        """(L, 3, K) the change of what lifts the markers off the skin, along the directions, in the frames of parts."""
        mean = self.marked.body.subject.vertices(model.pose_mean)
        skin = MovingPoints(*(np.einsum("lk,lk...->l...", weights, of[ids]) for of in (mean, slopes)))
        turning = above_skin(skin, np.ones(len(distances))).jacobian - skin.jacobian[::3]    # of the normals
        back = np.swapaxes(model.skeleton.part_rotations(model.pose_mean)[self._part], -1, -2)
        return np.asarray(distances[:, None, None] * (back @ turning @ self.directions.T))

    def slopes(self, pose: np.ndarray) -> np.ndarray:
        """Derivative (B, K, 3, L) of the markers by z at poses (B, J, 3), metres."""
        D = self._skin.shape_jacobian(pose)
        D += self._skin.skeleton.part_rotations(pose)[:, self._part] @ self._turning
        return D.transpose(0, 3, 2, 1)

    def positions(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Where the body puts the markers (T, L, 3), metres, for unknowns (T, P) and changes z (T, K)."""
        pose, _, _ = self.marked.body.split(x)
        y = self.marked.positions(x)
        for some in batches(len(x)):
            y[some] += np.swapaxes(_moved(z[some], self.slopes(pose[some])), 1, 2)
        return y

    def system(self, x: np.ndarray, z: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Dense:
        """Markers and pose prior at x (B, P), z (B, K), with P + K unknowns; arguments as of `point_system`."""
        pose, trans, _ = self.marked.body.split(x)
        (y, by_rotation), D = self.marked.shapes.columns(pose, trans), self.slopes(pose)
        data = point_system(y + _moved(z, D), np.concatenate([by_rotation, D], axis=1), targets, weights)
        return self.marked.with_prior(data, pose)

    def change_system(self, x: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> Dense:
        """Markers by z (B, K), at z = 0; as for `system`."""
        pose, trans, _ = self.marked.body.split(x)
        return point_system(self.marked.shapes.evaluate(pose, trans), self.slopes(pose), targets, weights)


def _moved(z: np.ndarray, D: np.ndarray) -> np.ndarray:
    """How changes z (B, K) move the markers (B, 3, L), with derivatives D (B, K, 3, L)."""
    return np.asarray((z[:, None] @ D.reshape(*z.shape, -1)).reshape(len(z), *D.shape[2:]))
