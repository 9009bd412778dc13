"""Where the fit of a scan begins, and where it begins again when a limb is in the wrong place."""
from __future__ import annotations

import numpy as np

from scanprep import find_correspondences

from ..starts import distinct, search
from .draws import around, examples_of, limbs, near_points, quick_misfits, redrawn
from .fit import ScanFit
from .search import from_nothing

COARSE = (0.25, 0.2, 0.15, 0.12, 0.1)    # metres: reaches of the first rounds, on few points
PAIRS_SD = 0.05                      # metres: correspondences are that far off, and not independently of each other
FINALISTS = 4                        # starts that are carried through all these rounds
SETTLE = (0.2, 0.15, 0.1)            # metres: reaches of the rounds after a limb was moved
DOUBT = 0.012                        # share of scan or body that may be in the wrong place for no reason
MANY = 6                             # times as many draws of a limb are compared with what is unexplained
PROMISING = 30.0                     # a limb drawn at random may be this much worse before it is fitted
BETTER = 5.0                         # by how much the misfit must fall for a limb to be moved


def first_starts(fit: ScanFit) -> np.ndarray:
    """Bodies (n, P) to start from: those that meet the landmarks, or, without any, typical poses on the scan."""
    if not len(fit.vertices):
        return from_nothing(fit)
    marked = from_landmarks(fit, fit.vertices, fit.points, fit.config.landmark_sd)
    if not fit.config.correspondences:
        return marked
    pairs = find_correspondences(fit.body.template, fit.cloud.points, (fit.vertices, fit.points))
    more = from_landmarks(fit, pairs.template_vertices, pairs.scan_points, PAIRS_SD)
    return np.concatenate([more, marked])


def from_landmarks(fit: ScanFit, vertices: np.ndarray, points: np.ndarray, sd: float) -> np.ndarray:
    """The likeliest bodies (n, P) that meet landmarks (L,), (L, 3) to within sd metres, distinct and best first."""
    body, config = fit.body, fit.config
    follow = body.follow(vertices, np.zeros(body.n_angles + 3 + body.n_betas))
    x, _ = search(body, follow, points, sd, fit.prior, config.start_axes)
    places = body.subject.points(fit.spread).evaluate(*body.split(x)[:2])
    x = x[distinct(places, config.candidates)]
    drawn = np.concatenate([x, *(around(body, follow, start, points, sd, fit.prior, config.draws, fit.rng)
                                for start in x)])
    drawn = drawn[np.argsort(quick_misfits(fit, drawn))]
    places = body.subject.points(fit.spread).evaluate(*body.split(drawn)[:2])
    return drawn[distinct(places, config.candidates)]


def best_start(fit: ScanFit, starts: np.ndarray) -> np.ndarray:
    """The start (P,) that explains the scan best after a few rounds on few points; the worst drop out early."""
    ends = np.array(starts)
    if len(ends) > FINALISTS:
        ends = np.array([approach(fit, x, COARSE[:2]) for x in ends])
        ends = ends[np.argsort([fit.misfit(x) for x in ends], kind="stable")[:FINALISTS]]
        ends = np.array([approach(fit, x, COARSE[2:]) for x in ends])
    else:
        ends = np.array([approach(fit, x) for x in ends])
    return ends[int(np.argmin([fit.misfit(x) for x in ends]))]


def approach(fit: ScanFit, x: np.ndarray, reaches: tuple[float, ...] = COARSE) -> np.ndarray:
    """Unknowns (P,) after a few rounds on few points."""
    for reach in reaches:
        x = fit.step(x, fit.coarse, reach)[0]
    return x


def redraw_limbs(fit: ScanFit, x: np.ndarray) -> np.ndarray:
    """Unknowns (P,) with limbs moved elsewhere where that explains the scan better; the shape is held."""
    if not doubtful(fit, x):
        return x
    whole, fit.body = fit.body, fit.body.held(x)
    free = whole.n_angles + 3
    moved = approach(fit, x[:free], SETTLE)
    for root in limbs(fit.body.skeleton):
        moved = _redrawn(fit, moved, root)
    fit.body = whole
    return np.concatenate([moved[:free], x[free:]])


def _redrawn(fit: ScanFit, x: np.ndarray, root: int) -> np.ndarray:
    """Unknowns (P,) with the limb at a joint as it is, or drawn from the prior and from the training poses."""
    best, count = fit.misfit(x), fit.config.draws
    moved = np.flatnonzero(fit.body.skeleton.descends[:, root])
    drawn = np.concatenate([examples_of(fit.body, x, root, MANY * count // 2, fit.rng),
                            redrawn(fit.body, x, root, fit.prior, MANY * count, fit.rng)])
    drawn = drawn[fit.rng.permutation(len(drawn))]
    wanted = fit.coarse.points[fit.unexplained(x, fit.coarse)]
    drawn = np.vstack([near_points(fit, drawn, moved, wanted, count // 3), drawn[:count]])
    quick = quick_misfits(fit, np.vstack([x, drawn]), moved)
    for i in np.argsort(quick[1:])[:2]:
        if quick[i + 1] > quick[0] + PROMISING:
            continue
        tried = approach(fit, drawn[i], SETTLE)
        if (misfit := fit.misfit(tried)) < best - BETTER:
            x, best = tried, misfit
    return x


def doubtful(fit: ScanFit, x: np.ndarray) -> bool:
    """Whether more than a little of the scan is unexplained, or of the body where nothing can be."""
    return bool(fit.unexplained(x, fit.thin).mean() > DOUBT
                or len(fit.trespasses(fit.mesh(x))[0]) > DOUBT * len(fit.spread))
