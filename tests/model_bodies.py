"""Small articulated bodies with a known skeleton and a known model, for the tests of `model`."""
from __future__ import annotations

import numpy as np

from model.features import linear_features
from model.pose_space import PoseSpace, nearest_joints
from model.scape import ScapeModel
from model.shape_space import ShapeSpace
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton


def worm(rings: int = 33, around: int = 12) -> Mesh:
    """A closed, tapered, slightly oval tube 2 m long along x, in no special place."""
    x = np.linspace(-1, 1, rings)
    angle = 2 * np.pi * np.arange(around) / around
    radius = 0.15 - 0.04 * x**2
    wall = np.stack([np.repeat(x, around), np.outer(radius, np.cos(angle)).ravel(),
                     0.8 * np.outer(radius, np.sin(angle)).ravel()], axis=1)
    vertices = np.vstack([wall, [[-1.05, 0, 0], [1.05, 0, 0]]]) + [0.3, -0.2, 0.9]
    a = (np.arange(rings - 1)[:, None] * around + np.arange(around)).ravel()
    b = (np.arange(rings - 1)[:, None] * around + (np.arange(around) + 1) % around).ravel()
    ring, after = np.arange(around), (np.arange(around) + 1) % around
    last = (rings - 1) * around
    faces = np.vstack([np.stack([a, b, a + around], 1), np.stack([b, b + around, a + around], 1),
                       np.stack([after, ring, np.full(around, len(wall))], 1),
                       np.stack([last + ring, last + after, np.full(around, len(wall) + 1)], 1)])
    faces = faces[:, ::-1]
    return Mesh(vertices, faces)


def worm_skeleton(template: Mesh) -> Skeleton:
    """Four parts: the middle is the root, one part to the left, a chain of two to the right."""
    x = template.corners.mean(axis=1)[:, 0] - 0.3
    part = np.select([x < -0.35, x < 0.35, x < 0.7], [1, 0, 2], 3)
    joints = np.array([[0, 0, 0], [-0.35, 0, 0], [0.35, 0, 0], [0.7, 0, 0]]) + [0.3, -0.2, 0.9]
    skeleton = Skeleton(part, [-1, 0, 0, 2], joints)
    joints[0] = template.vertices[skeleton.part_of_vertex(template) == 0].mean(axis=0)
    return Skeleton(part, [-1, 0, 0, 2], joints)


def worm_model(seed: int = 0, components: int = 3, bulge: float = 0.15, rings: int = 33) -> ScapeModel:
    """A model of the worm whose Q depends smoothly on place and linearly on the twists, with Q = I at rest."""
    template = worm(rings)
    skeleton = worm_skeleton(template)
    rng = np.random.default_rng(seed)
    features = linear_features(skeleton, (np.zeros((3, 0)), np.eye(3), np.eye(3), np.eye(3)[:, :2]))
    near = nearest_joints(template, skeleton)
    centre = template.corners.mean(axis=1)
    coefficients = []
    for p in range(4):
        faces = np.flatnonzero(skeleton.part_of_face == p)
        a = np.zeros((features.of_part(p).stop - features.of_part(p).start, len(faces), 3, 3))
        a[0] = np.eye(3)
        for row, j in enumerate(features.uses[features.of_part(p)][1:].argmax(axis=1), start=1):
            close = np.exp(-np.linalg.norm(centre[faces] - skeleton.joints[j], axis=1) ** 2 / 0.04)
            a[row] = (close * near[faces, j])[:, None, None] * rng.normal(0, bulge, (3, 3))
        coefficients.append(a.astype(np.float32))
    waves = np.cos(centre[:, 0, None] * (1 + np.arange(components)))
    U = waves.T[:, :, None, None] * rng.normal(0, 0.05, (components, 1, 3, 3))
    mean = np.broadcast_to(np.diag([1.02, 0.95, 1.05]), (len(centre), 3, 3))
    variances = (U**2).sum(axis=(1, 2, 3))
    shapes = ShapeSpace(mean.astype(np.float32), U.astype(np.float32), variances, float(variances.sum()))
    return ScapeModel(template, skeleton, PoseSpace(features, tuple(coefficients)), shapes,
                      np.zeros((4, 3)), np.eye(12))


def random_poses(model: ScapeModel, count: int, rng: np.random.Generator, size: float = 0.5) -> np.ndarray:
    """Poses (count, J, 3) with every joint turned."""
    return rng.normal(0, size, (count, len(model.skeleton.parents), 3))
