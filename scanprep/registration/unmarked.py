"""Registration without landmarks, or with few: through a model that finds a body on the scan; by correspondences.

The second is tried where the first leaves much to doubt, and the one that leaves less is kept. Bodies lie on a scan
nearly as well turned round or mirrored: where a second one leaves hardly more to doubt, it is told too.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np

from ..correspondence.correlated import find_correspondences, find_seeds
from ..correspondence.correspondences import Correspondences
from ..correspondence.search import CorrelatedConfig
from ..geometry.mesh import Mesh
from ..judgement import HAND, size
from ..words import number_of
from .lead import Lead
from .limbs import find_exchanged_sides, limb_doubts
from .matches import Landmarks
from .nonrigid import LedRegistration, Registration, near_origin, register, registration_problem
from .person import PersonParts
from .repair import repair_limbs, severity
from .schedule import RegistrationConfig

FEW = 7                              # landmarks from which on they lead a template alone
CLEARLY = 0.8                        # of the doubts that the first leaves, below which another registration is better
# Doubts that the model's bodies leave, from which on correspondences are tried too. Below, on six poses and two men,
# they led to the same within a millimetre, or 3 mm farther off, and took a minute.
GRAVE = 3.0
UNCOVERED = 0.005                    # share of the scan off the template, from which on a limb may be lost
RIVAL = "another body explains the scan as well"


@dataclass(frozen=True, eq=False)
class Candidate:
    """A registration, how much speaks against it (`weigh_doubts`), and what led it, in words."""

    doubt: float
    fit: Registration
    way: str

    @property
    def led(self) -> LedRegistration:
        return LedRegistration(self.fit, self.way)


@near_origin
def register_by_any(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                    lead: Lead | None = None, parts: PersonParts | None = None,
                    config: RegistrationConfig | None = None, search: CorrelatedConfig | None = None,
                    progress: Callable[[int, int], None] | None = None, model: Path | None = None
                    ) -> LedRegistration:
    """Bring a template onto a scan by what there is, limbs repaired: landmarks; few of them, or none, and a lead;
    correspondences, where all bodies that a lead finds leave much to doubt.

    The likeliest body is kept unless another one, or correspondences, leave clearly less to doubt. Another body that
    leaves hardly more is the rival of the one that is kept. `model` is passed on to the lead. ValueError as from
    `register_unmarked` where that is all there is.
    """
    clicked = [] if landmarks is None else [number_of(len(landmarks[0]), "landmark")]
    if landmarks is not None and (lead is None or len(landmarks[0]) >= FEW):
        fit = register(template, scan, landmarks, config, progress)
        if not registration_problem(template, scan, fit, marked=True):
            fit = repair_limbs(template, scan, fit, parts, landmarks, config)
        return LedRegistration(fit, clicked[0])
    candidates = list[Candidate]()
    if lead is not None:
        way = ", ".join([*clicked, f"model {lead.name}"])
        for vertices in lead(scan, landmarks, model):
            fit = register(template, scan, landmarks, config, progress, start=vertices)
            candidates.append(Candidate(weigh_doubts(template, parts, fit), fit, way))
            if not candidates[-1].doubt:
                return candidates[-1].led                      # nothing to doubt: no other body is sought
        # the best body and its rival, both repaired, stand for what they were
        first = choose_clearly(candidates)
        chosen = [one for one in (first, find_rival(template, first, candidates)) if one is not None]
        others = [one for one in candidates if one not in chosen]
        mended = [repair_limbs(template, scan, one.fit, parts, landmarks, config) for one in chosen]
        candidates = [*(Candidate(weigh_doubts(template, parts, fit), fit, way) for fit in mended), *others]
    if landmarks is None and all(one.doubt > GRAVE for one in candidates):
        try:
            fit, pairs = register_unmarked(template, scan, config, search, progress)
        except ValueError:
            if not candidates:
                raise
        else:
            if not registration_problem(template, scan, fit, marked=False):
                fit = repair_limbs(template, scan, fit, parts, None, config, correspondences=pairs)
            candidates.append(Candidate(weigh_doubts(template, parts, fit), fit,
                                        number_of(len(pairs), "correspondence")))
    best = choose_clearly(candidates)
    rival = find_rival(template, best, [one for one in candidates if not registration_problem(
        template, scan, one.fit, landmarks is not None)])
    return replace(best.led, rival=None if rival is None else rival.led)


def choose_clearly(candidates: Sequence[Candidate]) -> Candidate:
    """The first of some registrations, or the one of least doubt where that leaves clearly less."""
    best = min(candidates, key=attrgetter("doubt"))
    return best if best.doubt < CLEARLY * candidates[0].doubt else candidates[0]


def find_rival(template: Mesh, best: Candidate, candidates: Sequence[Candidate]) -> Candidate | None:
    """Of other bodies than the best the one of least doubt, where that is not clearly more; else None.

    Another body is one whose worst tenth is more than a hand's width off: a twisted limb makes none, and neither does
    a limb of which the scan shows nothing in either.
    """
    def apart(fit: Registration) -> float:
        shown = fit.seen | best.fit.seen
        far = np.sort(np.linalg.norm(fit.mesh.vertices - best.fit.mesh.vertices, axis=1)[shown])
        # share of the vertices that tells two bodies apart: about that of an arm
        return float(far[-max(1, int(0.1 * len(far))):].mean()) if len(far) else 0.0

    others = [one for one in candidates if CLEARLY * one.doubt <= best.doubt and apart(one.fit) > HAND * size(template)]
    return min(others, key=attrgetter("doubt"), default=None)


def weigh_doubts(template: Mesh, parts: PersonParts | None, fit: Registration) -> float:
    """How much speaks against a registration: limbs, sides that are exchanged, and what of a scan is not covered.

    Each counts 1 where it begins to be doubted; 0 where nothing does.
    """
    lost = fit.uncovered / UNCOVERED
    # doubts that exchanged sides count as: more than any limb
    limbs = 0.0 if parts is None else severity(limb_doubts(template, parts, fit.mesh.vertices)) + 10.0 * (
        find_exchanged_sides(template, parts, fit.mesh.vertices) is not None)
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
