"""The command `scape view`."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

from scanprep.arguments import Alias, Place, UsageError
from scanprep.cli import Unit
from scanprep.console import Metric, Outcome, say
from scanprep.pipeline.pick import Port
from scanprep.ranges import Positive

from ..cli import ModelOrNone

FilesArg = Annotated[tuple[Path, ...], Place("FILE [FILE ...]")]


def view_files(files: FilesArg, model: ModelOrNone = None, over: bool = False, unit: Unit | None = None,
               rate: Positive | None = None, mend: bool = False, serve: Port | None = None,
               save_in: Annotated[Path, Alias("-o")] = Path()) -> Outcome:
    """Look at meshes, scans, models, motions and results in the browser, and move models by sliders.

    Example: scape view scan.ply completed -m model.npz

    What a file is, is told by what is in it. A model has sliders for its shape and its joints; with --over things that
    belong together are laid over each other, as a recording over the motion that was made of it.

    Args:
        files: Meshes, point clouds, depth pictures (PNG), models, motions and recordings of markers (C3D, TRC, CSV);
            registered sets and the folders of scape complete, mosh, animate and track; landmarks and marker layouts
            after their mesh.
        model: Model of motions that do not tell theirs.
        over: Lay everything over each other instead of side by side.
        unit: Unit of meshes, points, landmarks and markers.
        rate: Frames a second of motions and markers, where files do not say or say it wrongly.
        mend: Correct places and names of markers in one folder of scape mosh, and run it again.
        serve: Port to be looked at from another machine, 0 for any that is free: no browser is opened here, and how
            to reach it is printed.
        save_in: Folder for bodies and poses that are saved; files that are there stay.
    """
    from scanprep.viewer.server import serve as show

    from .app import ViewApp
    from .files import Files

    if mend:
        from ..mocap.mosh.mend import MoshApp

        if len(files) != 1:
            raise UsageError(f"--mend: expected one folder of scape mosh, got {len(files)} files")
        page = MoshApp(files[0])
        show(page, serve or None, serve is None)
        return Outcome(None, [Metric("markers corrected and not run again", len(page.spots))], judgement=None)
    app = ViewApp(Files(files, model, unit, over, rate).entries(), over, save_in)
    for problem in app.problems.values():
        say(f"scape view: note: {problem}")
    show(app, serve or None, serve is None)
    return Outcome(None, [Metric("things", len(app.entries)), Metric("shown at last", len(app.shown)),
                          Metric("files saved", len(app.written))], judgement=None)
