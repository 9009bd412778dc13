"""`scape model repose`: a registered body in other poses."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.geometry.files import read_mesh

from ..cli import ModelArg
from ..export.cli import read_motion
from ..export.meshes import write_frames
from ..files import load_model
from .transfer import TransferConfig, own_body

MM = 1000.0

BodyArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BODY")]


def repose(model: ModelArg, body: BodyArg, poses: Path, output: Output, unit: Unit | None = None,
           config: Annotated[TransferConfig, tyro.conf.arg(name="")] = TransferConfig()) -> Outcome:  # noqa: B008
    """Put one registered body, with all its detail, into the poses of a motion.

    Example: scape model repose model.npz man.ply --poses walk/motion.npz -o walking

    Args:
        model: Model file.
        body: Mesh with the triangles of the model.
        poses: Motion file (.npz), as of scape animate; its betas are not used.
        output: Folder for the meshes.
        unit: Unit of the body.
        config: Settings.
    """
    loaded, mesh = load_model(model), read_mesh(body, unit)
    if not np.array_equal(mesh.faces, loaded.template.faces):
        raise ValueError(f"{body}: expected the triangles of the model ({loaded.template}), found {mesh}; "
                         "register the template to it first (scape prep register)")
    moves = read_motion(poses, loaded)
    found = own_body(loaded, mesh.vertices, config=config)
    with bar("writing meshes") as progress:
        written = write_frames(output, found.subject, moves.poses, moves.trans, progress=progress)
    return Outcome(output, [
        Metric("meshes", len(written)),
        Metric("distance from the body in its own pose, mean", MM * found.mean, "mm"),
        Metric("distance from the body in its own pose, largest", MM * found.largest, "mm")], {"repose": config})
