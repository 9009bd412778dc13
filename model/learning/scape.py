"""Learning SCAPE and BlendSCAPE models from registered meshes."""
from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from scanprep.batch.steps import Step, inside, once
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.meaning import HAND, extent, size, unit_problem
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blendscape import BlendScapeModel
from ..body import BodyModel
from ..borders import face_weights
from ..carriers import rigid_weights
from ..digests import body_digest, body_digests, digest
from ..features import twists
from ..gradients import GradientSystem, shape_gradients
from ..pose_space import PoseSpace
from ..scape import ScapeModel
from ..shape_space import ShapeSpace, learn_shape_space
from .carriage import Carriage
from .pose import LearnedPose, PoseConfig, Ticks, learn_pose

Progress = Callable[[int, int], None]
T = TypeVar("T")
LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class LearnConfig(PoseConfig):
    """Settings of `learn_scape`: those of the pose space, and of the space of shapes.

    Parameters
    ----------
    components : int
        Shape components to keep, fewer where there are fewer people.
    """

    components: int = 40


@dataclass(frozen=True)
class BlendConfig(LearnConfig):
    """Settings of `learn_blendscape`: those of `learn_scape`, and how far rotations blend.

    Parameters
    ----------
    width : float
        How far a rotation reaches over the border of its part, as a share of the template's diagonal.
    """

    width: float = 0.01


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
        Keeps what was worked out on the way, as `scanprep.batch.steps.Step`.

    Raises
    ------
    ValueError
        Fewer than two poses, vertices of another count or not finite, a skeleton of another template.

    [SCAPE] Eq. 4, Eq. 5, Eq. 7, Eq. 8
    """
    config = config or LearnConfig()
    check_template(template)
    check_skeleton(template, skeleton)
    carriage = Carriage(template, skeleton, rigid_weights(skeleton))
    space, shape_space, mean, covariance, info, examples = _learn(carriage, poses, shapes, config, progress, step)
    return ScapeModel(template, skeleton, space, shape_space, mean, covariance, info, pose_examples=examples)


def learn_blendscape(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None, skeleton: Skeleton,
                     config: BlendConfig | None = None, progress: Progress | None = None, step: Step = once
                     ) -> BlendScapeModel:
    """Learn a body model whose rotations blend across the borders of parts.

    All is as in `learn_scape`, with `R` a mixture of rotations for triangles near a border. A mixture is no rotation;
    what it shrinks, Q learns to undo.

    Parameters
    ----------
    template, poses, shapes, skeleton, progress, step
        As for `learn_scape`.
    config : BlendConfig, optional

    Raises
    ------
    ValueError
        As `learn_scape`, and a width that is not positive.

    [BlendSCAPE]
    """
    config = config or BlendConfig()
    check_template(template)
    check_skeleton(template, skeleton)
    blend = face_weights(template, skeleton, config.width * float(np.linalg.norm(np.ptp(template.vertices, axis=0))))
    carriage = Carriage(template, skeleton, blend)
    space, shape_space, mean, covariance, info, examples = _learn(carriage, poses, shapes, config, progress, step)
    return BlendScapeModel(template, skeleton, space, shape_space, mean, covariance, info, pose_examples=examples,
                           blend=blend)


def _learn(carriage: Carriage, poses: np.ndarray, shapes: np.ndarray | None, config: LearnConfig,
           progress: Progress | None, step: Step
           ) -> tuple[PoseSpace, ShapeSpace, np.ndarray, np.ndarray, dict[str, Any], np.ndarray]:
    """Pose space, shape space, mean and covariance of the poses, how they came about, and the poses."""
    template = carriage.template
    poses = checked_bodies(template, poses, "poses")
    shapes = None if shapes is None else checked_bodies(template, shapes, "shapes")
    tick = Ticks(progress, (config.refinements + 1) * len(poses) + (0 if shapes is None else len(shapes)))
    learned = pose_space(carriage, poses, config, tick, step)
    shape_space = ShapeSpace.empty(len(template.faces))
    if shapes is not None:
        shape_space = from_shapes(carriage, learned.space, shapes, config, tick, step, None,
                                  lambda S: learn_shape_space(S, config.components))
    examples = pose_examples(template, carriage.skeleton, learned.poses, shapes)
    return (learned.space, shape_space, *pose_prior(examples, len(poses)),
            how_learned(template, learned, poses, shapes, config), examples)


def pose_space(carriage: Carriage, poses: np.ndarray, config: LearnConfig, tick: Ticks, step: Step) -> LearnedPose:
    """What is learned of the poses, in a step and its steps."""
    def learn() -> LearnedPose:
        with timed("pose space"):
            return learn_pose(carriage, poses, config, tick, inside(step, "pose space"))

    return tick.over((config.refinements + 1) * len(poses),
                     lambda: step("pose space", (carriage, poses, config.of_poses), learn))


def from_shapes(carriage: Carriage, space: PoseSpace, shapes: np.ndarray, config: LearnConfig, tick: Ticks, step: Step,
                inputs: Any, learn: Callable[[np.ndarray], T]) -> T:
    """What is learned of the shape deformations S (P, F, 3, 3) of people (P, N, 3), in a step and one a person.

    Parameters
    ----------
    inputs
        What it depends on beside them and the settings.
    learn : callable
        Gets S.
    """
    def make() -> T:
        with timed("shape of every person"):
            each = inside(step, "shape components/shape of every person")
            S = shape_deformations(carriage, space, shapes, config.smoothness, tick, each)
        with timed("shape components"):
            return learn(S)

    return tick.over(len(shapes), lambda: step(
        "shape components", (carriage, space, shapes, config.smoothness, config.components, inputs), make))


def how_learned(template: Mesh, learned: LearnedPose, poses: np.ndarray, shapes: np.ndarray | None, config: LearnConfig
                ) -> dict[str, Any]:
    """What a model keeps of its making: settings, what was chosen, sizes and digests of the training set."""
    design = learned.design
    return {"settings": asdict(config), "poses": len(poses), "shapes": 0 if shapes is None else len(shapes),
            "pruning": design.pruning, "ridge": design.ridge, "features": learned.space.features.count,
            "left_out_error": design.left_out_error, "digest": digest(template, poses, shapes),
            "digests": body_digests(poses, shapes)}


def pose_prior(examples: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (J, 3) and covariance (3J, 3J) of poses, radians, zero for the root.

    Two kinds of poses count alike, however many there are of each: those one person took for the sake of the pose, and
    those in which people stood. A limb that nothing is known of would else be as likely behind the back as at the
    side: on half views of five men that were not learned from, that left 20 mm where nothing was seen, and this 14.

    Parameters
    ----------
    examples : (M, J, 3) float, radians
        As `pose_examples` gives them.
    count : int
        The first so many are of the one kind, the rest of the other.
    """
    flat = examples.reshape(len(examples), -1)
    kinds = [kind for kind in (flat[:count], flat[count:]) if len(kind)]
    mean = np.mean([kind.mean(axis=0) for kind in kinds], axis=0)
    spreads = [(kind - mean).T @ (kind - mean) / max(1, len(kind) - (len(kinds) == 1)) for kind in kinds]
    return mean.reshape(-1, 3), np.mean(spreads, axis=0)


