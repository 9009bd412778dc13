"""What a surface fit takes from a scan, its data term, and how far a fit has stretched its mesh."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array, diags_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.target import Target, target_of


@dataclass(frozen=True, eq=False)
class SurfaceData:
    """A data term Σ (x - y)ᵀ A (x - y) + share · |C x - z|²: vertices are drawn, and points of the scan draw the mesh.

    Attributes
    ----------
    A : (N, 3, 3) float
        Weight of each vertex: nothing without data, only across the surface at the edge of a hole.
    y : (N, 3) float, metres
        Where it is drawn.
    C : (P, N) sparse
        Points of the mesh, as barycentric coordinates.
    z : (P, 3) float, metres
        The points of the scan that draw them.
    share : float
        Weight of each of these.

    [Statues] Eq. 13
    """

    A: np.ndarray
    y: np.ndarray
    C: csc_array
    z: np.ndarray
    share: float

    def energy(self, x: np.ndarray) -> float:
        """At vertices x (N, 3), square metres."""
        return (float(np.einsum("ni,nij,nj->", x - self.y, self.A, x - self.y))
                + self.cover(x))

    def cover(self, x: np.ndarray) -> float:
        """The part of the points that draw the mesh."""
        return self.share * float(((self.C @ x - self.z) ** 2).sum())

    def force(self, x: np.ndarray) -> np.ndarray:
        """(N, 3) minus half the gradient."""
        return np.einsum("nij,nj->ni", self.A, self.y - x) + self.share * (self.C.T @ (self.z - self.C @ x))

    def applied(self, d: np.ndarray) -> np.ndarray:
        """(N, 3) half the second derivative, applied to d (N, 3)."""
        return np.einsum("nij,nj->ni", self.A, d) + self.share * (self.C.T @ (self.C @ d))

    @property
    def bound(self) -> csc_array:
        """(N, N) the same for each coordinate, at least as stiff."""
        return csc_array(diags_array(np.linalg.eigvalsh(self.A)[:, 2]) + self.share * (self.C.T @ self.C))


def scan_target(scan: Mesh) -> Target:
    """Points with smooth normals; the borders are those of the mesh, for tips of limbs look one-sided as well."""
    border = np.zeros(len(scan.vertices), dtype=bool)
    border[scan.boundary_vertices] = True
    border |= scan.vertex_adjacency @ border.astype(float) > 0       # the nearest point may lie one step farther in
    return replace(target_of(scan, name="scan"), border=border[np.unique(scan.faces)])


def distortion(rest: Mesh, x: np.ndarray) -> float:
    """Root mean square over the area at rest of the logarithm of the stretches of the triangles."""
    def flat(c: np.ndarray) -> np.ndarray:
        e, f = c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]
        length = np.maximum(np.linalg.norm(e, axis=1), 1e-12)
        along = np.einsum("fd,fd->f", e, f) / length
        height = np.linalg.norm(np.cross(e, f), axis=1) / length
        return np.stack([np.stack([length, along], axis=1), np.stack([np.zeros_like(length), height], axis=1)], axis=1)

    s = np.linalg.svd(flat(x[rest.faces]) @ np.linalg.inv(flat(rest.corners)), compute_uv=False)
    stretch = (np.log(np.maximum(s, 1e-6)) ** 2).mean(axis=1)
    return float(np.sqrt(np.average(stretch, weights=rest.face_areas)))
