"""Graft what a scan lacks from a body that lies on it: a finger tip that was cut off is no hole to be capped.

1. Of the body, find what stands out from the closed scan where it was cut: at the patch of a hole.
2. Join each such piece to the border of its hole by a strip of triangles.
"""
from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.sparse import label_components
from ..geometry.surface import Surface
from .manifold import repair

# Lengths in metres. A patch over a hole in a smooth surface is within 4 mm of the body; what stands out by 8 mm is a
# finger tip, a toe or an ear. The rim of a piece that fits lies within 15 mm of the border of its hole.
PATCHED, LEAST, NEAR = 0.004, 0.008, 0.015


def graft(scan: Mesh, closed: Mesh, body: Mesh) -> tuple[Mesh, int]:
    """Join to an open scan the pieces of a body that it lacks, and return how many there were.

    Parameters
    ----------
    scan : Mesh, metres
        Manifold and oriented, open where something is missing.
    closed : Mesh, metres
        The same with its holes filled.
    body : Mesh, metres
        A closed body that lies on the scan, with triangles as fine as wanted.

    Returns
    -------
    (Mesh, int)
        The scan with the pieces, manifold; holes that none fits stay open.
    """
    loops = [loop for loop in scan.boundary_loops if len(loop) >= 3]
    missing = find_missing(closed, body)
    pieces, faces, vertices, count = [], [scan.faces], [scan.vertices], len(scan.vertices)
    for chosen in missing:
        piece = body.submesh(chosen)[0]
        rim = piece.boundary_loops
        # a piece with several rims, or far from every hole, does not belong to one hole
        if len(rim) != 1 or not loops:
            continue
        apart = [cKDTree(scan.vertices[loop]).query(piece.vertices[rim[0]])[0].mean() for loop in loops]
        if min(apart) > NEAR:
            continue
        hole = loops.pop(int(np.argmin(apart)))
        strip = bridge(np.concatenate([scan.vertices, piece.vertices]), hole, rim[0] + len(scan.vertices))
        # numbers of the piece begin after all vertices so far
        moved = np.where(strip >= len(scan.vertices), strip - len(scan.vertices) + count, strip)
        faces += [piece.faces + count, moved]
        vertices.append(piece.vertices)
        count += len(piece.vertices)
        pieces.append(piece)
    if not pieces:
        return scan, 0
    return repair(Mesh(np.concatenate(vertices), np.concatenate(faces))), len(pieces)


def find_missing(closed: Mesh, body: Mesh) -> list[np.ndarray]:
    """Find the pieces of a body that stand out from a closed scan: masks (F,) of triangles, the largest first."""
    off = Surface(closed).closest(body.vertices).distances
    inside = (off > PATCHED)[body.faces].all(axis=1)
    a, b = body.faces[inside][:, [0, 1]].T, body.faces[inside][:, [1, 2]].T
    label = label_components(a.ravel(), b.ravel(), len(body.vertices))
    of_face = label[body.faces[:, 0]]
    pieces = [with_islands(body, inside & (of_face == one)) for one in np.unique(of_face[inside])
              if off[np.unique(body.faces[inside & (of_face == one)])].max() > LEAST]
    # of several at the hole of one sole, the largest is the one that matters
    return sorted(pieces, key=lambda chosen: -body.face_areas[chosen].sum())


def with_islands(body: Mesh, chosen: np.ndarray) -> np.ndarray:
    """Add to chosen triangles (F,) bool all that they enclose: where a missing toe touches the patch of its hole."""
    # triangles hang together by their edges: at a vertex alone a piece only touches itself
    a, b = body.face_pairs.T
    apart = ~chosen[a] & ~chosen[b]
    label = label_components(a[apart], b[apart], len(body.faces))
    return chosen | (label != np.bincount(label[~chosen]).argmax())


def bridge(points: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Join two border loops of vertices (a,), (b,) of points (n, 3) by a strip of triangles (a + b, 3).

    Borders of oriented surfaces that face each other run in opposite directions. The strip starts at the nearest
    vertices and takes the shorter diagonal at every step.
    """
    start = int(np.linalg.norm(points[second] - points[first[0]], axis=1).argmin())
    second = np.roll(second[::-1], start + 1)
    triangles, i, j = [], 0, 0
    while i < len(first) or j < len(second):
        a, b = first[i % len(first)], second[j % len(second)]
        ahead, beside = first[(i + 1) % len(first)], second[(j + 1) % len(second)]
        along, across = np.linalg.norm(points[ahead] - points[b]), np.linalg.norm(points[a] - points[beside])
        if j == len(second) or (i < len(first) and along <= across):
            triangles.append((a, b, ahead))
            i += 1
        else:
            triangles.append((a, b, beside))
            j += 1
    return np.array(triangles)
