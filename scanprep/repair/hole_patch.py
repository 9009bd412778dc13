"""Make, refine and fair the new triangles across holes [Liepa]."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.remeshing import clamp_cotangents, flip_edges, mean_of_neighbours
from ..geometry.sparse import factor
from ..geometry.surface import Rays
from .intersections import intersecting_faces
from .loops import triangulate_loop


class Patch:
    """New triangles and vertices, with the fixed triangles `around` the holes: all that touch a rim (n,) bool."""

    def __init__(self, around: Mesh, rim: np.ndarray) -> None:
        self.mesh, self.rim = around, rim
        self.old_vertices, self.old_faces = len(around.vertices), len(around.faces)

    @property
    def _new(self) -> np.ndarray:
        """(F,) bool: new triangles."""
        return np.arange(len(self.mesh.faces)) >= self.old_faces

    def triangulate(self, loops: list[np.ndarray], rays: Rays, progress: Callable[[int, int], None] | None) -> None:
        """Triangulate the holes with existing vertices, or as a fan around a new one where that is impossible.

        Loops (n,) run in the direction of the existing triangles' sides. A polygon contains a vertex twice where two
        borders are joined by a cut. `rays` are of the existing surface, which new triangles should not intersect.
        """
        around = self.mesh
        normal_of = _border_normals(around)
        adjacency = around.vertex_adjacency
        triangles, extra = [around.faces], [around.vertices]
        shared = np.bincount(np.concatenate([np.unique(loop) for loop in loops]), minlength=len(around.vertices)) > 1
        chords: list[np.ndarray] = []                     # new edges between vertices of several loops
        for done, loop in enumerate(loops):
            ring = loop[::-1]                             # the new triangles run the other way along the border
            ahead = np.roll(ring, -1)
            rim_normals = np.array([normal_of.get((int(b), int(a)), np.zeros(3))
                                    for a, b in zip(ring, ahead, strict=True)])
            # pairs of vertices that have an edge already must not get another one
            joined = (adjacency[ring][:, ring].toarray() > 0) | (ring[:, None] == ring)
            if chords and shared[ring].sum() > 1:
                place = {int(v): i for i, v in enumerate(ring)}
                for a, b in np.concatenate(chords).tolist():
                    if a in place and b in place:
                        joined[place[a], place[b]] = joined[place[b], place[a]] = True
            inner = _clear_triangles(around, ring, rim_normals, joined, rays)
            if inner is None:
                centre = sum(map(len, extra))
                extra.append(around.vertices[ring].mean(axis=0, keepdims=True))
                triangles.append(np.stack([ring, np.roll(ring, -1), np.full(len(ring), centre)], axis=1))
            else:
                triangles.append(ring[inner])
                sides = ring[inner[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
                chords += [sides[shared[sides].all(axis=1)]] if shared[ring].sum() > 1 else []
            if progress:
                progress(done + 1, len(loops))
        self.mesh = Mesh(np.concatenate(extra), np.concatenate(triangles))

    def _flip(self) -> None:
        """Flip new edges towards a Delaunay triangulation."""
        self.mesh = flip_edges(self.mesh, self._new, rounds=10, min_cosine=-1)

    def refine(self) -> None:
        """Split triangles at their centroids until they are as small as those around the hole [Liepa]."""
        density = 2 ** 0.5                                             # of [Liepa]: larger means finer
        size = self._edge_size()
        self._flip()
        for _ in range(25):
            v, faces = self.mesh.vertices, self.mesh.faces[self.old_faces:]
            # split where the centroid is farther from all corners than the local edge size, divided by the density
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
            self._flip()

    def _edge_size(self) -> np.ndarray:
        """Return the mean length of existing edges at every vertex (n,), or of all edges for a new vertex."""
        v = self.mesh.vertices
        a, b = self.mesh.faces[:self.old_faces], np.roll(self.mesh.faces[:self.old_faces], 1, axis=1)
        length = np.linalg.norm(v[a] - v[b], axis=2).ravel()
        ends = np.concatenate([a.ravel(), b.ravel()])
        count = np.bincount(ends, minlength=len(v))
        total = np.bincount(ends, np.tile(length, 2), len(v))
        return np.divide(total, count, out=np.full(len(v), length.mean()), where=count > 0)

    def fair(self, targets: np.ndarray | None = None, strength: float = 0.0) -> None:
        """Move the new vertices to where patch and rim bend least.

        The energy is the squared mean curvature, with robust weights for large curvatures. So a patch may meet its rim
        in an edge (soles) or keep a crease (armpits) where a round patch would be far off. Targets (f, 3) pull the new
        vertices; `strength` is that of their pull for a hole of radius 1.
        """
        free = np.arange(self.old_vertices, len(self.mesh.vertices))
        if not len(free):
            return
        rim = np.flatnonzero(self.rim)
        rows = np.concatenate([rim, free])
        area = self.mesh.vertex_areas[rows]
        area = np.maximum(area, 0.1 * np.median(area))                 # slivers on a rim must not dominate
        laplacian = csr_array(clamp_cotangents(self.mesh)[rows])
        # curvature times radius of the hole from which bends count less than squared: 2 on the rim, 4 in the patch
        large = np.repeat([2.0, 4.0], [len(rim), len(free)]) / self._radii()[rows]
        weight = np.ones(len(rows))
        pull = np.zeros(len(free))
        if targets is not None:
            pull = strength * area[len(rim):] / self._radii()[free] ** 4
        for _ in range(4):                       # solved once, then three times reweighted
            b = csr_array(laplacian.multiply(np.sqrt(weight / area)[:, None])).tocsc()
            known = b[:, :self.old_vertices] @ self.mesh.vertices[:self.old_vertices]
            inner = b[:, free]
            wanted = 0.0 if targets is None else pull[:, None] * targets
            vertices = np.array(self.mesh.vertices)
            vertices[free] = factor(csc_array(inner.T @ inner + diags_array(pull)))(wanted - inner.T @ known)
            self.mesh = self.mesh.with_vertices(vertices)
            bend = laplacian @ vertices
            outward = np.einsum("nd,nd->n", bend, self.mesh.vertex_normals[rows]) > 0
            curvature = np.linalg.norm(bend, axis=1) / area
            weight = 1 / np.sqrt(1 + (curvature / large) ** 2)
            weight[:len(rim)][~outward[:len(rim)]] = 1                 # a rim may be an edge, but not a groove

    def _radii(self) -> np.ndarray:
        """Return for each vertex (n,) the radius, metres, of a disc with the area of its patch."""
        new = self.mesh.faces[self.old_faces:]
        patch = Mesh(self.mesh.vertices, new).vertex_component
        area = np.bincount(patch[new[:, 0]], self.mesh.face_areas[self.old_faces:], minlength=patch.max() + 1)
        return np.sqrt(np.maximum(area, 1e-12) / np.pi)[patch]

    def untangle(self, start: np.ndarray) -> None:
        """Move new vertices back towards `start` (n, 3), the shape before fairing, around intersecting triangles."""
        goal, share = self.mesh.vertices, np.ones(len(self.mesh.vertices))
        near, rounds = mean_of_neighbours(self.mesh), 10
        patch = Mesh(goal, self.mesh.faces[self.old_faces:]).vertex_component
        for step in range(rounds):
            pairs = intersecting_faces(self.mesh, self._new)
            if not len(pairs):
                return
            bad = np.zeros(len(share))
            bad[self.mesh.faces[pairs]] = 1
            for _ in range(1 + step // 2):                             # ever wider around the intersection
                bad = np.maximum(bad, near @ bad > 0)
            if step == rounds - 1:                                     # last resort: the whole patch
                bad = np.isin(patch, patch[self.mesh.faces[pairs.max(axis=1)]]).astype(float)
            # keep 60% of the fairing each time, later none; blend with the neighbours
            share = np.where(bad > 0, 0.6 * share if step < rounds // 2 else 0.0, share)
            even = np.minimum(share, near @ share)
            self.mesh = self.mesh.with_vertices(start + even[:, None] * (goal - start))

    def onto(self, mesh: Mesh, used: np.ndarray) -> Mesh:
        """Append the patch to its mesh; `used` are the numbers of the vertices around the holes."""
        new = self.mesh.vertices[self.old_vertices:]
        number = np.concatenate([used, len(mesh.vertices) + np.arange(len(new))])
        faces = np.concatenate([mesh.faces, number[self.mesh.faces[self.old_faces:]]])
        vertices = np.concatenate([mesh.vertices, new])
        if mesh.colors is None:
            return Mesh(vertices, faces)
        # new vertices take the colour of the nearest border vertex
        nearest = cKDTree(mesh.vertices[mesh.boundary_vertices]).query(new)[1] if len(new) else np.empty(0, int)
        return Mesh(vertices, faces, np.concatenate([mesh.colors, mesh.colors[mesh.boundary_vertices[nearest]]]))


def _border_normals(mesh: Mesh) -> dict[tuple[int, int], np.ndarray]:
    """Map every border edge, in the direction of its triangle, to the triangle's normal."""
    face, side = np.nonzero(mesh.edge_use[mesh.face_edges] == 1)
    a, b = mesh.faces[face, side], mesh.faces[face, (side + 1) % 3]
    return {(int(p), int(q)): normal for p, q, normal in zip(a, b, mesh.face_normals[face], strict=True)}


