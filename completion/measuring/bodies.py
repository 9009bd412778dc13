"""Read bodies from files: registered, completed, or as betas of a model."""
from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.measurement.marks import MEASURED
from model.measurement.tapes import Tapes
from model.people import stature_and_volume
from model.posing.cli import read_subject
from scanprep.console import bar
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import list_meshes, name_of, read_mesh
from scanprep.geometry.landmark_names import translate_landmarks
from scanprep.geometry.landmarks import landmarks_beside, read_landmark_vertices
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import implausible_body
from scanprep.registration.person import find_landmarks
from scanprep.registration.unit import resolve_unit
from scanprep.words import number_of

from ..partial.completion import load_completion
from ..viewing.kinds import model_of_report

# files by which the folders of commands are recognised
COMPLETED, PERSON, MOTION = "completion.npz", "subject.json", "motion.npz"


@dataclass(frozen=True, eq=False)
class Body:
    """One body to measure.

    `betas`: made from shape coefficients, so it stands as the model's template does. `path`: its origin, for landmarks
    and messages. `expected_error`: (N,) metres, of a completed body.
    """

    name: str
    mesh: Mesh
    path: Path
    betas: bool = False
    expected_error: np.ndarray | None = None


def read_bodies(paths: Sequence[Path], model: BodyModel | None, unit: str | None) -> list[Body]:
    """Read all bodies of files and folders, in the triangles of one template.

    Raises
    ------
    ValueError
        No bodies, betas without a model, or other triangles.
    """
    bodies = [body for path in paths for body in _bodies(path, model, unit)]
    if not bodies:
        raise ValueError("BODY: expected at least one body, found none")
    first = bodies[0].mesh if model is None else model.template
    whose = bodies[0].path if model is None else "the model"
    for body in bodies:
        if not np.array_equal(body.mesh.faces, first.faces):
            raise ValueError(f"{body.path}: expected the triangles of {whose} ({first}), found {body.mesh}; register "
                             "the template to it first (scape prep register), or measure it in a call of its own")
    return bodies


def model_of(paths: Sequence[Path]) -> Path | None:
    """Return the model that the reports of folders name; None where none does, or it does not exist any more."""
    for path in paths:
        folders = [path, *(p.parent for p in sorted(path.glob("*/report.json")))] if path.is_dir() else [path.parent]
        for folder in folders:
            name = model_of_report(folder / "report.json")
            if name is not None:
                return name
    return None


def _bodies(path: Path, model: BodyModel | None, unit: str | None) -> Iterator[Body]:
    """Yield the bodies of one file or folder."""
    if not path.exists():
        raise ValueError(f"{path}: there is no such file or folder")
    if not path.is_dir():
        yield _of_file(path, model, unit)
    elif (path / "set.json").exists():
        registered = RegisteredSet.load(path)
        for entry in registered.entries:
            yield Body(entry.name, registered.template.with_vertices(registered.vertices([entry.name])[0]), path)
    elif (path / COMPLETED).exists():
        completion = load_completion(path)
        yield Body(path.name, completion.completed, path, expected_error=completion.expected_error)
    elif (path / PERSON).exists() or (path / MOTION).exists():
        file = path / PERSON if (path / PERSON).exists() else path / MOTION
        yield _of_betas(path.name, file, model)
    else:
        inner = sorted({p.parent for name in (COMPLETED, PERSON, MOTION) for p in path.glob(f"*/{name}")})
        for folder in inner:
            yield from _bodies(folder, model, unit)
        for mesh in [] if inner else list_meshes(path):
            yield _of_file(mesh, model, unit)


def _of_file(path: Path, model: BodyModel | None, unit: str | None) -> Body:
    """Read the body of a mesh, or of betas."""
    if path.suffix.lower() in (".json", ".npz"):
        return _of_betas(name_of(path), path, model)
    error = None
    if path.name == "completed.ply" and (path.parent / COMPLETED).exists():
        error = load_completion(path.parent).expected_error
    return Body(name_of(path), read_mesh(path, resolve_unit(path, unit)), path, expected_error=error)


def _of_betas(name: str, path: Path, model: BodyModel | None) -> Body:
    """Compute the body of betas, in the pose of the model's template."""
    if model is None:
        raise ValueError(f"{path}: betas need their model; name it with -m")
    body = read_subject(model, path).vertices(np.zeros((len(model.skeleton.parents), 3)))
    return Body(name, model.template.with_vertices(body), path, betas=True)


def landmarks_of(file: Path | None, bodies: Sequence[Body], model: BodyModel | None) -> tuple[Mesh, dict[str, int]]:
    """Return the template that tapes are defined on, and its landmarks.

    The template is the model's, else that of the set, else the first body. Landmarks are from the given file, the
    model, a file beside the bodies, or those of the built-in people if the triangles are theirs. Where tapes need more,
    they are found by registering the average person.
    """
    from scanprep.synthetic.landmarks import landmarks
    from scanprep.synthetic.topology import load_topology

    # the template, and the landmarks that are known of it
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

    # further landmarks that tapes need
    missing = [name for name in MEASURED if name not in translate_landmarks(known)]
    if not missing:
        return template, known
    with bar("looking for the other landmarks") as progress:
        located = find_landmarks(template, known, progress)
    more = {name: located[name] for name in missing if name in located}
    if not more and not known:
        size = implausible_body(*stature_and_volume(template)).reasons
        raise ValueError("".join(f"{reason}; " for reason in size[:1]) + "measuring begins at landmarks of the "
                         "template, and there are none, nor does the average person come to lie on it; name a file of "
                         "them with --landmarks (scape pick makes one), or a model that keeps them with -m")
    if more:
        warnings.warn(f"{number_of(len(more), 'landmark was', 'landmarks were')} missing on the template and found "
                      "with the average person, a few centimetres from where you would click; to place one yourself, "
                      f"click it with scape pick under its name: {', '.join(more)}", stacklevel=2)
    return template, known | more


def check_standing(tapes: Tapes, body: Body) -> None:
    """Raise ValueError for a template whose legs are bent, or whose arms are not below the shoulders."""
    for name, (first, second) in tapes.limbs.items():
        way = second.at(tapes.template.vertices) - first.at(tapes.template.vertices)
        angle = float(np.degrees(np.arccos(-way @ tapes.axes[0] / np.linalg.norm(way))))
        if angle > (25 if name.endswith("shin") else 75):           # degrees from vertical of a standing person
            raise ValueError(f"{body.path}: it is the template of all bodies, as no model is named, and does not stand "
                             f"upright: the {name} is {angle:.0f} degrees from it; name one that stands first, or the "
                             "model with -m")
