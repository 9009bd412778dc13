"""Learning from a random mix of people and poses, without one person scanned in many poses.

A body is explained by `R S Q v̂`: with the people's S known, their scans tell Q; with Q known, they tell S. The two are
found in turns [SCAPE-patent], and so are the part rotations R, which Procrustes cannot tell from the shape.
"""
from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from scanprep.batch.room import Step, once
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blending import BlendedTemplate, rigid_weights
from ..digests import body_digests, digest
from ..fitting.vertices import FitConfig, ShapeFitter
from ..gradients import GradientSystem, ShapeSolver, pose_gradients
from ..pose_space import PoseSpace
from ..scape import ScapeModel
from ..shape_space import ShapeSpace, body_volumes, learn_shape_space
from .config import LearnConfig
from .regression import Design, compress
from .scape import Progress, Work, check_skeleton, checked_bodies, fit_poses, pose_examples, pose_prior
from .within import choose_within, fit_within, held_out_bodies, number_people

# what `learn_scape_mix` takes by default; `refinements` is the largest number of rounds
MIX = LearnConfig(features="quadratic", ridges=(1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1), detail=0.005, refinements=6)
CORRECTIONS = 2                      # of Q and of S in a round, by what the stitched model leaves
GAIN = 0.01                          # a round counts as progress when it lowers the held-out error by this share of it


@dataclass(frozen=True, eq=False)
class Mix:
    """The training set: bodies (M, N, 3) of people `who` (M,), numbers from 0, on a template with its parts."""

    parts: BlendedTemplate
    bodies: np.ndarray
    who: np.ndarray
    config: LearnConfig

    @property
    def people(self) -> int:
        """P, the number of people."""
        return int(self.who.max()) + 1

    def some(self, chosen: np.ndarray) -> Mix:
        """The mix of some of the bodies, people numbered anew."""
        return replace(self, bodies=self.bodies[chosen], who=np.unique(self.who[chosen], return_inverse=True)[1])


@dataclass(frozen=True, eq=False)
class State:
    """What a round hands to the next: poses (M, J, 3), the pose space, S (P, F, 3, 3) of every person, the design."""

    poses: np.ndarray
    space: PoseSpace
    S: np.ndarray
    design: Design | None


@one_thread()
def learn_scape_mix(template: Mesh, bodies: np.ndarray, subjects: Sequence[Hashable], skeleton: Skeleton,
                    config: LearnConfig | None = None, progress: Progress | None = None, step: Step = once
                    ) -> ScapeModel:
    """Learn a body model from any people in any poses.

    In every round the part rotations are fitted to the model, the pose model is regressed with the people's shapes
    held, and the shapes are solved for with the pose model held. Shapes are held down to a few components at first,
    and what the bodies of one person have in common is never left to the pose model. The number of rounds is the one
    with which bodies that were held out are met best; then everything trains.

    Q and S are determined up to a factor per triangle only, `S Q = (S A)(A⁻¹ Q)`. It is fixed by Q = I at zero
    twist, so that S carries all that the pose does not change, and the template's own body, which need not be among
    the bodies, has S = I. That Q is found from `S⁻¹ Rᵀ v` weighs its residuals by the inverse shape, which keeps one
    factorisation for all bodies.

    Parameters
    ----------
    template : Mesh
    bodies : (M, N, 3) float, metres
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
    bodies = checked_bodies(template, bodies, "bodies")
    mix = Mix(BlendedTemplate(template, skeleton, rigid_weights(skeleton)), bodies,
              number_people(subjects, len(bodies)), config)
    work, inputs = Work(progress, step), (mix.parts, bodies, mix.who, config)
    errors = work.step("how many rounds", inputs, 0.5, lambda inner: held_out_errors(mix, inner))
    rounds = 1 + int(np.argmin(errors))
    state, shapes = work.step("poses and shapes in turns", inputs, 0.5, lambda inner: _in_turns(mix, rounds, inner))
    assert state.design is not None
    return _model(mix, state, shapes, {
        "settings": asdict(config), "bodies": len(bodies), "people": mix.people, "rounds": rounds,
        "held_out_errors": errors, "pruning": state.design.pruning, "ridge": state.design.ridge,
        "features": state.space.features.count, "digest": digest(template, bodies, None),
        "digests": body_digests(bodies)})


def _in_turns(mix: Mix, rounds: int, work: Work) -> tuple[State, ShapeSpace]:
    """What so many rounds reach, and the space of the shapes, which are then no longer needed."""
    state = _start(mix)
    for number in range(rounds):
        state = _kept_round(mix, state, number, 1 / rounds, work)
    return replace(state, S=np.zeros((0, 3, 3))), _shape_space(mix, state)


def _shape_space(mix: Mix, state: State) -> ShapeSpace:
    """The space of the people's shapes, whose volumes are the means of their bodies."""
    volumes = np.bincount(mix.who, body_volumes(mix.parts.template, mix.bodies)) / np.bincount(mix.who)
    return learn_shape_space(state.S, mix.config.components, volumes)


