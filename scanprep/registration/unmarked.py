"""Registration without landmarks, or with few: initialised by a body model, else by automatic correspondences.

Correspondences are tried where the model leaves much doubt, and the better result is kept. A body turned round or
mirrored may fit a scan nearly as well. Such a rival is reported.
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
from ..geometry.mesh import Mesh, select_points
from ..judgement import HAND, size
from ..words import number_of
from .lead import Lead
from .limbs import PlausibilityIssue, find_exchanged_sides, limb_doubts
from .matches import Landmarks
from .nonrigid import LedRegistration, Registration, near_origin, register, registration_problem
from .person import PersonParts
from .repair import repair_limbs, severity
from .schedule import RegistrationConfig

FEW = 7                              # landmarks from which on no model is needed
CLEARLY = 0.8                        # another registration is better if it has less than this share of the doubt
# Doubt from which on correspondences are tried besides the model. Below it, on six poses and two men, they gave the
# same result within a millimetre, or one 3 mm worse, and took a minute.
GRAVE = 3.0
UNCOVERED = 0.005                    # share of the scan off the template from which on a limb may be missed
HAIR_ON_HEAD = "hair on head"
RIVAL = "another body explains the scan as well"


@dataclass(frozen=True, eq=False)
class Candidate:
    """A registration, how much speaks against it (`weigh_doubts`), and what initialised it, in words."""

    doubt: float
    fit: Registration
    way: str
    scan: Mesh | np.ndarray                     # without hair and clothes
    worn: tuple[str, ...] = ()                  # what these are, in words

    @property
    def led(self) -> LedRegistration:
        return LedRegistration(self.fit, self.way, worn=self.worn)


@near_origin
def register_by_any(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None,
                    lead: Lead | None = None, parts: PersonParts | None = None,
                    config: RegistrationConfig | None = None, search: CorrelatedConfig | None = None,
                    progress: Callable[[int, int], None] | None = None, model: Path | None = None
                    ) -> LedRegistration:
    """Register a template by whatever is known: landmarks, a model (`lead`), or automatic correspondences.

    Enough landmarks are used alone. Else the model proposes bodies. If all of them are doubtful, correspondences are
    tried too. The likeliest body is kept unless another result is clearly less doubtful. A different body that is
    almost as good is returned as `rival`. Implausible limbs are repaired.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        The scan.
    landmarks : ((L,) int, (L, 3) float, metres), optional
        Vertices of the template and their positions on the scan.
    lead : Lead, optional
        Finds bodies on the scan.
    parts : PersonParts, optional
        Parts of a template that is a person.
    config : RegistrationConfig, optional
        Settings of the registration.
    search : CorrelatedConfig, optional
        Settings of the correspondences.
    progress : callable, optional
        Called as progress(done, total).
    model : Path, optional
        Model file, passed on to the lead.

    Returns
    -------
    LedRegistration

    Raises
    ------
    ValueError
        As from `register_unmarked`, if nothing else is possible.
    """
    clicked = [] if landmarks is None else [number_of(len(landmarks[0]), "landmark")]
    # enough landmarks, or no model: landmarks alone
    if landmarks is not None and (lead is None or len(landmarks[0]) >= FEW):
        fit = register(template, scan, landmarks, config, progress)
        if not registration_problem(template, scan, fit, marked=True):
            fit = repair_limbs(template, scan, fit, parts, landmarks, config)
        return LedRegistration(fit, clicked[0])
    # the bodies that the model proposes, until one leaves no doubt
    candidates = list[Candidate]()
    if lead is not None:
        for body in lead(scan, landmarks, model, config.up if config else None):
            # the template is bent onto skin; under hair and clothes it stays as the model has it
            bare = scan if body.not_skin is None else select_points(scan, ~body.not_skin)
            fit = register(template, bare, landmarks, config, progress, start=body.vertices)
            way = ", ".join([*clicked, f"model {lead.name}", *(f"without {words}" for words in body.worn)])
            candidates.append(Candidate(weigh_doubts(template, parts, fit), fit, way, bare, body.worn))
            if not candidates[-1].doubt:
                return candidates[-1].led  # no doubt: try no other body
        # repair the limbs of the best body and of its rival
        first = choose_clearly(candidates)
        chosen = [one for one in (first, find_rival(template, first, candidates)) if one is not None]
        others = [one for one in candidates if one not in chosen]
        mended = [replace(one, fit=repair_limbs(template, one.scan, one.fit, parts, landmarks, config))
                  for one in chosen]
        candidates = [*(replace(one, doubt=weigh_doubts(template, parts, one.fit)) for one in mended), *others]
    # all doubtful, or no model: try correspondences; their failure counts only if there is nothing else
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
                                        number_of(len(pairs), "correspondence"), scan))
    best = choose_clearly(candidates)
    rival = find_rival(template, best, [one for one in candidates if not registration_problem(
        template, one.scan, one.fit, landmarks is not None)])
    return replace(best.led, rival=None if rival is None else rival.led)


def doubt_worn(worn: Sequence[str]) -> tuple[PlausibilityIssue, ...]:
    """Return the doubts of hair and clothes, such as "clothes on thighs"; hair on a head alone hides no measure."""
    return tuple(PlausibilityIssue(1.0, f"{words}: the body inside is a guess") for words in worn
                 if words != HAIR_ON_HEAD)


def choose_clearly(candidates: Sequence[Candidate]) -> Candidate:
    """Choose the first candidate, or the least doubtful one where that is clearly better."""
    best = min(candidates, key=attrgetter("doubt"))
    return best if best.doubt < CLEARLY * candidates[0].doubt else candidates[0]


def find_rival(template: Mesh, best: Candidate, candidates: Sequence[Candidate]) -> Candidate | None:
    """Find the least doubtful different body, if it is not clearly worse than the best; else None.

    A body is different if its worst tenth is more than a hand's width away. A twisted limb is not enough, nor is a limb
    without data in both.
    """
    def apart(fit: Registration) -> float:
        shown = fit.seen | best.fit.seen
        far = np.sort(np.linalg.norm(fit.mesh.vertices - best.fit.mesh.vertices, axis=1)[shown])
        # the worst tenth of the vertices: about as many as an arm has
        return float(far[-max(1, int(0.1 * len(far))):].mean()) if len(far) else 0.0

    others = [one for one in candidates if CLEARLY * one.doubt <= best.doubt and apart(one.fit) > HAND * size(template)]
    return min(others, key=attrgetter("doubt"), default=None)


def weigh_doubts(template: Mesh, parts: PersonParts | None, fit: Registration) -> float:
    """Sum what speaks against a registration: limbs, exchanged sides, and the uncovered share of the scan.

    Each counts 1 at its limit; 0 means no doubt.
    """
    lost = fit.uncovered / UNCOVERED
    # exchanged sides count 10, more than any limb
    limbs = 0.0 if parts is None else severity(limb_doubts(template, parts, fit.mesh.vertices)) + 10.0 * (
        find_exchanged_sides(template, parts, fit.mesh.vertices) is not None)
    return limbs + (lost if lost > 1 else 0.0)


@near_origin
def register_unmarked(template: Mesh, scan: Mesh | np.ndarray, config: RegistrationConfig | None = None,
                      search: CorrelatedConfig | None = None, progress: Callable[[int, int], None] | None = None
                      ) -> tuple[Registration, Correspondences]:
    """Register a template to a scan without landmarks; return the registration and its correspondences.

    Confident correspondences may miss a limb, such as a raised forearm, which then stays off its scan. So a scan that
    is not fully covered is registered again with its limb ends as landmarks, and the better covering result is kept.
    ValueError as from `find_correspondences` and `register`.
    """
    seeds = find_seeds(template, scan)
    ends = seeds.template_vertices, seeds.scan_points
    pairs = find_correspondences(template, scan, ends, search)
    fit = register(template, scan, None, config, progress, pairs)
    if fit.uncovered > UNCOVERED:
        again = register(template, scan, ends, config, progress, pairs)
        if again.uncovered < fit.uncovered:
            fit = replace(again, landmark_rms=np.nan)                # these landmarks were not clicked
    return fit, pairs
