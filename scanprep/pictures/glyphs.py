"""Triangles for balls and rods."""
from __future__ import annotations

import numpy as np


def sphere(divisions: int) -> tuple[np.ndarray, np.ndarray]:
    """A unit sphere as an icosahedron whose triangles are cut in four `divisions` times."""
    g = (1 + 5 ** 0.5) / 2
    vertices = np.array([(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g), (0, -1, -g),
                         (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)], dtype=float)
    faces = np.array([(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11),
                      (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8),
                      (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5),
                      (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)])
    for _ in range(divisions):
        corners = vertices[faces]
        a, b, c = (corners[:, i] + corners[:, (i + 1) % 3] for i in range(3))
        p, q, r = corners.transpose(1, 0, 2)
        quarters = np.concatenate([np.stack(t, axis=1) for t in ((p, a, c), (a, q, b), (c, b, r), (a, b, c))])
        vertices, faces = quarters.reshape(-1, 3), np.arange(12 * len(faces)).reshape(-1, 3)
        vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces


def balls(points: np.ndarray, radius: float, divisions: int | None = None
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One ball for each point (n, 3); how round, as for `sphere`, goes by their number when it is not given."""
    vertices, faces = sphere(divisions if divisions is not None else 2 if len(points) <= 400 else 1)
    normals = vertices[faces]
    corners = points[:, None, None, None, :].swapaxes(1, 2) + radius * normals
    count = len(points)
    return (corners.reshape(-1, 3, 3), np.tile(normals, (count, 1, 1)), np.repeat(np.arange(count), len(faces)))


def capsules(starts: np.ndarray, ends: np.ndarray, radius: float, sides: int = 16
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One rod with round ends for each pair of points (n, 3), in the form of `balls`."""
    count = len(starts)
    along = ends - starts
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along = np.divide(along, length, out=np.tile([0.0, 0.0, 1.0], (count, 1)), where=length > 0)
    aside = np.cross(along, np.eye(3)[np.abs(along).argmin(axis=1)])
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = (np.cos(angle)[:, None] * aside[:, None] + np.sin(angle)[:, None] * np.cross(along, aside)[:, None])
    following = np.roll(ring, -1, axis=1)
    normals = np.stack([np.stack([ring, following, following], axis=2),      # the two halves of a side
                        np.stack([ring, following, ring], axis=2)], axis=2)
    end = np.array([[0, 0, 1], [0, 1, 1]])
    place = np.stack([starts, ends], axis=1)[:, None][:, :, end]
    corners = (place + radius * normals).reshape(-1, 3, 3)
    owner = np.repeat(np.arange(count), 2 * sides)
    caps = [balls(starts, radius), balls(ends, radius)]
    return (np.concatenate([corners, *(c[0] for c in caps)]),
            np.concatenate([normals.reshape(-1, 3, 3), *(c[1] for c in caps)]),
            np.concatenate([owner, *(c[2] for c in caps)]))
