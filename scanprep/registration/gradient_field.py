"""How a template rotates and stretches from place to place: measured, smoothed, and laid out again."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csc_array, diags_array

from ..geometry import rotations
from ..geometry.mesh import Mesh
from ..geometry.sparse import Factored


@dataclass(frozen=True, eq=False)
class Field:
    """The rotation R and the stretch S (F, 3, 3) of every triangle; its gradient is `R S`.

    S is symmetric, in the template's axes; along the normal it is the mean stretch within the triangle.
    """

    R: np.ndarray
    S: np.ndarray

    @property
    def gradient(self) -> np.ndarray:
        """(F, 3, 3)"""
        return self.R @ self.S


class Triangles:
    """The triangles of a template at rest, ready to measure gradients and to lay wanted ones out."""

    def __init__(self, template: Mesh) -> None:
        c = template.corners
        self.mesh = template
        self.areas = np.maximum(template.face_areas, 1e-3 * template.face_areas.mean())
        n = template.face_normals
        e = np.stack([c[:, 2] - c[:, 1], c[:, 0] - c[:, 2], c[:, 1] - c[:, 0]], axis=1)
        self.hats = np.cross(n[:, None], e) / (2 * self.areas)[:, None, None]
        u = e[:, 2] / np.maximum(np.linalg.norm(e[:, 2], axis=1, keepdims=True), 1e-300)
        self.frames = np.stack([u, np.cross(n, u), n], axis=1)
        self._stiffness = self.stiffness(self.areas)

    def measured(self, x: np.ndarray) -> Field:
        """The rotations and stretches of vertices (N, 3)."""
        flat = np.einsum("fad,fae,fke->fdk", x[self.mesh.faces], self.hats, self.frames[:, :2], optimize=True)
        C = np.matmul(flat.transpose(0, 2, 1), flat)
        area = np.sqrt(np.maximum(C[:, 0, 0] * C[:, 1, 1] - C[:, 0, 1] ** 2, 1e-12))
        trace = np.sqrt(C[:, 0, 0] + C[:, 1, 1] + 2 * area)
        U = (C + area[:, None, None] * np.eye(2)) / trace[:, None, None]
        inverse = (np.eye(2) * np.einsum("fii->f", U)[:, None, None] - U) / area[:, None, None]
        rotated = np.empty((len(U), 3, 3))
        rotated[:, :, :2] = flat @ inverse
        rotated[:, :, 2] = self.mesh.with_vertices(x).face_normals
        full = np.zeros((len(U), 3, 3))
        full[:, :2, :2], full[:, 2, 2] = U, np.sqrt(area)
        B = self.frames
        return Field(rotated @ B, B.transpose(0, 2, 1) @ full @ B)

    def smoothed(self, field: Field, length: float, weights: np.ndarray) -> Field:
        """The field that varies little over `length` (metres), where triangles count by weights (F,)."""
        w = np.maximum(weights, 1e-6) * self.areas
        entries = np.concatenate([field.R.reshape(-1, 9), _log_symmetric(field.S).reshape(-1, 9)], axis=1)
        faces, N = self.mesh.faces, len(self.mesh.vertices)
        mass = np.bincount(faces.ravel(), np.repeat(w / 3, 3), N)
        collect = csc_array(coo_array((np.repeat(w / 3, 3), (faces.ravel(), np.repeat(np.arange(len(faces)), 3))),
                                      shape=(N, len(faces))))
        even = Factored(csc_array(diags_array(mass) + length**2 * self._stiffness)).solve(collect @ entries)
        of_faces = even[faces].mean(axis=1)
        return Field(rotations.project(of_faces[:, :9].reshape(-1, 3, 3)),
                     _exp_symmetric(of_faces[:, 9:].reshape(-1, 3, 3)))

    def stiffness(self, weights: np.ndarray) -> csc_array:
        """(N, N) with `x·Kx = Σ w |∇x|²` for weights (F,), square metres."""
        faces, N = self.mesh.faces, len(self.mesh.vertices)
        local = weights[:, None, None] * np.matmul(self.hats, self.hats.transpose(0, 2, 1))
        rows, columns = np.repeat(faces, 3, axis=1).ravel(), np.tile(faces, (1, 3)).ravel()
        return csc_array(coo_array((local.ravel(), (rows, columns)), shape=(N, N)))

    def force(self, weights: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """(N, 3) right-hand side that asks for gradients (F, 3, 3) with weights (F,)."""
        local = weights[:, None, None] * np.matmul(self.hats, gradient.transpose(0, 2, 1))
        out = np.empty((len(self.mesh.vertices), 3))
        for d in range(3):
            out[:, d] = np.bincount(self.mesh.faces.ravel(), local[:, :, d].ravel(), len(out))
        return out


def _log_symmetric(S: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(S)
    return (vectors * np.log(np.maximum(values, 1e-3))[:, None]) @ vectors.transpose(0, 2, 1)


def _exp_symmetric(E: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(0.5 * (E + E.transpose(0, 2, 1)))
    return (vectors * np.exp(values)[:, None]) @ vectors.transpose(0, 2, 1)
