"""Measurements of one body, by the tapes of its template."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.words import describe_result

from .reading import NotMeasuredError, Reading, Standing, read_measurement
from .tapes import Tapes

REACH = 0.15                         # metres over which errors of the surface are correlated
PLACE = 0.007                        # metres from where a section or landmark should be, along the part
MANY = 2000                          # vertices: the matrix of their distances takes 100 megabytes with intermediates


@dataclass(frozen=True, eq=False)
class Measurements:
    """Result of `measure`.

    Attributes
    ----------
    readings : dict of str to Reading
        Every measurement with its curve and derivative, in the order of the catalogue.
    missing : dict of str to str
        Why a measurement could not be taken.
    turned : tuple of str
        Limbs that are far from the standard pose, in which their measurements differ.
    axes : (3, 3) float
        Unit vectors up, left and ahead of the body.
    errors : dict of str to float
        Expected error, root mean square, in the unit of the measurement.
    body : (N, 3) float, metres
        The vertices on which the curves lie.

    Examples
    --------
    >>> from model import find_tapes, load_built_in_model, measure
    >>> model = load_built_in_model()
    >>> result = measure(model.template, find_tapes(model.template, model.info["landmarks"]), only=["weight"])
    >>> list(result.values), result.turned
    (['weight'], ())
    """

    readings: Mapping[str, Reading]
    missing: Mapping[str, str]
    turned: tuple[str, ...]
    axes: np.ndarray
    errors: Mapping[str, float]
    body: np.ndarray
    __repr__ = describe_result

    @property
    def values(self) -> dict[str, float]:
        """Metres, and kilograms of the weight, by name."""
        return {name: reading.value for name, reading in self.readings.items()}


@take_any_mesh
def measure(body: Mesh | np.ndarray, tapes: Tapes, axes: np.ndarray | None = None,
            expected_error: np.ndarray | None = None, only: Iterable[str] | None = None) -> Measurements:
    """Measure a body that has the triangles of a template and stands about as it does.

    A girth is the length of a tape: the convex hull of a plane section. The plane is level for trunk, head and thighs,
    and across the limb or neck for the others. The vertices carry its centre and axis, and the section is cut anew.
    Lengths along the surface are exact shortest paths over the same landmarks. The weight follows from the volume.

    Parameters
    ----------
    body : Mesh or (N, 3) float, metres
        The body, in the topology of the template.
    tapes : Tapes
        Tapes of the template, see `find_tapes`.
    axes : (3, 3) float, optional
        Unit vectors up, left and ahead of the body; by default from aligning the template with it.
    expected_error : (N,) float, metres, optional
        Expected errors of the vertices, for example of a `Completion`. Without it the surface counts as exact.
    only : iterable of str, optional
        Names of the catalogue; by default all.

    Returns
    -------
    Measurements
        Values in metres, the weight in kilograms, with curves, missing measurements and expected errors.

    Raises
    ------
    ValueError
        Another number of vertices, or vertices that are not finite.

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
        except NotMeasuredError as problem:
            missing[name] = str(problem)
    errors = {name: measurement_error(reading, standing.mesh, expected_error) for name, reading in readings.items()}
    return Measurements(readings, missing, find_turned_limbs(tapes, standing), axes, errors, vertices)


def laid_on(template: Mesh, vertices: np.ndarray) -> np.ndarray:
    """Find the rotation (3, 3) from the template to a body (N, 3); limbs that moved lose weight, round by round."""
    weights, R = template.vertex_areas, np.eye(3)
    for _ in range(20):
        here, there = (points - np.average(points, axis=0, weights=weights)
                       for points in (template.vertices, vertices))
        R = rotations.project((weights[:, None] * there).T @ here)
        weights = template.vertex_areas / (0.01 + np.linalg.norm(here @ R.T - there, axis=1))
    return R


def stands(vertices: np.ndarray, tapes: Tapes) -> bool:
    """Return whether a body (N, 3) stands nearly as its template, so that it need not be reposed."""
    mesh = tapes.template.with_vertices(vertices)
    # half the usual limits: for smaller turns, reposing costs more millimetres than it saves
    return not find_turned_limbs(tapes, Standing(mesh, tapes.axes @ laid_on(tapes.template, vertices).T), 0.5)


def find_turned_limbs(tapes: Tapes, body: Standing, share: float = 1.0) -> tuple[str, ...]:
    """Describe limbs that point elsewhere than on the template, by more than a share of the usual limits."""
    texts = []
    # degrees from the standard pose that change measurements little
    turned = {"upper arm": 30.0, "forearm": 35.0, "shin": 15.0}
    for name, (first, second) in tapes.limbs.items():
        ways = [(second.at(vertices) - first.at(vertices)) @ axes.T for vertices, axes in (
            (tapes.template.vertices, tapes.axes), (body.vertices, body.axes))]
        cosine = ways[0] @ ways[1] / (np.linalg.norm(ways[0]) * np.linalg.norm(ways[1]))
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        if angle > share * turned[name.split(" ", 1)[1]]:
            texts.append(f"the {name} is turned by {angle:.0f} degrees from the standard pose")
    return tuple(texts)


def measurement_error(reading: Reading, body: Mesh, expected: np.ndarray | None) -> float:
    """Compute the expected error of a measurement, root mean square, in its unit.

    The derivative by the vertices is applied to the errors of the surface. Errors of the place of the tape along the
    skin are added, and those that no surface shows.

    Parameters
    ----------
    reading : Reading
        The measurement.
    body : Mesh, metres
        The body that was measured.
    expected : (N,) float, metres, optional
        Root mean square error of each vertex, as of a completion; none for an exact surface.
    """
    surface = 0.0 if expected is None else error_of_surface(reading, body, expected)
    return float(np.sqrt(surface**2 + (PLACE * reading.slope)**2 + reading.unknown**2))


def error_of_surface(reading: Reading, body: Mesh, expected: np.ndarray) -> float:
    """Compute the error of a measurement by that of the surface.

    Errors are equal in all directions. Where the surface lies too far out, so does the skin within `REACH`: its error
    along the normal is correlated. So is that along the surface, as a vector.
    """
    vertices, ids = body.vertices, reading.vertices
    pull = expected[ids][:, None] * reading.force / np.sqrt(3)
    out = np.einsum("kd,kd->k", pull, body.vertex_normals[ids])
    parts = np.column_stack([out, pull - out[:, None] * body.vertex_normals[ids]])
    # with thousands of vertices, those in one cube of a quarter of the reach are summed: their errors are alike
    cubes = vertices if len(np.unique(ids)) < MANY else np.floor(vertices / (0.25 * REACH))
    first, place = np.unique(cubes[ids], axis=0, return_index=True, return_inverse=True)[1:]
    sums = np.zeros((len(first), 4))
    np.add.at(sums, place.ravel(), parts)
    points = vertices[ids[first]]
    together = np.exp(-0.5 * (np.linalg.norm(points[:, None] - points, axis=2) / REACH)**2)
    return float(np.sqrt(max(np.einsum("id,ij,jd->", sums, together, sums), 0)))
