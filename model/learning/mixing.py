"""Learning from a random mix of people and poses, without one person scanned in many poses.

A body is `R S Q v̂`. With S of the people known, their scans determine Q; with Q known, they determine S. The two are
solved in turns [SCAPE-patent], and so are the part rotations R, which Procrustes cannot separate from the shape.
"""
from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from operator import attrgetter

import numpy as np

from scanprep.batch.room import Step, run_uncached
from scanprep.geometry.members import check_members, find_doubtful_members
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.geometry.upright import find_up
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blending import BlendedTemplate, rigid_weights
from ..digests import body_digests, check_bodies, digest
from ..gradients import GradientSystem, ShapeSolver, pose_gradients
from ..pose_space import PoseSpace
from ..scape import ScapeModel
from ..shape_space import ShapeSpace, body_volumes, learn_shape_space
from .config import LearnConfig
from .regression import Design, compress, make_design
from .scape import Progress, ProgressShares, check_skeleton, estimate_pose_prior, fit_poses, pose_examples

# Defaults of `learn_scape_mix`. `refinements` is the number of rounds: of up to six, two gave the smallest error on
# held-out bodies. Products of twists help more than for one person: 1.46 instead of 1.68 mm on new people.
MIX = LearnConfig(features="quadratic", ridges=(1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1), detail=0.005,
                  refinements=2)
CORRECTIONS = 2                      # how often Q and S are corrected in a round by the residual of the stitched model


@dataclass(frozen=True, eq=False)
class Mix:
    """The training set: bodies (M, N, 3) of people `who` (M,), numbers from 0, on a template with its parts."""

    parts: BlendedTemplate
    bodies: np.ndarray
    who: np.ndarray
    config: LearnConfig


@dataclass(frozen=True, eq=False)
class MixingState:
    """The state between rounds: poses (M, J, 3), the pose space, S (P, F, 3, 3) of every person, the design."""

    poses: np.ndarray
    space: PoseSpace
    S: np.ndarray
    design: Design | None


@one_thread()
def learn_scape_mix(template: Mesh, bodies: np.ndarray, subjects: Sequence[Hashable], skeleton: Skeleton,
                    config: LearnConfig | None = None, progress: Progress | None = None, step: Step = run_uncached
                    ) -> ScapeModel:
    """Learn a body model from any people in any poses.

    In every round the part rotations are fitted to the model, the pose model is regressed with the people's shapes
    held, and the shapes are solved for with the pose model held. Shapes are held down to a few components at first,
    and what the bodies of one person have in common is never left to the pose model.

    Q and S are determined up to a factor per triangle only, `S Q = (S A)(A⁻¹ Q)`. It is fixed by Q = I at zero
    twist, so that S carries all that the pose does not change, and the template's own body, which need not be among
    the bodies, has S = I. That Q is found from `S⁻¹ Rᵀ v` weighs its residuals by the inverse shape, which keeps one
    factorisation for all bodies.

    Parameters
    ----------
    template : Mesh
        N vertices, F triangles.
    bodies : (M, N, 3) float, metres
        Registered bodies.
    subjects : M labels
        Whose body each is.
    skeleton : Skeleton
        On the template.
    config : LearnConfig, optional
        By default `MIX`.
    progress, step
        As for `learn_scape`.

    Raises
    ------
    ValueError
        Bodies of another shape or not finite, labels of another count, fewer than two people or four bodies, a
        skeleton of another template, settings without rounds or with support vectors.

    [SCAPE] Eq. 4, Eq. 5, Eq. 7, Eq. 8
    """
    config = config or MIX
    if config.regressor != "ridge" or not config.refinements:
        raise ValueError(f"config: expected the regressor 'ridge' and at least 1 refinement for a mix, got "
                         f"{config.regressor!r} and {config.refinements}")
    check_template(template)
    check_skeleton(template, skeleton)
    bodies = check_bodies(template, bodies, "bodies", 2)
    check_members(template, bodies, "bodies")
    template = find_up(template, bodies)
    who, parts = number_people(subjects, len(bodies)), BlendedTemplate(template, skeleton, rigid_weights(skeleton))
    mix, inputs = Mix(parts, bodies, who, config), (parts, bodies, who, config)

    def in_turns(work: ProgressShares) -> tuple[MixingState, ShapeSpace]:
        # start: rigid parts by Procrustes, and the template's shape for everybody
        state = MixingState(skeleton.pose_of(skeleton.fit_rotations(template, bodies)), PoseSpace.identity(skeleton),
                            np.broadcast_to(np.eye(3, dtype=np.float32), (who.max() + 1, len(template.faces), 3, 3)),
                            None)
        for number in range(config.refinements):
            state = work.step(f"round {number}", (*inputs, number), 1 / config.refinements,
                              partial(_next_round, mix, state, number))
        # the volume of a person is the mean of their bodies; their shapes are then no longer needed
        volumes = np.bincount(who, body_volumes(template, bodies)) / np.bincount(who)
        return replace(state, S=state.S[:0]), learn_shape_space(state.S, config.components, volumes)

    state, shapes = ProgressShares(progress, step).step("poses and shapes in turns", inputs, 1.0, in_turns)
    assert state.design is not None
    examples = pose_examples(template, skeleton, state.poses)
    prior = estimate_pose_prior(template, skeleton, examples, len(examples))
    return ScapeModel(template, skeleton, state.space, shapes, *prior, {
        "settings": asdict(config), "bodies": len(bodies), "people": int(who.max()) + 1, "rounds": config.refinements,
        "pruning": state.design.pruning, "ridge": state.design.ridge, "features": state.space.features.count,
        "spikes": find_doubtful_members(template, bodies, "bodies", ratio=np.inf),
        "digest": digest(template, bodies, None), "digests": body_digests(bodies)}, pose_examples=examples)


