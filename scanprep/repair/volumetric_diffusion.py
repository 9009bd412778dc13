"""The surface continued through holes in a volume [Davis]."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, diags_array

from ..geometry.mesh import Mesh
from ..geometry.sparse import factor
from ..geometry.surface import SeenSpace, Surface

EMPTY = 0.01                         # metres in front of what was seen from which on space counts as empty


def diffuse_surface(mesh: Mesh, rim: np.ndarray, seen: SeenSpace | None = None, voxels: int = 12) -> Mesh:
    """The zero level of the signed distance, diffused from the existing surface into the space about holes.

    Near the surface the distance is known. Elsewhere it takes the steady state of diffusion; that of second order,
    in which the level sets run on in their direction instead of taking the shortest way. Space that was seen to
    be empty keeps a positive distance. Existing surface and patches come together, as far as the volume reaches: at
    most `voxels` along the longest side of the holes, whose borders `rim` (n,) are, and never finer than the mesh.

    [Davis] volumetric diffusion, line-of-sight constraints
    """
    points = mesh.vertices[rim]
    extent = np.ptp(points, axis=0).max()
    voxel = max(float(extent) / voxels, mesh.mean_edge)
    margin = 5 * voxel
    low = points.min(axis=0) - margin
    shape = np.ceil((np.ptp(points, axis=0) + 2 * margin) / voxel).astype(int) + 1
    grid = low + voxel * np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1)
    distance, sure = measure_signed_distance(mesh, grid)
    known = sure & (np.abs(distance) <= 3 * voxel)
    operator = _roughness(tuple(shape.tolist()))
    values = _spread(operator, known, distance)
    if seen is not None:
        empty = ~known & (seen.ahead(grid) > max(EMPTY, voxel))
        for _ in range(6):
            wrong = empty & ~known & (values < voxel)
            if not wrong.any():
                break
            known, distance = known | wrong, np.where(wrong, voxel, distance)
            values = _spread(operator, known, distance)
    return _zero_surface(grid, values / max(float(np.abs(values).max()), 1e-30), shape)


def _zero_surface(grid: np.ndarray, values: np.ndarray, shape: np.ndarray) -> Mesh:
    """Where values (N,) on a full grid (N, 3) of a shape change sign."""
    import igl

    values = np.where(np.abs(values) < 1e-4, 1e-4, values)      # a surface through a corner would make flat triangles
    order = np.arange(len(values)).reshape(shape).ravel(order="F")             # igl: x runs fastest
    return Mesh(*igl.marching_cubes(values[order], grid[order], *shape.tolist(), 0.0)[:2])


def measure_signed_distance(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances (n,) in metres of points from a surface with borders, and (n,) bool where they can be trusted.

    Beyond a border inside and outside are not defined: there the closest point lies on the border.
    """
    at = Surface(mesh).closest(points)
    corners = mesh.faces[at.faces]
    normal = np.einsum("nc,ncd->nd", at.bary, mesh.vertex_normals[corners])
    sign = np.where(np.einsum("nd,nd->n", points - at.points, normal) < 0, -1.0, 1.0)
    border = np.zeros(len(mesh.vertices), dtype=bool)
    border[mesh.boundary_vertices] = True
    inner = (at.bary * ~border[corners]).sum(axis=1) > 1e-3
    return sign * at.distances, inner


def _roughness(shape: tuple[int, ...]) -> csr_array:
    """(N, N) squared Laplacian of a grid whose sides let nothing through."""
    number = np.arange(np.prod(shape)).reshape(shape)
    ends = [(number.take(np.arange(size - 1), axis).ravel(), number.take(np.arange(1, size), axis).ravel())
            for axis, size in enumerate(shape)]
    a, b = (np.concatenate(side) for side in zip(*ends, strict=True))
    near = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(number.size, number.size)).tocsr()
    laplacian = diags_array(np.asarray(near.sum(axis=1)).ravel()) - near
    return csr_array(laplacian @ laplacian)


def _spread(operator: csr_array, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (N,) that are as smooth as possible and keep those that are known."""
    free, fixed = np.flatnonzero(~known), np.flatnonzero(known)
    out = np.array(values)
    rows = operator[free]
    out[free] = factor(csc_array(rows[:, free]))(-(rows[:, fixed] @ values[fixed]))
    return out
