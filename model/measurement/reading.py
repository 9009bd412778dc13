"""One measurement of one body, with its derivative by every vertex."""
from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch

import numpy as np

from scanprep.geometry.mesh import Mesh

from .path import shortest_path
from .section import (
    Carried,
    SectionCurve,
    bulge,
    chain_length,
    direction,
    on_the_way,
    part_around,
    section,
    tape,
    tape_length,
)
from .tapes import Extent, Found, Girth, Height, Leg, Span, Straight, Tapes, Way, Weight

# kilograms of a person per cubic metre inside the skin, and spread. Tissue has 1,030 to 1,080, depending on fat; lungs
# half full hold 3 litres of air. The spread is that of fat (7% of the weight: 1.5%) and air (0.8 of 78 litres: 1%).
DENSITY, DENSITY_SPREAD = 985.0, 0.02
ENDS = np.sqrt(2.0)                  # slope of a distance between two landmarks that slide independently


class NotMeasuredError(ValueError):
    """A measurement that cannot be taken of a body; the message says why."""


@dataclass(frozen=True, eq=False)
class Standing:
    """A body in the triangles of a template; the rows of `axes` (3, 3) are unit vectors up, left and ahead."""

    mesh: Mesh
    axes: np.ndarray

    @property
    def vertices(self) -> np.ndarray:
        return self.mesh.vertices


@dataclass(frozen=True, eq=False)
class Reading:
    """One measurement of a body.

    `value` is in metres, or kilograms for a weight; `curve` (m, 3), metres, is the line of the tape. `force` (k, 3) is
    the derivative by `vertices` (k,), which may repeat. `slope`, metres per metre, is the change when its plane slides
    along the part, or its landmarks along the skin. `unknown` is the standard deviation of what no surface shows.
    """

    value: float
    curve: np.ndarray
    vertices: np.ndarray
    force: np.ndarray
    slope: float = 0.0
    unknown: float = 0.0

    def along(self, moves: np.ndarray) -> np.ndarray:
        """Compute the change (...,) of the value by moves (N, 3, ...) of all vertices."""
        return np.einsum("kd,kd...->...", self.force, moves[self.vertices])


@singledispatch
def read_measurement(found: Found, body: Standing, tapes: Tapes) -> Reading:
    """Take one measurement of a body.

    Raises
    ------
    NotMeasuredError
        A hole where the tape runs.
    """
    raise TypeError(f"expected a measurement, got {type(found).__name__}")


@read_measurement.register
def _girth(found: Girth, body: Standing, tapes: Tapes) -> Reading:
    cut = _cut_girth(found, body, tapes)
    points = cut.points[cut.hull]
    apart = np.abs(cut.hull - np.roll(cut.hull, 1))
    value, pull = tape_length(points, (apart == 1) | (apart == len(cut.points) - 1))    # next to each other on the skin
    return Reading(value, np.concatenate([points, points[:1]]), *_section_derivative(found, cut, cut.hull, pull, body))


@dataclass(frozen=True, eq=False)
class _Cut:
    """The section of a girth: its plane, its points (m, 3), and those that the tape touches, in order (`hull`).

    `change` (m, 3) is the derivative of the bulge at a point by its share along its edge. `height` carries the plane.
    """

    curve: SectionCurve
    height: Carried
    origin: np.ndarray
    normal: np.ndarray
    points: np.ndarray
    change: np.ndarray
    hull: np.ndarray


def _plane(found: Girth, body: Standing) -> tuple[np.ndarray, np.ndarray]:
    """Compute a point (3,) of the plane of a girth, on the axis of the part, and its normal."""
    normal = body.axes[0] if found.axis is None else direction(found.axis, body.vertices)
    centre = found.centre.at(body.vertices)
    return centre + (found.height.at(body.vertices) - centre) @ normal * normal, normal


