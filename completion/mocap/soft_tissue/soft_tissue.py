"""Soft tissue: a motion in which the skin or the shape changes a little in every frame. [MoSh] Eq. 24"""
from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.linear import Subject, check_pose
from scanprep.geometry import rotations, storage
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh

from ...motion import Motion

CHANGES, MODES, MOVED = "shape_changes", "skin_modes", "skin_moved"       # names of arrays in a motion file
AT_ONCE = 32                         # bodies in memory at once


@dataclass(frozen=True, eq=False)
class SkinMovement:
    """A smooth displacement of the skin in every frame.

    Attributes
    ----------
    modes : (N, R) float
        Share of each vertex in the displacement of each of R places.
    moved : (T, R, 3) float, metres
        Displacements of the places, along the axes of the root.
    """

    modes: np.ndarray
    moved: np.ndarray

    def at(self, places: np.ndarray, poses: np.ndarray, frames: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Compute displacements (n, L, 3), metres, of points with shares (L, R) in frames with poses (n, J, 3)."""
        return np.asarray(places @ in_world(self.moved[frames], poses))

    def times(self, factor: float) -> SkinMovement:
        """Return the movement multiplied by a factor."""
        return SkinMovement(self.modes, factor * self.moved)

    def mean_square(self) -> np.ndarray:
        """Compute the mean square over time of each vertex's displacement (N,), square metres."""
        moment = np.tensordot(self.moved, self.moved, axes=((0, 2), (0, 2))) / max(len(self.moved), 1)
        return np.maximum(((self.modes @ moment) * self.modes).sum(axis=1), 0)


@dataclass(frozen=True, eq=False)
class SoftTissue:
    """A motion of a body whose skin moves on it, or whose betas change.

    Attributes
    ----------
    motion : Motion
        Poses and places, and the residuals with the moving skin; `motion.betas` is the person's own shape.
    changes : (T, K) float
        Changes of the betas in every frame, as in the paper; zero where the skin moves instead. K may exceed the number
        of the person's betas, which are zero beyond their end.
    skin : SkinMovement, optional
        How the skin moves on the body; None where betas change instead.
    """

    motion: Motion
    changes: np.ndarray
    skin: SkinMovement | None = None

    def betas(self, factor: float = 1.0) -> np.ndarray:
        """Return the betas (T, K) of every frame, with `factor` times the change: more than 1 exaggerates it."""
        assert self.motion.betas is not None, "a person of a shape space"
        own = np.zeros(self.changes.shape[1])
        own[:len(self.motion.betas)] = self.motion.betas
        return own + factor * self.changes

    def times(self, factor: float) -> SoftTissue:
        """Return the motion with `factor` times the soft tissue."""
        return replace(self, changes=factor * self.changes, skin=self.skin and self.skin.times(factor))

    def vertices(self, model: BodyModel, frames: np.ndarray | slice = slice(None), factor: float = 1.0,
                 subject: Subject | None = None) -> np.ndarray:
        """Compute the meshes (n, N, 3) of some frames, metres, with `factor` times the soft tissue.

        `subject` is the person's own body, if the caller has it; where betas change, each frame has another.
        """
        poses, trans = self.motion.poses[frames], self.motion.trans[frames]
        if self.changes.any():
            out = changing_bodies(model, poses, self.betas(factor)[frames], trans)
        else:
            out = (subject or model.subject(self.motion.betas)).vertices(poses, trans)
        return out if self.skin is None else out + factor * self.skin.at(self.skin.modes, poses, frames)

    def points(self, model: BodyModel, vertex_ids: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Compute points (T, L, 3) of the skin, metres; arguments are those of `Subject.points`."""
        poses, K = self.motion.poses, self.changes.shape[1]
        shaped = model.points(vertex_ids, weights, K)
        out = shaped.operator(self.betas(0.0)[0]).evaluate(poses, self.motion.trans)
        # changes of betas to first order, then the displacement of the skin
        for start in range(0, len(out) if self.changes.any() else 0, AT_ONCE):
            some = slice(start, start + AT_ONCE)
            out[some] += np.einsum("tk,tldk->tld", self.changes[some], shaped.shape_jacobian(poses[some]))
        if self.skin is not None:
            out += self.skin.at(np.einsum("lk,lkr->lr", weights, self.skin.modes[vertex_ids]), poses)
        return out

    def movement(self, model: BodyModel) -> np.ndarray:
        """Compute the root mean square displacement (N,), metres, of each vertex by soft tissue."""
        by_betas = skin_movement(model, self.changes) if self.changes.any() or self.skin is None else 0.0
        return np.sqrt(by_betas**2 + (0.0 if self.skin is None else self.skin.mean_square()))

    def save(self, path: str | Path) -> None:
        """Write a motion file (see `Motion.save`) that also holds soft tissue.

        Earlier versions, which know only changes of betas, read a moving skin as a motion of fixed shape.
        """
        more = {CHANGES: self.changes}
        if self.skin is not None:
            more |= {MODES: self.skin.modes.astype(np.float32), MOVED: self.skin.moved.astype(np.float32)}
        self.motion.save(path, **more)

    @staticmethod
    def is_in(path: Path) -> bool:
        """Tell whether a motion file holds soft tissue."""
        return path.suffix != ".bvh" and CHANGES in storage.names_in(path, "a motion")

    @staticmethod
    def load(path: str | Path) -> SoftTissue:
        """Read a file of `save`; StorageError for one that is missing, not a motion, or without soft tissue."""
        motion, stored = Motion.load(path), storage.load_arrays(path, "a motion")
        T, skin = len(motion.poses), None
        with storage.taking_apart(path, f"shape_changes, a row for each of {T} frames"):
            changes = storage.numbers(stored, CHANGES, T, None)
        if motion.betas is None or len(motion.betas) > changes.shape[1]:
            raise storage.StorageError(f"{path}: expected a person of at most {changes.shape[1]} betas, "
                                       f"found {0 if motion.betas is None else len(motion.betas)}")
        if MODES in stored or MOVED in stored:
            with storage.taking_apart(path, f"{MODES} and {MOVED}, the same number of places in {T} frames"):
                modes = storage.numbers(stored, MODES, None, None)
                skin = SkinMovement(modes.astype(np.float64),
                                    storage.numbers(stored, MOVED, T, modes.shape[1], 3).astype(np.float64))
        return SoftTissue(motion, changes.astype(np.float64), skin)


def in_world(moved: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Rotate vectors (n, R, 3) from the axes of the root to the world, in poses (n, J, 3)."""
    return np.asarray(moved @ np.swapaxes(rotations.exp(poses[:, 0]), -1, -2))


def in_root(moved: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Rotate vectors (n, R, 3) from the world to the axes of the root, in poses (n, J, 3)."""
    return np.asarray(moved @ rotations.exp(poses[:, 0]))


def smooth_modes(skin: Mesh, places: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute modes (N, R) that interpolate displacements of vertices (R,), and a root (R, r) of their correlation.

    The displacement is a Gaussian process over the skin. Correlations fall with the distance along it like a Gaussian
    bell, to exp(-1/2) at `reach`, metres. The modes are the conditional mean, given the displacements of the places.
    Rare patterns are left out: distances along a curved surface make some impossible.
    """
    distances = SurfaceGraph(skin).distances(places, limit=4 * reach)              # at the limit the bell is 0.0003
    bell = np.exp(-0.5 * (distances / reach)**2)
    near = bell[:, places]
    values, vectors = np.linalg.eigh(0.5 * (near + near.T))
    # 1e-2: patterns of less variance are noise, or not possible for a Gaussian process
    values, vectors = values[values > 1e-2], vectors[:, values > 1e-2]
    return bell.T @ (vectors / values) @ vectors.T, vectors * np.sqrt(values)


def changing_bodies(model: BodyModel, poses: np.ndarray, betas: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """Compute vertices (T, N, 3), metres, with betas (T, k) for each frame, exactly."""
    poses, trans = check_pose(model.skeleton, poses, trans)
    if betas.ndim != 2 or len(betas) != len(poses) or betas.shape[1] > model.n_betas:
        raise ValueError(f"betas: expected ({len(poses)}, k) with k at most {model.n_betas}, got {betas.shape}")
    out = np.empty((len(poses), len(model.template.vertices), 3))
    for start in range(0, len(poses), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        out[some] = model.bodies_of(poses[some], betas[some])
    out += (model.skeleton.joints[0] + trans)[:, None]
    return out


def skin_movement(model: BodyModel, changes: np.ndarray) -> np.ndarray:
    """Compute the root mean square displacement (N,), metres, of each vertex by changes of betas (T, k).

    It is that in the mean pose; other poses rotate the displacement, and hardly change its length.
    """
    D = model.shape_jacobian(model.pose_mean)[..., :changes.shape[1]]
    moment = changes.T @ changes / max(len(changes), 1)
    return np.sqrt(np.maximum(np.einsum("ndk,ndk->n", D @ moment, D), 0.0))
