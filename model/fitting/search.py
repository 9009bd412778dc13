"""Search for bodies of a model on whole scans, and on templates with other triangles.

1. The search of `complete` finds the body: typical poses in all orientations. Where the result is doubtful, limbs are
   re-initialised, which takes as long again.
2. A template has no holes, so the body is then registered to all of it.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry.mesh import Mesh, select_points
from scanprep.registration.nonrigid import register, share_stretched, share_uncovered
from scanprep.threads import one_thread

from ..body import BodyModel
from .bodies import FixedBody, as_body
from .free_surface import free_surface
from .inside import reach_farther
from .limbs import ASTRAY, with_limbs, with_standing
from .not_skin import NotSkin, find_not_skin
from .rounds import solve_jointly
from .scale import check_size
from .scan import point_count
from .scan_fit import ScanFit, prepare_scan_fit
from .settings import ScanFitConfig
from .starts import best_starts, first_starts, from_nothing

Landmarks = tuple[np.ndarray, np.ndarray]
NO_LANDMARKS = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
# Shares of the body's size (√area): bodies nearer than ALIKE everywhere lead to the same result; scan points farther
# than FAR are uncovered. From a share LOST of uncovered points on, a limb is missing (a hand is 0.02 of a man).
ALIKE, FAR, LOST = 0.015, 0.045, 0.005


class ModelMismatchError(ValueError):
    """The model does not fit the template: it is of another kind of body."""


def nearest_by_name(template: Mesh, laid: Mesh, names: Mapping[str, int]) -> dict[str, int]:
    """Find the vertices of a template that are nearest to named ones of the model laid on it."""
    nearest = cKDTree(template.vertices).query(laid.vertices[list(names.values())])[1] if names else ()
    return {name: int(v) for name, v in zip(names, nearest, strict=True)}


def lay_model(model: BodyModel, template: Mesh, progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Lay the mesh of a model on a template with other triangles.

    Parameters
    ----------
    model : BodyModel
        The model.
    template : Mesh
        Of the same kind of body as the model, in a pose that the search finds.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Mesh
        The model's triangles, with vertices on the template.

    Raises
    ------
    ModelMismatchError
        No body of the model fits the template.
    """
    report_progress, own = progress or (lambda done, total: None), model.template
    if np.array_equal(own.faces, template.faces) and np.allclose(own.vertices, template.vertices, atol=1e-6):
        report_progress(1, 1)                             # the model was learned with this template
        return template
    # largest shares of the template that is uncovered, and of the body that is stretched. A woman has 0.004 and 0.0002;
    # a crab has 0.005 and 0.088.
    other = 0.02, 0.05
    for body, _ in find_bodies(model, template):
        report_progress(1, 2)
        laid = register(body, template, start=body.vertices)
        if laid.uncovered <= other[0] and share_stretched(body, laid.mesh) <= other[1]:
            report_progress(2, 2)
            return laid.mesh
    raise ModelMismatchError(f"the model does not come to lie on the template, {100 * laid.uncovered:.0f}% of which "
                             "lies off it: a model of something else?")


