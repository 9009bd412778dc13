"""Left-right symmetry: mirror partners of markers and of places on the skin."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sides import other_side
from scanprep.geometry.surface import Surface
from scanprep.skeleton.symmetry import find_symmetry


@dataclass(frozen=True, eq=False)
class SkinMirror:
    """The mirror image of every vertex, as a point of the skin.

    Attributes
    ----------
    faces : (N,) int
        Triangle of the image.
    bary : (N, 3) float
        Barycentric coordinates of the image.
    partner : (N,) int
        Vertex nearest to the image. In an irregular triangulation the partner's partner is the vertex itself for most
        vertices, but not all.
    across : (N,) float, metres
        Distance of each vertex from its image, 0 in the middle, negative on one side; which one is unknown.
    """

    faces: np.ndarray
    bary: np.ndarray
    partner: np.ndarray
    across: np.ndarray

    def image(self, mesh: Mesh) -> np.ndarray:
        """Compute the mirror images (N, 3) of all vertices, metres, on a body with these triangles in any pose."""
        return np.einsum("nc,ncd->nd", self.bary, mesh.vertices[mesh.faces[self.faces]])


def label_pairs(labels: Sequence[str]) -> np.ndarray:
    """Return the index (L,) of each label's partner: its own for a label without side, -1 for a missing partner."""
    rows = {label: i for i, label in enumerate(labels)}
    others = [other_side(label) for label in labels]
    return np.array([i if other is None else rows.get(other, -1) for i, other in enumerate(others)], dtype=np.int64)


def find_skin_mirror(template: Mesh) -> SkinMirror:
    """Find the mirror image of every vertex, for any triangulation.

    The reflected template is registered to the template, without using vertex numbers.

    Parameters
    ----------
    template : Mesh
        In a nearly symmetric pose.

    Raises
    ------
    ValueError
        Not symmetric.
    """
    symmetry = find_symmetry(template)
    if not symmetry.holds:
        raise ValueError("template: expected one that stands symmetrically, its mirror image is "
                         f"{symmetry.distance:.1%} of its size away; give labels that tell left from right")
    # the nearest points to the image
    found = Surface(template).closest(symmetry.image)
    partner = cKDTree(template.vertices).query(found.points)[1]
    return SkinMirror(found.faces, found.bary, partner, (template.vertices - found.points) @ symmetry.normal)
