"""How the soft tissue of a person moves, from markers: what moves is integrated out of the poses, then found.

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
from scanprep.ranges import Positive, Settings
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import STILL
from ..pose.foot_contact import FootContact
from ..pose.marked_body import RATE, AnimateConfig, MarkedBody, batches, marker_weights, point_system
from .soft_tissue import SkinMovement, SoftTissue, in_root, in_world, smooth_modes

ROUNDS = 3                           # Gauss-Newton steps over the whole sequence, which begins near its end
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
    shape_change : float
        Weight of the squared change of the betas from the person's own, the paper's is 0.25: the betas change in every
        frame, as in the paper. 0: the skin moves instead, as `marker_sd`, `reach` and `temporal_smoothness` say.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight.
    """

    data: Positive = 2.0
    pose: float = 0.3
    velocity: Positive = 57600.0
    marker_sd: Positive = 0.001
    reach: Positive = 0.09
    temporal_smoothness: float = 2.0
    shape_change: float = 0.0
    outlier: Positive = 0.06

    @classmethod
    def from_paper(cls) -> SoftTissueConfig:
        """The weights of [MoSh] Eq. 24, whose betas change in every frame."""
        return cls(data=0.75, pose=1.0, velocity=6.25, outlier=1000.0, shape_change=0.25)


@one_thread()
def follow_soft_tissue(model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                       config: SoftTissueConfig | None = None, progress: Progress | None = None, ground: bool = False,
                       floor: tuple[float, float, float, float] | None = None) -> SoftTissue:
    """A motion in which the skin moves on the body, as the markers tell.

    [MoSh] changes the betas in every frame and holds the change by its squared length; `published()` does so. Betas of
    182 people have a third of the energy of a bump of 6 to 12 cm on average, so by default the skin itself moves: a
    Gaussian process over the surface, whose size at each marker is taken from how far that marker strays. Poses are
    found again, and a marker that strays more than most counts the less for them, so that they do not follow soft
    tissue. Where no marker is near, the skin does not move; markers that were not seen, and those that the motion did
    not trust, count nothing.

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
    ground : bool
        Feet neither sink into the floor nor slide while they stand on it, as by `AnimateConfig.ground`.
    floor : four numbers, optional
        A unit normal that points up, and the height of the floor along it, metres; else both come from the motion.

    Raises
    ------
    ValueError
        A motion without betas, or of other markers; a model without betas; fewer than 3 markers in common; settings
        out of range.

    [MoSh] Eq. 24
    """
    config, tell = config or SoftTissueConfig(), progress or (lambda done, total: None)
    if not model.n_betas:
        raise ValueError("model: expected one with betas, this one knows its template's body only")
    if motion.betas is None or len(motion.betas) > model.n_betas:
        raise ValueError(f"motion: expected one with at most {model.n_betas} betas, got "
                         f"{'none' if motion.betas is None else len(motion.betas)}")
    if motion.labels != markers.labels or len(motion.poses) != len(markers.positions):
        raise ValueError(f"motion: expected the one of these markers ({len(markers.positions)} frames, "
                         f"{len(markers.labels)} labels), got {len(motion.poses)} frames, {len(motion.labels)} labels")
    follower = (ShapeFollower if config.shape_change else SkinFollower)(model, motion, markers, layout, config)
    body, targets, T = follower.body, follower.targets, len(motion.poses)
    x = body.body.join(motion.poses, motion.trans)
    feet = FootContact(body, x, markers.rate, floor) if ground and T > 2 else None

    # how much each marker counts, and the frames from the first to the last in which any does
    share, _ = marker_weights(body.positions(x), targets, 1.0, config.outlier)
    share *= motion.trusted[:, follower.rows]
    some = np.flatnonzero((share > 0).any(axis=1))
    some = np.arange(some[0], some[-1] + 1) if len(some) else some

    # the poses, then what moves on them
    last = np.zeros(T)
    for i in range(ROUNDS if len(some) > 2 else 0):
        before = body.positions(x[some])
        x[some] = follower.step_poses(x[some], targets[some], share[some], feet,
                                      None if feet is None else feet.target_positions(x)[some])
        last[some] = np.linalg.norm(body.positions(x[some]) - before, axis=2).max(axis=1)
        tell(round(T * (i + 1) / (ROUNDS + 1)), T)
    added, changes, skin = follower.solve_movement(x, some, share)
    tell(T, T)
    pose, trans, _ = body.body.split(x)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    residuals[:, follower.rows] = np.linalg.norm(body.positions(x) + added - targets, axis=2)
    return SoftTissue(replace(motion, poses=pose.copy(), trans=trans.copy(), residuals=residuals,
                              converged=motion.converged & (last < STILL)), changes, skin)


