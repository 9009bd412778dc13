"""Pose, place and shape together: in rounds of matching with shrinking reach, or to meet an alignment."""
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

SETTLED = 5e-4                       # metres, root mean square over the vertices from round to round
NARROWING, SETTLING = 3, 12          # rounds from the wide to the final reach; that a reach is held at most
CLEARLY = 0.93                       # of the narrow reach's misfit, below which the wide one's is clearly less


@dataclass(frozen=True, eq=False)
class Solved:
    """Unknowns (P,) at the end of the rounds, whether they settled, the rounds, and each term of the energy."""

    x: np.ndarray
    converged: bool
    rounds: int
    energies: dict[str, float]


def solve_jointly(fit: ScanFit, few: ScanFit, x: np.ndarray, tell: Callable[[int], None]) -> Solved:
    """All unknowns at once from x (P,) on, in rounds of matching with shrinking reach, `few` vertices first.

    A model of many scans follows a scan closely, and matches that are farther off than it ever is are wrong. One of
    few scans does not, and drops the limbs that it follows badly. So the rounds settle at a wide reach first, then at
    a narrow one, and the former is kept where it explains clearly more.

    [SCAPE] Eq. 10
    """
    wide_reach = 0.08  # metres: limit on the distance of matches, for models that follow a scan badly
    reaches = np.geomspace(REACH, wide_reach, fit.config.rounds)
    rough = _in_rounds(few, x, reaches, tell, 0)
    # rounds at the wide reach that take all vertices, at least
    wide = _in_rounds(fit, rough.x, reaches[-1:].repeat(2), lambda i: None)
    narrow = _in_rounds(fit, wide.x, np.geomspace(wide_reach, FINAL_REACH, NARROWING), lambda i: None)
    best = wide if fit.misfit(wide.x) < CLEARLY * fit.misfit(narrow.x) else narrow
    return replace(best, rounds=rough.rounds + wide.rounds + narrow.rounds)


def _in_rounds(fit: ScanFit, x: np.ndarray, reaches: np.ndarray, tell: Callable[[int], None],
               settling: int = SETTLING) -> Solved:
    """Unknowns from x (P,) on when matches reach so far, metres, round by round, and the last until they settle."""
    shift, place, rounds = np.inf, fit.skin(x).places, len(reaches)
    for i, reach in enumerate([*reaches, *reaches[-1:].repeat(settling)]):
        x, matched = fit.step(x, fit.thin, reach)
        before, place = place, fit.skin(x).places
        shift = float(np.sqrt(((place - before)**2).sum(axis=1).mean()))
        tell(min(i + 1, rounds))
        if i + 1 >= rounds and shift < SETTLED:
            break
    return Solved(x, bool(shift < 2 * SETTLED), i + 1, matched.energies(x))


def meet_vertices(fit: ScanFit, x: np.ndarray, vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Unknowns (P,) from x (P,) on at which a body meets an alignment, as far as priors and landmarks let it.

    `vertices` (N, 3), metres, of the alignment; `weights` (N,), from 0 for those that may be anywhere to 1.
    """
    ids, config = fit.sample.spread, fit.config
    share = share_of_vertices(fit.body.template.vertices, ids) / len(vertices)
    near = EVIDENCE / config.scan_sd**2 * share * weights[ids]
    to_point = np.concatenate([np.full(len(fit.vertices), config.landmark_sd**-2), near])
    targets = np.concatenate([fit.points, vertices[ids]])
    # times that the points of a body are linearised anew to meet an alignment
    for _ in range(4):
        points, at = fit.body.gather(np.concatenate([fit.vertices, ids]), x)
        pull = MatchTargets(points, at, targets, np.zeros_like(targets), to_point, np.zeros(len(targets)))
        x = levenberg_marquardt(partial(_equations, Matched(pull, len(fit.vertices), len(ids), fit.prior_terms),
                                        fit.body.n_angles + 3), x[None], 3, 1e-5).x[0]
    return x


def _equations(matched: Matched, first_beta: int, x: np.ndarray) -> Deferred:
    """Those of matches, and of the prior of the betas, at unknowns (1, P)."""
    return matched.equations(x, shape_prior(x, first_beta))
