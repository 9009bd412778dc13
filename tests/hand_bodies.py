"""A hand of a palm and four fingers side by side, whose roots touch their neighbours', with known joints."""
from __future__ import annotations

import igl
import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import label_components

STEP = 0.0031                                                     # metres, edge of a voxel
KNUCKLES = np.array([[x, 0, 0.09] for x in (-0.03, -0.01, 0.01, 0.03)])


def hand() -> Mesh:
    """A box with four rods of 8 cm that are joined by skin over their first 2 cm."""
    x, y, z = np.meshgrid(np.arange(-0.05, 0.05, STEP), np.arange(-0.02, 0.02, STEP), np.arange(-0.01, 0.2, STEP),
                          indexing="ij")
    palm = np.maximum(np.maximum(abs(x) - 0.04, abs(y) - 0.01), np.maximum(-z, z - 0.095))
    rods = [np.maximum(np.hypot(x - knuckle[0], y) - 0.0085, np.maximum(0.08 - z, z - 0.175)) for knuckle in KNUCKLES]
    webs = np.maximum(np.maximum(abs(x) - 0.036, abs(y) - 0.004), np.maximum(0.08 - z, z - 0.11))
    solid = np.minimum.reduce([palm, webs, *rods])
    grid = np.stack([axis.ravel(order="F") for axis in (x, y, z)], axis=1)
    vertices, faces, _ = igl.marching_cubes(solid.ravel(order="F"), grid, *solid.shape, 0.00037)
    mesh = Mesh(vertices, faces[:, ::-1] if Mesh(vertices, faces).volume < 0 else faces)
    assert not label_components(*mesh.edges.T, len(mesh.vertices)).any()
    return mesh


def bend_fingers(mesh: Mesh, angles: np.ndarray) -> np.ndarray:
    """Bend finger k by angles (4,), radians, about the x axis through its knuckle; skin blends over 1 cm."""
    x = mesh.vertices
    share = np.clip((x[:, 2] - KNUCKLES[0, 2]) / 0.01 + 0.5, 0, 1)
    near = np.exp(-(x[:, :1] - KNUCKLES[:, 0])**2 / 0.006**2)
    weights = share[:, None] * near / near.sum(axis=1, keepdims=True)
    moved = np.stack([(x - knuckle) @ rotations.exp([angle, 0, 0]).T + knuckle
                      for knuckle, angle in zip(KNUCKLES, angles, strict=True)], axis=1)
    return np.einsum("nk,nkd->nd", weights, moved) + (1 - weights.sum(axis=1))[:, None] * x
