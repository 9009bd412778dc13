"""Non-rigid registration of a template to a scan, from stiff to soft.

1. The template is placed by the lengths of paths to its landmarks, whatever its pose.
2. A graph of nodes that rotate and grow is drawn to the scan by matches in both directions, in stages of falling
   stiffness and rising detail; rotations are unknowns, so limbs keep their volume where there are no data.
3. The surface follows the scan below its noise, evenly stretched and without inverted triangles.

[Hahnel], [Allen], [Amberg]
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from typing import Any, Protocol, TypeVar, cast

import numpy as np
from scipy.spatial import cKDTree

from ..correspondence.correspondences import Correspondences
from ..geometry.mesh import Mesh
from ..geometry.surface import OrientedPoints, Surface, check_points
from ..geometry.target import Target, orient_by_mesh
from ..judgement import HAND, extent, size, unit_problem
from ..threads import one_thread
from .final_fit import final_fit
from .folds import find_inverted_triangles, without_inverted
from .graph_fit import register_graph
from .matches import NORMALS, Fit, RegistrationProblem, initial_transform, prepare_problem
from .schedule import RegistrationConfig


@dataclass(frozen=True, eq=False)
class Registration:
    """The template on the scan.

    `uncovered` is the share of the scan's points off the template, by more than a hundredth of its size (the root of
    its area). More than half a per cent is a limb in the wrong place, or clutter; `converged` does not tell.
    """

    mesh: Mesh                   # the template's triangles on their new vertices
    distances: np.ndarray        # (N,) metres, from each vertex that was seen to the surface of the scan, else NaN
    seen: np.ndarray             # (N,) bool: there were data here, the confidence is at least one half
    rms: float                   # metres, of the distances of the vertices seen
    landmark_rms: float          # metres; NaN without landmarks
    converged: bool              # never without data
    iterations: int              # steps over all stages
    energies: dict[str, float]   # each term at the end of the coarse registration, and of the data at the very end
    inverted: int                # triangles that face against their surroundings
    confidence: np.ndarray       # (N,) from 0, made up from the surroundings, to 1: data here, from both directions
    uncovered: float
    rolled: bool = False         # limbs were rolled otherwise than they were found first: see `repair_limbs`
    soles: tuple[float, float] | None = None    # metres beyond the floor where the scan ends: see `with_soles`


@dataclass(frozen=True, eq=False)
class LedRegistration:
    """A registration without landmarks, or with few, and what led it: see `register_by_any`."""

    fit: Registration
    way: str                                    # what led it, in words: "model people", "160 correspondences"
    rival: LedRegistration | None = None        # another body on the scan that leaves hardly more to doubt


class Method(Protocol):
    """A way to bring a template near a scan, of which `METHODS` holds those that can be chosen by name.

    It takes the inputs, the rigid transform (4, 4) or the vertices (N, 3) to begin with, the settings and a callback
    for (done, total), and says where the template came to lie. The checks before, the last pass and the figures after
    are the same for all.
    """

    def __call__(self, inputs: RegistrationProblem, start: np.ndarray, config: RegistrationConfig,
                 progress: Callable[[int, int], None]) -> Fit: ...


METHODS: dict[str, Method] = {"graph": register_graph}


def translate(what: Any, by: np.ndarray) -> Any:
    """What registrations are made of, or one itself, at another place, `by` (3,) metres away; all else stays.

    A mesh, points (n, 3), a transform (4, 4), correspondences, and tuples of these, as landmarks are.
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
    moved[:3, 3:] += by[:, None]                          # of a transform
    return moved if moved.shape == (4, 4) else moved + by


F = TypeVar("F", bound=Callable[..., Any])


