"""`scape pick SET`: the scans of a registered set worst first; their landmarks are mended, and they registered again.

Built on the clicking of landmarks: a third pane shows the template as it lies on the scan.
"""
from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..batch.opening import workspace
from ..console import write_report
from ..viewer.app import Send
from ..viewer.clicked import Clicked
from ..viewer.messages import Message
from ..viewer.pick import PickApp
from .again import Call
from .cli import carried_out
from .figures import Verdict
from .page import PICTURES, judge_set
from .scans import ScanTask

LEDS = ("best", "landmarks")             # ways to begin that landmarks lead
WORK = ("registering", "finding the skeleton", "finding the parts of a person", "registering the scan")


class MendApp(PickApp):
    """The state of `scape pick SET`.

    Parameters
    ----------
    folder : of the set
    ending : of new landmark files
    names : offered beside those that are there already
    """

    name, title = "mend", "Mend a set"

    def __init__(self, folder: Path, ending: str, names: tuple[str, ...] = ()) -> None:
        self.folder, self.call = folder, Call.read(folder)
        if self.call.config.scan.init not in LEDS:
            raise ValueError(f"{folder}: it was made with --init {self.call.config.scan.init}, which uses none: "
                             "there are no landmarks to mend")
        self.verdicts = {verdict.name: verdict for verdict in judge_set(folder)}
        tasks = {task.name: task for task in self.call.tasks()}
        worst = [name for name in self.verdicts if name in tasks]
        self.scan_names = [*worst, *(name for name in tasks if name not in self.verdicts)]
        self.changed: set[int] = set()
        template = Clicked.found(self.call.template, ending, None, self.call.template_landmarks)
        super().__init__(template, [self._clicked(tasks[name], ending) for name in self.scan_names], names)

    def _clicked(self, task: ScanTask, ending: str) -> Clicked:
        """A scan and its landmarks, in the file that `scape prep run` reads."""
        unit = self.call.config.scan.unit
        if task.landmarks is not None:
            return Clicked.found(task.scan, ending, unit, task.landmarks)
        return Clicked(task.scan, (self.call.landmarks or task.scan.parent) / (task.name + ending), unit)

    # what the page is sent

    def scene(self) -> Message:
        """Template, scan, and behind them, packed as the page of the set has it, the template on the scan."""
        plain = super().scene()
        shown = self.folder / PICTURES / f"{self.scan_names[self.current]}.scene"
        return Message("scene", {"first": len(plain.data)},
                       plain.data + (shown.read_bytes() if shown.is_file() else b""))

    def more(self) -> dict[str, Any]:
        """What is to be thought of each scan, and which have been changed."""
        names = [self.scan_names[i] for i in sorted(self.changed) if i >= 0]
        told = [_told(self.verdicts.get(name), one.path)
                for name, one in zip(self.scan_names, self.scans, strict=True)]
        return {"verdicts": told,
                "changed": names, "template_changed": -1 in self.changed, "set": str(self.folder)}

    # what the page sends

    def _set(self, number: int, places: Mapping[str, np.ndarray | None]) -> None:
        super()._set(number, places)
        self.changed.add(number)

    def on_register(self, send: Send) -> None:
        """Register again what has changed."""
        if self.working is not None:
            return
        before, self.changed = self.changed, set()

        def telling(what: str) -> Any:
            def tell(done: int, total: int) -> None:
                self.working = (what, done, total)
                send(self.state())
            return tell

        def work(tell: Any) -> str:
            try:
                note = self._again([telling(what) for what in WORK])
            except Exception:
                with self._lock:
                    self.changed |= before
                raise
            verdicts = {verdict.name: verdict for verdict in judge_set(self.folder)}
            with self._lock:
                self.verdicts = verdicts
                scene = self.scene()
            send(scene)
            return note

        self.beside(WORK[0], work, send, "nothing was registered")

    def _again(self, tell: list[Any]) -> str:
        """The run itself; the set is open, and closed to other runs, only meanwhile."""
        begin = time.perf_counter()
        given = self.call.inputs(lambda line: None)
        with workspace(self.folder) as space:
            outcome = carried_out(self.call, given, space, *tell)
            with space.staging("report") as staged:
                write_report(replace(outcome, output=staged.folder), f"scape pick {self.folder}",
                             time.perf_counter() - begin)
        fresh = next(metric.value for metric in outcome.metrics if metric.name == "of them in this run")
        return f"{fresh} of {len(given[0])} scans registered again; the page of the set is new"


def _told(verdict: Verdict | None, scan: Path) -> dict[str, Any]:
    """A verdict in words; the path of a scan that is shown need not be said."""
    if verdict is None:
        return {"verdict": "new", "reasons": ["not registered yet"]}
    reasons = [reason.removeprefix(f"{scan}: ") for reason in verdict.judgement.reasons]
    return {"verdict": verdict.judgement.verdict, "reasons": reasons}
