"""Learning SCAPE and BlendSCAPE models from registered meshes."""
from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import asdict, dataclass, replace
from functools import partial
from operator import attrgetter
from typing import Any, TypeVar

import numpy as np

from scanprep.batch.pool import SideBySide
from scanprep.batch.room import Step, run_uncached, substeps
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.judgement import HAND, Judgement, extent, size, unit_problem
from scanprep.skeleton.names import skeleton_doubts
from scanprep.skeleton.roles import joint_in_words
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blend_weights import face_weights
from ..blending import BlendedTemplate, rigid_weights
from ..body import BodyModel, Progress
from ..digests import body_digest, body_digests, check_bodies, digest
from ..features import twists
from ..fitting.vertices import FitConfig, PoseFitter
from ..gradients import GradientSystem, ShapeSolver, pose_gradients, shape_gradients
from ..human_poses import mix_moments, with_human_poses
from ..linear import Subject
from ..pose_space import PoseSpace
from ..priors import CRUDE, STIFF, stiff_joints
from ..scape import BlendScapeModel, ScapeModel
from ..shape_space import ShapeSpace, add_people, body_volumes, learn_shape_space
from .config import LearnConfig
from .prior import TemplatePrior
from .regression import Design, by_edges, choose_design, compress, predict_left_out

T = TypeVar("T")
POSES = 2 / 3                        # of the time of learning, where there are people as well
# The pose space of a prior's own bodies: refined once it was 0.3 mm better on held-out poses, for three times the time.
PRIOR = LearnConfig(prunings=(0.01,), ridges=(1e-3,), refinements=0)
WORTH = 10.0                         # people that the people of a prior count as


class ProgressShares:
    """Steps of some work, each a share of the whole, of which progress is told in thousandths."""

    def __init__(self, progress: Progress | None, step: Step = run_uncached) -> None:
        self._progress, self._step, self._part, self._done = progress, step, 1.0, [0.0]

    def tick(self, share: float) -> None:
        """So much of this work is done."""
        self._done[0] += share * self._part
        if self._progress:
            self._progress(round(1000 * self._done[0]), 1000)

    def step(self, name: str, inputs: Any, share: float, make: Callable[[ProgressShares], T]) -> T:
        """What `make` returns, or returned before for the same inputs; it is a share of this work either way.

        `make` gets the work of its own steps, which are forgotten once it is done.
        """
        inner, end = copy(self), self._done[0] + share * self._part
        inner._step, inner._part = substeps(self._step, name), share * self._part
        value = self._step(name, inputs, lambda: make(inner))
        self.tick((end - self._done[0]) / self._part)
        return value


@one_thread()
def learn_scape(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None, skeleton: Skeleton,
                config: LearnConfig | None = None, progress: Progress | None = None, step: Step = run_uncached,
                prior: TemplatePrior | None = None) -> ScapeModel:
    """Learn a body model from one person in many poses and many people in about one pose.

    With a `prior` the model is the known one, adapted: what the scans do not show is as there.

    Parameters
    ----------
    template : Mesh
        One of the poses.
    poses : (M, N, 3) float, metres
        The template's person in M poses, at least two; with a prior one is enough.
    shapes : (S, N, 3) float, metres, or None
        Other people; with None the model is of the template's own body alone, or of the people of the prior.
    skeleton : Skeleton
        For few poses that of the prior.
    config : LearnConfig, optional
    progress : callable, optional
        Called with the work done and the whole.
    step : callable, optional
        Keeps what was worked out on the way, as `scanprep.batch.room.Step`.
    prior : TemplatePrior, optional
        Of `bring_prior`.

    Returns
    -------
    ScapeModel
        With a prior `info["joint_evidence"]` says how much of each joint's movement is of the scans, from 0 to 1.

    Raises
    ------
    ValueError
        Too few poses, vertices of another count or not finite, a skeleton of another template.

    [SCAPE] Eq. 4, Eq. 5, Eq. 7, Eq. 8
    """
    parts = BlendedTemplate(template, skeleton, rigid_weights(skeleton))                   # R of each part
    return ScapeModel(template, skeleton,
                      **_learn_spaces(parts, poses, shapes, config, ProgressShares(progress, step), prior))


