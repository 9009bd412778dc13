"""Light on triangles under a camera: ray casting, shading, and the canvas that collects the result."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.format_common import as_seen

# Three-point lighting: directions in the camera's frame (right, up, back) and linear strengths. The key light models
# the form, the fill softens its shadows, the rim light from behind separates the body from the background.
KEY, FILL, RIM = ((-0.58, 0.62, 0.52), 1.00), ((0.85, 0.05, 0.50), 0.13), ((0.62, 0.40, -0.68), 0.50)
# linear ambient light from above, bluish, and from the ground, warmer and darker
SKY, BOUNCE = np.array([0.32, 0.34, 0.38]), np.array([0.20, 0.175, 0.16])


@dataclass(frozen=True, eq=False)
class LitTriangles:
    """Triangles to be lit: corners (F, 3, 3) with unit normals and linear colours, both (F, 3, 3)."""

    corners: np.ndarray
    normals: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True, eq=False)
class Seen:
    """What rays hit: numbers of the rays (n,), linear colours (n, 3), cosine to the normal (n,), depth (n,)."""

    rays: np.ndarray
    colors: np.ndarray
    facing: np.ndarray
    depth: np.ndarray


class Scene:
    """Triangles in one search tree, with the camera's frame `axes` (3, 3) and the direction away from the ground."""

    def __init__(self, shapes: Sequence[LitTriangles], axes: np.ndarray, vertical: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.axes, self.vertical = axes, vertical
        self.corners = np.concatenate([s.corners for s in shapes]).astype(np.float32)
        c = self.corners
        self.outward = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
        # of every corner: normal (3), colour (3); interpolated together
        self.attributes = np.concatenate([np.concatenate([s.normals, s.colors], axis=2) for s in shapes]
                                         ).astype(np.float32)
        self._tree = EmbreeScene()
        self._kept = TriangleMesh(self._tree, c.reshape(-1, 3), np.arange(3 * len(c), dtype=np.int32).reshape(-1, 3))

    def cast(self, origins: np.ndarray, directions: np.ndarray) -> Seen:
        """Cast rays, and shade what they hit."""
        if not len(self.corners):
            return Seen(np.empty(0, int), np.empty((0, 3), np.float32), *np.empty((2, 0), np.float32))
        hit = self._tree.run(np.ascontiguousarray(origins), np.ascontiguousarray(directions), output=True)
        rays = np.flatnonzero(hit["primID"] >= 0)
        face = hit["primID"][rays]
        # interpolate at the place that each ray hits
        u, v = hit["u"][rays], hit["v"][rays]
        bary = np.stack([1 - u - v, u, v], axis=1)
        return Seen(rays, *self._shade(face, bary, directions[rays]), hit["tfar"][rays])

    def _shade(self, face: np.ndarray, bary: np.ndarray, directions: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the linear colour (n, 3) of points on triangles, and the cosine between ray and normal."""
        at = np.einsum("nc,ncd->nd", bary, self.attributes[face])
        normal, color = at[:, :3], at[:, 3:6]
        inner = np.einsum("nd,nd->n", self.outward[face], directions) > 0
        # seen from inside, the normal is turned towards the camera
        normal = _unit(normal) * np.where(inner, -1, 1)[:, None].astype(np.float32)
        # the inner side of an open surface is dark and bluish
        color = np.where(inner[:, None], color * np.array([0.30, 0.33, 0.40]).astype(np.float32), color)
        # diffuse light of the three lamps, and of the sky above and the ground below
        lights = [(_unit(np.array(d)) @ self.axes).astype(np.float32) for d, _ in (KEY, FILL, RIM)]
        key, fill, rim = (np.maximum(normal @ d, 0)[:, None] for d in lights)
        upward = 0.5 + 0.5 * (normal @ self.vertical.astype(np.float32))[:, None]
        sky = (upward * SKY + (1 - upward) * BOUNCE).astype(np.float32)
        facing = np.clip(-np.einsum("nd,nd->n", normal, directions), 0, 1)[:, None]
        # Blinn-Phong highlight of the key light, and a brighter edge at grazing angles
        half = _unit(lights[0] - directions)
        gloss = np.maximum(np.einsum("nd,nd->n", normal, half), 0)[:, None] ** 24
        diffuse = sky + KEY[1] * key + FILL[1] * fill + RIM[1] * rim
        sheen = 0.07 * gloss + 0.10 * (1 - facing) ** 4
        return color * diffuse + np.where(inner[:, None], 0, sheen), facing[:, 0]



class Canvas:
    """Colour, opacity and depth of `count` rays, painted layer by layer, then averaged to a picture."""

    def __init__(self, count: int) -> None:
        self.color = np.zeros((count, 3), dtype=np.float32)       # linear light times alpha
        self.alpha = np.zeros(count, dtype=np.float32)
        self.depth = np.full(count, np.inf, dtype=np.float32)

    def cover(self, seen: Seen, opacity: float = 1.0, through: float = 0.0) -> None:
        """Paint what is nearer than what is there; with the alpha `through`, also what is hidden.

        Translucent shapes let less light pass at a slant, like a shell.
        """
        rays, depth = seen.rays, seen.depth
        alpha = opacity + (1 - opacity) * (1 - seen.facing) ** 2 if opacity < 1 else 1.0
        alpha = np.where(depth < self.depth[rays], alpha, through).astype(np.float32)
        self.color[rays] = seen.colors * alpha[:, None] + self.color[rays] * (1 - alpha[:, None])
        self.alpha[rays] = alpha + self.alpha[rays] * (1 - alpha)
        nearer = (alpha >= 1) & (depth < self.depth[rays])
        self.depth[rays[nearer]] = depth[nearer]

    def finish(self, width: int, height: int, samples: int) -> np.ndarray:
        """Average the rays of every pixel and put them on white."""
        def mean(values: np.ndarray) -> np.ndarray:
            """Average the samples of each pixel."""
            rows = values.reshape(height * samples, width * samples, -1)
            parts = [rows[i::samples, j::samples] for i in range(samples) for j in range(samples)]
            return np.add.reduce(parts) / len(parts)

        color, alpha = mean(self.color), mean(self.alpha)
        # blend with white in display values, so that shadows fade evenly
        inked = as_seen(np.divide(color, alpha, out=np.zeros_like(color), where=alpha > 0))
        return np.clip(255 * (inked * alpha + 1 - alpha) + 0.5, 0, 255).astype(np.uint8)


def sphere_directions(count: int) -> np.ndarray:
    """Make unit vectors (count, 3) spread evenly over the sphere on a golden spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - 5 ** 0.5) * np.arange(count)
    r = np.sqrt(1 - z * z)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)


def _unit(v: np.ndarray) -> np.ndarray:
    """Scale vectors to length 1; a zero vector stays."""
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-20).astype(v.dtype)