def pose_examples(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None = None
                  ) -> np.ndarray:
    """Poses (M, J, 3), radians, that bodies were seen in: the training poses, and how the people (P, N, 3) stand.

    The root is not turned.
    """
    out = _below_half_turn(poses)
    if shapes is None:
        return out
    return np.concatenate([out, _below_half_turn(skeleton.pose_of(skeleton.fit_rotations(template, shapes)))])


def _below_half_turn(poses: np.ndarray) -> np.ndarray:
    """Poses (M, J, 3), radians, below a half turn and without the root's."""
    out = twists(poses).copy()
    out[:, 0] = 0
    return out


@contextlib.contextmanager
def timed(step: str) -> Iterator[None]:
    """Tell the log how many seconds a step took."""
    begun = time.perf_counter()
    yield
    LOG.info("%s: %.2f s", step, time.perf_counter() - begun)


def shape_deformations(carriage: Carriage, space: PoseSpace, shapes: np.ndarray, smoothness: float, tick: Ticks,
                       step: Step = once) -> np.ndarray:
    """S (P, F, 3, 3) of every person, in float32 to halve the memory.

    Poses are those of Procrustes. Fitting each part to the template in the pose found, again and again, left the same
    error on new people (6.50, 5.44 and 4.37 mm at 20, 40 and 80 components against 6.48, 5.47 and 4.38).

    [SCAPE] Eq. 8
    """
    template, skeleton = carriage.template, carriage.skeleton
    system = GradientSystem(template, smoothness)

    def deformation(y: np.ndarray) -> np.ndarray:
        pose = skeleton.pose_of(skeleton.fit_rotations(template, y))
        posed = carriage.v_hat @ np.swapaxes(space.gradients(pose), -1, -2)
        return shape_gradients(system, posed, carriage.local_edges(y[None], pose[None])[0]).astype(np.float32)

    S = np.empty((len(shapes), len(template.faces), 3, 3), dtype=np.float32)
    for i, y in enumerate(shapes):
        S[i] = step(f"person {body_digest(y)}", (carriage, space, smoothness, y), partial(deformation, y))
        tick(1)
    return S


def check_skeleton(template: Mesh, skeleton: Skeleton) -> None:
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
    """Why a model that was learned means nothing, with the likely cause; None where it means something.

    Parameters
    ----------
    people : (S, N, 3) float, metres, optional
        That taught the shapes.
    """
    error, body = float(model.info.get("left_out_error", 0.0)), model.template
    spans = [extent(person) for person in people] if people is not None else [extent(body.vertices)]
    wrong = unit_problem(float(np.median(spans)), extent(body.vertices), "the people are")
    if error <= HAND * size(body) and wrong is None:
        return None
    return (f"a pose that was left out is predicted {1000 * error:.0f} mm off; "
            f"{wrong or 'too few poses, or meshes whose vertices have another order?'}")
