"""`scape model`: look into a body model and pose it; what commands on models share."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from scanprep.cli import Unit
from scanprep.command_line import dispatch
from scanprep.console import Metric, Outcome
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import read_registered
from scanprep.geometry.mesh import Mesh

from .body import BodyModel
from .files import load_model

ModelArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MODEL.npz")]

COMMANDS = {
    "info": ("What a model holds and how it was made.", "model.cli:info"),
    "import": ("A body model of the SMPL family's layout as ours.", "model.importing:import_file"),
    "mesh": ("The mesh of one pose and shape.", "model.posing.cli:mesh"),
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


def about(model: BodyModel) -> list[Metric]:
    """What a model is made of."""
    rows = [Metric("pose features", model.n_features), Metric("shape components", model.n_betas)]
    if model.n_betas:
        rows.append(Metric("variance of shape they explain", 100 * float(model.explained[-1]), "%"))
    return rows


def read_bodies(folder: Path, template: Mesh, unit: Unit | None = None, one_person: bool = False
                ) -> tuple[np.ndarray, tuple[str, ...]]:
    """Vertices (n, N, 3) and names of a folder or a set: one body of every person, or all of the one with the most.

    Raises
    ------
    ValueError
        Triangles that are not those of the template.
    """
    if (folder / "set.json").exists():
        whole = RegisteredSet.load(folder)
        faces, subjects = whole.template.faces, [entry.subject for entry in whole.entries]
        if not subjects:
            raise ValueError(f"{folder}: the set holds no meshes")
        most = max(whole.subjects, key=subjects.count)
        names = tuple(entry.name for i, entry in enumerate(whole.entries) if
                      (entry.subject == most if one_person else entry.subject not in subjects[:i]))
        vertices = whole.vertices(names)
    else:
        faces, vertices, names = read_registered(folder, unit)
    if not np.array_equal(faces, template.faces):
        order = ", in another order" if len(faces) == len(template.faces) else ""
        raise ValueError(f"{folder}: expected the triangles of {template}; these have {len(faces)} faces and "
                         f"{vertices.shape[1]} vertices{order}")
    return vertices, names