def held_out_errors(mix: Mix, work: Work) -> list[float]:
    """Mean error, metres, of bodies that are held out, after each round until it stops falling."""
    # share of the bodies that is held out to find after how many rounds to stop
    held = held_out_bodies(mix.who, 0.2)
    train = mix.some(np.setdiff1d(np.arange(len(mix.bodies)), held))
    state, errors, share = _start(train), list[float](), 0.5 / mix.config.refinements

    def error(_: Work) -> float:
        model = _model(train, state, _shape_space(train, state), {})
        fitter = ShapeFitter(model, FitConfig(sample=400, polish=0))
        return float(np.mean([fitter.fit(y).mean for y in mix.bodies[held]]))

    for number in range(mix.config.refinements):
        state = _kept_round(train, state, number, share, work)
        errors.append(work.step(f"error of round {number}", (mix.parts, mix.bodies, mix.who, mix.config, number),
                                share, error))
        if number and errors[-1] > (1 - GAIN) * min(errors[:-1]):
            break
    return errors


def _model(mix: Mix, state: State, shapes: ShapeSpace, info: dict[str, object]) -> ScapeModel:
    """The model that a round has reached."""
    template, skeleton = mix.parts.template, mix.parts.skeleton
    examples = pose_examples(template, skeleton, state.poses)
    prior = pose_prior(template, skeleton, examples, len(examples))
    return ScapeModel(template, skeleton, state.space, shapes, *prior, info, pose_examples=examples)


def _start(mix: Mix) -> State:
    """Rigid parts, as Procrustes places them, and everybody of the template's shape."""
    skeleton, template = mix.parts.skeleton, mix.parts.template
    poses = skeleton.pose_of(skeleton.fit_rotations(template, mix.bodies))
    S = np.broadcast_to(np.eye(3, dtype=np.float32), (mix.people, len(template.faces), 3, 3))
    return State(poses, PoseSpace.identity(skeleton), S, None)


def _kept_round(mix: Mix, state: State, number: int, share: float, work: Work) -> State:
    """The next round, in a step."""
    return work.step(f"round {number}", (mix.parts, mix.bodies, mix.who, mix.config, number), share,
                     lambda inner: _next_round(mix, state, number, inner))


def _next_round(mix: Mix, state: State, number: int, work: Work) -> State:
    """Part rotations with the model held, then the pose model with the shapes held, then the shapes."""
    # shape components that tell people apart: in each round twice as many as in the one before
    S, poses = _simplified(state.S, 20 * 2**number), state.poses.copy()
    for person in range(mix.people if number else 0):
        mine = mix.who == person
        poses[mine] = fit_poses(mix.parts.subject(state.space, S[person]), mix.bodies[mine], poses[mine], Work(None))
        work.tick(float(mine.mean()))
    space, design = _learn_pose(mix, State(poses, state.space, S, state.design))         # [SCAPE] Eq. 4, Eq. 5
    return State(poses, space, _learn_people(mix, poses, space), design)                # [SCAPE] Eq. 8


