"""Holes closed by a fair patch [Liepa]."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh, template_problem
from ..geometry.sparse import factor
from .remesh import clamped_cotangents, flip_edges
from .repair import repair, split_vertices
from .triangulate import triangulate_loop

RIM_BEND, PATCH_BEND = 2.0, 4.0      # bends, in curvature times radius of the hole, that count less than squared
REWEIGHTINGS = 3
METHODS = ("fair", "poisson-open3d", "poisson-pymeshlab")


@dataclass(frozen=True)
class FillConfig:
    """Settings of `fill_holes`.

    Attributes
    ----------
    method : "fair" for our own patch, "poisson-open3d" or "poisson-pymeshlab"
        Screened Poisson reconstruction remeshes everything and needs the named library.
    max_edges : int, optional
        Longer borders stay open.
    density : float
        Size of the new triangles relative to those around the hole: larger means finer.
    fair_rounds : int
        Alternations of turning edges and solving for the fair shape.
    exact_edges : int
        Longest loop whose triangulation is found by dynamic programming as a whole.
    poisson_depth : int
        Octree depth of the Poisson methods.
    """

    method: Literal["fair", "poisson-open3d", "poisson-pymeshlab"] = "fair"
    max_edges: int | None = None
    density: float = 2 ** 0.5
    fair_rounds: int = 0
    exact_edges: int = 300
    poisson_depth: int = 8


def fill_holes(mesh: Mesh, config: FillConfig | None = None,
               progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Close the holes of a mesh.

    Each border loop gets the triangulation that bends least, is refined to the size of the triangles around it,
    and faired so that it leaves the hole's rim smoothly.

    Parameters
    ----------
    mesh : Mesh
        Edge-manifold; borders may touch in a vertex (see `repair`).
    config : FillConfig, optional
    progress : callback(done, total), optional

    Returns
    -------
    Mesh
        With the method "fair", the vertices and triangles of `mesh` come first, untouched. Vertices where
        separate sheets touch are doubled.

    Raises
    ------
    ValueError
        The mesh is empty or not manifold along its edges, or the method is unknown.

    [Liepa] triangulation, refinement, fairing
    """
    config = config or FillConfig()
    if not len(mesh.faces):
        raise ValueError("mesh: expected a surface with holes, got one without triangles")
    if config.method not in METHODS:
        raise ValueError(f"config.method: expected one of {', '.join(METHODS)}, got {config.method!r}")
    if config.method == "poisson-open3d":
        from .open3d_filters import poisson

        return close(poisson(mesh, config.poisson_depth))
    if config.method == "poisson-pymeshlab":
        from .pymeshlab_filters import poisson

        return close(poisson(mesh, config.poisson_depth))
    if not mesh.is_edge_manifold:
        raise ValueError("mesh: expected at most two triangles at an edge, facing the same way; repair it first")
    mesh = split_vertices(mesh, across_holes=True)
    loops = [loop for loop in mesh.boundary_loops if len(loop) <= (config.max_edges or len(mesh.vertices))]
    if not loops:
        return split_vertices(mesh)
    rim = np.zeros(len(mesh.vertices), dtype=bool)
    rim[np.concatenate(loops)] = True
    around, used = mesh.submesh(rim[mesh.faces].any(axis=1))      # all that the patches have to know
    patch = _Patch(around, rim[used])
    local = np.full(len(mesh.vertices), -1)
    local[used] = np.arange(len(used))
    patch.triangulate([local[loop] for loop in loops], config.exact_edges, progress)
    patch.refine(config.density)
    for _ in range(config.fair_rounds):
        patch.fair()
        patch.flip(min_cosine=0.3)
    patch.fair()
    patch.flip(min_cosine=0.3)
    return split_vertices(patch.onto(mesh, used))


