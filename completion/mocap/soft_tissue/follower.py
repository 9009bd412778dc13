"""Poses over time of a body on which soft tissue moves: what moves is integrated out, then found. [MoSh] Eq. 24"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from model.body import BodyModel
from scanprep.geometry.least_squares import Dense

from ...motion import Motion, Progress
from ...smoothing import windowed_steps
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import FURTHEST, STILL
from ..pose.foot_contact import FootContact, HeldPoints
from ..pose.marked_body import MarkedBody, batches, point_system
from ..pose.robust import marker_weights
from ..pose.settings import RATE, AnimateConfig
from .settings import SoftTissueConfig
from .skin import SkinMovement

PER_SQUARE_METRE = 1e4               # of a weight on square centimetres
ROUNDS = 3                           # Gauss-Newton steps over the whole sequence, which begins near its end

Whitening = Callable[[slice], np.ndarray]


class SoftFollower(ABC):
    """The markers of a sequence, and the body that carries them; arguments as of `follow_soft_tissue`.

    Unknowns are x (T, P) as in `MarkedBody`. What soft tissue does to the markers is a Gaussian variable: it adds to
    the covariance of their residuals while poses are sought, and is found at the end.
    """

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        labels = layout.matched(markers.labels)
        self.config, self.motion, self.layout = config, motion, layout.select(labels)
        self.rows = np.array([markers.labels.index(label) for label in labels])
        self.targets = markers.positions[:, self.rows]
        poses = AnimateConfig(prior_weight=config.pose, angle_acceleration=RATE**2 / np.sqrt(config.velocity))
        if config.shape_change:                  # as the paper: its prior is not shrunk, and places are not smoothed
            poses = replace(poses, prior_shrinkage=0.0, place_acceleration=1e6)
        self.body = MarkedBody(model.subject(motion.betas), self.layout, config.pose, poses.prior_shrinkage)
        self.inertia = poses.inertia(markers.rate, self.body.n_unknowns)
        self.weight = config.data * PER_SQUARE_METRE

    @abstractmethod
    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        """Of some of the frames x (T, P), what makes the residuals of their markers independent, see `whiten`.

        (B, L, L) if the three coordinates are independent of each other and alike, else (B, 3L, 3L).
        """

    @abstractmethod
    def moved(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        """The movement in all frames x (T, P), that of frames without a marker that counts, not in `some`, none.

        What it adds to the places of the markers (T, L, 3), metres, and how `SoftTissue` holds it.
        """

    def solve(self, progress: Progress | None = None, feet: FootContact | None = None
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unknowns (T, P), which frames count (n,) and the share of every marker (T, L).

        Which frames settled is in `settled` (T,). `feet` are held where they stand.
        """
        T, tell = len(self.targets), progress or (lambda done, total: None)
        x, last = self.body.body.join(self.motion.poses, self.motion.trans), np.zeros(T)
        some, share = self._share(x)
        for i in range(ROUNDS if len(some) > 2 else 0):
            before = self.body.positions(x[some])
            held = None if feet is None else feet.held(x).of(slice(some[0], some[-1] + 1))
            x[some] = self.round(x[some], self.targets[some], share[some], held)
            last[some] = np.linalg.norm(self.body.positions(x[some]) - before, axis=2).max(axis=1)
            tell(round(T * (i + 1) / (ROUNDS + 1)), T)
        self.settled = last < STILL
        return x, some, share

    def _share(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames from the first to the last with a marker that counts (n,), and how much each counts (T, L)."""
        share, _ = marker_weights(self.body.positions(x), self.targets, 1.0, self.config.outlier)
        share *= self.motion.trusted[:, self.rows]
        some = np.flatnonzero((share > 0).any(axis=1))
        return (np.arange(some[0], some[-1] + 1) if len(some) else some), share

    def off(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Where markers are against the body at x (B, P), metres (B, L, 3), 0 for one not seen."""
        away = targets - self.body.positions(x)
        return np.where(np.isnan(away), 0.0, away)

    def round(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray, held: HeldPoints | None = None
              ) -> np.ndarray:
        """Frames (T, P) that follow each other after one Gauss-Newton step, the movement integrated out."""
        whitening = self.whitening(x, targets, share)

        def equations(near: slice) -> tuple[np.ndarray, np.ndarray]:
            frames = np.arange(len(x))[near]
            gradient, hessian = np.empty((len(frames), x.shape[1])), np.empty((len(frames), x.shape[1], x.shape[1]))
            for few in batches(len(frames)):
                mine = slice(frames[few][0], frames[few][-1] + 1)
                _, gradient[few], hessian[few] = self.system(x[mine], targets[mine],
                                                             np.sqrt(self.weight) * whitening(mine))
                if held is not None:
                    _, pull, stiff = held.system(*self.body.body.split(x[mine])[:2], mine)
                    gradient[few] += pull
                    hessian[few] += stiff
            return gradient, hessian

        step = windowed_steps(x, equations, self.inertia)
        longest = np.abs(step).max(axis=1, keepdims=True)
        return self.body.retract(x, step * np.minimum(1, FURTHEST / np.maximum(longest, 1e-12)))

    def system(self, x: np.ndarray, targets: np.ndarray, W: np.ndarray) -> Dense:
        """Markers (B, L, 3) whose residuals W (B, n, n) makes independent, and the pose prior, at x (B, P).

        n is L for each coordinate by itself, or 3L.
        """
        pose, trans, _ = self.body.body.split(x)
        y, columns = self.body.shapes.columns(pose, trans)
        away, n = y - np.swapaxes(targets, 1, 2), W.shape[-1]
        away = np.where(np.isnan(away), 0.0, away)
        away, columns = ((of.reshape(len(x), -1, n) @ W).reshape(of.shape) for of in (away, columns))
        return self.body.with_prior(point_system(away, columns, np.zeros_like(targets), np.ones(targets.shape[:2])),
                                    pose)


def whiten(covariance: np.ndarray, share: np.ndarray) -> np.ndarray:
    """W (B, n, n), with which rows r (n,) become independent, r @ W, where a unit of noise is added to the covariance.

    The covariance C is (n, n) or (B, n, n). Noise counts by its share (B, n): `W Wᵀ = S (S C S + 1)⁻¹ S` with S the
    roots of the shares.
    """
    S, one = np.sqrt(share), np.eye(share.shape[1])
    root = np.linalg.cholesky(S[:, :, None] * covariance * S[:, None] + one)
    return np.swapaxes(np.linalg.solve(root, S[:, :, None] * one), 1, 2)
