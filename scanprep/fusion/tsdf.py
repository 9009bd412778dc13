"""Fuse range views into one surface by a truncated signed distance volume [VRIP]."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from scipy.sparse.csgraph import dijkstra

from ..geometry.mesh import Mesh, take_any_mesh
from ..geometry.remeshing import smooth_taubin
from ..geometry.sparse import unique_integers
from ..geometry.surface import Rays, barycentric, mesh_and_camera
from ..ranges import Cell, Cosine, Range, Settings
from ..repair.manifold import drop_small_components, split_vertices

SPECK = 0.02                   # components with a smaller share of the vertices of the largest one are dropped
BLOCK = 4                      # voxels along the side of a block, the unit of sparse storage; limits the truncation


@dataclass(frozen=True)
class MergeConfig(Settings):
    """Settings of `merge_views`.

    Attributes
    ----------
    voxel : float, metres
        Edge length of a voxel; triangles of the result have about this size.
    truncation : float, voxels
        Distance from a view's surface within which it contributes, at most 4.
    min_cosine : float
        Surface whose cosine to the line of sight is smaller has no weight.

    Examples
    --------
    >>> MergeConfig(voxel=0.01).truncation
    3.0
    """

    voxel: Cell = 0.004
    truncation: Annotated[float, Range(1, BLOCK)] = 3.0
    min_cosine: Cosine = 0.1


@dataclass(frozen=True, eq=False)
class _View:
    """A range view prepared for ray casting."""

    mesh: Mesh
    camera: np.ndarray
    rays: Rays
    cosines: np.ndarray        # (N,) between normals and lines of sight, at the vertices
    weights: np.ndarray        # (N,)

    def look(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Cast rays from the camera through points (n, 3): triangle hit or -1, signed distance to it, weight,
        barycentric.

        The distance is positive in front of the surface.
        """
        along = points - self.camera
        depth = np.linalg.norm(along, axis=1)
        along /= depth[:, None]
        face, hit = self.rays.cast(self.camera[None].repeat(len(points), axis=0), along)
        seen = face >= 0
        # interpolate weight and cosine at the hit; the cosine turns depth differences into distances to the plane
        where = self.camera + hit[seen, None] * along[seen]
        bary = np.zeros((len(points), 3))
        bary[seen] = np.clip(barycentric(where, self.mesh.corners[face[seen]]), 0, 1)
        corners = self.mesh.faces[face]
        weight = np.einsum("nc,nc->n", bary, self.weights[corners])
        cosine = np.einsum("nc,nc->n", bary, self.cosines[corners])
        return face, (hit - depth) * cosine, weight, bary


