"""Pictures of a model: its parts and joints, and what its shape components do."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.judgement import size
from scanprep.pictures.camera import look_around
from scanprep.pictures.scene import Pane, picture_panes
from scanprep.pictures.shading import Bones, Dots, Shape, Solid, part_colors
from scanprep.skeleton.tree import Skeleton

from .body import BodyModel

HEIGHT = 420                         # pixels: as many panes side by side as a screen is wide


def parts_panes(template: Mesh, skeleton: Skeleton) -> list[Pane]:
    """Draw the parts in colour, then joints and bones inside a transparent body."""
    camera, = look_around(template, turns=(15,))
    joints, child = skeleton.joints, np.arange(1, len(skeleton.joints))
    ball = 0.01 * size(template)                                    # 14 mm on a man, 2 mm in a hand
    inside: list[Shape] = [Solid(template, opacity=0.35), Dots(joints, radius=ball, on_top=True),
                           Bones(joints[skeleton.parents[child]], joints[child], radius=0.4 * ball, on_top=True)]
    return [Pane([Solid(template, part_colors(skeleton.part_of_face))], camera, f"{len(skeleton.parents)} parts"),
            Pane(inside, camera, "joints")]


def picture_parts(template: Mesh, skeleton: Skeleton) -> np.ndarray:
    """Picture parts and joints from the front."""
    return picture_panes(parts_panes(template, skeleton), 640)


def component_panes(model: BodyModel) -> list[Pane]:
    """Draw the mean person, then the first four components at minus and plus two standard deviations.

    [SCAPE] Eq. 7
    """
    J = len(model.skeleton.parents)
    count = min(4, model.n_betas)
    wanted = [("mean", np.zeros(1))]
    for k in range(count):
        for sign in (-1, 1):
            wanted.append((f"{k + 1}: {sign * 2:+} sd", sign * 2.0 * np.eye(count)[k]))
    up = model.template.up
    bodies = [model.template.with_vertices(model.vertices(np.zeros((J, 3)), betas, np.zeros(3)), up)
              for _, betas in wanted]
    camera = look_around(bodies[0], np.stack([b.vertices for b in bodies]))[0]
    return [Pane([body], camera, name) for body, (name, _) in zip(bodies, wanted, strict=True)]


def picture_components(model: BodyModel) -> np.ndarray:
    """Picture the panes of `component_panes`.

    [SCAPE] Eq. 7
    """
    return picture_panes(component_panes(model), HEIGHT)


def picture_character(model: BodyModel) -> np.ndarray:
    """Picture the character with its parts and its joints, then in poses of the model's people that are far from rest.
    """
    skeleton, betas = model.skeleton, np.zeros(1)
    rest = np.zeros((len(skeleton.parents), 3))
    body = model.template.with_vertices(model.vertices(rest, betas), model.template.up)
    joints = model.joint_regressor @ body.vertices
    # training poses from the most bent on; the more bent half is shown, evenly spread
    examples = model.pose_examples[np.argsort(-np.abs(model.pose_examples[:, 1:]).sum(axis=(1, 2)), kind="stable")]
    chosen = np.linspace(0, max(len(examples) - 1, 0) // 2, min(4, len(examples))).astype(int)
    poses = examples[chosen].reshape(-1, *rest.shape)
    poses[:, 0] = 0
    bodies = model.vertices(poses, np.tile(betas, (len(poses), 1)))
    panes = [*parts_panes(body, replace(skeleton, joints=joints)),
             *(Pane([model.template.with_vertices(v)], look_around(body, v, (35,))[0], f"pose {k + 1}")
               for k, v in enumerate(bodies))]
    return picture_panes(panes, HEIGHT)
