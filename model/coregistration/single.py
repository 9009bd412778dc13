"""One scan registered with a model as prior."""
from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.target import target_of
from scanprep.registration.nonrigid import register
from scanprep.threads import one_thread

from ..body import BodyModel
from ..linear import Subject
from .config import EXPLAINED, CoregistrationConfig
from .modelfit import ModelFit

Landmarks = tuple[np.ndarray, np.ndarray]


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
    score, starts : float, metres, and int
        How far scan and model were apart, of the best start, and how many were tried.
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
    score: float
    starts: int


@one_thread()
def register_with_model(body: BodyModel | Subject, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                        start: np.ndarray | None = None, config: CoregistrationConfig | None = None,
                        progress: Callable[[int, int], None] | None = None) -> ModelRegistration:
    """Bring the template onto a scan with a model of it as prior.

    1. Pose, place and betas are sought from several starts by matches alone.
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
        An earlier registration, right or wrong, or a pose; it is tried beside the typical poses.
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
    fit = ModelFit(body, target_of(scan), landmarks, config.fit)
    given = [] if start is None else [_given(fit, start)]
    best, tried = fit.best_of(itertools.chain(given, fit.starts()))
    tell(1, 2)
    aligned = register(fit.predicted(best.x), scan, None, config.registration)
    x = fit.taken_from(aligned.mesh.vertices, aligned.confidence, best.x, config.fit.refine[-1].prior)
    tell(2, 2)
    predicted, (pose, trans, betas) = fit.predicted(x), fit.split(x)
    mesh, seen = aligned.mesh, aligned.seen
    off_model = np.linalg.norm(mesh.vertices - predicted.vertices, axis=1)[seen]
    off_marks = np.linalg.norm(mesh.vertices[fit.marks] - fit.marked, axis=1)
    return ModelRegistration(mesh, predicted, pose, trans, betas, seen, aligned.distances, aligned.rms,
                             fit.explained(mesh, 0.01, EXPLAINED), _rms(off_model), _rms(off_marks),
                             aligned.inverted, aligned.confidence, best.score, tried)


def _rms(distances: np.ndarray) -> float:
    return float(np.sqrt((distances**2).mean())) if len(distances) else np.nan


def _given(fit: ModelFit, start: np.ndarray) -> np.ndarray:
    """Unknowns of a start given as vertices or as a pose."""
    start = np.asarray(start, dtype=np.float64)
    shapes = fit.body.template.vertices.shape, fit.pose_mean.shape
    if start.shape not in shapes or not np.isfinite(start).all():
        raise ValueError(f"start: expected finite vertices {shapes[0]} or a pose {shapes[1]}, got {start.shape}")
    if start.shape == shapes[0]:
        return fit.start_from(start, np.ones(len(start)))
    return fit.placed(start, fit.target.points)
