"""The shape of an unknown person from several frames at once."""
from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.least_squares import normal_equations

from .. import energy
from ..bodies import ShapedBody
from ..partial.fit import ScanFit
from ..partial.scan import ScanPoints
from .frame_fit import NOTHING, scan_terms
from .settings import TrackConfig


@dataclass(frozen=True, eq=False)
class SharedShape:
    """One shape in several poses."""

    betas: np.ndarray       # (K,)
    x: np.ndarray           # (n, P), pose and trans of every frame


def shared_shape(body: ShapedBody, clouds: Sequence[ScanPoints], x: np.ndarray, betas: np.ndarray,
                 config: TrackConfig) -> SharedShape:
    """Betas that explain several frames together, each with a pose of its own.

    Every round matches all frames anew and takes one Gauss-Newton step on all unknowns, in which the poses are
    eliminated frame by frame.

    `x` (n, P), pose and trans of each, near the truth; `betas` (K,), to begin with.
    """
    fit = ScanFit(body, clouds[0], *NOTHING, config.scan)
    fits = [_own_body(fit.on(cloud), body) for cloud in clouds]
    x, betas, free = x.copy(), betas.copy(), x.shape[1]
    for i in range(config.shape_rounds):
        reach = config.reach * (config.final_reach / config.reach)**min(1.0, i / 2)
        systems = [_system(fit, np.concatenate([x[k], betas]), reach) for k, fit in enumerate(fits)]
        prior = energy.shape_prior(betas[None], 0)
        _, gradient, matrix = (part[0] for part in normal_equations([prior]))
        back = []
        for g, H in systems:
            by_pose = np.linalg.solve(H[:free, :free], np.column_stack([g[:free], H[:free, free:]]))
            gradient = gradient + g[free:] - H[free:, :free] @ by_pose[:, 0]
            matrix = matrix + H[free:, free:] - H[free:, :free] @ by_pose[:, 1:]
            back.append(by_pose)
        step = -np.linalg.solve(matrix, gradient)
        betas += step
        x -= np.stack([solved[:, 0] + solved[:, 1:] @ step for solved in back])
    return SharedShape(betas, x)


def spread_poses(vertices: np.ndarray, count: int) -> np.ndarray:
    """Indices of `count` of the bodies (n, N, 3) that are as unlike as possible, in order, the first among them."""
    shapes = vertices - vertices.mean(axis=1, keepdims=True)
    return np.sort(farthest_points(
        shapes, count, 0, lambda i, _: np.linalg.norm(shapes - shapes[i], axis=2).mean(axis=1)))


def _own_body(fit: ScanFit, body: ShapedBody) -> ScanFit:
    """A fit with a body of its own, which keeps what it has worked out for the pose of its frame."""
    fit.body = copy.copy(body)
    return fit


def _system(fit: ScanFit, x: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (P + K,) and matrix of one frame at pose, trans and betas."""
    _, gradient, matrix = normal_equations(scan_terms(fit, x, reach)(x[None]))
    return gradient[0], matrix[0]
