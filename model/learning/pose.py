"""The pose space of one person, learned from that person in many poses."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from typing import TypeVar

import numpy as np

from scanprep.batch.steps import Step, once

from ..fitting import FitConfig, PoseFitter
from ..gradients import GradientSystem, pose_gradients
from ..linear import Subject
from ..pose_space import PoseSpace
from .carriage import Carriage
from .compress import condense
from .regression import Design, RegressionConfig, choose_design

Progress = Callable[[int, int], None]
T = TypeVar("T")


@dataclass(frozen=True)
class PoseConfig(RegressionConfig):
    """Settings of the pose space: those of the regression, and how it is refined.

    Parameters
    ----------
    smoothness : float
        The paper's 0.001: times the mean edge length it is w_s of Eq. 5 and 8.
    refinements : int
        How often part rotations are fitted anew to the learned model.
    steps : int
        How often, after each of these, the regression is corrected by what the stitched model leaves.
    detail : float
        Features are joined to fewer ones as long as that changes the edges of a part by less, as a share of the mean
        edge length.
    """

    smoothness: float = 0.001
    refinements: int = 4
    steps: int = 3
    detail: float = 0.03

    @property
    def of_poses(self) -> PoseConfig:
        """The settings of the pose space alone, where there are more of them."""
        return PoseConfig(**{field.name: getattr(self, field.name) for field in fields(PoseConfig)})


@dataclass(frozen=True, eq=False)
class LearnedPose:
    """What was learned of the poses.

    Attributes
    ----------
    space : PoseSpace
    poses : (M, J, 3) float, radians
        Of the training bodies.
    design : Design
        What was chosen.
    """

    space: PoseSpace
    poses: np.ndarray
    design: Design


def learn_pose(carriage: Carriage, bodies: np.ndarray, config: PoseConfig, tick: Ticks, step: Step = once
               ) -> LearnedPose:
    """The pose space, first as in the paper, then refined on the stitched surface.

    Stitching sees only what neighbouring triangles agree on, and Eq. 4 does not know it. So, with the part
    rotations fitted anew to the learned model, what the stitched model leaves of every body (as deformation of
    the triangles) is added to what the model says now, and regressed again: majorise and minimise, which
    lowers the error of the stitched edges step by step. What Q depends on is chosen first by the edges of left-out
    poses, and after the first fit of the rotations once more by their stitched vertices.

    [SCAPE] Eq. 4, Eq. 5
    """
    template = carriage.template

    @cache
    def gradients() -> GradientSystem:
        return GradientSystem(template, config.smoothness, carriage.skeleton.part_of_face)

    inputs = carriage, bodies, config.of_poses
    learned = tick.over(len(bodies), partial(step, "first fit", inputs, lambda: _first(
        carriage, bodies, config, gradients())))
    for number in range(config.refinements):
        refine = partial(_refined, carriage, bodies, config, gradients, learned, tick, choosing=number == 0)
        learned = tick.over(len(bodies), partial(step, f"refinement {number}", inputs, refine))
    return replace(learned, space=condense(learned.space, learned.poses, template, config.detail * template.mean_edge))


def _first(carriage: Carriage, bodies: np.ndarray, config: PoseConfig, gradients: GradientSystem) -> LearnedPose:
    """Q of every body from the rotations of Procrustes, regressed.

    [SCAPE] Eq. 4, Eq. 5
    """
    template, skeleton = carriage.template, carriage.skeleton
    poses = skeleton.pose_of(skeleton.fit_rotations(template, bodies))
    Q = pose_gradients(gradients, carriage.local_edges(bodies, poses))
    design = choose_design(template, skeleton, poses, Q, config, _by_edges(carriage, Q))
    return LearnedPose(design.fit(poses, Q), poses, design)


def _refined(carriage: Carriage, bodies: np.ndarray, config: PoseConfig, gradients: Callable[[], GradientSystem],
             learned: LearnedPose, tick: Ticks, choosing: bool) -> LearnedPose:
    """The part rotations fitted anew, and Q regressed again on what the stitched model leaves."""
    space, design = learned.space, learned.design
    poses = fit_poses(carriage.subject(space), bodies, learned.poses, tick)
    for number in range(config.steps):
        left = bodies - carriage.subject(space).vertices(poses)
        Q = space.gradients(poses)
        Q += pose_gradients(gradients(), carriage.v_hat + carriage.local_edges(left, poses)) - np.eye(3)
        if choosing and number == 0:
            design = choose_design(carriage.template, carriage.skeleton, poses, Q, config,
                                   _by_vertices(carriage, bodies, poses), design)
        space = design.fit(poses, Q)
    return LearnedPose(space, poses, design)


def fit_poses(subject: Subject, bodies: np.ndarray, poses: np.ndarray, tick: Ticks) -> np.ndarray:
    """Poses (M, J, 3), radians, with which the subject comes nearest to the bodies, from poses nearby."""
    fitter = PoseFitter(subject, FitConfig(polish=0))
    fitted = []
    for body, pose in zip(bodies, poses, strict=True):
        fitted.append(fitter.fit(body, pose).pose)
        tick(1)
    return np.stack(fitted)


class Ticks:
    """Counts work for a progress callback."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0

    def __call__(self, more: int) -> None:
        self.done += more
        if self.progress and more:
            self.progress(self.done, self.total)

    def over(self, count: int, work: Callable[[], T]) -> T:
        """What some work returns; it counts so much, whether it is done now or was done before."""
        goal = self.done + count
        value = work()
        self(goal - self.done)
        return value


def _by_edges(carriage: Carriage, Q: np.ndarray) -> Callable[[np.ndarray], float]:
    """A judge of predictions of Q (M, F, 3, 3): the root mean square error of an edge."""
    v_hat = np.swapaxes(carriage.v_hat, -1, -2)

    def error(predicted: np.ndarray) -> float:
        return float(np.sqrt(np.mean([(((q - p) @ v_hat) ** 2).sum(axis=1).mean()
                                      for q, p in zip(Q, predicted, strict=True)])))

    return error


def _by_vertices(carriage: Carriage, bodies: np.ndarray, poses: np.ndarray) -> Callable[[np.ndarray], float]:
    """A judge of predictions of Q (M, F, 3, 3): the mean distance of the stitched vertices, well placed."""
    def error(predicted: np.ndarray) -> float:
        far = []
        for body, pose, Q in zip(bodies, poses, predicted, strict=True):
            off = carriage.stitched(Q, pose) - body
            far.append(np.linalg.norm(off - off.mean(axis=0), axis=1).mean())
        return float(np.mean(far))

    return error
