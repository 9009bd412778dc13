"""How the skin of a person moves, from markers. [MoSh] Eq. 24"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from model.body import BodyModel
from scanprep.geometry.least_squares import Dense
from scanprep.geometry.sparse import overlapping_windows, solve_smooth
from scanprep.ranges import Positive, Settings
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ...smoothing import windowed_steps
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import FURTHEST, STILL
from ..pose.marked_body import MarkedBody, batches, point_system
from ..pose.robust import marker_weights
from ..pose.settings import RATE, AnimateConfig
from .skin import SkinMovement, in_root, smooth_modes
from .soft_tissue import SoftTissue

PER_SQUARE_METRE = 1e4               # of a weight on square centimetres
ROUNDS = 3                           # Gauss-Newton steps over the whole sequence, which begins near its end
USUAL = 2.0                          # medians of how far markers lie off (squared) within which it is noise to the pose
LOOSE = 3.0                          # sizes of the movement by which the prior allows it; at 1 it shrinks what it finds
WINDOW, OVERLAP = 400, 40            # frames smoothed at once, and those that each side lends to its neighbour


@dataclass(frozen=True)
class SoftTissueConfig(Settings):
    """Settings of `follow_soft_tissue`.

    Weights stand on squared centimetres, as in the paper, whose own are `published()`. They are those by which the
    poses were found before, see `MoshConfig`.

    Attributes
    ----------
    data : float
        Weight of the markers against their simulation, when poses are found.
    pose : float
        Weight of the pose prior; the paper's is 1.
    velocity : float
        Weight of the squared change of velocity from frame to frame, 120 frames a second; the paper's is 6.25.
    marker_sd : float, metres
        How far a marker lies from where the moving skin has it: what cameras are off.
    reach : float, metres
        Along the skin: where the movement of two points is correlated by 0.6.
    temporal_smoothness : float
        Weight of the squared second difference of the movement from frame to frame, 120 frames a second, against that
        of the movement itself.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight.
    """

    data: Positive = 2.0
    pose: float = 0.3
    velocity: Positive = 57600.0
    marker_sd: Positive = 0.001
    reach: Positive = 0.09
    temporal_smoothness: float = 2.0
    outlier: Positive = 0.06

    @classmethod
    def published(cls) -> SoftTissueConfig:
        """The weights of [MoSh] for poses; what moves is our skin, not betas as in its Eq. 24."""
        return cls(data=0.75, pose=1.0, velocity=6.25, outlier=1000.0)


@one_thread()
def follow_soft_tissue(model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                       config: SoftTissueConfig | None = None, progress: Progress | None = None) -> SoftTissue:
    """A motion in which the skin moves on the body, as the markers tell.

    [MoSh] changes the betas in every frame and holds the change by its squared length. Betas of 182 people have a
    sixth to a third of the energy of a bump of 6 to 12 cm, so here the skin itself moves: a Gaussian process over the
    surface, whose size at each marker is taken from how far that marker strays. Poses are found again, and a marker
    that strays more than most counts the less for them, so that they do not follow soft tissue. Where no marker is
    near, the skin does not move; markers that were not seen, and those that the motion did not trust, count nothing.

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
    x, skin, settled = follower.solve(progress)
    pose, trans, _ = follower.body.body.split(x)
    found = replace(motion, poses=pose.copy(), trans=trans.copy(), converged=motion.converged & settled)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    places = follower.body.positions(x) + skin.at(skin.modes[follower.nearest], pose)
    residuals[:, follower.rows] = np.linalg.norm(places - follower.targets, axis=2)
    assert motion.betas is not None, "checked"
    return SoftTissue(replace(found, residuals=residuals), np.zeros((len(x), len(motion.betas))), skin)


