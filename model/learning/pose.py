"""The pose space of one person, learned from that person in many poses."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scanprep.geometry.mesh import Mesh

from ..blending import BlendedTemplate
from ..features import PoseFeatures
from ..fitting import FitConfig, PoseFitter
from ..gradients import GradientSystem, pose_gradients
from ..linear import Subject
from ..pose_space import PoseSpace
from .config import LearnConfig
from .regression import Design, choose_design
from .work import Work, timed

NOTHING = 1e-9                       # relative size below which a direction of the features is none


@dataclass(frozen=True, eq=False)
class LearnedPose:
    """What was learned of the poses: the pose space, the poses (M, J, 3) of the training bodies, what was chosen."""

    space: PoseSpace
    poses: np.ndarray
    design: Design


def learn_pose(parts: BlendedTemplate, bodies: np.ndarray, config: LearnConfig, work: Work) -> LearnedPose:
    """The pose space, first as in the paper, then refined on the stitched surface.

    [SCAPE] Eq. 3, Eq. 4, Eq. 5
    """
    inputs = parts, bodies, replace(config, components=0)
    return work.step("pose space", inputs, (config.refinements + 1) * len(bodies),
                     lambda inner: _learned(parts, bodies, config, inputs, inner))


def _learned(parts: BlendedTemplate, bodies: np.ndarray, config: LearnConfig, inputs: object, work: Work
             ) -> LearnedPose:
    with timed("pose space"):
        learned = work.step("first fit", inputs, len(bodies), lambda _: _first(parts, bodies, config))
        for k in range(config.refinements):
            learned = work.step(f"refinement {k}", inputs, len(bodies),
                                partial(_refined, parts, bodies, config, learned, k == 0))
        tolerance = config.detail * parts.template.mean_edge
        return learned if not tolerance else replace(
            learned, space=compress(learned.space, learned.poses, parts.template, tolerance))


def _first(parts: BlendedTemplate, bodies: np.ndarray, config: LearnConfig) -> LearnedPose:
    """Q of every body from the rotations of Procrustes, regressed on the joint twists."""
    skeleton = parts.skeleton
    poses = skeleton.pose_of(skeleton.fit_rotations(parts.template, bodies))                     # R, then Δr
    Q = pose_gradients(_system(parts, config), parts.local_edges(bodies, poses))                # [SCAPE] Eq. 5
    design = choose_design(parts.template, skeleton, poses, Q, config, _by_edges(parts, Q))
    return LearnedPose(design.fit(poses, Q), poses, design)                                     # [SCAPE] Eq. 4


def _refined(parts: BlendedTemplate, bodies: np.ndarray, config: LearnConfig, learned: LearnedPose, choosing: bool,
             work: Work) -> LearnedPose:
    """The part rotations fitted anew, and Q regressed again on what the stitched model leaves.

    Stitching sees only what neighbouring triangles agree on, and Eq. 4 does not know it. So what the stitched model
    leaves of every body, as deformation of the triangles, is added to what the model says now, and regressed again:
    majorise and minimise, which lowers the error of the stitched edges step by step. What Q depends on is chosen first
    by the edges of left-out poses, and after the first fit of the rotations once more by their stitched vertices.
    """
    space, design, system = learned.space, learned.design, _system(parts, config)
    poses = fit_poses(parts.subject(space), bodies, learned.poses, work)
    # corrections of the regression after each fit of the part rotations
    for number in range(3):
        left = bodies - parts.subject(space).vertices(poses)
        Q = space.gradients(poses)
        Q += pose_gradients(system, parts.v_hat + parts.local_edges(left, poses)) - np.eye(3)   # [SCAPE] Eq. 5
        if choosing and number == 0:
            design = choose_design(parts.template, parts.skeleton, poses, Q, config, _by_vertices(parts, bodies, poses),
                                   design)
        space = design.fit(poses, Q)                                                            # [SCAPE] Eq. 4
    return LearnedPose(space, poses, design)


def _system(parts: BlendedTemplate, config: LearnConfig) -> GradientSystem:
    return GradientSystem(parts.template, config.smoothness, parts.skeleton.part_of_face)


def fit_poses(subject: Subject, bodies: np.ndarray, poses: np.ndarray, work: Work, config: FitConfig | None = None
              ) -> np.ndarray:
    """Poses (M, J, 3), radians, with which the subject comes nearest to the bodies, from poses nearby."""
    fitter = PoseFitter(subject, config or FitConfig(polish=0))
    fitted = []
    for body, pose in zip(bodies, poses, strict=True):
        fitted.append(fitter.fit(body, pose).pose)
        work.tick(1)
    return np.stack(fitted)


def _by_edges(parts: BlendedTemplate, Q: np.ndarray) -> Callable[[np.ndarray], float]:
    """A judge of predictions of Q (M, F, 3, 3): the root mean square error of an edge."""
    v_hat = np.swapaxes(parts.v_hat, -1, -2)

    def error(predicted: np.ndarray) -> float:
        return float(np.sqrt(np.mean([(((q - p) @ v_hat) ** 2).sum(axis=1).mean()
                                      for q, p in zip(Q, predicted, strict=True)])))

    return error


def _by_vertices(parts: BlendedTemplate, bodies: np.ndarray, poses: np.ndarray) -> Callable[[np.ndarray], float]:
    """A judge of predictions of Q (M, F, 3, 3): the mean distance of the stitched vertices, well placed."""
    def error(predicted: np.ndarray) -> float:
        far = []
        for body, pose, Q in zip(bodies, poses, predicted, strict=True):
            off = parts.stitched(Q, pose) - body
            far.append(np.linalg.norm(off - off.mean(axis=0), axis=1).mean())
        return float(np.mean(far))

    return error


def compress(space: PoseSpace, poses: np.ndarray, template: Mesh, tolerance: float) -> PoseSpace:
    """The pose space with those mixtures of its features alone that matter for the edges in the poses (M, J, 3) seen.

    The fast path pays for features one by one. In each part an edge may change by the tolerance, metres root mean
    square.
    """
    features, delta = space.features, space.features.evaluate(poses)
    v_hat = np.swapaxes(template.corners[:, 1:] - template.corners[:, :1], -1, -2)
    part, mixes, coefficients = [], [], []
    for p, faces in enumerate(space.faces_of_part):
        mine = features.of_part(p)
        a = space.coefficients[p].astype(np.float64)
        X = delta[:, mine][:, 1:]
        centre = X.mean(axis=0)
        scale, axes = _principal(X - centre)                        # X - centre = U diag(scale) axesᵀ
        moved = (a[1:] @ v_hat[faces]).reshape(len(a) - 1, 6 * len(faces))
        U, s, _ = np.linalg.svd((scale[:, None] * (axes.T @ moved)), full_matrices=False)
        left = np.sqrt(np.maximum(np.cumsum((s**2)[::-1])[::-1], 0) / (len(poses) * 2 * len(faces)))
        r = int((left > tolerance).sum())
        W = axes @ (U[:, :r] / scale[:, None])                      # features -> r numbers of unit scatter
        back = (U[:, :r] * scale[:, None]).T @ axes.T               # r numbers -> features
        kept = np.tensordot(back, a[1:], axes=1)
        constant = a[0] + np.tensordot(centre, a[1:], axes=1) - np.tensordot(centre @ W, kept, axes=1)
        part += [p] * (1 + r)
        mixes.append(np.concatenate([np.zeros((*features.mix.shape[:2], 1)), features.mix[..., mine][..., 1:] @ W],
                                    axis=-1))
        coefficients.append(np.concatenate([constant[None], kept]).astype(np.float32))
    fewer = PoseFeatures(features.skeleton, features.lift, np.array(part), np.concatenate(mixes, axis=-1))
    return PoseSpace(fewer, tuple(coefficients))


def _principal(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales (k,) and axes (n, k) of centred features (M, n), without those in which nothing varies."""
    _, s, Vt = np.linalg.svd(X, full_matrices=False)
    good = s > NOTHING * max(s.max(initial=0.0), NOTHING)
    return s[good], Vt[good].T
