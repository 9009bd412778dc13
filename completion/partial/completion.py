"""Completion of a partial scan: a start from landmarks, the pose and shape, then the free surface."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry.mesh import Mesh
from scanprep.meaning import HAND, extent, size, unit_problem
from scanprep.threads import one_thread

from ..bodies import as_body
from .alternation import follow_alternating, model_for_turns
from .confidence import distance_to_seen, expected_error, posterior_error, probability_within
from .fit import ScanFit
from .free_surface import free_surface
from .inputs import in_metres
from .reinitialise import best_start, first_starts, redraw_limbs
from .scale import ScaledBody
from .scan import View
from .settings import CompletionConfig

Progress = Callable[[int, int], None]

LOST = 0.5                           # share of a scan explained below which a completion means nothing
ASTRAY, ENOUGH = 0.016, 0.9          # so far landmarks, of the size, and so little explained: left and right exchanged


@dataclass(frozen=True, eq=False)
class Completion:
    """A whole body from a partial scan.

    Attributes
    ----------
    completed : Mesh
        Follows the scan where there are data, the model elsewhere; it may leave the model's space.
    predicted : Mesh
        The model's own mesh.
    pose : (J, 3) float, radians
    betas : (K,) float, or None for the template's own body
    trans : (3,) float, metres
    seen : (N,) bool
        Vertices that had data: they were observed, the others are extrapolated.
    rms : float, metres
        Distance of the scan points that were used to the completed mesh.
    explained : float
        Share of the scan points that were used.
    landmark_rms : float, metres
        Distance of the landmarks to their vertices on the predicted mesh; NaN when there are none.
    converged : bool
    iterations : int
        Rounds of matching.
    energies : dict
        Each term of the energy at the end.
    scale : float
        Metres per unit of the scan: times this it lies on the completed mesh.
    expected_error : (N,) float, metres
        How far each vertex of the completed mesh may be from the truth, root mean square: from the true surface
        where it was seen, from its true place elsewhere. None in files of earlier versions.
    confidence : (N,) float in [0, 1]
        Probability that the vertex is within `config.tolerance` of the truth. None in files of earlier versions.
    """

    completed: Mesh
    predicted: Mesh
    pose: np.ndarray
    betas: np.ndarray | None
    trans: np.ndarray
    seen: np.ndarray
    rms: float
    explained: float
    landmark_rms: float
    converged: bool
    iterations: int
    energies: dict[str, float] = field(default_factory=dict)
    scale: float = 1.0
    expected_error: np.ndarray | None = None
    confidence: np.ndarray | None = None


@one_thread()
def complete(body: BodyModel | Subject, scan: View | Sequence[View],
             landmarks: tuple[np.ndarray, np.ndarray] | None = None, config: CompletionConfig | None = None,
             progress: Progress | None = None, masked: np.ndarray | None = None) -> Completion:
    """The whole body from a scan of some of it.

    Parameters
    ----------
    body : BodyModel or Subject
        A model when the person's shape is unknown, a subject when it is known.
    scan : Mesh, PointCloud, (n, 3) or (n, 6) float, metres, or a sequence of these
        A sequence holds several views in one frame; (n, 6) are points with normals. In any unit where
        `config.free_scale` says so.
    landmarks : ((L,) int, (L, 3) float), optional
        Vertices of the template and where they are on the scan; 4 to 10, at least 3. Without them the search
        starts from typical poses, turned every way.
    progress : callable, optional
        Called with (done, total).
    masked : (n,) bool, optional
        Points, one view after the other, that are clothing or hair: the body is somewhere inside.

    Raises
    ------
    ValueError
        Fewer than 3 landmarks, landmarks or a scan that cannot be used.

    [SCAPE] Eq. 10
    """
    config = config or CompletionConfig()
    posed = as_body(body)
    by_turns = model_for_turns(body, config)
    given = in_metres(posed, scan, landmarks, masked, config)
    sized = ScaledBody(posed) if config.free_scale else None
    task = ScanFit(sized or posed, given.cloud, given.vertices, given.points, config)
    total = config.rounds + 3
    tell = progress or (lambda done, total: None)
    starts = first_starts(task)
    tell(1, total)
    x = redraw_limbs(task, best_start(task, starts))
    tell(2, total)
    follow = partial(follow_alternating, task, by_turns) if by_turns else task.follow_scan
    x, converged, rounds, energies = follow(x, lambda done: tell(2 + done, total))
    open_error = posterior_error(task.body, x, task.precision(x))
    if sized:
        x, factor = sized.in_metres(x)
        given, open_error = given.scaled(factor), factor * open_error
    predicted = posed.template.with_vertices(posed.vertices(x))
    cloud = task.without_ignored(given.cloud, predicted)
    completed, seen, used, rms = free_surface(predicted, cloud, config)
    error = expected_error(open_error, distance_to_seen(predicted, seen), rms)
    tell(total, total)
    pose, trans, betas = posed.split(x)
    shape = body.betas if isinstance(body, Subject) else betas if posed.n_betas else None
    off = np.linalg.norm(predicted.vertices[given.vertices] - given.points, axis=1)
    landmark_rms = float(np.sqrt((off**2).mean())) if len(off) else np.nan
    return Completion(completed, predicted, pose, shape, trans, seen, rms, float(used.mean()),
                      landmark_rms, converged, rounds, energies, given.metres, error,
                      probability_within(error, config.tolerance))


def completion_problem(done: Completion, points: np.ndarray, free_scale: bool = False) -> str | None:
    """Why a completion means nothing, with the likely cause; None where it means something.

    `points` (n, 3), metres, the scan, in whatever unit it was taken to be.
    """
    off, most = done.landmark_rms / size(done.predicted), done.explained
    if done.seen.any() and most >= LOST and not (off > HAND or (off > ASTRAY and most < ENOUGH)):
        return None
    wrong = None if free_scale else unit_problem(extent(points), extent(done.predicted.vertices), "the scan is", 0.05)
    marks = "" if np.isnan(done.landmark_rms) else f", the landmarks are {1000 * done.landmark_rms:.0f} mm off"
    return (f"the body explains {100 * done.explained:.0f}% of the scan, {100 * done.seen.mean():.2g}% of it has "
            f"data{marks}; " + (wrong or ("landmarks of other places, left and right exchanged, or " if marks else "")
                                + "a scan of something else, another model?"))
