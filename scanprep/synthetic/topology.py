"""The topology that all people share, and how it is carried onto another body."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array, diags_array

from ..geometry import storage
from ..geometry.mesh import Mesh
from ..geometry.sparse import factor
from ..skeleton.tree import Skeleton
from .anatomy import PARENTS, Anatomy, BodyShape
from .body_parts import body_surface
from .implicit_surface import Field, project, value_and_gradient

STORED = Path(__file__).with_name("topology.npz")         # made by tests/people_maker.py
CANONICAL = BodyShape(sex=0.0, stature=1.69)
VERSION = 1


@dataclass(frozen=True, eq=False)
class Template:
    """The shared triangulation on the canonical body."""

    mesh: Mesh
    mirror: np.ndarray  # (N,) int: the vertex at the mirrored place
    part_of_face: np.ndarray  # (F,) int
    anatomy: Anatomy  # anatomy of the canonical body

    @cached_property
    def part_of_vertex(self) -> np.ndarray:
        """(N,) the part of most triangles around each vertex."""
        return Skeleton(self.part_of_face, PARENTS, self.anatomy.joints).part_of_vertex(self.mesh)


@lru_cache(maxsize=1)
def load() -> Template:
    """The stored template."""
    _, arrays = storage.load(STORED, "people template", (VERSION,))
    anatomy = Anatomy(CANONICAL)
    vertices = arrays["vertices"] / 1e5
    mirror = arrays["mirror"].astype(np.int64)
    vertices = project(body_surface(anatomy), vertices, 2)
    vertices = 0.5 * (vertices + vertices[mirror] * [-1, 1, 1])
    mesh = Mesh(vertices, arrays["faces"].astype(np.int64))
    return Template(mesh, mirror, arrays["part_of_face"].astype(np.int64), anatomy)


@lru_cache(maxsize=1)
def blending() -> tuple[np.ndarray, np.ndarray]:
    """Smooth part weights (N, 16) on the shared topology: for carrying, and for posing."""
    template = load()
    mesh = template.mesh
    n = len(mesh.vertices)
    share = np.zeros((n, len(PARENTS)))
    for corner in range(3):
        np.add.at(share, (mesh.faces[:, corner], template.part_of_face), mesh.face_areas / 3)
    share /= share.sum(axis=1, keepdims=True)
    a, b = mesh.edges.T
    # over how many metres (N,) the motion of one part passes into that of the next
    wide = {1: 0.075, 2: 0.075, 3: 0.040, 4: 0.052, 5: 0.030, 6: 0.020, 10: 0.060, 11: 0.034, 12: 0.020}
    v = np.abs(template.mesh.vertices * [1, 0, 0]) + template.mesh.vertices * [0, 1, 1]
    d = np.stack([np.linalg.norm(v - template.anatomy.joints[j], axis=1) for j in wide], axis=1)
    near = np.exp(-0.5 * ((d - d.min(axis=1, keepdims=True)) / 0.04)**2)
    width = near @ np.array(list(wide.values())) / near.sum(axis=1)
    results = []
    for spread in (1.3, 1.0):
        w = (spread * 0.5 * (width[a] + width[b]) / mesh.edge_lengths)**2 / 6
        A = csr_array((np.r_[w, w], (np.r_[a, b], np.r_[b, a])), shape=(n, n))
        solve = factor((diags_array(1 + A.sum(axis=1)) - A).tocsc())
        weights = solve(solve(share))
        results.append(weights / weights.sum(axis=1, keepdims=True))
    return results[0], results[1]


@lru_cache(maxsize=1)
def neighbour_mean() -> csr_array:
    """(N, N) the mean of a vertex's neighbours."""
    A = load().mesh.vertex_adjacency
    return csr_array(diags_array(1 / A.sum(axis=1)) @ A)


