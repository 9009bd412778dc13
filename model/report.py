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
    child = np.arange(1, len(skeleton.parents))
    inside: list[Shape] = [Solid(template, opacity=0.35), Dots(skeleton.joints, radius=0.014, on_top=True),
              Bones(skeleton.joints[skeleton.parents[child]], skeleton.joints[child], on_top=True)]
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
