"""Correct a folder of completions in the browser: worst first, move landmarks, complete again from the last result.

Opened by `scape complete SCANS -o FOLDER --interactive`.
"""
from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from model.linear import Subject
from scanprep.batch.opening import workspace
from scanprep.batch.workspace import HOME, Workspace
from scanprep.console import keep_report
from scanprep.folders import judgement_on, load_results
from scanprep.judgement import Judgement
from scanprep.viewer.app import Send
from scanprep.viewer.clicked import Clicked
from scanprep.viewer.messages import Message
from scanprep.viewer.results import ResultsApp

from .clicked_landmarks import on_scan, pairs_of
from .completion import Completion, load_completion
from .folder import FolderCall
from .interactive import ENDING, CompleteApp, Made
from .work import CompletionInputs


class CompletionsApp(ResultsApp, CompleteApp):
    """State of `scape complete SCANS -o FOLDER --interactive`.

    Parameters
    ----------
    call : FolderCall
        The call that made the results; what is saved here counts as done for the same call.
    output : Path
        Folder of the results.
    """

    title, no_result = "Mend completions", "not completed yet"

    def __init__(self, call: FolderCall, output: Path) -> None:
        model, self.plain = call.work(True)
        self.call, self.tasks, self.fresh = call, call.tasks(), set[str]()
        self.told = call.description(output, self.plain.model)
        self._space = Workspace(output, output / HOME)                      # read only
        self.results = load_results(self._space, list(self.tasks))
        self._name_of = {task.given.scans[0]: name for name, task in self.tasks.items()}
        worst = self.told.worst_first(self.results, self.tasks)
        super().__init__(model, self.plain, [self.tasks[name].given.scans[0] for name in worst], output)
        self._bring()

    def _load_clicked(self, path: Path) -> Clicked:
        """Load a scan with the landmarks that the command reads; an unreadable landmark file counts as empty."""
        file, unit = self.tasks[self._name_of[path]].given.landmarks, self.plain.unit
        if file is None:
            return Clicked(path, (self.call.landmarks or path.parent) / (self._name_of[path] + ENDING), unit)
        try:
            return Clicked.load(path, ENDING, unit, file)
        except ValueError:
            return Clicked(path, file, unit)

    def _inputs(self, scan: Clicked) -> CompletionInputs:
        """Return the files of a scan as the command would find them now."""
        return self.tasks[self._name_of[scan.path]].given

    # what is stored

    def _bring(self) -> None:
        """Load the stored completion of the shown scan, if it belongs to this model."""
        scan = self.scan
        if scan.path not in self.made and (folder := self.output / self._name_of[scan.path]).exists():
            try:
                done = load_completion(folder)
                # of this model: as many vertices, parts and betas
                if len(done.completed.vertices) == len(self.model.template.vertices) and len(done.pose) == len(
                        self.model.skeleton.parents) and (done.betas is None or len(done.betas) == self.model.n_betas):
                    self._keep(scan, done, folder)
            except ValueError as error:
                self.note = str(error)
        if (made := self.made.get(scan.path)) is not None:
            self.known = made.known

    def _keep(self, scan: Clicked, done: Completion, folder: Path) -> None:
        """Hold a stored completion with its inputs as if it had been made here."""
        task = self.tasks[self._name_of[scan.path]]
        places = {name: scan.places[name] for name in self._usable(scan)}
        known = done.betas is None or isinstance(self.plain.body, Subject)
        files = self._files(scan.path, pairs_of(places, self.work.marks))
        self.made[scan.path] = Made(done, files, 0.0, places, known, self._read_masks(scan, files),
                                    not self._space.is_done(self.plain, task))
        if scan.surface is None:
            scan.surface = self._surface(scan.path)
        scan.predicted = on_scan(done, self.work.marks, scan.body)
        self.saved[scan.path] = folder

    # what the page is sent

    def scene(self) -> Message:
        """Return the scene of one scan, or only the template where the scan cannot be read."""
        scan = self.scan
        try:
            if scan.surface is None:
                scan.surface = self._surface(scan.path)
            return super().scene()
        except (ValueError, OSError) as error:
            self.note = str(error)
            return self.pack([self.template.pane("the model")])

    def judgements(self) -> Iterable[Judgement | None]:
        """Return the judgement of every scan."""
        return (judgement_on(self._name_of[one.path], self.results) for one in self.scans)

    def more(self) -> dict[str, Any]:
        """Return the state of the page, with the folder."""
        return {**super().more(), "folder": str(self.output)}

    # what the page sends

    def on_open(self, send: Send, scan: int) -> None:
        """Show another scan with its stored result."""
        before = self.current
        if 0 <= scan < len(self.scans) and scan != before:
            self._read.clear()
            self.current = scan
            self._bring()
            self.current = before
        super().on_open(send, scan)

    def _save(self, scan: Clicked, made: Made) -> None:
        """Write the files of the command, so that the scan counts as done there, and renew the folder's page."""
        if self._is_outdated(made):
            raise ValueError("it has changed since: complete again, then save")
        if scan.path in self.saved:
            raise ValueError("it is saved: nothing has changed since")
        name, self.tasks = self._name_of[scan.path], self.call.tasks()        # the landmark file may be new
        if name not in self.tasks:
            raise ValueError(f"{scan.path}: no such file; it was moved meanwhile")
        # put the new files in place of the old ones as a whole, then renew table and page
        with workspace(self.output) as space:
            with space.instead(self.plain, self.tasks[name]) as staged:
                (staged.folder / name).mkdir()
                staged.value = self._write(scan, made, staged.folder / name)
            self.fresh.add(name)
            self.results = load_results(space, list(self.tasks))
            keep_report(space, self.told.write(space, self.results, len(self.tasks)),
                        f"{self.plain.command} --interactive", made.seconds)
        self.saved[scan.path] = self.output / name
        self.note = f"saved in {self.output / name}; the page of the folder is new"
