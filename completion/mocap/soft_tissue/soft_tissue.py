"""Soft tissue: a person whose shape changes a little in every frame. [MoSh] Eq. 24"""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model.body import BodyModel
from scanprep.geometry import storage
from scanprep.geometry.sparse import overlapping_windows, solve_smooth
from scanprep.ranges import Positive, Settings
from scanprep.threads import one_thread

from ...motion import Motion, Progress
from ...smoothing import coupled_steps
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..pose.follow import FURTHEST
from ..pose.marked_body import batches
from ..pose.robust import marker_weights
from ..pose.settings import RATE, AnimateConfig
from .changing_body import ChangingBody, changing_bodies, skin_metric, skin_movement

PER_SQUARE_METRE = 1e4               # of a weight on square centimetres
ROUNDS = 3                           # Gauss-Newton steps over the whole sequence, which begins near its end
CHANGES = "shape_changes"            # in a motion file
WINDOW, OVERLAP = 400, 40            # frames smoothed at once, and those that each side lends to its neighbour


@dataclass(frozen=True)
class SoftTissueConfig(Settings):
    """Settings of `follow_soft_tissue`.

    Weights stand on squared centimetres, as in the paper, whose own are `published()`. Here the pose prior is a narrow
    one, which at the paper's 1 keeps poses from their markers, and the shape would bend to make up for it; and
    velocities are held because the shape would else follow the noise.

    Attributes
    ----------
    data : float
        Weight of the markers against their simulation.
    pose : float
        Weight of the pose prior; the paper's is 1.
    velocity : float
        Weight of the squared change of velocity from frame to frame, 120 frames a second; the paper's is 6.25.
    change : float
        Weight of the squared change of betas from the person's own.
    skin : float
        Weight of the squared distance, in centimetres, that the change moves the skin: the mean over the surface.
    temporal_smoothness : float
        Weight of the squared second difference of the change from frame to frame, 120 frames a second, against that
        of the change itself.
    outlier : float, metres
        Residual at which a marker has lost three quarters of its weight.
    """

    data: float = 0.75
    pose: float = 0.1
    velocity: float = 40000.0
    change: float = 0.25
    skin: float = 10.0
    temporal_smoothness: float = 20.0
    outlier: Positive = 0.06

    @classmethod
    def published(cls) -> SoftTissueConfig:
        """The weights of [MoSh] Eq. 24, and nothing that holds the change but its λΔ of 0.25."""
        return cls(pose=1.0, velocity=6.25, skin=0.0, temporal_smoothness=0.0, outlier=1000.0)


