"""Joint centres and facial points of a person who stands upright, without a click."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.farthest_points import thin
from scanprep.geometry.format_common import UNITS
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sanitise import sanitise
from scanprep.geometry.surface import Surface
from scanprep.registration.nonrigid import Registration, register
from scanprep.registration.schedule import RegistrationConfig
from scanprep.threads import one_thread, search_threads
from scanprep.words import number_of

from ...body import Progress
from ..control.model import ControlModel
from ..detail.subdivision import divide_long_edges
from .features import FeatureFit, fit_features
from .person_search import Stand, find_stand, shows_person

# metres: length of a person, and the range in which a file's own unit is believed; others are seldom people
TALL, SMALLEST, LARGEST = 1.7, 1.07, 2.31
# metres: edges of the control model are 40 mm. At 25 mm a person of 800 triangles gives the joints of the full mesh
LONGEST_EDGE = 0.025
DOUBTED_MARGIN = 1.2


@dataclass(frozen=True, eq=False)
class Features:
    """What was found on a scan, in the scan's own axes and unit."""

    joints: dict[str, np.ndarray]  # {name: (3,)}, joint centres with data around them
    points: dict[str, np.ndarray]  # {name: (3,)}, landmarks with data around them
    missing: tuple[str, ...]       # joints and landmarks that the scan does not show
    registered: Mesh | None        # the control mesh on the scan; None where no person was found
    fit: FeatureFit | None         # of the control model to these features
    problem: str | None            # why the features should not be trusted


@one_thread()
def find_features(control: ControlModel, scan: Mesh, progress: Progress | None = None) -> Features:
    """Find joint centres and landmarks of a person who stands upright, by a humanoid control model.

    Unit and axes of the scan need not be known. It may have holes, or show a part of a person. The control model, z up
    and facing -y, is placed in many ways; the best are posed to fit the scan, and one of them is registered.
    """
    if max(len(scan.vertices), len(scan.faces)) < 100:
        raise ValueError(f"scan: expected a person of at least 100 points, got {scan}")
    scan = sanitise(scan)
    # a part of a person is shorter than a person: then a usual unit may be right
    nearest = nearest_unit(scan.vertices)
    sizes = {UNITS[nearest]: nearest} | dict([person_unit(scan.vertices)])
    for metres, unit in sizes.items():
        found = _find_features(control, scan, metres, unit, progress)
        if found.fit is not None:
            break
    return found


def _find_features(control: ControlModel, scan: Mesh, metres: float, unit: str, progress: Progress | None) -> Features:
    """Find joint centres and landmarks in a scan with so many metres a unit."""
    data = sample_evenly(scan, metres)
    best, other = find_stand(control, data)
    problem = nobody_problem(best, other, unit)
    if problem:
        # where they would be, to be mended by hand
        centres = control.skeleton.joint_regressor(control.mesh) @ best.mesh.vertices / metres
        return Features(dict(zip(control.skeleton.names[1:], centres[1:], strict=True)), {}, (), None, None, problem)
    result = register(best.mesh, data, config=RegistrationConfig(graph=RegistrationConfig().graph[-2:]),
                      start=np.eye(4), progress=progress)
    joints, points, missing = _features(control, result, data, metres)
    fit = fit_features(control, joints, points) if len(joints) + len(points) > 2 else None
    registered = control.mesh.with_vertices(result.mesh.vertices / metres)
    problem = why_uncertain(other.off / best.off) if fit else (
        f"{number_of(len(joints), 'joint')} and {number_of(len(points), 'point')} of the face have data around them, "
        "too few to place a person: "
        "a part of one only?")
    return Features(joints, points, missing, registered, fit, problem)


def sample_evenly(scan: Mesh, metres: float) -> Mesh | np.ndarray:
    """Bring a scan to metres with vertices that measure its surface: long edges divided, or dense points thinned."""
    scan = divide_long_edges(scan.with_vertices(metres * scan.vertices), LONGEST_EDGE)
    return scan if len(scan.vertices) < 40_000 else scan.vertices[thin(scan.vertices, 0.007)]


