"""Render shaded pictures by ray casting, without graphics card or display.

Key, fill and rim light move with the camera.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ..geometry.format_common import as_light
from ..geometry.mesh import Mesh
from .camera import Camera
from .colors import Heat, color_bar, heat, part_colors, part_palette
from .lighting import Canvas, LitTriangles, Scene
from .sheets import contact_sheet, png_bytes, save_png

__all__ = [
    "Bones",
    "Camera",
    "Dots",
    "Heat",
    "Moving",
    "Solid",
    "color_bar",
    "contact_sheet",
    "heat",
    "part_colors",
    "part_palette",
    "png_bytes",
    "render",
    "save_png",
]

CLAY = (0.79, 0.76, 0.725)           # colour of plain bodies: light, so that shading shows


@dataclass(frozen=True, eq=False)
class Solid:
    """A mesh and its appearance."""

    mesh: Mesh
    # (3,), (N, 3) per vertex or (F, 3) per triangle, in [0, 1]; by default the mesh's own colours, else clay
    color: np.ndarray | Sequence[float] | Heat | None = None
    opacity: float = 1.0  # below 1 it is translucent
    smooth: bool = True  # interpolate normals; False shows the facets
    name: str = ""  # in the browser shapes with a name can be hidden
    shades: Mapping[str, np.ndarray | Heat] = field(default_factory=dict)  # other colours to choose from in the browser
    visible: bool = True  # at first; shapes with a name can be shown later


@dataclass(frozen=True, eq=False)
class Dots:
    """Small balls: markers, joints, landmarks."""

    points: np.ndarray  # (n, 3) float, metres; points that are not finite are left out
    color: np.ndarray | Sequence[float] | Heat = (0.86, 0.24, 0.20)  # (3,) or (n, 3) in [0, 1]
    radius: float = 0.012  # metres
    on_top: bool = False  # visible through the meshes in front of them
    coarse: bool = False  # balls of few triangles, for dots a few pixels wide
    name: str = ""
    labels: Sequence[str] = ()  # of each point, shown in the browser
    visible: bool = True


@dataclass(frozen=True, eq=False)
class Bones:
    """Straight rods with round ends."""

    starts: np.ndarray  # (n, 3) float, metres
    ends: np.ndarray  # (n, 3) float, metres
    color: np.ndarray | Sequence[float] = (0.25, 0.30, 0.38)  # (3,) or (n, 3) in [0, 1]
    radius: float = 0.006  # metres
    on_top: bool = False
    name: str = ""
    visible: bool = True


@dataclass(frozen=True, eq=False)
class Moving:
    """A shape in motion, for the browser; pictures show its first frame."""

    shape: Solid | Dots
    frames: np.ndarray  # (T, n, 3) float, metres: of its vertices or points
    rate: float  # frames a second
    # the same as columns (n, r) times coefficients (T, r, 3), where they are known; `frames` is then the first alone
    columns: tuple[np.ndarray, np.ndarray] | None = None


Shape = Mesh | Solid | Dots | Bones


def render(shapes: Shape | Sequence[Shape], camera: Camera, width: int, height: int) -> np.ndarray:
    """Render a shaded picture on a white background.

    Parameters
    ----------
    shapes : Mesh, Solid, Dots, Bones, or sequence of these
        What is seen.
    camera : Camera
        Where it is seen from.
    width, height : int, pixels
        Size of the picture.

    Returns
    -------
    (height, width, 3) uint8
    """
    everything = [shapes] if isinstance(shapes, Shape) else list(shapes)
    origins, directions = camera.rays(width, height, samples=2)
    canvas = Canvas(len(origins))
    # opaque shapes in one search tree
    solid = [s for s in everything if not _on_top(s) and _opacity(s) == 1]
    if solid:
        canvas.cover(_scene(solid, camera).cast(origins, directions))
    # translucent shapes are blended over them, and what is on top shows through all
    for shape in everything:
        if _opacity(shape) < 1:
            canvas.cover(_scene([shape], camera).cast(origins, directions), opacity=_opacity(shape))
    top = [s for s in everything if _on_top(s)]
    if top:
        canvas.cover(_scene(top, camera).cast(origins, directions), through=0.8)
    return canvas.finish(width, height, samples=2)


def _on_top(shape: Shape) -> bool:
    """Return whether a shape is visible through others."""
    return isinstance(shape, Dots | Bones) and shape.on_top


def _opacity(shape: Shape) -> float:
    """Return the opacity of a shape."""
    return shape.opacity if isinstance(shape, Solid) else 1.0


def _scene(shapes: Sequence[Shape], camera: Camera) -> Scene:
    """Build the scene of some shapes under a camera."""
    return Scene([_triangles(shape, camera.target) for shape in shapes], camera.axes, camera.vertical)


def _triangles(shape: Shape, origin: np.ndarray) -> LitTriangles:
    """Convert a shape to triangles, moved so that `origin` is at 0."""
    if isinstance(shape, Mesh):
        shape = Solid(shape)
    if isinstance(shape, Solid):
        mesh = shape.mesh
        flat = np.broadcast_to(mesh.face_normals[:, None], mesh.corners.shape)
        normals = mesh.vertex_normals[mesh.faces] if shape.smooth else flat
        color = own_color(shape)
        return LitTriangles(mesh.corners - origin, normals, _corner_colors(np.asarray(color, dtype=float), mesh))
    if isinstance(shape, Dots):
        points = np.atleast_2d(np.asarray(shape.points, dtype=float))
        finite = np.isfinite(points).all(axis=1)
        corners, normals, owner = balls(points[finite] - origin, shape.radius, 1 if shape.coarse else None)
        count = len(points)
    else:
        starts, ends = np.atleast_2d(shape.starts), np.atleast_2d(shape.ends)
        finite = np.isfinite(starts).all(axis=1) & np.isfinite(ends).all(axis=1)
        corners, normals, owner = capsules(starts[finite] - origin, ends[finite] - origin, shape.radius)
        count = len(starts)
    own_colors = shape.color.colors() if isinstance(shape.color, Heat) else shape.color
    color = as_light(np.broadcast_to(np.asarray(own_colors, dtype=float), (count, 3)))[finite][owner]
    return LitTriangles(corners, normals, np.repeat(color[:, None], 3, axis=1))


def own_color(solid: Solid) -> np.ndarray | Sequence[float]:
    """Return the colours of a mesh: those of the solid, else those of the mesh, else clay."""
    if isinstance(solid.color, Heat):
        return solid.color.colors()
    return solid.color if solid.color is not None else CLAY if solid.mesh.colors is None else solid.mesh.colors


def _corner_colors(color: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Return linear light (F, 3, 3) at the corners of every triangle."""
    linear = as_light(color)
    if color.shape == (3,):
        return np.broadcast_to(linear, (len(mesh.faces), 3, 3))
    if color.shape == mesh.vertices.shape:
        return linear[mesh.faces]
    if color.shape == mesh.faces.shape:
        return np.repeat(linear[:, None], 3, axis=1)
    raise ValueError(f"color: expected (3,), {mesh.vertices.shape} per vertex or {mesh.faces.shape} per triangle, "
                     f"got {color.shape}")


