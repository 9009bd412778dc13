"""Soles on the floor: a scan of somebody who stands ends flat where a scanner took the floor away.

Nothing was measured of the soles, so a body that was fitted to such a scan may go on below the floor. Where the scan
ends in one plane all around the feet, that plane bounds the body: what of the feet is beyond is pressed towards it.
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

NEAR = 0.04                  # metres from the skin of the feet within which points are of them
FLAT = 0.002                 # metres from the plane within which a scan that ends flat ends
REACH = 0.015                # metres along the floor between the outline of a foot and where the scan ends
WALL = 0.006                 # metres above the floor where feet have an outline, wherever their soles came to lie
LEVEL = 0.7                  # cosine between the normal of a floor and the way from the feet to the rest of the body
TRIED, ENDS = 500, 12        # planes through three points, and points that a plane is fitted to at least


@dataclass(frozen=True, eq=False)
class Grounded:
    """A body with its soles on the floor: its vertices (N, 3), metres, and the floor.

    `beyond` is how far the lowest vertex was beyond the floor, and how far it is now, metres.
    """

    vertices: np.ndarray
    floor: Plane
    beyond: tuple[float, float]


def foot_of_vertex(template: Mesh, skeleton: Skeleton) -> np.ndarray:
    """(N,) int: the foot of each vertex, 1 left and 2 right, the last parts of the legs; 0 elsewhere.

    Where the skeleton has no named legs, there are none.
    """
    part, foot = skeleton.part_of_vertex(template), np.zeros(len(template.vertices), dtype=np.int64)
    for number, side in enumerate(("left", "right"), 1):
        leg = limb_parts(skeleton.names, skeleton.parents, skeleton.joints, "leg", side)
        for j in range(len(skeleton.parents) if len(leg) > 1 else 0):
            if leg[-1] in above(skeleton.parents, j):
                foot[part == j] = number
    return foot


def with_soles(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, parts: PersonParts | None) -> Registration:
    """A registration whose soles rest on the floor at which its scan ends; else as it is, and for no person."""
    if parts is None:
        return fit
    target = orient_by_mesh(target_of(scan), fit.mesh, NORMALS * size(template))
    found = put_on_floor(template, fit.mesh, foot_of_vertex(template, parts.skeleton), target.points, target.normals)
    if found is None:
        return fit
    vertices = without_inverted(template, found.vertices)          # narrow ones at rims of soles may turn over
    return replace(fit, mesh=template.with_vertices(vertices), soles=found.beyond,
                   inverted=int(find_inverted_triangles(template, vertices).sum()))


def soles_row(beyond: tuple[float, float] | None) -> list[Metric]:
    """The row that tells that soles were brought to the floor, from how far beyond it to how far, metres."""
    return [] if beyond is None else [
        Metric("soles", f"the scan ends flat at the floor: soles rest on it, {1000 * beyond[1]:.0f} mm beyond its "
                        f"end, where they were {1000 * beyond[0]:.0f} mm")]


def put_on_floor(reference: Mesh, body: Mesh, foot: np.ndarray, points: np.ndarray, normals: np.ndarray
                 ) -> Grounded | None:
    """A body with its soles on the floor at which a scan ends; None where it does not end flat around the feet.

    A scanner may cut some millimetres above the floor, and a body that is like the person knows its soles better then.
    So what is beyond the plane is pressed towards it the more, the more the feet had to be bent to lie on the scan, up
    to what scanners usually take away with the floor. Who is unlike the body, and was cut higher, comes out too short:
    two men cut at 12 mm by 10 mm, at 5 mm by 2.

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
    """
    floor = find_floor(body, foot > 0, points, normals)
    if floor is None:
        return None
    height = floor.height(body.vertices)
    shown = (height > 0) & (cKDTree(points).query(body.vertices)[0] < REACH)
    bent = max(_bending(reference, body, shown & (foot == number)) for number in np.unique(foot[foot > 0]))
    below = np.maximum(-height, 0)
    # Metres, RMS, that feet are bent from which on they say less of their soles than the end of the scan: synthetic
    # feet are bent by 0.9 to 1.9 mm on other synthetic people and know the soles to 3 mm; by 4 to 9 mm on real men,
    # to 13 mm; by 3.5 and 8 mm on two scans of a booth whose floor is known, to 12 and 18 mm.
    # millimetres above the floor that scanners cut at, lest it shows: usually 1.5, and hardly ever 12; deeper soles are
    # doubted more
    against = (bent / 0.003) ** 4 * (1 + (below.max() / 0.012) ** 2)
    pressed = (1 + against * min(0.0015 / below.max(), 1.0)) / (1 + against)
    return Grounded(body.vertices + ((1 - pressed) * below)[:, None] * floor.normal, floor,
                    (float(below.max()), float(pressed * below.max())))


def _bending(reference: Mesh, body: Mesh, shown: np.ndarray) -> float:
    """By how much a foot had to change its shape where it was shown, (N,) bool, metres; far if it was not."""
    if shown.sum() < 20:
        return 0.05                  # of which nothing was seen
    return bending(reference.vertices[shown], body.vertices[shown], body.vertex_areas[shown])[0]


def find_floor(body: Mesh, feet: np.ndarray, points: np.ndarray, normals: np.ndarray) -> Plane | None:
    """The plane in which a scan, points and normals (n, 3), ends around the feet (N,) of a body on it, or None.

    All of the scan lies above it, and of the body nothing but soles below. Soles that were scanned need no floor.
    """
    x = body.vertices
    if not feet.any() or feet.all() or not len(points):
        return None
    at_feet = cKDTree(x[feet]).query(points, distance_upper_bound=NEAR)[0] < NEAR
    near, normals = points[at_feet], normals[at_feet]
    floor = _supporting(near, x[feet].mean(axis=0), x[~feet].mean(axis=0))
    # share of the points at the feet that may lie behind the floor: specks
    if floor is None or np.mean(floor.height(near) < -2 * FLAT) > 0.005:
        return None
    height = floor.height(x)
    # metres beyond the plane: what is longer is a shin or a hand, not a sole
    if (height[~feet] < 0).any() or not -0.04 < height.min() < 0:
        return None
    ends = near[np.abs(floor.height(near)) < 2 * FLAT]
    outline, length = _outline(body, height - WALL)
    apart = cKDTree(floor.flat(ends)).query(floor.flat(outline))[0]
    # share of the outline of the feet along which the scan ends there; seen from in front 0.67
    if not len(outline) or length @ (apart < REACH) < 0.7 * length.sum():
        return None
    facing = 0.7  # cosine to the vertical of what is sole, and no wall
    flat = near[(normals @ floor.normal < -facing) & (np.abs(floor.height(near)) < FLAT)]
    # what is beyond the end of the scan: an arch above it is seen where the rest of the sole is cut away
    soles = x[feet & (height < 0) & (body.vertex_normals @ floor.normal < -facing)]
    if not len(flat) or not len(soles):
        return floor
    scanned = cKDTree(floor.flat(flat)).query(floor.flat(soles))[0] < REACH / 2
    # share with data, above which they were scanned themselves: 0.64 where it ends 4 mm above, 1 of a whole one
    return None if np.mean(scanned) > 0.8 else floor


def _supporting(points: np.ndarray, feet: np.ndarray, rest: np.ndarray) -> Plane | None:
    """The plane below the feet that all points (n, 3) lie above, from the middle (3,) of the feet and of the rest.

    It is the face of the convex hull on which the feet stand, fitted to the points on it.
    """
    try:
        hull = ConvexHull(points)
    except (QhullError, ValueError):       # too few points, or all in one plane
        return None
    up = (rest - feet) / np.linalg.norm(rest - feet)
    downwards = -hull.equations[:, :3] @ up
    way = -(hull.equations[:, :3] @ points.mean(axis=0) + hull.equations[:, 3]) / np.maximum(downwards, LEVEL)
    face = hull.equations[np.where(downwards > LEVEL, way, np.inf).argmin()]
    if -face[:3] @ up <= LEVEL:
        return None
    # noise tilts a face: of every square centimetre the lowest point, and of planes through three of them that which
    # most lie on; walls that rise from there, and what sticks out, are not on it
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
    lying = tukey(height, FLAT).sum(axis=0) - 2 * (height < -FLAT).sum(axis=0)
    best = int(np.where(normals @ up > LEVEL, lying, -np.inf).argmax())
    height = height[:, best]
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
    # of cuts it is 0 to 0.35 mm, of scans that end where scanners lose the rim of a sole, 3 to 9 mm above the floor,
    # 0.5 to 0.7 mm
    return Plane(normal, float(normal @ centre), noise) if normal @ up > LEVEL and noise < 0.00045 else None


def _outline(body: Mesh, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the surface crosses height 0 of its vertices (N,): the middles (n, 3) of pieces, and their lengths (n,)."""
    h = height[body.faces]
    crossing = (h.min(axis=1) < 0) & (h.max(axis=1) >= 0)
    corners, h = body.corners[crossing], h[crossing]
    ends = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        share = h[:, a] / np.where(h[:, a] == h[:, b], 1.0, h[:, a] - h[:, b])
        cut = (h[:, a] < 0) != (h[:, b] < 0)
        ends.append(np.where(cut[:, None], corners[:, a] + share[:, None] * (corners[:, b] - corners[:, a]), np.nan))
    places = np.stack(ends, axis=1)
    middle = np.nanmean(places, axis=1)
    return middle, 2 * np.nanmax(np.linalg.norm(places - middle[:, None], axis=2), axis=1)
