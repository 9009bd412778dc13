"""Soft tissue from markers: its movement is integrated out while poses are solved, then estimated.

[MoSh] Eq. 24
"""
from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from model.body import BodyModel
from scanprep.geometry.least_squares import Dense
from scanprep.geometry.sparse import overlapping_windows, solve_smooth
from scanprep.judgement import size
from scanprep.ranges import Positive, Settings
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import STILL
from ..pose.foot_contact import FootContact
from ..pose.marked_body import RATE, AnimateConfig, MarkedBody, batches, marker_weights, point_system
from .soft_tissue import SkinMovement, SoftTissue, in_root, in_world, smooth_modes

ROUNDS = 3                           # Gauss-Newton steps over the whole sequence, which starts near the solution
LOOSE = 3.0                          # prior sd over the size of the movement; at 1 the prior shrinks the result
WINDOW, OVERLAP = 400, 40            # frames smoothed at once, and those shared with each neighbour
MARKER_SD = 0.001                    # metres, sd of a marker from the moving skin: the error of the cameras


@dataclass(frozen=True)
class SoftTissueConfig(Settings):
    """Settings of `follow_soft_tissue`.

    Weights are for squared centimetres, as in the paper, whose own are `SoftTissueConfig.from_paper()`. They are those
    of the poses found before, see `MoshConfig`.

    Attributes
    ----------
    data : float
        Weight of the markers against their simulation, when poses are found.
    pose : float
        Weight of the pose prior; the paper's is 1.
    velocity : float
        Weight of the squared change of velocity from frame to frame, 120 frames a second; the paper's is 6.25.
    reach : float, metres
        Distance along the skin at which the movements of two points have a correlation of 0.6.
    temporal_smoothness : float
        Weight of the squared second difference of the movement from frame to frame, 120 frames a second, relative to
        that of the movement itself.
    shape_change : float
        Weight of the squared change of the betas from the person's own; the paper's is 0.25. With 0 the skin moves and
        the betas stay, by `reach` and `temporal_smoothness`; where betas change, all markers have the same weight.

    Examples
    --------
    >>> SoftTissueConfig.from_paper().shape_change
    0.25

    [MoSh] Eq. 24
    """

    data: Positive = 2.0
    pose: float = 0.3
    velocity: Positive = 57600.0
    reach: Positive = 0.09
    temporal_smoothness: float = 2.0
    shape_change: float = 0.0

    @classmethod
    def from_paper(cls) -> SoftTissueConfig:
        """Return the weights of [MoSh] Eq. 24, with betas that change in every frame."""
        return cls(data=0.75, pose=1.0, velocity=6.25, shape_change=0.25)


@one_thread()
def follow_soft_tissue(model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                       config: SoftTissueConfig | None = None, progress: Progress | None = None, ground: bool = False
                       ) -> SoftTissue:
    """Estimate the soft tissue of a motion: how the skin moves on the body.

    [MoSh] changes the betas in every frame, with a penalty on the squared change; `SoftTissueConfig.from_paper()` does
    so. But betas of 182 people have only a third of the energy of a bump of 6 to 12 cm on average. So by default the
    skin itself moves, as a Gaussian process over the surface. Its size at each marker comes from the scatter of that
    marker. Poses are solved again; a marker with much scatter weighs less, so that they do not follow soft tissue.
    Where no marker is near, the skin does not move. Missing and distrusted markers have no weight.

    Parameters
    ----------
    model : BodyModel
        With betas.
    motion : Motion
        Of these markers, with the person's own betas.
    markers : MarkerSequence
        Positions (T, L, 3) in metres.
    layout : MarkerLayout
        Where the markers sit on the person.
    config : SoftTissueConfig, optional
        Settings.
    progress : callable, optional
        Called with (done, total) frames.
    ground : bool
        Foot contact, as by `AnimateConfig.ground`.

    Returns
    -------
    SoftTissue
        The motion with poses (T, J, 3) found again, and the movement of the skin, metres, or of the betas (T, K).

    Raises
    ------
    ValueError
        A motion without betas, or of other markers; a model without betas; fewer than 3 markers in common; settings
        out of range.

    Examples
    --------
    >>> from completion import animate, load_layout
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> layout = load_layout("cmu41", model)
    >>> still = MarkerSequence(np.stack([layout.place(model)] * 5), layout.labels, 120.0)
    >>> motion = animate(model.subject(np.zeros(2)), still, layout)
    >>> follow_soft_tissue(model, motion, still, layout).skin.moved.shape
    (5, 41, 3)

    [MoSh] Eq. 24
    """
    config, report_progress = config or SoftTissueConfig(), progress or (lambda done, total: None)
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    if motion.betas is None or len(motion.betas) > model.n_betas:
        raise ValueError(f"motion: expected one with at most {model.n_betas} betas, got "
                         f"{'none' if motion.betas is None else len(motion.betas)}")
    if motion.labels != markers.labels or len(motion.poses) != len(markers.positions):
        raise ValueError(f"motion: expected the one of these markers ({len(markers.positions)} frames, "
                         f"{len(markers.labels)} labels), got {len(motion.poses)} frames, {len(motion.labels)} labels")
    # the body with its markers, and foot contact if wanted
    follower = (ShapeFollower if config.shape_change else SkinFollower)(model, motion, markers, layout, config)
    body, targets, T = follower.body, follower.targets, len(motion.poses)
    x = body.body.join(motion.poses, motion.trans)
    feet = FootContact(body, x, markers.rate) if ground and T > 2 else None

    # robust weights of the markers, and the frames from the first to the last with any weight
    outlier = 1000.0 if config.shape_change else AnimateConfig.outlier     # metres; the paper weights all equally
    share, _ = marker_weights(body.positions(x), targets, 1.0, outlier)
    share *= motion.trusted[:, follower.rows]
    used = np.flatnonzero((share > 0).any(axis=1))
    used = np.arange(used[0], used[-1] + 1) if len(used) else used

    # the poses, then what moves on them
    last = np.zeros(T)
    for i in range(ROUNDS if len(used) > 2 else 0):
        before = body.positions(x[used])
        x[used] = follower.step_poses(x[used], targets[used], share[used], feet,
                                      None if feet is None else feet.target_positions(x)[used])
        last[used] = np.linalg.norm(body.positions(x[used]) - before, axis=2).max(axis=1)
        report_progress(round(T * (i + 1) / (ROUNDS + 1)), T)
    # the movement, given the poses, and the residuals with it
    added, changes, skin = follower.solve_movement(x, used, share)
    report_progress(T, T)
    pose, trans, _ = body.body.split(x)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    residuals[:, follower.rows] = np.linalg.norm(body.positions(x) + added - targets, axis=2)
    return SoftTissue(replace(motion, poses=pose.copy(), trans=trans.copy(), residuals=residuals,
                              converged=motion.converged & (last < STILL * size(body.body.template))), changes, skin)