@one_thread()
def learn_blendscape(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None, skeleton: Skeleton,
                     config: LearnConfig | None = None, progress: Progress | None = None, step: Step = run_uncached,
                     prior: TemplatePrior | None = None) -> BlendScapeModel:
    """Learn a body model whose rotations blend across the borders of parts.

    All is as in `learn_scape`, with `R` a mixture of rotations for triangles near a border. A mixture is no rotation;
    what it shrinks, Q learns to undo.

    Parameters
    ----------
    template, poses, shapes, skeleton, config, progress, step, prior
        As for `learn_scape`.

    Raises
    ------
    ValueError
        As `learn_scape`.

    [BlendSCAPE]
    """
    check_training(template, skeleton, poses, shapes, prior)
    # a share of the template's diagonal: so far a rotation blends over the border of its part
    blend = face_weights(template, skeleton, 0.01 * float(np.linalg.norm(np.ptp(template.vertices, axis=0))))
    parts = BlendedTemplate(template, skeleton, blend)
    learned = _learn_spaces(parts, poses, shapes, config, ProgressShares(progress, step), prior)
    return BlendScapeModel(template, skeleton, **learned, blend=blend)


def _learn_spaces(parts: BlendedTemplate, poses: np.ndarray, shapes: np.ndarray | None, config: LearnConfig | None,
                  work: ProgressShares, prior: TemplatePrior | None) -> dict[str, Any]:
    """Pose space, shape space, pose prior and info of a SCAPE model of either kind."""
    config = config or LearnConfig()
    poses, shapes = check_training(parts.template, parts.skeleton, poses, shapes, prior)
    learned = learn_pose_with(prior, parts, poses, config, work)                           # [SCAPE] Eq. 3, Eq. 4, Eq. 5
    people = learn_people(parts, learned.space, shapes, config, work, prior)               # [SCAPE] Eq. 7, Eq. 8
    return {"pose_space": learned.space, "shape_space": people,
            **training_metadata(parts.template, parts.skeleton, learned, poses, shapes, config, prior)}


def learn_pose_with(prior: TemplatePrior | None, parts: BlendedTemplate, bodies: np.ndarray, config: LearnConfig,
                    work: ProgressShares) -> LearnedPose:
    """The pose space of bodies (M, N, 3), which leans on a prior where there is one; two thirds of the work."""
    if prior is None:
        return learn_pose(parts, bodies, config, work, POSES)
    # the prior's own bodies are learned from in the same way, on this skeleton
    known = learn_pose(parts, prior.poses, replace(PRIOR, features=config.features, smoothness=config.smoothness),
                       work, POSES / 3)
    return learn_pose(parts, bodies, config, work, 2 * POSES / 3, known)


@dataclass(frozen=True, eq=False)
class LearnedPose:
    """What was learned of the poses: the pose space, the poses (M, J, 3) of the training bodies, what was chosen."""

    space: PoseSpace
    poses: np.ndarray
    design: Design


def learn_pose(parts: BlendedTemplate, bodies: np.ndarray, config: LearnConfig, work: ProgressShares,
               share: float = 1.0,
               prior: LearnedPose | None = None) -> LearnedPose:
    """The pose space, first as in the paper, then refined on the stitched surface; a share of the work.

    A prior is taken where left-out poses are predicted better with it, which are none of a single one.
    [SCAPE] Eq. 3, Eq. 4, Eq. 5
    """
    template, skeleton = parts.template, parts.skeleton
    inputs = (parts, bodies, replace(config, components=0), prior and (prior.space, prior.poses))
    system = GradientSystem(template, config.smoothness, skeleton.part_of_face)

    def first(_: ProgressShares) -> LearnedPose:
        """Q of every body from the rotations of Procrustes, regressed on the joint twists."""
        poses = skeleton.pose_of(skeleton.fit_rotations(template, bodies))                      # R, then Δr
        Q = pose_gradients(system, parts.local_edges(bodies, poses))                            # [SCAPE] Eq. 5
        designs = [choose_design(template, skeleton, poses, config, by_edges(template, poses, Q))]
        if prior is not None:
            judge = by_edges(template, poses, Q - prior.space.gradients(poses))
            designs.insert(0, choose_design(template, skeleton, poses, config, judge, prior=prior.space))
        design = min(designs, key=attrgetter("left_out_error"))         # of equals, as of one pose, that with the prior
        return LearnedPose(design.fit(poses, Q), poses, design)                                 # [SCAPE] Eq. 4

    def learn(inner: ProgressShares) -> LearnedPose:
        share = 1 / (1 + config.refinements)
        learned = inner.step("first fit", inputs, share, first)
        for k in range(config.refinements):
            learned = inner.step(f"refinement {k}", inputs, share,
                                 partial(_refine, parts, system, bodies, config, learned, k == 0))
        # features are joined to the few mixtures that matter, in the poses seen and in those of the prior
        tolerance = config.detail * template.mean_edge
        seen = learned.poses if prior is None else np.concatenate([learned.poses, prior.poses])
        return learned if not tolerance else replace(
            learned, space=compress(learned.space, seen, template, tolerance))

    return work.step("pose space" if prior is None else "pose space with the prior", inputs, share, learn)


