"""The command `scape view`."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from scanprep.cli import Unit
from scanprep.console import Metric, Outcome, say
from scanprep.viewer.cli import Port

from ..cli import ModelOrNone

FilesArg = Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE [FILE ...]")]
Axis = Literal["x", "-x", "y", "-y", "z", "-z"]


def view_files(files: FilesArg, model: ModelOrNone = None, over: bool = False, unit: Unit | None = None,
               up: Axis | None = None, port: Port | None = None, open: bool = True,
               save_in: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path()) -> Outcome:
    """Look at meshes, scans, models, motions and results in the browser, and move models by sliders.

    Example: scape view scan.ply completed -m model.npz

    What a file is, is told by what is in it. A model has sliders for its shape and its joints; with --over things that
    belong together are laid over each other, as a recording over the motion that was made of it.

    Args:
        files: Meshes, point clouds, models, motions and recordings of markers (C3D, TRC, CSV); registered sets and the
            folders of scape complete, mosh, animate and track; landmarks and marker layouts after their mesh.
        model: Model of motions that do not tell theirs.
        over: Lay everything over each other instead of side by side.
        unit: Unit of meshes, points, landmarks and markers.
        up: Axis that points up; without it the one along which a body is largest.
        port: Port of this machine to use; else any that is free.
        open: Open the browser. With --no-open the address is printed, and how to reach it from another machine.
        save_in: Folder for bodies and poses that are saved; files that are there stay.
    """
    from scanprep.viewer.server import serve

    from .app import ViewApp
    from .files import Files

    if not files:
        raise ValueError("FILE: expected at least one file or folder")
    app = ViewApp(Files(files, model, unit, over).entries(), over, up, save_in)
    for problem in app.problems.values():
        say(f"scape view: note: {problem}")
    serve(app, port, open)
    return Outcome(None, [Metric("things", len(app.entries)), Metric("shown at last", len(app.shown)),
                          Metric("files saved", len(app.written))])
