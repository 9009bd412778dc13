"""A small jointed body with a known deformation, for the tests of registration."""
from __future__ import annotations

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh


def crab(rings: int = 41, around: int = 20) -> Mesh:
    """A closed, oval, tapered tube 1 m long along x: a chest with an arm on either side, all different."""
    x = np.linspace(-0.5, 0.5, rings)
    angle = 2 * np.pi * np.arange(around) / around
    radius = 0.05 + 0.07 * np.exp(-((x - 0.03) / 0.16) ** 2) + 0.01 * np.sin(9 * x)
    bump = 1 + 0.25 * np.exp(-((angle - np.pi / 2) / 0.6) ** 2)
    wall = np.stack([np.repeat(x, around), np.outer(radius, bump * np.cos(angle)).ravel(),
                     0.75 * np.outer(radius, bump * np.sin(angle)).ravel()], axis=1)
    vertices = np.vstack([wall, [[-0.53, 0, 0], [0.53, 0, 0]]])
    ring, after = np.arange(around), (np.arange(around) + 1) % around
    start = (np.arange(rings - 1) * around)[:, None]
    a, b = (start + ring).ravel(), (start + after).ravel()
    last = (rings - 1) * around
    faces = np.vstack([np.stack([a, a + around, b], 1), np.stack([b, a + around, b + around], 1),
                       np.stack([ring, after, np.full(around, len(wall))], 1),
                       np.stack([last + after, last + ring, np.full(around, len(wall) + 1)], 1)])
    return Mesh(vertices, faces[:, ::-1])


def bent(body: Mesh, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Vertices with both arms turned by rotation vectors about the shoulders, the bend spread over 12 cm."""
    x = body.vertices
    out = x.copy()
    for side, twist in ((-1, left), (1, right)):
        shoulder = np.array([side * 0.2, 0.0, 0.0])
        share = np.clip((side * x[:, 0] - 0.14) / 0.12, 0, 1)
        share = share**2 * (3 - 2 * share)
        R = rotations.exp(share[:, None] * np.asarray(twist, dtype=float))
        turned = np.einsum("nij,nj->ni", R, x - shoulder) + shoulder
        out = np.where((share > 0)[:, None], turned, out)
    return out