def _refine(parts: BlendedTemplate, system: GradientSystem, bodies: np.ndarray, config: LearnConfig,
            learned: LearnedPose, choosing: bool, work: ProgressShares) -> LearnedPose:
    """The part rotations fitted anew, and Q regressed again on what the stitched model leaves.

    Stitching sees only what neighbouring triangles agree on, and Eq. 4 does not know it. So what the stitched model
    leaves of every body, as deformation of the triangles, is added to what the model says now, and regressed again:
    majorise and minimise, which lowers the error of the stitched edges step by step. What Q depends on is chosen first
    by the edges of left-out poses, and after the first fit of the rotations once more by their stitched vertices.
    """
    space, design, subject = learned.space, learned.design, parts.subject(learned.space)
    poses = fit_poses(subject, bodies, learned.poses, work)
    # corrections of the regression after each fit of the part rotations
    for number in range(3):
        subject = parts.subject(space) if number else subject
        left = parts.local_edges(bodies - subject.vertices(poses), poses)
        if choosing and number == 0:
            Q = space.gradients(poses) + _correction(parts, system, left)

            def by_vertices(tried: Design, Q: np.ndarray = Q) -> float:
                """The mean distance of the stitched vertices of left-out poses, well placed, metres."""
                off = np.stack([parts.stitch(predicted, pose) - body for body, pose, predicted in
                                zip(bodies, poses, predict_left_out(tried, poses, Q), strict=True)])
                return float(np.linalg.norm(off - off.mean(axis=1, keepdims=True), axis=2).mean())

            design = choose_design(parts.template, parts.skeleton, poses, config, by_vertices, design, design.prior)
        seen = design.prepare(poses)
        space = seen.fit(seen.of_space(space) + _correction(parts, system, seen.sums(left)))    # [SCAPE] Eq. 4
    return LearnedPose(space, poses, design)


def _correction(parts: BlendedTemplate, system: GradientSystem, left: np.ndarray) -> np.ndarray:
    """What edges (n, F, 2, 3) that the model leaves add to Q (n, F, 3, 3), which is linear in them. [SCAPE] Eq. 5"""
    return pose_gradients(system, parts.v_hat + left) - np.eye(3)


def fit_poses(subject: Subject, bodies: np.ndarray, poses: np.ndarray, work: ProgressShares,
              config: FitConfig | None = None
              ) -> np.ndarray:
    """Poses (M, J, 3), radians, with which the subject comes nearest to the bodies, from poses nearby."""
    fitter = PoseFitter(subject, config or FitConfig(polish=0))
    fitted = []
    for body, pose in zip(bodies, poses, strict=True):
        fitted.append(fitter.fit(body, pose).pose)
        work.tick(1 / len(bodies))
    return np.stack(fitted)


def learn_people(parts: BlendedTemplate, space: PoseSpace, shapes: np.ndarray | None, config: LearnConfig,
                 work: ProgressShares,
                 prior: TemplatePrior | None = None) -> ShapeSpace:
    """The space of body shapes of people (P, N, 3), who may be none, and of the prior's. [SCAPE] Eq. 7, Eq. 8"""
    if shapes is None and prior is None:
        work.tick(1 - POSES)
        return ShapeSpace.empty(len(parts.template.faces))
    people = np.zeros((0, *parts.template.vertices.shape)) if shapes is None else shapes

    def learn(inner: ProgressShares) -> ShapeSpace:
        S, volumes = shape_deformations(parts, space, people, config, inner), body_volumes(parts.template, people)
        if prior is None:
            return learn_shape_space(S, config.components, volumes)
        return add_people(S, volumes, prior_deformations(parts, space, prior.people, config),
                          body_volumes(parts.template, prior.people), WORTH, config.components)

    return work.step("shape components", (parts, space, people, config.smoothness, config.components,
                                          prior and prior.people), 1 - POSES, learn)


def prior_deformations(parts: BlendedTemplate, space: PoseSpace, people: np.ndarray, config: LearnConfig
                       ) -> np.ndarray:
    """S (1 + K, F, 3, 3), in float32, of the people of a prior, who all stand in the pose of the first.

    [SCAPE] Eq. 8
    """
    pose = parts.skeleton.pose_of(parts.skeleton.fit_rotations(parts.template, people[0]))
    solve = ShapeSolver(GradientSystem(parts.template, config.smoothness), parts.deform_edges(space.gradients(pose)))
    return np.stack([solve(parts.local_edges(person, pose)).astype(np.float32) for person in people])


