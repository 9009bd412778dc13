"""Non-rigid registration of a template to a scan, from stiff to soft.

1. The template is placed by its landmarks and bent towards them, with no data yet.
2. A graph of nodes that turn and grow is drawn to the scan by matches in both directions, in stages of
   falling stiffness and rising detail; turns are unknowns, so limbs keep their volume where there are no data.
3. The surface follows the scan as a thin shell.

[Hahnel], [Allen], [Amberg]
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..correspondence.correspondences import Correspondences, checked_pairs
from ..geometry.mesh import Mesh, check_template
from ..meaning import HAND, extent, size, unit_problem
from ..threads import one_thread
from .anchors import hints_of
from .confidence import evidence, missed_share, stretched_share
from .fit import Fit
from .matches import target_of
from .schedule import GraphStage, RegistrationConfig, ShellStage
from .shell import flipped, unfold
from .vertex_rotations import turns

__all__ = ["GraphStage", "Registration", "RegistrationConfig", "ShellStage", "register"]

WIDER = (2,), (2, 3), (3, 4)     # rings of the patches where folds are left
FAR = 0.01                       # of the template's size: points of the scan farther off were missed
LOST, UNSEEN = 0.5, 0.01         # shares, of the scan missed and of the template with data, that mean nothing
ASTRAY = 0.05                    # so much missed and so much stretched: with left and right exchanged 0.13 and 0.10


@dataclass(frozen=True, eq=False)
class Registration:
    """The template on the scan.

    Attributes
    ----------
    mesh : Mesh
        The template's triangles on their new vertices.
    distances : (N,) float, metres
        From each vertex that was seen to the surface of the scan; NaN for the others.
    seen : (N,) bool
        Whether there were data here: the confidence is at least one half.
    rms : float, metres
        Of the distances of the vertices seen.
    landmark_rms : float, metres
        NaN without landmarks.
    converged : bool
        Never without data.
    iterations : int
        Steps over all stages.
    energies : dict
        Value of each term at the end of the coarse registration, and of the data at the very end.
    flipped : int
        Triangles that face against their surroundings.
    confidence : (N,) float
        From 0, made up from the surroundings, to 1: there were data here, from both directions.
    missed : float
        Share of the scan's points off the template, by more than a hundredth of its size (the root of its area). More
        than half a per cent is a limb in the wrong place, or clutter; `converged` does not tell.
    """

    mesh: Mesh
    distances: np.ndarray
    seen: np.ndarray
    rms: float
    landmark_rms: float
    converged: bool
    iterations: int
    energies: dict[str, float]
    flipped: int
    confidence: np.ndarray
    missed: float


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
    start : (4, 4) float, optional
        The similarity that brings the template near the scan, where it is known: else landmarks tell, or the whole is
        aligned, which a scan of a part leads astray.

    Returns
    -------
    Registration

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite, fewer than
        three landmarks or landmarks that do not exist.
    """
    config = config or RegistrationConfig()
    check_template(template)
    target = target_of(scan, config.neighbours)
    if landmarks is not None:
        landmarks = checked_pairs(template, *landmarks, "landmarks")
    hints = None if correspondences is None else hints_of(template, correspondences)
    fit = Fit(template, target, landmarks, hints, config, progress or (lambda done, total: None), start)
    for stage in fit.stages:
        fit.bend_graph(stage)
        if stage.twists:
            fit.try_twists(stage)
    for links in config.links:
        fit.bend_links(links)
    for round_ in config.shell:
        fit.follow(round_)
    if config.settle is not None:
        fit.settle(config.settle)
    fit.x = _without_folds(template, fit.x)
    return _result(fit, scan)


def registration_problem(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, marked: bool) -> str | None:
    """Why a registration means nothing, with the likely cause; None where it means something.

    Parameters
    ----------
    marked : bool
        Whether landmarks led it.
    """
    points = scan.vertices if isinstance(scan, Mesh) else scan
    far, seen, stretch = fit.missed, float(fit.seen.mean()), stretched_share(template, fit.mesh)
    off = fit.landmark_rms > HAND * size(template)
    if not (far > LOST or seen < UNSEEN or (far > ASTRAY and stretch > ASTRAY) or off):
        return None
    cause = unit_problem(extent(points), extent(template.vertices), "the scan is", 0.05) or (
        "landmarks of left and right exchanged, or of other places?" if marked and seen >= UNSEEN else
        "a scan of something else, or too few points?" if marked else
        "a scan of something else, or a pose far from the template's, which needs landmarks?")
    marks = f", its landmarks are {1000 * fit.landmark_rms:.0f} mm off" if marked else ""
    return (f"{100 * far:.0f}% of the scan lies off the template, {100 * seen:.2g}% of the template has data, "
            f"{100 * stretch:.0f}% of it is stretched or shrunk to the double or half{marks}; {cause}")


def _without_folds(template: Mesh, x: np.ndarray) -> np.ndarray:
    """Vertices (N, 3) where patches around turned triangles were laid anew, wider ones while that leaves fewer."""
    x = unfold(template, x, turns(template, x))
    left = int(flipped(template, x, turns(template, x)).sum())
    for rings in WIDER:
        if not left:
            break
        trial = unfold(template, x, turns(template, x), rings)
        turned = int(flipped(template, trial, turns(template, trial)).sum())
        if turned < left:
            x, left = trial, turned
    return x


def _result(fit: Fit, scan: Mesh | np.ndarray) -> Registration:
    """What was found, measured against the whole scan."""
    folded = flipped(fit.template, fit.x, turns(fit.template, fit.x))
    body = fit.template.with_vertices(fit.x)
    found = evidence(body, fit.target, fit.config.near * fit.size,
                     fit.config.normal_weight * fit.size)
    seen = found.confidence >= 0.5
    distances = np.where(seen, found.distances, np.nan)
    landmark_rms = np.nan
    if fit.landmarks is not None:
        apart = np.linalg.norm(fit.x[fit.landmarks[0]] - fit.landmarks[1], axis=1)
        landmark_rms = float(np.sqrt(np.mean(apart**2)))
    return Registration(body, distances, seen,
                        float(np.sqrt(np.mean(distances[seen] ** 2))) if seen.any() else np.nan, landmark_rms,
                        bool(fit.converged and seen.any()), fit.iterations, fit.energies, int(folded.sum()),
                        found.confidence, missed_share(scan, body, FAR * fit.size))
