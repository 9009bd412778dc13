"""Learning SCAPE and BlendSCAPE models from registered meshes."""
from __future__ import annotations

from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from scanprep.batch.room import Step, once
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.meaning import HAND, extent, size, unit_problem
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blend_weights import face_weights
from ..blending import BlendedTemplate, rigid_weights
from ..body import BodyModel
from ..digests import body_digest, body_digests, digest
from ..features import twists
from ..gradients import GradientSystem, shape_gradients
from ..pose_space import PoseSpace
from ..scape import BlendScapeModel, ScapeModel
from ..shape_space import ShapeSpace, learn_shape_space
from .config import LearnConfig
from .pose import LearnedPose, learn_pose
from .work import Progress, Work, timed


@one_thread()
def learn_scape(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None, skeleton: Skeleton,
                config: LearnConfig | None = None, progress: Progress | None = None, step: Step = once
                ) -> ScapeModel:
    """Learn a body model from one person in many poses and many people in about one pose.

    Parameters
    ----------
    template : Mesh
        One of the poses.
    poses : (M, N, 3) float, metres
        The template's person in M poses.
    shapes : (S, N, 3) float, metres, or None
        Other people; None for a model of the template's own body alone.
    skeleton : Skeleton
    config : LearnConfig, optional
    progress : callable, optional
        Called with the work done and the whole.
    step : callable, optional
        Keeps what was worked out on the way, as `scanprep.batch.room.Step`.

    Raises
    ------
    ValueError
        Fewer than two poses, vertices of another count or not finite, a skeleton of another template.

    [SCAPE] Eq. 4, Eq. 5, Eq. 7, Eq. 8
    """
    config = config or LearnConfig()
    poses, shapes = checked_training(template, skeleton, poses, shapes)
    parts = BlendedTemplate(template, skeleton, rigid_weights(skeleton))                   # R of each part
    work = Work(progress, amount(poses, shapes, config), step)
    learned = learn_pose(parts, poses, config, work)                                       # [SCAPE] Eq. 3, Eq. 4, Eq. 5
    people = learn_people(parts, learned.space, shapes, config, work)                      # [SCAPE] Eq. 7, Eq. 8
    examples = pose_examples(template, skeleton, learned.poses, shapes)
    return ScapeModel(template, skeleton, learned.space, people, *pose_prior(examples, len(poses)),
                      how_learned(template, learned, poses, shapes, config), pose_examples=examples)


@one_thread()
def learn_blendscape(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None, skeleton: Skeleton,
                     config: LearnConfig | None = None, progress: Progress | None = None, step: Step = once
                     ) -> BlendScapeModel:
    """Learn a body model whose rotations blend across the borders of parts.

    All is as in `learn_scape`, with `R` a mixture of rotations for triangles near a border. A mixture is no rotation;
    what it shrinks, Q learns to undo.

    Parameters
    ----------
    template, poses, shapes, skeleton, config, progress, step
        As for `learn_scape`.

    Raises
    ------
    ValueError
        As `learn_scape`.

    [BlendSCAPE]
    """
    config = config or LearnConfig()
    poses, shapes = checked_training(template, skeleton, poses, shapes)
    # a share of the template's diagonal: so far a rotation blends over the border of its part
    blend = face_weights(template, skeleton, 0.01 * float(np.linalg.norm(np.ptp(template.vertices, axis=0))))
    parts = BlendedTemplate(template, skeleton, blend)
    work = Work(progress, amount(poses, shapes, config), step)
    learned = learn_pose(parts, poses, config, work)
    people = learn_people(parts, learned.space, shapes, config, work)
    examples = pose_examples(template, skeleton, learned.poses, shapes)
    return BlendScapeModel(template, skeleton, learned.space, people, *pose_prior(examples, len(poses)),
                           how_learned(template, learned, poses, shapes, config), pose_examples=examples, blend=blend)


def amount(poses: np.ndarray, shapes: np.ndarray | None, config: LearnConfig) -> int:
    """How much work it is, in bodies that are fitted or solved for."""
    return (config.refinements + 1) * len(poses) + (0 if shapes is None else len(shapes))


def learn_people(parts: BlendedTemplate, space: PoseSpace, shapes: np.ndarray | None, config: LearnConfig, work: Work
                 ) -> ShapeSpace:
    """The space of body shapes of people (P, N, 3), without components where there are none.

    [SCAPE] Eq. 7, Eq. 8
    """
    if shapes is None:
        return ShapeSpace.empty(len(parts.template.faces))

    def learn(inner: Work) -> ShapeSpace:
        S = shape_deformations(parts, space, shapes, config, inner)
        with timed("shape components"):
            return learn_shape_space(S, config.components)

    return work.step("shape components", (parts, space, shapes, config.smoothness, config.components), len(shapes),
                     learn)


