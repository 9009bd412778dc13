"""Transfer of parts, vertices and fields to another triangulation of the same surface."""
from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csc_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import Factored
from scanprep.geometry.surface import Surface
from scanprep.skeleton.labels import keep_connected
from scanprep.skeleton.tree import Skeleton

from ..gradients import edges
from ..stitching import edge_operator


def transfer_skeleton(skeleton: Skeleton, old: Mesh, new: Mesh) -> Skeleton:
    """Transfer a skeleton: the same tree and joints, with parts assigned to the new triangles by majority.

    ValueError where the mesh is too coarse: a part gets no triangles, or no longer touches its parent.
    """
    J, F = len(skeleton.parents), len(new.faces)
    # points inside every new triangle vote for the part of the nearest old triangle
    bary = _inner_points(_cuts(old, new))
    points = np.einsum("sc,fcd->fsd", bary, new.corners)
    hit = Surface(old).closest(points.reshape(-1, 3)).faces
    votes = np.zeros((F, J))
    np.add.at(votes, (np.repeat(np.arange(F), len(bary)), skeleton.part_of_face[hit]), 1 / len(bary))
    part = keep_connected(-votes, new.face_pairs, new.face_areas, votes.argmax(axis=1))
    sizes = np.bincount(part, minlength=J)
    least = 6  # triangles that a part needs: fewer are no piece of surface
    if sizes.min() < least:
        lost = int(sizes.argmin())
        share = old.face_areas[skeleton.part_of_face == lost].sum() / old.face_areas.sum()
        needed = 2 * least * max(1 / share, F / max(sizes[lost], 1))       # by its area, and by what it got
        raise ValueError(f"template: {F} triangles are too coarse, {sizes[lost]} are left for part "
                         f"'{skeleton.names[lost]}'; expected some {needed:.0f} or more")
    carried = Skeleton(part, skeleton.parents, skeleton.joints, skeleton.names)
    for j in range(1, J):
        if not len(carried.ring(new, j)):
            raise ValueError(f"template: {F} triangles are too coarse, part '{skeleton.names[j]}' no longer touches "
                             f"its parent '{skeleton.names[skeleton.parents[j]]}'")
    return carried


class Piece:
    """One part on both triangulations: transfers fields from its old triangles (f,) to its new ones (g,)."""

    def __init__(self, old: Mesh, new: Mesh, old_faces: np.ndarray, new_faces: np.ndarray) -> None:
        self.old_faces, self.new_faces = old_faces, new_faces
        self.before, self.after = old.submesh(old_faces)[0], new.submesh(new_faces)[0]
        surface = Surface(self.before)
        self._corner = surface.closest(self.after.vertices)
        bary = _inner_points(_cuts(old, new))
        inside = np.einsum("sc,fcd->fsd", bary, self.after.corners).reshape(-1, 3)
        rows = np.repeat(np.arange(len(new_faces)), len(bary))
        self._mean = csc_array(coo_array((np.full(len(inside), 1 / len(bary)), (rows, surface.closest(inside).faces)),
                                         shape=(len(new_faces), len(old_faces))))

    @cached_property
    def v_hat(self) -> np.ndarray:
        """(g, 2, 3) edges of the new triangles at rest, metres."""
        return edges(self.after.vertices, self.after.faces)

    @cached_property
    def _stitch(self) -> tuple[csc_array, Factored]:
        """The edge operator of the old triangles, and the factored normal equations of their vertices."""
        n = len(self.before.vertices)
        G = edge_operator(self.before.faces, n)
        held = np.unique(self.before.vertex_component, return_index=True)[1]
        anchor = coo_array((np.ones(len(held)), (held, held)), shape=(n, n))
        return G, Factored(csc_array(G.T @ G + anchor))

    def average(self, values: np.ndarray) -> np.ndarray:
        """Average values (f, ...) of the old triangles over each new one, by area: (g, ...)."""
        return (self._mean @ values.reshape(len(values), -1)).reshape(-1, *values.shape[1:])

    def edges(self, action: np.ndarray) -> np.ndarray:
        """Compute edges (n, g, 2, 3), metres, of the new triangles when `action` (n, f, 3, 3) deforms the old ones.

        Stitching uses only the integrable part of a part's edges; the rest vanishes in the normal equations. So the
        part is stitched on its own, without loss. The new vertices follow the triangles on which, or nearest to which,
        they lie.
        """
        G, normal = self._stitch
        wanted = edges(self.before.vertices, self.before.faces) @ np.swapaxes(action, -1, -2)     # (n, f, 2, 3)
        columns = wanted.transpose(1, 2, 0, 3).reshape(G.shape[0], -1)
        stitched = normal.solve(G.T @ columns).reshape(-1, len(action), 3)
        face = self._corner.faces
        y = np.einsum("vc,vcnd->nvd", self._corner.bary, stitched[self.before.faces[face]])
        y += np.einsum("nvij,vj->nvi", action[:, face], self.after.vertices - self._corner.points)
        return edges(y, self.after.faces)


def gradients_of(before: np.ndarray, after: np.ndarray, otherwise: np.ndarray | None = None) -> np.ndarray:
    """Compute the matrices (..., g, 3, 3) that map edges (g, 2, 3) to other edges (..., g, 2, 3).

    Along the normal, which edges do not determine, they act as `otherwise`, or map to zero.
    """
    dual = np.linalg.solve(before @ np.swapaxes(before, -1, -2), before)      # (g, 2, 3)
    carried = np.swapaxes(after, -1, -2) @ dual
    return carried if otherwise is None else carried + otherwise @ (np.eye(3) - np.swapaxes(before, -1, -2) @ dual)


def _inner_points(n: int) -> np.ndarray:
    """Compute barycentric coordinates (n², 3) of the centres of n² equal pieces of a triangle."""
    up = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    down = [(i + 2 / 3, j + 2 / 3) for i in range(n - 1) for j in range(n - 1 - i)]
    two = np.array(up + down) / n
    return np.column_stack([1 - two.sum(axis=1), two])


def _cuts(old: Mesh, new: Mesh) -> int:
    """Choose the pieces along a side of a new triangle, so that each is smaller than the old triangles."""
    return int(np.clip(np.ceil(2 * np.sqrt(len(old.faces) / len(new.faces))), 2, 12))
