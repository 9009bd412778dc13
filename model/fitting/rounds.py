"""Joint fit of pose, place and shape: in rounds of matching with shrinking reach, or to a registered mesh."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from scanprep.geometry.least_squares import Deferred, levenberg_marquardt

from .energy import shape_prior
from .pull import MatchTargets
from .scan_fit import EVIDENCE, FINAL_REACH, REACH, Matched, ScanFit
from .vertices import share_of_vertices

SETTLED = 5e-4                       # metres: converged when vertices move less from round to round (RMS)
NARROWING, SETTLING = 3, 12          # rounds from the wide to the final reach; most rounds at one reach
CLEARLY = 0.93                       # the wide reach wins only with a misfit below this share of the narrow one's


@dataclass(frozen=True, eq=False)
class Solved:
    """Result of a fit: unknowns (P,), whether it converged, the number of rounds, and each term of the energy."""

    x: np.ndarray
    converged: bool
    rounds: int
    energies: dict[str, float]


def solve_jointly(fit: ScanFit, few: ScanFit, x: np.ndarray, report_progress: Callable[[int], None]) -> Solved:
    """Fit all unknowns from x (P,), in rounds of matching with shrinking reach, with `few` vertices first.

    A model of many scans follows a scan closely, so distant matches are wrong. A model of few scans does not, and at a
    narrow reach it loses limbs that it follows badly. So the rounds converge at a wide reach first, then at a narrow
    one. The wide result is kept only where it explains clearly more.

    [SCAPE] Eq. 10
    """
    wide_reach = 0.08  # metres: limit on the distance of matches, for models that follow a scan badly
    reaches = np.geomspace(REACH, wide_reach, fit.config.rounds)
    rough = _in_rounds(few, x, reaches, report_progress, 0)
    # at least two rounds with all vertices at the wide reach, then the narrow one
    wide = _in_rounds(fit, rough.x, reaches[-1:].repeat(2), lambda i: None)
    narrow = _in_rounds(fit, wide.x, np.geomspace(wide_reach, FINAL_REACH, NARROWING), lambda i: None)
    best = wide if fit.misfit(wide.x) < CLEARLY * fit.misfit(narrow.x) else narrow
    return replace(best, rounds=rough.rounds + wide.rounds + narrow.rounds)


def _in_rounds(fit: ScanFit, x: np.ndarray, reaches: np.ndarray, report_progress: Callable[[int], None],
               settling: int = SETTLING) -> Solved:
    """Fit from x (P,) with one largest match distance, metres, a round; the last is repeated until convergence."""
    shift, place, rounds = np.inf, fit.skin(x).places, len(reaches)
    for i, reach in enumerate([*reaches, *reaches[-1:].repeat(settling)]):
        x, matched = fit.step(x, fit.thin, reach)
        before, place = place, fit.skin(x).places
        shift = float(np.sqrt(((place - before)**2).sum(axis=1).mean()))
        report_progress(min(i + 1, rounds))
        if i + 1 >= rounds and shift < SETTLED:
            break
    return Solved(x, bool(shift < 2 * SETTLED), i + 1, matched.energies(x))


def meet_vertices(fit: ScanFit, x: np.ndarray, vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Fit a body, from unknowns x (P,), to registered vertices, with priors and landmarks; return unknowns (P,).

    `vertices` (N, 3), metres, have weights (N,) from 0, for those that may be anywhere, to 1.
    """
    ids, config = fit.sample.spread, fit.config
    share = share_of_vertices(fit.body.template.vertices, ids) / len(vertices)
    near = EVIDENCE / config.scan_sd**2 * share * weights[ids]
    to_point = np.concatenate([np.full(len(fit.vertices), config.landmark_sd**-2), near])
    targets = np.concatenate([fit.points, vertices[ids]])
    # points are linearised anew four times
    for _ in range(4):
        points, at = fit.body.gather(np.concatenate([fit.vertices, ids]), x)
        pull = MatchTargets(points, at, targets, np.zeros_like(targets), to_point, np.zeros(len(targets)))
        x = levenberg_marquardt(partial(_equations, Matched(pull, len(fit.vertices), len(ids), fit.prior_terms),
                                        fit.body.n_angles + 3), x[None], 3, 1e-5).x[0]
    return x


def _equations(matched: Matched, first_beta: int, x: np.ndarray) -> Deferred:
    """Build the equations of the matches and the shape prior at unknowns (1, P)."""
    return matched.equations(x, shape_prior(x, first_beta))
