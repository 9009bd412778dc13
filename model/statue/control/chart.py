"""The texture chart of a control mesh: the seams along which it is cut, and the flattening into an image."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays
from scanprep.skeleton.tree import Skeleton
from scanprep.words import number_of


def find_seams(mesh: Mesh, skeleton: Skeleton) -> list[np.ndarray]:
    """Find a tree of seams to the tips of all limbs, preferably where the surface is hidden.

    Each seam is its vertices (k,). The tips, nearest first, are joined to the tree by the cheapest path over the edges.
    """
    graph = _costs(mesh)
    first, *rest = limb_tips(mesh, skeleton)
    tree, left, seams = np.array([first]), set(rest), list[np.ndarray]()
    while left or not seams:
        far = dijkstra(graph, directed=False, indices=tree, min_only=True)
        # one tip only: through the body to its far end
        goal = min(left, key=lambda v: (far[v], v)) if left else int(far.argmax())
        left.discard(goal)
        seam = join(graph, tree, goal)
        if len(seam) > 1:
            seams.append(seam)
            tree = np.union1d(tree, seam)
    return seams


def join(graph: csr_array, tree: np.ndarray, goal: int) -> np.ndarray:
    """Find the cheapest path (k,) over a graph from any vertex of `tree` to `goal`."""
    before = dijkstra(graph, directed=False, indices=tree, min_only=True, return_predecessors=True)[1]
    path = [goal]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return np.array(path[::-1])


def limb_tips(mesh: Mesh, skeleton: Skeleton) -> list[int]:
    """Find the tips of limbs: one vertex for each part without children, and for the root with only one child."""
    x, y = mesh.edges.T
    graph = coo_array((mesh.edge_lengths, (x, y)), shape=2 * (len(mesh.vertices),)).tocsr()
    part, parents = skeleton.part_of_vertex(mesh), skeleton.parents
    tips = []
    for p in range(len(parents)):
        children = np.flatnonzero(parents == p)
        if len(children) > (1 if p == 0 else 0):
            continue
        own = np.flatnonzero(part == p)
        if not len(own):
            continue
        joint = int(children[0]) if p == 0 and len(children) else p   # where it meets its neighbour
        start = skeleton.ring(mesh, joint) if joint else own[:0]
        if not len(start):
            start = own[[np.linalg.norm(mesh.vertices[own] - skeleton.joints[joint], axis=1).argmin()]]
        far = dijkstra(graph, directed=False, indices=start, min_only=True)
        tips.append(int(own[far[own].argmax()]))
    return sorted(set(tips))


def cut(mesh: Mesh, seams: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Cut a closed mesh along seams: return triangles (F, 3) and the old vertex (M,) of each new one."""
    if not mesh.is_closed:
        raise ValueError("mesh: expected a closed surface")
    # edges of the seams are open; corners joined across the other edges become one vertex
    number = {edge: k for k, edge in enumerate(map(tuple, mesh.edges.tolist()))}
    is_open = np.zeros(len(mesh.edges), dtype=bool)
    for seam in seams:
        for a, b in zip(seam[:-1].tolist(), seam[1:].tolist(), strict=True):
            if (min(a, b), max(a, b)) not in number:
                raise ValueError(f"seams: vertices {a} and {b} follow each other but no edge joins them")
            is_open[number[min(a, b), max(a, b)]] = True
    sides = np.argsort(mesh.face_edges.ravel(), kind="stable").reshape(-1, 2)[~is_open]    # the two at every edge
    begin, end = sides, sides - sides % 3 + (sides + 1) % 3            # corners; the two sides run in opposite ways
    fan = sparse.label_components(np.r_[begin[:, 0], end[:, 0]], np.r_[end[:, 1], begin[:, 1]], mesh.faces.size)
    _, first = np.unique(fan, return_index=True)
    return fan.reshape(-1, 3).astype(np.int64), mesh.faces.ravel()[first]


def _costs(mesh: Mesh) -> csr_array:
    """Build a graph of edge lengths in which visible edges are up to twice as long."""
    # visibility of each vertex: the share of 48 directions, evenly over the sphere, that nothing occludes
    k = np.arange(48) + 0.5
    z, turn = 1 - 2 * k / 48, np.pi * (1 + 5**0.5) * k
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    cosine = np.maximum(mesh.vertex_normals @ directions.T, 0)
    vertex, ray = np.nonzero(cosine)
    start = mesh.vertices[vertex] + 1e-3 * mesh.mean_edge * mesh.vertex_normals[vertex]
    free = ~Rays(mesh).test_occlusion(start, directions[ray])
    weight = cosine[vertex, ray]
    n = len(mesh.vertices)
    seen = np.bincount(vertex, weight * free, n) / np.maximum(np.bincount(vertex, weight, n), 1e-12)
    x, y = mesh.edges.T
    return csr_array(coo_array((mesh.edge_lengths * (1 + (seen[x] + seen[y]) / 2), (x, y)), shape=(n, n)))