def nobody_problem(best: Stand, other: Stand, size: str) -> str | None:
    """Explain why there is no person in a scan, or none that stands upright; None where there is one."""
    if shows_person(best, other):
        return None
    return (f"no person who stands upright was found (the unit taken for {size}): a body bent onto the scan stays "
            f"{1000 * best.off:.0f} mm off, and {other.off / best.off:.2f} times as far when it faces another way; "
            "something else, several people, a pedestal, or a pose that needs joints by hand?")


def why_uncertain(margin: float) -> str | None:
    """Explain why front and back may be exchanged; None where they are not. Distances are those of the finished statue.
    """
    return (None if margin >= DOUBTED_MARGIN else
            f"facing another way it fits only {margin:.2f} times worse: look at it, or click")


def person_unit(points: np.ndarray) -> tuple[float, str]:
    """Choose how many metres a unit of points (n, 3) has, so that they are as long as a person; and say it in words.

    Where no known unit makes them that long, as for most figures of artists, they are brought to 1.7 m.

    Examples
    --------
    >>> person_unit(np.diag([1750.0, 400, 200]))
    (0.001, 'mm, from the height of the body')
    """
    longest, unit = max(_length(points), 1e-12), nearest_unit(points)
    if SMALLEST <= longest * UNITS[unit] <= LARGEST:
        return UNITS[unit], f"{unit}, from the height of the body"
    return TALL / longest, f"1 unit = {TALL / longest:.3g} m, brought to {TALL} m as no unit makes it a person's size"


def nearest_unit(points: np.ndarray) -> str:
    """Choose the unit in which points (n, 3) are most nearly as long as a person."""
    longest = max(_length(points), 1e-12)
    return min(UNITS, key=lambda unit: abs(np.log(longest * UNITS[unit] / TALL)))


def _length(points: np.ndarray) -> float:
    """Compute the extent of points (n, 3) along their principal direction."""
    spread = points - points.mean(axis=0)
    return float(np.ptp(spread @ np.linalg.svd(spread[:: max(1, len(spread) // 5000)], full_matrices=False)[2][0]))


def _features(control: ControlModel, found: Registration, scan: Mesh | np.ndarray, metres: float
              ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], tuple[str, ...]]:
    """Collect joints and points with data around them, in the unit of the scan, and the names of the others."""
    skeleton, near = control.skeleton, control.mesh.vertex_adjacency
    x, seen = found.mesh.vertices, found.confidence
    centres = skeleton.joint_regressor(control.mesh) @ x / metres
    around = (near @ seen + seen) / (near.sum(axis=1) + 1)
    least_shown = 0.3  # share of the vertices around a joint or landmark, or of a limb, that must have data
    shown = np.array([seen[skeleton.joint_weights(control.mesh,
                                                  j)[0]].mean() > least_shown for j in range(len(centres))])
    part = control.weights.argmax(axis=1)
    # a limb has data of its own only where its nearest scan points are not near the rest of the body as well. Otherwise
    # points of a thigh could count as a hand on it.
    data = scan.vertices if isinstance(scan, Mesh) else scan
    nearest = data[cKDTree(data).query(x, workers=search_threads(len(x)))[1]]
    of_face = part[control.mesh.faces].min(axis=1)
    for j, parent in enumerate(skeleton.parents):
        limb = np.flatnonzero(skeleton.descends[:, j])
        of_limb = np.isin(part, limb)
        if parent >= 0 and of_limb.any():
            rest = found.mesh.submesh(~np.isin(of_face, limb))[0]
            # points within 2 cm of the rest of the body are not evidence of a limb
            own = Surface(rest).closest(nearest[of_limb]).distances > 0.02
            shown[j] &= bool((own * seen[of_limb]).mean() > least_shown)
        shown[j] &= parent <= 0 or shown[parent]
    joints = {name: centres[j] for j, name in enumerate(skeleton.names) if shown[j]}
    places = x / metres
    points = {name: places[v] for name, v in control.landmarks.items()
              if around[v] > least_shown and (shown[part[v]] or part[v] == 0)}
    lacking = tuple(name for name in (*skeleton.names, *control.landmarks) if name not in {*joints, *points})
    return joints, points, lacking
