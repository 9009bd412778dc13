"""Where the normals of a control mesh cross the surface of a scan [Statues]."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays

from .normal_volume import interpolate

SKIP = 2e-5                          # metres: a ray goes on this far behind what it met
SAME = 1e-6                          # metres: two crossings nearer to each other are one, met on a shared edge
OVERLAP = 0.01                       # metres: farther apart, two views have not met the same surface
LAYERS = 30                          # crossings of one normal that are looked for
NEAREST = 0.003                      # metres: crossings up to this height are never those of another body part
THICK = 0.75                         # share of the way to the other side of a limb, or across a gap, that heights go


@dataclass(frozen=True, eq=False)
class Crossings:
    """Crossings of normals with a surface, ordered by normal and height."""

    normal: np.ndarray   # (k,), which normal
    heights: np.ndarray  # (k,) metres
    cosines: np.ndarray  # (k,), between the normals of both; negative where the surface is met from inside
    faces: np.ndarray    # (k,), triangle of the scan

    def pick(self, keep: np.ndarray) -> Crossings:
        """Only some of them."""
        return Crossings(self.normal[keep], self.heights[keep], self.cosines[keep], self.faces[keep])


def outer_layers(found: Crossings) -> Crossings:
    """The crossings that meet the scan from outside, sheets of overlapping views as one at their mean height.

    Two layers of a fold have one between them that is met from inside; two views of one surface have not.
    """
    outside = found.cosines > 0
    layer = np.cumsum(~outside)[outside]
    front = found.pick(outside)
    begins = np.ones(len(front.normal), dtype=bool)
    begins[1:] = ((front.normal[1:] != front.normal[:-1]) | (layer[1:] != layer[:-1])
                  | (front.heights[1:] - front.heights[:-1] > OVERLAP))
    group = np.cumsum(begins) - 1
    count = np.maximum(np.bincount(group), 1)
    return Crossings(front.normal[begins], np.bincount(group, front.heights) / count,
                     np.bincount(group, front.cosines) / count, front.faces[begins])


def find_crossings(scan: Mesh, rays: Rays, points: np.ndarray, normals: np.ndarray, reach: float) -> Crossings:
    """Every crossing of normals (n, 3), of any length, at points (n, 3) with a scan, at most `reach` metres away.

    Embree tells which triangle is met, in single precision; where, the triangle's plane says in double.
    """
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    along = normals / length[:, None]
    active, at = np.arange(len(points)), np.full(len(points), -reach)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for _ in range(LAYERS):
        face, far = rays.cast(points[active] + at[active, None] * along[active], along[active], 2 * reach)
        met = face >= 0
        active, face, far = active[met], face[met], far[met]
        at[active] += far + SKIP
        inside = at[active] < reach
        active, face = active[inside], face[inside]
        if not len(active):
            break
        found.append((active, face))
    normal = np.concatenate([a for a, _ in found]) if found else np.zeros(0, dtype=int)
    face = np.concatenate([f for _, f in found]) if found else np.zeros(0, dtype=int)
    N, m = scan.face_normals[face], along[normal]
    cosine = np.einsum("nd,nd->n", N, m)
    away = np.einsum("nd,nd->n", scan.corners[face, 0] - points[normal], N)
    steep = np.abs(cosine) < 1e-3                           # seen from the edge: where, is not to be said
    height = away / np.where(steep, 1, cosine)
    order = np.lexsort((height, normal))
    normal, height, cosine, face, steep = (v[order] for v in (normal, height, cosine, face, steep))
    again = np.zeros(len(normal), dtype=bool)
    again[1:] = (normal[1:] == normal[:-1]) & (height[1:] - height[:-1] < SAME) & (cosine[1:] * cosine[:-1] > 0)
    keep = ~again & ~steep & (np.abs(height) <= reach)
    return Crossings(normal[keep], (height / length[normal])[keep], cosine[keep], face[keep])


def limits(control: Mesh, points: np.ndarray, normals: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest distance (n,) along normals before which no other body part is met, metres."""
    along = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    rays = Rays(control)
    ends = []
    for side in (-along, along):
        far = rays.cast(points + 1e-4 * side, side, reach / THICK)[1]
        ends.append(np.maximum(THICK * np.nan_to_num(far, nan=reach / THICK), NEAREST))
    return -ends[0], ends[1]


def unturned(control: Mesh, faces: np.ndarray, bary: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """(n,) bool: up to these heights the displaced triangles are nowhere turned over.

    The area of the displaced triangle, as seen along the normal, is a quadratic in the height, and 1 at height 0.
    """
    corners, normals = control.corners[faces], control.vertex_normals[control.faces[faces]]
    _, n = interpolate(control, faces, bary)
    e, f = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p, q = normals[:, 1] - normals[:, 0], normals[:, 2] - normals[:, 0]

    def seen(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("nd,nd->n", np.cross(a, b), n)

    c0, c1, c2 = seen(e, f), seen(e, q) + seen(p, f), seen(p, q)
    good = c0 > 0
    for part in (0.25, 0.5, 0.75, 1.0):
        d = part * heights
        good &= c0 + d * (c1 + d * c2) > 0.05 * c0
    return good
