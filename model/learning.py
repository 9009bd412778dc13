"""Learning a SCAPE model from registered meshes."""
from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scanprep.geometry.mesh import Mesh, check_template
from scanprep.skeleton.tree import Skeleton

from .carriers import Carrier, build_basis, carried_terms, make_carriers, rigid_weights
from .features import twists
from .fitting import FitConfig, PoseFitter
from .gradients import GradientSystem, edges, local_edges, pose_gradients, shape_gradients
from .linear import Subject
from .pose_space import PoseSpace, Regression, learn_pose_space
from .scape import ScapeModel
from .shape_space import ShapeSpace, learn_shape_space
from .stitching import StitchingSystem

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class LearnConfig:
    """Settings of `learn_scape`.

    Parameters
    ----------
    smoothness : float
        The paper's 0.001: times the mean edge length it is w_s of Eq. 5 and 8.
    pruning : float, square radians
        Twist directions of smaller variance are not regressed on.
    ridges : floats, square radians
        Strengths of the regression's penalty; the one that predicts left-out poses best is taken.
    refinements : int
        How often part rotations are fitted anew to the learned model.
    steps : int
        How often, after each of these, the regression is corrected by what the stitched model leaves.
    components : int
        Shape components to keep, fewer where there are fewer people.
    """

    smoothness: float = 0.001
    pruning: float = 0.01
    ridges: tuple[float, ...] = (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1, 0.3)
    refinements: int = 2
    steps: int = 3
    components: int = 40


def learn_scape(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None, skeleton: Skeleton,
                config: LearnConfig | None = None, progress: Progress | None = None) -> ScapeModel:
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

    Raises
    ------
    ValueError
        Fewer than two poses, vertices of another count or not finite, a skeleton of another template.

    [SCAPE] Eq. 4, Eq. 5, Eq. 7, Eq. 8
    """
    config = config or LearnConfig()
    check_template(template)
    check_skeleton(template, skeleton)
    poses = checked_bodies(template, poses, "poses")
    shapes = None if shapes is None else checked_bodies(template, shapes, "shapes")
    tick = Ticks(progress, (config.refinements + 1) * len(poses) + (0 if shapes is None else len(shapes)))

    carriage = Carriage(template, skeleton, rigid_weights(skeleton))
    trained = _learn_pose(carriage, poses, config, tick)
    space = trained.regression.space

    shape_space = ShapeSpace.empty(len(template.faces))
    if shapes is not None:
        S = shape_deformations(template, space, shapes, config, tick)
        shape_space = learn_shape_space(S, config.components)
    mean, covariance = pose_prior(trained.poses)
    info: dict[str, Any] = {
        "settings": asdict(config), "poses": len(poses), "shapes": 0 if shapes is None else len(shapes),
        "ridge": trained.regression.ridge,
        "features": space.features.count, "digest": digest(template, poses, shapes)}
    return ScapeModel(template, skeleton, space, shape_space, mean, covariance, info)


def pose_prior(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean (J, 3) and covariance (3J, 3J) of poses (M, J, 3), radians, zero for the root."""
    flat = twists(poses).reshape(len(poses), -1).copy()
    flat[:, :3] = 0
    return flat.mean(axis=0).reshape(-1, 3), np.cov(flat.T, ddof=1)


