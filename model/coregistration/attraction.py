"""What a scan asks of the points of a body: matches in both directions, gathered into one quadratic a point."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints, Surface
from scanprep.geometry.target import Target
from scanprep.registration.matches import tukey


@dataclass(frozen=True, eq=False)
class Attraction:
    """A quadratic energy `Σ |root (x - place)|²` of points x (L, 3)."""

    root: np.ndarray        # (L, 3, 3), zero for a point that nothing attracts
    place: np.ndarray       # (L, 3), metres

    def residual(self, x: np.ndarray) -> np.ndarray:
        """(3L,)"""
        return np.einsum("lij,lj->li", self.root, x - self.place).ravel()

    def joined(self, other: Attraction) -> Attraction:
        """Those of these points and of others behind them."""
        return Attraction(np.concatenate([self.root, other.root]), np.concatenate([self.place, other.place]))


def towards(places: np.ndarray, weights: np.ndarray) -> Attraction:
    """Points drawn to places (L, 3), metres, with weights (L,) on the squared distances."""
    return Attraction(np.sqrt(weights)[:, None, None] * np.eye(3), places)


def attraction(x: np.ndarray, normals: np.ndarray, share: np.ndarray, target: Target, reach: float, slide: float,
               scale: float) -> Attraction:
    """What matches with compatible normals want, from the body to the scan and back.

    `x, normals` (L, 3), points of the body and their normals; `share` (L,); `reach`, metres, weights fall to zero
    towards it; `scale`, metres, how much distance a difference of normals weighs.
    """
    forward = OrientedPoints(target.points, target.normals, scale).match(x, normals, reach)
    i = np.flatnonzero(forward.valid & ~target.border[forward.index])
    back = OrientedPoints(x, normals, scale).match(target.points, target.normals, reach)
    p = np.flatnonzero(back.valid)
    mine, theirs = np.r_[i, back.index[p]], np.r_[forward.index[i], p]
    w = np.r_[share[i] * tukey(forward.distances[i], reach), tukey(back.distances[p], reach) / len(target.points)]
    n, z = target.normals[theirs], target.points[theirs]
    A_each = w[:, None, None] * (slide * np.eye(3) + (1 - slide) * n[:, :, None] * n[:, None, :])
    A, b = np.zeros((len(x), 3, 3)), np.zeros((len(x), 3))
    np.add.at(A, mine, A_each)
    np.add.at(b, mine, np.einsum("nij,nj->ni", A_each, z))
    values, axes = np.linalg.eigh(A)
    known = values > 1e-12 * max(float(values.max(initial=0)), 1e-30)
    root = (axes * np.sqrt(np.where(known, values, 0))[:, None]) @ np.swapaxes(axes, -1, -2)
    inverse = (axes * np.where(known, 1 / np.where(known, values, 1), 0)[:, None]) @ np.swapaxes(axes, -1, -2)
    return Attraction(root, np.einsum("nij,nj->ni", inverse, b))


def apart(mesh: Mesh, target: Target, limit: float) -> np.ndarray:
    """Distances (n,) of scan points to the nearest place of a mesh, metres; at most `limit`, which it is where the two
    face away from each other."""
    found = Surface(mesh).closest(target.points)
    facing = np.einsum("nd,nd->n", mesh.face_normals[found.faces], target.normals) > 0
    return np.where(facing, np.minimum(found.distances, limit), limit)