def _clear_triangles(around: Mesh, ring: np.ndarray, rim_normals: np.ndarray, joined: np.ndarray, rays: Rays
                     ) -> np.ndarray | None:
    """Triangulate a ring (n - 2, 3) with as few intersections as possible, with the mesh or within itself."""
    points = around.vertices[ring]
    # a price above the cost of all bends together
    most = float(4 * np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum())
    price = most * _pierces(points, joined, rays)
    best, fewest = None, np.inf
    corners = around.corners                    # only what overlaps the box of the ring can intersect
    near = around.faces[((corners.max(axis=1) >= points.min(axis=0))
                         & (corners.min(axis=1) <= points.max(axis=0))).all(axis=1)]
    for _ in range(5):
        # triangulate, then forbid the sides of intersecting triangles by a price, and try again
        inner = triangulate_loop(points, rim_normals, joined, price)
        if inner is None:
            return best
        mesh = Mesh(around.vertices, np.concatenate([near, ring[inner]]))
        pairs = intersecting_faces(mesh, np.arange(len(near), len(mesh.faces)))
        if len(pairs) < fewest:
            best, fewest = inner, len(pairs)
        if not fewest:
            break
        bad = np.unique(pairs[pairs >= len(near)]) - len(near)
        sides = inner[bad][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        price[sides[:, 0], sides[:, 1]] += most
        price = np.maximum(price, price.T)
    return best


def _pierces(points: np.ndarray, joined: np.ndarray, rays: Rays) -> np.ndarray:
    """Test for every pair of loop points (n, n) whether the line between them runs through the existing surface."""
    i, k = np.nonzero(np.triu(~joined, 2))
    out = np.zeros(joined.shape, dtype=bool)
    along = points[k] - points[i]
    length = np.linalg.norm(along, axis=1)
    good = length > 0
    i, k, along, length = i[good], k[good], along[good] / length[good, None], length[good]
    # from 2% to 98% of the line, as both ends lie on the surface
    face, at = rays.cast(points[i] + 0.02 * length[:, None] * along, along)
    out[i, k] = (face >= 0) & (at < 0.96 * length)
    return out | out.T