def sphere(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """Make a unit sphere: an icosahedron whose triangles are cut into four `divisions` times."""
    import igl

    vertices, faces = igl.icosahedron()
    for _ in range(divisions):
        vertices, faces = igl.upsample(vertices, faces)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, faces


def balls(points: np.ndarray, radius: float, divisions: int | None = None
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make a ball for each point (n, 3): corners and normals (f, 3, 3) of triangles, and the point (f,) of each.

    `divisions` is as for `sphere`; by default many balls are coarser than few.
    """
    # up to 4000 balls are divided once, up to 400 twice: the number of triangles stays within bounds
    vertices, faces = sphere(divisions if divisions is not None else sum(len(points) <= limit for limit in (4000, 400)))
    normals = vertices[faces]
    corners = points[:, None, None, None, :].swapaxes(1, 2) + radius * normals
    count = len(points)
    return (corners.reshape(-1, 3, 3), np.tile(normals, (count, 1, 1)), np.repeat(np.arange(count), len(faces)))


def capsules(starts: np.ndarray, ends: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make a rod with round ends for each pair of points (n, 3), in the form of `balls`."""
    count, sides = len(starts), 16
    # axis of each rod, and two directions across it; a rod of length 0 gets an arbitrary axis
    along = ends - starts
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.divide(along, length, out=np.tile([0.0, 0.0, 1.0], (count, 1)), where=length > 0)
    aside = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    # a ring of 16 sides around it, each side two triangles
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = (np.cos(angle)[:, None] * aside[:, None] + np.sin(angle)[:, None] * np.cross(along, aside)[:, None])
    following = np.roll(ring, -1, axis=1)
    normals = np.stack([np.stack([ring, following, following], axis=2),      # the two halves of a side
                        np.stack([ring, following, ring], axis=2)], axis=2)
    end = np.array([[0, 0, 1], [0, 1, 1]])
    place = np.stack([starts, ends], axis=1)[:, None][:, :, end]
    corners = (place + radius * normals).reshape(-1, 3, 3)
    owner = np.repeat(np.arange(count), 2 * sides)
    caps = [balls(starts, radius), balls(ends, radius)]
    return (np.concatenate([corners, *(c[0] for c in caps)]),
            np.concatenate([normals.reshape(-1, 3, 3), *(c[1] for c in caps)]),
            np.concatenate([owner, *(c[2] for c in caps)]))