Whitening = Callable[[np.ndarray, np.ndarray], np.ndarray]


class SoftFollower(ABC):
    """The markers of a sequence, and the body that carries them; arguments as of `follow_soft_tissue`.

    Unknowns are x (T, P) as in `MarkedBody`. What soft tissue does to the markers is a Gaussian variable: it adds to
    the covariance of their residuals while poses are sought, and is found at the end.
    """

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        assert motion.betas is not None, "checked"
        self.rows, self.layout = layout.match_columns(markers.labels)
        self.config, self.n_betas, self.targets = config, len(motion.betas), markers.positions[:, self.rows]
        poses = AnimateConfig(prior_weight=config.pose, angle_acceleration=RATE**2 / np.sqrt(config.velocity))
        if config.shape_change:                  # as the paper: its prior is not shrunk, and places are not smoothed
            poses = replace(poses, prior_shrinkage=0.0, place_acceleration=1e6)
        self.body = MarkedBody(model.subject(motion.betas), self.layout, config.pose, poses.prior_shrinkage)
        self.inertia = poses.inertia(markers.rate, self.body.n_unknowns)
        # of a weight on square centimetres
        self.weight = config.data * 1e4

    @abstractmethod
    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        """What makes the residuals of markers independent, see `whiten`, by the x and the share of some frames.

        (B, L, L) if the three coordinates are independent of each other and alike, else (B, 3L, 3L).
        """

    @abstractmethod
    def solve_movement(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        """The movement in all frames x (T, P), that of frames without a marker that counts, not in `some`, none.

        What it adds to the places of the markers (T, L, 3), metres, and how `SoftTissue` holds it.
        """

    def off(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """Where markers are against the body at x (B, P), metres (B, L, 3), 0 for one not seen."""
        away = targets - self.body.positions(x)
        return np.where(np.isnan(away), 0.0, away)

    def step_poses(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray, feet: FootContact | None,
                   places: np.ndarray | None) -> np.ndarray:
        """Frames (T, P) that follow each other after one Gauss-Newton step, the movement integrated out."""
        whitening = self.whitening(x, targets, share)

        def system(x: np.ndarray, targets: np.ndarray, share: np.ndarray, *places: np.ndarray) -> Dense:
            data = self.system(x, targets, np.sqrt(self.weight) * whitening(x, share))
            return data if feet is None else feet.hold(data, x, *places)

        held = () if places is None else (places,)
        return self.body.smooth_step(x, self.inertia, system, targets, share, *held)

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


class SkinFollower(SoftFollower):
    """The skin moves on the body, a Gaussian process along it and along the axes of the root."""

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        super().__init__(model, motion, markers, layout, config)
        self.modes, self.root = smooth_modes(model.template, self.layout.nearest, config.reach)
        self.smoothness = config.temporal_smoothness * (markers.rate / RATE)**4

    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        strays = variances(self.off(x, targets), share)
        # how far most markers lie off, two medians (squared), is noise to the pose; what one is beyond, soft tissue
        noise = max(2.0 * float(np.median(strays)), self.config.marker_sd**2)
        root = np.sqrt(np.maximum(strays / noise - 1, 0))[:, None] * self.root
        return lambda x, share: whiten(root @ root.T, share)

    def solve_movement(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        moved, poses = np.zeros(self.targets.shape), self.body.body.split(x)[0]
        if len(some):
            moved[some] = self.solve_displacements(in_root(self.off(x[some], self.targets[some]), poses[some]),
                                                   share[some])
        return in_world(moved, poses), np.zeros((len(x), self.n_betas)), SkinMovement(self.modes, moved)

    def solve_displacements(self, off: np.ndarray, share: np.ndarray) -> np.ndarray:
        """The movement of the skin under the markers (T, L, 3), metres, which lie off the body (T, L, 3).

        [MoSh] Eq. 24, with |z|² in place of |β_t|²
        """
        sd = self.config.marker_sd
        size = LOOSE * np.sqrt(np.maximum(variances(off, share) - sd**2, (0.1 * sd)**2))
        root = size[:, None] * self.root                                       # the movement is root @ z, z ~ N(0, 1)
        z, coupled = np.empty((len(off), root.shape[1], 3)), len(off) > 2
        for near, kept, where in overlapping_windows(len(off), WINDOW, OVERLAP) if coupled else [(slice(None),) * 3]:
            counts = share[near, :, None] / sd**2
            blocks, pull = root.T @ (counts * root) + np.eye(root.shape[1]), root.T @ (counts * off[near])
            z[where] = (solve_smooth(blocks, self.smoothness, pull) if coupled else np.linalg.solve(blocks, pull))[kept]
        return root @ z


class ShapeFollower(SoftFollower):
    """The betas change in every frame, β_t = β + z_t, at a cost of λ_Δ |z_t|². [MoSh] Eq. 24"""

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        super().__init__(model, motion, markers, layout, config)
        # at most 200 betas change, or those that the person has
        self.skin = model.points(*self.layout.skin, min(max(200, self.n_betas), model.n_betas))

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivative (B, 3L, K) of the markers by the betas at x (B, P), coordinates before markers, metres.

        A marker moves as the skin below it.
        """
        D = self.skin.shape_jacobian(self.body.body.split(x)[0])
        return np.swapaxes(D, 1, 2).reshape(len(x), -1, D.shape[-1])

    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        def of(x: np.ndarray, share: np.ndarray) -> np.ndarray:
            D = self.slopes(x)
            return whiten(self.weight / self.config.shape_change * D @ np.swapaxes(D, 1, 2), np.tile(share, 3))
        return of

    def solve_movement(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
                       ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        T, K = len(x), self.skin.n_betas
        added, changes, off = np.zeros(self.targets.shape), np.zeros((T, K)), self.off(x, self.targets)
        for few in batches(T):
            D = self.slopes(x[few])
            away = np.swapaxes(off[few], 1, 2).reshape(len(D), -1, 1)
            pull = np.swapaxes(self.weight * np.tile(share[few], 3)[..., None] * D, 1, 2)
            changes[few] = np.linalg.solve(pull @ D + self.config.shape_change * np.eye(K), pull @ away)[..., 0]
            added[few] = np.swapaxes((D @ changes[few, :, None]).reshape(len(D), 3, -1), 1, 2)
        return added, changes, None


def variances(off: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(L,) square metres: the mean square of a coordinate of residuals (T, L, 3), which count by their share (T, L)."""
    return np.einsum("tl,tld->l", share, off**2) / (3 * np.maximum(share.sum(axis=0), 1e-12))


def whiten(covariance: np.ndarray, share: np.ndarray) -> np.ndarray:
    """W (B, n, n), with which rows r (n,) become independent, r @ W, where a unit of noise is added to the covariance.

    The covariance C is (n, n) or (B, n, n). Noise counts by its share (B, n): `W Wᵀ = S (S C S + 1)⁻¹ S` with S the
    roots of the shares.
    """
    S, one = np.sqrt(share), np.eye(share.shape[1])
    root = np.linalg.cholesky(S[:, :, None] * covariance * S[:, None] + one)
    return np.swapaxes(np.linalg.solve(root, S[:, :, None] * one), 1, 2)