def shape_deformations(parts: BlendedTemplate, space: PoseSpace, shapes: np.ndarray, config: LearnConfig, work: Work
                       ) -> np.ndarray:
    """S (P, F, 3, 3) of every person, in float32 to halve the memory.

    Poses are those of Procrustes. Fitting each part to the template in the pose found, again and again, left the same
    error on new people (6.50, 5.44 and 4.37 mm at 20, 40 and 80 components against 6.48, 5.47 and 4.38).

    [SCAPE] Eq. 8
    """
    template, skeleton = parts.template, parts.skeleton
    system = GradientSystem(template, config.smoothness)

    def deformation(y: np.ndarray, _: Work) -> np.ndarray:
        pose = skeleton.pose_of(skeleton.fit_rotations(template, y))
        posed = parts.posed(space.gradients(pose))
        return shape_gradients(system, posed, parts.local_edges(y, pose)).astype(np.float32)

    S = np.empty((len(shapes), len(template.faces), 3, 3), dtype=np.float32)
    with timed("shape of every person"):
        for i, y in enumerate(shapes):
            S[i] = work.step(f"person {body_digest(y)}", (parts, space, config.smoothness, y), 1,
                             partial(deformation, y))
    return S


def how_learned(template: Mesh, learned: LearnedPose, poses: np.ndarray, shapes: np.ndarray | None, config: LearnConfig
                ) -> dict[str, Any]:
    """What a model keeps of its making: settings, what was chosen, sizes and digests of the training set."""
    design = learned.design
    return {"settings": asdict(config), "poses": len(poses), "shapes": 0 if shapes is None else len(shapes),
            "pruning": design.pruning, "ridge": design.ridge, "features": learned.space.features.count,
            "left_out_error": design.left_out_error, "digest": digest(template, poses, shapes),
            "digests": body_digests(poses, shapes)}


def pose_prior(examples: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (J, 3) and covariance (3J, 3J) of `pose_examples` (M, J, 3), radians, zero for the root.

    The first `count` and the rest count alike, however many there are of each: those one person took for the sake of
    the pose, and those in which people stood. A limb that nothing is known of would else be as likely behind the back
    as at the side: on half views of five men that were not learned from, that left 20 mm where nothing was seen, and
    this 14.
    """
    flat = examples.reshape(len(examples), -1)
    kinds = [kind for kind in (flat[:count], flat[count:]) if len(kind)]
    mean = np.mean([kind.mean(axis=0) for kind in kinds], axis=0)
    spreads = [(kind - mean).T @ (kind - mean) / max(1, len(kind) - (len(kinds) == 1)) for kind in kinds]
    return mean.reshape(-1, 3), np.mean(spreads, axis=0)


def pose_examples(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None = None
                  ) -> np.ndarray:
    """Poses (M, J, 3), radians, that bodies were seen in: the training poses, and how the people (P, N, 3) stand.

    The root is at rest.
    """
    out = _rootless(poses)
    if shapes is None:
        return out
    return np.concatenate([out, _rootless(skeleton.pose_of(skeleton.fit_rotations(template, shapes)))])


def _rootless(poses: np.ndarray) -> np.ndarray:
    """Poses (M, J, 3), radians, at most π and without the root's."""
    out = twists(poses).copy()
    out[:, 0] = 0
    return out


def checked_training(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None
                     ) -> tuple[np.ndarray, np.ndarray | None]:
    """Poses (M, N, 3) and people (P, N, 3) that a model can be learned from, or ValueError."""
    check_template(template)
    check_skeleton(template, skeleton)
    return (checked_bodies(template, poses, "poses"),
            None if shapes is None else checked_bodies(template, shapes, "shapes"))


def check_skeleton(template: Mesh, skeleton: Skeleton) -> None:
    """ValueError for a skeleton of another template."""
    if len(skeleton.part_of_face) != len(template.faces):
        raise ValueError(f"skeleton: it has {len(skeleton.part_of_face)} faces, "
                         f"the template {len(template.faces)}")
    root = template.vertices[skeleton.part_of_vertex(template) == 0].mean(axis=0)
    if np.linalg.norm(root - skeleton.joints[0]) > 1e-6 * np.ptp(template.vertices, axis=0).max():
        raise ValueError("skeleton: joints[0] is not the centroid of part 0, so it belongs to another template")


def checked_bodies(template: Mesh, bodies: np.ndarray, name: str) -> np.ndarray:
    """At least two bodies (n, N, 3) in the template's topology, or ValueError."""
    bodies, N = np.asarray(bodies, dtype=np.float64), len(template.vertices)
    if bodies.ndim != 3 or bodies.shape[1:] != (N, 3):
        raise ValueError(f"{name}: expected shape (n, {N}, 3) like the template, got {bodies.shape}")
    bad = np.flatnonzero(~np.isfinite(bodies).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"{name}: body {bad[0]} has vertices that are not finite")
    if len(bodies) < 2:
        raise ValueError(f"{name}: expected at least 2 bodies, got {len(bodies)}")
    return bodies


def learning_problem(model: BodyModel, people: np.ndarray | None = None) -> str | None:
    """Why a model learned with people (S, N, 3) means nothing, with the likely cause; None where it means something."""
    error, body = float(model.info.get("left_out_error", 0.0)), model.template
    spans = [extent(person) for person in people] if people is not None else [extent(body.vertices)]
    wrong = unit_problem(float(np.median(spans)), extent(body.vertices), "the people are")
    if error <= HAND * size(body) and wrong is None:
        return None
    return (f"a pose that was left out is predicted {1000 * error:.0f} mm off; "
            f"{wrong or 'too few poses, or meshes whose vertices have another order?'}")