@dataclass(frozen=True, eq=False)
class Carriage:
    """How rotations carry the triangles of a template, with all that does not change while a model is learned.

    Parameters
    ----------
    template : Mesh
    skeleton : Skeleton
    weights : (F, J) float
        How much each rotation carries of each triangle.
    """

    template: Mesh
    skeleton: Skeleton
    weights: np.ndarray

    @cached_property
    def carriers(self) -> list[Carrier]:
        return make_carriers(self.skeleton, self.weights)

    @cached_property
    def system(self) -> StitchingSystem:
        return StitchingSystem(self.template, self.skeleton)

    @cached_property
    def v_hat(self) -> np.ndarray:
        return edges(self.template.vertices, self.template.faces)

    def local_edges(self, bodies: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Edges (M, F, 2, 3) of bodies (M, N, 3), or of differences, as they were before rotations carried them.

        [SCAPE] Eq. 1
        """
        out = np.empty((len(bodies), *self.v_hat.shape))
        for i, (y, R) in enumerate(zip(bodies, self.skeleton.part_rotations(poses), strict=True)):
            turned = np.tensordot(self.weights, R, axes=1)
            out[i] = local_edges(y, self.template.faces, np.swapaxes(np.linalg.inv(turned), -1, -2))
        return out

    def subject(self, space: PoseSpace, S: np.ndarray | None = None) -> Subject:
        """A body with a pose space in the making, the template's own unless S (F, 3, 3) is given."""
        S = np.broadcast_to(np.eye(3), (len(self.template.faces), 3, 3)) if S is None else S
        basis = build_basis(self.system, self.template, space, S, self.carriers)
        return Subject(self.template, self.skeleton, None, carried_terms(space.features, self.carriers), basis,
                       self.skeleton.joints[0])


@dataclass(frozen=True, eq=False)
class _Trained:
    regression: Regression
    poses: np.ndarray


def _learn_pose(carriage: Carriage, bodies: np.ndarray, config: LearnConfig, tick: Ticks) -> _Trained:
    """The pose space, first as in the paper, then refined on the stitched surface.

    Stitching sees only what neighbouring triangles agree on, and Eq. 4 does not know it. So, with the part
    rotations fitted anew to the learned model, what the stitched model leaves of every body (as deformation of
    the triangles) is added to what the model says now, and regressed again: majorise and minimise, which
    lowers the error of the stitched edges step by step.

    [SCAPE] Eq. 4, Eq. 5
    """
    template, skeleton = carriage.template, carriage.skeleton
    gradients = GradientSystem(template, config.smoothness, skeleton.part_of_face)
    poses = skeleton.pose_of(skeleton.fit_rotations(template, bodies))
    Q = pose_gradients(gradients, carriage.local_edges(bodies, poses))
    regression = learn_pose_space(template, skeleton, poses, Q, config.pruning, config.ridges)
    tick(len(bodies))
    for _ in range(config.refinements):
        poses = fit_poses(carriage.subject(regression.space), bodies, poses, tick)
        for _ in range(config.steps):
            left = bodies - carriage.subject(regression.space).vertices(poses)
            Q = regression.space.gradients(poses)
            Q += pose_gradients(gradients, carriage.v_hat + carriage.local_edges(left, poses)) - np.eye(3)
            regression = learn_pose_space(template, skeleton, poses, Q, config.pruning, (regression.ridge,))
    return _Trained(regression, poses)


def fit_poses(subject: Subject, bodies: np.ndarray, poses: np.ndarray, tick: Ticks) -> np.ndarray:
    """Poses (M, J, 3), radians, with which the subject comes nearest to the bodies, from poses nearby."""
    fitter = PoseFitter(subject, FitConfig(polish=0))
    fitted = []
    for body, pose in zip(bodies, poses, strict=True):
        fitted.append(fitter.fit(body, pose).pose)
        tick(1)
    return np.stack(fitted)


def shape_deformations(template: Mesh, space: PoseSpace, shapes: np.ndarray, config: LearnConfig,
                        tick: Ticks) -> np.ndarray:
    """S (P, F, 3, 3) of every person, in float32 to halve the memory.

    [SCAPE] Eq. 8
    """
    skeleton = space.skeleton
    system = GradientSystem(template, config.smoothness)
    v_hat = edges(template.vertices, template.faces)
    S = np.empty((len(shapes), len(template.faces), 3, 3), dtype=np.float32)
    for i, y in enumerate(shapes):
        R = skeleton.fit_rotations(template, y)
        posed = v_hat @ np.swapaxes(space.gradients(skeleton.pose_of(R)), -1, -2)
        S[i] = shape_gradients(system, posed, local_edges(y, template.faces, R[skeleton.part_of_face]))
        tick(1)
    return S


class Ticks:
    """Counts work for a progress callback."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self.progress, self.total, self.done = progress, total, 0

    def __call__(self, more: int) -> None:
        self.done += more
        if self.progress:
            self.progress(self.done, self.total)


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


def digest(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None) -> str:
    """SHA-256 of the training set."""
    total = hashlib.sha256()
    for array in (template.vertices, template.faces, poses, shapes):
        if array is not None:
            total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()
