"""`scape model`: the commands on body models, and what they share."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from scanprep.arguments import Place
from scanprep.cli import MM, Output, Unit
from scanprep.command_line import dispatch
from scanprep.console import Metric, Outcome, bar
from scanprep.dataset import RegisteredSet
from scanprep.geometry.attached import in_body
from scanprep.geometry.files import read_mesh, read_registered
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement
from scanprep.pictures.camera import guess_upright

from .body import BodyModel, Up
from .files import load_model

ModelArg = Annotated[Path, Place("MODEL.npz")]

COMMANDS = {
    "info": ("What a model holds and how it was made.", "model.cli:info"),
    "import": ("A body model of the SMPL family's layout, MHR or SOMA-X as ours.", "model.cli:import_file"),
    "mesh": ("The mesh of one pose and shape.", "model.posing.cli:mesh"),
    "sample": ("Random bodies: meshes, a sheet of pictures, betas and poses.", "model.evaluation.cli:sample"),
    "evaluate": ("Errors on held-out bodies, with a page of pictures.", "model.evaluation.cli:evaluate"),
    "resample": ("The model with fewer or more triangles.", "model.resolution.cli:resample_model"),
    "coregister": ("Scans registered with a model as prior, and the model learned again.",
                   "model.coregistration.cli:coregister_scans"),
    "repose": ("A registered body in the poses of a motion.", "model.posing.cli:repose"),
    "character": ("A character of any triangles as the mean of a model.", "model.posing.cli:character"),
    "export": ("Files for other programs: skinned GLB, BVH, body-model npz, meshes.", "model.export.cli:export"),
}


LEFT_OUT = "poses left out of the learning, mean error"


def group(argv: list[str]) -> int:
    """The commands of `scape model`."""
    return dispatch(COMMANDS, "scape model", argv, "Look into a body model and pose it.")


def info(model: ModelArg) -> Outcome:
    """What a model holds and how it was made.

    Example: scape model info model.npz

    Args:
        model: Model file.
    """
    from .learning.scape import judge_model

    loaded = load_model(model)
    # other entries of the model's notes; those left out have rows of their own or are for programs
    told = "left_out_error", "pose_distance", "digest", "features"
    facts = [Metric(name.replace("_", " "), value) for name, value in loaded.info.items()
             if isinstance(value, str | int | float) and name not in told]
    return Outcome(None, [
        Metric("kind", loaded.kind), *about(loaded), Metric("parts", ", ".join(loaded.skeleton.names)),
        Metric("vertices", len(loaded.template.vertices)), Metric("triangles", len(loaded.template.faces)),
        Metric("landmarks", len(loaded.info.get("landmarks", {}))), *facts], judgement=judge_model(loaded))


def about(model: BodyModel) -> list[Metric]:
    """What a model is worth and made of: first how well it predicts poses that were left out of the learning."""
    left_out = model.info.get("left_out_error")
    rows = [] if left_out is None else [Metric(LEFT_OUT, MM * float(left_out), "mm")]
    rows.append(Metric("shape components", model.n_betas))
    if model.n_betas:
        rows.append(Metric("differences between the people that they explain", 100 * float(model.explained[-1]), "%"))
    if model.template.attached is not None:
        rows.append(Metric("components", str(model.template.attached)))
    return [*rows, Metric("up", "xyz"[guess_upright(model.template)[0]])]


def import_file(model: ModelArg, output: Output, up: Up | None = None) -> Outcome:
    """A body model of the SMPL family's layout (SMPL, SMPL-H, SMPL-X, STAR, `scape model export -o body.npz`) as ours.

    Vertices are those of the published formula. A folder of MHR or SOMA-X is read by the library body-models; the table
    says how near these come. The licence of the files holds for the model that is written.

    Example: scape model import SMPL_NEUTRAL.npz -o smpl.npz

    Args:
        model: File with v_template, shapedirs, posedirs, J_regressor, weights, kintree_table and f, or a folder.
        output: Model file to write.
        up: Axis of the model that points up; else that along which it stands on its feet.
    """
    from .body_library import import_any

    with bar("learning how joints bend") as progress:
        imported = import_any(model, progress).with_up(up)
    imported.save(output)
    off, notes = imported.info.get("left_out_error"), imported.info["notes"].split("; ")
    axis = guess_upright(imported.template)[0]
    return Outcome(output, [
        *([] if off is None else [Metric(LEFT_OUT, MM * float(off), "mm")]),
        *(Metric("note", note) for note in notes if note),
        Metric("vertices", len(imported.template.vertices)), Metric("triangles", len(imported.template.faces)),
        Metric("joints", len(imported.skeleton.parents)), Metric("betas", imported.n_betas),
        Metric("pose columns", len(imported.correctives)), Metric("pose features", imported.features.lift.kind),
        Metric("up", "xyz"[axis]),
        Metric("height of the template", float(np.ptp(imported.template.vertices[:, axis])), "m"),
        Metric("parts", ", ".join(imported.skeleton.names))], judgement=Judgement())


def read_body(path: Path, template: Mesh, unit: str | None = None) -> Mesh:
    """Read a mesh in the triangles of a model's template; ValueError for a mesh with other triangles."""
    body = read_mesh(path, unit)
    vertices = in_body(template, body.faces, body.vertices)
    if vertices is None:
        raise ValueError(f"{path}: expected the triangles of the model ({template}), found {body}; register the "
                         "template to it first (scape prep register)")
    return body if vertices is body.vertices else template.with_vertices(vertices)


def read_bodies(folder: Path, template: Mesh, unit: Unit | None = None, one_person: bool = False
                ) -> tuple[np.ndarray, tuple[str, ...]]:
    """Read vertices (n, N, 3) and names from a folder or a registered set.

    Of a set, the first body of every person, or with `one_person` all bodies of the person with the most.

    Raises
    ------
    ValueError
        Triangles that are not those of the template.
    """
    # a registered set says whose body each mesh is; a plain folder does not
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
        faces, vertices, names, _ = read_registered(folder, unit)
    bodies = in_body(template, faces, vertices)
    if bodies is None:
        order = ", in another order" if len(faces) == len(template.faces) else ""
        raise ValueError(f"{folder}: expected the triangles of {template}; these have {len(faces)} faces and "
                         f"{vertices.shape[1]} vertices{order}")
    return bodies, names
