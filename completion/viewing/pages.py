"""Pages that are reached from the view: which things offer which, and the apps that were opened."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from model.body import BodyModel
from scanprep.pipeline.again import RUN
from scanprep.viewer.app import App, Send
from scanprep.viewer.clicked import Clicked
from scanprep.viewer.dropped import Dropped

from ..partial.interactive import ENDING, CompleteApp
from ..partial.settings import CompletionConfig
from ..partial.work import Work, marks_of_template
from .files import SET, Entry, Files
from .saving import free_name

PEOPLE = "synthetic people"          # the model of those who have none
Progress = Callable[[int, int], None]
SCANS = ("surface", "picture")       # kinds of entries that can be completed


@dataclass(frozen=True)
class FolderPage:
    """A page that folders offer: what its button says, whether a folder is one of them, and how its app is made."""

    label: str
    offered: Callable[[Path], bool]
    make: Callable[[Path], App]


def _mend(folder: Path) -> App:
    from scanprep.pipeline.mend import MendApp

    return MendApp(folder, ENDING)


def _has(*names: str) -> Callable[[Path], bool]:
    return lambda folder: all((folder / name).is_file() for name in names)


FOLDER_PAGES = {"mend": FolderPage("mend landmarks of", _has(SET, RUN), _mend)}


class CompletePage(CompleteApp):
    """Completion inside of the view: each body that is saved gets a folder of its own beside what is there."""

    def __init__(self, model: BodyModel, work: Work, output: Path, dropped: Dropped) -> None:
        super().__init__(model, work, (), output, dropped=dropped)
        self.entries: dict[Path, Entry] = {}
        self._folders: dict[Path, Path] = {}
        self.fresh: list[Path] = []                       # folders written since the view was last shown

    def open(self, entry: Entry) -> None:
        """Show a scan; as it was left, unless its file is another one now."""
        if self.entries.get(entry.path) is not entry:
            self.entries[entry.path] = entry
            self.take(entry.path)
        self.on_open(lambda message: None, [one.path for one in self.scans].index(entry.path))

    def folder_of(self, scan: Clicked) -> Path:
        """Where the body of a scan is saved."""
        if scan.path not in self._folders:
            self._folders[scan.path] = free_name(self.output / f"{scan.path.name.split('.')[0]}_completed")
        return self._folders[scan.path]

    def on_save(self, send: Send) -> None:
        """Write what `scape complete` writes."""
        super().on_save(send)
        assert self.scan is not None
        self.fresh.append(self.saved[self.scan.path])


class Inside:
    """The pages of a view; each is kept as it was left.

    Parameters
    ----------
    files : Files
    output : folder for what is saved
    dropped : files that were dropped on the view, which pages may be given
    """

    def __init__(self, files: Files, output: Path, dropped: Dropped) -> None:
        self.files, self.output, self.dropped = files, output, dropped
        self.opened: dict[tuple[str, Path | None], App] = {}

    def offered(self, entries: Sequence[Entry]) -> dict[str, Any]:
        """What the buttons are: pages of folders, and the scans and models of a completion, by number of the entry."""
        folders = [(folder, page, one) for folder in self.files.folders(entries)
                   for page, one in FOLDER_PAGES.items() if one.offered(folder)]
        return {"folders": [{"page": page, "folder": str(folder), "label": f"{one.label} {folder.resolve().name}"}
                            for folder, page, one in folders],
                "scans": [i for i, entry in enumerate(entries) if entry.kind in SCANS],
                "models": [{"path": "", "name": PEOPLE},
                           *({"path": str(path), "name": path.name} for path in self.files.models)]}

    def enter(self, entries: Sequence[Entry], wanted: Mapping[str, Any], progress: Progress) -> App:
        """What was asked for of things: a page of a folder, or the completion of a scan.

        `wanted` has "what", the page, and either "folder", or "scan", its number, and "model", a file or "".
        """
        if wanted["what"] == "complete":
            return self._completion(entries[int(wanted["scan"])], wanted["model"], progress)
        what, known = wanted["what"], self.files.folders(entries)
        folder = next((folder for folder in known if str(folder) == wanted["folder"]), None)
        if what not in FOLDER_PAGES or folder is None:
            raise ValueError(f"page: expected one that the list of things offers, got {what} of {wanted['folder']}")
        if (what, folder) not in self.opened:
            self.opened[what, folder] = FOLDER_PAGES[what].make(folder)
        return self.opened[what, folder]

    def _completion(self, scan: Entry, model: str, progress: Progress) -> App:
        if scan.kind not in SCANS:
            raise ValueError(f"{scan.name}: expected a scan, found {scan.kind}")
        path = next((path for path in self.files.models if str(path) == model), None)
        if path is None and model:
            raise ValueError(f"model: expected one that is among the things, got {model}")
        if ("complete", path) not in self.opened:
            self.opened["complete", path] = self._complete_page(path, progress)
        page = self.opened["complete", path]
        assert isinstance(page, CompletePage)
        page.open(scan)
        return page

    def _complete_page(self, path: Path | None, progress: Progress) -> CompletePage:
        if path is None:
            from ..synthetic_people import synthetic_model

            model, name = synthetic_model(progress), PEOPLE
        else:
            model, name = self.files.read_model(path), str(path)
        body = model if model.n_betas else model.subject(None)
        work = Work(body, name, marks_of_template(model, None, name), CompletionConfig(), self.files.unit)
        return CompletePage(model, work, self.output, self.dropped)

    @property
    def completions(self) -> list[CompletePage]:
        """Those that were opened."""
        return [page for page in self.opened.values() if isinstance(page, CompletePage)]

    def written(self, app: App) -> list[Path]:
        """Folders that a page has written to since this was last asked."""
        if isinstance(app, CompletePage):
            fresh, app.fresh = app.fresh, []
            return list(dict.fromkeys(fresh))
        return [folder for (_, folder), other in self.opened.items() if other is app and folder is not None]
