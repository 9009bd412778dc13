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
    """Q of every triangle as a linear function of the features of its part.

    Parameters
    ----------
    features : PoseFeatures
    coefficients : J arrays (n_p, F_p, 3, 3)
        For each part: feature × triangle of the part, in the order of the faces.

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
        """Q (..., F, 3, 3) at poses (..., J, 3), radians.

        [SCAPE] Eq. 3
        """
        delta = self.features.evaluate(pose)
        Q = np.empty((*delta.shape[:-1], len(self.skeleton.part_of_face), 3, 3))
        for p, faces in enumerate(self.faces_of_part):
            a = self.coefficients[p].astype(np.float64)
            value = delta[..., self.features.of_part(p)] @ a.reshape(len(a), -1)
            Q[..., faces, :, :] = value.reshape(*delta.shape[:-1], len(faces), 3, 3)
        return Q

    @staticmethod
    def identity(skeleton: Skeleton) -> PoseSpace:
        """The pose space without deformation: rigid parts, Q = I."""
        features = linear_features(skeleton, tuple(np.zeros((3, 0)) for _ in skeleton.parents))
        return PoseSpace(features, tuple(np.broadcast_to(np.eye(3, dtype=np.float32), (1, len(f), 3, 3)).copy()
                                         for f in faces_of_part(skeleton)))


def faces_of_part(skeleton: Skeleton) -> tuple[np.ndarray, ...]:
    """The triangles of every part, in the order of the faces."""
    return tuple(np.flatnonzero(skeleton.part_of_face == p) for p in range(len(skeleton.parents)))


def nearest_joints(template: Mesh, skeleton: Skeleton, count: int = 2) -> np.ndarray:
    """(F, J) bool: the `count` joints of its part that lie nearest to each triangle on the template.

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


def kept_directions(poses: np.ndarray, threshold: float) -> tuple[np.ndarray, ...]:
    """Principal twist directions of every joint whose variance reaches a threshold.

    Parameters
    ----------
    poses : (M, J, 3) float, radians
    threshold : float, square radians

    Returns
    -------
    J arrays (3, k_j)
        Orthonormal, largest variance first; none for the root.

    [SCAPE] §4.2
    """
    observed = twists(poses)
    kept = [np.zeros((3, 0))]
    for j in range(1, observed.shape[1]):
        centred = observed[:, j] - observed[:, j].mean(axis=0)
        variance, axes = np.linalg.eigh(centred.T @ centred / len(centred))
        kept.append(axes[:, ::-1][:, variance[::-1] >= max(threshold, 1e-12)])
    return tuple(kept)


@dataclass(frozen=True)
class Regression:
    """A learned pose space and how well it predicts what it has not seen.

    Attributes
    ----------
    space : PoseSpace
    ridge : float, square radians
    left_out_error : float, metres
        Root mean square error of an edge when its instance is left out.
    """

    space: PoseSpace
    ridge: float
    left_out_error: float


def learn_pose_space(template: Mesh, skeleton: Skeleton, poses: np.ndarray, Q: np.ndarray, pruning: float,
                     ridges: tuple[float, ...]) -> Regression:
    """Regress Q on the joint twists, with the ridge that predicts left-out instances best.

    Parameters
    ----------
    poses : (M, J, 3) float, radians
    Q : (M, F, 3, 3) float
    pruning : float, square radians
        Twist directions of smaller variance are not regressed on.
    ridges : floats, square radians
        Strengths to choose from; the penalty is on the coefficients, not on the constant.

    [SCAPE] Eq. 4
    """
    features = linear_features(skeleton, kept_directions(poses, pruning))
    groups = _groups(template, features)
    delta = features.evaluate(poses)
    if len(ridges) > 1:
        v_hat = np.swapaxes(template.corners[:, 1:] - template.corners[:, :1], -1, -2)
        errors = [_left_out(delta, groups, Q, v_hat, ridge) for ridge in ridges]
        best = int(np.argmin(errors))
    else:
        best, errors = 0, [float("nan")]
    coefficients = tuple(np.zeros((features.of_part(p).stop - features.of_part(p).start, len(f), 3, 3),
                                  dtype=np.float32) for p, f in enumerate(faces_of_part(skeleton)))
    place = np.empty(len(template.faces), dtype=np.int64)
    for faces in faces_of_part(skeleton):
        place[faces] = np.arange(len(faces))
    for part, used, faces in groups:
        X = delta[:, used]
        centre = X.mean(axis=0)
        flat = Q[:, faces].reshape(len(X), -1)
        slope = _ridge(X - centre, ridges[best]) @ flat
        rows = used - features.starts[part]
        shape = (len(faces), 3, 3)
        coefficients[part][rows[:, None], place[faces]] = slope.reshape(len(used), *shape)
        coefficients[part][0, place[faces]] = (flat.mean(axis=0) - centre @ slope).reshape(shape)
    return Regression(PoseSpace(features, coefficients), ridges[best], errors[best])


def _groups(template: Mesh, features: PoseFeatures) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Triangles of one part that regress on the same joints: (part, features without the constant, faces)."""
    near = nearest_joints(template, features.skeleton)
    groups = []
    for p, faces in enumerate(faces_of_part(features.skeleton)):
        kinds, which = np.unique(near[faces], axis=0, return_inverse=True)
        mine = np.arange(features.count)[features.of_part(p)][1:]
        for g, joints in enumerate(kinds):
            groups.append((p, mine[~(features.uses[mine] & ~joints).any(axis=1)], faces[which.ravel() == g]))
    return groups


def _ridge(centred: np.ndarray, ridge: float) -> np.ndarray:
    """(n, M) matrix that gives the slopes of a ridge regression on centred features (M, n)."""
    M, n = centred.shape
    return np.linalg.solve(centred.T @ centred + (M * ridge + 1e-12) * np.eye(n), centred.T)


def _left_out(delta: np.ndarray, groups: list[tuple[int, np.ndarray, np.ndarray]], Q: np.ndarray,
              v_hat: np.ndarray, ridge: float) -> float:
    """Root mean square error in metres of the edges `Q v̂` of left-out instances, in closed form."""
    total = 0.0
    for _, used, faces in groups:
        X = delta[:, used] - delta[:, used].mean(axis=0)
        hat = X @ _ridge(X, ridge) + 1 / len(X)
        target = (Q[:, faces] @ v_hat[faces]).reshape(len(X), -1)
        residual = (target - hat @ target) / np.maximum(1 - np.diag(hat), 1e-6)[:, None]
        total += float((residual**2).sum())
    return float(np.sqrt(total / (Q.shape[0] * Q.shape[1] * 2)))
