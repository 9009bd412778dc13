"""Completion of a partial scan: a start from landmarks, the pose and shape, then the free surface."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry.mesh import Mesh

from ..bodies import as_body
from .fit import ScanFit
from .restarts import best_start, from_landmarks, redraw_limbs
from .scan import prepare_scan
from .settings import CompletionConfig
from .surface import free_surface

Progress = Callable[[int, int], None]


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
        Vertices that had data.
    rms : float, metres
        Distance of the scan points that were used to the completed mesh.
    explained : float
        Share of the scan points that were used.
    landmark_rms : float, metres
        Distance of the landmarks to their vertices on the predicted mesh.
    converged : bool
    iterations : int
        Rounds of matching.
    energies : dict
        Each term of the energy at the end.
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


def complete(body: BodyModel | Subject, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray],
             config: CompletionConfig | None = None, progress: Progress | None = None) -> Completion:
    """The whole body from a scan of some of it.

    Parameters
    ----------
    body : BodyModel or Subject
        A model when the person's shape is unknown, a subject when it is known.
    scan : Mesh, or (n, 3) float, metres
    landmarks : ((L,) int, (L, 3) float)
        Vertices of the template and where they are on the scan; 4 to 10, at least 3.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    ValueError
        Fewer than 3 landmarks, landmarks or a scan that cannot be used.

    [SCAPE] Eq. 10
    """
    config = config or CompletionConfig()
    marked = check_landmarks(landmarks, body.template)
    cloud = prepare_scan(scan, None if config.viewpoint is None else np.array(config.viewpoint))
    posed = as_body(body)
    task = ScanFit(posed, cloud, *marked, config)
    total = config.rounds + 3
    tell = progress or (lambda done, total: None)
    starts = from_landmarks(task)
    tell(1, total)
    x = redraw_limbs(task, best_start(task, starts))
    tell(2, total)
    x, converged, rounds, energies = task.follow_scan(x, lambda done: tell(2 + done, total))
    predicted = posed.template.with_vertices(posed.vertices(x))
    completed, seen, used, rms = free_surface(predicted, cloud, config)
    tell(total, total)
    pose, trans, betas = posed.split(x)
    shape = body.betas if isinstance(body, Subject) else betas if posed.n_betas else None
    off = predicted.vertices[marked[0]] - marked[1]
    return Completion(completed, predicted, pose, shape, trans, seen, rms, float(used.mean()),
                      float(np.sqrt((off**2).sum(axis=1).mean())), converged, rounds, energies)


def check_landmarks(landmarks: tuple[np.ndarray, np.ndarray], template: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Landmark vertices (L,) and points (L, 3) as arrays.

    Raises
    ------
    ValueError
        Fewer than 3, lists of different length, vertices that do not exist, points that are not finite or of
        another scale than the template.
    """
    count = len(template.vertices)
    vertices, points = (np.asarray(part) for part in landmarks)
    if vertices.ndim != 1 or points.shape != (len(vertices), 3):
        raise ValueError(f"landmarks: expected (L,) vertices and (L, 3) points, got {vertices.shape} "
                         f"and {points.shape}")
    if len(np.unique(vertices)) < 3:
        raise ValueError(f"landmarks: expected at least 3 different ones, got {len(np.unique(vertices))}")
    if not np.issubdtype(vertices.dtype, np.integer):
        raise ValueError("landmarks: expected vertex numbers")
    if vertices.min() < 0 or vertices.max() >= count:
        raise ValueError(f"landmarks: expected vertices of 0..{count - 1}, "
                         f"got {vertices.min()}..{vertices.max()}")
    if not np.isfinite(points).all():
        raise ValueError("landmarks: expected finite points")
    extent, whole = (float(np.ptp(p, axis=0).max()) for p in (points, template.vertices))
    if not whole / 100 < extent < 5 * whole:
        raise ValueError(f"landmarks: they extend over {extent:.3g} m, the template over {whole:.3g} m; "
                         "expected the scan in metres")
    return vertices.astype(np.int64), points.astype(np.float64)
