"""Pages opened from the view: which things offer which, and the apps that were opened."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from model.body import BodyModel
from scanprep.batch.calls import command_of
from scanprep.command_line import load_command
from scanprep.viewer.app import App
from scanprep.viewer.clicked import Clicked
from scanprep.viewer.dropped import Dropped

from ..cli import marks_of_template
from ..partial.interactive import CompleteApp, Made
from ..partial.settings import CompletionConfig
from ..partial.work import CompletionTask
from .files import Entry, Files
from .saving import free_name

Progress = Callable[[int, int], None]


# Commands whose results can be corrected: text of the button, and the app for the folder.
MENDED: Mapping[str, tuple[str, str]] = {
    "scape prep run": ("mend landmarks of", "scanprep.pipeline.mend:MendApp"),
    "scape complete": ("mend landmarks of", "completion.partial.mend:mend_completions"),
    "scape mosh": ("mend markers of", "completion.mocap.mosh.mend:MoshApp")}


class CompletePage(CompleteApp):
    """Completion inside the view: each saved body gets a new folder of its own."""

    def __init__(self, model: BodyModel, work: CompletionTask, output: Path, dropped: Dropped) -> None:
        super().__init__(model, work, (), output, dropped=dropped)
        self.entries: dict[Path, Entry] = {}
        self._folders: dict[Path, Path] = {}
        self.fresh: list[Path] = []                       # folders written since the view was last shown

    def open(self, entry: Entry) -> None:
        """Show a scan, as it was left unless its file has changed."""
        if self.entries.get(entry.path) is not entry:
            self.entries[entry.path] = entry
            self.take(entry.path)
        self.on_open(lambda message: None, [one.path for one in self.scans].index(entry.path))

    def folder_of(self, scan: Clicked) -> Path:
        """Return the folder in which the body of a scan is saved."""
        if scan.path not in self._folders:
            self._folders[scan.path] = free_name(self.output / f"{scan.path.name.split('.')[0]}_completed")
        return self._folders[scan.path]

    def _save(self, scan: Clicked, made: Made) -> None:
        super()._save(scan, made)
        self.fresh.append(self.saved[scan.path])


class Inside:
    """The pages of a view; each keeps its state.

    Parameters
    ----------
    files : Files
        The files of the view.
    output : Path
        Folder for what is saved.
    dropped : Dropped
        Files dropped on the view, which pages may use.
    """

    PEOPLE = "built-in people"           # name of the model for people who have none
    SCANS = ("surface", "picture")       # kinds of entries that can be completed

    def __init__(self, files: Files, output: Path, dropped: Dropped) -> None:
        self.files, self.output, self.dropped = files, output, dropped
        self.opened: dict[tuple[str, Path | None], App] = {}

    def list_buttons(self, entries: Sequence[Entry]) -> dict[str, Any]:
        """List the buttons: pages of folders, and scans and models for a completion."""
        commands = {folder: command_of(folder) for folder in self.files.folders(entries)}
        return {"folders": [{"page": "mend", "folder": str(folder),
                             "label": f"{MENDED[command][0]} {folder.resolve().name}"}
                            for folder, command in commands.items() if command in MENDED],
                "scans": [i for i, entry in enumerate(entries) if entry.kind in self.SCANS],
                "models": [{"path": "", "name": self.PEOPLE},
                           *({"path": str(path), "name": path.name} for path in self.files.models)]}

    def enter(self, entries: Sequence[Entry], progress: Progress, what: str, folder: str = "", scan: int = -1,
              model: str = "") -> App:
        """Open the page `what`: of a folder, or the completion of a scan, by its number, with a model, a file or ""."""
        if what == "complete":
            if not 0 <= scan < len(entries):
                raise ValueError(f"scan: expected 0 to {len(entries) - 1}, got {scan}")
            return self._completion(entries[scan], model, progress)
        place = next((place for place in self.files.folders(entries) if str(place) == folder), None)
        command = "" if place is None else command_of(place)
        if what != "mend" or place is None or command not in MENDED:
            raise ValueError(f"page: expected one that the list of things offers, got {what} of {folder}")
        if (what, place) not in self.opened:
            self.opened[what, place] = load_command(MENDED[command][1])(place)
        return self.opened[what, place]

    def _completion(self, scan: Entry, model: str, progress: Progress) -> App:
        """Open the page that completes scans with a model, and show a scan there."""
        if scan.kind not in self.SCANS:
            raise ValueError(f"{scan.name}: expected a scan, found {scan.kind}")
        path = next((path for path in self.files.models if str(path) == model), None)
        if path is None and model:
            raise ValueError(f"model: expected one that is among the things, got {model}")
        page = self.opened.get(("complete", path))
        if not isinstance(page, CompletePage):
            if path is None:
                from model.files import BUILT_IN, load_model

                loaded, name = load_model(BUILT_IN), self.PEOPLE
            else:
                loaded, name = self.files.read_model(path), str(path)
            body = loaded if loaded.n_betas else loaded.subject(None)
            work = CompletionTask(body, name, marks_of_template(loaded, None, name), CompletionConfig(),
                                  self.files.unit)
            page = self.opened["complete", path] = CompletePage(loaded, work, self.output, self.dropped)
        page.open(scan)
        return page

    @property
    def completions(self) -> list[CompletePage]:
        """The completion pages that were opened."""
        return [page for page in self.opened.values() if isinstance(page, CompletePage)]

    def folders_written(self, app: App) -> list[Path]:
        """Return folders that a page has written to since the last call."""
        if isinstance(app, CompletePage):
            fresh, app.fresh = app.fresh, []
            return list(dict.fromkeys(fresh))
        return [folder for (_, folder), other in self.opened.items() if other is app and folder is not None]