class SoftFollower:
    """The markers of a sequence, and the body whose skin carries them; arguments as of `follow_soft_tissue`.

    Unknowns are x (T, P) as in `MarkedBody`, and what the skin under each marker is displaced (T, L, 3).
    """

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        _check(model, motion, markers)
        labels = layout.matched(markers.labels)
        self.config, self.motion, layout = config, motion, layout.select(labels)
        self.rows = np.array([markers.labels.index(label) for label in labels])
        self.targets = markers.positions[:, self.rows]
        poses = AnimateConfig(prior_weight=config.pose, angle_acceleration=RATE**2 / np.sqrt(config.velocity))
        self.body = MarkedBody(model.subject(motion.betas), layout, config.pose, poses.prior_shrinkage)
        self.inertia = poses.inertia(markers.rate, self.body.n_unknowns)
        self.nearest = layout.nearest
        self.modes, self.root = smooth_modes(model.template, self.nearest, config.reach)
        self.smoothness = config.temporal_smoothness * (markers.rate / RATE)**4

    def solve(self, progress: Progress | None = None) -> tuple[np.ndarray, SkinMovement, np.ndarray]:
        """Unknowns (T, P), the movement of the skin, and which frames settled (T,)."""
        T, tell = len(self.targets), progress or (lambda done, total: None)
        x = self.body.body.join(self.motion.poses, self.motion.trans)
        off, last = np.zeros((T, self.body.count, 3)), np.zeros(T)
        some, share = self.share(x)
        for i in range(ROUNDS if len(some) > 2 else 0):
            before = self.body.positions(x[some])
            x[some] = self.round(x[some], self.targets[some], share[some])
            last[some] = np.linalg.norm(self.body.positions(x[some]) - before, axis=2).max(axis=1)
            tell(round(T * (i + 1) / (ROUNDS + 1)), T)
        if len(some):
            off[some] = self.displaced(x[some], self.targets[some], share[some])
        tell(T, T)
        return x, SkinMovement(self.modes, off), last < STILL

    def share(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Frames from the first to the last with a marker that counts (n,), and how much each counts (T, L)."""
        share, _ = marker_weights(self.body.positions(x), self.targets, 1.0, self.config.outlier)
        share *= self.motion.trusted[:, self.rows]
        some = np.flatnonzero((share > 0).any(axis=1))
        return (np.arange(some[0], some[-1] + 1) if len(some) else some), share

    def off(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Where markers are against the body at x (B, P), along the axes of the root (B, L, 3), 0 for one not seen."""
        away = targets - self.body.positions(x)
        return in_root(np.where(np.isnan(away), 0.0, away), self.body.body.split(x)[0])

    def round(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Frames (T, P) that follow each other after one Gauss-Newton step, the movement of the skin integrated out.

        How far most of the markers lie off is noise to the pose; what a marker is beyond it is movement of the skin.
        """
        strays = variances(self.off(x, targets), share)
        noise = max(USUAL * float(np.median(strays)), self.config.marker_sd**2)
        size = np.sqrt(np.maximum(strays / noise - 1, 0))
        root = size[:, None] * self.root
        covariance, weight = root @ root.T, np.sqrt(self.config.data * PER_SQUARE_METRE)

        def equations(near: slice) -> tuple[np.ndarray, np.ndarray]:
            at, goal, counts = x[near], targets[near], share[near]
            gradient, hessian = np.empty(at.shape), np.empty((*at.shape, at.shape[1]))
            for few in batches(len(at)):
                whiten = weight * whitening(covariance, counts[few])
                _, gradient[few], hessian[few] = self.system(at[few], goal[few], whiten)
            return gradient, hessian

        step = windowed_steps(x, equations, self.inertia)
        longest = np.abs(step).max(axis=1, keepdims=True)
        return self.body.retract(x, step * np.minimum(1, FURTHEST / np.maximum(longest, 1e-12)))

    def system(self, x: np.ndarray, targets: np.ndarray, whiten: np.ndarray) -> Dense:
        """Markers (B, L, 3) whose residuals `whiten` (B, L, L) makes independent, and the pose prior, at x (B, P)."""
        pose, trans, _ = self.body.body.split(x)
        y, columns = self.body.shapes.columns(pose, trans)
        away = y - np.swapaxes(targets, 1, 2)
        away = np.where(np.isnan(away), 0.0, away) @ whiten
        columns = (columns.reshape(len(x), -1, self.body.count) @ whiten).reshape(columns.shape)
        return self.body.with_prior(point_system(away, columns, np.zeros_like(targets), np.ones(targets.shape[:2])),
                                    pose)

    def displaced(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> np.ndarray:
        """The movement of the skin under the markers (T, L, 3), metres, along the axes of the root, poses x held.

        [MoSh] Eq. 24, with |z|² in place of |β_t|²
        """
        off, sd = self.off(x, targets), self.config.marker_sd
        size = LOOSE * np.sqrt(np.maximum(variances(off, share) - sd**2, (0.1 * sd)**2))
        root = size[:, None] * self.root                                       # the movement is root @ z, z ~ N(0, 1)
        z, coupled = np.empty((len(x), root.shape[1], 3)), len(x) > 2
        for near, kept, where in overlapping_windows(len(x), WINDOW, OVERLAP) if coupled else [(slice(None),) * 3]:
            counts = share[near, :, None] / sd**2
            blocks, pull = root.T @ (counts * root) + np.eye(root.shape[1]), root.T @ (counts * off[near])
            z[where] = (solve_smooth(blocks, self.smoothness, pull) if coupled else np.linalg.solve(blocks, pull))[kept]
        return root @ z


def variances(off: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(L,) square metres: the mean square of a coordinate of residuals (T, L, 3), which count by their share (T, L)."""
    return np.einsum("tl,tld->l", share, off**2) / (3 * np.maximum(share.sum(axis=0), 1e-12))


def whitening(covariance: np.ndarray, share: np.ndarray) -> np.ndarray:
    """W (B, L, L), with which rows r (L,) become independent, r @ W, where a unit of noise is added to the covariance.

    Noise counts by its share (B, L): `W Wᵀ = S (S C S + 1)⁻¹ S` with S the roots of the shares.
    """
    S = np.sqrt(share)
    root = np.linalg.cholesky(S[:, :, None] * covariance * S[:, None] + np.eye(len(covariance)))
    return np.swapaxes(np.linalg.solve(root, S[:, :, None] * np.eye(len(covariance))), 1, 2)


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
