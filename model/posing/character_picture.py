"""A picture of a character that has become a model."""
from __future__ import annotations

import numpy as np

from scanprep.pictures.camera import look_around
from scanprep.pictures.shading import Bones, Dots, Shape, Solid, part_colors, render, side_by_side

from .character_mesh import Character

POSES = 4


def picture_character(found: Character, height: int = 420) -> np.ndarray:
    """The character with its parts and with its joints, then in some poses of the model's people, far from rest."""
    model, skeleton = found.model, found.model.skeleton
    betas, rest = np.zeros(1), np.zeros((len(skeleton.parents), 3))
    body = model.template.with_vertices(model.vertices(rest, betas))
    joints, child = skeleton.joint_regressor(model.template) @ body.vertices, np.arange(1, len(skeleton.parents))
    inside: list[Shape] = [Solid(body, opacity=0.35), Dots(joints, radius=0.014, on_top=True),
                           Bones(joints[skeleton.parents[child]], joints[child], on_top=True)]
    examples = model.pose_examples[np.argsort(-np.abs(model.pose_examples[:, 1:]).sum(axis=(1, 2)), kind="stable")]
    chosen = np.linspace(0, max(len(examples) - 1, 0) // 2, min(POSES, len(examples))).astype(int)
    poses = examples[chosen].reshape(-1, *rest.shape)
    poses[:, 0] = 0
    bodies = model.vertices(poses, np.tile(betas, (len(poses), 1)))
    camera = look_around(body)[0]
    width = int(height * camera.width / camera.height) + 10
    images = [render(Solid(body, part_colors(skeleton.part_of_face)), camera, width, height),
              render(inside, camera, width, height)]
    images += [render(model.template.with_vertices(v), look_around(body, v, (35,))[0], width, height) for v in bodies]
    return side_by_side(images, ["parts", "joints", *[f"pose {k + 1}" for k in range(len(poses))]])
