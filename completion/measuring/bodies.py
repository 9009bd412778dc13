"""Bodies that files hold: registered, completed, or as betas of a model."""
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
from scanprep.cli import Unit
from scanprep.console import bar
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import list_meshes, name_of, read_mesh
from scanprep.geometry.landmark_names import translate_landmarks
from scanprep.geometry.landmarks import landmarks_beside, read_landmark_vertices
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import implausible_body
from scanprep.registration.person import find_landmarks
from scanprep.words import number_of

from ..partial.completion import load_completion
from ..viewing.kinds import model_of_report

COMPLETED, PERSON, MOTION = "completion.npz", "subject.json", "motion.npz"      # files that tell what a folder is


@dataclass(frozen=True, eq=False)
class Body:
    """One body to be measured.

    `betas`: it is that of a model in the pose of its template. `path` is where it comes from, for landmarks and
    messages; `expected_error` (N,), metres.
    """

    name: str
    mesh: Mesh
    path: Path
    betas: bool = False
    expected_error: np.ndarray | None = None


def read_bodies(paths: Sequence[Path], model: BodyModel | None, unit: Unit | None) -> list[Body]:
    """All bodies of files and folders, in the triangles of one template.

    Raises
    ------
    ValueError
        None, betas without a model, or other triangles.
    """
    found = [body for path in paths for body in _bodies(path, model, unit)]
    if not found:
        raise ValueError("BODY: expected at least one body, found none")
    first = found[0].mesh if model is None else model.template
    whose = found[0].path if model is None else "the model"
    for body in found:
        if not np.array_equal(body.mesh.faces, first.faces):
            raise ValueError(f"{body.path}: expected the triangles of {whose} ({first}), found {body.mesh}; register "
                             "the template to it first (scape prep register), or measure it in a call of its own")
    return found


def model_of(paths: Sequence[Path]) -> Path | None:
    """The model that the reports of folders name; None where none does, or it is gone."""
    for path in paths:
        folders = [path, *(p.parent for p in sorted(path.glob("*/report.json")))] if path.is_dir() else [path.parent]
        for folder in folders:
            name = model_of_report(folder / "report.json")
            if name is not None:
                return name
    return None


def _bodies(path: Path, model: BodyModel | None, unit: Unit | None) -> Iterator[Body]:
    """The bodies of one file or folder."""
    if not path.exists():
        raise ValueError(f"{path}: there is no such file or folder")
    if not path.is_dir():
        yield _of_file(path, model, unit)
    elif (path / "set.json").exists():
        whole = RegisteredSet.load(path)
        for entry in whole.entries:
            yield Body(entry.name, whole.template.with_vertices(whole.vertices([entry.name])[0]), path)
    elif (path / COMPLETED).exists():
        done = load_completion(path)
        yield Body(path.name, done.completed, path, expected_error=done.expected_error)
    elif (path / PERSON).exists() or (path / MOTION).exists():
        known = path / PERSON if (path / PERSON).exists() else path / MOTION
        yield _of_betas(path.name, known, model)
    else:
        inner = sorted({p.parent for name in (COMPLETED, PERSON, MOTION) for p in path.glob(f"*/{name}")})
        for folder in inner:
            yield from _bodies(folder, model, unit)
        for mesh in [] if inner else list_meshes(path):
            yield _of_file(mesh, model, unit)


def _of_file(path: Path, model: BodyModel | None, unit: Unit | None) -> Body:
    """A mesh, or betas."""
    if path.suffix.lower() in (".json", ".npz"):
        return _of_betas(name_of(path), path, model)
    error = None
    if path.name == "completed.ply" and (path.parent / COMPLETED).exists():
        error = load_completion(path.parent).expected_error
    return Body(name_of(path), read_mesh(path, unit), path, expected_error=error)


def _of_betas(name: str, path: Path, model: BodyModel | None) -> Body:
    if model is None:
        raise ValueError(f"{path}: betas need their model; name it with -m")
    body = read_subject(model, path).vertices(np.zeros((len(model.skeleton.parents), 3)))
    return Body(name, model.template.with_vertices(body), path, betas=True)


def landmarks_of(given: Path | None, bodies: Sequence[Body], model: BodyModel | None) -> tuple[Mesh, dict[str, int]]:
    """The template that tapes are found on, and its landmarks.

    The model's, which keeps its own; else that of the set; else the first body. Landmarks are in the file given, or
    beside, or known by the triangles: those of the built-in people. Where tapes begin at others too, as they do when
    ten were clicked, the average person finds them.
    """
    from scanprep.synthetic.landmarks import landmarks
    from scanprep.synthetic.topology import load_topology

    # the template, and the landmarks that somebody gave it
    first = bodies[0] if bodies else None
    if model is not None:
        template = model.template
    else:
        assert first is not None
        template = RegisteredSet.load(first.path).template if (first.path / "set.json").exists() else first.mesh
    beside = None if first is None else landmarks_beside(first.path) if not first.path.is_dir() else next(
        (path for path in [first.path / "landmarks.json"] if path.exists()), None)
    known = dict[str, int]()
    if given is not None:
        known = read_landmark_vertices(given, template)
    elif model is not None and model.info.get("landmarks"):
        known = dict(model.info["landmarks"])
    elif beside is not None:
        known = read_landmark_vertices(beside, template)
    elif np.array_equal(template.faces, load_topology().mesh.faces):
        known = landmarks()

    # those that tapes begin at besides
    lacking = [name for name in MEASURED if name not in translate_landmarks(known)]
    if not lacking:
        return template, known
    with bar("looking for the other landmarks") as progress:
        found = find_landmarks(template, known, progress)
    more = {name: found[name] for name in lacking if name in found}
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
    """Refuse a body as the template of others if its legs bend or its arms are not below the shoulders."""
    for name, (first, second) in tapes.limbs.items():
        way = second.at(tapes.template.vertices) - first.at(tapes.template.vertices)
        angle = float(np.degrees(np.arccos(-way @ tapes.axes[0] / np.linalg.norm(way))))
        if angle > (25 if name.endswith("shin") else 75):           # degrees from hanging, on somebody who stands
            raise ValueError(f"{body.path}: it is the template of all bodies, as no model is named, and does not stand "
                             f"upright: the {name} is {angle:.0f} degrees from it; name one that stands first, or the "
                             "model with -m")
