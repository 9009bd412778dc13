"""Pictures of a model: its parts and joints, and what its shape components do."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import look_around
from scanprep.pictures.shading import Bones, Dots, Shape, Solid, part_colors, render, side_by_side
from scanprep.skeleton.tree import Skeleton

from .body import BodyModel


def picture_parts(template: Mesh, skeleton: Skeleton, height: int = 640) -> np.ndarray:
    """Parts in colour from the front and the back, then joints and bones inside a transparent body."""
    front, _, back, _ = look_around(template)
    width = int(height * front.width / front.height) + 20
    colored = Solid(template, part_colors(skeleton.part_of_face))
    inside = _joints_inside(template, skeleton.joints, skeleton)
    images = [render(colored, front, width, height), render(colored, back, width, height),
              render(inside, front, width, height)]
    return side_by_side(images, [f"{len(skeleton.parents)} parts, front", "back", "joints"])


def picture_components(model: BodyModel, count: int = 4, deviations: float = 2.0, height: int = 420,
                       tell: Callable[[int, int], None] | None = None, columns: int | None = None) -> np.ndarray:
    """The mean person, then the first components at minus and plus some standard deviations.

    [SCAPE] Eq. 7
    """
    J = len(model.skeleton.parents)
    count = min(count, model.n_betas)
    wanted = [("mean", np.zeros(1))]
    for k in range(count):
        for sign in (-1, 1):
            wanted.append((f"{k + 1}: {sign * deviations:+.0f} sd", sign * deviations * np.eye(count)[k]))
    bodies = [model.template.with_vertices(model.vertices(np.zeros((J, 3)), betas, np.zeros(3)))
              for _, betas in wanted]
    camera = look_around(bodies[0], np.stack([b.vertices for b in bodies]))[0]
    width = int(height * camera.width / camera.height) + 10
    images = []
    for i, body in enumerate(bodies):
        images.append(render(body, camera, width, height))
        if tell:
            tell(i + 1, len(bodies))
    return side_by_side(images, [name for name, _ in wanted], columns=columns)


def picture_character(model: BodyModel, count: int = 4, height: int = 420) -> np.ndarray:
    """The character with its parts and with its joints, then in some poses of the model's people, far from rest."""
    skeleton, betas = model.skeleton, np.zeros(1)
    rest = np.zeros((len(skeleton.parents), 3))
    body = model.template.with_vertices(model.vertices(rest, betas))
    joints = skeleton.joint_regressor(model.template) @ body.vertices
    examples = model.pose_examples[np.argsort(-np.abs(model.pose_examples[:, 1:]).sum(axis=(1, 2)), kind="stable")]
    chosen = np.linspace(0, max(len(examples) - 1, 0) // 2, min(count, len(examples))).astype(int)
    poses = examples[chosen].reshape(-1, *rest.shape)
    poses[:, 0] = 0
    bodies = model.vertices(poses, np.tile(betas, (len(poses), 1)))
    camera = look_around(body)[0]
    width = int(height * camera.width / camera.height) + 10
    images = [render(Solid(body, part_colors(skeleton.part_of_face)), camera, width, height),
              render(_joints_inside(body, joints, skeleton), camera, width, height)]
    images += [render(model.template.with_vertices(v), look_around(body, v, (35,))[0], width, height) for v in bodies]
    return side_by_side(images, ["parts", "joints", *[f"pose {k + 1}" for k in range(len(poses))]])


def _joints_inside(body: Mesh, joints: np.ndarray, skeleton: Skeleton) -> list[Shape]:
    """Joints (J, 3) and bones inside a transparent body."""
    child = np.arange(1, len(joints))
    return [Solid(body, opacity=0.35), Dots(joints, radius=0.014, on_top=True),
            Bones(joints[skeleton.parents[child]], joints[child], on_top=True)]
