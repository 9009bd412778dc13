"""A copy of a body with fewer triangles, on which parts are sought, and the way back."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..decimation.decimate import collapse
from ..geometry.mesh import Mesh

VERTICES = 2500                  # of the copy: parts are centimetres large, and the search takes a third of the time


@dataclass(frozen=True, eq=False)
class CoarseCopy:
    """Some of the vertices of a template, and triangles over them alone.

    `kept` (n,) are the numbers of its vertices among all, `owner` (N,) the vertex of the copy that stands for each, and
    `face` (f,) a triangle of the template for every one of the copy.
    """

    template: Mesh
    mesh: Mesh
    kept: np.ndarray
    owner: np.ndarray
    face: np.ndarray

    def back(self, part_of_vertex: np.ndarray) -> np.ndarray:
        """(F,) part of every triangle of the template, that of most of its corners, from those of the copy's vertices.

        Neighbours stay neighbours: nothing is carried over where a limb touches another.
        """
        a, b, c = part_of_vertex[self.owner[self.template.faces]].T
        return np.where(b == c, b, a)


def coarse_copy(template: Mesh, count: int = VERTICES) -> CoarseCopy:
    """A copy with about `count` of the template's vertices; all of them where it has no more."""
    if len(template.vertices) <= count:
        every = np.arange(len(template.vertices))
        return CoarseCopy(template, template, every, every, np.arange(len(template.faces)))
    small = collapse(Mesh(template.vertices, template.faces), 2 * count)
    return CoarseCopy(template, Mesh(template.vertices[small.vertex_map], small.mesh.faces), small.vertex_map,
                      small.owner, small.face_map)
