"""Soft tissue: a person whose shape changes a little in every frame."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from model.body import BodyModel
from scanprep.threads import one_thread

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import BATCH
from ..pose.robust import marker_weights
from ..pose.settings import RATE, FollowConfig, animate_config
from ..pose.smooth import FURTHEST, coupled_steps, inertia
from ..results import SoftTissue
from ..settings import SoftTissueConfig
from .equations import SwayingBody, skin_metric
from .temporal_smoothness import steady_changes

Progress = Callable[[int, int], None]
PER_SQUARE_METRE = 1e4               # of a weight on square centimetres
STILL = 0.002                        # metres that the last round moves any marker of a frame that has settled


@one_thread()
def follow_soft_tissue(model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                       config: SoftTissueConfig | None = None, progress: Progress | None = None) -> SoftTissue:
    """A motion in which the person's shape changes with time, as the markers tell.

    Poses and the change of betas in every frame are solved for together, from the motion of the body of fixed shape.
    Markers that were not seen, and those that the motion did not trust, count nothing. A change costs what its betas
    are away from the person's own, as in the paper, and what skin it moves: where no marker is, none should move.

    Parameters
    ----------
    model : BodyModel
    motion : Motion
        Of these markers, with the person's own betas.
    markers : MarkerSequence
    layout : MarkerLayout
        Where the markers sit on the person.
    config : SoftTissueConfig, optional
    progress : callable, optional
        Called with (done, total) frames.

    Raises
    ------
    ValueError
        A motion without betas, or of other markers; a model without betas; fewer than 3 markers in common; settings
        out of range.

    [MoSh] Eq. 24
    """
    follower = SoftFollower(model, motion, markers, layout, config or SoftTissueConfig())
    x, z, settled = follower.solve(progress)
    pose, trans, _ = follower.body.marked.body.split(x)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    residuals[:, follower.rows] = np.linalg.norm(follower.body.positions(x, z) - follower.targets, axis=2)
    found = replace(motion, poses=pose.copy(), trans=trans.copy(), residuals=residuals,
                    converged=motion.converged & settled)
    return SoftTissue(found, z @ follower.body.directions)


class SoftFollower:
    """The markers of a sequence, and the changing body that is to carry them.

    Unknowns are x (T, P) as in `MarkedBody` and changes z (T, K) along directions of which each costs the same: their
    energy is |z|².

    Parameters
    ----------
    model, motion, markers, layout, config
        As for `follow_soft_tissue`.
    """

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        _check(model, motion, markers, config)
        assert motion.betas is not None, "checked"
        labels = layout.matched(markers.labels)
        self.config, self.motion = config, motion
        self.rows = np.array([markers.labels.index(label) for label in labels])
        self.targets = markers.positions[:, self.rows]
        K = min(max(config.n_betas, len(motion.betas)), model.n_betas)
        slopes = model.shape_jacobian(model.pose_mean)[..., :K]
        self.body = SwayingBody(model, motion.betas, layout.select(labels), cheap_directions(model, slopes, config),
                                slopes, config.pose, config.prior_shrinkage)
        follow = FollowConfig(config.data, config.pose, config.velocity, config.outlier, config.prior_shrinkage)
        self.inertia = inertia(animate_config(follow), markers.rate, self.body.marked.n_unknowns)
        self.steadiness = config.steadiness * (markers.rate / RATE)**4

    def solve(self, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unknowns (T, P), changes z (T, K), and which frames settled (T,)."""
        marked, T, rounds = self.body.marked, len(self.targets), self.config.iterations
        x = marked.body.join(self.motion.poses, self.motion.trans)
        z, moved = np.zeros((T, self.body.n_betas)), np.zeros(T)
        some, weights = self.weights(marked.positions(x))
        targets, weights = self.targets[some], weights[some]
        for i in range(rounds if len(some) else 0):
            earlier = x[some], z[some]
            x[some], z[some] = self.round(*earlier, targets, weights)
            if i == rounds - 1:
                moved[some] = np.linalg.norm(self.body.positions(x[some], z[some]) - self.body.positions(*earlier),
                                             axis=2).max(axis=1)
            if progress:
                progress(round(T * (i + 1) / (rounds + 1)), T)
        if self.steadiness and len(some) > 2:
            z[some] = steady_changes(self.body, x[some], targets, weights, self.steadiness)
        if progress:
            progress(T, T)
        return x, z, moved < STILL

    def weights(self, positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames from the first to the last with a marker that counts (n,), and weights of all markers (T, L)."""
        share, _ = marker_weights(positions, self.targets, 1.0, self.config.outlier)
        weights = self.config.data * PER_SQUARE_METRE * share * self.motion.trusted[:, self.rows]
        some = np.flatnonzero((weights > 0).any(axis=1))
        return (np.arange(some[0], some[-1] + 1) if len(some) else some), weights

    def round(self, x: np.ndarray, z: np.ndarray, targets: np.ndarray, weights: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray]:
        """One Gauss-Newton step on frames (T,) that follow each other, the changes eliminated frame by frame."""
        T, P = x.shape
        gradient, hessian = np.empty((T, P)), np.empty((T, P, P))
        back = np.empty((T, self.body.n_betas, P + 1), dtype=np.float32)
        for start in range(0, T, BATCH):
            some = slice(start, start + BATCH)
            _, g, H = self.body.system(x[some], z[some], targets[some], weights[some])
            g[:, P:] += z[some]
            across = H[:, :P, P:]
            right = np.concatenate([np.swapaxes(across, 1, 2), g[:, P:, None]], axis=2)
            back[some] = solved = np.linalg.solve(H[:, P:, P:] + np.eye(self.body.n_betas), right)
            hessian[some] = H[:, :P, :P] - across @ solved[:, :, :P]
            gradient[some] = g[:, :P] - (across @ solved[:, :, P:])[..., 0]
        step = coupled_steps(self.body.marked, self.inertia, x, gradient, hessian) if T > 2 \
            else -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        share = np.minimum(1, FURTHEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        shift = -(back[:, :, P] + (back[:, :, :P] @ step[..., None].astype(np.float32))[..., 0])
        return self.body.marked.retract(x, share * step), z + share * shift


def cheap_directions(model: BodyModel, slopes: np.ndarray, config: SoftTissueConfig) -> np.ndarray:
    """(K, K) directions of betas, by rows, that each cost one: `Δ = z @ directions` has the energy |z|².

    Parameters
    ----------
    model : BodyModel
    slopes : (N, 3, K) float, metres
        Derivative of the vertices by betas, in the mean pose.
    config : SoftTissueConfig

    [MoSh] Eq. 24
    """
    cost = config.change * np.eye(slopes.shape[-1]) + config.skin * PER_SQUARE_METRE * skin_metric(model, slopes)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cost)))


def _check(model: BodyModel, motion: Motion, markers: MarkerSequence, config: SoftTissueConfig) -> None:
    """ValueError for what cannot belong together."""
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    if motion.betas is None or len(motion.betas) > model.n_betas:
        raise ValueError(f"motion: expected one with at most {model.n_betas} betas, got "
                         f"{'none' if motion.betas is None else len(motion.betas)}")
    if motion.labels != markers.labels or len(motion.poses) != len(markers.positions):
        raise ValueError(f"motion: expected the one of these markers ({len(markers.positions)} frames, "
                         f"{len(markers.labels)} labels), got {len(motion.poses)} frames, {len(motion.labels)} labels")
    if not config.change > 0 or config.skin < 0 or config.steadiness < 0:
        raise ValueError(f"config: expected change > 0, skin and steadiness >= 0, got {config.change}, {config.skin} "
                         f"and {config.steadiness}")
