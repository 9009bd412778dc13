"""The verdict on one registration, and `register` with it."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial, wraps
from typing import Any, TypeVar, cast

import numpy as np

from ..geometry.mesh import Mesh, take_any_mesh
from ..judgement import Judgement, size
from ..plausible import implausible_body
from .figures import ONE_VIEW, UNSEEN, figures_of, review
from .limbs import find_exchanged_sides, hidden_doubts, limb_doubts
from .matches import Landmarks
from .nonrigid import Registration, registration_problem
from .nonrigid import register as bend_template
from .person import PersonParts, person_parts, stature
from .unmarked import RIVAL, doubt_worn

F = TypeVar("F", bound=Callable[..., Any])


def judge_registration(name: str, template: Mesh, scan: Mesh | np.ndarray, fit: Registration, pairs: Landmarks | None,
                       parts: PersonParts | None, has_rival: bool = False, worn: Sequence[str] = ()) -> Judgement:
    """Judge the registration of one scan by the limits used for sets, and by whether it is a plausible person.

    `has_rival` says whether another body explains the scan about as well; `worn` are hair and clothes, in words.
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
    if parts is None or problem is not None:
        return verdict.judgement.merge(rival)
    # an implausible stature comes first: it is often the cause of implausible limbs
    return implausible_body(stature(template, parts, fit.mesh.vertices)).merge(verdict.judgement, rival)


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
