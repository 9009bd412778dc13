"""Non-rigid registration of a template to a scan, from stiff to soft.

1. Place the template by path lengths to its landmarks, whatever its pose.
2. Pull a graph of rotating and scaling nodes to the scan by matches in both directions. Stages go from stiff to soft
   and from coarse to fine. Rotations are unknowns, so limbs keep their volume where there are no data.
3. Fit the surface to the scan down to its noise, evenly stretched and without inverted triangles.

[Hahnel], [Allen], [Amberg]
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, wraps
from typing import Any, TypeVar, cast

import numpy as np
from scipy.spatial import cKDTree

from ..correspondence.correspondences import Correspondences
from ..geometry.mesh import Mesh
from ..geometry.places import point_areas
from ..geometry.surface import OrientedPoints, Surface, check_points
from ..geometry.target import Target, orient_by_mesh
from ..judgement import HAND, UNJUDGED, Judgement, extent, size
from ..plausible import unit_problem
from ..threads import one_thread
from ..words import describe_result
from .final_fit import final_fit
from .folds import find_inverted_triangles, without_inverted
from .graph_fit import register_graph
from .matches import NORMALS, Fit, RegistrationProblem, initial_transform, prepare_problem
from .schedule import RegistrationConfig


@dataclass(frozen=True, eq=False)
class Registration:
    """The template on the scan, with quality figures.

    Attributes
    ----------
    mesh : Mesh
        The template's triangles with vertices on the scan.
    distances : (N,) float, metres
        Distance of each vertex with data to the surface of the scan; NaN elsewhere.
    seen : (N,) bool
        Vertices with data: their confidence is at least one half.
    rms : float, metres
        RMS of the distances; NaN without data.
    landmark_rms : float, metres
        RMS distance of the landmarks; NaN without landmarks.
    converged : bool
        The last step moved the mean vertex by less than a thousandth of the template's size. False without data.
    iterations : int
        Steps over all stages.
    energies : dict of str to float
        Each energy term at the end of the coarse registration, and the strain of the final fit.
    inverted : int
        Triangles that face against their surroundings.
    confidence : (N,) float
        From 0, extrapolated from the surroundings, to 1, data here by matches in both directions.
    uncovered : float
        Share of the scanned surface more than a hundredth of the template's size (the root of its area) off it.
        More than half a per cent is a limb in the wrong place, or clutter. `converged` does not show that.
    rolled : bool
        Limbs were re-rolled by `repair_limbs`.
    soles : (float, float), metres, or None
        How far soles were beyond the end of the scan, before and after `with_soles`.
    judge : callable, optional
        Gives the `judgement`, which is made when it is first asked for.

    Examples
    --------
    >>> corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    >>> template = Mesh(corners, [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4],
    ...                           [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    >>> fit = register(template, template.with_vertices(1.1 * template.vertices), config=RegistrationConfig.quick())
    >>> fit.mesh.vertices.shape, fit.inverted
    ((6, 3), 0)
    """

    mesh: Mesh
    distances: np.ndarray
    seen: np.ndarray
    rms: float
    landmark_rms: float
    converged: bool
    iterations: int
    energies: dict[str, float]
    inverted: int
    confidence: np.ndarray
    uncovered: float
    rolled: bool = False
    soles: tuple[float, float] | None = None
    judge: Callable[[Registration], Judgement] | None = None
    __repr__ = describe_result

    @cached_property
    def judgement(self) -> Judgement:
        """The verdict of `scape prep register`; on a person, whose parts are found first, it takes some seconds."""
        return UNJUDGED if self.judge is None else self.judge(self)

    @property
    def measured(self) -> float:
        """Share of the template's surface with data."""
        return self.mesh.share_of_area(self.seen)


@dataclass(frozen=True, eq=False)
class LedRegistration:
    """A registration without landmarks, or with few, and what initialised it: see `register_by_any`."""

    fit: Registration
    way: str                                    # what initialised it: "model people", "160 correspondences"
    rival: LedRegistration | None = None        # another body on the scan that is almost as plausible
    worn: tuple[str, ...] = ()                  # hair and clothes that were left out, in words


def translate(what: Any, by: np.ndarray) -> Any:
    """Translate any input or result of a registration by `by` (3,), metres; return anything else as it is.

    It knows meshes, registrations, points (n, 3), transforms (4, 4), correspondences, and tuples of these.
    """
    if isinstance(what, Mesh):
        return what.with_vertices(what.vertices + by)
    if isinstance(what, Registration):
        return replace(what, mesh=translate(what.mesh, by))
    if isinstance(what, LedRegistration):
        return replace(what, fit=translate(what.fit, by), rival=translate(what.rival, by))
    if isinstance(what, Correspondences):
        return replace(what, scan_points=what.scan_points + by)
    if isinstance(what, tuple):
        return tuple(translate(part, by) for part in what)
    if np.ndim(what) != 2:
        return what
    moved = np.array(what, dtype=np.float64)
    moved[:3, 3:] += by[:, None]                          # the translation of a (4, 4) transform
    return moved if moved.shape == (4, 4) else moved + by


F = TypeVar("F", bound=Callable[..., Any])


def near_origin(method: F) -> F:
    """Decorate a function of template and scan, so that it also works far from the origin, as in UTM coordinates.

    Everything but the template is moved near the origin, and the result is moved back.
    """
    @wraps(method)
    def wrapper(template: Mesh, scan: Mesh | np.ndarray, *args: Any, **named: Any) -> Any:
        points = check_points(scan.vertices if isinstance(scan, Mesh) else scan, "scan")
        middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else np.zeros(3)
        # within 100 m nothing is moved: 3 m away a registration is the same to 1e-14 m; 5,000 km away it was 15 mm off
        if np.abs(middle).max() <= 100:
            return method(template, scan, *args, **named)
        near = {name: translate(value, -middle) for name, value in named.items()}
        return translate(method(template, *translate((scan, *args), -middle), **near), middle)

    return cast(F, wrapper)


@near_origin
@one_thread()
def register(template: Mesh, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
             config: RegistrationConfig | None = None, progress: Callable[[int, int], None] | None = None,
             correspondences: Correspondences | None = None, start: np.ndarray | None = None) -> Registration:
    """Register a template to a scan: deform it until its surface lies on the scan.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        It may have holes, borders, several overlapping sheets and noise.
    landmarks : ((L,) int, (L, 3) float, metres), optional
        Vertices of the template and their positions on the scan. Needed wherever the pose differs much.
    config : RegistrationConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total).
    correspondences : Correspondences, optional
        Hints, of which some may be wrong. Their pull is soft, and weaker for hints far from their target.
    start : (4, 4) or (N, 3) float, metres, optional
        A transform that brings the template near the scan; by default found from landmarks, else by ICP. ICP can fail
        on a partial scan. Or approximate vertices, for example of a body model; then only the last stages run, and
        a result that leaves what these already cover is not kept.

    Returns
    -------
    Registration
        The mesh on the scan, metres, with the confidence of every vertex and quality figures.

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite, fewer than
        three landmarks or landmarks that do not exist.

    Examples
    --------
    >>> t, p = np.meshgrid(np.linspace(0, np.pi, 12)[1:-1], np.arange(24) * np.pi / 12, indexing="ij")
    >>> scan = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), 1.2 * np.cos(t)], axis=-1).reshape(-1, 3)
    >>> template = Mesh([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], [
    ...     [0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    >>> register(template, scan, config=RegistrationConfig.quick()).mesh.vertices.shape
    (6, 3)

    [Hahnel], [Allen], [Amberg]
    """
    config, report_progress = config or RegistrationConfig(), progress or (lambda done, total: None)
    # check the inputs; describe every point by position, normal and path lengths to landmarks
    inputs = prepare_problem(template, scan, landmarks, correspondences)
    begin = initial_transform(inputs) if start is None else _check_start(template, start)
    # bring the template near the scan, from stiff to soft; then fit the surface to the noise
    def fit_softly() -> Fit:
        fit = register_graph(inputs, begin, config, lambda done, total: report_progress(90 * done // total, 100))
        return snap_to_surface(inputs, fit, config)

    if begin.shape != (4, 4) and covers(template.with_vertices(begin), scan, inputs.size):
        fit = choose_fit_that_stays(inputs, begin, scan, [
            fit_softly, lambda: snap_to_surface(inputs, Fit(begin), config),
            lambda: Fit(without_inverted(inputs.template, begin))])
    else:
        fit = fit_softly()
    report_progress(100, 100)
    return measure_fit(inputs, fit, scan)


def covers(body: Mesh, scan: Mesh | np.ndarray, size: float) -> bool:
    """Tell whether a body already lies on a scan.

    At most 10% of the scan is farther off than 0.01 of the `size`: 0.0% of naked people, 3 to 8% of long hair, 14 to
    28% of skirts.
    """
    return share_uncovered(scan, body, 0.01 * size) <= 0.1


def _check_start(template: Mesh, start: np.ndarray) -> np.ndarray:
    """Check an initial transform (4, 4) or vertices (N, 3); ValueError for anything else."""
    array = np.asarray(start, dtype=np.float64)
    if array.shape not in ((4, 4), template.vertices.shape) or not np.isfinite(array).all():
        raise ValueError(f"start: expected a finite transform (4, 4) or vertices {template.vertices.shape}, "
                         f"got {array.shape}")
    return array


def snap_to_surface(inputs: RegistrationProblem, fit: Fit, config: RegistrationConfig) -> Fit:
    """Fit the surface to the scan down to its noise, and repair inverted triangles."""
    if config.final_fit:
        final = final_fit(inputs.template, fit.x, inputs.target, inputs.landmarks, config.noise_width)
        fit = Fit(final.vertices, {**fit.energies, "strain": final.strain}, fit.iterations + final.iterations,
                  final.moved)
    return replace(fit, x=without_inverted(inputs.template, fit.x))


def choose_fit_that_stays(inputs: RegistrationProblem, start: np.ndarray, scan: Mesh | np.ndarray,
                          ways: Sequence[Callable[[], Fit]]) -> Fit:
    """Return the first fit that is as whole as its start, vertices (N, 3) on the scan; else the last.

    It leaves nothing that the start covers: graphs, whose nodes are wider than fingers, made hands 15 to 28 mm worse,
    and fingers beside a thigh were drawn to it. 0.0005 of the surface are the tips of two fingers; a hand that ended
    20 mm off left 0.0007. And it fuses nothing: a finger that the scan lacks slides into its neighbour, 20 to 30 mm
    off, with 0.0012 to 0.007 of the surface double. Real poses and men have 0.0002 at most.
    """
    def measure(x: np.ndarray) -> np.ndarray:
        body = inputs.template.with_vertices(x)
        return np.array([share_uncovered(scan, body, 0.01 * inputs.size), share_doubled(inputs.template, body)])

    before = measure(start)
    for way in ways:
        fit = way()
        if (measure(fit.x) <= before + 0.0005).all():
            break
    return fit


def registration_problem(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, marked: bool) -> str | None:
    """Explain why a registration is meaningless, with the likely cause; None where it is not.

    `marked` says whether landmarks were used.
    """
    points = scan.vertices if isinstance(scan, Mesh) else scan
    far, seen, stretch = fit.uncovered, fit.measured, share_stretched(template, fit.mesh)
    off = fit.landmark_rms > HAND * size(template)
    # Both uncovered and stretched above 0.05: with left and right exchanged they are 0.13 and 0.10.
    # Less than 0.2 with data: most of the template is extrapolated. Shins and feet give 0.15, one view 0.26 to 0.46,
    # half a body 0.49.
    # Uncovered above 0.7 of the share with data: a well covered template may stand beside furniture or a second person.
    # Two people have 0.42 uncovered and 0.87 with data, a cylinder 0.32 and 0.28.
    if not (far > min(0.5, 0.7 * seen) or seen < 0.2 or min(far, stretch) > 0.05 or off):
        return None
    # the likeliest cause: wrong units, a partial scan, wrong landmarks, or something else
    cause = unit_problem(extent(points), extent(template.vertices), "the scan is", 0.05) or (
        "a part of the body only, which scape complete makes whole?" if far < 0.05 and not off else
        "landmarks of left and right exchanged, or of other places?" if marked and seen >= 0.01 else
        "a scan of something else, or too few points?" if marked else
        "a scan of something else, its up axis to be named (--up), or a pose far from the template's, which needs "
        "landmarks?")
    marks = f", its landmarks are {1000 * fit.landmark_rms:.0f} mm off" if marked else ""
    return (f"{100 * far:.0f}% of the scan lies off the template, {100 * seen:.2g}% of the template has data, "
            f"{100 * stretch:.0f}% of it is stretched or shrunk to the double or half{marks}; {cause}")


def measure_fit(inputs: RegistrationProblem, fit: Fit, scan: Mesh | np.ndarray) -> Registration:
    """Measure a fit against the whole scan, and return it with its quality figures."""
    body, size = inputs.template.with_vertices(fit.x), inputs.size
    # data within 1.5% of the size count, 2 cm on a man
    confidence, distances = evidence(body, inputs.target, 0.015 * size, NORMALS * size)
    seen = confidence >= 0.5
    landmark_rms = np.nan
    if inputs.landmarks is not None:
        apart = np.linalg.norm(fit.x[inputs.landmarks[0]] - inputs.landmarks[1], axis=1)
        landmark_rms = float(np.sqrt(np.mean(apart**2)))
    return Registration(
        mesh=body, distances=np.where(seen, distances, np.nan), seen=seen,
        rms=float(np.sqrt(body.vertex_areas[seen] @ distances[seen]**2 / body.vertex_areas[seen].sum()))
        if seen.any() else np.nan, landmark_rms=landmark_rms,
        converged=bool(fit.moved <= 0.001 * size and seen.any()), iterations=fit.iterations, energies=fit.energies,
        inverted=int(find_inverted_triangles(inputs.template, fit.x).sum()), confidence=confidence,
        uncovered=share_uncovered(scan, body, 0.01 * size))


def evidence(deformed: Mesh, target: Target, reach: float, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Weigh the data near every vertex of a registered template: the confidence in them and their distances (N,).

    The confidence goes from 0, no data here, to 1: a scanned surface lies here, faces the same way and does not end
    here, and its points match this part of the template too. Distances, metres, are to the tangent plane at the nearest
    point that faces the same way; NaN where that is too far. Points beyond `reach` (metres) count for nothing. A unit
    difference of normals counts like a distance of `scale` metres.
    """
    def ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
        return np.clip((value - low) / (high - low), 0, 1)

    target = orient_by_mesh(target, deformed, scale)
    x, normals = deformed.vertices, deformed.vertex_normals
    forth = OrientedPoints(target.points, target.normals, scale).match(x, normals, reach)
    back = OrientedPoints(x, normals, scale).match(target.points, target.normals, reach)
    v = np.flatnonzero(forth.valid)
    p = forth.index[v]
    # near the surface: full weight within twice the noise, a robust standard deviation from the median
    off = np.abs(np.einsum("nd,nd->n", target.normals[p], x[v] - target.points[p]))
    noise = 1.4826 * float(np.median(off)) if len(v) else 0.0
    near = np.exp(-0.5 * (np.maximum(off - 2 * noise, 0) / max(2 * noise, 0.05 * reach)) ** 2)
    # facing the same way: none from 60 degrees on, full within 37
    facing = ramp(np.einsum("nd,nd->n", target.normals[p], normals[v]), 0.5, 0.8)
    # matched from the scan too: this vertex, or at least 0.1 to 0.4 of its neighbours, is the match of some point
    hits = (np.bincount(back.index[back.valid], minlength=len(x)) > 0).astype(float)
    A = deformed.vertex_adjacency
    degree = np.maximum(np.asarray(A.sum(axis=1)).ravel(), 1)
    chosen = ramp(np.maximum(hits, (A @ hits) / degree), 0.1, 0.4)
    # inside the scan: points that face the same way are as near as points are to each other, and few of them are on the
    # border of a hole; never less than the median spacing, as overlapping views are dense
    tree = cKDTree(target.points)
    apart, around = tree.query(x, min(8, len(target.points)))
    nearest = tree.query(target.points, 2)[0][:, 1]
    spacing = np.maximum(np.median(nearest), nearest[around].mean(axis=1))
    alike = np.einsum("nkd,nd->nk", target.normals[around], normals) > 0.3
    nearest = np.where(alike, apart, np.inf).min(axis=1)
    edge = (alike * target.border[around]).sum(axis=1) / np.maximum(alike.sum(axis=1), 1)
    inside = np.exp(-0.5 * (np.maximum(nearest - 2 * spacing, 0) / (2 * spacing)) ** 2) * (1 - ramp(edge, 0.3, 0.9))
    confidence, distances = np.zeros(len(x)), np.full(len(x), np.nan)
    confidence[v], distances[v] = near * facing * (inside * chosen)[v], off
    return confidence, distances


def share_uncovered(scan: Mesh | np.ndarray, registered: Mesh, far: float) -> float:
    """Compute the share of a scanned surface that lies further than `far` (metres) from a mesh."""
    points = scan.vertices if isinstance(scan, Mesh) else scan
    every = slice(None, None, max(1, len(points) // 5000))
    off = Surface(registered).closest(points[every]).distances > far
    return float(np.average(off, weights=point_areas(scan)[every]))


def share_doubled(template: Mesh, registered: Mesh) -> float:
    """Compute the share of the surface that lies on another part of itself and faces the same way, as fused fingers do.

    Parts that touch face each other. Within 4 mm on a man, and at least 17 mm apart on the template.
    """
    pairs = cKDTree(registered.vertices).query_pairs(0.003 * size(template), output_type="ndarray")

    def apart(body: Mesh) -> np.ndarray:
        return np.linalg.norm(body.vertices[pairs[:, 0]] - body.vertices[pairs[:, 1]], axis=1)

    alike = np.einsum("pd,pd->p", *registered.vertex_normals[pairs.T]) > 0.5
    elsewhere = apart(template) > np.maximum(0.012 * size(template), 4 * apart(registered))
    return template.share_of_area(np.isin(np.arange(len(template.vertices)), pairs[alike & elsewhere]))


def share_stretched(template: Mesh, registered: Mesh) -> float:
    """Compute the share of the area that is twice or half as long in some direction as the median stretch.

    So a smaller or slimmer person is nowhere stretched: one correct registration had 0.058 half as long as on the
    template, but only 0.007 half as long as its median.
    """
    long, short = principal_stretches(template, registered)
    usual = float(np.median(np.concatenate([long, short])))
    stretched = (long > 2 * usual) | (short < usual / 2)
    return float(template.face_areas @ stretched / template.face_areas.sum())


def principal_stretches(template: Mesh, registered: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Compute the largest and the smallest stretch (F,) of every triangle: singular values of its deformation."""
    rest, now = (m.corners[:, 1:] - m.corners[:, :1] for m in (template, registered))
    # edges of the template in an orthonormal basis of its triangle, as a lower triangular matrix
    gram = np.einsum("fid,fjd->fij", rest, rest)
    basis = np.linalg.inv(np.linalg.cholesky(gram + 1e-18 * np.eye(2)))
    metric = np.einsum("fij,fjd,fkd,flk->fil", basis, now, now, basis)
    squared = np.linalg.eigvalsh(metric)
    return np.sqrt(np.maximum(squared[:, 1], 0)), np.sqrt(np.maximum(squared[:, 0], 0))
