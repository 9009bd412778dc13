"""What linear blend skinning lacks: the way to the exact model, in the axes of the rest mesh."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..linear import Subject
from .rig import Rig

AT_ONCE = 32                         # frames that are held at a time


@dataclass(frozen=True, eq=False)
class Correctives:
    """The changes of the rest mesh that make a skinned motion exact: shapes (C, N, 3), metres, the largest first, and
    their weights (T, C), of mean square 1.
    """

    shapes: np.ndarray
    weights: np.ndarray

    def changes(self, frames: np.ndarray) -> np.ndarray:
        """The changes (n, N, 3) of the rest mesh in some frames, metres."""
        return np.tensordot(self.weights[frames], self.shapes, axes=1)


def rest_corrections(rig: Rig, poses: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Changes of the rest mesh (T, N, 3), metres, that skinning carries onto the exact bodies (T, N, 3), trans zero."""
    out = np.empty_like(exact, dtype=np.float64)
    for t, pose in enumerate(poses):
        blended = np.einsum("nj,jab->nab", rig.weights, rig.skeleton.part_rotations(pose))
        # opposite rotations can cancel; the damped inverse leaves alone what they blot out
        # share of a blended rotation below which it is not undone
        square = np.swapaxes(blended, 1, 2) @ blended + 0.1**2 * _lost(blended)[:, None, None] * np.eye(3)
        off = exact[t] - rig.vertices(pose)
        out[t] = np.linalg.solve(square, np.swapaxes(blended, 1, 2) @ off[..., None])[..., 0]
    return out


def _lost(blended: np.ndarray) -> np.ndarray:
    """(N,) how far blended rotations (N, 3, 3) are from a rotation: 0 for one, 1 where all has cancelled."""
    return 1 - np.clip(np.abs(np.linalg.det(blended)), 0, 1)


def motion_correctives(rig: Rig, subject: Subject, poses: np.ndarray, count: int, frames: int = 200) -> Correctives:
    """The `count` shapes that bring a skinned motion nearest to the exact one.

    Parameters
    ----------
    rig : Rig
    subject : Subject
        The exact body.
    poses : (T, J, 3) float, radians
    count : int
        No more come back than there are frames.
    frames : int
        The shapes are found from so many frames of a longer motion; all frames have their weights.
    """
    poses = np.asarray(poses, dtype=np.float64)
    seen = poses[spaced(len(poses), frames)]
    changes = rest_corrections(rig, seen, subject.vertices(seen)).reshape(len(seen), -1)
    power, modes = np.linalg.eigh(changes @ changes.T)
    chosen = np.argsort(-power)[:count]
    chosen = chosen[power[chosen] > 1e-12 * power.max()]
    basis = modes[:, chosen].T @ changes
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    weights = np.empty((len(poses), len(basis)))
    for start in range(0, len(poses), AT_ONCE):
        some = poses[start:start + AT_ONCE]
        each = rest_corrections(rig, some, subject.vertices(some))
        weights[start:start + AT_ONCE] = each.reshape(len(some), -1) @ basis.T
    size = np.sqrt((weights**2).mean(axis=0))
    return Correctives((basis * size[:, None]).reshape(-1, *rig.mesh.vertices.shape), weights / size)


def spaced(total: int, count: int) -> np.ndarray:
    """Up to `count` of 0..total-1, evenly spaced and with both ends."""
    return np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))
