"""Whether the body that a model of people makes of betas is one that a person can have."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement, implausible_body
from scanprep.pictures.camera import tallest
from scanprep.skeleton.roles import find_roles

from .body import BodyModel

ASKED = "betas are standard deviations, and hardly anybody is beyond 3"      # cause where somebody typed them


def person_judgement(model: BodyModel, betas: np.ndarray | None, cause: str = "") -> Judgement:
    """Whether the body of betas (k,) is one that a person can have; of models of other things nothing is said.

    Without betas it is the template's own body. `cause` as in `beyond_people`.
    """
    human = {"skullbase", "l_hip", "r_hip", "l_knee", "r_knee"}  # joints that a horse has not under these names
    if not find_roles(model.skeleton.names).keys() >= human:
        return Judgement()
    body = model.subject(betas).vertices(np.zeros((len(model.skeleton.parents), 3)))
    return implausible_body(*stature_and_volume(model.template.with_vertices(body)), betas, cause)


def stature_and_volume(body: Mesh) -> tuple[float, float | None]:
    """Metres along the tallest axis of a body that stands, and litres; None for a surface that is open."""
    height = float(np.ptp(body.vertices[:, tallest(body.vertices)]))
    return height, 1000 * abs(body.volume) if body.is_closed else None
