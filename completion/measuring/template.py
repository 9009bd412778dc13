"""The template that tapes lie on: its landmarks, and what brings the bodies into one pose."""
from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.built_in import load_built_in_model
from model.fitting.search import ModelMismatchError
from model.measurement.find import find_tapes
from model.measurement.marks import MEASURED
from model.measurement.measure import Measurements, measure, stands
from model.measurement.person import measure_person
from model.measurement.tapes import Tapes
from model.people import stature_and_volume
from model.posing.standing import StandingModel
from scanprep.console import bar
from scanprep.dataset import RegisteredSet
from scanprep.geometry.landmark_names import translate_landmarks
from scanprep.geometry.landmarks import landmarks_beside, read_landmark_vertices
from scanprep.geometry.mesh import Mesh
from scanprep.plausible import implausible_body
from scanprep.synthetic.landmarks import landmarks
from scanprep.synthetic.topology import load_topology
from scanprep.words import number_of

from .bodies import Body


def tape_template(file: Path | None, bodies: Sequence[Body], model: BodyModel | None
                  ) -> tuple[Tapes, StandingModel | None]:
    """Find the tapes of bodies on their template, and what brings the bodies into its pose, if anything.

    With a model, that is its template. Otherwise the built-in people are laid on the template where it lacks landmarks,
    or where anybody does not stand; the tapes are then found on it as it stands.

    Parameters
    ----------
    file : Path, optional
        Landmarks of the template.
    bodies : sequence of Body
        In the triangles of the template.
    model : BodyModel, optional
        The model of the bodies.

    Raises
    ------
    ValueError
        The template has no landmarks, and the built-in people do not fit it.
    """
    template, known = collect_landmarks(file, bodies, model)
    lacking = [name for name in MEASURED if name not in translate_landmarks(known)]
    people = lay_people(template) if lacking else None
    if people is not None:
        more = people.landmarks(load_built_in_model().info["landmarks"])
        names = [name for name in more if name in lacking] if known else list(more)
        warnings.warn(f"{number_of(len(names), 'landmark was', 'landmarks were')} missing on the template and found by "
                      "laying the built-in people on it; to place one yourself, click it with scape pick under its "
                      f"name: {', '.join(names)}", stacklevel=2)
        known = known | {name: more[name] for name in names}
    elif not known:
        size = implausible_body(*stature_and_volume(template)).reasons
        raise ValueError("".join(f"{reason}; " for reason in size[:1]) + "measuring begins at landmarks of the "
                         "template, and there are none, nor do the built-in people come to lie on it; name a file of "
                         "them with --landmarks (scape pick makes one), or a model that keeps them with -m")
    if model is not None:
        return find_tapes(template, known), StandingModel(model, template)
    if people is None:
        tapes = find_tapes(template, known)
        bent = find_bent_limb(tapes)
        if bent is None and all(stands(body.mesh.vertices, tapes) for body in bodies):
            return tapes, None
        people = lay_people(template)
        if people is None and bent is not None:
            raise ValueError(f"{bodies[0].path}: it is the template of all bodies, as no model is named, and does not "
                             f"stand upright: {bent}; name one that stands first, or the model with -m")
        if people is None:
            return tapes, None
    upright = template.with_vertices(people.stand(template.vertices).vertices)
    return find_tapes(upright, known), people


def measure_body(body: Body, tapes: Tapes, standing: StandingModel | None) -> Measurements:
    """Measure one body; its `Measurements.body` is the body as it was measured."""
    vertices, error = body.mesh.vertices, body.expected_error
    if body.betas or standing is None:
        return measure(vertices, tapes, tapes.axes if body.betas else None, error)
    return measure_person(vertices, tapes, standing, tapes.axes, error)


def collect_landmarks(file: Path | None, bodies: Sequence[Body], model: BodyModel | None
                      ) -> tuple[Mesh, dict[str, int]]:
    """Return the template of bodies, and the landmarks that are known of it.

    The template is the model's, else that of the set, else the first body. Landmarks are from the given file, the
    model, a file beside the bodies, or those of the built-in people if the triangles are theirs.
    """
    body = bodies[0] if bodies else None
    if model is not None:
        template = model.template
    else:
        assert body is not None
        template = RegisteredSet.load(body.path).template if (body.path / "set.json").exists() else body.mesh
    beside = None if body is None else landmarks_beside(body.path) if not body.path.is_dir() else next(
        (path for path in [body.path / "landmarks.json"] if path.exists()), None)
    known = dict[str, int]()
    if file is not None:
        known = read_landmark_vertices(file, template)
    elif model is not None and model.info.get("landmarks"):
        known = dict(model.info["landmarks"])
    elif beside is not None:
        known = read_landmark_vertices(beside, template)
    if not known and np.array_equal(template.faces, load_topology().mesh.faces):
        known = landmarks()
    return template, known


def lay_people(template: Mesh) -> StandingModel | None:
    """Lay the built-in people on a template; None where they do not fit, or nobody is of its size."""
    if implausible_body(*stature_and_volume(template)).problems:
        return None
    with bar("laying the built-in people on it") as progress:
        try:
            return StandingModel.lay_on(load_built_in_model(), template, progress)
        except ModelMismatchError:
            return None


def find_bent_limb(tapes: Tapes) -> str | None:
    """Return which limb of a template does not hang or stand, so that tapes found on it would lie elsewhere."""
    for name, (first, second) in tapes.limbs.items():
        way = second.at(tapes.template.vertices) - first.at(tapes.template.vertices)
        angle = float(np.degrees(np.arccos(-way @ tapes.axes[0] / np.linalg.norm(way))))
        if angle > (25 if name.endswith("shin") else 75):           # degrees from vertical of a standing person
            return f"the {name} is {angle:.0f} degrees from it"
    return None