def _next_round(mix: Mix, state: MixingState, number: int, work: ProgressShares) -> MixingState:
    """Fit part rotations with the model held, then the pose model with the shapes held, then the shapes."""
    S, poses = state.S, state.poses.copy()
    # shapes are limited to 20 components in the first round, and twice as many in each further round
    if 20 * 2**number < len(S) - 1:
        limited = learn_shape_space(S, 20 * 2**number)
        S = (limited.mean + np.tensordot(limited.betas_of(S), limited.components, axes=1)).astype(np.float32)
    for person in range(len(S) if number else 0):
        own = mix.who == person
        poses[own] = fit_poses(mix.parts.subject(state.space, S[person]), mix.bodies[own], poses[own],
                               ProgressShares(None))
        work.tick(float(own.mean()))
    space, design = _learn_pose(mix, MixingState(poses, state.space, S, state.design))         # [SCAPE] Eq. 4, Eq. 5
    return MixingState(poses, space, _learn_people(mix, poses, space), design)                # [SCAPE] Eq. 8


def _learn_pose(mix: Mix, state: MixingState) -> tuple[PoseSpace, Design]:
    """Learn the pose space with the shapes held, as in the paper, then correct it on the stitched surface.

    [SCAPE] Eq. 4, Eq. 5
    """
    parts, config, poses, S = mix.parts, mix.config, state.poses, state.S.astype(np.float64)
    gradients = GradientSystem(parts.template, parts=parts.skeleton.part_of_face)
    # S⁻¹, a tenth damped against triangles that somebody has nearly flat; the identity stays the identity
    inverse = 1.1 * np.swapaxes(S, -1, -2) @ np.linalg.inv(S @ np.swapaxes(S, -1, -2) + 0.1 * np.eye(3))
    back = np.swapaxes(inverse, -1, -2)
    space, design = state.space, state.design
    for step in range(1 + CORRECTIONS):
        # residual edges: of the parts by themselves at first, then of the stitched bodies
        Q = space.gradients(poses)
        left = np.empty((len(poses), *parts.v_hat.shape))
        for i, (body, pose, q) in enumerate(zip(mix.bodies, poses, state.S[mix.who] @ Q, strict=True)):
            if step == 0:
                left[i] = parts.local_edges(body, pose) - parts.deform_edges(q)
            else:
                left[i] = parts.local_edges(body - parts.stitch(q, pose), pose)
        Q += pose_gradients(gradients, parts.v_hat + left @ back[mix.who]) - np.eye(3)
        design = design or choose_within(parts.template, parts.skeleton, poses, Q, mix.who, config)
        space = fit_within(design, poses, Q, mix.who)
    assert design is not None
    space = compress(space, poses, parts.template, config.detail * parts.template.mean_edge)
    # S Q is unique only up to a factor: fix Q = I at zero twist, and let S take over the rest
    rest = np.linalg.inv(space.gradients(np.zeros(parts.skeleton.joints.shape)))
    return PoseSpace(space.features, tuple((rest[faces] @ a.astype(np.float64)).astype(np.float32) for faces, a in
                                           zip(space.faces_of_part, space.coefficients, strict=True))), design


def _learn_people(mix: Mix, poses: np.ndarray, space: PoseSpace) -> np.ndarray:
    """Fit S (P, F, 3, 3) of every person to all of their bodies together, in float32 to halve the memory.

    As with Q, the residual of the stitched bodies is added and solved for again.

    [SCAPE] Eq. 8
    """
    def side_by_side(edges: np.ndarray) -> np.ndarray:
        """Arrange edges (n, F, 2, 3) of several scans as those (F, 2n, 3) of one."""
        return np.concatenate(list(edges), axis=1)

    parts, P = mix.parts, int(mix.who.max()) + 1
    system = GradientSystem(parts.template)
    S = np.empty((P, len(parts.template.faces), 3, 3), dtype=np.float32)
    for person in range(P):
        bodies, own = mix.bodies[mix.who == person], poses[mix.who == person]
        Q = space.gradients(own)
        posed = side_by_side(parts.deform_edges(Q))
        solve = ShapeSolver(system, posed)
        shape = solve(side_by_side(parts.local_edges(bodies, own)))
        for _ in range(CORRECTIONS):
            left = bodies - np.stack([parts.stitch(shape @ q, pose) for q, pose in zip(Q, own, strict=True)])
            shape = solve(posed @ np.swapaxes(shape, -1, -2) + side_by_side(parts.local_edges(left, own)))
        S[person] = shape
    return S


