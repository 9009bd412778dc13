"""One scan registered with a model as prior."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanprep.correspondence.correspondences import check_pairs
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.geometry.target import Target, orient_by_mesh, target_of
from scanprep.registration.nonrigid import register
from scanprep.threads import one_thread

from ..body import BodyModel
from ..features import twists
from ..fitting.bodies import FixedBody, as_body
from ..fitting.limbs import misplaced_limbs, reinitialise_limbs, with_limbs
from ..fitting.rounds import meet_vertices, solve_jointly
from ..fitting.scan_fit import ScanFit, prepare_scan_fit
from ..fitting.starts import best_starts, first_starts
from ..linear import Subject
from .config import CoregistrationConfig

Landmarks = tuple[np.ndarray, np.ndarray]
EXPLAINED = 0.006                    # share of √area: scan points so near to the mesh, facing alike, are explained
# of the misfit of a start that explains its scan, below which another is better: of a crab, a body that lay the other
# way round had 1.0 to 1.6 times the misfit of the right one
CLEARLY = 0.8


@dataclass(frozen=True, eq=False)
class ModelRegistration:
    """The template on a scan, and the model that led it there.

    Attributes
    ----------
    mesh : Mesh
        Follows the scan where there are data, the model along the surface and where there are none.
    predicted : Mesh
        The model's own mesh.
    pose, trans, betas : (J, 3), (3,) and (K,) float
        No betas for a body of known shape.
    seen : (N,) bool
        Whether there were data here.
    distances : (N,) float, metres
        From each vertex that was seen to the surface of the scan; NaN for the others.
    rms, landmark_rms : float, metres
        Of these distances, and of those of the landmarks.
    explained : float
        Share of the scan's points that the mesh explains.
    apart : float, metres
        Root mean square distance of mesh and prediction where there were data; much of it tells of a wrong pose.
    inverted : int
        Triangles that face against their surroundings.
    confidence : (N,) float
        From 0, made up by the model, to 1: there were data here.
    starts : int
        How many starts were tried.
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


@one_thread()
def register_with_model(body: BodyModel | Subject, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                        start: np.ndarray | None = None, config: CoregistrationConfig | None = None,
                        progress: Callable[[int, int], None] | None = None) -> ModelRegistration:
    """Bring the template onto a scan with a model of it as prior.

    1. Pose, place and betas are sought as in a partial scan: from several starts, with limbs tried elsewhere.
    2. The template as the model predicts it is aligned with the scan, which it follows where there are data; along
       the surface and elsewhere it keeps the predicted shape.
    3. Pose and betas are taken from where the alignment has data.

    Parameters
    ----------
    body : BodyModel or Subject
        A model where the person's shape is unknown, a subject where it is known.
    scan : Mesh or (n, 3) float, metres
    landmarks : (L,) int and (L, 3) float, metres, optional
        Vertices of the template and where they are on the scan.
    start : (N, 3) float, metres, or (J, 3) float, radians, optional
        An earlier registration, right or wrong, or a pose; others are sought where it does not explain the scan.
    config : CoregistrationConfig, optional
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    ValueError
        A scan, landmarks or a start that cannot be used.

    [BlendSCAPE]
    """
    config = config or CoregistrationConfig()
    tell = progress or (lambda done, total: None)
    given: Landmarks = landmarks or (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    vertices, points = check_pairs(body.template, *given, "landmarks", 0)
    target = target_of(scan)
    size, person = float(np.sqrt(body.template.face_areas.sum())), as_body(body)
    fit, factor = prepare_scan_fit(person, scan, vertices, points, config.fit)
    # 1. pose, place and betas by matches alone
    x, tried = _pose_and_shape(fit, None if start is None else _unknowns_of_start(fit, start, factor))
    tell(1, 2)
    # 2. the template as the model predicts it is aligned with the scan
    aligned = register(_predict_own_mesh(person, fit, x), scan, None, config.registration)
    # 3. pose and betas from where there are data
    x = meet_vertices(fit, x, factor * aligned.mesh.vertices, aligned.confidence)
    tell(2, 2)
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
    """The best unknowns (P,) for a scan, and how many starts were tried: those given (1, P) first, all if need be."""
    few, tried, best = fit.few(), 0, None
    if given is not None:
        best, tried = reinitialise_limbs(few, best_starts(few, given)[0]), 1
    # share of a scan that a start must explain for no other to be sought
    explains = best is not None and few.find_unexplained(best, few.thin).mean() <= 1 - 0.98
    if best is None or not explains or misplaced_limbs(few, best):
        starts = first_starts(fit, few)
        tried += len(starts)
        other = with_limbs(fit, few, best_starts(few, starts))[0]
        # a body that lies the other way round may explain a scan about as well: what was known decides
        least = np.inf if best is None else (CLEARLY if explains else 1.0) * few.misfit(best)
        best = other if best is None or few.misfit(other) < least else best
    return solve_jointly(fit, few, best, lambda done: None).x, tried


def _unknowns_of_start(fit: ScanFit, start: np.ndarray, factor: float) -> np.ndarray:
    """Unknowns (1, P) of a start given as vertices of the template or as a pose."""
    start, body = np.asarray(start, dtype=np.float64), fit.body
    shapes = body.template.vertices.shape, body.pose_mean.shape
    if start.shape not in shapes or not np.isfinite(start).all():
        raise ValueError(f"start: expected finite vertices {shapes[0]} or a pose {shapes[1]}, got {start.shape}")
    registered = start.shape == shapes[0]
    onto = factor * start if registered else fit.cloud.points
    pose = body.skeleton.pose_of(body.skeleton.fit_rotations(body.template, onto)) if registered else start
    x = body.join(pose, np.zeros(3))
    x[body.n_angles:body.n_angles + 3] = onto.mean(axis=0) - body.vertices(x).mean(axis=0)
    return (meet_vertices(fit, x, onto, np.ones(len(onto))) if registered else x)[None]


def _predict_own_mesh(person: FixedBody, fit: ScanFit, x: np.ndarray) -> Mesh:
    """A person's own mesh, of unknowns (P,) of a fit that may be of another size."""
    return person.template.with_vertices(person.vertices(fit.body.in_metres(x)[0]))


def apart(mesh: Mesh, target: Target, limit: float) -> np.ndarray:
    """Distances (n,) of scan points to the nearest place of a mesh, metres; at most `limit`, which it is where the two
    face away from each other."""
    found = Surface(mesh).closest(target.points)
    facing = np.einsum("nd,nd->n", mesh.face_normals[found.faces], target.normals) > 0
    return np.where(facing, np.minimum(found.distances, limit), limit)


def _rms(distances: np.ndarray) -> float:
    return float(np.sqrt((distances**2).mean())) if len(distances) else np.nan
