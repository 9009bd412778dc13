"""A round of learning from a mix: part rotations, pose model, shapes, each with the others held."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from scanprep.batch.steps import Step
from scanprep.ranges import TINY, Count, Positive, Range

from ..gradients import GradientSystem, ShapeSolver, pose_gradients
from ..pose_space import PoseSpace
from ..shape_space import learn_shape_space
from .carriage import Carriage
from .compress import condense
from .pose import Ticks, fit_poses
from .regression import Design, RegressionConfig
from .within import choose_within, fit_within

DAMPING = 0.1                        # of the inverse of S, against triangles that somebody has nearly flat


@dataclass(frozen=True)
class MixConfig(RegressionConfig):
    """Settings of `learn_scape_mix`: those of the regression, which has to be ridge regression, and of the rounds.

    Parameters
    ----------
    smoothness : float
        The paper's 0.001: times the mean edge length it is w_s of Eq. 5 and 8.
    detail : float
        Features are joined to fewer ones as long as that changes the edges of a part by less, as a share of the mean
        edge length.
    components : int
        Shape components to keep, fewer where there are fewer people.
    stiff : int
        Shape components that tell people apart in the first round; twice as many in each round that follows.
    steps : int
        How often in a round the regression is corrected by what the stitched model leaves.
    rounds : int
        Largest number of rounds.
    held_out : float
        Share of the bodies that is held out to find after how many rounds to stop.
    tolerance : float
        A round counts as progress when it lowers the held-out error by this share of it.

    Raises
    ------
    ValueError
        Support vectors asked for; rounds, or a share to hold out, out of range.
    """

    features: Literal["linear", "quadratic", "radial"] = "quadratic"
    ridges: tuple[Positive, ...] = (1e-4, 3e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)
    smoothness: float = 0.001
    detail: float = 0.005
    components: int = 40
    stiff: int = 20
    steps: int = 2
    rounds: Count = 6
    held_out: Annotated[float, Range(TINY, 0.5)] = 0.2
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.regressor != "ridge":
            raise ValueError(f"regressor: expected 'ridge' for a mix, got {self.regressor!r}")


@dataclass(frozen=True, eq=False)
class Mix:
    """The training set: bodies (M, N, 3) of people `who` (M,), numbers from 0, and how rotations carry the template."""

    carriage: Carriage
    bodies: np.ndarray
    who: np.ndarray
    config: MixConfig

    @property
    def people(self) -> int:
        """P, the number of people."""
        return int(self.who.max()) + 1

    def of(self, person: int) -> np.ndarray:
        """The bodies of one person."""
        return np.flatnonzero(self.who == person)

    def some(self, chosen: np.ndarray) -> Mix:
        """The mix of some of the bodies, people numbered anew."""
        return Mix(self.carriage, self.bodies[chosen], np.unique(self.who[chosen], return_inverse=True)[1], self.config)


@dataclass(frozen=True, eq=False)
class State:
    """What a round hands to the next: poses (M, J, 3), the pose space, S (P, F, 3, 3) of every person, the design."""

    poses: np.ndarray
    space: PoseSpace
    S: np.ndarray
    design: Design | None


def start(mix: Mix) -> State:
    """Rigid parts, as Procrustes places them, and everybody of the template's shape."""
    skeleton, template = mix.carriage.skeleton, mix.carriage.template
    poses = skeleton.pose_of(skeleton.fit_rotations(template, mix.bodies))
    S = np.broadcast_to(np.eye(3, dtype=np.float32), (mix.people, len(template.faces), 3, 3))
    return State(poses, PoseSpace.identity(skeleton), S, None)


def kept_round(mix: Mix, state: State, number: int, tick: Ticks, step: Step) -> State:
    """The next round, in a step."""
    return tick.over(len(mix.bodies), lambda: step(
        f"round {number}", (mix.carriage, mix.bodies, mix.who, mix.config, number),
        lambda: next_round(mix, state, number, tick)))


