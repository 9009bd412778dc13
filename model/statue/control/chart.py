"""One flat chart of a control mesh: where every triangle lies in an image."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .seams import cut, extended, find_seams

MARGIN = 6 / 1024                    # of the image, left free around the chart
FINE = 1 / 3                         # of the mean density, in length: coarser triangles ask for one more seam


@dataclass(frozen=True, eq=False)
class Chart:
    """Texture coordinates of a mesh in one connected piece. [Statues] Eq. 21"""

    uv: np.ndarray     # (M, 2) in [0, 1], (0, 0) is the lower left corner of the image, (1, 1) its upper right one. A
                       # vertex on a seam has several
    faces: np.ndarray  # (F, 3), the rows of `uv` at the corners of every triangle of the mesh, in its order

    @cached_property
    def flat(self) -> Mesh:
        """The chart as a mesh in the plane z = 0."""
        return Mesh(np.column_stack([self.uv, np.zeros(len(self.uv))]), self.faces)

    def texels(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The pixels of a square image of so many pixels a side whose centres lie in the chart: rows (n,), 0 the upper
        one, columns (n,), and the faces (n,) and bary (n, 3) where they lie. [Statues] Eq. 21
        """
        corners = self.uv[self.faces] * size - 0.5                     # pixel centres have whole numbers here
        low = np.maximum(np.ceil(corners.min(axis=1)).astype(np.int64), 0)
        count = np.maximum(np.minimum(np.floor(corners.max(axis=1)).astype(np.int64), size - 1) - low + 1, 0)
        boxes = count.prod(axis=1)
        face = np.repeat(np.arange(len(boxes)), boxes)
        within = np.arange(len(face)) - np.repeat(np.cumsum(boxes) - boxes, boxes)
        at = low[face] + np.stack(np.divmod(within, np.maximum(count[face, 1], 1)), axis=1)
        a, b, c = (corners[face, k] for k in range(3))
        bary = np.stack([_twice_area(at, b, c), _twice_area(at, c, a), _twice_area(at, a, b)], axis=1)
        bary /= _twice_area(a, b, c)[:, None]
        inside = (bary >= -1e-12).all(axis=1)
        pixel = (size - 1 - at[inside, 1]) * size + at[inside, 0]
        pixel, first = np.unique(pixel, return_index=True)             # a centre on an edge lies in two triangles
        bary = np.maximum(bary[inside][first], 0)
        return pixel // size, pixel % size, face[inside][first], bary / bary.sum(axis=1, keepdims=True)


def make_chart(mesh: Mesh, seams: Sequence[np.ndarray]) -> Chart:
    """A closed mesh cut along seams and laid flat in the unit square. Each seam is the vertices (k,) that it passes;
    ValueError where the seams, together a tree, do not cut the mesh into one disk.
    """
    from .flatten import flatten

    faces, corner = cut(mesh, seams)
    disk = Mesh(mesh.vertices[corner], faces)
    euler = len(disk.vertices) - len(disk.edges) + len(disk.faces)
    if disk.vertex_component.max() > 0 or euler != 1 or len(disk.boundary_loops) != 1:
        raise ValueError(f"seams: expected a tree of edges that cuts the mesh into one disk, got "
                         f"{disk.vertex_component.max() + 1} pieces with Euler number {euler}")
    chart = Chart(fill_square(flatten(disk), disk), faces)
    problem = chart_problem(mesh, chart)
    assert problem is None, problem
    return chart


def automatic_chart(mesh: Mesh, skeleton: Skeleton, rounds: int = 4) -> Chart:
    """A chart along the seams of `find_seams`, which go on to where it is crowded, such as the tips of fingers;
    `rounds` charts at most.
    """
    seams = find_seams(mesh, skeleton)
    chart = make_chart(mesh, seams)
    for _ in range(rounds - 1):
        crowded = crowded_places(mesh, densities(mesh, chart))
        longer = seams
        for vertex in crowded:
            longer = extended(mesh, longer, vertex)
        if len(longer) == len(seams):
            break
        seams, chart = longer, make_chart(mesh, longer)
    return chart


def crowded_places(mesh: Mesh, density: np.ndarray) -> list[int]:
    """A vertex of the smallest triangle of every region that is drawn smaller than `FINE`."""
    crowded = np.flatnonzero(density < FINE)
    part, old = mesh.submesh(crowded)
    region = part.vertex_component[part.faces[:, 0]]
    return [int(old[part.faces[np.flatnonzero(region == k)[density[crowded][region == k].argmin()], 0]])
            for k in np.unique(region)]


def densities(mesh: Mesh, chart: Chart) -> np.ndarray:
    """(F,) how large each triangle is drawn against the mean of the surface, in length."""
    drawn = _twice_area(*chart.uv[chart.faces].swapaxes(0, 1)) / 2
    return np.sqrt(drawn / mesh.face_areas * mesh.face_areas.sum() / drawn.sum())


def fill_square(uv: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Turned and scaled so that the smallest square around it is the unit square without its margin."""
    angles = np.radians(np.arange(0, 90, 0.5))
    cos, sin = np.cos(angles), np.sin(angles)
    places = np.einsum("ija,nj->ani", np.array([[cos, -sin], [sin, cos]]), uv)
    extent = np.ptp(places, axis=1).max(axis=1)
    best = places[extent.argmin()]
    middle = (best.min(axis=0) + best.max(axis=0)) / 2
    return 0.5 + (best - middle) * (1 - 2 * MARGIN) / extent.min()


def chart_problem(mesh: Mesh, chart: Chart) -> str | None:
    """Why a chart cannot carry the images of a mesh, or None when it can.

    A chart is one disk inside the unit square, no triangle turned over, whose border does not meet itself: then it
    is one-to-one.
    """
    from .flatten import crossings, orientation

    if chart.faces.shape != mesh.faces.shape:
        return f"it has {len(chart.faces)} triangles, the mesh {len(mesh.faces)}"
    if not (np.isfinite(chart.uv).all() and (chart.uv >= 0).all() and (chart.uv <= 1).all()):
        return "it leaves the unit square"
    flat = chart.flat
    pieces = int(flat.vertex_component[chart.faces].max()) + 1
    if pieces > 1:
        return f"it is in {pieces} charts, expected one"
    if not flat.is_edge_manifold or len(flat.boundary_loops) != 1:
        return f"expected one border, it has {len(flat.boundary_loops)}"
    corners = chart.uv[chart.faces]
    turned = np.flatnonzero(orientation(*corners.swapaxes(0, 1)) <= 0)
    if len(turned):
        return f"{len(turned)} triangles are turned over, the first is face {turned[0]}"
    if crossings(chart.uv[flat.boundary_loops[0]]):
        return "its border crosses itself: places of the image belong to two places of the surface"
    return None


def _twice_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed area (n,) of triangles in the plane."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
