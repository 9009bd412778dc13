"""The simulated markers of a sequence: where the body has them, and what each marker is off by the others' account."""
from __future__ import annotations

import numpy as np

from model.linear import Subject

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import between_keys, seen_span, smoothed
from ..pose.marked_body import MarkedBody, batches
from ..pose.robust import known_median, marker_weights
from ..pose.settings import AnimateConfig


class Simulation:
    """A body that follows markers whose labels are taken as they are."""

    def __init__(self, subject: Subject, markers: MarkerSequence, layout: MarkerLayout, config: AnimateConfig) -> None:
        self.labels = layout.matched(markers.labels)
        self.config, self.rate = config, markers.rate
        self.rows = np.array([markers.labels.index(label) for label in self.labels])
        self.targets = markers.positions[:, self.rows]
        template, selected = subject.template, layout.select(self.labels)
        self.body = MarkedBody(subject, selected, config.prior_weight, config.prior_shrinkage)
        self.part = subject.skeleton.part_of_vertex(template)[selected.nearest]
        parents = np.asarray(subject.skeleton.parents)[self.part]
        hangs = self.part[:, None] == parents
        self.neighbours = (self.part[:, None] == self.part) | hangs | hangs.T

    def weights(self, frames: np.ndarray | slice, x: np.ndarray) -> np.ndarray:
        """Weights (n, L) of the markers of some frames, low for outliers, the body being at unknowns (n, P)."""
        return marker_weights(self.body.positions(x), self.targets[frames], self.config.marker_sd,
                              self.config.outlier)[0]

    def solve(self, targets: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Unknowns (T, P) of the body that follows markers (T, L, 3), metres, from others that are near or anew."""
        self.targets = targets
        x = between_keys(self.body, targets, self.rate, self.config) if near is None else near.copy()
        inside, stiffness = seen_span(targets), self.config.inertia(self.rate, self.body.n_unknowns)
        for _ in range(max(self.config.smoothing, 1)):
            weights = self.weights(inside, x[inside])
            x[inside] = smoothed(self.body, stiffness, x[inside], targets[inside], weights)
        return x

    def taken_from(self, motion: Motion, repaired: np.ndarray) -> np.ndarray:
        """Unknowns (T, P) of the body in a motion, which followed the repaired markers (T, all labels, 3)."""
        self.targets = repaired[:, self.rows]
        return self.body.body.join(motion.poses, motion.trans)

    def alone(self, off: np.ndarray, x: np.ndarray) -> np.ndarray:
        """What markers, off by (T, L, 3) metres, would be off if the body x (T, P) followed the others alone.

        The body has gone after a displaced marker a little: its own part in the normal equations is taken back.
        """
        T, every = len(x), max(1, round(self.rate / 15))                # 15 looks a second at how markers draw the body
        frames = np.arange(min(every // 2, T - 1), T, every)
        freed, out = self._freed(x[frames], frames), np.empty_like(off)
        for some in batches(T):
            t = np.clip(np.arange(T)[some], frames[0], frames[-1])      # before the first and after the last look
            i = np.clip(np.searchsorted(frames, t, side="right") - 1, 0, max(len(frames) - 2, 0))
            share = ((t - frames[i]) / every)[:, None, None, None]
            now = freed[i] + share * (freed[np.minimum(i + 1, len(frames) - 1)] - freed[i])
            out[some] = (now @ off[some][..., None])[..., 0]
        return out

    def local(self, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Vectors (T, L, 3) of markers in the frames of their parts, the body being at x (T, P)."""
        return self._turned("tldc,tld->tlc", vectors, x)

    def world(self, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Vectors (T, L, 3) in the frames of the markers' parts as they are in the world: the inverse of `local`."""
        return self._turned("tldc,tlc->tld", vectors, x)

    def _turned(self, how: str, vectors: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Products (T, L, 3) of the rotations of the markers' parts, from the part to the world, and vectors."""
        pose, _, _ = self.body.body.split(x)
        R, out = self.body.body.skeleton.part_rotations(pose), np.empty(vectors.shape)
        for some in batches(len(x)):
            out[some] = np.einsum(how, R[some][:, self.part], vectors[some])
        return out

    def _freed(self, x: np.ndarray, frames: np.ndarray) -> np.ndarray:
        """Matrices (n, L, 3, 3) from what is left of a displacement to the whole of it, at unknowns (n, P)."""
        weights = self.weights(frames, x)
        out = np.empty((*weights.shape, 3, 3))
        for some in batches(len(x)):
            _, _, hessian = self.body.system(x[some], self.targets[frames[some]], weights[some])
            _, columns = self.body.shapes.columns(*self.body.body.split(x[some])[:2])                # (B, P, 3, L)
            B, P = columns.shape[:2]
            hessian += 1e-9 * np.trace(hessian, axis1=1, axis2=2)[:, None, None] * np.eye(P)
            answer = np.linalg.solve(hessian, columns.reshape(B, P, -1)).reshape(columns.shape)
            followed = np.einsum("bpcl,bpdl->blcd", columns, answer) * weights[some][..., None, None]
            share, axes = np.linalg.eigh(followed)
            # most of a displacement that the body is taken to have followed
            out[some] = (axes / (1 - np.clip(share, 0, 0.6))[..., None, :]) @ np.swapaxes(axes, -1, -2)
        return out


def bridged(local: np.ndarray, reach: float) -> np.ndarray:
    """What markers are off (T, L, 3), NaN in gaps, with these bridged: straight, long ones by the usual place."""
    out = np.repeat(known_median(local, 0)[None], len(local), axis=0)
    for i in range(local.shape[1]):
        seen = np.flatnonzero(np.isfinite(local[:, i, 0]))
        if not len(seen):
            continue
        usual, times = out[0, i].copy(), np.arange(len(local))
        after = np.searchsorted(seen, times)
        left, right = seen[np.maximum(after - 1, 0)], seen[np.minimum(after, len(seen) - 1)]
        span = np.clip(right - left, 1, reach)
        share = [np.clip(1 - np.abs(times - end) / span, 0, 1)[:, None] for end in (left, right)]
        share[1][left == right] = 0                                    # before the first, after the last
        out[:, i] += share[0] * (local[left, i] - usual) + share[1] * (local[right, i] - usual)
        out[seen, i] = local[seen, i]
    return out
