"""A fitted control model as a body model, so that markers, points and motions drive it as they drive every other."""
from __future__ import annotations

import numpy as np

from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic import people

from ..features import linear_features
from ..skinning import SkinningModel
from .control.model import ControlModel

POSES = 100                          # random poses of the synthetic people that make the pose prior
WIDEST = 1.0                         # radians: standard deviation of the turns of a joint without such poses


def body_model(control: ControlModel, poses: np.ndarray | None = None) -> SkinningModel:
    """The control model under linear blend skinning as a model of one person, without betas.

    Parameters
    ----------
    control : ControlModel
    poses : (M, J, 3) float, radians, optional
        What people do with these joints, for the pose prior; without any all turns are about as likely.

    [Statues] Eq. 1
    """
    skeleton, N = control.skeleton, len(control.mesh.vertices)
    J = len(skeleton.parents)
    if poses is None:
        mean, covariance, poses = np.zeros((J, 3)), WIDEST**2 * np.eye(3 * J), np.zeros((0, J, 3))
        covariance[:3, :3] = 0
    else:
        poses = poses.copy()
        poses[:, 0] = 0
        mean, covariance = poses.mean(axis=0), np.cov(poses.reshape(len(poses), -1).T)
    return SkinningModel(
        control.mesh, skeleton, control.mesh.vertices, control.weights, _no_correctives(skeleton),
        np.zeros((0, N, 3)), control.mesh.vertices, np.zeros((0, N, 3)), np.zeros(0), 0.0, mean, covariance,
        {"made of": "a statue", "landmarks": dict(control.landmarks)}, pose_examples=poses)


def people_poses(count: int = POSES, seed: int = 0) -> np.ndarray:
    """Random poses (count, 16, 3), radians, of the synthetic people."""
    rng = np.random.default_rng(seed)
    return np.array([people.random_pose(rng) for _ in range(count)])


def _no_correctives(skeleton: Skeleton):  # type: ignore[no-untyped-def]
    return linear_features(skeleton, tuple(np.zeros((3, 0)) for _ in skeleton.parents))
