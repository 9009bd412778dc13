"""`scape pick`: click landmarks in the browser."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from ..arguments import Place, UsageError
from ..cli import MeshArg, Unit
from ..console import Metric, Outcome, bar
from ..geometry.files import name_of
from ..geometry.landmark_names import FACE
from ..geometry.landmark_writing import CLICKED_JOINTS, Format, landmark_ending
from ..geometry.landmarks import read_landmarks
from ..ranges import Range
from ..viewer.clicked import Clicked
from ..viewer.joints import JointApp
from ..viewer.landmark_names import HUMANOID, read_names
from ..viewer.pick import PickApp
from .scans import find_scans

ScansArg = Annotated[tuple[Path, ...], Place("[SCAN ...]")]
Port = Annotated[int, Range(0, 65535)]


def pick_landmarks(mesh: MeshArg, scans: ScansArg = (), names: str = "ten", format: Format = "json",
                   unit: Unit | None = None, joints: bool = False, start: Path | None = None, serve: Port | None = None
                   ) -> Outcome:
    """Click named points on a template and on scans, in the browser. Every click is saved at once.

    Of a set that scape prep run made, the scans come worst first, and are registered again where they were mended.

    Example: scape pick template.ply scans

    Args:
        mesh: The template, or any mesh whose landmarks are wanted; or the folder of a registered set.
        scans: Scans to click the same landmarks on, one after the other, or folders of them.
        names: Names to offer beside those that are there already: "ten" for people, or a text file with one name
            in each line.
        format: Of new landmark files, which are written beside each scan with its name: json, csv, pp (MeshLab),
            mrk.json (3D Slicer). A file of these formats that is there keeps its own, and a copy of it as it was.
        unit: Unit of the scans and of their landmarks; of the mesh, if there are no scans.
        joints: Click joint centres inside one body, for scape statue fit --features. Offers the joints of its generic
            humanoid and points of the face, or --names; written beside the scan as NAME.features.json.
        start: With --joints, a file of joints to begin with, such as features.json of scape statue fit.
        serve: Port to be looked at from another machine, 0 for any that is free: no browser is opened here, and how
            to reach it is printed.
    """
    ending = landmark_ending(format)
    if joints:
        if scans:
            raise UsageError(f"--joints: expected one scan, got {1 + len(scans)}")
        return _serve_until_closed(_joint_app(mesh, names, unit, start), serve)
    if start is not None:
        raise UsageError("--start: expected --joints with it")
    if (mesh / "set.json").exists():
        return _run_mending(mesh, scans, ending, names, unit, serve)
    template = Clicked.load(mesh, ending, None if scans else unit)      # in the unit in which scape prep run reads it
    others = [Clicked.load(path, ending, unit, file) for path, file in _files(scans)]
    with bar("reading") as progress:                      # a file that is no mesh is refused before a browser opens
        for number, one in enumerate(first := [template, *others[:1]]):
            progress(number, len(first))
            _ = one.shown
    app = PickApp(template, others, read_names(names))
    return _serve_until_closed(app, serve)


def _run_mending(folder: Path, scans: tuple[Path, ...], ending: str, names: str, unit: Unit | None, serve: Port | None
                 ) -> Outcome:
    """Correct landmarks of a registered set, whose scans are registered again."""
    from .mend import MendApp

    if scans or unit:
        raise ValueError(f"{folder}: a registered set knows its scans and their unit; name nothing but the set")
    app = MendApp(folder, ending, () if names == "ten" else read_names(names))
    done = _serve_until_closed(app, serve)
    return replace(done, metrics=[*done.metrics, Metric("scans that need a look",
                                                        sum(v.suspect for v in app.verdicts.values())),
                                  Metric("scans changed and not registered again", len(app.changed - {-1}))])


def _joint_app(scan: Path, names: str, unit: Unit | None, start: Path | None) -> JointApp:
    """Open a scan to click joints in, with those of an earlier call and of a file to start with."""
    # in the file's own numbers: scape statue fit finds the unit by itself, and takes joints in that of the scan
    body = Clicked(scan, scan.with_name(name_of(scan) + CLICKED_JOINTS), unit or "m", opacity=0.45)
    for file in (start, body.file if body.file.exists() else None):
        body.places |= {} if file is None else read_landmarks(file, None, body.unit)
    with bar("reading"):
        app = JointApp(body, HUMANOID if names == "ten" else read_names(names), FACE)
    if start is not None:                # also what nobody clicks is in the file
        body.save()
    return app


def _serve_until_closed(app: PickApp, serve: Port | None) -> Outcome:
    """Show an app in the browser until it is closed; return how many landmarks were clicked."""
    from ..viewer.server import serve as show

    all_bodies = (app.template, *app.scans)
    before = {body.path: len(body.places) for body in all_bodies}
    show(app, serve or None, serve is None)
    clicked = [body for body in all_bodies if body.places]
    return Outcome(None, [Metric("bodies with landmarks", len(clicked)),
                          Metric("landmarks", sum(len(body.places) for body in clicked)),
                          Metric("more than before", sum(len(body.places) - before[body.path] for body in clicked)),
                          *(Metric(body.path.name, len(body.places), f"in {body.file.name}") for body in clicked)],
                   judgement=None)


def _files(scans: tuple[Path, ...]) -> list[tuple[Path, Path | None]]:
    """Return scans, and those in folders, with their landmark files where these are not beside the scan."""
    return [pair for one in scans for pair in (
        [(task.scan, task.landmarks) for task in find_scans(one)] if one.is_dir() else [(one, None)])]