def frames(anatomy: Anatomy) -> np.ndarray:
    """(16, 3, 3) affine frames of the bones: columns across (2) and along, lengths included."""
    g = anatomy.scale
    out = np.zeros((16, 3, 3))
    along = anatomy.ends - anatomy.joints
    for p in range(16):
        z = along[p]
        front = np.array([0, -1.0, 0]) if p not in (12, 15) else np.array([0, 0, 1.0])
        length = np.linalg.norm(z)
        y = front - (front @ z) * z / length**2
        y /= np.linalg.norm(y)
        x = np.cross(y, z / length)
        thick = anatomy.head_scale if p == 3 else anatomy.width["hand"] / 0.19 if p in (6, 9) else \
            anatomy.width["foot"] / 0.26 if p in (12, 15) else g
        if p in (0, 1, 2):
            thick = anatomy.joints[4, 0] / 0.176
        out[p] = np.stack([x * thick, y * thick, z], axis=1)
    return out


def carry(shape: BodyShape, stages: int = 3) -> tuple[np.ndarray, Anatomy]:
    """The template's vertices (N, 3) on the body of another shape, metres, and that body's anatomy.

    Moved with the skeleton, projected on the implicit surface and evened out in it, in a few stages from
    the canonical body to the wanted one.
    """
    template = load()
    weights, _ = blending()
    at, goal = CANONICAL.array(), shape.array()
    before, vertices = template.anatomy, template.mesh.vertices
    x0 = template.mesh.vertices
    mean = neighbour_mean()
    offset = x0 - mean @ x0
    for stage in range(1, stages + 1):
        now = Anatomy(BodyShape.from_array(at + (goal - at) * stage / stages))
        field = body_surface(now)
        change = frames(now) @ np.linalg.inv(frames(before))
        shift = now.joints - np.einsum("pij,pj->pi", change, before.joints)
        blend = np.einsum("np,pij->nij", weights, change)
        vertices = np.einsum("nij,nj->ni", blend, vertices) + weights @ shift
        total = frames(now) @ np.linalg.inv(frames(template.anatomy))
        wanted = np.einsum("np,pij,nj->ni", weights, total, offset)
        gradient = None
        for _ in range(2):
            vertices, gradient = _relax(field, vertices, wanted, gradient)
        before = now
    value, gradient = _symmetric(field, vertices)
    step = np.clip(value / np.maximum((gradient**2).sum(axis=1), 0.1), -0.005, 0.005)
    vertices = vertices - step[:, None] * gradient
    return 0.5 * (vertices + vertices[template.mirror] * [-1, 1, 1]), now


def _symmetric(field: Field, vertices: np.ndarray, gradient: np.ndarray | None = None
               ) -> tuple[np.ndarray, np.ndarray]:
    """Field (N,) and gradient (N, 3), worked out on the left half; a known gradient is kept."""
    twin = load().mirror
    left = np.flatnonzero(load().mesh.vertices[:, 0] >= -1e-9)
    value = np.empty(len(vertices))
    if gradient is None:
        gradient = np.empty_like(vertices)
        value[left], gradient[left] = value_and_gradient(field, vertices[left])
        gradient[twin[left]] = gradient[left] * [-1, 1, 1]
    else:
        value[left] = field(vertices[left])
    value[twin[left]] = value[left]
    return value, gradient


def _relax(field: Field, vertices: np.ndarray, wanted: np.ndarray, gradient: np.ndarray | None
            ) -> tuple[np.ndarray, np.ndarray]:
    """One Newton step onto the surface, then tangential steps towards the canonical neighbourhoods."""
    value, gradient = _symmetric(field, vertices, gradient)
    length = np.sqrt(np.maximum((gradient**2).sum(axis=1), 0.05))
    normal = gradient / length[:, None]
    vertices = vertices - np.clip(value / length, -0.03, 0.03)[:, None] * normal
    mean = neighbour_mean()
    for _ in range(6):
        step = mean @ vertices + wanted - vertices
        step -= np.einsum("nd,nd->n", step, normal)[:, None] * normal
        vertices = vertices + 0.5 * step
    return vertices, gradient
