"""A body that is its own mirror image, for the tests of posing and transfer."""
from __future__ import annotations

import numpy as np
from model_bodies import worm
from scipy.spatial import cKDTree

from model.features import linear_features
from model.skinning import SkinningModel
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton


def symmetric_worm() -> tuple[Mesh, Skeleton, np.ndarray]:
    """The worm in five parts, two chains that mirror each other, and the image of every vertex."""
    template = worm()
    x = template.corners.mean(axis=1)[:, 0] - 0.3
    part = np.select([x < -0.7, x < -0.3, x < 0.3, x < 0.7], [3, 1, 0, 2], 4)
    joints = np.array([[0.0, 0, 0], [-0.3, 0, 0], [0.3, 0, 0], [-0.7, 0, 0], [0.7, 0, 0]]) + [0.3, -0.2, 0.9]
    skeleton = Skeleton(part, [-1, 0, 0, 1, 2], joints, ("middle", "left", "right", "left end", "right end"))
    image = template.vertices * [-1, 1, 1] + [0.6, 0, 0]
    return template, skeleton, cKDTree(template.vertices).query(image)[1]


def skinned(template: Mesh, skeleton: Skeleton) -> SkinningModel:
    """Linear blend skinning whose weights and rest vertices are symmetric."""
    x = template.vertices[:, [0]] - 0.3
    weights = np.exp(-(x - [0, -0.5, 0.5, -0.9, 0.9]) ** 2 / 0.05)
    weights /= weights.sum(axis=1, keepdims=True)
    J, N = 5, len(template.vertices)
    features = linear_features(skeleton, tuple(np.zeros((3, 0)) for _ in range(J)))
    rest = template.vertices.copy()
    return SkinningModel(template, skeleton, rest, weights, features, np.zeros((0, N, 3)), rest, np.zeros((0, N, 3)),
                         np.zeros(0), 0.0, np.zeros((J, 3)), np.eye(15))