def _cut_girth(found: Girth, body: Standing, tapes: Tapes) -> _Cut:
    """Cut the section of a girth by its carried plane; NotMeasuredError where it is not closed.

    Thigh and upper arm are measured as near to the trunk as they are separate. Their plane moves away in up to twelve
    steps of 4 mm for a person of 1.75 m. A girth between two levels is the longest of 13 sections there.
    """
    origin, normal = _plane(found, body)
    if found.between is not None:
        cuts = []
        for share in np.linspace(0, 1, 13):
            height = on_the_way(*found.between, float(share))
            place = origin + (height.at(body.vertices) - origin) @ normal * normal
            cuts.append(_cut_at(found, height, body, place, normal))
        closed = [cut for cut in cuts if cut is not None]
        if closed:
            return max(closed, key=lambda cut: tape_length(cut.points[cut.hull], None)[0])
    else:
        step = 0.004 * (np.ptp(body.vertices @ body.axes[0]) / 1.75) * found.aside * normal
        for place in (origin + tried * step for tried in range(12 if found.aside else 1)):
            cut = _cut_at(found, found.height, body, place, normal)
            if cut is not None:
                return cut
    raise NotMeasuredError("its plane runs out of the part it goes around")


def _cut_at(found: Girth, height: Carried, body: Standing, place: np.ndarray, normal: np.ndarray) -> _Cut | None:
    """Cut the section of a girth by a plane through a point (3,); None where it runs out of the part.

    NotMeasuredError where nothing is or a hole. Where arms are left out, the pieces of the section are joined.
    """
    vertices = body.vertices
    curves = section(vertices, found.faces, place, normal)
    curve = part_around(curves, vertices, place, normal)
    if curve is None:
        raise NotMeasuredError("its plane meets nothing there")
    # open curves that end at the border of the mesh mean a hole there
    ends = np.concatenate([c.edges[[0, -1]] for c in curves if not c.closed] or [np.zeros((0, 2), int)])
    if np.isin(ends, body.mesh.boundary_vertices).all(axis=1).any():
        raise NotMeasuredError("a hole of the mesh crosses it")
    if found.under_arms and not curve.closed:
        # front and back; a triangle of the arm that is left over is much shorter
        lengths = [0.0 if c.closed else chain_length(c.at(vertices))[0] for c in curves]
        pieces = [c for c, length in zip(curves, lengths, strict=True) if length > 0.2 * max(lengths)]
        curve = SectionCurve(np.concatenate([c.edges for c in pieces]), np.concatenate([c.share for c in pieces]), True)
    if not curve.closed:
        return None
    off, change = bulge(vertices, body.mesh.vertex_normals, curve)
    points = curve.at(vertices) + off
    return _Cut(curve, height, place, normal, points, change, tape(points, normal))


def _section_derivative(found: Girth, cut: _Cut, chosen: np.ndarray, pull: np.ndarray, body: Standing
                        ) -> tuple[np.ndarray, np.ndarray, float]:
    """Carry a derivative by points of a section to the vertices, with the plane that moves along.

    `chosen` (m,) are points of the section and `pull` (m, 3) the derivative by them. Returns vertices (k,), their force
    (k, 3), and the derivative by a shift of the plane along its normal. The effect of normals on the bulge is left out.
    """
    vertices, edges, share = body.vertices, cut.curve.edges[chosen], cut.curve.share[chosen]
    along = vertices[edges[:, 1]] - vertices[edges[:, 0]]
    out = np.einsum("md,md->m", pull, along + cut.change[chosen]) / (along @ cut.normal)
    on_edge = pull - out[:, None] * cut.normal
    by_plane = _plane_pull(cut.height, found.axis, out, cut.points[chosen] - cut.origin, cut.normal, vertices)
    return (np.concatenate([edges[:, 0], edges[:, 1], by_plane[0]]),
            np.concatenate([(1 - share)[:, None] * on_edge, share[:, None] * on_edge, by_plane[1]]), float(out.sum()))