def find_bodies(model: BodyModel, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                up: tuple[float, float, float] | None = None, only_if_near: bool = False
                ) -> Iterator[tuple[Mesh, NotSkin | None]]:
    """Yield likely bodies of a model on a scan, each bent onto it where there are data, and computed on demand.

    With each comes what hair and clothes are around it, or None. Where the best one shows any, the search is made again
    for a body inside them. First comes the best of the typical poses. Then come the best after re-initialisation of
    limbs, and another body that explains the scan nearly as well, where they differ.

    Parameters
    ----------
    model : BodyModel
        The model.
    scan : Mesh or (n, 3) float, metres
        The scan of a whole body.
    landmarks : (L,) int and (L, 3) float, metres, optional
        Few vertices of the model and where they are on the scan.
    up : (3,) floats, optional
        The direction that is up in the scan, where people in it mostly stand.
    only_if_near : bool
        Yield nothing where the first body leaves `ASTRAY` of the scan unexplained, as in scans of something else.

    Raises
    ------
    WrongScaleError
        A person of another size than the unit of the scan says.
    """
    body, size, config = as_body(model), float(np.sqrt(model.template.face_areas.sum())), ScanFitConfig(up=up)
    fit, coarse, starts, factor = _search(body, scan, landmarks or NO_LANDMARKS, config)

    def mesh_of(x: np.ndarray) -> Mesh:
        """Compute the predicted body of unknowns (P,) at its own size."""
        return model.template.with_vertices(body.vertices(fit.body.in_metres(x)[0]))

    def bend(x: np.ndarray) -> tuple[Mesh, NotSkin | None]:
        """Let the surface of the body follow the scan; lengths there are those of the fit."""
        followed, *_ = free_surface(fit.mesh(x), fit.cloud)              # [SCAPE] Eq. 10, over Y
        return followed.with_vertices(followed.vertices / factor), worn

    best = _solve(fit, coarse, starts[0])
    if only_if_near and coarse.find_unexplained(best, coarse.thin).mean() > ASTRAY:
        return
    worn = find_not_skin(fit.mesh(best), body, fit.cloud, point_count(scan))
    if worn is not None:                       # or a limb that was lost
        best = _solve_with_limbs(fit, coarse, starts)[0]
        worn = find_not_skin(fit.mesh(best), body, fit.cloud, point_count(scan))
    if worn is not None and worn.points.any():
        worn = reach_farther(worn, fit, best, point_count(scan))
        fit, coarse, starts, factor = _search(body, scan, landmarks or NO_LANDMARKS, config, worn.points)
        best, scan = _solve_with_limbs(fit, coarse, starts)[0], select_points(scan, ~worn.points)
    first = mesh_of(best)
    # a body with a limb in the wrong place leaves scan points uncovered: skip it
    lost = share_uncovered(scan, first, FAR * size) > LOST
    if not lost:
        yield bend(best)
    for x in _solve_with_limbs(fit, coarse, starts):
        if lost or np.linalg.norm(mesh_of(x).vertices - first.vertices, axis=1).max() > ALIKE * size:
            yield bend(x)


@one_thread()
def _search(body: FixedBody, scan: Mesh | np.ndarray, landmarks: Landmarks, config: ScanFitConfig,
            masked: np.ndarray | None = None) -> tuple[ScanFit, ScanFit, np.ndarray, float]:
    """Prepare the fit of a scan, the same with few vertices, and the unknowns (n, P) of likely bodies, best first.

    `masked` (n,) bool are points of hair and clothes. Also return the factor by which lengths of the fit are larger
    than those of the scan.
    """
    fit, factor = prepare_scan_fit(body, scan, *landmarks, config, masked)
    few = fit.few()
    starts = first_starts(fit, few)
    if len(landmarks[0]) >= 3:                 # few landmarks determine little: also try starts without them
        starts = np.concatenate([starts, from_nothing(few)])
    starts = best_starts(few, starts)
    if fit.body is body:                       # a hand or a horse is brought to the size of a person
        check_size(body, few, starts[0])
    return fit, few, starts, factor


@one_thread()
def _solve_with_limbs(fit: ScanFit, few: ScanFit, starts: np.ndarray) -> list[np.ndarray]:
    """Solve from the best start after re-initialisation of limbs, and from one that explains nearly as much."""
    bodies = with_standing(fit, few, *with_limbs(fit, few, starts))
    return [_solve(fit, few, x) for x in bodies if x is not None]


@one_thread()
def _solve(fit: ScanFit, few: ScanFit, x: np.ndarray) -> np.ndarray:
    """Fit pose, place and shape together from a start; return unknowns (P,)."""
    return solve_jointly(fit, few, x, lambda done: None).x
