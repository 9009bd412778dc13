"""Read bodies from files: registered, completed, or as betas of a model."""
from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.posing.cli import read_subject
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import list_meshes, name_of, read_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.registration.figures import UNSEEN, read_figures
from scanprep.registration.unit import resolve_unit

from ..partial.completion import Completion, load_completion
from ..viewing.kinds import model_of_report

# files by which the folders of commands are recognised
COMPLETED, PERSON, MOTION = "completion.npz", "subject.json", "motion.npz"
# Expected errors of the surface, metres: of registered meshes, whose skin is 1 mm from the scan and slides a little; of
# what their scans do not show, as `scape complete` tells it of half views (11 to 18 mm on seven people); and of bodies
# made from betas, which are as far from the person as the model's own error in `model/fitting/confidence.py`.
REGISTERED, HIDDEN, OF_BETAS = 0.0015, 0.0125, 0.0075


@dataclass(frozen=True, eq=False)
class Body:
    """One body to measure.

    `expected_error`: (N,) metres, of the vertices. `betas`: made from shape coefficients, so it stands as the model's
    template does. `path`: its origin, for landmarks and messages.
    """

    name: str
    mesh: Mesh
    path: Path
    expected_error: np.ndarray
    betas: bool = False


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
        shown = {figures.name: figures.seen for figures in read_figures(path)}
        for entry in registered.entries:
            mesh = registered.template.with_vertices(registered.vertices([entry.name])[0])
            yield Body(entry.name, mesh, path, everywhere(mesh, registration_error(shown.get(entry.name, 1.0))))
    elif (path / COMPLETED).exists():
        completion = load_completion(path)
        yield Body(path.name, completion.completed, path, completion_error(completion))
    elif (path / PERSON).exists() or (path / MOTION).exists():
        betas = path / PERSON if (path / PERSON).exists() else path / MOTION
        yield _of_betas(path.name, betas, model)
    else:
        inner = sorted({p.parent for name in (COMPLETED, PERSON, MOTION) for p in path.glob(f"*/{name}")})
        for folder in inner:
            yield from _bodies(folder, model, unit)
        for file in [] if inner else list_meshes(path):
            yield _of_file(file, model, unit)


def _of_file(path: Path, model: BodyModel | None, unit: str | None) -> Body:
    """Read the body of a mesh, or of betas."""
    if path.suffix.lower() in (".json", ".npz"):
        return _of_betas(name_of(path), path, model)
    mesh = read_mesh(path, resolve_unit(path, unit))
    if path.name == "completed.ply" and (path.parent / COMPLETED).exists():
        return Body(name_of(path), mesh, path, completion_error(load_completion(path.parent)))
    return Body(name_of(path), mesh, path, everywhere(mesh, REGISTERED))


def registration_error(seen: float) -> float:
    """Compute the expected error of a registered mesh, metres, whose scan shows a share of the surface.

    What scans from all sides leave without data is small and lies between data, so it counts as seen.
    """
    hidden = max(0.0, 1 - seen - UNSEEN) / (1 - UNSEEN)
    return float(np.sqrt((1 - hidden) * REGISTERED**2 + hidden * HIDDEN**2))


def completion_error(completion: Completion) -> np.ndarray:
    """Return the expected errors (N,), metres, of a completed body.

    They hold for people as the model knows them. Somebody whose betas are larger is as much less known.
    """
    if completion.expected_error is None:
        return everywhere(completion.completed, REGISTERED)
    size = 0.0 if completion.betas is None else float(np.sqrt(np.mean(completion.betas**2)))
    return max(1.0, size) * completion.expected_error


def everywhere(mesh: Mesh, error: float) -> np.ndarray:
    """Return one expected error for all vertices of a mesh, (N,) metres."""
    return np.full(len(mesh.vertices), error)


def _of_betas(name: str, path: Path, model: BodyModel | None) -> Body:
    """Compute the body of betas, in the pose of the model's template."""
    if model is None:
        raise ValueError(f"{path}: betas need their model; name it with -m")
    body = read_subject(model, path).vertices(np.zeros((len(model.skeleton.parents), 3)))
    mesh = model.template.with_vertices(body)
    return Body(name, mesh, path, everywhere(mesh, OF_BETAS), betas=True)
