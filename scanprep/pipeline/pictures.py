"""A strip of small pictures of one registration: the scan, the template on it, how far apart, how sure."""
from __future__ import annotations

import io

import numpy as np
from scipy.sparse import eye_array

from ..geometry import rotations
from ..geometry.farthest_points import thin
from ..geometry.mesh import Mesh
from ..pictures.camera import Camera, upright
from ..pictures.colors import heat
from ..pictures.shading import CLAY, Dots, Shape, Solid, render
from ..registration.nonrigid import Registration

WIDTH, HEIGHT = 150, 216
FAR = 0.005                 # of the template's size: the dark end of the distances
TURN = 20.0                 # degrees from the front
BALL = 0.013                # of the template's size: radius of the balls that stand for points

PANELS = ("the scan", "the template on it", "distance, front", "distance, back", "dark: not sure")


def strip(template: Mesh, scan: Mesh | np.ndarray, fit: Registration) -> bytes:
    """One row of pictures as a WebP file, in the order of `PANELS`.

    All are seen as the template would be from its front, whichever way the person stood in the scanner.
    """
    R, _ = rotations.procrustes(fit.mesh.vertices, template.vertices)
    middle = fit.mesh.vertices.mean(axis=0)
    body = fit.mesh.with_vertices((fit.mesh.vertices - middle) @ R.T)
    up, front = upright(template)
    near, back = (Camera.around(body.vertices, front + turn, up=up, margin=1.12) for turn in (TURN, TURN + 180))
    size = float(np.sqrt(template.face_areas.sum()))
    far = Solid(body, heat(evened(body, fit.distances), 0, FAR * size))
    shown = [(_scan(scan, R, middle, size), near), (Solid(body, CLAY), near), (far, near), (far, back),
             (Solid(body, heat(1 - fit.confidence, -0.35, 1, "Blues")), near)]      # unlike the distances
    return webp_bytes(np.concatenate([render(shape, camera, WIDTH, HEIGHT) for shape, camera in shown], axis=1))


def _scan(scan: Mesh | np.ndarray, R: np.ndarray, middle: np.ndarray, size: float) -> Shape:
    """The scan in the frame of the picture, with no more detail than a small picture can show."""
    if isinstance(scan, Mesh) and len(scan.faces):
        coarse = coarsened(scan, 0.007 * size)
        return Solid(coarse.with_vertices((coarse.vertices - middle) @ R.T))
    points = scan.vertices if isinstance(scan, Mesh) else scan
    return Dots((points[thin(points, 1.25 * BALL * size)] - middle) @ R.T, CLAY, BALL * size)


def evened(mesh: Mesh, values: np.ndarray, rounds: int = 2) -> np.ndarray:
    """Values (N,) averaged with those of neighbours, so that noise fades and misfit stays; NaN stays NaN."""
    known = np.isfinite(values)
    weights = mesh.vertex_adjacency.astype(float) + eye_array(len(values))
    for _ in range(rounds):
        total = weights @ np.where(known, values, 0.0)
        values = np.where(known, total / np.maximum(weights @ known.astype(float), 1.0), np.nan)
    return values


def coarsened(mesh: Mesh, cell: float) -> Mesh:
    """The mesh with all vertices of a cubic cell (metres) in one; for pictures only, it may not be manifold."""
    key = np.floor((mesh.vertices - mesh.vertices.min(axis=0)) / cell).astype(np.int64)
    _, first, place = np.unique(key, axis=0, return_index=True, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    apart = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    count = np.bincount(place.reshape(-1))
    means = np.stack([np.bincount(place.reshape(-1), axis) / count for axis in mesh.vertices.T], axis=1)
    colors = None if mesh.colors is None else mesh.colors[first]
    return Mesh(means, faces[apart], colors)


def webp_bytes(image: np.ndarray, quality: int = 82) -> bytes:
    """A picture (H, W, 3) uint8 as a WebP file, a tenth of the size of a PNG."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).save(out, format="WEBP", quality=quality, method=4)
    return out.getvalue()