def close(mesh: Mesh, config: FillConfig | None = None, rounds: int = 4) -> Mesh:
    """Repair and fill in turns, until nothing is open or defective.

    Parameters
    ----------
    mesh : Mesh
    config : FillConfig, optional
        Of the first filling; what repair opens afterwards is filled with fair patches.
    rounds : int

    Returns
    -------
    Mesh
        One closed manifold component, unless `rounds` do not suffice.
    """
    mesh = fill_holes(repair(mesh), config)
    for _ in range(rounds):
        if mesh.is_closed and template_problem(mesh) is None:
            break
        mesh = fill_holes(repair(mesh))
    return mesh


class _Patch:
    """New triangles and vertices, and the triangles `around` the holes, which stay.

    Parameters
    ----------
    around : Mesh
        All triangles that touch a rim.
    rim : (n,) bool
        Its vertices on the borders to close.
    """

    def __init__(self, around: Mesh, rim: np.ndarray) -> None:
        self.mesh, self.rim = around, rim
        self.old_vertices, self.old_faces = len(around.vertices), len(around.faces)

    @property
    def _new(self) -> np.ndarray:
        return np.arange(len(self.mesh.faces)) >= self.old_faces

    def triangulate(self, loops: list[np.ndarray], largest: int,
                    progress: Callable[[int, int], None] | None) -> None:
        """Triangles between the existing vertices only, or a fan about a new one where that is impossible."""
        around = self.mesh
        normal_of = _border_normals(around)
        adjacency = around.vertex_adjacency
        triangles, extra = [around.faces], [around.vertices]
        shared = np.bincount(np.concatenate(loops), minlength=len(around.vertices)) > 1
        chords: list[np.ndarray] = []                     # new edges between vertices where loops touch
        for done, loop in enumerate(loops):
            ring = loop[::-1]                             # the new triangles run the other way along the border
            ahead = np.roll(ring, -1)
            rim_normals = np.array([normal_of[int(b), int(a)] for a, b in zip(ring, ahead, strict=True)])
            joined = adjacency[ring][:, ring].toarray() > 0
            if chords and shared[ring].sum() > 1:
                place = {int(v): i for i, v in enumerate(ring)}
                for a, b in np.concatenate(chords).tolist():
                    if a in place and b in place:
                        joined[place[a], place[b]] = joined[place[b], place[a]] = True
            found = triangulate_loop(around.vertices[ring], rim_normals, joined, largest)
            if found is None:
                centre = sum(map(len, extra))
                extra.append(around.vertices[ring].mean(axis=0, keepdims=True))
                triangles.append(np.stack([ring, np.roll(ring, -1), np.full(len(ring), centre)], axis=1))
            else:
                triangles.append(ring[found])
                sides = ring[found[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
                chords += [sides[shared[sides].all(axis=1)]] if shared[ring].sum() > 1 else []
            if progress:
                progress(done + 1, len(loops))
        self.mesh = Mesh(np.concatenate(extra), np.concatenate(triangles))

    def flip(self, min_cosine: float) -> None:
        """Turn edges between new triangles."""
        self.mesh = flip_edges(self.mesh, self._new, rounds=10, min_cosine=min_cosine)

    def refine(self, density: float) -> None:
        """Cut triangles at their centroids until they are as small as those around the hole."""
        size = self._edge_size()
        self.flip(min_cosine=-1)
        for _ in range(25):
            v, faces = self.mesh.vertices, self.mesh.faces[self.old_faces:]
            centre = v[faces].mean(axis=1)
            wanted = size[faces].mean(axis=1)
            apart = density * np.linalg.norm(v[faces] - centre[:, None], axis=2)
            cut = np.flatnonzero(((apart > wanted[:, None]) & (apart > size[faces])).all(axis=1))
            if not len(cut):
                break
            middle = len(v) + np.arange(len(cut))
            a, b, c = faces[cut].T
            faces = np.array(faces)
            faces[cut, 2] = middle
            more = np.concatenate([np.stack([b, c, middle], axis=1), np.stack([c, a, middle], axis=1)])
            self.mesh = Mesh(np.concatenate([v, centre[cut]]),
                             np.concatenate([self.mesh.faces[:self.old_faces], faces, more]))
            size = np.concatenate([size, wanted[cut]])
            self.flip(min_cosine=-1)

    def _edge_size(self) -> np.ndarray:
        """Mean length of the existing edges at every vertex; for a vertex without one, the mean of all."""
        v = self.mesh.vertices
        a, b = self.mesh.faces[:self.old_faces], np.roll(self.mesh.faces[:self.old_faces], 1, axis=1)
        length = np.linalg.norm(v[a] - v[b], axis=2).ravel()
        ends = np.concatenate([a.ravel(), b.ravel()])
        count = np.bincount(ends, minlength=len(v))
        total = np.bincount(ends, np.tile(length, 2), len(v))
        return np.divide(total, count, out=np.full(len(v), length.mean()), where=count > 0)

    def fair(self) -> None:
        """Move the new vertices to where patch and rim bend least.

        The energy is the squared mean curvature, but large curvatures count less than by their square: a patch
        may meet its rim in an edge (soles) or keep a crease (armpits) where being round would take it far away.
        """
        free = np.arange(self.old_vertices, len(self.mesh.vertices))
        if not len(free):
            return
        rim = np.flatnonzero(self.rim)
        rows = np.concatenate([rim, free])
        area = self.mesh.vertex_areas[rows]
        area = np.maximum(area, 0.1 * np.median(area))                 # slivers on a rim must not rule
        laplacian = csr_array(clamped_cotangents(self.mesh)[rows])
        large = np.repeat([RIM_BEND, PATCH_BEND], [len(rim), len(free)]) / self._radii()[rows]
        weight = np.ones(len(rows))
        for _ in range(REWEIGHTINGS + 1):
            b = csr_array(laplacian.multiply(np.sqrt(weight / area)[:, None])).tocsc()
            known = b[:, :self.old_vertices] @ self.mesh.vertices[:self.old_vertices]
            inner = b[:, free]
            vertices = np.array(self.mesh.vertices)
            vertices[free] = factor(inner.T @ inner)(-(inner.T @ known))
            self.mesh = self.mesh.with_vertices(vertices)
            bend = laplacian @ vertices
            outward = np.einsum("nd,nd->n", bend, self.mesh.vertex_normals[rows]) > 0
            curvature = np.linalg.norm(bend, axis=1) / area
            weight = 1 / np.sqrt(1 + (curvature / large) ** 2)
            weight[:len(rim)][~outward[:len(rim)]] = 1                 # a rim may be an edge but not a groove

    def _radii(self) -> np.ndarray:
        """(n,) radius of the disc with the area of the patch that each of its vertices belongs to, metres."""
        new = self.mesh.faces[self.old_faces:]
        patch = Mesh(self.mesh.vertices, new).vertex_component
        area = np.bincount(patch[new[:, 0]], self.mesh.face_areas[self.old_faces:], minlength=patch.max() + 1)
        return np.sqrt(np.maximum(area, 1e-12) / np.pi)[patch]

    def onto(self, mesh: Mesh, used: np.ndarray) -> Mesh:
        """The mesh the patch was made for, with it; `used` are the numbers of the vertices around the holes."""
        new = self.mesh.vertices[self.old_vertices:]
        number = np.concatenate([used, len(mesh.vertices) + np.arange(len(new))])
        faces = np.concatenate([mesh.faces, number[self.mesh.faces[self.old_faces:]]])
        vertices = np.concatenate([mesh.vertices, new])
        if mesh.colors is None:
            return Mesh(vertices, faces)
        nearest = cKDTree(mesh.vertices[mesh.boundary_vertices]).query(new)[1] if len(new) else np.empty(0, int)
        return Mesh(vertices, faces, np.concatenate([mesh.colors, mesh.colors[mesh.boundary_vertices[nearest]]]))


def _border_normals(mesh: Mesh) -> dict[tuple[int, int], np.ndarray]:
    """The normal of the triangle at every border edge, by the edge's direction in it."""
    face, side = np.nonzero(mesh.edge_use[mesh.face_edges] == 1)
    a, b = mesh.faces[face, side], mesh.faces[face, (side + 1) % 3]
    return {(int(p), int(q)): normal for p, q, normal in zip(a, b, mesh.face_normals[face], strict=True)}
