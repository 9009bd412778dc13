"""The command `scape demo`."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from scanprep.console import Outcome, bar, say
from scanprep.ranges import Seed

from ..cli import Out
from .chain import QUICK, Demo, DemoConfig


def demo(out: Out = Path("scape_demo"), quick: bool = False, seed: Seed = DemoConfig.seed) -> Outcome:
    """The whole chain on embedded people: scans, registration, skeleton, model, completion, animation.

    Example: scape demo --quick

    Interrupted and started again, it goes on where it was.

    Args:
        out: Folder to write to; report.html in it is the page to open.
        quick: A small run.
        seed: Another seed scans other people.
    """
    from .figures import figures
    from .page import write_page

    run = Demo(out, replace(QUICK if quick else DemoConfig(), seed=seed), bar)
    run.begin()
    metrics = figures(run)
    with bar("drawing the report") as progress:
        write_page(run, metrics, progress)
    say(f"open {out / 'report.html'} in a browser; {out / 'animation' / 'walk.glb'} in any 3D viewer")
    return Outcome(out, metrics, {"demo": run.config})
