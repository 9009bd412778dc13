"""The skin that moves on a body: displacements under some markers that go over into each other along the skin."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.geometry.mesh import Mesh

LEAST = 1e-2                         # eigenvalue of a pattern that is kept: finer ones are noise, or none of a process


@dataclass(frozen=True, eq=False)
class SkinMovement:
    """A smooth displacement of the skin in every frame.

    Attributes
    ----------
    modes : (N, R) float
        What share every vertex has in the displacement of each of R places.
    moved : (T, R, 3) float, metres
        Displacements of the places, along the axes of the root.
    """

    modes: np.ndarray
    moved: np.ndarray

    def at(self, places: np.ndarray, poses: np.ndarray, frames: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Displacements (n, L, 3), metres, of points with shares (L, R) in some frames with their poses (n, J, 3)."""
        return np.asarray(places @ in_world(self.moved[frames], poses))

    def times(self, factor: float) -> SkinMovement:
        """The same, so many times as large."""
        return SkinMovement(self.modes, factor * self.moved)

    def squared(self) -> np.ndarray:
        """(N,) square metres: how far every vertex moves, the mean square over time."""
        moment = np.tensordot(self.moved, self.moved, axes=((0, 2), (0, 2))) / max(len(self.moved), 1)
        return np.maximum(((self.modes @ moment) * self.modes).sum(axis=1), 0)


def in_world(moved: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Vectors (n, R, 3) along the axes of the root, turned into the world, in poses (n, J, 3)."""
    return np.asarray(moved @ np.swapaxes(rotations.exp(poses[:, 0]), -1, -2))


def in_root(moved: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Vectors (n, R, 3) in the world, turned into the axes of the root, in poses (n, J, 3)."""
    return np.asarray(moved @ rotations.exp(poses[:, 0]))


def smooth_modes(skin: Mesh, places: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """What displacements of some vertices (R,) tell of all others, (N, R), and a root (R, r) of their correlation.

    The displacement is a Gaussian process over the skin: correlations fall with the distance along it as a bell does,
    to exp(-1/2) at `reach`, metres. The modes are its mean, the displacements of the places given. Patterns over the
    places that hardly occur are left out; distances along a curved surface make some impossible.
    """
    distances = SurfaceGraph(skin).distances(places, limit=4 * reach)              # beyond it the bell is 0.0003
    bell = np.exp(-0.5 * (distances / reach)**2)
    near = bell[:, places]
    values, vectors = np.linalg.eigh(0.5 * (near + near.T))
    values, vectors = values[values > LEAST], vectors[:, values > LEAST]
    return bell.T @ (vectors / values) @ vectors.T, vectors * np.sqrt(values)
