"""Plausibility of bodies of people: stature and volume."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement
from scanprep.pictures.camera import tallest
from scanprep.plausible import implausible_body
from scanprep.skeleton.roles import find_roles

from .body import BodyModel

ASKED = "betas are standard deviations, and hardly anybody is beyond 3"      # cause where somebody typed them


def person_judgement(model: BodyModel, betas: np.ndarray | None, cause: str = "") -> Judgement:
    """Judge whether betas (k,) give a body that a person can have; models of other things are always good.

    Without betas it is the template's own body. `cause` is the likely reason that the message names.
    """
    human = {"skullbase", "l_knee", "r_knee"}              # roles that only people's skeletons have
    if not find_roles(model.skeleton.names).keys() >= human:
        return Judgement()
    body = model.subject(betas).vertices(np.zeros((len(model.skeleton.parents), 3)))
    return implausible_body(*stature_and_volume(model.template.with_vertices(body)), betas, cause)


def stature_and_volume(body: Mesh) -> tuple[float, float | None]:
    """Measure stature, metres, and volume, litres, of a standing body; no volume for an open surface."""
    height = float(np.ptp(body.vertices[:, tallest(body.vertices)]))
    return height, 1000 * abs(body.volume) if body.is_closed else None
