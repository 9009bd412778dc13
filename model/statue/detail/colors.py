"""Colours of a scan in the chart of its control model."""
from __future__ import annotations

import numpy as np

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import Look, Texture

from ..control.model import ControlModel
from ..statue import DisplacementMap
from .displacement import FILL_LEVEL
from .lattice import Lattice
from .normal_volume import interpolate
from .texels import find_texels

REACH = 0.01                         # metres: farther from a place the scan does not say its colour
MIN_COSINE = 0.0                     # between the normals of both
GREY = 0.6                           # where nothing at all is known


def scan_look(scan: Mesh | Texture) -> Look:
    """The colours of a scan, of its vertices or its picture, at the closest place of its surface.

    Raises
    ------
    ValueError
        A scan without colours.
    """
    mesh = scan.mesh if isinstance(scan, Texture) else scan
    if not isinstance(scan, Texture) and mesh.colors is None:
        raise ValueError("scan: expected colours of its vertices or a texture, found neither")
    surface = Surface(mesh)

    def look(places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = surface.closest(places)
        if isinstance(scan, Texture):
            colors = scan.sample(found.faces, found.bary)
        else:
            assert mesh.colors is not None, "a scan without colours was refused"
            colors = np.einsum("nc,ncd->nd", found.bary, mesh.colors[mesh.faces[found.faces]])
        facing = np.einsum("nd,nd->n", mesh.face_normals[found.faces], normals)
        return colors, ((found.distances < REACH) & (facing > MIN_COSINE)).astype(float)
    return look


def bake_texture(control: ControlModel, map: DisplacementMap, look: Look) -> np.ndarray:
    """(H, W, 3) uint8 colours over the chart of a control model, those of the displaced surface.

    Parameters
    ----------
    look : (places (n, 3), normals (n, 3)) -> colours (n, 3), weights (n,)
        Where the weight is zero, colours go over smoothly from those around, across seams too.
    """
    texels = find_texels(control.mesh, control.chart, len(map.heights))
    p, n = interpolate(control.mesh, texels.faces, texels.bary)
    places = p + map.heights.ravel()[texels.pixels, None] * n
    if map.vectors is not None:
        places += map.vectors.reshape(-1, 3)[texels.pixels]
    colors, weight = look(places, n / np.maximum(np.linalg.norm(n, axis=1), 1e-12)[:, None])
    known = weight > 0
    if not known.all():
        lattice = Lattice(control.mesh, control.chart, FILL_LEVEL)
        found = [lattice.gather(texels, colors[:, k], known) for k in range(3)]
        values, sure = np.stack([value for value, _ in found], axis=1), found[0][1]
        values = sparse.harmonic(lattice.fine.vertex_adjacency, np.where(sure[:, None], values, GREY), sure)
        colors = np.where(known[:, None], colors, lattice.sample(values, texels.faces, texels.bary))
    return texels.image((255 * np.clip(colors, 0, 1) + 0.5).astype(np.uint8))
