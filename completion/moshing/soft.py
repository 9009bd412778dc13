"""Soft tissue: a person whose shape changes a little in every frame."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from model.body import BodyModel

from ..animation.marked import BATCH
from ..animation.smooth import FURTHEST, coupled_steps
from ..animation.trust import marker_weights
from ..markers.files import MarkerSequence
from ..markers.layout import MarkerLayout
from ..motion import Motion
from .results import SoftTissue
from .settings import SoftTissueConfig
from .swaying import SwayingBody

Progress = Callable[[int, int], None]
PER_SQUARE_METRE = 1e4               # of a weight on square centimetres
STILL = 0.002                        # metres that the last round moves any marker of a frame that has settled


def follow_soft_tissue(model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                       config: SoftTissueConfig | None = None, progress: Progress | None = None) -> SoftTissue:
    """A motion in which the person's shape changes with time, as the markers tell.

    Poses and the change of betas in every frame are solved for together, from the motion of the body of fixed shape.
    Markers that were not seen, and those that the motion did not trust, count nothing.

    Parameters
    ----------
    model : BodyModel
    motion : Motion
        Of these markers, with the person's own betas.
    markers : MarkerSequence
    layout : MarkerLayout
        Where the markers sit on the person.
    progress : callable, optional
        Called with (done, total) frames.

    Raises
    ------
    ValueError
        A motion without betas, or of other markers; a model without betas; fewer than 3 markers in common.

    [MoSh] Eq. 24
    """
    config = config or SoftTissueConfig()
    follower = SoftFollower(model, motion, markers, layout, config)
    x, changes, settled = follower.solve(progress)
    pose, trans, _ = follower.body.marked.body.split(x)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    residuals[:, follower.rows] = np.linalg.norm(follower.body.positions(x, changes) - follower.targets, axis=2)
    found = replace(motion, poses=pose.copy(), trans=trans.copy(), residuals=residuals,
                    converged=motion.converged & settled)
    return SoftTissue(found, changes)


class SoftFollower:
    """The markers of a sequence, and the changing body that is to carry them.

    Parameters
    ----------
    model, motion, markers, layout, config
        As for `follow_soft_tissue`.
    """

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        _check(model, motion, markers)
        assert motion.betas is not None
        labels = layout.matched(markers.labels)
        self.config, self.motion = config, motion
        self.rows = np.array([markers.labels.index(label) for label in labels])
        self.targets = markers.positions[:, self.rows]
        K = min(max(config.n_betas, len(motion.betas)), model.n_betas)
        self.body = SwayingBody(model, motion.betas, layout.select(labels), K, config.pose, config.prior_shrinkage,
                                motion.poses)
        self.inertia = np.full(self.body.marked.n_unknowns, config.velocity)
        self.inertia[-3:] = 0
        self.stiffness = config.change * np.eye(K)

    def solve(self, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unknowns (T, P), changes (T, K), and which frames settled (T,)."""
        marked, T = self.body.marked, len(self.targets)
        x = marked.body.join(self.motion.poses, self.motion.trans)
        changes = np.zeros((T, self.body.n_betas))
        there, weights = self.weights(marked.positions(x))
        moved = np.zeros(T)
        for i in range(self.config.iterations):
            before = self.body.positions(x, changes) if i == self.config.iterations - 1 else None
            x[there], changes[there] = self.round(x[there], changes[there], self.targets[there], weights[there])
            if before is not None:
                moved = np.linalg.norm(self.body.positions(x, changes) - before, axis=2).max(axis=1)
            if progress:
                progress(round(T * (i + 1) / self.config.iterations), T)
        return x, changes, moved < STILL

    def weights(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames from the first to the last with a marker (n,), and weights of all markers (T, L)."""
        share, _ = marker_weights(positions, self.targets, 1.0, self.config.outlier)
        weights = self.config.data * PER_SQUARE_METRE * share * self.motion.trusted[:, self.rows]
        some = np.flatnonzero((weights > 0).any(axis=1))
        return (np.arange(some[0], some[-1] + 1) if len(some) else some), weights

    def round(self, x: np.ndarray, changes: np.ndarray, targets: np.ndarray, weights: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray]:
        """One Gauss-Newton step on frames that follow each other, the changes eliminated frame by frame."""
        T, P = x.shape
        gradient, hessian = np.empty((T, P)), np.empty((T, P, P))
        back = np.empty((T, self.body.n_betas, P + 1), dtype=np.float32)
        for start in range(0, T, BATCH):
            some = slice(start, start + BATCH)
            _, g, H = self.body.system(x[some], changes[some], targets[some], weights[some])
            g[:, P:] += changes[some] @ self.stiffness
            across = H[:, :P, P:]
            right = np.concatenate([np.swapaxes(across, 1, 2), g[:, P:, None]], axis=2)
            solved = np.linalg.solve(H[:, P:, P:] + self.stiffness, right)
            hessian[some] = H[:, :P, :P] - across @ solved[:, :, :P]
            gradient[some] = g[:, :P] - (across @ solved[:, :, P:])[..., 0]
            back[some] = solved
        step = coupled_steps(self.body.marked, self.inertia, x, gradient, hessian) if T > 2 \
            else -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        share = np.minimum(1, FURTHEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        shift = -(back[:, :, P] + (back[:, :, :P] @ step[..., None].astype(np.float32))[..., 0])
        return self.body.marked.retract(x, share * step), changes + share * shift


def _check(model: BodyModel, motion: Motion, markers: MarkerSequence) -> None:
    """ValueError for what cannot belong together."""
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    if motion.betas is None or len(motion.betas) > model.n_betas:
        raise ValueError(f"motion: expected one with at most {model.n_betas} betas, got "
                         f"{'none' if motion.betas is None else len(motion.betas)}")
    if motion.labels != markers.labels or len(motion.poses) != len(markers.positions):
        raise ValueError(f"motion: expected the one of these markers ({len(markers.positions)} frames, "
                         f"{len(markers.labels)} labels), got {len(motion.poses)} frames, {len(motion.labels)} labels")
