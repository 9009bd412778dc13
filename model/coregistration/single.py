"""One scan registered with a model as prior."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanprep.correspondence.correspondences import check_pairs
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.geometry.surface import Surface
from scanprep.geometry.target import Target, orient_by_mesh, target_of
from scanprep.registration.nonrigid import register
from scanprep.threads import one_thread
from scanprep.words import describe_result

from ..body import BodyModel
from ..features import twists
from ..fitting.bodies import FixedBody, as_body
from ..fitting.limbs import find_misplaced_limbs, reinitialise_limbs, with_limbs
from ..fitting.rounds import meet_vertices, solve_jointly
from ..fitting.scan_fit import ScanFit, prepare_scan_fit
from ..fitting.starts import best_starts, first_starts
from ..linear import Subject
from .config import CoregistrationConfig

Landmarks = tuple[np.ndarray, np.ndarray]
EXPLAINED = 0.006                    # share of √area: scan points nearer to the mesh that face alike are explained
# another start is better only below this share of the misfit of a given start that explains its scan. On crabs, bodies
# turned the wrong way had 1.0 to 1.6 times the misfit of the right ones.
CLEARLY = 0.8


@dataclass(frozen=True, eq=False)
class ModelRegistration:
    """Result of `register_with_model`: the template on a scan, and the fitted model.

    Attributes
    ----------
    mesh : Mesh
        The registered template. It follows the scan where there are data; elsewhere, and along the surface, it follows
        the model.
    predicted : Mesh
        The mesh of the fitted model.
    pose : (J, 3) float, radians
        Pose of the fitted model.
    trans : (3,) float, metres
        Place of the fitted model.
    betas : (K,) float or None
        Shape coefficients; None for a body of known shape.
    seen : (N,) bool
        Vertices with data.
    distances : (N,) float, metres
        From each seen vertex to the surface of the scan; NaN for the others.
    rms : float, metres
        Root mean square of these distances.
    explained : float
        Share of the scan's points that are near the mesh.
    apart : float, metres
        RMS distance of mesh and prediction where there were data; a large value means a wrong pose.
    landmark_rms : float, metres
        RMS distance of the landmarks from their vertices.
    inverted : int
        Number of inverted triangles.
    confidence : (N,) float
        From 0, predicted by the model, to 1, measured.
    starts : int
        Number of starts that were tried.

    Examples
    --------
    >>> from dataclasses import fields
    >>> [field.name for field in fields(ModelRegistration)][:3]
    ['mesh', 'predicted', 'pose']

    [BlendSCAPE]
    """

    mesh: Mesh
    predicted: Mesh
    pose: np.ndarray
    trans: np.ndarray
    betas: np.ndarray | None
    seen: np.ndarray
    distances: np.ndarray
    rms: float
    explained: float
    apart: float
    landmark_rms: float
    inverted: int
    confidence: np.ndarray
    starts: int
    __repr__ = describe_result


@take_any_mesh
@one_thread()
def register_with_model(body: BodyModel | Subject, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                        start: np.ndarray | None = None, config: CoregistrationConfig | None = None,
                        progress: Callable[[int, int], None] | None = None) -> ModelRegistration:
    """Register the template to a scan with a model of it as prior.

    1. Pose, place and betas are fitted as in scan completion: from several starts, with limbs re-initialised.
    2. The predicted mesh is registered to the scan. It follows the scan where there are data; elsewhere, and along the
       surface, it keeps the predicted shape.
    3. Pose and betas are fitted to the registered vertices that have data.

    Parameters
    ----------
    body : BodyModel or Subject
        A model where the person's shape is unknown, a subject where it is known.
    scan : Mesh or (n, 3) float, metres
        The scan, or bare points.
    landmarks : (L,) int and (L, 3) float, metres, optional
        Vertices of the template and where they are on the scan.
    start : (N, 3) float, metres, or (J, 3) float, radians, optional
        An earlier registration, right or wrong, or a pose. Other starts are tried where it does not explain the scan.
    config : CoregistrationConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    ModelRegistration
        The registered mesh, the fitted model, and how well they explain the scan.

    Raises
    ------
    ValueError
        A scan, landmarks or a start that cannot be used.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> subject = load_built_in_model().subject(None)
    >>> try:
    ...     register_with_model(subject, subject.template, start=np.zeros((3, 3)))
    ... except ValueError as error:
    ...     print(error)
    start: expected finite vertices (5002, 3) or a pose (16, 3), got (3, 3)

    [BlendSCAPE]
    """
    config = config or CoregistrationConfig()
    report_progress = progress or (lambda done, total: None)
    marks: Landmarks = landmarks or (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    vertices, points = check_pairs(body.template, *marks, "landmarks", 0)
    target = target_of(scan)
    size, person = float(np.sqrt(body.template.face_areas.sum())), as_body(body)
    fit, factor = prepare_scan_fit(person, scan, vertices, points, config.fit)
    # 1. pose, place and betas by matches alone
    x, tried = _pose_and_shape(fit, None if start is None else _unknowns_of_start(fit, start, factor))
    report_progress(1, 2)
    # 2. the template as the model predicts it is aligned with the scan
    aligned = register(_predict_own_mesh(person, fit, x), scan, None, config.registration)
    # 3. pose and betas from where there are data
    x = meet_vertices(fit, x, factor * aligned.mesh.vertices, aligned.confidence)
    report_progress(2, 2)
    predicted, mesh, seen = _predict_own_mesh(person, fit, x), aligned.mesh, aligned.seen
    pose, trans, betas = person.split(fit.body.in_metres(x)[0])
    off_model = np.linalg.norm(mesh.vertices - predicted.vertices, axis=1)[seen]
    off_marks = np.linalg.norm(mesh.vertices[vertices] - points, axis=1)
    limit = EXPLAINED * size
    explained = float((apart(mesh, orient_by_mesh(target.thin(0.01 * size), mesh, limit), limit) < limit).mean())
    return ModelRegistration(mesh, predicted, twists(pose), trans, betas if person.n_betas else None, seen,
                             aligned.distances, aligned.rms, explained, _rms(off_model), _rms(off_marks),
                             aligned.inverted, aligned.confidence, tried)


def _pose_and_shape(fit: ScanFit, given: np.ndarray | None) -> tuple[np.ndarray, int]:
    """Find the best unknowns (P,) for a scan; also return how many starts were tried.

    A given start (1, P) is tried first; the others only if it does not explain the scan.
    """
    coarse, tried, best = fit.few(), 0, None
    if given is not None:
        best, tried = reinitialise_limbs(coarse, best_starts(coarse, given)[0]), 1
    # a given start that explains 98% of the scan and has no misplaced limb is enough
    explains = best is not None and coarse.find_unexplained(best, coarse.thin).mean() <= 1 - 0.98
    if best is None or not explains or find_misplaced_limbs(coarse, best):
        starts = first_starts(fit, coarse)
        tried += len(starts)
        other = with_limbs(fit, coarse, best_starts(coarse, starts))[0]
        # a body turned the wrong way may explain a scan about as well, so the given start is preferred
        least = np.inf if best is None else (CLEARLY if explains else 1.0) * coarse.misfit(best)
        best = other if best is None or coarse.misfit(other) < least else best
    return solve_jointly(fit, coarse, best, lambda done: None).x, tried


def _unknowns_of_start(fit: ScanFit, start: np.ndarray, factor: float) -> np.ndarray:
    """Compute the unknowns (1, P) of a start that is given as vertices of the template or as a pose."""
    start, body = np.asarray(start, dtype=np.float64), fit.body
    shapes = body.template.vertices.shape, body.pose_mean.shape
    if start.shape not in shapes or not np.isfinite(start).all():
        raise ValueError(f"start: expected finite vertices {shapes[0]} or a pose {shapes[1]}, got {start.shape}")
    # rotations of the parts by Procrustes, or the pose itself; placed at the centroid of what is known
    registered = start.shape == shapes[0]
    onto = factor * start if registered else fit.cloud.points
    pose = body.skeleton.pose_of(body.skeleton.fit_rotations(body.template, onto)) if registered else start
    x = body.join(pose, np.zeros(3))
    x[body.n_angles:body.n_angles + 3] = onto.mean(axis=0) - body.vertices(x).mean(axis=0)
    return (meet_vertices(fit, x, onto, np.ones(len(onto))) if registered else x)[None]


def _predict_own_mesh(person: FixedBody, fit: ScanFit, x: np.ndarray) -> Mesh:
    """Compute the person's mesh, in metres, for unknowns (P,) of a fit that may use another size."""
    return person.template.with_vertices(person.vertices(fit.body.in_metres(x)[0]))


def apart(mesh: Mesh, target: Target, limit: float) -> np.ndarray:
    """Compute distances (n,) of scan points to the nearest point of a mesh, metres, at most `limit`.

    Points whose normal opposes that of the mesh get `limit`.
    """
    found = Surface(mesh).closest(target.points)
    facing = np.einsum("nd,nd->n", mesh.face_normals[found.faces], target.normals) > 0
    return np.where(facing, np.minimum(found.distances, limit), limit)


def _rms(distances: np.ndarray) -> float:
    return float(np.sqrt((distances**2).mean())) if len(distances) else np.nan
