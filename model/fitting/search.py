"""Bodies of a model sought on scans of whole people, and on templates of other triangles.

1. The body is found by the search of `complete`: typical poses turned every way. Where that leaves something to doubt,
   limbs are tried elsewhere, which takes as long again.
2. On a template, which is a surface without holes, the body is then laid: registered until it lies on all of it.
"""
from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.registration.nonrigid import register, share_stretched, share_uncovered
from scanprep.threads import one_thread

from ..body import BodyModel
from .bodies import FixedBody, as_body
from .limbs import with_limbs
from .rounds import solve_jointly
from .scan_fit import ScanFit, prepare_scan_fit
from .settings import ScanFitConfig
from .starts import best_starts, first_starts, from_nothing

Landmarks = tuple[np.ndarray, np.ndarray]
NO_LANDMARKS = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
# Of the body's size: bodies no vertex of which is farther apart come to the same end; so far off a body is what a limb
# that is elsewhere leaves uncovered; and the share of a scan that is then lost, where a hand is 0.02 of a man.
ALIKE, FAR, LOST = 0.015, 0.045, 0.005


class ModelMismatchError(ValueError):
    """A model that does not come to lie on a template: it is of something else."""


def lay_model(model: BodyModel, template: Mesh, progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Lay the mesh of a model on a template of other triangles.

    Parameters
    ----------
    model : BodyModel
    template : Mesh
        Of what the model is of, in a pose that the search finds.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Mesh
        Of the model's triangles; the vertices lie on the template.

    Raises
    ------
    ModelMismatchError
    """
    tell, own = progress or (lambda done, total: None), model.template
    if np.array_equal(own.faces, template.faces) and np.allclose(own.vertices, template.vertices, atol=1e-6):
        tell(1, 1)                             # a model of this very template
        return template
    # of a template: share off the body that was laid on it, and of the body that is stretched, from which on it is
    # another thing than the model; a woman has 0.004 and 0.0002, a crab 0.005 and 0.088
    other = 0.02, 0.05
    for body in find_bodies(model, template):
        tell(1, 2)
        laid = register(body, template, start=body.vertices)
        if laid.uncovered <= other[0] and share_stretched(body, laid.mesh) <= other[1]:
            tell(2, 2)
            return laid.mesh
    raise ModelMismatchError(f"the model does not come to lie on the template, {100 * laid.uncovered:.0f}% of which "
                             "lies off it: a model of something else?")


def find_bodies(model: BodyModel, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None) -> Iterator[Mesh]:
    """Yield bodies of a model on a scan, each sought when it is asked for.

    First the likeliest of typical poses; then the best with limbs moved elsewhere, and another body that explains the
    scan nearly as well, where there are such.

    Parameters
    ----------
    model : BodyModel
    scan : Mesh or (n, 3) float, metres
    landmarks : (L,) int and (L, 3) float, metres, optional
        Few vertices of the model and where they are on the scan.
    """
    body, size = as_body(model), float(np.sqrt(model.template.face_areas.sum()))
    fit, few, starts = _search(body, scan, landmarks or NO_LANDMARKS)

    def mesh_of(x: np.ndarray) -> Mesh:
        """The body of unknowns (P,) at its own size."""
        return model.template.with_vertices(body.vertices(fit.body.in_metres(x)[0]))

    first = mesh_of(_solve(fit, few, starts[0]))
    # what is left uncovered so far off is a limb that is elsewhere; nobody needs to look at such a body
    lost = share_uncovered(scan, first, FAR * size) > LOST
    if not lost:
        yield first
    for x in _solve_with_limbs(fit, few, starts):
        other = mesh_of(x)
        if lost or np.linalg.norm(other.vertices - first.vertices, axis=1).max() > ALIKE * size:
            yield other


@one_thread()
def _search(body: FixedBody, scan: Mesh | np.ndarray, landmarks: Landmarks) -> tuple[ScanFit, ScanFit, np.ndarray]:
    """The fit of a scan, the same with few vertices, and the unknowns (n, P) of the likeliest bodies, best first."""
    fit, _ = prepare_scan_fit(body, scan, *landmarks, ScanFitConfig())
    few = fit.few()
    starts = first_starts(fit, few)
    if len(landmarks[0]) >= 3:                 # few landmarks leave much open: also bodies that begin without
        starts = np.concatenate([starts, from_nothing(few)])
    return fit, few, best_starts(few, starts)


@one_thread()
def _solve_with_limbs(fit: ScanFit, few: ScanFit, starts: np.ndarray) -> list[np.ndarray]:
    """Unknowns (P,) of the best start after its limbs were moved elsewhere, and of one that explains nearly as much."""
    return [_solve(fit, few, x) for x in with_limbs(fit, few, starts) if x is not None]


@one_thread()
def _solve(fit: ScanFit, few: ScanFit, x: np.ndarray) -> np.ndarray:
    """Unknowns (P,) of pose, place and shape together, from those of a start."""
    return solve_jointly(fit, few, x, lambda done: None).x