def next_round(mix: Mix, state: State, number: int, tick: Ticks) -> State:
    """Part rotations with the model held, then the pose model with the shapes held, then the shapes."""
    S, poses = _simplified(state.S, mix.config.stiff * 2**number), state.poses.copy()
    if number == 0:
        tick(len(poses))
    for person in range(mix.people if number else 0):
        mine = mix.of(person)
        poses[mine] = fit_poses(mix.carriage.subject(state.space, S[person]), mix.bodies[mine], poses[mine], tick)
    space, design = _learn_pose(mix, State(poses, state.space, S, state.design))
    return State(poses, space, people_shapes(mix, poses, space), design)


def _learn_pose(mix: Mix, state: State) -> tuple[PoseSpace, Design]:
    """The pose space with the shapes held, first as in the paper, then corrected on the stitched surface.

    As in `learn_pose`, where all bodies are one person's.

    [SCAPE] Eq. 4, Eq. 5
    """
    carriage, config, poses, S = mix.carriage, mix.config, state.poses, state.S
    template, skeleton = carriage.template, carriage.skeleton
    gradients = GradientSystem(template, config.smoothness, skeleton.part_of_face)
    back = np.swapaxes(_safe_inverse(S), -1, -2)
    space, design = state.space, state.design
    for step in range(1 + config.steps):
        Q = space.gradients(poses)
        left = np.empty((len(poses), *carriage.v_hat.shape))
        for i, (body, pose, q) in enumerate(zip(mix.bodies, poses, S[mix.who] @ Q, strict=True)):
            if step == 0:
                left[i] = carriage.local_edges(body[None], pose[None])[0] - carriage.v_hat @ np.swapaxes(q, -1, -2)
            else:
                left[i] = carriage.local_edges(body[None] - carriage.stitched(q, pose), pose[None])[0]
        Q += pose_gradients(gradients, carriage.v_hat + left @ back[mix.who]) - np.eye(3)
        design = design or choose_within(template, skeleton, poses, Q, mix.who, config)
        space = fit_within(design, poses, Q, mix.who)
    assert design is not None
    return _at_rest(condense(space, poses, template, config.detail * template.mean_edge)), design


def _safe_inverse(S: np.ndarray) -> np.ndarray:
    """`S⁻¹`, less of it where S is nearly flat; the identity stays the identity."""
    S = S.astype(np.float64)
    St = np.swapaxes(S, -1, -2)
    return (1 + DAMPING) * St @ np.linalg.inv(S @ St + DAMPING * np.eye(3))


def _at_rest(space: PoseSpace) -> PoseSpace:
    """The pose space with Q = I at zero twist; S takes over what was there."""
    back = np.linalg.inv(space.gradients(np.zeros((len(space.skeleton.parents), 3))))
    coefficients = tuple((back[faces] @ a.astype(np.float64)).astype(np.float32)
                         for faces, a in zip(space.faces_of_part, space.coefficients, strict=True))
    return PoseSpace(space.features, coefficients)


def people_shapes(mix: Mix, poses: np.ndarray, space: PoseSpace) -> np.ndarray:
    """S (P, F, 3, 3) of every person from all of his bodies together, in float32 to halve the memory.

    As with Q, Eq. 8 does not know of the stitching: what the stitched bodies leave is added and solved for again.

    [SCAPE] Eq. 8
    """
    carriage = mix.carriage
    system = GradientSystem(carriage.template, mix.config.smoothness)
    S = np.empty((mix.people, len(carriage.template.faces), 3, 3), dtype=np.float32)
    for person in range(mix.people):
        mine = mix.of(person)
        Q = space.gradients(poses[mine])
        posed = _side_by_side(carriage.v_hat @ np.swapaxes(Q, -1, -2))
        solve = ShapeSolver(system, posed)
        found = solve(_side_by_side(carriage.local_edges(mix.bodies[mine], poses[mine])))
        for _ in range(mix.config.steps):
            left = mix.bodies[mine] - np.stack([carriage.stitched(found @ q, pose)
                                                for q, pose in zip(Q, poses[mine], strict=True)])
            found = solve(posed @ np.swapaxes(found, -1, -2) + _side_by_side(carriage.local_edges(left, poses[mine])))
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
    flat = space.components.reshape(space.count, S[0].size)
    betas = (S - space.mean).reshape(len(S), -1) @ (flat / np.maximum((flat**2).sum(axis=1, keepdims=True), 1e-30)).T
    return space.mean + (betas @ flat).reshape(S.shape)
