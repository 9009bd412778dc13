"""Measurements of one body: the tapes of its template laid on it."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh

from .reading import NotMeasured, Reading, Standing, read_measurement
from .tapes import Tapes

# Chosen on half views of the ten even people of `tests/benchmarks/measures.py`, which tells how far the odd ones agree.
MOST, SHARE = 0.010, 0.02            # metres, and of the value: more is an error of the pose, which repose takes away
MANY = 2000                          # vertices, whose distances from each other are 100 megabytes


@dataclass(frozen=True, eq=False)
class Measurements:
    """What was measured of a body.

    Attributes
    ----------
    readings : dict of name to Reading
        In the order of the catalogue.
    missing : dict of name to str
        Why a measurement is not there.
    turned : tuple of str
        Limbs that are far from the standard pose: what was measured there is of that pose.
    axes : (3, 3) float
        Unit vectors up, left and ahead of the body.
    errors : dict of name to float
        Expected error, root mean square, in the unit of the measurement; of the weight alone where none is known of
        the vertices.
    """

    readings: Mapping[str, Reading]
    missing: Mapping[str, str]
    turned: tuple[str, ...]
    axes: np.ndarray
    errors: Mapping[str, float] = field(default_factory=dict)

    @property
    def values(self) -> dict[str, float]:
        """Metres, and kilograms of the weight, by name."""
        return {name: reading.value for name, reading in self.readings.items()}


def measure(body: Mesh | np.ndarray, tapes: Tapes, axes: np.ndarray | None = None,
            expected_error: np.ndarray | None = None, only: Iterable[str] | None = None) -> Measurements:
    """Measure a body that has the triangles of a template and stands about as it does.

    A girth is the length of a tape, the convex hull of a plane section: level for trunk, head and thighs, across the
    limb or the neck for the others. Its centre and axis are carried by the vertices, the plane is cut anew. Ways along
    the surface are exact shortest paths over the same landmarks. The weight is that of the volume.

    Parameters
    ----------
    body : Mesh or (N, 3) float, metres
    tapes : Tapes
        Of the template, see `find_tapes`.
    axes : (3, 3) float, optional
        Unit vectors up, left and ahead of the body; found by laying the template on it when not given.
    expected_error : (N,) float, metres, optional
        Of the vertices, as of a `Completion`.
    only : names, optional
        Of the catalogue; all when not given.

    Raises
    ------
    ValueError
        Vertices of another count or not finite.

    Examples
    --------
    >>> from model import find_tapes, load_built_in_model
    >>> model = load_built_in_model()
    >>> found = measure(model.template, find_tapes(model.template, model.info["landmarks"]))
    >>> 1.6 < found.values["stature"] < 1.8, 70 < found.values["weight"] < 90
    (True, True)
    """
    vertices = np.asarray(body.vertices if isinstance(body, Mesh) else body, dtype=np.float64)
    if vertices.shape != tapes.template.vertices.shape or not np.isfinite(vertices).all():
        raise ValueError(f"body: expected finite numbers of shape {tapes.template.vertices.shape}, "
                         f"got shape {vertices.shape}")
    axes = tapes.axes @ laid_on(tapes.template, vertices).T if axes is None else axes
    standing = Standing(tapes.template.with_vertices(vertices), axes)
    readings, missing = dict[str, Reading](), dict(tapes.missing)
    for name in tapes.found if only is None else [n for n in only if n in tapes.found]:
        try:
            readings[name] = read_measurement(tapes.found[name], standing, tapes)
        except NotMeasured as problem:
            missing[name] = str(problem)
    errors = {name: reading.unknown if expected_error is None else measurement_error(reading, vertices, expected_error)
              for name, reading in readings.items() if expected_error is not None or reading.unknown}
    return Measurements(readings, missing, find_turned_limbs(tapes, standing), axes, errors)


def laid_on(template: Mesh, vertices: np.ndarray) -> np.ndarray:
    """The turn (3, 3) that lays the template on a body (N, 3): of trunk and legs, as limbs that moved lose weight."""
    weights, R = template.vertex_areas, np.eye(3)
    for _ in range(20):
        here, there = (points - np.average(points, axis=0, weights=weights)
                       for points in (template.vertices, vertices))
        R = rotations.project((weights[:, None] * there).T @ here)
        weights = template.vertex_areas / (0.01 + np.linalg.norm(here @ R.T - there, axis=1))
    return R


def stands(vertices: np.ndarray, tapes: Tapes) -> bool:
    """Whether a body (N, 3) stands so nearly as its template that it need not be brought into that pose."""
    mesh = tapes.template.with_vertices(vertices)
    # half of what changes little is not worth the millimetres that another pose costs
    return not find_turned_limbs(tapes, Standing(mesh, tapes.axes @ laid_on(tapes.template, vertices).T), 0.5)


def find_turned_limbs(tapes: Tapes, body: Standing, share: float = 1.0) -> tuple[str, ...]:
    """Limbs that point elsewhere than on the template, by more than a share of what changes little, in words."""
    found = []
    turned = {"upper arm": 30.0, "forearm": 35.0, "shin": 15.0}  # degrees from the standard pose that change little
    for name, (first, second) in tapes.limbs.items():
        ways = [(second.at(vertices) - first.at(vertices)) @ axes.T for vertices, axes in (
            (tapes.template.vertices, tapes.axes), (body.vertices, body.axes))]
        cosine = ways[0] @ ways[1] / (np.linalg.norm(ways[0]) * np.linalg.norm(ways[1]))
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        if angle > share * turned[name.split(" ", 1)[1]]:
            found.append(f"the {name} is turned by {angle:.0f} degrees from the standard pose")
    return tuple(found)


def measurement_error(reading: Reading, vertices: np.ndarray, expected: np.ndarray) -> float:
    """Expected error, root mean square, of a measurement, in its unit.

    The derivative by the vertices is applied to errors that are alike in all directions and go together over some
    way, so that a girth sums them up and a distance feels its ends; sliding along the skin comes on top, and what no
    surface tells.

    Parameters
    ----------
    reading : Reading
    vertices : (N, 3) float, metres
    expected : (N,) float, metres
        Root mean square error of each vertex, as of a completion.
    """
    most = MOST if reading.unknown else min(MOST, SHARE * reading.value)
    pull = np.minimum(expected[reading.vertices], most)[:, None] * reading.force / np.sqrt(3)
    # of thousands of vertices those of one cube are taken together: within a quarter of the reach errors are alike
    reach = 0.10  # metres, over which errors of the surface go together
    cubes = vertices if len(np.unique(reading.vertices)) < MANY else np.floor(vertices / (0.25 * reach))
    first, place = np.unique(cubes[reading.vertices], axis=0, return_index=True, return_inverse=True)[1:]
    place = place.ravel()
    sums = np.zeros((len(first), 3))
    np.add.at(sums, place, pull)
    points = vertices[reading.vertices[first]]
    together = np.exp(-0.5 * (np.linalg.norm(points[:, None] - points, axis=2) / reach)**2)
    variance = np.einsum("id,ij,jd->", sums, together, sums)
    # metres that a section may lie beside its place along the part, or a landmark
    return float(np.sqrt(max(variance, 0) + (0.003 * reading.slope)**2 + reading.unknown**2))
