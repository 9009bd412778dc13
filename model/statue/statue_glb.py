"""A statue as glTF 2.0: its skin at any level of detail, its images, its skeleton and a motion."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh

from ..export.glb import Material, write_skinned_glb
from ..export.rig import Rig, strongest
from .control.model import ControlModel
from .detail.normal_image import chart_tangents, vertex_of_row
from .detail.subdivision import Subdivision, subdivide
from .motion.retarget import StatueMotion


def write_statue_glb(path: str | Path, control: ControlModel, vertices: np.ndarray | None = None,
                     subdivision: Subdivision | None = None, texture: np.ndarray | None = None,
                     normals: np.ndarray | None = None, heights: np.ndarray | None = None,
                     motion: StatueMotion | None = None, up: int = 2) -> None:
    """Write a statue for any glTF 2.0 viewer, animation program or game engine.

    glTF knows linear blend skinning only: joints carry the detailed vertices themselves, while `Reconstruction` moves
    the control mesh and sets the detail upon it anew. The rest pose is that of the scan.

    Parameters
    ----------
    path : str or Path
    control : ControlModel
        Fitted.
    vertices : (n, 3) float, metres, optional
        The detailed surface in the default pose; else the control mesh itself, which `normals` and `heights` detail.
    subdivision : Subdivision, optional
        Its triangles; with `vertices`.
    texture : (H, W, 3) uint8, optional
        Colours over the chart.
    normals : (H, W, 3) uint8, optional
        `normal_image`: for the control mesh.
    heights : (H, W) float, metres, optional
        Displacement over the chart. glTF has no place for it, so it is stored as an image that the material's
        `extras` name.
    motion : StatueMotion, optional
    up : int
        0, 1 or 2: the axis that points up.

    Raises
    ------
    ValueError
        Vertices of another count than the subdivision's, or one of the two alone; what `write_skinned_glb` refuses.
    """
    rig, material = statue_rig(control, vertices, subdivision, texture, normals, heights)
    if motion is None:
        write_skinned_glb(path, rig, up=up, material=material)
    else:
        write_skinned_glb(path, rig, motion.poses, motion.trans, motion.rate, up=up, material=material)


def statue_rig(control: ControlModel, vertices: np.ndarray | None, subdivision: Subdivision | None,
               texture: np.ndarray | None = None, normals: np.ndarray | None = None, heights: np.ndarray | None = None
               ) -> tuple[Rig, Material]:
    """The skin with its vertices repeated along the seams of the chart, and its material."""
    if (vertices is None) != (subdivision is None):
        raise ValueError("vertices, subdivision: expected both or none")
    if subdivision is None or vertices is None:
        subdivision, vertices = subdivide(control.mesh, control.chart, 0), control.mesh.vertices
    if np.shape(vertices) != (len(subdivision.parent), 3):
        raise ValueError(f"vertices: expected shape ({len(subdivision.parent)}, 3), got {np.shape(vertices)}")
    mesh, chart = Mesh(vertices, subdivision.faces), subdivision.chart
    weights = np.einsum("nc,ncj->nj", subdivision.bary, control.weights[control.mesh.faces[subdivision.parent]])
    row = vertex_of_row(mesh, chart)
    split = Mesh(mesh.vertices[row], chart.faces)
    tangents = None if normals is None else chart_tangents(mesh, chart)
    material = Material(chart.uv, mesh.vertex_normals[row], tangents, texture, normals, heights)
    return Rig(split, control.skeleton, strongest(weights)[row], np.zeros((0, *split.vertices.shape))), material
