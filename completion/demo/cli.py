"""The command `scape demo`."""
from __future__ import annotations

from pathlib import Path
from shlex import quote

from scanprep.arguments import UsageError
from scanprep.batch.workspace import Workspace
from scanprep.console import Outcome, bar
from scanprep.ranges import Seed

from ..cli import Out
from .chain import FULL, MODEL, QUICK, USUAL, Demo


def demo(out: Out = Path("scape_demo"), quick: bool = False, full: bool = False, seed: Seed = 0, *,
         space: Workspace) -> Outcome:
    """The whole chain on the built-in people: scans, registration, skeleton, model, completion, animation.

    Example: scape demo

    About three minutes on two cores. Interrupted and started again, it goes on where it was; with other settings it
    does anew what depends on them.

    Args:
        out: Folder to write to; report.html in it is the page to open.
        quick: A small run.
        full: A large run: more scans, finer.
        seed: Another seed scans other people.
    """
    from .figures import judge_demo, measure_demo
    from .page import write_page

    if quick and full:
        raise UsageError("--quick, --full: expected at most one of the two")
    amounts = USUAL
    if quick or full:
        amounts = QUICK if quick else FULL
    run = Demo(space, amounts, seed, bar)
    metrics = measure_demo(run)
    judgement = judge_demo(run)
    with bar("drawing the report") as progress, space.staging("page") as staged:
        write_page(run, metrics, judgement, progress, staged.folder)
    return Outcome(out, metrics, {"demo": amounts, "seed": seed, "model": MODEL}, judgement=judgement,
                   following=f"open {quote(str(out / 'report.html'))} in a browser; then your own scans: "
                   "scape prep run scans --template template.ply -o set")