def shape_deformations(parts: BlendedTemplate, space: PoseSpace, shapes: np.ndarray, config: LearnConfig,
                       work: ProgressShares
                       ) -> np.ndarray:
    """S (P, F, 3, 3) of every person, in float32 to halve the memory.

    Poses are those of Procrustes. Fitting each part to the template in the pose found, again and again, left the same
    error on new people (6.50, 5.44 and 4.37 mm at 20, 40 and 80 components against 6.48, 5.47 and 4.38).

    [SCAPE] Eq. 8
    """
    template, skeleton = parts.template, parts.skeleton
    system = GradientSystem(template, config.smoothness)

    def deformation(y: np.ndarray) -> np.ndarray:
        pose = skeleton.pose_of(skeleton.fit_rotations(template, y))
        posed = parts.deform_edges(space.gradients(pose))
        return shape_gradients(system, posed, parts.local_edges(y, pose)).astype(np.float32)

    S = np.empty((len(shapes), len(template.faces), 3, 3), dtype=np.float32)
    with SideBySide(deformation, list(shapes)) as found:
        for i, y in enumerate(shapes):
            S[i] = work.step(f"person {body_digest(y)}", (parts, space, config.smoothness, y), 1 / len(shapes),
                             lambda _, number=i: found(number))                # type: ignore[misc]
    return S


def training_metadata(template: Mesh, skeleton: Skeleton, learned: LearnedPose, poses: np.ndarray,
                      shapes: np.ndarray | None, config: LearnConfig, prior: TemplatePrior | None = None
                      ) -> dict[str, Any]:
    """What a model keeps of its making: the pose prior, its examples, and settings, choices, sizes and digests."""
    design, examples = learned.design, pose_examples(template, skeleton, learned.poses, shapes)
    mean, covariance = estimate_pose_prior(template, skeleton, examples, len(poses))
    if prior is not None:                   # what joints do that no scan bends
        examples = np.concatenate([examples, pose_examples(
            template, skeleton, skeleton.pose_of(skeleton.fit_rotations(template, prior.poses)))])
    of_prior = {} if prior is None else describe_prior(prior, skeleton, learned)
    # metres by which the built-in people's movement misses SCAPE poses of one scan
    return {"pose_mean": mean, "pose_covariance": covariance, "pose_examples": examples, "info": {
        "settings": asdict(config), "poses": len(poses), "shapes": 0 if shapes is None else len(shapes),
        "pruning": design.pruning, "ridge": design.ridge, "features": learned.space.features.count,
        "left_out_error": design.left_out_error if len(poses) > 1 else 0.016,     # of a single pose none is left out
        "digest": digest(template, poses, shapes), "digests": body_digests(poses, shapes), **of_prior}}


def describe_prior(prior: TemplatePrior, skeleton: Skeleton, learned: LearnedPose) -> dict[str, Any]:
    """What of a model is the prior's: its name, how many people its own count as, and the joints."""
    evidence = joint_evidence(learned)
    joints = [joint_in_words(name) for name, share in zip(skeleton.names, evidence, strict=True) if share < 0.5]
    return {"prior": prior.name, "prior_people": WORTH, "joint_evidence": evidence,
            "joints_of_prior": ", ".join(joints)}


def joint_evidence(learned: LearnedPose) -> list[float]:
    """How much of the deformation by each joint (J,) the scans say, from 0, all is the prior's, to 1.

    A ridge regression takes from data the share v / (v + penalty) along a twist direction of variance v. The direction
    in which a joint moved most counts; one that was pruned says nothing. The root, which deforms nothing, has 1.

    [SCAPE] Eq. 4
    """
    design, twist = learned.design, twists(learned.poses)
    if design.prior is None:
        return [1.0] * twist.shape[1]
    centred = twist - twist.mean(axis=0)
    moved = np.linalg.eigvalsh(np.einsum("mji,mjk->jik", centred, centred) / len(centred))[:, -1]
    share = np.where(moved >= design.pruning, moved / (moved + design.ridge), 0.0)
    return [1.0, *share[1:].tolist()]


