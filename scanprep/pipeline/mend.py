"""`scape pick SET`: the scans of a registered set, worst first, to correct landmarks and register again.

It extends the clicking of landmarks by a third pane with the template as it lies on the scan.
"""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..batch.room import Progress
from ..batch.workspace import HOME, Task, Workspace
from ..console import Outcome
from ..dataset import RegisteredSet
from ..geometry.format_common import UNKNOWN
from ..geometry.landmark_names import TEN
from ..judgement import Judgement
from ..registration.figures import Verdict
from ..viewer.app import Send
from ..viewer.clicked import Clicked
from ..viewer.messages import Message
from ..viewer.results import ResultsApp
from .again import Call
from .cli import carry_out, summarize
from .page import judge_set, pictures_place
from .prepare import SCANS, name_model, take_rival
from .rivals import has_rival
from .scan import mesh_file
from .scans import ScanTask, means_none


class MendApp(ResultsApp):
    """The state of `scape pick SET`.

    Parameters
    ----------
    folder : Path
        Folder of the set.
    ending : str
        Ending of new landmark files.
    names : tuple of str
        Landmark names to offer beside those that are there already; ten of a person where there are neither.
    """

    name, title = "mend", "Mend a set"
    no_result = "not registered yet"

    def __init__(self, folder: Path, ending: str = ".landmarks.json", names: tuple[str, ...] = ()) -> None:
        self.folder, self.call = folder, Call.read(folder)
        self.outside = self.call.ask_outside(folder)
        if self.call.config.scan.through == "pose" or means_none(self.call.landmarks):
            raise ValueError(f"{folder}: it was made with --through pose or --landmarks none, which use none: "
                             "there are no landmarks to mend")
        results = self.read_results()
        self.tasks = {task.name: task for task in name_model(self.call.tasks(), self.call.config)}
        # worst first; scans without a result come last
        worst = [name for name in results if name in self.tasks]
        self.scan_names = [*worst, *(name for name in self.tasks if name not in results)]
        template = Clicked.load(self.call.template, ending, None, self.call.template_landmarks)
        if self.call.template_landmarks not in (None, template.file):
            raise ValueError(f"{self.call.template_landmarks}: landmarks in this format are read, not written; run "
                             "the command again with them as JSON")
        scans = [self._load_clicked(self.tasks[name], ending) for name in self.scan_names]
        known = any(one.places for one in (template, *scans))
        super().__init__(template, scans, names or (() if known else TEN))
        # numbers of the scans to register again, -1 for the template; and digests of files whose registration is there
        self.changed, self.as_registered = set[int](), dict[int, str]()
        self.show_results(results)

    def _load_clicked(self, task: ScanTask, ending: str) -> Clicked:
        """Load a scan and its landmarks from the file that `scape prep run` reads."""
        unit = self.call.config.scan.unit
        unit = "m" if unit == UNKNOWN else unit               # landmarks are in the numbers of the scan then
        if task.landmarks is not None:
            return Clicked.load(task.scan, ending, unit, task.landmarks)
        return Clicked(task.scan, (self.call.landmarks or task.scan.parent) / (task.name + ending), unit)

    # what the page is sent

    def scene(self) -> Message:
        """Return template and scan, and behind them the packed scene of the registered template."""
        plain = super().scene()
        name = self.scan_names[self.current]
        entries = {entry.name: entry for entry in RegisteredSet.load(self.folder).entries}
        shown = self.folder / pictures_place(entries.get(name)) / f"{name}.scene"
        return Message("scene", {**plain.fields, "first": len(plain.data)},
                       plain.data + (shown.read_bytes() if shown.is_file() else b""))

    def judgements(self) -> Iterable[Judgement | None]:
        """Yield the judgement on every scan, without the path, which the page shows anyway."""
        for name, one in zip(self.scan_names, self.scans, strict=True):
            verdict = self.verdicts.get(name)
            yield None if verdict is None else Judgement(verdict.judgement.verdict, tuple(
                reason.removeprefix(f"{one.path}: ") for reason in verdict.judgement.reasons))

    def more(self) -> dict[str, Any]:
        """Add to the state which scans have changed, and which have a second body to choose from."""
        return {**super().more(), "changed": [self.scan_names[i] for i in sorted(self.changed) if i >= 0],
                "template_changed": -1 in self.changed, "outdated": bool({-1, self.current} & self.changed),
                "set": str(self.folder),
                "rivals": [name in self.rivals for name in self.scan_names]}

    # what the page sends

    def _set(self, number: int, places: Mapping[str, np.ndarray | None]) -> None:
        super()._set(number, places)
        changed = number < 0 or self.digests.of(self._inputs(number)) != self.as_registered.get(number)
        (self.changed.add if changed else self.changed.discard)(number)

    def _inputs(self, number: int) -> ScanTask:
        """Return what is known of a scan now."""
        one = self.scans[number]
        return replace(self.tasks[self.scan_names[number]], landmarks=one.file if one.places else None)

    def on_register(self, send: Send) -> None:
        """Register the changed scans again."""
        if self.working is not None:
            return
        if not self.changed:
            raise ValueError("nothing has changed since the scans were registered")
        template_changed = self.changed & {-1}
        self.changed -= template_changed

        def show_progress(what: str) -> Progress:
            """Return a progress callback that shows one stage on the page."""
            def report_progress(done: int, total: int) -> None:
                self.working = (what, done, total)
                send(self.state())
            return report_progress

        stages = ("registering", "finding the skeleton", "finding the parts of a person", "registering the scan")
        def do(space: Workspace, _: Progress) -> tuple[Outcome, str]:
            inputs = self.call.inputs(lambda line: None)
            outcome = carry_out(self.call, inputs, space, *map(show_progress, stages))
            # how many were registered stands in the closing table
            count = next(metric.value for metric in outcome.metrics if metric.name == "of them in this run")
            return outcome, f"{count} of {len(inputs[0])} scans registered again; the page of the set is new"

        self.do_again(stages[0], f"scape pick {self.folder}", do, send, "nothing was registered",
                      lambda: self.changed.update(template_changed))

    def on_take_rival(self, send: Send) -> None:
        """Swap the shown scan's registration with its second body; doing it again swaps them back."""
        if self.working is not None:
            return
        name = self.scan_names[self.current]

        def do(space: Workspace, _: Progress) -> tuple[Outcome, str]:
            tasks, template, landmarks = self.call.inputs(lambda line: None)
            done = take_rival(tasks, template, landmarks, space.folder, self.call.config, name)
            return summarize(self.call, len(tasks), done, space), "this is the other body; the button takes it back"

        self.do_again("taking the other body", f"scape pick {self.folder}", do, send, "the body stays as it was")

    def read_results(self) -> dict[str, Verdict]:
        """Read the verdicts on the scans of the set, worst first."""
        return {verdict.name: verdict for verdict in judge_set(self.folder)}

    def show_results(self, results: dict[str, Verdict]) -> None:
        """Show new verdicts, and which scans have changed since; the scans keep their order."""
        self.verdicts = results
        # a scan that failed has no result: that of its files now is that it fails
        space, failed = Workspace(self.folder, self.folder / HOME), {v.name for v in results.values() if v.failed}
        self.digests = space.digests
        self.changed &= {-1}
        for number, name in enumerate(self.scan_names):
            inputs = self._inputs(number)
            if name not in failed and space.has_changed(Task(SCANS + name, inputs)):
                self.changed.add(number)
            else:
                self.as_registered[number] = self.digests.of(inputs)
        # the second body lies in the folder of the round that made it; a choice needs the first registration too
        self.rivals = {entry.name for entry in RegisteredSet.load(self.folder).entries
                       if has_rival((self.folder / entry.file).parents[1], entry.name)
                       and (self.folder / mesh_file(entry.name)).is_file()}
