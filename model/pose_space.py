"""From joint twists to the pose-dependent deformation Q of every triangle."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .features import PoseFeatures, linear_features, twists


@dataclass(frozen=True, eq=False)
class PoseSpace:
    """Q of every triangle as a linear function of the features of its part: J arrays (n_p, F_p, 3, 3) of coefficients.

    [SCAPE] Eq. 3
    """

    features: PoseFeatures
    coefficients: tuple[np.ndarray, ...]

    @property
    def skeleton(self) -> Skeleton:
        return self.features.skeleton

    @cached_property
    def faces_of_part(self) -> tuple[np.ndarray, ...]:
        """The triangles of every part."""
        return faces_of_part(self.skeleton)

    def gradients(self, pose: np.ndarray) -> np.ndarray:
        """Compute Q (..., F, 3, 3) at poses (..., J, 3), radians.

        [SCAPE] Eq. 3
        """
        delta = self.features.evaluate(pose)
        Q = np.empty((*delta.shape[:-1], len(self.skeleton.part_of_face), 3, 3))
        for p, faces in enumerate(self.faces_of_part):
            a = self.coefficients[p].astype(np.float64)
            value = delta[..., self.features.of_part(p)] @ a.reshape(len(a), -1)
            Q[..., faces, :, :] = value.reshape(*delta.shape[:-1], len(faces), 3, 3)
        return Q

    def add(self, other: PoseSpace) -> PoseSpace:
        """Add a pose space on the same skeleton: Q is the sum, with the features of both."""
        one, two = self.features, other.features
        if one.lift.kind != two.lift.kind:
            raise ValueError(f"pose spaces: expected features of one kind, got {one.lift.kind} and {two.lift.kind}")
        part, mixes, coefficients = [], [], []
        for p, (a, b) in enumerate(zip(self.coefficients, other.coefficients, strict=True)):
            part += [p] * (len(a) + len(b) - 1)                # the two constants become one
            mixes += [one.mix[..., one.of_part(p)], two.mix[..., two.of_part(p)][..., 1:]]
            coefficients.append(np.concatenate([a[:1] + b[:1], a[1:], b[1:]]))
        features = PoseFeatures(self.skeleton, one.lift, np.array(part), np.concatenate(mixes, axis=-1))
        return PoseSpace(features, tuple(coefficients))

    @staticmethod
    def identity(skeleton: Skeleton) -> PoseSpace:
        """Build the pose space without deformation: rigid parts, Q = I."""
        features = linear_features(skeleton, tuple(np.zeros((3, 0)) for _ in skeleton.parents))
        return PoseSpace(features, tuple(np.broadcast_to(np.eye(3, dtype=np.float32), (1, len(f), 3, 3)).copy()
                                         for f in faces_of_part(skeleton)))


def faces_of_part(skeleton: Skeleton) -> tuple[np.ndarray, ...]:
    """List the triangles of every part, in the order of the faces."""
    return tuple(np.flatnonzero(skeleton.part_of_face == p) for p in range(len(skeleton.parents)))


def nearest_joints(template: Mesh, skeleton: Skeleton, count: int = 2) -> np.ndarray:
    """Find the `count` joints of its part nearest to each triangle on the template, as (F, J) bool.

    [SCAPE] §4.2
    """
    near = np.zeros((len(template.faces), len(skeleton.parents)), dtype=bool)
    centre = template.corners.mean(axis=1)
    for p, faces in enumerate(faces_of_part(skeleton)):
        joints = np.array(skeleton.joints_of_part[p], dtype=np.int64)
        far = np.linalg.norm(centre[faces, None] - skeleton.joints[joints], axis=2)
        chosen = joints[np.argsort(far, axis=1, kind="stable")[:, :count]]
        near[faces[:, None], chosen] = True
    return near


def principal_directions(poses: np.ndarray, threshold: float) -> tuple[np.ndarray, ...]:
    """Find the principal twist directions with at least a variance, rad²: J arrays (3, k_j), the largest first.

    [SCAPE] §4.2
    """
    observed = twists(poses)
    # PCA of every joint's twists; the root has no twist, and directions never seen (1e-12) are always dropped
    kept = [np.zeros((3, 0))]
    for j in range(1, observed.shape[1]):
        centred = observed[:, j] - observed[:, j].mean(axis=0)
        variance, axes = np.linalg.eigh(centred.T @ centred / len(centred))
        kept.append(axes[:, ::-1][:, variance[::-1] >= max(threshold, 1e-12)])
    return tuple(kept)