Whitening = Callable[[np.ndarray, np.ndarray], np.ndarray]


class SoftFollower(ABC):
    """The markers of a sequence, and the body that carries them; arguments are those of `follow_soft_tissue`.

    Unknowns are x (T, P) as in `MarkedBody`. The displacement of the markers by soft tissue is a Gaussian variable. It
    adds to the covariance of their residuals while poses are solved, and is estimated at the end.
    """

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        assert motion.betas is not None, "checked"
        self.rows, self.layout = layout.match_columns(markers.labels)
        self.config, self.n_betas, self.targets = config, len(motion.betas), markers.positions[:, self.rows]
        poses = AnimateConfig(prior_weight=config.pose, angle_acceleration=RATE**2 / np.sqrt(config.velocity),
                              published=bool(config.shape_change))
        self.body = MarkedBody(model.subject(motion.betas), self.layout, config.pose, poses.prior_shrinkage)
        self.inertia = poses.inertia(markers.rate, self.body.n_unknowns)
        # 1e4: from square centimetres to square metres
        self.weight = config.data * 1e4

    @abstractmethod
    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        """Return a function of x and the weights of some frames that gives whitening matrices, see `whiten`.

        They are (B, L, L) where the three coordinates are independent and alike, else (B, 3L, 3L).
        """

    @abstractmethod
    def solve_movement(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        """Estimate the movement in all frames x (T, P); it is zero in frames outside `some`, which have no markers.

        Returned are the displacements of the markers (T, L, 3), metres, the changes of betas (T, K) and the skin.
        """

    def off(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Compute offsets (B, L, 3), metres, of markers from the body at x (B, P), 0 for one not seen."""
        away = targets - self.body.positions(x)
        return np.where(np.isnan(away), 0.0, away)

    def step_poses(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray, feet: FootContact | None,
                   places: np.ndarray | None) -> np.ndarray:
        """Take one Gauss-Newton step of successive frames (T, P), with the movement integrated out."""
        whitening = self.whitening(x, targets, share)

        def system(x: np.ndarray, targets: np.ndarray, share: np.ndarray, *places: np.ndarray) -> Dense:
            data = self.system(x, targets, np.sqrt(self.weight) * whitening(x, share))
            return data if feet is None else feet.hold(data, x, *places)

        held = () if places is None else (places,)
        return self.body.smooth_step(x, self.inertia, system, targets, share, *held)

    def system(self, x: np.ndarray, targets: np.ndarray, W: np.ndarray) -> Dense:
        """Build the equations of markers (B, L, 3), whitened by W (B, n, n), and of the pose prior, at x (B, P).

        n is L for each coordinate by itself, or 3L.
        """
        pose, trans, _ = self.body.body.split(x)
        y, columns = self.body.shapes.columns(pose, trans)
        away, n = y - np.swapaxes(targets, 1, 2), W.shape[-1]
        away = np.where(np.isnan(away), 0.0, away)
        away, columns = ((of.reshape(len(x), -1, n) @ W).reshape(of.shape) for of in (away, columns))
        return self.body.with_prior(point_system(away, columns, np.zeros_like(targets), np.ones(targets.shape[:2])),
                                    pose)


class SkinFollower(SoftFollower):
    """The skin moves on the body: a Gaussian process over the surface, along the axes of the root."""

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        super().__init__(model, motion, markers, layout, config)
        self.modes, self.root = smooth_modes(model.template, self.layout.nearest, config.reach)
        self.smoothness = config.temporal_smoothness * (markers.rate / RATE)**4

    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        """Return whitening by the scatter of the markers, correlated over the skin."""
        strays = variances(self.off(x, targets), share)
        # twice the median variance is noise of the pose; what a marker has beyond it is soft tissue
        noise = max(2.0 * float(np.median(strays)), MARKER_SD**2)
        root = np.sqrt(np.maximum(strays / noise - 1, 0))[:, None] * self.root
        return lambda x, share: whiten(root @ root.T, share)

    def solve_movement(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        """Estimate the movement of the skin in the axes of the root; the betas do not change."""
        moved, poses = np.zeros(self.targets.shape), self.body.body.split(x)[0]
        if len(some):
            moved[some] = self.solve_displacements(in_root(self.off(x[some], self.targets[some]), poses[some]),
                                                   share[some])
        return in_world(moved, poses), np.zeros((len(x), self.n_betas)), SkinMovement(self.modes, moved)

    def solve_displacements(self, off: np.ndarray, share: np.ndarray) -> np.ndarray:
        """Solve for displacements of the skin (T, L, 3), metres, under markers that are off the body by (T, L, 3).

        [MoSh] Eq. 24, with z in place of β_t
        """
        sd = MARKER_SD
        size = LOOSE * np.sqrt(np.maximum(variances(off, share) - sd**2, (0.1 * sd)**2))
        root = size[:, None] * self.root                                       # the movement is root @ z, z ~ N(0, 1)
        # minimise Σ |root z - off|² / sd² + |z|² + smoothness |second difference of z|², in overlapping windows
        z, coupled = np.empty((len(off), root.shape[1], 3)), len(off) > 2
        for near, kept, where in overlapping_windows(len(off), WINDOW, OVERLAP) if coupled else [(slice(None),) * 3]:
            counts = share[near, :, None] / sd**2
            blocks, pull = root.T @ (counts * root) + np.eye(root.shape[1]), root.T @ (counts * off[near])
            z[where] = (solve_smooth(blocks, self.smoothness, pull) if coupled else np.linalg.solve(blocks, pull))[kept]
        return root @ z


class ShapeFollower(SoftFollower):
    """The betas change in every frame, β_t = β + z_t, with the penalty λ_Δ |z_t|². [MoSh] Eq. 24"""

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        super().__init__(model, motion, markers, layout, config)
        # 200 betas change, or as many as the person has if more
        self.skin = model.points(*self.layout.skin, min(max(200, self.n_betas), model.n_betas))

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Compute derivatives (B, 3L, K) of the markers by the betas at x (B, P), coordinates before markers, metres.

        A marker moves like the skin below it.
        """
        D = self.skin.shape_jacobian(self.body.body.split(x)[0])
        return np.swapaxes(D, 1, 2).reshape(len(x), -1, D.shape[-1])

    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        """Return whitening by the covariance w_D / λ_Δ D Dᵀ of the markers, with D their derivatives by betas."""
        def of(x: np.ndarray, share: np.ndarray) -> np.ndarray:
            D = self.slopes(x)
            return whiten(self.weight / self.config.shape_change * D @ np.swapaxes(D, 1, 2), np.tile(share, 3))
        return of

    def solve_movement(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        """Estimate the changes of the betas in every frame by itself: (w_D DᵀD + λ_Δ) z = w_D Dᵀ off."""
        T, K = len(x), self.skin.n_betas
        added, changes, off = np.zeros(self.targets.shape), np.zeros((T, K)), self.off(x, self.targets)
        for batch in batches(T):
            D = self.slopes(x[batch])
            away = np.swapaxes(off[batch], 1, 2).reshape(len(D), -1, 1)
            pull = np.swapaxes(self.weight * np.tile(share[batch], 3)[..., None] * D, 1, 2)
            changes[batch] = np.linalg.solve(pull @ D + self.config.shape_change * np.eye(K), pull @ away)[..., 0]
            added[batch] = np.swapaxes((D @ changes[batch, :, None]).reshape(len(D), 3, -1), 1, 2)
        return added, changes, None


def variances(off: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Compute the variance (L,), square metres, per coordinate of residuals (T, L, 3) with weights (T, L)."""
    return np.einsum("tl,tld->l", share, off**2) / (3 * np.maximum(share.sum(axis=0), 1e-12))


def whiten(covariance: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Compute W (B, n, n) that makes rows r (n,) independent, as r @ W, for a covariance plus unit noise.

    The covariance C is (n, n) or (B, n, n). With weights `share` (B, n): `W Wᵀ = S (S C S + 1)⁻¹ S`, where S holds the
    roots of the weights.
    """
    S, one = np.sqrt(share), np.eye(share.shape[1])
    root = np.linalg.cholesky(S[:, :, None] * covariance * S[:, None] + one)
    return np.swapaxes(np.linalg.solve(root, S[:, :, None] * one), 1, 2)
