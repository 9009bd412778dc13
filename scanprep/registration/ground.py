"""Soles on the floor: a scan of somebody who stands ends flat where a scanner took the floor away.

The soles were not measured, so a fitted body may continue below the floor. Where the scan ends in one plane all around
the feet, that plane bounds the body. Vertices of the feet beyond it are pressed towards it.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, QhullError, cKDTree

from ..cleaning.floor import Plane
from ..console import Metric
from ..geometry.mesh import Mesh
from ..geometry.target import orient_by_mesh, target_of
from ..judgement import size
from ..skeleton.roles import above, limb_parts
from ..skeleton.tree import Skeleton
from .folds import find_inverted_triangles, without_inverted
from .limb_ends import bending
from .matches import NORMALS, tukey
from .nonrigid import Registration
from .person import PersonParts

FLAT = 0.002                 # metres: how flat a cut is; its points lie this near to the plane
REACH = 0.015                # metres along the floor from the outline of a foot to where the scan ends
WALL = 0.006                 # metres above the floor where the outline of the feet is taken, above any sole
LEVEL = 0.7                  # least cosine between the floor's normal and the way from feet to body: 45 degrees
TRIED, ENDS = 500, 12        # random planes tried, and the fewest points that a plane is fitted to


@dataclass(frozen=True, eq=False)
class Grounded:
    """A body with its soles on the floor: its vertices (N, 3), metres, and the floor.

    `beyond` is how far the lowest vertex was beyond the floor before, and how far it is now, metres.
    """

    vertices: np.ndarray
    floor: Plane
    beyond: tuple[float, float]


def foot_of_vertex(template: Mesh, skeleton: Skeleton) -> np.ndarray:
    """Label vertices (N,) int by foot: 1 left, 2 right, 0 elsewhere. Feet are the last parts of the legs.

    A skeleton without named legs has no feet.
    """
    part, foot = skeleton.part_of_vertex(template), np.zeros(len(template.vertices), dtype=np.int64)
    for number, side in enumerate(("left", "right"), 1):
        leg = limb_parts(skeleton.names, skeleton.parents, skeleton.joints, "leg", side)
        for j in range(len(skeleton.parents) if len(leg) > 1 else 0):
            if leg[-1] in above(skeleton.parents, j):
                foot[part == j] = number
    return foot


def with_soles(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, parts: PersonParts | None) -> Registration:
    """Rest the soles of a registration on the floor where its scan ends flat; else return it as it is."""
    if parts is None:
        return fit
    target = orient_by_mesh(target_of(scan), fit.mesh, NORMALS * size(template))
    grounded = put_on_floor(template, fit.mesh, foot_of_vertex(template, parts.skeleton), target.points, target.normals)
    if grounded is None:
        return fit
    vertices = without_inverted(template, grounded.vertices)          # narrow triangles at the rim may invert
    return replace(fit, mesh=template.with_vertices(vertices), soles=grounded.beyond,
                   inverted=int(find_inverted_triangles(template, vertices).sum()))


def soles_row(beyond: tuple[float, float] | None) -> list[Metric]:
    """Return the table row that reports how far soles were beyond the floor, before and after, metres; or no row."""
    return [] if beyond is None else [
        Metric("soles", f"the scan ends flat at the floor: soles rest on it, {1000 * beyond[1]:.0f} mm beyond its "
               f"end, where they were {1000 * beyond[0]:.0f} mm")]


def put_on_floor(reference: Mesh, body: Mesh, foot: np.ndarray, points: np.ndarray, normals: np.ndarray
                 ) -> Grounded | None:
    """Put a body with its soles on the floor where a scan ends; None if it does not end flat around the feet.

    A scanner may cut some millimetres above the floor. A body that resembles the person then knows its soles better.
    So the more the feet had to deform to lie on the scan, the more they are pressed to the plane. At most what scanners
    usually cut away stays below it. A person unlike the body who was cut higher comes out too short: two men cut at
    12 mm by 10 mm, cut at 5 mm by 2 mm.

    Parameters
    ----------
    reference : Mesh
        The body before it followed the scan: the template, or what the model predicts.
    body : Mesh
        The same triangles on the scan.
    foot : (N,) int
        See `foot_of_vertex`.
    points, normals : (n, 3) float, metres, and unit, outward
        The scan.

    Returns
    -------
    Grounded or None
    """
    floor = find_floor(body, foot > 0, points, normals)
    if floor is None:
        return None
    height = floor.height(body.vertices)
    # how much the shape of each foot changed, where the scan shows it
    shown = (height > 0) & (cKDTree(points).query(body.vertices)[0] < REACH)
    bent = max(_bending(reference, body, shown & (foot == number)) for number in np.unique(foot[foot > 0]))
    below = np.maximum(-height, 0)
    # 3 mm RMS of bending: from there on the body says less of its soles than the end of the scan does. Measured:
    # synthetic feet bend by 0.9 to 1.9 mm on other synthetic people and predict soles to 3 mm; by 4 to 9 mm on real
    # men, to 13 mm; on two scans of a booth with a known floor by 3.5 and 8 mm, to 12 and 18 mm.
    # Scanners usually cut 1.5 mm above the floor, hardly ever 12 mm: deeper soles are trusted less.
    against = (bent / 0.003) ** 4 * (1 + (below.max() / 0.012) ** 2)
    pressed = (1 + against * min(0.0015 / below.max(), 1.0)) / (1 + against)
    return Grounded(body.vertices + ((1 - pressed) * below)[:, None] * floor.normal, floor,
                    (float(below.max()), float(pressed * below.max())))


def _bending(reference: Mesh, body: Mesh, shown: np.ndarray) -> float:
    """Return by how much a foot changed its shape, metres RMS, at the vertices with data (N,) bool."""
    if shown.sum() < 20:
        return 0.05                  # fewer than 20 vertices with data say nothing: count the foot as bent far
    return bending(reference.vertices[shown], body.vertices[shown], body.vertex_areas[shown])[0]


def find_floor(body: Mesh, feet: np.ndarray, points: np.ndarray, normals: np.ndarray) -> Plane | None:
    """Find the plane in which a scan, points and normals (n, 3), ends around the feet (N,) of a body, or None.

    The whole scan lies above it, and only soles of the body lie below. Soles that were scanned need no floor.
    """
    x = body.vertices
    if not feet.any() or feet.all() or not len(points):
        return None
    sole_reach = 0.04  # metres: scan points nearer than this to the skin of the feet belong to them
    at_feet = cKDTree(x[feet]).query(points, distance_upper_bound=sole_reach)[0] < sole_reach
    near, normals = points[at_feet], normals[at_feet]
    floor = _supporting_plane(near, x[feet].mean(axis=0), x[~feet].mean(axis=0))
    # at most 0.5% of the points at the feet may lie behind the floor: specks
    if floor is None or np.mean(floor.height(near) < -2 * FLAT) > 0.005:
        return None
    height = floor.height(x)
    # only feet may go below the plane, by at most 40 mm: more is a shin or a hand, not a sole
    if (height[~feet] < 0).any() or not -0.04 < height.min() < 0:
        return None
    # the scan must end near the plane along most of the outline of the feet
    ends = near[np.abs(floor.height(near)) < 2 * FLAT]
    outline, length = _outline(body, height - WALL)
    apart = cKDTree(floor.flat(ends)).query(floor.flat(outline))[0]
    # along 0.7 of the outline: a scan from the front alone has 0.67
    if not len(outline) or length @ (apart < REACH) < 0.7 * length.sum():
        return None
    facing = 0.7  # least cosine to the vertical of a sole; steeper surface is a wall
    flat = near[(normals @ floor.normal < -facing) & (np.abs(floor.height(near)) < FLAT)]
    # was the sole itself scanned? Only vertices below the plane count: an arch above it is seen after a cut, too
    soles = x[feet & (height < 0) & (body.vertex_normals @ floor.normal < -facing)]
    if not len(flat) or not len(soles):
        return floor
    scanned = cKDTree(floor.flat(flat)).query(floor.flat(soles))[0] < REACH / 2
    # above 0.8 with data the soles were scanned: a scan cut at 4 mm has 0.64, a whole one 1
    return None if np.mean(scanned) > 0.8 else floor


def _supporting_plane(points: np.ndarray, feet: np.ndarray, rest: np.ndarray) -> Plane | None:
    """Find the plane below the feet with all points (n, 3) above it; None if there is none.

    `feet` and `rest` (3,) are the centroids of the feet and of the other vertices. The plane is the face of the
    convex hull on which the feet stand, fitted to the points on it.
    """
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):       # too few points, or all in one plane
        return None
    up = (rest - feet) / np.linalg.norm(rest - feet)
    # the face of the hull that a ray from the centroid towards the floor meets first
    downwards = -hull.equations[:, :3] @ up
    way = -(hull.equations[:, :3] @ points.mean(axis=0) + hull.equations[:, 3]) / np.maximum(downwards, LEVEL)
    face = hull.equations[np.where(downwards > LEVEL, way, np.inf).argmin()]
    if -face[:3] @ up <= LEVEL:
        return None
    # noise tilts a face, so take the lowest point of every square centimetre, and by RANSAC the plane through three of
    # them that most lie on; walls that rise from there, and outliers, do not
    plane = Plane(-face[:3], float(face[3]), FLAT)
    low = points[plane.height(points) < 2 * WALL]
    low = low[np.argsort(plane.height(low), kind="stable")]
    flat = plane.flat(low - points[0])         # squares of the scan, not of the room
    low = low[np.unique(np.floor(flat / 0.01).astype(np.int64), axis=0, return_index=True)[1]]
    if len(low) < ENDS:
        return None
    a, b, c = low[np.random.default_rng(0).integers(len(low), size=(3, TRIED))]
    normals = np.cross(b - a, c - a)
    normals *= (np.sign(normals @ up) / np.maximum(np.linalg.norm(normals, axis=1), 1e-12))[:, None]
    height = low @ normals.T - np.einsum("nd,nd->n", a, normals)
    # a point below the plane counts twice against it
    lying = tukey(height, FLAT).sum(axis=0) - 2 * (height < -FLAT).sum(axis=0)
    best = int(np.where(normals @ up > LEVEL, lying, -np.inf).argmax())
    height = height[:, best]
    # refine by weighted least squares: the normal is the direction of least spread; five rounds settle it
    for _ in range(5):
        weights = tukey(height, FLAT)
        if np.count_nonzero(weights) < ENDS:
            return None
        centre = np.average(low, axis=0, weights=weights)
        spread = (weights[:, None] * (low - centre)).T @ (low - centre)
        normal = np.linalg.eigh(spread)[1][:, 0]
        normal *= np.sign(normal @ up)
        height = (low - centre) @ normal
    noise = float(np.sqrt(np.average(height**2, weights=tukey(height, FLAT))))
    # a cut has a noise of 0 to 0.35 mm; where scanners merely lose the rim of a sole, 3 to 9 mm above the floor, it is
    # 0.5 to 0.7 mm and no plane
    return Plane(normal, float(normal @ centre), noise) if normal @ up > LEVEL and noise < 0.00045 else None


def _outline(body: Mesh, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut the surface at height 0 of its vertices (N,): midpoints (n, 3) and lengths (n,) of the segments, metres."""
    h = height[body.faces]
    crossing = (h.min(axis=1) < 0) & (h.max(axis=1) >= 0)
    corners, h = body.corners[crossing], h[crossing]
    # in every crossing triangle two of three edges are cut, by linear interpolation; the third gives NaN
    ends = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        share = h[:, a] / np.where(h[:, a] == h[:, b], 1.0, h[:, a] - h[:, b])
        cut = (h[:, a] < 0) != (h[:, b] < 0)
        ends.append(np.where(cut[:, None], corners[:, a] + share[:, None] * (corners[:, b] - corners[:, a]), np.nan))
    places = np.stack(ends, axis=1)
    middle = np.nanmean(places, axis=1)
    return middle, 2 * np.nanmax(np.linalg.norm(places - middle[:, None], axis=2), axis=1)
