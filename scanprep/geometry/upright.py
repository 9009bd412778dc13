"""Which axis of a body points up, from how its poses stand."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from .farthest_points import spread_indices
from .format_glb import tallest
from .mesh import Mesh
from .rotations import procrustes

POSES = 24                           # spread over all: enough for a mean in which the body stands


def find_up(body: Mesh, poses: np.ndarray | None = None) -> Mesh:
    """Find the axis of a body that points up; return the body with it, or as it is if it says the axis.

    Up is the axis along which the mean of the poses stands most firmly (`support`): in the mean, lifted feet are on the
    ground. Where nothing stands clearly, as a snake, a hand or a face, up is the axis of the largest extent, unless
    arms are spread wider (`tallest`). A body that stands along a negative axis is not recognised.

    Parameters
    ----------
    body : Mesh
        The body at rest.
    poses : (M, N, 3) float, metres, optional
        The body in poses.

    Returns
    -------
    Mesh
        The body with `up`.

    Examples
    --------
    A table is longer than it is high, and stands on its legs:

    >>> legs = [[x, y, z] for x in (0, 1.2) for y in (0, 0.5) for z in (0.0, 0.7)]
    >>> find_up(Mesh(legs, [[0, 2, 4], [2, 6, 4], [1, 3, 5], [3, 7, 5]])).up
    2
    """
    if body.up is not None:
        return body
    standing = body
    if poses is not None and len(poses):
        chosen = np.asarray(poses)[spread_indices(len(poses), POSES)]
        R, t = procrustes(chosen, np.broadcast_to(body.vertices, chosen.shape))
        standing = body.with_vertices((chosen @ np.swapaxes(R, 1, 2) + t[:, None]).mean(axis=0))
    firm = np.array([support(standing, up) for up in range(3)])
    usual, best = tallest(body.vertices), int(firm.argmax())
    # another axis than the usual one has to be clear: with a fifth of the outline, and twice what stands along that one
    clear = firm[best] > 0.2 and firm[best] > 2 * max(firm[usual], support(body, usual))
    return replace(body, up=best if clear else usual)


def support(body: Mesh, up: int) -> float:
    """Measure how firmly a body stands along an axis: the share of its outline that its support polygon covers.

    The support polygon is the convex hull of all that is within a tenth of the height. It is 0 where the centroid is
    not above it, or where the body is flat, as a person who lies.
    """
    height, flat = body.vertices[:, up] - body.vertices[:, up].min(), np.delete(body.vertices, up, axis=1)
    # people on their backs are 0.15 to 0.3 of their stature high, dogs on their feet at least half of their length
    if height.max() < 0.35 * np.ptp(body.vertices, axis=0).max():
        return 0.0
    try:
        polygon, outline = ConvexHull(flat[height < 0.1 * height.max()]), ConvexHull(flat)
    except (QhullError, ValueError):             # fewer than three points, or all in a line
        return 0.0
    centroid = np.average(body.corners.mean(axis=1), axis=0, weights=body.face_areas)[np.arange(3) != up]
    inside = (polygon.equations[:, :2] @ centroid + polygon.equations[:, 2]).max() < 0
    return float(polygon.volume / outline.volume) if inside else 0.0