def _learn_pose(mix: Mix, state: State) -> tuple[PoseSpace, Design]:
    """The pose space with the shapes held, first as in the paper, then corrected on the stitched surface, as in
    `learn_pose`. [SCAPE] Eq. 4, Eq. 5
    """
    parts, config, poses, S = mix.parts, mix.config, state.poses, state.S
    gradients = GradientSystem(parts.template, config.smoothness, parts.skeleton.part_of_face)
    back = np.swapaxes(_safe_inverse(S), -1, -2)
    space, design = state.space, state.design
    for step in range(1 + CORRECTIONS):
        Q = space.gradients(poses)
        left = np.empty((len(poses), *parts.v_hat.shape))
        for i, (body, pose, q) in enumerate(zip(mix.bodies, poses, S[mix.who] @ Q, strict=True)):
            if step == 0:
                left[i] = parts.local_edges(body, pose) - parts.posed(q)
            else:
                left[i] = parts.local_edges(body - parts.stitched(q, pose), pose)
        Q += pose_gradients(gradients, parts.v_hat + left @ back[mix.who]) - np.eye(3)
        design = design or choose_within(parts.template, parts.skeleton, poses, Q, mix.who, config)
        space = fit_within(design, poses, Q, mix.who)
    assert design is not None
    return _at_rest(compress(space, poses, parts.template, config.detail * parts.template.mean_edge)), design


def _safe_inverse(S: np.ndarray) -> np.ndarray:
    """`S⁻¹`, a tenth damped against triangles that somebody has nearly flat; the identity stays the identity."""
    S = S.astype(np.float64)
    St = np.swapaxes(S, -1, -2)
    return 1.1 * St @ np.linalg.inv(S @ St + 0.1 * np.eye(3))


def _at_rest(space: PoseSpace) -> PoseSpace:
    """The pose space with Q = I at zero twist; S takes over what was there."""
    back = np.linalg.inv(space.gradients(np.zeros((len(space.skeleton.parents), 3))))
    coefficients = tuple((back[faces] @ a.astype(np.float64)).astype(np.float32)
                         for faces, a in zip(space.faces_of_part, space.coefficients, strict=True))
    return PoseSpace(space.features, coefficients)


def _learn_people(mix: Mix, poses: np.ndarray, space: PoseSpace) -> np.ndarray:
    """S (P, F, 3, 3) of every person from all of their bodies together, in float32 to halve the memory. As with Q, what
    the stitched bodies leave is added and solved for again. [SCAPE] Eq. 8
    """
    parts = mix.parts
    system = GradientSystem(parts.template, mix.config.smoothness)
    S = np.empty((mix.people, len(parts.template.faces), 3, 3), dtype=np.float32)
    for person in range(mix.people):
        bodies, mine = mix.bodies[mix.who == person], poses[mix.who == person]
        Q = space.gradients(mine)
        posed = _side_by_side(parts.posed(Q))
        solve = ShapeSolver(system, posed)
        found = solve(_side_by_side(parts.local_edges(bodies, mine)))
        for _ in range(CORRECTIONS):
            left = bodies - np.stack([parts.stitched(found @ q, pose) for q, pose in zip(Q, mine, strict=True)])
            found = solve(posed @ np.swapaxes(found, -1, -2) + _side_by_side(parts.local_edges(left, mine)))
        S[person] = found
    return S


def _side_by_side(edges: np.ndarray) -> np.ndarray:
    """Edges (n, F, 2, 3) of several scans as those (F, 2n, 3) of one."""
    return np.concatenate(list(edges), axis=1)


def _simplified(S: np.ndarray, count: int) -> np.ndarray:
    """S (P, F, 3, 3) held down to its first components."""
    if count >= len(S) - 1:
        return S
    space = learn_shape_space(S, count)
    return (space.mean + np.tensordot(space.betas_of(S), space.components, axes=1)).astype(np.float32)
