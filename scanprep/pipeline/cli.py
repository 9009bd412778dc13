"""`scape prep run` and `scape prep page`: a whole folder of scans."""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from ..batch.opening import workspace
from ..batch.workspace import Workspace
from ..cleaning.clean_scan import CleanScanConfig
from ..cli import MM, Output, SetArg
from ..console import Metric, Outcome, bar, say
from ..geometry.files import read_mesh
from ..geometry.landmarks import read_template_landmarks
from ..geometry.mesh import Mesh
from .figures import Limits, Verdict
from .page import PAGE, judge_set, write_set_page
from .prepare import PrepareConfig, Prepared, prepare
from .scan import Init
from .scans import ScanTask, find_scans

ScansArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCANS")]
LISTED = 5                    # scans that the closing table names


def run_all(scans: ScansArg, template: Path, output: Output, landmarks: Path | None = None,
            template_landmarks: Path | None = None, clean: bool = False, subject: str = "",
            config: PrepareConfig = PrepareConfig(), *, space: Workspace) -> Outcome:                # noqa: B008
    """Register a template to every scan of a folder, find the skeleton, and write a page of all scans, worst first.

    Killed and started again it goes on where it was; scans whose files have changed are registered anew.

    Example: scape prep run scans --template template.ply -o set

    Args:
        scans: Folder of meshes or point clouds. scans.csv in it may say more: name,subject,pose,sex.
        template: Mesh to bring onto the scans: one closed or bordered manifold component.
        output: Folder of the registered set; open report.html in it.
        landmarks: Folder of landmark files with the names of the scans; else scans/landmarks, or beside the scans.
        template_landmarks: Landmarks of the template; else the file of its name beside it.
        clean: Take floor, furniture and specks off each scan before.
        subject: Whose scans they are, where scans.csv does not say; else each is a person of its own.
    """
    body, tasks = read_mesh(template), find_scans(scans, landmarks, subject)
    if clean and config.scan.clean is None:
        config = replace(config, scan=replace(config.scan, clean=CleanScanConfig()))
    marks = _template_marks(template, template_landmarks, body, tasks, config.scan.init)
    with bar("finding the parts of a person") as naming, bar("registering scans") as registering, \
            bar("finding the skeleton") as finding:
        done = prepare(tasks, body, marks, space.folder, config, registering, finding, naming)
    return Outcome(output, [*_progress_made(done, tasks), *_quality(judge_set(output)),
                            Metric("unit assumed", config.scan.unit or "m")], {"prepare": config}, list(done.failures))


def page(registered: SetArg, limits: Limits = Limits()) -> Outcome:  # noqa: B008
    """Write the page of a registered set again, with other limits for what needs a look.

    Example: scape prep page set --config limits.toml

    Args:
        registered: Folder that scape prep run wrote.
    """
    with workspace(registered) as space, space.staging("page") as staged:
        write_set_page(registered, limits, to=staged.folder)
    say(f"written: {registered / PAGE}")
    return Outcome(None, _quality(judge_set(registered, limits)), {"limits": limits})


def _template_marks(template: Path, given: Path | None, body: Mesh, tasks: Sequence[ScanTask], init: Init
                    ) -> dict[str, int]:
    """The landmarks of the template, where any scan is led by landmarks."""
    without = [task.name for task in tasks if task.landmarks is None]
    if init == "pose":
        say("note: no landmarks are used; all scans must be near the template's pose")
        return {}
    if init == "automatic" or (init == "best" and len(without) == len(tasks)):
        say("note: no landmarks are used; look at the page for scans turned round or mirrored")
        return {}
    if without and init == "best":
        say(f"note: no landmarks for {len(without)} of {len(tasks)} scans ({', '.join(without[:LISTED])}); "
            "look at the page for those turned round or mirrored")
    return read_template_landmarks(template, body, given)


def _progress_made(done: Prepared, tasks: Sequence[ScanTask]) -> list[Metric]:
    tree = done.registered.skeleton
    seconds = [f.seconds for f in done.figures if np.isfinite(f.seconds)]
    ways = Counter(f.init.lstrip("0123456789 ") for f in done.figures)        # without the number of landmarks
    return [Metric("scans registered", f"{len(tasks) - len(done.failures)} of {len(tasks)}"),
            Metric("of them in this run", done.fresh),
            *(Metric(f"led by {way}", count) for way, count in sorted(ways.items())),
            Metric("time a scan, mean", float(np.mean(seconds)) if seconds else "", "s"),
            Metric("parts of the skeleton", len(tree.parents) if tree else "none sought")]


def _quality(verdicts: Sequence[Verdict]) -> list[Metric]:
    """Means over the set, and the scans that need a look."""
    suspects = [v for v in verdicts if v.suspect]
    figures = [v.figures for v in verdicts if v.figures is not None]

    def mean(name: str) -> float:
        values = np.array([getattr(f, name) for f in figures], dtype=float)
        return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else np.nan

    return [Metric("distance to the scan, mean", MM * mean("distance"), "mm"),
            Metric("vertices with data, mean", 100 * mean("seen"), "%"),
            Metric("scan off the template, mean", 100 * mean("missed"), "%"),
            Metric("distance of landmarks, mean RMS", MM * mean("landmarks"), "mm"),
            Metric("inverted triangles", sum(f.inverted for f in figures)),
            Metric("scans that need a look", len(suspects)),
            *(Metric(f"  {v.name}", "failed" if v.failed else v.reasons[0]) for v in suspects[:LISTED])]