@dataclass(frozen=True, eq=False)
class Within:
    """The transform that turns a regression with a random effect for each person into an ordinary one.

    `who` (M,) is the person of each body, 0..P-1. A share of the mean over a person's bodies is subtracted from each;
    it is the larger the more bodies there are. So a person's own shape has little weight. Where each person has only
    one body, all have equal weight.
    """

    who: np.ndarray

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Subtract that share from values (M, ...)."""
        out = np.array(values, dtype=np.float64)
        for person in range(int(self.who.max()) + 1):
            own = self.who == person
            # 30: ratio of the variances between and within people that the regression does not explain
            out[own] -= (1 - 1 / np.sqrt(1 + 30.0 * own.sum())) * out[own].mean(axis=0)
        return out

    def without_the_person(self, X: np.ndarray, operator: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Compute leave-one-person-out residuals (M, n) in closed form.

        Features X (M, k) and targets (M, n) are transformed; `operator` (k, M) maps targets to coefficients.
        """
        hat = X @ operator
        left = target - hat @ target
        for person in range(int(self.who.max()) + 1):
            own = np.flatnonzero(self.who == person)
            left[own] = np.linalg.solve(np.eye(len(own)) * (1 + 1e-9) - hat[np.ix_(own, own)], left[own])
        return left


def choose_within(template: Mesh, skeleton: Skeleton, poses: np.ndarray, Q: np.ndarray, who: np.ndarray,
                  config: LearnConfig) -> Design:
    """Choose the pruning and penalty that predict the edges of left-out people best.

    From poses (M, J, 3), Q (M, F, 3, 3), and the person of each body, `who` (M,).

    [SCAPE] Eq. 4
    """
    designs = (make_design(template, skeleton, poses, config, pruning, ridge)
               for pruning, ridge in product(config.prunings, config.ridges))
    return min((replace(design, left_out_error=_leave_out_error(design, poses, Q, who)) for design in designs),
               key=attrgetter("left_out_error"))


def fit_within(design: Design, poses: np.ndarray, Q: np.ndarray, who: np.ndarray) -> PoseSpace:
    """Fit Q as a function of the features, as `Design.fit`, with a random effect for each person.

    [SCAPE] Eq. 4
    """
    within = Within(who)
    delta = within(design.features.evaluate(poses))
    return design.space(lambda used, faces: _operator(delta[:, used], design.ridge) @ within(Q[:, faces]).reshape(
        len(poses), -1))


def _operator(X: np.ndarray, ridge: float) -> np.ndarray:
    """Compute the ridge operator (k, M) from targets to coefficients; the first feature, the constant, is free."""
    penalty = np.full(X.shape[1], len(X) * ridge + 1e-12)
    penalty[0] = 1e-12
    return np.linalg.solve(X.T @ X + np.diag(penalty), X.T)


def _leave_out_error(design: Design, poses: np.ndarray, Q: np.ndarray, who: np.ndarray) -> float:
    """Compute the RMS error, metres, of the edges of left-out people, apart from each person's random effect."""
    within = Within(who)
    delta, total = within(design.features.evaluate(poses)), 0.0
    v_hat = np.swapaxes(design.template.corners[:, 1:] - design.template.corners[:, :1], -1, -2)
    for part, used, faces in design.groups:
        X = delta[:, np.r_[design.features.starts[part], used]]
        target = within(Q[:, faces] @ v_hat[faces]).reshape(len(poses), -1)
        total += float((within.without_the_person(X, _operator(X, design.ridge), target) ** 2).sum())
    return float(np.sqrt(total / (Q.shape[0] * Q.shape[1] * 2)))


def number_people(subjects: Sequence[Hashable], count: int) -> np.ndarray:
    """Number the people in order of appearance, (M,); ValueError for too few."""
    if len(subjects) != count:
        raise ValueError(f"subjects: expected {count} labels, one a body, got {len(subjects)}")
    order = {label: i for i, label in enumerate(dict.fromkeys(subjects))}
    if len(order) < 2 or count < 4:
        raise ValueError(f"subjects: expected at least 2 people and 4 bodies, got {len(order)} people and "
                         f"{count} bodies; learn_scape learns from the poses of one person")
    return np.array([order[label] for label in subjects])
