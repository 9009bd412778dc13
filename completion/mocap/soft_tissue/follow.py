"""How the soft tissue of a person moves, from markers. [MoSh] Eq. 24"""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from model.body import BodyModel
from scanprep.geometry.sparse import overlapping_windows, solve_smooth
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.foot_contact import Floor, FootContact
from ..pose.marked_body import batches
from ..pose.settings import RATE
from .follower import SoftFollower, Whitening, whiten
from .settings import SoftTissueConfig
from .skin import SkinMovement, in_root, in_world, smooth_modes
from .soft_tissue import SoftTissue

USUAL = 2.0                          # medians of how far markers lie off (squared) within which it is noise to the pose
LOOSE = 3.0                          # sizes of the movement by which the prior allows it; at 1 it shrinks what it finds
WINDOW, OVERLAP = 400, 40            # frames smoothed at once, and those that each side lends to its neighbour
MOST_BETAS = 200                     # that change, of those that the model has


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
    config = config or SoftTissueConfig()
    _check(model, motion, markers)
    follower = (ShapeFollower if config.shape_change else SkinFollower)(model, motion, markers, layout, config)
    body, feet = follower.body, None
    if ground and len(motion.poses) > 2:
        feet = FootContact(body, body.body.join(motion.poses, motion.trans), markers.rate,
                           None if floor is None else Floor.given(floor))
    x, some, share = follower.solve(progress, feet)
    added, changes, skin = follower.moved(x, some, share)
    if progress:
        progress(len(x), len(x))
    pose, trans, _ = body.body.split(x)
    residuals = np.full(markers.positions.shape[:2], np.nan)
    residuals[:, follower.rows] = np.linalg.norm(body.positions(x) + added - follower.targets, axis=2)
    return SoftTissue(replace(motion, poses=pose.copy(), trans=trans.copy(), residuals=residuals,
                              converged=motion.converged & follower.settled), changes, skin)


class SkinFollower(SoftFollower):
    """The skin moves on the body, a Gaussian process along it and along the axes of the root."""

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        super().__init__(model, motion, markers, layout, config)
        self.modes, self.root = smooth_modes(model.template, self.layout.nearest, config.reach)
        self.smoothness = config.temporal_smoothness * (markers.rate / RATE)**4

    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        """How far most of the markers lie off is noise to the pose; what a marker is beyond it is soft tissue."""
        strays = variances(self.off(x, targets), share)
        noise = max(USUAL * float(np.median(strays)), self.config.marker_sd**2)
        root = np.sqrt(np.maximum(strays / noise - 1, 0))[:, None] * self.root
        return lambda near: whiten(root @ root.T, share[near])

    def moved(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray, SkinMovement | None]:
        assert self.motion.betas is not None, "checked"
        moved, poses = np.zeros(self.targets.shape), self.body.body.split(x)[0]
        if len(some):
            moved[some] = self.displaced(in_root(self.off(x[some], self.targets[some]), poses[some]), share[some])
        return in_world(moved, poses), np.zeros((len(x), len(self.motion.betas))), SkinMovement(self.modes, moved)

    def displaced(self, off: np.ndarray, share: np.ndarray) -> np.ndarray:
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
        assert motion.betas is not None, "checked"
        self.skin = model.points(*self.layout.skin, min(max(MOST_BETAS, len(motion.betas)), model.n_betas))

    def slopes(self, x: np.ndarray) -> np.ndarray:
        """Derivative (B, 3L, K) of the markers by the betas at x (B, P), coordinates before markers, metres.

        A marker moves as the skin below it.
        """
        D = self.skin.shape_jacobian(self.body.body.split(x)[0])
        return np.swapaxes(D, 1, 2).reshape(len(x), -1, D.shape[-1])

    def whitening(self, x: np.ndarray, targets: np.ndarray, share: np.ndarray) -> Whitening:
        def of(near: slice) -> np.ndarray:
            D = self.slopes(x[near])
            return whiten(self.weight / self.config.shape_change * D @ np.swapaxes(D, 1, 2),
                          np.tile(share[near], 3))
        return of

    def moved(self, x: np.ndarray, some: np.ndarray, share: np.ndarray
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
