"""A copy of a body with fewer triangles, on which parts are sought, and the way back."""
from __future__ import annotations

import numpy as np

from ..decimation.registered_set import DecimatedSet, DecimateSetConfig, decimate_set
from ..geometry.mesh import Mesh

VERTICES = 2500                  # of the copy: parts are centimetres large, and the search takes a third of the time


def coarse_copy(template: Mesh, count: int = VERTICES) -> DecimatedSet:
    """About `count` of the template's vertices, and triangles over them alone; all where it has no more."""
    faces = 2 * count if len(template.vertices) > count else len(template.faces)
    return decimate_set(template, None, faces, DecimateSetConfig(meshes=1))


def parts_of_source(copy: DecimatedSet, part_of_vertex: np.ndarray) -> np.ndarray:
    """(F,) part of every triangle before, that of most of its corners, from those (n,) of the copy's vertices.

    Neighbours stay neighbours: nothing is carried over where a limb touches another.
    """
    a, b, c = part_of_vertex[copy.owner[copy.source.faces]].T
    return np.where(b == c, b, a)
