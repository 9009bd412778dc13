"""Local shape of a triangle mesh: the coordinates of every vertex in the frames of the triangles around it.

The frame of a triangle is made of the three vertices opposite across its sides. Heights are multiples of √(2 · area) of
the frame, so the shape is invariant under similarities. Triangles at a border have no frame. Frames flatter than 0.05
of their longest side, or with a barycentric coordinate above 4, are ill-conditioned and left out.

[Statues] section 4.1
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from scanprep.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class LocalShape:
    """The rest shape of a mesh in the frames of its triangles; R rows, each a vertex in a frame. [Statues] Eq. 10"""

    count: int            # vertices of the mesh, N
    held: np.ndarray      # (R,), the vertex
    corners: np.ndarray   # (R, 3), vertices of the frame
    bary: np.ndarray      # (R, 3), its barycentric coordinates 1 - α - β, α, β in the plane of the frame
    heights: np.ndarray   # (R,), its height h over that plane, in multiples of √(2 · area) of the frame
    smallest: np.ndarray  # (R,) square metres, least double area that a frame counts as

    @cached_property
    def weights(self) -> np.ndarray:
        """(R,) 1 / N_i of the vertex of each row, N_i the number of frames that hold it."""
        return 1 / np.bincount(self.held, minlength=self.count)[self.held]

    @cached_property
    def plane(self) -> csr_array:
        """(R, N) sparse: x_i minus its foot in the plane of the frame, from vertices."""
        R = len(self.held)
        rows = np.tile(np.arange(R), 4)
        columns = np.concatenate([self.held, *self.corners.T])
        return csr_array((np.concatenate([np.ones(R), *-self.bary.T]), (rows, columns)), shape=(R, self.count))

    def height_offsets(self, x: np.ndarray) -> np.ndarray:
        """Compute the offsets (R, 3) of heights from their feet, on vertices (N, 3)."""
        _, _, c, size = self._frames(x)
        return (self.heights / np.sqrt(size))[:, None] * c

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """Compute the residuals (R, 3) x_i - x(α, β, h), metres."""
        return self.plane @ x - self.height_offsets(x)

    def energy(self, x: np.ndarray) -> float:
        """Compute S(x) of vertices (N, 3), square metres: 0 for similar copies of the rest shape. [Statues] Eq. 10"""
        return float(self.weights @ (self.residuals(x) ** 2).sum(axis=1))

    def paper_force(self, x: np.ndarray) -> np.ndarray:
        """Compute the paper's force (N, 3): the mean over frames of the shift that restores each vertex.

        Frames are held, so it is not the gradient of Eq. 10: a vertex also moves the frames of which it is a corner.

        [Statues] Eq. 12
        """
        return -self._sum_rows(self.held, self.weights[:, None] * self.residuals(x))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Compute the exact gradient (N, 3) of `energy`, including the effect of a vertex on the frames of others."""
        return 2 * self.apply_transpose(x, self.weights[:, None] * self.residuals(x))

    def apply_transpose(self, x: np.ndarray, r: np.ndarray) -> np.ndarray:
        """Apply the transposed derivative of the residuals at vertices x (N, 3) to rows r (R, 3)."""
        e, f, c, size = self._frames(x)
        q = self._apply_curvature(c, size, r)
        to_1, to_2 = np.cross(f, q), np.cross(q, e)
        rows = np.concatenate([to_1 + to_2, -to_1, -to_2])
        return self.plane.T @ r + self._sum_rows(self.corners.T.ravel(), rows)

    def derivative(self, x: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Compute the change (R, 3) of the residuals at vertices x (N, 3) for moves d (N, 3)."""
        e, f, c, size = self._frames(x)
        d0, d1, d2 = (d[corner] for corner in self.corners.T)
        return self.plane @ d - self._apply_curvature(c, size, np.cross(d1 - d0, f) + np.cross(e, d2 - d0))

    def _frames(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Compute two sides of every frame, their cross product and the double area."""
        p0, p1, p2 = (x[corner] for corner in self.corners.T)
        e, f = p1 - p0, p2 - p0
        c = np.cross(e, f)
        return e, f, c, np.maximum(np.linalg.norm(c, axis=1), self.smallest)

    def _apply_curvature(self, c: np.ndarray, size: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Apply the (symmetric) derivative of h c / √|c| by c to v (R, 3)."""
        along = np.where(size > self.smallest, np.einsum("rd,rd->r", c, v) / (2 * size**2), 0.0)
        return (self.heights / np.sqrt(size))[:, None] * (v - along[:, None] * c)

    def _sum_rows(self, vertex: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(vertex, column, self.count) for column in rows.T], axis=1)


def local_shape(rest: Mesh) -> LocalShape:
    """Compute the local shape of an edge-manifold mesh at rest. [Statues] section 4.1"""
    if not rest.is_edge_manifold:
        raise ValueError(f"rest: expected every edge between two triangles that agree on the outside, got {rest}")
    x, whole = rest.vertices, np.flatnonzero((rest.edge_use[rest.face_edges] == 2).all(axis=1))
    # the two triangles at an edge have four corners, whose sum gives the vertex opposite across it
    totals = np.bincount(rest.face_edges.ravel(), np.repeat(rest.faces.sum(axis=1), 3), len(rest.edges)).astype(int)
    face = rest.faces[whole]
    both = face + np.roll(face, -1, axis=1)
    frames = totals[rest.face_edges[whole]] - 2 * both - np.roll(face, -2, axis=1)
    p = x[frames]
    c = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    size = np.linalg.norm(c, axis=1)
    longest = ((p - np.roll(p, 1, axis=1)) ** 2).sum(axis=2).max(axis=1)
    safe = size > 0.05 * longest
    corners, c, size, held = (np.repeat(a[safe], 3, axis=0) for a in (frames, c, size, face))
    held = face[safe].ravel()
    # coordinates of each vertex in its frame; frames with a vertex far outside are left out
    w = x[held] - x[corners[:, 0]]
    e, f = x[corners[:, 1]] - x[corners[:, 0]], x[corners[:, 2]] - x[corners[:, 0]]
    alpha = np.einsum("rd,rd->r", np.cross(w, f), c) / size**2
    beta = np.einsum("rd,rd->r", np.cross(e, w), c) / size**2
    bary = np.stack([1 - alpha - beta, alpha, beta], axis=1)
    near = np.repeat((np.abs(bary) <= 4.0).all(axis=1).reshape(-1, 3).all(axis=1), 3)
    if not near.any():
        raise ValueError(f"rest: expected triangles with neighbours across all three sides, got {rest} without")
    heights = np.einsum("rd,rd->r", w, c) / size**1.5
    return LocalShape(len(x), held[near], corners[near], bary[near], heights[near], 1e-6 * size[near])
