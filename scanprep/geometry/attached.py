"""Eyes, teeth and loose vertices: what belongs to a registered mesh but not to the surface of its body."""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..words import number_of
from .carrier import SurfaceCarrier, mount
from .mesh import Mesh
from .rotations import procrustes

STIFF = 0.15        # of the body's size: eyes, teeth and buttons keep their shape; hair and shirts bend


@dataclass(frozen=True, eq=False)
class Attached:
    """The whole mesh that a body was taken from; all else of it follows the nearest triangles of the body."""

    whole: Mesh                      # at rest, as the files have it
    body: np.ndarray                 # (N,) int: vertex of the whole of every vertex of the body
    template: Mesh                   # the body at rest

    @cached_property
    def others(self) -> np.ndarray:
        """(n,) the vertices of the whole that are not the body's."""
        return np.setdiff1d(np.arange(len(self.whole.vertices)), self.body)

    @cached_property
    def carrier(self) -> SurfaceCarrier:
        """The nearest triangle of the body, for each of the others."""
        return mount(self.template, Mesh(self.whole.vertices[self.others], np.zeros((0, 3), dtype=np.int64)))

    @cached_property
    def stiff(self) -> list[np.ndarray]:
        """Components, as rows of the others, that are small against the body and so keep their shape."""
        component, size = self.whole.vertex_component[self.others], np.ptp(self.template.vertices, axis=0).max()
        rest, pieces = self.whole.vertices[self.others], [np.flatnonzero(component == c) for c in np.unique(component)]
        return [piece for piece in pieces if len(piece) > 2 and np.ptp(rest[piece], axis=0).max() < STIFF * size]

    def follow(self, vertices: np.ndarray) -> np.ndarray:
        """Compute the vertices (M, 3) of the whole for those of the body (N, 3), metres."""
        moved, rest = self.carrier.positions(vertices), self.whole.vertices[self.others]
        for piece in self.stiff:
            R, t = procrustes(rest[piece], moved[piece])
            moved[piece] = rest[piece] @ R.T + t
        return self._fill(vertices, moved)

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Compute values (M, k) of the whole, as colours or blend weights, from those of the body (N, k)."""
        carried = self.carrier.values(values)
        for piece in self.stiff:
            carried[piece] = carried[piece].mean(axis=0)
        return self._fill(values, carried)

    def mesh(self, body: Mesh) -> Mesh:
        """Build the whole mesh for a body in any pose and shape."""
        colors = None if body.colors is None else self.spread(body.colors)
        return Mesh(self.follow(body.vertices), self.whole.faces, colors, up=body.up)

    def __str__(self) -> str:
        components = np.unique(self.whole.vertex_component[self.whole.faces[:, 0]])
        loose = len(self.whole.vertices) - len(np.unique(self.whole.faces))
        told = f"{len(components)}, the largest is the body, the others follow it"
        return told if not loose else f"{told}, and {number_of(loose, 'loose vertex', 'loose vertices')}"

    def _fill(self, of_body: np.ndarray, of_others: np.ndarray) -> np.ndarray:
        out = np.empty((len(self.whole.vertices), of_body.shape[1]))
        out[self.body], out[self.others] = of_body, of_others
        return out


def take_body(mesh: Mesh) -> Mesh:
    """Take the largest component of a mesh as the body, by area; it keeps the rest as `attached`.

    Parameters
    ----------
    mesh : Mesh
        At rest.

    Returns
    -------
    Mesh
        The body; the mesh as it is where it is one component without loose vertices.

    Examples
    --------
    >>> square = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 2, 2]], [[0, 1, 2], [0, 2, 3]])
    >>> body = take_body(square)
    >>> body, str(body.attached)
    (Mesh(4 vertices, 2 faces), '1, the largest is the body, the others follow it, and 1 loose vertex')
    """
    component = mesh.vertex_component
    if not len(mesh.faces) or not component.any():
        return mesh
    area = np.bincount(component[mesh.faces[:, 0]], mesh.face_areas)
    body, used = mesh.submesh(component[mesh.faces[:, 0]] == area.argmax())
    # numbers of files, as those of landmarks, lead to the body
    place = np.full(len(mesh.vertices), -1)
    place[used] = np.arange(len(used))
    of_file = place if mesh.of_file is None else np.where(mesh.of_file < 0, -1, place[mesh.of_file])
    return replace(body, up=mesh.up, of_file=of_file, attached=Attached(mesh, used, body))


def in_body(template: Mesh, faces: np.ndarray, vertices: np.ndarray) -> np.ndarray | None:
    """Return vertices (..., N, 3) of the body from those of meshes in its triangles or in those of its whole.

    None for other triangles.
    """
    if np.array_equal(faces, template.faces):
        return vertices
    whole = template.attached
    return vertices[..., whole.body, :] if whole is not None and np.array_equal(faces, whole.whole.faces) else None