def estimate_pose_prior(template: Mesh, skeleton: Skeleton, examples: np.ndarray, count: int
                        ) -> tuple[np.ndarray, np.ndarray]:
    """Mean (J, 3) and covariance (3J, 3J) of poses, radians, zero for the root, from `pose_examples` (M, J, 3).

    The first `count`, which one person took for the sake of the pose, are mixed with what people do. They and the
    rest, in which people stood, count alike, however many there are of each. A limb that nothing is known of would
    else be as likely behind the back as at the side: on half views of five men that were not learned from, that left
    20 mm where nothing was seen, and this 14.
    """
    flat, one_kind = examples.reshape(len(examples), -1), count == len(examples)

    def moments(kind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        off = kind - kind.mean(axis=0)
        return kind.mean(axis=0).reshape(-1, 3), off.T @ off / max(1, len(kind) - one_kind)

    taken = with_human_poses(template, skeleton, count, *moments(flat[:count]))
    return taken if one_kind else mix_moments(taken, moments(flat[count:]), 0.5)


def pose_examples(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None = None
                  ) -> np.ndarray:
    """Poses (M, J, 3), radians, that bodies were seen in: the training poses, and how the people (P, N, 3) stand.

    All are at most π, the root is at rest.
    """
    if shapes is not None:
        poses = np.concatenate([poses, skeleton.pose_of(skeleton.fit_rotations(template, shapes))])
    out = twists(poses).copy()
    out[:, 0] = 0
    return out


def check_training(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None,
                   prior: TemplatePrior | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Poses (M, N, 3) and people (P, N, 3) that a model can be learned from, or ValueError."""
    if prior is not None and prior.poses.shape[1:] != template.vertices.shape:
        raise ValueError(f"prior: it was brought to a template of {prior.poses.shape[1]} vertices, not to this one of "
                         f"{len(template.vertices)}")
    check_template(template)
    check_skeleton(template, skeleton)
    return (check_bodies(template, poses, "poses", 2 if prior is None else 1),
            None if shapes is None else check_bodies(template, shapes, "shapes", 2))


def check_skeleton(template: Mesh, skeleton: Skeleton) -> None:
    """ValueError for a skeleton of another template."""
    if len(skeleton.part_of_face) != len(template.faces):
        raise ValueError(f"skeleton: it has {len(skeleton.part_of_face)} faces, "
                         f"the template {len(template.faces)}")
    root = template.vertices[skeleton.part_of_vertex(template) == 0].mean(axis=0)
    if np.linalg.norm(root - skeleton.joints[0]) > 1e-6 * np.ptp(template.vertices, axis=0).max():
        raise ValueError("skeleton: joints[0] is not the centroid of part 0, so it belongs to another template")


def judge_model(model: BodyModel, people: np.ndarray | None = None) -> Judgement:
    """What a model learned with people (S, N, 3), metres, is worth: whether it means nothing, what it never saw."""
    learned = model.info.get("poses", 0)                # of nobody's poses are the examples of imported models
    known = "joints_of_prior" in model.info             # what no pose shows is known otherwise
    stiff = stiff_joints(model.pose_examples[:learned]) if learned and not known else ()
    never, doubts = f"never bent more than {np.degrees(STIFF):.0f} degrees in your poses", []
    if len(stiff) and len(stiff) == len(model.skeleton.parents) - 1:
        doubts = [f"the poses are all alike: joints {never}"]
    elif len(stiff):
        doubts = [f"the {', '.join(joint_in_words(model.skeleton.names[j]) for j in stiff)} {never}"]
    elif len(model.skeleton.parents) == 1 and model.n_betas:
        doubts = ["the body has one part and no joint: it takes no pose"]
    doubts += skeleton_doubts(model.skeleton)
    error = model.info.get("left_out_error", 0.0)
    # Metres by which a prior should not miss left-out poses: of one man 12 to 16 from three poses on, of four of him
    # with four other men, told to be one person, 27
    strange = 0.02
    if known and error > strange:
        doubts += [f"a pose that was left out is predicted {1000 * error:.0f} mm off, more than by the prior alone: "
                   "meshes of two people, or wrong ones?"]
    elif error > CRUDE:
        doubts += [f"a pose that was left out is predicted {1000 * error:.0f} mm off: it needs more poses"]
    return Judgement.of(learning_problem(model, people), doubts)


def learning_problem(model: BodyModel, people: np.ndarray | None = None) -> str | None:
    """Why a model learned with people (S, N, 3) means nothing, with the likely cause; None where it means something."""
    error, body = float(model.info.get("left_out_error", 0.0)), model.template
    if len(model.skeleton.parents) == 1 and not model.n_betas:
        return "the meshes differ neither in pose nor in shape: the body has one part, no joint and no shape components"
    spans = [extent(person) for person in people] if people is not None else [extent(body.vertices)]
    wrong = unit_problem(float(np.median(spans)), extent(body.vertices), "the people are")
    if error <= HAND * size(body) and wrong is None:
        return None
    return (f"a pose that was left out is predicted {1000 * error:.0f} mm off; "
            f"{wrong or 'too few poses, or meshes whose vertices have another order?'}")