def _plane_pull(height: Carried, axis: tuple[Carried, Carried] | None, out: np.ndarray, apart: np.ndarray,
                normal: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the derivative by the vertices that carry the plane of a girth: vertices (k,), force (k, 3).

    `out` (m,) is the derivative by each point's shift along the normal; `apart` (m, 3) are the points relative to the
    plane's.
    """
    ids, force = [height.vertices], [height.weights[:, None] * (out.sum() * normal)]
    if axis is not None:                                                  # the plane turns with the limb
        length = np.linalg.norm(axis[1].at(vertices) - axis[0].at(vertices))
        by_normal = -(out @ apart)
        by_end = (by_normal - (by_normal @ normal) * normal) / length
        for point, sign in zip(axis, (-1, 1), strict=True):
            ids.append(point.vertices)
            force.append(sign * point.weights[:, None] * by_end)
    return np.concatenate(ids), np.concatenate(force)


@read_measurement.register
def _span(found: Span, body: Standing, tapes: Tapes) -> Reading:
    girth = tapes.found[found.girth]
    assert isinstance(girth, Girth)
    cut, way = _cut_girth(girth, body, tapes), body.axes[found.axis]
    along = cut.points[cut.hull] @ way
    ends = cut.hull[[along.argmin(), along.argmax()]]
    drawn = _through(cut.points[ends].mean(axis=0), cut.points[ends], way)
    return Reading(float(np.ptp(along)), drawn, *_section_derivative(girth, cut, ends, np.stack([-way, way]), body))


def _through(middle: np.ndarray, points: np.ndarray, way: np.ndarray) -> np.ndarray:
    """Project points (n, 3) onto the line through a point (3,) along a unit vector (3,)."""
    return middle + np.outer((points - middle) @ way, way)


@read_measurement.register
def _height(found: Height, body: Standing, tapes: Tapes) -> Reading:
    up, height = body.axes[0], body.vertices @ body.axes[0]
    top = Carried(np.array([height.argmax()]), np.ones(1)) if found.top is None else found.top
    place = top.at(body.vertices)
    # a foot that is off the floor does not bear the body; soles differ by less than 3 cm where both do
    floors = [float(height[leg.sole].mean()) - leg.arch for leg in tapes.legs]
    bears = [floor < min(floors) + 0.03 for floor in floors]
    legs, floors = list(itertools.compress(tapes.legs, bears)), list(itertools.compress(floors, bears))
    soles = [leg.sole for leg in legs] or [np.array([height.argmin()])]
    floor = float(np.mean(floors or height.min()))
    longer, ids, force = _straighten(legs, body)
    value = float(place @ up) - floor + longer
    ids = np.concatenate([top.vertices, *soles, ids])
    force = np.concatenate([top.weights[:, None] * up, *(
        np.tile(-up / len(soles) / len(sole), (len(sole), 1)) for sole in soles), force])
    return Reading(value, np.stack([place - (place @ up - floor) * up, place]), ids, force,
                   0.0 if found.top is None else float(np.linalg.norm(top.weights)))


def _straighten(legs: Sequence[Leg], body: Standing) -> tuple[float, np.ndarray, np.ndarray]:
    """Compute by how much a body is taller on straight, upright legs, metres, and the derivative by vertices."""
    value, ids, force = 0.0, [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3))]
    for leg in legs:
        for upper, lower in itertools.pairwise(leg.centres):
            way = upper.at(body.vertices) - lower.at(body.vertices)
            length, weight = float(np.linalg.norm(way)), leg.share / len(legs)
            value += weight * (leg.straight * length - float(way @ body.axes[0]))
            pull = weight * (leg.straight * way / length - body.axes[0])
            ids += [upper.vertices, lower.vertices]
            force += [upper.weights[:, None] * pull, -lower.weights[:, None] * pull]
    return value, np.concatenate(ids), np.concatenate(force)


@read_measurement.register
def _straight(found: Straight, body: Standing, tapes: Tapes) -> Reading:
    ends = np.stack([found.first.at(body.vertices), found.second.at(body.vertices)])
    way = ends[1] - ends[0]
    value = float(np.linalg.norm(way))
    ids = np.concatenate([found.first.vertices, found.second.vertices])
    weights = np.concatenate([-found.first.weights, found.second.weights])
    return Reading(value, ends, ids, weights[:, None] * (way / value), ENDS)


@read_measurement.register
def _extent(found: Extent, body: Standing, tapes: Tapes) -> Reading:
    vertices, up = body.vertices, body.axes[0]
    way = found.second.at(vertices) - found.first.at(vertices)
    way = way - (way @ up) * up
    length = np.linalg.norm(way)
    way = way / length
    along = vertices[found.vertices] @ way
    ends = found.vertices[[along.argmin(), along.argmax()]]
    apart = vertices[ends[1]] - vertices[ends[0]]
    turned = apart - (apart @ way) * way - (apart @ up) * up              # the direction is carried too
    ids = np.concatenate([ends, found.first.vertices, found.second.vertices])
    weights = np.concatenate([-found.first.weights, found.second.weights])
    return Reading(float(np.ptp(along)), _through(vertices[ends].mean(axis=0), vertices[ends], way), ids,
                   np.concatenate([-way[None], way[None], weights[:, None] * turned / length]))


@read_measurement.register
def _way(found: Way, body: Standing, tapes: Tapes) -> Reading:
    total, drawn, ids, force = 0.0, list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    last = len(found.faces) - 1
    for k, (start, end, faces) in enumerate(zip(found.vertices, found.vertices[1:], found.faces, strict=False)):
        try:
            length, curve = shortest_path(body.vertices, faces, start, end)
        except ValueError as problem:
            raise NotMeasuredError(str(problem)) from None
        points = curve.at(body.vertices)
        _, pull = chain_length(points)
        if k == last and found.until is not None:
            girth = tapes.found[found.until]
            assert isinstance(girth, Girth)
            more, points, by_end = _until(girth, curve, body)
            length += more
            ids.append(by_end[0])
            force.append(by_end[1])
        total += length
        drawn.append(points[::-1])                                        # the way is found from its end
        ids += [curve.edges[:, 0], curve.edges[:, 1]]
        force += [(1 - curve.share)[:, None] * pull, curve.share[:, None] * pull]
    return Reading(total, np.concatenate(drawn), np.concatenate(ids), np.concatenate(force), ENDS)


def _until(girth: Girth, way: SectionCurve, body: Standing) -> tuple[float, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Extend a path straight on to the plane of a girth, or cut it there; its last point comes first.

    Returns the change of length, metres, the points of the new path, and vertices (k,) with their force (k, 3).
    """
    (origin, normal), points = _plane(girth, body), way.at(body.vertices)
    last = way.edges[0, 0]
    # the direction is that of the last 5 cm
    k = int((np.linalg.norm(points - points[0], axis=1) > 0.05).argmax()) or len(points) - 1
    before = way.edges[k, int(way.share[k] > 0.5)]                        # a vertex, as points of ways slide
    ahead = points[0] - body.vertices[before]
    reach, rise, lack = float(np.linalg.norm(ahead)), ahead @ normal, (origin - points[0]) @ normal
    by_ahead = lack * (ahead / (reach * rise) - reach / rise**2 * normal)
    ids, force = _plane_pull(girth.height, girth.axis, np.array([reach / rise]), (points[0] - origin)[None], normal,
                             body.vertices)
    beyond = int(((points - origin) @ normal * np.sign(rise) < 0).argmax())      # so many points lie behind the plane
    if beyond:
        # the way crosses the plane: it ends there
        step = points[beyond] - points[beyond - 1]
        crossing = points[beyond - 1] + (origin - points[beyond - 1]) @ normal / (step @ normal) * step
        more = -float(np.linalg.norm(np.diff(np.vstack([points[:beyond], crossing]), axis=0), axis=1).sum())
    else:
        crossing, more = points[0] + lack / rise * ahead, lack / rise * reach
    return (more, np.vstack([crossing, points[beyond:]]),
            (np.r_[last, before, ids], np.vstack([by_ahead - reach / rise * normal, -by_ahead, force])))


@read_measurement.register
def _weight(found: Weight, body: Standing, tapes: Tapes) -> Reading:
    a, b, c = np.moveaxis(body.mesh.corners, 1, 0)
    by_corner = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1) / 6      # of the volume
    outside = np.sign(body.mesh.volume) * DENSITY
    force = np.zeros_like(body.vertices)
    np.add.at(force, body.mesh.faces, outside * by_corner)
    value = abs(body.mesh.volume) * DENSITY
    return Reading(value, np.zeros((0, 3)), np.arange(len(force)), force, unknown=DENSITY_SPREAD * value)
