"""What a model transferred to another resolution still lacks, found by comparing the two in many poses."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

from ..pose_space import PoseSpace
from ..scape import ScapeModel
from ..shape_space import ShapeSpace
from .pieces import gradients_of

Progress = Callable[[int, int], None]

SHRINK = 1e-3                        # of the mean square: holds what the poses do not show


class Follower:
    """The vertices of one triangulation as points that ride on another one, both at rest."""

    def __init__(self, ridden: Mesh, rider: Mesh) -> None:
        self._on = Surface(ridden).closest(rider.vertices)
        self._corners = ridden.faces[self._on.faces]
        off = rider.vertices - self._on.points
        self._off = np.einsum("nji,nj->ni", _frames(ridden.vertices[self._corners]), off)

    def positions(self, vertices: np.ndarray) -> np.ndarray:
        """Where the riders (..., n, 3) are when the ridden vertices are at (..., N, 3), metres."""
        corners = vertices[..., self._corners, :]
        return self._between(corners) + np.einsum("...nij,nj->...ni", _frames(corners), self._off)

    def displacements(self, fields: np.ndarray) -> np.ndarray:
        """What the riders (..., n, 3) have of a small displacement (..., N, 3), metres."""
        return self._between(fields[..., self._corners, :])

    def values(self, values: np.ndarray) -> np.ndarray:
        """What the riders (n, k) have of values (N, k) of the ridden vertices."""
        return np.einsum("nc,nck->nk", self._on.bary, values[self._corners])

    def _between(self, corners: np.ndarray) -> np.ndarray:
        return np.einsum("nc,...ncd->...nd", self._on.bary, corners)


def _frames(corners: np.ndarray) -> np.ndarray:
    """(..., 3, 3) an orthonormal frame, in columns, of triangles (..., 3, 3)."""
    first, second = corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :]
    normal = np.cross(first, second)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    first = first / np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(normal, first), normal], axis=-1)


@dataclass(frozen=True, eq=False)
class Distillation:
    """Lowers what a transferred model leaves of the model it was made of, in rounds.

    The way is that of learning: what is left of every body, as edges in the frames of the parts, is regressed and added
    to what the triangles have. `follow` puts the imitation's vertices on the model's.
    """

    model: ScapeModel
    follow: Follower
    rounds: int
    progress: Progress | None = None

    def pose_space(self, imitation: ScapeModel, poses: np.ndarray) -> ScapeModel:
        """The imitation with a pose space corrected on the template's own body in poses (M, J, 3).

        [SCAPE] Eq. 4
        """
        wanted = self.follow.positions(self.model.subject(None).vertices(poses))
        for _ in range(self.rounds):
            left = wanted - imitation.subject(None).vertices(poses)
            local = imitation.parts.local_edges(left, poses)
            imitation = replace(imitation, pose_space=_corrected(imitation, poses, local))
        return imitation

    def shape_space(self, imitation: ScapeModel, poses: np.ndarray) -> ScapeModel:
        """The imitation with a mean person and shape components corrected in poses (M, J, 3).

        [SCAPE] Eq. 8
        """
        if not self.model.n_betas:
            return imitation
        total, done = (self.rounds + 1) * len(poses), 0
        wanted = []
        for pose in poses:
            mean, slope = _people(self.model, pose)
            wanted.append((self.follow.positions(mean), self.follow.displacements(slope).astype(np.float32)))
            done = self._tell(done + 1, total)
        for _ in range(self.rounds):
            square, product = np.zeros((3, 3)), np.zeros((3, 3))
            for pose, (y, dy) in zip(poses, wanted, strict=True):
                mean, slope = _people(imitation, pose)
                local = imitation.parts.local_edges(np.concatenate([(y - mean)[None], dy - slope]), pose)
                posed = imitation.posed_edges(pose)
                square = square + np.swapaxes(posed, -1, -2) @ posed
                product = product + np.swapaxes(local, -1, -2) @ posed
                done = self._tell(done + 1, total)
            shrink = SHRINK * np.trace(square, axis1=-2, axis2=-1)[:, None, None] * np.eye(3)
            more, space = product @ np.linalg.inv(square + shrink), imitation.shape_space
            imitation = replace(imitation, shape_space=ShapeSpace(
                (space.mean + more[0]).astype(space.mean.dtype),
                (space.components + more[1:]).astype(space.components.dtype), space.variances, space.total_variance))
        return imitation

    def _tell(self, done: int, total: int) -> int:
        if self.progress:
            self.progress(done, total)
        return done


def _corrected(model: ScapeModel, poses: np.ndarray, local: np.ndarray) -> PoseSpace:
    """The pose space with a regression of edges (M, F, 2, 3) that are left in poses (M, J, 3) added."""
    space, v_hat = model.pose_space, model.parts.v_hat
    delta = space.features.evaluate(poses)
    coefficients = []
    for p, faces in enumerate(space.faces_of_part):
        X = delta[:, space.features.of_part(p)]
        shrink = SHRINK * np.diag(np.maximum((X**2).sum(axis=0), 1e-12))
        slope = np.linalg.solve(X.T @ X + shrink, X.T @ local[:, faces].reshape(len(X), -1))
        more = gradients_of(v_hat[faces], slope.reshape(-1, len(faces), 2, 3))
        coefficients.append((space.coefficients[p] + more).astype(space.coefficients[p].dtype))
    return PoseSpace(space.features, tuple(coefficients))


def _people(model: ScapeModel, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mean person (N, 3) in a pose, and the change (K, N, 3) by each beta."""
    return model.vertices(pose, np.zeros(model.n_betas)), np.moveaxis(model.shape_jacobian(pose), -1, 0)


def enough_poses(model: ScapeModel, least: int) -> int:
    """How many poses determine the features of every part."""
    # three poses for each feature of the part that has most
    return max(least, 3 * int(np.bincount(model.pose_space.features.part).max()))
