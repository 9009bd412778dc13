"""The verdict on one registration, and `register` with it."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial, wraps
from typing import Any, TypeVar, cast

import numpy as np

from ..geometry.mesh import Mesh, take_any_mesh
from ..judgement import Judgement, size
from ..plausible import implausible_body
from .figures import ONE_VIEW, UNSEEN, Limits, evidence_of, figures_of, review
from .limbs import find_exchanged_sides, hidden_doubts, limb_doubts
from .matches import Landmarks
from .nonrigid import Registration, registration_problem
from .nonrigid import register as bend_template
from .person import PersonParts, person_parts, stature
from .schedule import RegistrationConfig
from .unmarked import RIVAL, doubt_worn
from .wrong_landmarks import find_wrong_landmarks

# A landmark farther than STRAINED, a share of the size (14 mm on a man), from its vertex needs a look. Right ones of
# synthetic people end within 2 mm; exchanged sides that all figures let pass, up to 27 mm. Exchanged limbs count as
# EXCHANGED limits, more than any limb.
STRAINED, EXCHANGED = 0.01, 10.0
F = TypeVar("F", bound=Callable[..., Any])


def judge_registration(name: str, template: Mesh, scan: Mesh | np.ndarray, fit: Registration, pairs: Landmarks | None,
                       parts: PersonParts | None, has_rival: bool = False, worn: Sequence[str] = (),
                       wrong: str | None = None) -> Judgement:
    """Judge the registration of one scan by the limits used for sets, and by whether it is a plausible person.

    `has_rival` says whether another body explains the scan about as well; `worn` are hair and clothes, in words, and
    `wrong` is the fault of `explain_by_landmarks`, which comes first.
    """
    # first what makes the registration meaningless, then what only needs a look
    problem = registration_problem(template, scan, fit, pairs is not None) or (
        find_exchanged_sides(template, parts, fit.mesh.vertices) if parts else None)
    doubts = (*limb_doubts(template, parts, fit.mesh.vertices), *hidden_doubts(parts, fit.mesh, fit.seen),
              *doubt_worn(worn)) \
        if parts else ()
    verdict = review([figures_of(name, "", template, fit)], {} if problem is None else {name: problem}, size(template),
                     len(template.faces), doubts={name: doubts} if parts else None,
                     usual=ONE_VIEW if parts else UNSEEN)[0]
    rival = Judgement.of(check=[f"{RIVAL}: click some landmarks, left and right, to decide"] if has_rival else [])
    judgement = verdict.judgement.merge(rival)
    # an implausible stature comes first: it is often the cause of implausible limbs
    if parts is not None and problem is None:
        judgement = implausible_body(stature(template, parts, fit.mesh.vertices)).merge(judgement)
    return judgement.put_first(wrong)


def explain_by_landmarks(template: Mesh, scan: Mesh | np.ndarray, fit: Registration, landmarks: Landmarks | None,
                         known: Mapping[str, int], parts: PersonParts | None, config: RegistrationConfig
                         ) -> str | None:
    """Name the fault in the landmarks of a registration that is doubtful, by registering again without it.

    `known` are the template's landmarks by name. None where the landmarks are no cause, and for a registration that is
    within its limits and at its landmarks.
    """
    if landmarks is None:
        return None

    def misfit_of(fit: Registration) -> dict[str, float]:
        """Collect what speaks against a registration, apart from parts that the scan does not show."""
        doubts = () if parts is None else limb_doubts(template, parts, fit.mesh.vertices)
        exchanged = parts is not None and find_exchanged_sides(template, parts, fit.mesh.vertices) is not None
        evidence = evidence_of(figures_of("", "", template, fit), size(template), len(template.faces), 1.0, Limits(),
                               doubts)
        return {**evidence, "exchanged": EXCHANGED * exchanged, "not_converged": 0.0}

    def fit_again(pairs: Landmarks) -> tuple[float, np.ndarray]:
        again = register(template, scan, pairs, config)
        return sum(misfit_of(again).values()), again.mesh.vertices

    misfit = misfit_of(fit)
    apart = np.linalg.norm(fit.mesh.vertices[landmarks[0]] - landmarks[1], axis=1).max()
    if max(misfit.values()) < 1 and apart < STRAINED * size(template):
        return None
    names = {vertex: name for name, vertex in reversed(list(known.items()))}
    return find_wrong_landmarks(template, scan, landmarks, [names[vertex] for vertex in landmarks[0].tolist()],
                                sum(misfit.values()), fit_again)


def _judge(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None, fit: Registration) -> Judgement:
    return judge_registration("scan", template, scan, fit, landmarks, person_parts(template))


def add_verdict(method: F) -> F:
    """Decorate a registration, so that its result can judge itself as `scape prep register` does, when it is asked."""
    @wraps(method)
    def wrapper(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks | None = None, *args: Any, **named: Any
                ) -> Registration:
        fit = method(template, scan, landmarks, *args, **named)
        return replace(fit, judge=partial(_judge, template, scan, landmarks))

    return cast(F, wrapper)


register = take_any_mesh(add_verdict(bend_template))