@dataclass(frozen=True, eq=False)
class Chart:
    """Texture coordinates of a mesh in one connected piece. [Statues] Eq. 21"""

    uv: np.ndarray     # (M, 2) in [0, 1], from the lower left corner of the image; a vertex on a seam has several
    faces: np.ndarray  # (F, 3), the rows of `uv` at the corners of every triangle of the mesh, in its order

    @cached_property
    def flat(self) -> Mesh:
        """The chart as a mesh in the plane z = 0."""
        return Mesh(np.column_stack([self.uv, np.zeros(len(self.uv))]), self.faces)

    def texels(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Find the pixels whose centres lie in the chart: rows (0 on top), columns, faces (n,), barycentric (n, 3).

        [Statues] Eq. 21
        """
        # the bounding box of every triangle in pixels, and the barycentric coordinates of all pixels in it
        corners = self.uv[self.faces] * size - 0.5                     # pixel centres have whole numbers here
        low = np.maximum(np.ceil(corners.min(axis=1)).astype(np.int64), 0)
        count = np.maximum(np.minimum(np.floor(corners.max(axis=1)).astype(np.int64), size - 1) - low + 1, 0)
        boxes = count.prod(axis=1)
        face = np.repeat(np.arange(len(boxes)), boxes)
        within = np.arange(len(face)) - np.repeat(np.cumsum(boxes) - boxes, boxes)
        at = low[face] + np.stack(np.divmod(within, np.maximum(count[face, 1], 1)), axis=1)
        bary = planar_barycentric(at, *corners[face].swapaxes(0, 1))
        inside = (bary >= -1e-12).all(axis=1)
        pixel = (size - 1 - at[inside, 1]) * size + at[inside, 0]
        pixel, first = np.unique(pixel, return_index=True)             # a centre on an edge lies in two triangles
        bary = np.maximum(bary[inside][first], 0)
        return pixel // size, pixel % size, face[inside][first], bary / bary.sum(axis=1, keepdims=True)


def make_chart(mesh: Mesh, seams: Sequence[np.ndarray]) -> Chart:
    """Cut a closed mesh along a tree of seams into one disk, and flatten it into the unit square."""
    faces, corner = cut(mesh, seams)
    disk = Mesh(mesh.vertices[corner], faces)
    euler = len(disk.vertices) - len(disk.edges) + len(disk.faces)
    if disk.vertex_component.max() > 0 or euler != 1 or len(disk.boundary_loops) != 1:
        raise ValueError(f"seams: expected a tree of edges that cuts the mesh into one disk, got "
                         f"{disk.vertex_component.max() + 1} pieces with Euler number {euler}")
    uv = flatten(disk)
    # rotate by the angle with the smallest bounding square and scale that to the unit square, with a margin of six of
    # 1,024 pixels
    angles = np.radians(np.arange(0, 90, 0.5))
    cos, sin = np.cos(angles), np.sin(angles)
    places = np.einsum("ija,nj->ani", np.array([[cos, -sin], [sin, cos]]), uv)
    extent = np.ptp(places, axis=1).max(axis=1)
    best = places[extent.argmin()]
    middle = (best.min(axis=0) + best.max(axis=0)) / 2
    chart = Chart(0.5 + (best - middle) * (1 - 2 * 6 / 1024) / extent.min(), faces)
    problem = chart_problem(mesh, chart)
    assert problem is None, problem
    return chart


def automatic_chart(mesh: Mesh, skeleton: Skeleton) -> Chart:
    """Make a chart and extend its seams to crowded regions, such as fingertips; at most four charts are made."""
    seams, graph = find_seams(mesh, skeleton), _costs(mesh)
    chart = make_chart(mesh, seams)
    for _ in range(3):
        # another seam to the smallest triangle of every region that is scaled below a third of the mean, in length
        density, longer = densities(mesh, chart), list(seams)
        crowded = np.flatnonzero(density < 1 / 3)
        region = mesh.submesh(crowded)[0]
        region_of = region.vertex_component[region.faces[:, 0]]
        for k in np.unique(region_of):
            own = crowded[region_of == k]
            seam = join(graph, np.unique(np.concatenate(longer)), int(mesh.faces[own[density[own].argmin()], 0]))
            longer += [seam] if len(seam) > 1 else []
        if len(longer) == len(seams):
            break
        seams, chart = longer, make_chart(mesh, longer)
    return chart


def densities(mesh: Mesh, chart: Chart) -> np.ndarray:
    """Compute the scale (F,) of each triangle in the chart relative to the mean, in length."""
    drawn = _twice_area(*chart.uv[chart.faces].swapaxes(0, 1)) / 2
    return np.sqrt(drawn / mesh.face_areas * mesh.face_areas.sum() / drawn.sum())


def flatten(mesh: Mesh) -> np.ndarray:
    """Flatten a surface with one border into the plane, (N, 2), one-to-one and with its area.

    From Tutte's embedding, libigl's SLIM lowers the symmetric Dirichlet energy. Its steps invert no triangle, and are
    halved until the border does not cross itself.
    """
    import igl

    # Tutte: the border on a circle, every other vertex in the mean of its neighbours
    border = mesh.boundary_loops[0]
    sides = np.linalg.norm(mesh.vertices[border] - np.roll(mesh.vertices[border], -1, axis=0), axis=1)
    angle = 2 * np.pi * np.r_[0, np.cumsum(sides)[:-1]] / sides.sum()
    uv = np.zeros((len(mesh.vertices), 2))
    uv[border] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    uv = sparse.harmonic(mesh.vertex_adjacency, uv, np.isin(np.arange(len(uv)), border))
    uv *= np.sqrt(2 * mesh.face_areas.sum() / _twice_area(*uv[mesh.faces].swapaxes(0, 1)).sum())
    vertices, faces = np.asfortranarray(mesh.vertices), np.asfortranarray(mesh.faces.astype(np.int32))
    for _ in range(100):
        slim = igl.slim_precompute(vertices, faces, np.asfortranarray(uv), igl.MappingEnergyType.SYMMETRIC_DIRICHLET,
                                   np.zeros(0, dtype=np.int32), np.zeros((0, 2), order="F"), 0.0)
        step = np.asarray(igl.slim_solve(slim, 1))[:, :2] - uv
        while crossings((uv + step)[border]):
            step /= 2
        uv = uv + step
        if np.linalg.norm(step, axis=1).max() < 1e-3 * mesh.mean_edge:
            break
    return uv


def chart_problem(mesh: Mesh, chart: Chart) -> str | None:
    """Explain why a chart cannot carry the images of a mesh; None where it can.

    A usable chart is one disk inside the unit square, without inverted triangles, whose border does not meet itself.
    """
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
    inverted = np.flatnonzero(orientation(*corners.swapaxes(0, 1)) <= 0)
    if len(inverted):
        return f"{number_of(len(inverted), 'triangle is', 'triangles are')} inverted, the first is face {inverted[0]}"
    if crossings(chart.uv[flat.boundary_loops[0]]):
        return "its border crosses itself: places of the image belong to two places of the surface"
    return None


def _twice_area(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Compute twice the signed area (n,) of triangles in the plane."""
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def planar_barycentric(points: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Compute barycentric coordinates (n, 3) of points in triangles of the plane; negative outside."""
    parts = np.stack([_twice_area(points, b, c), _twice_area(points, c, a), _twice_area(points, a, b)], axis=1)
    return parts / _twice_area(a, b, c)[:, None]


def crossings(loop: np.ndarray) -> bool:
    """Return whether a closed polygon (n, 2) meets itself other than at the ends of successive sides, exactly."""
    a, b = loop, np.roll(loop, -1, axis=0)
    n = len(loop)
    low, high = np.minimum(a, b), np.maximum(a, b)
    near = (low[:, None] <= high[None]).all(axis=2) & (low[None] <= high[:, None]).all(axis=2)
    i, j = np.nonzero(np.triu(near, 2))
    apart = (j - i) % n != n - 1
    i, j = i[apart], j[apart]
    for _ in range(2):              # two sides cross if each has its ends on both sides of the other's line
        met = orientation(a[i], b[i], a[j]) * orientation(a[i], b[i], b[j]) <= 0
        i, j = j[met], i[met]
    return bool(len(i))


def orientation(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Compute the exact orientation (n,) of triangles in the plane: 1 counter-clockwise, 0 without area, -1 clockwise.
    """
    first = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1])
    second = (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    sign = np.sign(first - second).astype(int)
    # where rounding could change the sign, it is computed with fractions
    for k in np.flatnonzero(np.abs(first - second) <= 1e-15 * (np.abs(first) + np.abs(second))):
        (ax, ay), (bx, by), (cx, cy) = (map(Fraction, map(float, p[k])) for p in (a, b, c))
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        sign[k] = (area > 0) - (area < 0)
    return sign
