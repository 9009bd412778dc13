"""`scape prep run` and `scape prep page`: register a whole folder of scans."""
from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Annotated

import numpy as np

from ..arguments import Place
from ..batch.opening import workspace
from ..batch.workspace import Workspace
from ..cleaning.clean_scan import CleanScanConfig
from ..cli import MM, Output, Person, SetArg
from ..console import Metric, Outcome, bar, say
from ..dataset import RegisteredSet
from ..geometry.mesh import Mesh
from ..registration.figures import Limits, Verdict
from ..skeleton.names import note_numbered_parts
from .again import LISTED, Call, prepare_set
from .page import PAGE, judge_set, judge_whole, write_set_page
from .prepare import PrepareConfig, Prepared, Progress
from .scans import ScanTask

ScansArg = Annotated[Path, Place("SCANS")]


def run_all(scans: ScansArg, template: Path, output: Output, landmarks: Path | None = None,
            template_landmarks: Path | None = None, clean: bool = False, subject: Annotated[str, Person] = "",
            config: PrepareConfig = PrepareConfig(), *, space: Workspace) -> Outcome:
    """Register a template to every scan of a folder, find the skeleton, and write a page of all scans, worst first.

    Killed and started again it goes on where it was; scans whose files have changed are registered anew.

    Example: scape prep run scans --template template.ply -o set

    Args:
        scans: Folder of meshes or point clouds. scans.csv in it may say more: name,subject,pose,sex.
        template: Mesh to bring onto the scans: one closed or bordered manifold component.
        output: Folder of the registered set; open report.html in it.
        landmarks: Folder of landmark files with the names of the scans; else scans/landmarks, or beside the scans; the
            word none leaves them out.
        template_landmarks: Landmarks of the template; else the file of its name beside it.
        clean: Take floor, furniture and specks off each scan before. From scans without landmarks up to a fifth of the
            points is taken off in any case, and the page says how much.
        subject: Whose scans they are, where scans.csv does not say; else each is a person of its own.
    """
    if clean and config.scan.clean is None:
        config = replace(config, scan=replace(config.scan, clean=CleanScanConfig()))
    if Path(config.scan.through).is_file():
        # an absolute path, as the set may be corrected from another folder later
        config = replace(config, scan=replace(config.scan, through=str(Path(config.scan.through).absolute())))
    call = Call(scans, template, landmarks, template_landmarks, subject, config)
    inputs = call.inputs(partial(warnings.warn, stacklevel=2))
    with bar("finding the parts of a person") as naming, bar("registering scans") as registering, \
            bar("finding the skeleton") as finding:
        return carry_out(call, inputs, space, registering, finding, naming)


def carry_out(call: Call, inputs: tuple[list[ScanTask], Mesh, dict[str, int]], space: Workspace,
              *progress: Progress) -> Outcome:
    """Register the scans that have changed into an open set, and keep the call there.

    `progress` are up to four callbacks: scans, skeleton, parts of a person, and the steps inside one scan.
    """
    return summarize(call, len(inputs[0]), prepare_set(call, inputs, space, *progress), space)


def summarize(call: Call, count: int, prepared: Prepared, space: Workspace) -> Outcome:
    """Build the outcome of the command: figures of the set, failures, judgement and next step."""
    verdicts, tree = judge_set(space.folder), prepared.registered.skeleton
    if tree is not None:
        note_numbered_parts(tree)
    seconds = [f.seconds for f in prepared.figures if np.isfinite(f.seconds)]
    ways = Counter(f.init.lstrip("0123456789 ") for f in prepared.figures)     # without their number
    # the closing table: how many, by which method, how fast, how good
    rows = [Metric("scans registered", f"{count - len(prepared.failures)} of {count}"),
            Metric("of them in this run", prepared.fresh),
            *(Metric(f"led by {way}", count) for way, count in sorted(ways.items())),
            Metric("time a scan, mean", float(np.mean(seconds)) if seconds else "", "s"),
            Metric("parts of the skeleton", len(tree.parents) if tree else "none sought"),
            *_quality(verdicts), Metric("unit assumed", call.config.scan.unit or "m")]
    return Outcome(space.folder, rows, {"prepare": call.config}, list(prepared.failures),
                   judgement=judge_whole(verdicts, prepared.registered, parts=prepared.parts),
                   scans={verdict.name: verdict.judgement for verdict in verdicts},
                   following=f"open {quote(str(space.folder / 'report.html'))}, then "
                   f"scape learn --poses {quote(str(space.folder))} --shapes {quote(str(space.folder))} -o model.npz")


def page(registered: SetArg, limits: Limits = Limits()) -> Outcome:
    """Write the page of a registered set again, with other limits for what needs a look.

    Example: scape prep page set --config limits.toml

    Args:
        registered: Folder that scape prep run wrote.
    """
    with workspace(registered) as space, space.staging("page") as staged:
        write_set_page(registered, limits, to=staged.folder)
    say(f"written: {registered / PAGE}")
    verdicts = judge_set(registered, limits)
    return Outcome(None, _quality(verdicts), {"limits": limits},
                   judgement=judge_whole(verdicts, RegisteredSet.load(registered), limits))


def _quality(verdicts: Sequence[Verdict]) -> list[Metric]:
    """Return means over the set, and the scans that need a look."""
    suspects = [v for v in verdicts if v.suspect]
    figures = [v.figures for v in verdicts if v.figures is not None]

    def mean(name: str) -> float:
        """Compute the mean of a figure over the scans that have it; NaN where none has."""
        values = np.array([getattr(f, name) for f in figures], dtype=float)
        return float(values[np.isfinite(values)].mean()) if np.isfinite(values).any() else np.nan

    return [Metric("distance to the scan, mean", MM * mean("distance"), "mm"),
            Metric("surface with data, mean", 100 * mean("seen"), "%"),
            Metric("scan off the template, mean", 100 * mean("missed"), "%"),
            Metric("distance of landmarks, mean RMS", MM * mean("landmarks"), "mm"),
            Metric("inverted triangles", sum(f.inverted for f in figures)),
            Metric("scans that need a look", len(suspects)),
            *(Metric(f"  {v.name}", "failed" if v.failed else v.reasons[0]) for v in suspects[:LISTED])]
