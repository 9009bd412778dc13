"""Registration without landmarks, or with few: through a model that finds a body on the scan; by correspondences.

Both are tried where the first leaves something to doubt, and the one that leaves less is kept.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..correspondence.correlated import find_correspondences, find_seeds
from ..correspondence.correspondences import Correspondences
from ..correspondence.search import CorrelatedConfig
from ..geometry.mesh import Mesh
from ..words import number_of
from .lead import Lead
from .limbs import exchanged_sides, limb_doubts
from .matches import Landmarks
from .nonrigid import Registration, near_origin, register
from .person import PersonParts
from .repair import gravity, repaired
from .schedule import RegistrationConfig

FEW = 7                              # landmarks from which on they lead a template alone
CLEARLY = 0.8                        # of the doubts that the first leaves, below which another registration is better
UNCOVERED = 0.005                    # share of the scan off the template, from which on a limb may be lost


@near_origin
def register_led(template: Mesh, scan: Mesh | np.ndarray, lead: Lead | None, parts: PersonParts | None = None,
                 landmarks: Landmarks | None = None, config: RegistrationConfig | None = None,
                 search: CorrelatedConfig | None = None, progress: Callable[[int, int], None] | None = None
                 ) -> tuple[Registration, str]:
    """Bring a template onto a scan with few landmarks or none: as a `lead` finds a body on it, or by correspondences.

    Returns the registration, its limbs repaired, and what led it, in words. The likeliest body is kept unless another
    one, or correspondences, leave clearly less to doubt. ValueError as from `register_unmarked` where that is all
    there is.
    """
    found = list[tuple[Registration, str]]()
    if lead is not None:
        for led in lead(scan, landmarks):
            fit = register(template, scan, landmarks, config, progress, start=led.vertices)
            fit = repaired(template, scan, fit, parts, landmarks, config)
            found.append((fit, f"model {lead.name}"))
    if landmarks is None and all(doubted(template, parts, fit) > 0 for fit, _ in found):
        try:
            fit, pairs = register_unmarked(template, scan, config, search, progress)
        except ValueError:
            if not found:
                raise
        else:
            fit = repaired(template, scan, fit, parts, None, config, correspondences=pairs)
            found.append((fit, number_of(len(pairs), "correspondence")))
    best = min(found, key=lambda one: doubted(template, parts, one[0]))
    clear = doubted(template, parts, best[0]) < CLEARLY * doubted(template, parts, found[0][0])
    return best if clear else found[0]


def doubted(template: Mesh, parts: PersonParts | None, fit: Registration) -> float:
    """How much speaks against a registration: limbs, sides that are exchanged, and what of a scan is not covered.

    Each counts 1 where it begins to be doubted; 0 where nothing does.
    """
    lost = fit.uncovered / UNCOVERED
    limbs = 0.0 if parts is None else gravity(limb_doubts(template, parts, fit.mesh.vertices)) + 10.0 * (
        exchanged_sides(template, parts, fit.mesh.vertices) is not None)
    return limbs + (lost if lost > 1 else 0.0)



@near_origin
def register_unmarked(template: Mesh, scan: Mesh | np.ndarray, config: RegistrationConfig | None = None,
                      search: CorrelatedConfig | None = None, progress: Callable[[int, int], None] | None = None
                      ) -> tuple[Registration, Correspondences]:
    """Bring a template onto a scan that has no landmarks; and the correspondences that led it.

    Correspondences that are sure may leave out a limb, a forearm bent upwards, say, which then stays beside its scan.
    A scan that is not all covered is registered again with the ends of its limbs as landmarks, and the registration
    that covers more is kept. ValueError as from `find_correspondences` and `register`.
    """
    seeds = find_seeds(template, scan)
    ends = seeds.template_vertices, seeds.scan_points
    pairs = find_correspondences(template, scan, ends, search)
    fit = register(template, scan, None, config, progress, pairs)
    if fit.uncovered > UNCOVERED:
        again = register(template, scan, ends, config, progress, pairs)
        if again.uncovered < fit.uncovered:
            fit = replace(again, landmark_rms=np.nan)                # nobody clicked them
    return fit, pairs
