"""Transfer colours of a scan to the completed body where it was seen, blended over the views."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from model.fitting.free_space import find_camera
from model.fitting.scan import View, as_views, check_viewpoints, prepare_scan, scale_view
from scanprep.geometry import sparse
from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import Texture

REACH = 0.02                         # metres: what is farther from the scan takes no colour: it may be another limb


class ColoredView:
    """The colours of one view, sampled near its surface.

    `view` is a Mesh or PointCloud with colours, in metres; `camera` (3,), metres, is where it was seen from.
    """

    def __init__(self, view: Mesh | PointCloud, camera: np.ndarray | None = None, texture: Texture | None = None
                 ) -> None:
        self.camera, self.texture = camera, texture
        source = texture.mesh if texture is not None else view
        self.colors = source.colors
        self.surface = Surface(source) if isinstance(source, Mesh) and len(source.faces) else None
        self.points = source.vertices if isinstance(source, Mesh) else source.points
        self.tree = cKDTree(self.points)
        rim = self.points[source.boundary_vertices] if isinstance(source, Mesh) else np.zeros((0, 3))
        self.rim = cKDTree(rim) if len(rim) and texture is None else None
        self.normals = prepare_scan(view).normals if self.surface is None else None

    def look(self, places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return colours (n, 3) at places (n, 3) with normals (n, 3), and weights (n,), 0 where no surface is near."""
        if self.surface is not None:
            # a mesh: colours of the closest triangle, from its texture or its corners
            mesh = self.surface.mesh
            closest = self.surface.closest(places)
            far, facing = closest.distances, mesh.face_normals[closest.faces]
            if self.texture is not None:
                colors = self.texture.sample(closest.faces, closest.bary)
            else:
                assert self.colors is not None, "a view without colours was left out"
                colors = np.einsum("nc,ncd->nd", closest.bary, self.colors[mesh.faces[closest.faces]])
        else:
            assert self.colors is not None and self.normals is not None, "a view without colours was left out"
            # a point cloud: mean of the 3 nearest points, weighted by inverse distance
            apart, near = self.tree.query(places, 3)
            far, facing = apart[:, 0], self.normals[near[:, 0]]
            share = 1 / np.maximum(apart, 1e-6)
            colors = np.einsum("nk,nkd->nd", share / share.sum(axis=1, keepdims=True), self.colors[near])
        cosine = np.einsum("nd,nd->n", facing, normals)
        # 0.5: normals of scan and body differ by less than 60 degrees
        weight = ((far < REACH) & (cosine > 0.5)).astype(float)
        # oblique views have less weight: cosine squared, at least 0.02 squared
        if self.camera is not None:
            to = self.camera - places
            cosine = np.einsum("nd,nd->n", normals, to) / np.linalg.norm(to, axis=1)
            weight = weight * np.clip(cosine, 0.02, 1)**2
        # so has the last 15 mm before the border of the view, for smooth seams
        if self.rim is not None:
            weight = weight * np.clip(self.rim.query(places)[0] / 0.015, 0.02, 1)
        return colors, weight


def carry_colors(body: Mesh, seen: np.ndarray, scan: View | Sequence[View], fill: bool = False,
                 viewpoint: object = None, metres: float = 1.0, textures: Sequence[Texture | None] = ()) -> np.ndarray:
    """Compute colours (N, 3) in [0, 1] of a completed body.

    Parameters
    ----------
    body : Mesh
        The completed mesh.
    seen : (N,) bool
        Observed vertices; only these take a colour from the scan.
    scan : Mesh or PointCloud with colours, or a sequence of these
        As given to `complete`; views without colours are left out.
    fill : bool
        Spread the colours smoothly over what was not seen.
    viewpoint : (3,) float, or one for each view, optional
        Position of the cameras; estimated from the normals when not given. Views that looked at a right angle weigh
        most.
    metres : float, metres per unit of the scan
        `Completion.scale`.
    textures : Texture or None of each view, optional
        Instead of the colours of its vertices.

    Returns
    -------
    (N, 3) float in [0, 1]
        Grey, or spread smoothly with `fill`, where nothing was seen.

    Raises
    ------
    ValueError
        No view has colours.
    """
    colors, weight = blend(views_with_colors(scan, viewpoint, metres, textures), body.vertices, body.vertex_normals)
    near = body.vertex_adjacency
    closed = seen | (near @ seen.astype(float) > 0.5 * near.sum(axis=1))     # close single gaps between seen vertices
    known = closed & (weight > 0)
    # 0.6: grey where nothing was seen
    out = np.where(known[:, None], colors, 0.6)
    return np.clip(sparse.harmonic(near, out, known), 0, 1) if fill and known.any() else out


def views_with_colors(scan: View | Sequence[View], viewpoint: object = None, metres: float = 1.0,
                      textures: Sequence[Texture | None] = ()) -> list[ColoredView]:
    """Return the views that have colours or a texture; ValueError where there are none."""
    views = [scale_view(view, metres) for view in as_views(scan)]
    cameras = check_viewpoints(viewpoint, len(views), metres)
    colored = []
    for i, view in enumerate(views):
        texture = textures[i] if textures else None
        if isinstance(view, np.ndarray) or (view.colors is None and texture is None):
            continue
        estimated = None if cameras is not None else find_camera(prepare_scan(view))
        camera = cameras[i] if cameras is not None else None if estimated is None else estimated.viewpoint
        colored.append(ColoredView(view, camera, None if texture is None else texture.scale_by(metres)))
    if not colored:
        raise ValueError("scan: expected colours at its points, found none")
    return colored


def blend(views: Sequence[ColoredView], places: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the weighted mean colour (n, 3) of the views at places (n, 3), and the sum (n,) of the weights."""
    total, weight = np.zeros_like(places), np.zeros(len(places))
    for view in views:
        colors, counts = view.look(places, normals)
        total += counts[:, None] * colors
        weight += counts
    return total / np.maximum(weight, 1e-12)[:, None], weight
