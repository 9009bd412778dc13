"""`scape learn` and `scape model`: learn a body from registered meshes, look into it, pose it."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, dispatch
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.storage import load_arrays, numbers, read_json, taking_apart
from scanprep.ranges import BETAS, TURNS, Beta

from .body import BodyModel
from .files import load_model
from .learning.cli import about
from .linear import Subject
from .posing.transfer import subject_from_body

ModelArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL.npz")]

COMMANDS = {
    "info": ("What a model holds and how it was made.", "model.cli:info"),
    "mesh": ("The mesh of one pose and shape.", "model.cli:mesh"),
    "sample": ("Random bodies: meshes, a sheet of pictures, betas and poses.", "model.evaluation.cli:sample"),
    "evaluate": ("Errors on held-out bodies, with a page of curves and pictures.", "model.evaluation.cli:evaluate"),
    "resample": ("The model with fewer or more triangles.", "model.resolution.cli:resample_model"),
    "coregister": ("Scans registered with a model as prior, and the model learned again.",
                   "model.coregistration.cli:coregister_scans"),
    "repose": ("A registered body in the poses of a motion.", "model.posing.cli:repose"),
    "character": ("A character of any triangles as the mean of a model.", "model.posing.cli:character"),
    "export": ("Files for other programs: skinned GLB, BVH, body-model npz, meshes.", "model.export.cli:export"),
}


def group(argv: list[str]) -> int:
    """The commands of `scape model`."""
    return dispatch(COMMANDS, "scape model", argv, "Look into a body model and pose it.")


def info(model: ModelArg) -> Outcome:
    """What a model holds and how it was made.

    Example: scape model info model.npz
    """
    loaded = load_model(model)
    facts = [Metric(name.replace("_", " "), value) for name, value in loaded.info.items()
             if isinstance(value, str | int | float)]
    return Outcome(None, [
        Metric("kind", loaded.kind), Metric("vertices", len(loaded.template.vertices)),
        Metric("triangles", len(loaded.template.faces)), Metric("parts", ", ".join(loaded.skeleton.names)),
        *about(loaded), Metric("landmarks", len(loaded.info.get("landmarks", {}))), *facts])


def mesh(model: ModelArg, output: Output, pose: Path | None = None, betas: tuple[Beta, ...] = (),
         subject: Path | None = None, own_body: bool = False) -> Outcome:
    """Write the mesh of one pose and shape.

    Example: scape model mesh model.npz --betas 2 -1 -o body.ply

    Args:
        model: Model file.
        output: Mesh to write.
        pose: JSON {part name: [x, y, z]} of axis-angle turns against the parent in radians, others at rest.
        betas: Shape in standard deviations, the first of them; the mean person without.
        subject: Betas in JSON or .npz, or a mesh in the model's triangles, instead of --betas.
        own_body: The template's own body instead of the mean person.
    """
    loaded = load_model(model)
    turns = np.zeros((len(loaded.skeleton.parents), 3))
    for name, turn in (_read_turns(pose) if pose else {}).items():
        if name not in loaded.skeleton.names:
            raise ValueError(f"{pose}: no part '{name}'; the model has {', '.join(loaded.skeleton.names)}")
        try:
            turns[loaded.skeleton.names.index(name)] = turn
        except (TypeError, ValueError):
            raise ValueError(f"{pose}: {name}: expected [x, y, z] in radians, got {turn}") from None
    TURNS.check(turns, f"{pose}: turns")
    if (subject is not None) + bool(betas) + own_body > 1:
        raise ValueError("--betas, --subject and --own-body: expected one of them")
    if subject is not None or own_body:
        vertices = read_subject(loaded, subject).vertices(turns)
    elif not loaded.n_betas:
        raise ValueError(f"{model}: it has no shape components; ask for --own-body")
    else:
        vertices = loaded.vertices(turns, np.array(betas if betas else (0.0,)))
    write_mesh(output, loaded.template.with_vertices(vertices))
    return Outcome(output, [Metric("vertices", len(vertices)),
                            Metric("largest extent", float(np.ptp(vertices, axis=0).max()), "m")])


def _read_turns(path: Path) -> dict[str, np.ndarray]:
    """Turns (3,), radians, by the names of parts."""
    wanted = "turns {part: [x, y, z]}"
    tree = read_json(path, wanted)
    with taking_apart(path, f"{wanted} in JSON"):
        turns = {name: np.array(turn, dtype=np.float64) for name, turn in tree.items()}
        return {name: numbers(turns, name, 3) for name in turns}


def read_subject(model: BodyModel, given: Path | None, unit: Unit | None = None) -> Subject:
    """The subject named on the command line: betas in JSON or a motion file, or a mesh in the model's topology.

    Without a name it is the template's own body; of a mesh it has all the detail, which betas have not.

    Raises
    ------
    ValueError
        A file that is neither, a mesh of another topology.
    """
    if given is None:
        return model.subject(None)
    if given.suffix in (".json", ".npz"):
        betas = _read_betas(given)
        if len(betas) > model.n_betas:
            raise ValueError(f"{given}: expected at most the {model.n_betas} betas of the model, found {len(betas)}")
        return model.subject(betas if len(betas) else None)
    person = read_mesh(given, unit)
    if not np.array_equal(person.faces, model.template.faces):
        raise ValueError(f"{given}: expected the triangles of the model ({model.template}), found {person}; "
                         "register the template to it first (scape prep register)")
    return subject_from_body(model, person.vertices)


def _read_betas(path: Path) -> np.ndarray:
    """Betas (k,) from JSON or from the array of that name in an `.npz`; none for the template's own body."""
    wanted = 'betas [b1, b2, ...] or {"betas": [...]}'
    if path.suffix == ".json":
        found = read_json(path, wanted)
        found = found.get("betas") if isinstance(found, dict) else found
    else:
        found = load_arrays(path).get("betas")
    try:
        betas = np.array(found, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        betas = np.array(np.nan)
    if betas.ndim != 1 or not np.isfinite(betas).all():
        raise ValueError(f"{path}: expected {wanted}, found something else")
    BETAS.check(betas, f"{path}: betas")
    return betas
