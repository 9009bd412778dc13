"""Measure how every triangle has rotated and stretched, smooth that field, and build the system that follows it."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.sparse import Factored


@dataclass(frozen=True, eq=False)
class Field:
    """The rotation R and the stretch S (F, 3, 3) of every triangle, and the logarithm of S; its gradient is `R S`.

    S is symmetric, in the template's axes; along the normal it is the mean stretch within the triangle.
    """

    R: np.ndarray
    S: np.ndarray
    log_S: np.ndarray  # noqa: N815 -- the symbol of the text

    @cached_property
    def gradient(self) -> np.ndarray:
        """The deformation gradient R S (F, 3, 3) of every triangle."""
        return self.R @ self.S


@lru_cache(maxsize=4)                # a folder of scans shares one template
def gradient_operator(template: Mesh) -> GradientOperator:
    """Return the gradient operator of a template, cached."""
    return GradientOperator(template)


class GradientOperator:
    """The gradient operator of a template: measures deformation gradients and builds systems for wanted ones."""

    def __init__(self, template: Mesh) -> None:
        c, faces = template.corners, template.faces
        self.mesh = template
        self.areas = np.maximum(template.face_areas, 1e-3 * template.face_areas.mean())
        n = template.face_normals
        # gradients of the linear hat functions of the corners; and an orthonormal frame: edge, in plane, normal
        e = np.stack([c[:, 2] - c[:, 1], c[:, 0] - c[:, 2], c[:, 1] - c[:, 0]], axis=1)
        self.hats = np.cross(n[:, None], e) / (2 * self.areas)[:, None, None]
        u = e[:, 2] / np.maximum(np.linalg.norm(e[:, 2], axis=1, keepdims=True), 1e-300)
        self.frames = np.stack([u, np.cross(n, u), n], axis=1)
        # a vertex collects a third of each of its triangles
        self._collect = csc_array(coo_array((np.full(faces.size, 1 / 3), (faces.ravel(), np.arange(faces.size) // 3)),
                                            shape=(len(template.vertices), len(faces))))
        self._smoothing: dict[float, Factored] = {}

    def measure(self, x: np.ndarray) -> Field:
        """Measure the rotation and stretch of every triangle of vertices (N, 3), by polar decomposition."""
        flat = np.matmul(x[self.mesh.faces].transpose(0, 2, 1), self._hats_in_plane)
        # in the plane F = R U with U = √(FᵀF), in closed form for 2 × 2 matrices
        C = np.matmul(flat.transpose(0, 2, 1), flat)
        area = np.sqrt(np.maximum(C[:, 0, 0] * C[:, 1, 1] - C[:, 0, 1] ** 2, 1e-12))
        trace = np.sqrt(C[:, 0, 0] + C[:, 1, 1] + 2 * area)
        U = (C + area[:, None, None] * np.eye(2)) / trace[:, None, None]
        inverse = (np.eye(2) * trace[:, None, None] - U) / area[:, None, None]
        # third axis: the normal stays the normal, stretched by the mean stretch in the plane
        rotated = np.empty((len(U), 3, 3))
        rotated[:, :, :2] = flat @ inverse
        rotated[:, :, 2] = self.mesh.with_vertices(x).face_normals
        full, logarithm = np.zeros((2, len(U), 3, 3))
        full[:, :2, :2], full[:, 2, 2] = U, np.sqrt(area)
        logarithm[:, :2, :2], logarithm[:, 2, 2] = _log_in_plane(U), 0.5 * np.log(area)
        # from the frame of each triangle back to the template's axes
        B = self.frames
        back = B.transpose(0, 2, 1)
        return Field(rotated @ B, back @ full @ B, back @ logarithm @ B)

    def smooth(self, field: Field, length: float, weights: np.ndarray) -> Field:
        """Smooth a field over `length` (metres), with triangles weighted by (F,).

        Values times weights, and the weights themselves, are diffused; their quotient is a local weighted mean.
        """
        w = np.maximum(weights, 1e-6) * self.areas
        entries = np.concatenate([field.R.reshape(-1, 9), field.log_S.reshape(-1, 9), np.ones((len(w), 1))], axis=1)
        # 18 columns: nine of R, nine of log S; the last column holds the weights
        spread = self._smoother(length).solve(self._collect @ (w[:, None] * entries))
        of_faces = (spread[:, :18] / spread[:, 18:])[self.mesh.faces].mean(axis=1)
        logarithm = of_faces[:, 9:].reshape(-1, 3, 3)
        return Field(rotations.project(of_faces[:, :9].reshape(-1, 3, 3)), _exp_symmetric(logarithm), logarithm)

    def _smoother(self, length: float) -> Factored:
        """Return the factored diffusion matrix of a length; it does not depend on the weights, so it is cached."""
        if length not in self._smoothing:
            mass = self._collect @ self.areas
            self._smoothing[length] = Factored(csc_array(diags_array(mass) + length**2 * self.stiffness(self.areas)))
        return self._smoothing[length]

    @cached_property
    def _hats_in_plane(self) -> np.ndarray:
        """Gradients (F, 3, 2) of the hat functions in the triangle's own frame."""
        return np.matmul(self.hats, self.frames[:, :2].transpose(0, 2, 1))

    def stiffness(self, weights: np.ndarray) -> csc_array:
        """Build the stiffness matrix K (N, N) with `x·Kx = Σ w |∇x|²` for weights (F,), square metres."""
        faces, N = self.mesh.faces, len(self.mesh.vertices)
        local = weights[:, None, None] * np.matmul(self.hats, self.hats.transpose(0, 2, 1))
        rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, (1, 3)).ravel()
        return csc_array(coo_array((local.ravel(), (rows, columns)), shape=(N, N)))

    def force(self, weights: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Build the right-hand side (N, 3) for wanted gradients (F, 3, 3) with weights (F,), square metres."""
        local = weights[:, None, None] * np.matmul(self.hats, gradient.transpose(0, 2, 1))
        out = np.empty((len(self.mesh.vertices), 3))
        for d in range(3):
            out[:, d] = np.bincount(self.mesh.faces.ravel(), local[:, :, d].ravel(), len(out))
        return out


def _log_in_plane(U: np.ndarray) -> np.ndarray:
    """Compute logarithms (n, 2, 2) of symmetric positive matrices, by their eigenvalues m ± d."""
    m, half = 0.5 * (U[:, 0, 0] + U[:, 1, 1]), 0.5 * (U[:, 0, 0] - U[:, 1, 1])
    d = np.hypot(half, U[:, 0, 1])
    low, high = np.log(np.maximum(m - d, 1e-3)), np.log(np.maximum(m + d, 1e-3))
    slope = np.where(d > 1e-9 * m, 0.5 * (high - low) / np.maximum(d, 1e-300), 1 / m)
    return slope[:, None, None] * U + (0.5 * (low + high) - slope * m)[:, None, None] * np.eye(2)


def _exp_symmetric(E: np.ndarray) -> np.ndarray:
    """Compute exponentials (n, 3, 3) of symmetric matrices."""
    values, vectors = np.linalg.eigh(0.5 * (E + E.transpose(0, 2, 1)))
    return (vectors * np.exp(values)[:, None]) @ vectors.transpose(0, 2, 1)
