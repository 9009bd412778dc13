"""Measure a completed body in one call."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.built_in import load_built_in_model
from model.measurement.measure import Measurements

from ..partial.completion import Completion
from .bodies import Body, completion_error
from .template import measure_body, tape_template


def measure_completion(whole: Completion, model: BodyModel | None = None) -> Measurements:
    """Measure a completed person in any pose, with expected errors, as `scape measure` does.

    Parameters
    ----------
    whole : Completion
        The completed body.
    model : BodyModel, optional
        The model with which it was completed; without it the built-in people, in their own triangles or laid on it.

    Returns
    -------
    Measurements
        `values` in metres and kilograms, and their `errors`, by name.

    Raises
    ------
    ValueError
        A body of other triangles than the model, or one on which the built-in people do not come to lie.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> mesh = model.template
    >>> seen = np.ones(len(mesh.vertices), dtype=bool)
    >>> whole = Completion(mesh, mesh, np.zeros((16, 3)), None, np.zeros(3), seen, 0.001, 0.98, 0.004, True, 12)
    >>> found = measure_completion(whole, model)
    >>> 1.6 < found.values["stature"] < 1.8, 0 < found.errors["waist_girth"] < 0.05
    (True, True)
    """
    people = load_built_in_model()
    if model is None and np.array_equal(whole.completed.faces, people.template.faces):
        model = people
    if model is not None and not np.array_equal(whole.completed.faces, model.template.faces):
        raise ValueError(f"model: expected the one of this body ({whole.completed}), got another ({model.template})")
    body = Body("body", whole.completed, Path("body in memory"), completion_error(whole))
    return measure_body(body, *tape_template(None, [body], model))