def near_origin(method: F) -> F:
    """The same function of template and scan, where a scan is so far from the origin that sums lose digits, as in UTM.

    Everything but the template is brought near, and what comes out is brought back.
    """
    @wraps(method)
    def wrapper(template: Mesh, scan: Mesh | np.ndarray, *args: Any, **named: Any) -> Any:
        points = check_points(scan.vertices if isinstance(scan, Mesh) else scan, "scan")
        middle = (points.min(axis=0) + points.max(axis=0)) / 2 if len(points) else np.zeros(3)
        # within 100 m nothing changes: at 3 m a registration is the same to 1e-14 m, at 5,000 km it was 15 mm off
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
    """Bring a template onto a scan.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        May have holes, borders, several overlapping sheets, noise.
    landmarks : (L,) int and (L, 3) float, metres, optional
        Vertices of the template and where they are on the scan. Needed wherever the pose differs much.
    progress : callable, optional
        Called as progress(done, total).
    correspondences : Correspondences, optional
        Hints, some of which may be wrong: they draw softly, and less the farther they are from all others.
    start : (4, 4) or (N, 3) float, optional
        The similarity that brings the template near the scan, where it is known: else landmarks tell, or the whole is
        aligned, which a scan of a part leads astray. Or where its vertices are nearly, metres, as a model finds them:
        then only the last stages are needed, which match by place.

    Returns
    -------
    Registration

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite, fewer than
        three landmarks or landmarks that do not exist, a method that is not known.
    """
    config, tell = config or RegistrationConfig(), progress or (lambda done, total: None)
    if config.method not in METHODS:
        raise ValueError(f"method: expected one of {', '.join(METHODS)}, got {config.method!r}")
    # what is known of both, and how every point is told from others: by place, normal, and paths to landmarks
    inputs = prepare_problem(template, scan, landmarks, correspondences)
    begin = initial_transform(inputs) if start is None else _check_start(template, start)
    # near the scan, from stiff to soft; then onto it, below its noise
    fit = METHODS[config.method](inputs, begin, config, lambda done, total: tell(90 * done // total, 100))
    fit = snap_to_surface(inputs, fit, config)
    tell(100, 100)
    return measure_fit(inputs, fit, scan)


def _check_start(template: Mesh, start: np.ndarray) -> np.ndarray:
    """A transform (4, 4) or vertices (N, 3) to begin with; ValueError for anything else."""
    found = np.asarray(start, dtype=np.float64)
    if found.shape not in ((4, 4), template.vertices.shape) or not np.isfinite(found).all():
        raise ValueError(f"start: expected a finite transform (4, 4) or vertices {template.vertices.shape}, "
                         f"got {found.shape}")
    return found


def snap_to_surface(inputs: RegistrationProblem, fit: Fit, config: RegistrationConfig) -> Fit:
    """The surface at last: laid on the scan below its noise, without inverted triangles."""
    if config.final_fit is not None:
        final = final_fit(inputs.template, fit.x, inputs.target, inputs.landmarks, config.final_fit)
        fit = Fit(final.vertices, {**fit.energies, "strain": final.strain}, fit.iterations + final.iterations,
                  final.moved)
    return replace(fit, x=without_inverted(inputs.template, fit.x))


def registration_problem(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, marked: bool) -> str | None:
    """Why a registration means nothing, with the likely cause; None where it means something.

    `marked` is whether landmarks led it.
    """
    points = scan.vertices if isinstance(scan, Mesh) else scan
    far, seen, stretch = fit.uncovered, float(fit.seen.mean()), share_stretched(template, fit.mesh)
    off = fit.landmark_rms > HAND * size(template)
    # with left and right exchanged 0.13 are not covered and 0.10 stretched. A part alone, with which the rest of the
    # template is only invented: shins and feet give 0.15 of it data, one half 0.49, one view 0.26 to 0.46. The more of
    # the template has data, the more of a scan may be furniture or a second person, to be looked at: of two people
    # 0.42 are not covered and 0.87 have data, of a cylinder 0.32 and 0.28.
    if not (far > min(0.5, 0.7 * seen) or seen < 0.2 or min(far, stretch) > 0.05 or off):
        return None
    cause = unit_problem(extent(points), extent(template.vertices), "the scan is", 0.05) or (
        "a part of the body only, which scape complete makes whole?" if far < 0.05 and not off else
        "landmarks of left and right exchanged, or of other places?" if marked and seen >= 0.01 else
        "a scan of something else, or too few points?" if marked else
        "a scan of something else, or a pose far from the template's, which needs landmarks?")
    marks = f", its landmarks are {1000 * fit.landmark_rms:.0f} mm off" if marked else ""
    return (f"{100 * far:.0f}% of the scan lies off the template, {100 * seen:.2g}% of the template has data, "
            f"{100 * stretch:.0f}% of it is stretched or shrunk to the double or half{marks}; {cause}")


def measure_fit(inputs: RegistrationProblem, fit: Fit, scan: Mesh | np.ndarray) -> Registration:
    """What was found, measured against the whole scan."""
    body, size = inputs.template.with_vertices(fit.x), inputs.size
    found = evidence(body, inputs.target, 0.015 * size, NORMALS * size)
    seen = found.confidence >= 0.5
    landmark_rms = np.nan
    if inputs.landmarks is not None:
        apart = np.linalg.norm(fit.x[inputs.landmarks[0]] - inputs.landmarks[1], axis=1)
        landmark_rms = float(np.sqrt(np.mean(apart**2)))
    return Registration(
        mesh=body, distances=np.where(seen, found.distances, np.nan), seen=seen,
        rms=float(np.sqrt(np.mean(found.distances[seen] ** 2))) if seen.any() else np.nan, landmark_rms=landmark_rms,
        converged=bool(fit.moved <= 0.001 * size and seen.any()), iterations=fit.iterations, energies=fit.energies,
        inverted=int(find_inverted_triangles(inputs.template, fit.x).sum()), confidence=found.confidence,
        uncovered=share_uncovered(scan, body, 0.01 * size))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the scan says of every vertex of a template that lies on it.

    The confidence (N,) goes from 0, no data here, to 1: a scanned surface lies here, faces the same way, does not end
    here, and its points find this part of the template too. Distances (N,), metres, are to the plane of the scan at the
    nearest point that faces the same way; NaN where that is too far.
    """

    confidence: np.ndarray
    distances: np.ndarray


def evidence(deformed: Mesh, target: Target, reach: float, scale: float) -> Evidence:
    """The data near every vertex of the template on the scan, weighed; farther away than `reach` (metres) are none.

    A difference of normals of one counts like a distance of `scale` metres.
    """
    def ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
        return np.clip((value - low) / (high - low), 0, 1)

    target = orient_by_mesh(target, deformed, scale)
    x, normals = deformed.vertices, deformed.vertex_normals
    found = OrientedPoints(target.points, target.normals, scale).match(x, normals, reach)
    back = OrientedPoints(x, normals, scale).match(target.points, target.normals, reach)
    v = np.flatnonzero(found.valid)
    p = found.index[v]
    off = np.abs(np.einsum("nd,nd->n", target.normals[p], x[v] - target.points[p]))
    noise = 1.4826 * float(np.median(off)) if len(v) else 0.0
    near = np.exp(-0.5 * (np.maximum(off - 2 * noise, 0) / max(2 * noise, 0.05 * reach)) ** 2)
    facing = ramp(np.einsum("nd,nd->n", target.normals[p], normals[v]), 0.5, 0.8)
    # the scan's points chose this vertex, or its neighbours, as theirs
    hits = (np.bincount(back.index[back.valid], minlength=len(x)) > 0).astype(float)
    A = deformed.vertex_adjacency
    degree = np.maximum(np.asarray(A.sum(axis=1)).ravel(), 1)
    chosen = ramp(np.maximum(hits, (A @ hits) / degree), 0.1, 0.4)
    # Points that face the same way lie close by, and not at the edge of a hole. Close by is what the points around
    # are to each other, but no less than usual: where views overlap they are dense.
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
    return Evidence(confidence, distances)


def share_uncovered(scan: Mesh | np.ndarray, registered: Mesh, far: float, samples: int = 5000) -> float:
    """Share of the points of a scan that lie further than `far` (metres) from a mesh."""
    points = scan.vertices if isinstance(scan, Mesh) else scan
    points = points[:: max(1, len(points) // samples)]
    return float((Surface(registered).closest(points).distances > far).mean())


def share_stretched(template: Mesh, registered: Mesh, factor: float = 2.0) -> float:
    """Share of the template's area that is longer by `factor`, or shorter, in some direction than most of the body is.

    Somebody smaller or slimmer than the template is nowhere stretched: one right registration had 0.058 that were half
    as long as on the template, 0.007 that were half as long as usual in it.
    """
    long, short = principal_stretches(template, registered)
    usual = float(np.median(np.concatenate([long, short])))
    stretched = (long > factor * usual) | (short < usual / factor)
    return float(template.face_areas @ stretched / template.face_areas.sum())


def principal_stretches(template: Mesh, registered: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """The largest and the smallest stretch (F,) of every triangle."""
    rest, now = (m.corners[:, 1:] - m.corners[:, :1] for m in (template, registered))
    # edges of the template in an orthonormal basis of its triangle, as a lower triangular matrix
    gram = np.einsum("fid,fjd->fij", rest, rest)
    basis = np.linalg.inv(np.linalg.cholesky(gram + 1e-18 * np.eye(2)))
    metric = np.einsum("fij,fjd,fkd,flk->fil", basis, now, now, basis)
    squared = np.linalg.eigvalsh(metric)
    return np.sqrt(np.maximum(squared[:, 1], 0)), np.sqrt(np.maximum(squared[:, 0], 0))
