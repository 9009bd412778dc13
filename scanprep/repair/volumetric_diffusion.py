"""Continue a surface through holes by volumetric diffusion [Davis]."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array, diags_array

from ..geometry.mesh import Mesh
from ..geometry.sparse import factor
from ..geometry.surface import SeenSpace, Surface

EMPTY = 0.01                         # metres in front of a seen surface from which on space counts as free


def diffuse_surface(mesh: Mesh, rim: np.ndarray, seen: SeenSpace | None = None) -> Mesh:
    """Diffuse the signed distance from the existing surface into holes, and extract its zero level.

    Near the surface the distance is known. Elsewhere it is the steady state of second-order diffusion, in which level
    sets continue in their direction instead of taking the shortest way. Free space keeps a positive distance. The
    result contains existing surface and patches within the volume. The volume has at most twelve voxels along the
    longest side of the holes with borders `rim` (n,), and is never finer than the mesh.

    [Davis] volumetric diffusion, line-of-sight constraints
    """
    # a grid around the holes, with a margin of five voxels
    points = mesh.vertices[rim]
    extent = np.ptp(points, axis=0).max()
    voxel = max(float(extent) / 12, mesh.mean_edge)
    margin = 5 * voxel
    low = points.min(axis=0) - margin
    shape = np.ceil((np.ptp(points, axis=0) + 2 * margin) / voxel).astype(int) + 1
    grid = low + voxel * np.stack(np.unravel_index(np.arange(np.prod(shape)), shape), axis=1)
    # fix the distance within three voxels of the surface, and diffuse it into the rest
    distance, sure = measure_signed_distance(mesh, grid)
    known = sure & (np.abs(distance) <= 3 * voxel)
    operator = _roughness(tuple(shape.tolist()))
    values = _spread(operator, known, distance)
    if seen is not None:
        # free space that came out inside gets a positive distance, and diffusion is repeated
        empty = ~known & (seen.ahead(grid) > max(EMPTY, voxel))
        for _ in range(6):
            wrong = empty & ~known & (values < voxel)
            if not wrong.any():
                break
            known, distance = known | wrong, np.where(wrong, voxel, distance)
            values = _spread(operator, known, distance)
    return _zero_surface(grid, values / max(float(np.abs(values).max()), 1e-30), shape)


def _zero_surface(grid: np.ndarray, values: np.ndarray, shape: np.ndarray) -> Mesh:
    """Extract the surface where values (N,) on a full grid (N, 3) change sign."""
    import igl

    values = np.where(np.abs(values) < 1e-4, 1e-4, values)      # zeros at corners give degenerate triangles
    order = np.arange(len(values)).reshape(shape).ravel(order="F")             # igl: x runs fastest
    return Mesh(*igl.marching_cubes(values[order], grid[order], *shape.tolist(), 0.0)[:2])


def measure_signed_distance(mesh: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute signed distances (n,), metres, of points from a surface with borders, and where they are reliable (n,).

    Beyond a border, inside and outside are not defined: there the closest point lies on the border.
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
    """Build the squared Laplacian (N, N) of a grid with zero flux at its sides."""
    number = np.arange(np.prod(shape)).reshape(shape)
    ends = [(number.take(np.arange(size - 1), axis).ravel(), number.take(np.arange(1, size), axis).ravel())
            for axis, size in enumerate(shape)]
    a, b = (np.concatenate(side) for side in zip(*ends, strict=True))
    near = coo_array((np.ones(2 * len(a)), (np.r_[a, b], np.r_[b, a])), shape=(number.size, number.size)).tocsr()
    laplacian = diags_array(np.asarray(near.sum(axis=1)).ravel()) - near
    return csr_array(laplacian @ laplacian)


def _spread(operator: csr_array, known: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Solve for the smoothest values (N,) that keep the known ones."""
    free, fixed = np.flatnonzero(~known), np.flatnonzero(known)
    out = np.array(values)
    rows = operator[free]
    out[free] = factor(csc_array(rows[:, free]))(-(rows[:, fixed] @ values[fixed]))
    return out
