"""One flat chart of a control mesh: where every triangle lies in an image."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scanprep.geometry.mesh import Mesh

MARGIN = 6 / 1024                    # of the image, left free around the chart


@dataclass(frozen=True, eq=False)
class Chart:
    """Texture coordinates of a mesh in one connected piece.

    Parameters
    ----------
    uv : (M, 2) float in [0, 1]
        (0, 0) is the lower left corner of the image, (1, 1) its upper right one. A vertex on a seam has several.
    faces : (F, 3) int
        The rows of `uv` at the corners of every triangle of the mesh, in its order.

    [Statues] Eq. 21
    """

    uv: np.ndarray
    faces: np.ndarray

    @cached_property
    def flat(self) -> Mesh:
        """The chart as a mesh in the plane z = 0."""
        return Mesh(np.column_stack([self.uv, np.zeros(len(self.uv))]), self.faces)

    def texels(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The pixels of a square image whose centres lie in the chart, and where they lie.

        Parameters
        ----------
        size : int, pixels of a side

        Returns
        -------
        rows, columns : (n,) int
            Row 0 is the upper one.
        faces : (n,) int
        bary : (n, 3) float

        [Statues] Eq. 21
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
    """A closed mesh cut along seams and laid flat in the unit square.

    Parameters
    ----------
    mesh : Mesh
    seams : paths over edges, each the vertices (k,) that it passes
        Together a tree.

    Raises
    ------
    ValueError
        Seams that do not cut the mesh into one disk.
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


def cut(mesh: Mesh, seams: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (F, 3) of the mesh opened along seams, and the vertex (M,) that each of the new ones was.

    Raises
    ------
    ValueError
        A seam that leaves the edges.
    """
    number = {edge: k for k, edge in enumerate(map(tuple, mesh.edges.tolist()))}
    open_edge = np.zeros(len(mesh.edges), dtype=bool)
    for seam in seams:
        for a, b in zip(seam[:-1].tolist(), seam[1:].tolist(), strict=True):
            if (min(a, b), max(a, b)) not in number:
                raise ValueError(f"seams: vertices {a} and {b} follow each other but no edge joins them")
            open_edge[number[min(a, b), max(a, b)]] = True
    order = np.argsort(mesh.face_edges.ravel(), kind="stable").reshape(-1, 2)    # the two sides at every edge
    p, q = order[~open_edge].T
    end = [k - k % 3 + (k + 1) % 3 for k in (p, q)]
    rows, columns = np.r_[p, end[0]], np.r_[end[1], q]                 # sides run in opposite directions
    n = mesh.faces.size
    _, label = connected_components(coo_array((np.ones(len(rows)), (rows, columns)), shape=(n, n)), directed=False)
    _, first, fan = np.unique(label, return_index=True, return_inverse=True)
    return fan.reshape(-1, 3), mesh.faces.ravel()[first]


def fill_square(uv: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Turned and scaled so that the smallest square around it is the unit square without its margin."""
    angles = np.radians(np.arange(0, 90, 0.5))
    turned = np.stack([np.stack([np.cos(angles), -np.sin(angles)], 1), np.stack([np.sin(angles), np.cos(angles)], 1)], 1)
    places = np.einsum("aij,nj->ani", turned, uv)
    extent = np.ptp(places, axis=1).max(axis=1)
    best = places[extent.argmin()]
    middle = (best.min(axis=0) + best.max(axis=0)) / 2
    return 0.5 + (best - middle) * (1 - 2 * MARGIN) / extent.min()


def chart_problem(mesh: Mesh, chart: Chart) -> str | None:
    """Why a chart cannot carry the images of a mesh, or None when it can.

    A chart is one disk inside the unit square, no triangle turned over, whose border does not meet itself: then it
    is one-to-one.
    """
    from .flatten import crossings

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
    turned = np.flatnonzero(_twice_area(*corners.swapaxes(0, 1)) <= 0)
    if len(turned):
        return f"{len(turned)} triangles are turned over, the first is face {turned[0]}"
    if crossings(chart.uv[flat.boundary_loops[0]]):
        return "its border crosses itself: places of the image belong to two places of the surface"
    return None


def _twice_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Twice the signed area (n,) of triangles in the plane."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