@take_any_mesh
def merge_views(views: Sequence[Any], config: MergeConfig | None = None,
                progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Merge several range views with known cameras into one surface.

    Each view measures along its lines of sight the signed distance of nearby voxels to its surface. The merged surface
    is where the weighted mean of these distances changes sign. It stays open where no view has data.

    Parameters
    ----------
    views : sequence of RangeView or of (Mesh, (3,) float) pairs, metres
        Surfaces with their camera positions, in one coordinate frame. See `align_views` if they are not quite aligned.
    config : MergeConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Mesh
        A manifold surface, metres, with borders; with colours if all views have them.

    Raises
    ------
    ValueError
        No views, or no surface left after merging.

    Examples
    --------
    >>> x, y = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40))
    >>> i = np.arange(1600).reshape(40, 40)
    >>> a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    >>> view = Mesh(np.stack([x, y, 0.1 * x * y], axis=-1).reshape(-1, 3), np.r_[np.c_[a, b, c], np.c_[a, c, d]])
    >>> cameras = np.array([[0.5, 0.5, 3.0], [1.0, 0.5, 3.0]])
    >>> bool(merge_views([(view, camera) for camera in cameras], MergeConfig(voxel=0.05)).face_areas.sum() > 0.7)
    True

    [VRIP] volumetric integration, tapered weights
    """
    config = config or MergeConfig()
    prepared = [_prepare(mesh, camera, config) for mesh, camera in map(mesh_and_camera, views)]
    if not prepared:
        raise ValueError("views: expected at least one, got none")
    # sparse volume: only voxels in blocks near some surface
    ends = [end for view in prepared for end in (view.mesh.vertices.min(axis=0), view.mesh.vertices.max(axis=0))]
    grid = _Grid.around(np.min(ends, axis=0), np.max(ends, axis=0), config.voxel)
    near = [grid.near(view.mesh) for view in prepared]
    keys = unique_integers(np.concatenate(near))
    points = grid.points(keys)
    # sum weighted distances over all views
    total, weight = np.zeros(len(keys)), np.zeros(len(keys))
    for number, view in enumerate(prepared):
        voxels = np.searchsorted(keys, near[number])
        for start in range(0, len(voxels), 500_000):                    # voxels at a time, to bound the memory
            _integrate(view, points, voxels[start:start + 500_000], total, weight, config)
        if progress:
            progress(number + 1, len(prepared))
    # surface of the mean distance where it is known; weights below 0.02 are grazing views and edges
    seen = weight > 0.02
    distance = np.divide(total, weight, out=np.zeros_like(total), where=seen)
    mesh = _zero_surface(grid, keys[seen], points[seen], distance[seen])
    mesh = drop_small_components(split_vertices(mesh), SPECK)
    if not len(mesh.faces):
        raise ValueError("views: no surface is left after merging; is every camera on the outer side of its view?")
    return _with_colors(mesh, prepared)


def border_distance(mesh: Mesh, limit: float) -> np.ndarray:
    """Compute distances (N,), metres, of every vertex from the border along edges, at most `limit`."""
    border = mesh.boundary_vertices
    if not len(border):
        return np.full(len(mesh.vertices), limit)
    lengths = mesh.vertex_adjacency.copy().tocoo()
    apart = mesh.vertices[lengths.row] - mesh.vertices[lengths.col]
    lengths.data = np.maximum(np.linalg.norm(apart, axis=1), 1e-12)
    return np.minimum(dijkstra(lengths.tocsr(), indices=border, min_only=True, limit=limit), limit)


def _prepare(mesh: Mesh, camera: np.ndarray, config: MergeConfig) -> _View:
    """Prepare a view; weights fall with the angle of view and towards the border, as in [VRIP]."""
    towards = camera - mesh.vertices
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    normals = smooth_taubin(mesh, 5).vertex_normals                  # smoothed, as noise tilts single triangles
    cosine = np.einsum("nd,nd->n", normals, towards)
    angle = np.clip((cosine - config.min_cosine) / (1 - config.min_cosine), 0, 1)
    taper = 0.02  # metres from the border where a view reaches its full weight; it hides steps between views
    border = border_distance(mesh, taper) / taper
    return _View(mesh, camera, Rays(mesh), np.clip(cosine, config.min_cosine, 1), angle * border)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Voxels numbered row by row in a box; only those in blocks near a surface are stored."""

    origin: np.ndarray
    blocks: tuple[int, ...]
    voxel: float

    @classmethod
    def around(cls, low: np.ndarray, high: np.ndarray, voxel: float) -> _Grid:
        """Make a grid around a box, with one block of margin."""
        side = BLOCK * voxel
        first = np.floor(low / side).astype(np.int64) - 1
        count = np.floor(high / side).astype(np.int64) - first + 2
        return cls(first * side, tuple(count.tolist()), voxel)

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of voxels along each axis."""
        return tuple(BLOCK * count for count in self.blocks)

    def points(self, keys: np.ndarray) -> np.ndarray:
        """Return the positions (n, 3), metres, of voxels by number."""
        return self.origin + self.voxel * np.stack(np.unravel_index(keys, self.shape), axis=1)

    def near(self, mesh: Mesh) -> np.ndarray:
        """Return the sorted numbers of the voxels in blocks that hold a surface, and in the blocks around them."""
        side = BLOCK * self.voxel
        blocks = np.floor((_dense_points(mesh, side / 2) - self.origin) / side).astype(np.int64)
        flat = unique_integers(np.ravel_multi_index(tuple(blocks.T), self.blocks))
        for axis in range(3):                       # neighbours axis by axis: 3 + 3 + 3 steps instead of 27
            step = int(np.prod(self.blocks[axis + 1:]))
            flat = unique_integers(np.concatenate([flat - step, flat, flat + step]))
        blocks = np.stack(np.unravel_index(flat, self.blocks), axis=1)
        inside = np.stack(np.meshgrid(*[np.arange(BLOCK)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        voxels = (BLOCK * blocks[:, None] + inside).reshape(-1, 3)
        return np.sort(np.ravel_multi_index(tuple(voxels.T), self.shape))


def _dense_points(mesh: Mesh, spacing: float) -> np.ndarray:
    """Sample points so that no point of a triangle is further than about `spacing` from one of them."""
    points = [mesh.vertices[unique_integers(mesh.faces)]]
    corners = mesh.corners
    # split triangles with long sides into four, and collect the midpoints
    while len(corners):
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        corners = corners[sides > spacing]
        a, b, c = corners.transpose(1, 0, 2)
        p, q, r = (a + b) / 2, (b + c) / 2, (c + a) / 2
        points += [p, q, r]
        corners = np.concatenate([np.stack(t, axis=1) for t in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))])
    return np.concatenate(points)


def _integrate(view: _View, points: np.ndarray, which: np.ndarray, total: np.ndarray, weight: np.ndarray,
               config: MergeConfig) -> None:
    """Add the distances of a view at some voxels to `total` and `weight`, in place.

    Behind the surface the weight falls to 0, so that the opposite side of a thin limb is not disturbed.
    """
    reach = config.truncation * config.voxel
    _, ahead, w, _ = view.look(points[which])
    ahead = np.nan_to_num(ahead, nan=-np.inf, neginf=-np.inf)
    # beyond the truncation in front nothing counts; behind the surface the weight falls from half the reach on
    w = np.where(ahead > reach, 0.0, w * np.clip(2 + 2 * ahead / reach, 0, 1))
    use = w > 0
    total[which[use]] += w[use] * np.clip(ahead[use], -reach, reach)
    weight[which[use]] += w[use]


def _zero_surface(grid: _Grid, keys: np.ndarray, points: np.ndarray, distance: np.ndarray) -> Mesh:
    """Extract the zero surface by marching cubes, in cells whose eight corners all have data."""
    import igl

    shape, voxel = grid.shape, grid.voxel
    # corner indices of every cell; keep cells with eight known corners and a change of sign
    step = np.array([shape[1] * shape[2], shape[2], 1])
    # corners of a cell in the order of marching cubes
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
    place = np.searchsorted(keys, keys[:, None] + corners @ step)
    place = np.minimum(place, max(len(keys) - 1, 0))
    whole = (keys[place] == keys[:, None] + corners @ step).all(axis=1)
    whole &= np.all([at < size - 1 for at, size in zip(np.unravel_index(keys, shape), shape, strict=True)], axis=0)
    cells = place[whole]
    inside = (distance < 0)[cells].sum(axis=1)
    cells = cells[(inside > 0) & (inside < 8)]
    if not len(cells):
        return Mesh(np.empty((0, 3)), np.empty((0, 3), int))
    used = unique_integers(cells.ravel())
    local = np.searchsorted(used, cells)
    values = distance[used]
    values[np.abs(values) < 1e-4 * voxel] = 1e-4 * voxel   # zeros at corners would give degenerate triangles
    vertices, faces = igl.marching_cubes(values, np.ascontiguousarray(points[used]),
                                         np.ascontiguousarray(local, dtype=np.int64), 0.0)[:2]
    return Mesh(vertices, faces)


def _with_colors(mesh: Mesh, views: Sequence[_View]) -> Mesh:
    """Blend the views' colours, with the same weights as their distances; no colours if a view has none."""
    if any(view.mesh.colors is None for view in views):
        return mesh
    total, weight = np.zeros_like(mesh.vertices), np.full(len(mesh.vertices), 1e-12)
    near = 2 * mesh.mean_edge
    for view in views:
        face, signed, w, bary = view.look(mesh.vertices)
        use = (face >= 0) & (np.abs(signed) < near)
        colors = np.einsum("nc,ncd->nd", bary[use], np.asarray(view.mesh.colors)[view.mesh.faces[face[use]]])
        total[use] += w[use, None] * colors
        weight[use] += w[use]
    return Mesh(mesh.vertices, mesh.faces, np.clip(total / weight[:, None], 0, 1))
