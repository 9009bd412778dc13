"""Marching cubes of the implicit surfaces from which bodies of the tests are made."""
from __future__ import annotations

import igl
import numpy as np
from implicit_surface import Field

from scanprep.geometry.mesh import Mesh


def polygonise(field: Field, low: np.ndarray, high: np.ndarray, step: float) -> Mesh:
    """The zero surface in a box by marching cubes; open where the box cuts it.

    Only cells near the surface are evaluated finely.
    """
    coarse = 6
    cells = np.ceil((high - low) / (coarse * step)).astype(int)
    axes = [low[d] + coarse * step * np.arange(cells[d] + 1) for d in range(3)]
    grid = np.stack(np.meshgrid(*axes[::-1], indexing="ij")[::-1], axis=-1)
    shape = grid.shape[:3]
    rough = field(grid.reshape(-1, 3)).reshape(shape)
    near = np.abs(rough) < 3.2 * coarse * step
    n = cells * coarse + 1
    fine_axes = [low[d] + step * np.arange(n[d]) for d in range(3)]
    index = [np.minimum((np.arange(n[d]) + coarse // 2) // coarse, cells[d]) for d in range(3)]
    pick = np.ix_(index[2], index[1], index[0])
    values, todo = rough[pick].copy(), near[pick]
    points = np.stack(np.meshgrid(*fine_axes[::-1], indexing="ij")[::-1], axis=-1)
    wanted = points[todo]
    values[todo] = np.concatenate([field(part) for part in np.array_split(wanted, max(1, len(wanted) // 200_000))])
    vertices, faces = igl.marching_cubes(values.reshape(-1), points.reshape(-1, 3), int(n[0]), int(n[1]),
                                         int(n[2]),
                                         0.0)[:2]
    mesh = Mesh(vertices, np.asarray(faces, dtype=np.int64))
    outside = field(mesh.corners.mean(axis=1) + 1e-3 * mesh.face_normals)
    return mesh if np.median(outside) > 0 else Mesh(vertices, mesh.faces[:, ::-1])