@dataclass(frozen=True, eq=False)
class SoftTissue:
    """A motion of a body whose shape changes while it moves.

    Attributes
    ----------
    motion : Motion
        Poses and places, and the residuals with the changing shape; `motion.betas` is the person's own shape.
    changes : (T, K) float
        What is added to the person's betas in every frame; K may be more than the person's betas, which are zero beyond
        their end.
    """

    motion: Motion
    changes: np.ndarray

    def betas(self, factor: float = 1.0) -> np.ndarray:
        """(T, K) betas of every frame, the change taken `factor` times: more than 1 exaggerates it."""
        assert self.motion.betas is not None, "a person of a shape space"
        own = np.zeros(self.changes.shape[1])
        own[:len(self.motion.betas)] = self.motion.betas
        return own + factor * self.changes

    def vertices(self, model: BodyModel, frames: np.ndarray | slice = slice(None), factor: float = 1.0) -> np.ndarray:
        """The meshes (n, N, 3) of some frames, metres, the change taken `factor` times."""
        return changing_bodies(model, self.motion.poses[frames], self.betas(factor)[frames], self.motion.trans[frames])

    def movement(self, model: BodyModel) -> np.ndarray:
        """How far the change moves every vertex (N,) of the skin, metres: the root of the mean square over time."""
        return skin_movement(model, self.changes)

    def save(self, path: str | Path) -> None:
        """Write a motion file (see `Motion.save`) that also holds the changes, as `shape_changes`."""
        self.motion.save(path, **{CHANGES: self.changes})

    @staticmethod
    def is_in(path: Path) -> bool:
        """Whether a motion file holds changes of shape."""
        return path.suffix != ".bvh" and CHANGES in storage.names_in(path, "a motion")

    @staticmethod
    def load(path: str | Path) -> SoftTissue:
        """Read a file of `save`; StorageError for one that is missing, not a motion, or of a fixed shape."""
        motion, stored = Motion.load(path), storage.load_arrays(path, "a motion")
        with storage.taking_apart(path, f"shape_changes, a row for each of {len(motion.poses)} frames"):
            changes = storage.numbers(stored, CHANGES, len(motion.poses), None)
        if motion.betas is None or len(motion.betas) > changes.shape[1]:
            raise storage.StorageError(f"{path}: expected a person of at most {changes.shape[1]} betas, "
                                       f"found {0 if motion.betas is None else len(motion.betas)}")
        return SoftTissue(motion, changes.astype(np.float64))


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
    """The markers of a sequence, and the changing body that is to carry them; arguments as of `follow_soft_tissue`.

    Unknowns are x (T, P) as in `MarkedBody` and changes z (T, K), whose energy is |z|².
    """

    def __init__(self, model: BodyModel, motion: Motion, markers: MarkerSequence, layout: MarkerLayout,
                 config: SoftTissueConfig) -> None:
        _check(model, motion, markers, config)
        assert motion.betas is not None, "checked"
        labels = layout.matched(markers.labels)
        self.config, self.motion = config, motion
        self.rows = np.array([markers.labels.index(label) for label in labels])
        self.targets = markers.positions[:, self.rows]
        # components in which the shape may change, of those that the model has
        K = min(max(200, len(motion.betas)), model.n_betas)
        slopes = model.shape_jacobian(model.pose_mean)[..., :K]
        poses = AnimateConfig(prior_weight=config.pose, angle_acceleration=RATE**2 / np.sqrt(config.velocity))
        self.body = ChangingBody(model, motion.betas, layout.select(labels), cheap_directions(model, slopes, config),
                                 slopes, config.pose, poses.prior_shrinkage)
        self.inertia = poses.inertia(markers.rate, self.body.marked.n_unknowns)
        self.smoothness = config.temporal_smoothness * (markers.rate / RATE)**4

    def solve(self, progress: Progress | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unknowns (T, P), changes z (T, K), and which frames settled (T,)."""
        marked, T = self.body.marked, len(self.targets)
        x = marked.body.join(self.motion.poses, self.motion.trans)
        z, moved = np.zeros((T, self.body.n_betas)), np.zeros(T)
        some, weights = self.weights(marked.positions(x))
        targets, weights = self.targets[some], weights[some]
        for i in range(ROUNDS if len(some) else 0):
            earlier = x[some], z[some]
            x[some], z[some] = self.round(*earlier, targets, weights)
            if i == ROUNDS - 1:
                moved[some] = np.linalg.norm(self.body.positions(x[some], z[some]) - self.body.positions(*earlier),
                                             axis=2).max(axis=1)
            if progress:
                progress(round(T * (i + 1) / (ROUNDS + 1)), T)
        if self.smoothness and len(some) > 2:
            z[some] = smooth_changes(self.body, x[some], targets, weights, self.smoothness)
        if progress:
            progress(T, T)
        return x, z, moved < 0.002  # metres that the last round moves any marker of a frame that has settled

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
        for some in batches(T):
            _, g, H = self.body.system(x[some], z[some], targets[some], weights[some])
            g[:, P:] += z[some]                                         # [MoSh] Eq. 24
            across = H[:, :P, P:]
            right = np.concatenate([np.swapaxes(across, 1, 2), g[:, P:, None]], axis=2)
            back[some] = solved = np.linalg.solve(H[:, P:, P:] + np.eye(self.body.n_betas), right)
            hessian[some] = H[:, :P, :P] - across @ solved[:, :, :P]
            gradient[some] = g[:, :P] - (across @ solved[:, :, P:])[..., 0]
        step = coupled_steps(x, gradient, hessian, self.inertia) if T > 2 \
            else -np.linalg.solve(hessian, gradient[..., None])[..., 0]
        share = np.minimum(1, FURTHEST / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
        shift = -(back[:, :, P] + (back[:, :, :P] @ step[..., None].astype(np.float32))[..., 0])
        return self.body.marked.retract(x, share * step), z + share * shift


def cheap_directions(model: BodyModel, slopes: np.ndarray, config: SoftTissueConfig) -> np.ndarray:
    """(K, K) directions of betas, by rows, each of cost one, from the vertices' slopes (N, 3, K). [MoSh] Eq. 24"""
    cost = config.change * np.eye(slopes.shape[-1]) + config.skin * PER_SQUARE_METRE * skin_metric(model, slopes)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cost)))


def smooth_changes(body: ChangingBody, x: np.ndarray, targets: np.ndarray, weights: np.ndarray, smoothness: float
                   ) -> np.ndarray:
    """The changes z (T, K) of at least 3 frames, poses x held, with `smoothness` on their second difference over time.

    Poses were found with changes free of each other; filtering these hardly moves a marker.
    """
    z, eye = np.empty((len(x), body.n_betas)), np.eye(body.n_betas)
    for near, kept, where in overlapping_windows(len(x), WINDOW, OVERLAP):
        at, goal, share = x[near], targets[near], weights[near]
        gradient, hessian = np.empty((len(at), body.n_betas)), np.empty((len(at), body.n_betas, body.n_betas))
        for some in batches(len(at)):
            _, gradient[some], hessian[some] = body.change_system(at[some], goal[some], share[some])
        z[where] = -solve_smooth(hessian + eye, smoothness, gradient)[kept]
    return z


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
    if not config.change > 0:
        raise ValueError(f"config: expected change > 0, got {config.change}")
