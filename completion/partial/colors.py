"""Colours of a scan carried over to the completed body where it was seen, from all views that looked at it squarely."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from model.fitting.free_space import find_camera
from model.fitting.scan import View, as_views, check_viewpoints, prepare_scan, scale_view
from scanprep.geometry import sparse
from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.textures import Texture
from scanprep.ranges import Positive, Settings


@dataclass(frozen=True)
class ColorConfig(Settings):
    """Settings of `carry_colors`.

    Attributes
    ----------
    reach : float, metres
        How far the scan may be from a place to give it its colour.
    fill : bool
        Spread colours smoothly over what was not seen, instead of grey.
    """

    reach: Positive = 0.02
    fill: bool = False


class ColoredView:
    """What one view says of the colours of places near it.

    `view` Mesh or PointCloud with colours, metres; `camera` (3,), metres, where it was seen from.
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

    def look(self, places: np.ndarray, normals: np.ndarray, config: ColorConfig) -> tuple[np.ndarray, np.ndarray]:
        """Colours (n, 3) of places (n, 3) with normals (n, 3), and how much each counts (n,); 0 where none is near."""
        if self.surface is not None:
            mesh = self.surface.mesh
            found = self.surface.closest(places)
            far, facing = found.distances, mesh.face_normals[found.faces]
            if self.texture is not None:
                colors = self.texture.sample(found.faces, found.bary)
            else:
                assert self.colors is not None, "a view without colours was left out"
                colors = np.einsum("nc,ncd->nd", found.bary, self.colors[mesh.faces[found.faces]])
        else:
            assert self.colors is not None and self.normals is not None, "a view without colours was left out"
            # points of a cloud that make the colour of a place
            apart, near = self.tree.query(places, 3)
            far, facing = apart[:, 0], self.normals[near[:, 0]]
            share = 1 / np.maximum(apart, 1e-6)
            colors = np.einsum("nk,nkd->nd", share / share.sum(axis=1, keepdims=True), self.colors[near])
        cosine = np.einsum("nd,nd->n", facing, normals)
        # between the normals of scan and body
        weight = ((far < config.reach) & (cosine > 0.5)).astype(float)
        return colors, weight * self._squarely(places, normals) * self._inside(places)

    def _squarely(self, places: np.ndarray, normals: np.ndarray) -> np.ndarray:
        if self.camera is None:
            return np.ones(len(places))
        to = self.camera - places
        cosine = np.einsum("nd,nd->n", normals, to) / np.linalg.norm(to, axis=1)
        # power of the cosine at which a view looked
        return np.clip(cosine, 0.02, 1)**2

    def _inside(self, places: np.ndarray) -> np.ndarray:
        # metres: towards its border a view counts less and less
        return np.ones(len(places)) if self.rim is None else np.clip(self.rim.query(places)[0] / 0.015, 0.02, 1)


def carry_colors(body: Mesh, seen: np.ndarray, scan: View | Sequence[View], config: ColorConfig | None = None,
                 viewpoint: object = None, metres: float = 1.0, textures: Sequence[Texture | None] = ()
                 ) -> np.ndarray:
    """Colours (N, 3) in [0, 1] of a completed body.

    Parameters
    ----------
    body : Mesh
        The completed mesh.
    seen : (N,) bool
        Its vertices that had data: no other takes a colour from the scan.
    scan : Mesh or PointCloud with colours, or a sequence of these
        As given to `complete`; views without colours are left out.
    viewpoint : (3,) float, or one for each view, optional
        Where they were seen from; found from the normals when not given. Several views are blended by how squarely
        they looked.
    metres : float
        Of one unit of the scan: `Completion.scale`.
    textures : Texture or None of each view, optional
        Instead of the colours of its vertices.

    Raises
    ------
    ValueError
        No view has colours.
    """
    config = config or ColorConfig()
    colors, weight = blend(views_with_colors(scan, viewpoint, metres, textures), body.vertices, body.vertex_normals,
                           config)
    near = body.vertex_adjacency
    closed = seen | (near @ seen.astype(float) > 0.5 * near.sum(axis=1))     # single gaps amid what was seen
    known = closed & (weight > 0)
    # what was not seen
    out = np.where(known[:, None], colors, 0.6)
    return np.clip(sparse.harmonic(near, out, known), 0, 1) if config.fill and known.any() else out


def views_with_colors(scan: View | Sequence[View], viewpoint: object = None, metres: float = 1.0,
                      textures: Sequence[Texture | None] = ()) -> list[ColoredView]:
    """The views that have colours, or a texture."""
    views = [scale_view(view, metres) for view in as_views(scan)]
    cameras = check_viewpoints(viewpoint, len(views), metres)
    found = []
    for i, view in enumerate(views):
        texture = textures[i] if textures else None
        if isinstance(view, np.ndarray) or (view.colors is None and texture is None):
            continue
        found_camera = None if cameras is not None else find_camera(prepare_scan(view))
        camera = cameras[i] if cameras is not None else None if found_camera is None else found_camera.viewpoint
        found.append(ColoredView(view, camera, None if texture is None else texture.scale_by(metres)))
    if not found:
        raise ValueError("scan: expected colours at its points, found none")
    return found


def blend(views: Sequence[ColoredView], places: np.ndarray, normals: np.ndarray, config: ColorConfig
          ) -> tuple[np.ndarray, np.ndarray]:
    """Mean colour (n, 3) that views give places (n, 3), and the sum (n,) of what they count."""
    total, weight = np.zeros_like(places), np.zeros(len(places))
    for view in views:
        colors, counts = view.look(places, normals, config)
        total += counts[:, None] * colors
        weight += counts
    return total / np.maximum(weight, 1e-12)[:, None], weight
