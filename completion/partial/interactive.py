"""`scape complete --interactive`: click landmarks on a scan, complete, look, correct, complete again, save.

Built on `scape pick`: the template is the model's, with its landmarks, and a third pane shows the whole body.
"""
from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.batch.opening import workspace
from scanprep.console import Metric, Outcome, write_report
from scanprep.depth_camera.picture import DepthPicture
from scanprep.geometry.files import name_of
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.scene import Pane
from scanprep.viewer.app import Send
from scanprep.viewer.clicked import Clicked
from scanprep.viewer.landmark_names import next_name
from scanprep.viewer.messages import Message
from scanprep.viewer.pick import PickApp
from scanprep.viewer.surface_clicks import Clickable

from .clicked_landmarks import far_apart_first, helpful, landmark_doubts, on_scan, pairs_of
from .clicked_markers import extra_markers, labels_of, write_clicked_markers
from .completion import Completion, complete
from .report import completion_panes
from .work import (
    CompletionInputs,
    CompletionTask,
    ScanFiles,
    completion_figures,
    person_in,
    read_masks,
    read_picture,
    read_scan_views,
    write_results,
)

ENDING = ".landmarks.json"           # of landmark files beside a scan


@dataclass(frozen=True, eq=False)
class Made:
    """A completion and the inputs it was made from."""

    completion: Completion
    files: ScanFiles
    seconds: float                       # run time
    places: Mapping[str, np.ndarray]     # of the landmarks
    known: bool                          # whether the person's shape was known
    masked: np.ndarray | None = None     # (n,) points that are clothing or hair
    stale: bool = False                  # whether its scan or the settings have changed since


class CompleteApp(PickApp):
    """State of `scape complete --interactive`.

    Parameters
    ----------
    model : BodyModel
    work : CompletionTask
        Settings and landmarks of the template; its body is used when the person's shape is known.
    scans : sequence of Path
    output : Path
        Folder for the results, with a folder for each of several scans.
    labels : strings, optional
        Markers on the person, which can be clicked too.
    """

    COMPLETED = "completed.ply"
    FEWEST = 3                           # landmarks that fix position and orientation of a body
    # what to do next, by the verdict
    TOLD: ClassVar[dict[str, str]] = {
        "good": "completed: look at it from all sides, then save; or move or add landmarks and complete again",
        "check": "completed, but look at it: move or add landmarks and complete again, or save",
        "failed": "the completion failed: correct landmarks, then start over"}

    name, title = "complete", "Complete a scan"

    def __init__(self, model: BodyModel, work: CompletionTask, scans: Sequence[Path], output: Path,
                 labels: Sequence[str] = ()) -> None:
        self.model, self.work, self.output = model, work, output
        self._read: dict[Path, ScanFiles | DepthPicture] = {}
        self.made: dict[Path, Made] = {}
        self.saved: dict[Path, Path] = {}
        self.known = isinstance(work.body, Subject)
        self.can_choose = model.n_betas > 0
        # the template with its landmarks, those far apart first, and the scans
        template = Clicked(Path(work.model), output / "template.landmarks.json", surface=Clickable(model.template))
        marks = far_apart_first({name: model.template.vertices[vertex] for name, vertex in work.marks.items()})
        super().__init__(template, [self._load_clicked(path) for path in scans], labels, fixed=marks)

    @property
    def scan(self) -> Clicked:
        """Return the scan that is shown."""
        return self.scans[self.current]

    def _load_clicked(self, path: Path) -> Clicked:
        """Load a scan with its landmarks."""
        body = Clicked.load(path, ENDING, self.work.unit)
        body.surface = self._surface(path)
        return body

    def _load_input(self, path: Path) -> ScanFiles | DepthPicture:
        """Read a file when it is first needed, and keep the content."""
        if path not in self._read:
            self._read[path] = read_picture([path], self.work.unit) or read_scan_views([path], self.work.unit)
        return self._read[path]

    def _surface(self, path: Path) -> Clickable | None:
        """Return the first view of a scan to click on; None for a depth picture, which is shown otherwise."""
        content = self._load_input(path)
        if not isinstance(content, ScanFiles):
            return None
        view = content.views[0]
        return Clickable(view if isinstance(view, Mesh) else view.points)

    def _inputs(self, scan: Clicked) -> CompletionInputs:
        """Return the files of a scan: itself and its landmarks."""
        return CompletionInputs((scan.path,), scan.file)

    def _files(self, path: Path, pairs: tuple[np.ndarray, np.ndarray] | None) -> ScanFiles:
        """Return the views of a scan; in a depth picture the person, which landmarks tell from other people."""
        content = self._load_input(path)
        return content if isinstance(content, ScanFiles) else person_in(content, self.model.template, pairs)

    # what the page is sent

    def scene(self) -> Message:
        """Return the panes: the template, the scan, and the whole body once there is one."""
        panes = [self.template.pane("the model"), self.scan_pane()]
        if (result := self._result_pane()) is not None:
            panes.append(replace(result, label="the whole body"))
        return self.pack(panes)

    def _result_pane(self) -> Pane | None:
        """Return the pane of the completed body, None before there is one."""
        made = self.made.get(self.scan.path)
        if made is None:
            return None
        return completion_panes(list(made.files.views), made.completion, self.model.template, made.masked)[-1]

    def _read_masks(self, scan: Clicked, files: ScanFiles) -> np.ndarray | None:
        """Read which points of a scan (n,) are clothing or hair, None without masks."""
        masks = self._inputs(scan).masks
        return read_masks(masks, files, self.work.unit) if masks else None

    def more(self) -> dict[str, Any]:
        """Return figures and judgement of the completion, and which landmarks would help it."""
        made = self.made.get(self.scan.path)
        markers = extra_markers(self.scan.places, self.work.marks)
        out: dict[str, Any] = {"known": self.known, "can_choose": self.can_choose, "completed": None,
                               "markers": len(markers), "fewest": self.FEWEST}
        if made is None:
            return out
        judgement, saved = made.completion.judgement, self.saved.get(self.scan.path)
        out["completed"] = {
            "verdict": judgement.verdict, "reasons": list(judgement.reasons), "landmarks": len(made.places),
            "rows": [[m.name, m.text(), m.unit] for m in self._figures(made)],
            "outdated": self._is_outdated(made), "helpful": helpful(made.completion, self.work.marks, made.places),
            "saved": str(saved.absolute() / self.COMPLETED) if saved else ""}
        return out

    def _figures(self, made: Made) -> list[Metric]:
        """Return the rows of the closing table."""
        pairs = pairs_of(made.places, self.work.marks)
        return completion_figures(self.work, self._inputs(self.scan), made.completion, pairs, made.masked)

    def _is_outdated(self, made: Made) -> bool:
        """Tell whether landmarks or other inputs have changed since the completion."""
        now = {name: self.scan.places[name] for name in self._usable(self.scan)}
        return made.stale or made.known != self.known or set(now) != set(made.places) or any(
            not np.array_equal(now[name], made.places[name]) for name in now)

    def _usable(self, scan: Clicked) -> list[str]:
        """Return the names of clicked landmarks that the template has too."""
        return [name for name in self.work.marks if name in scan.places]

    # markers that the person wears

    def choose_next(self, last: str | None, pane: int = 1) -> None:
        """Choose the next name, a landmark of the model or a marker, that the scan lacks."""
        done = set(self.scan.places)
        self.chosen = next_name(self.names, done, last) or last or next(iter(self.names), None)

    def on_choose(self, send: Send, name: str) -> None:
        """Choose a name, or add all names of a marker set."""
        labels = labels_of(" ".join(name.split()))
        if labels:
            self._join(labels)
        else:
            super().on_choose(send, name)

    def _join(self, labels: Sequence[str]) -> None:
        """Add labels of markers to the names that can be clicked."""
        self.names = tuple(dict.fromkeys([*self.names, *labels]))
        self.chosen = next((label for label in labels if label not in self.scan.places), self.chosen)

    # what the page sends

    def _predict_if_time(self, send: Send, pane: int) -> None:
        """Do nothing: here the completion predicts landmarks."""

    def on_known(self, send: Send, known: bool) -> None:
        """Set whether the body is the one that the model's poses were learned from."""
        self.known = bool(known) or not self.can_choose

    def on_complete(self, send: Send, anew: bool = False) -> None:
        """Complete the scan, from the last result if that is meaningful; `anew` searches from scratch."""
        if self.working is not None:
            return
        names = self._usable(self.scan)
        if 0 < len(names) < self.FEWEST:
            raise ValueError(f"click at least {self.FEWEST} landmarks, or none")
        made = self.made.get(self.scan.path)
        # go on from the last result if it is of the same kind and did not fail
        on = made is not None and made.known == self.known and names and not anew \
            and not self.work.config.free_scale and made.completion.judgement.verdict != "failed"
        start = made.completion if made is not None and on else None
        scan, known, places = self.scan, self.known, {name: self.scan.places[name] for name in names}

        def work(report_progress: Callable[[int, int], None]) -> str:
            begin, pairs = time.perf_counter(), pairs_of(places, self.work.marks)
            files = self._files(scan.path, pairs)
            done, masked = self._find_body(scan, files, known, pairs, report_progress, start)
            with self._lock:
                self.made[scan.path] = Made(done, files, time.perf_counter() - begin, places, known, masked)
                self.saved.pop(scan.path, None)
                scan.predicted = on_scan(done, self.work.marks, scan.body)
            if scan is self.scan:
                send(self.scene())
            return self.TOLD[done.judgement.verdict]

        self.beside("completing", work, send, "this scan could not be completed")

    def on_doubt(self, send: Send) -> None:
        """Complete without the landmarks, to find those at wrong places."""
        if self.working is not None:
            return
        scan, known, places = self.scan, self.known, {name: self.scan.places[name] for name in self._usable(self.scan)}

        def work(report_progress: Callable[[int, int], None]) -> str:
            files = self._files(scan.path, pairs_of(places, self.work.marks))
            done, _ = self._find_body(scan, files, known, None, report_progress)
            if done.judgement.verdict == "failed":
                return "the body is not found without landmarks either"
            with self._lock:
                scan.predicted = on_scan(done, self.work.marks, scan.body)
            text = landmark_doubts({name: done.scale * place for name, place in places.items()},
                                   {name: done.completed.vertices[vertex] for name, vertex in self.work.marks.items()})
            return text if done.judgement.verdict == "good" else f"{text}; but that body is itself doubtful"

        self.beside("finding the body without the landmarks", work, send, "it could not be found")

    def _find_body(self, scan: Clicked, files: ScanFiles, known: bool, pairs: tuple[np.ndarray, np.ndarray] | None,
                   report_progress: Callable[[int, int], None], start: Completion | None = None
                   ) -> tuple[Completion, np.ndarray | None]:
        """Complete a scan; return the result and its points that are clothing or hair."""
        content, masked = self._load_input(scan.path), self._read_masks(scan, files)
        views = list(content.views) if isinstance(content, ScanFiles) else content
        done = complete(self._body(known), views, pairs, self.work.config, report_progress, masked, start)
        return done, done.not_skin if masked is None else masked

    def _body(self, known: bool) -> BodyModel | Subject:
        """Return the model, or the person of known shape, the template's own body by default."""
        if not known:
            return self.model
        if not isinstance(self.work.body, Subject):
            self.work = replace(self.work, body=self.model.subject(None))
        return self.work.body

    def on_save(self, send: Send) -> None:
        """Write the files that `scape complete` writes."""
        made = self.made.get(self.scan.path)
        if made is None:
            raise ValueError("complete the scan first")
        self.working = ("saving", 0, 1)
        send(self.state())
        try:
            self._save(self.scan, made)
        finally:
            self.working = None

    def _save(self, scan: Clicked, made: Made) -> None:
        """Write the files of a scan into its folder."""
        folder = self.folder_of(scan)
        with workspace(folder) as space, space.staging("completion") as staged:
            self._write(scan, made, staged.folder)
        self.saved[scan.path] = folder
        self.note = f"saved: {folder.absolute() / self.COMPLETED}, and beside it the pose, the shape and a page"

    def folder_of(self, scan: Clicked) -> Path:
        """Return the folder for the results of a scan."""
        return self.output if len(self.scans) == 1 else self.output / name_of(scan.path)

    def _write(self, scan: Clicked, made: Made, folder: Path) -> list[Metric]:
        """Write all files of a completion into a folder and return the figures."""
        rows = write_results(replace(self.work, body=self._body(made.known)), self._inputs(scan), made.files,
                             made.completion, pairs_of(made.places, self.work.marks), made.masked, folder)
        rows += write_clicked_markers(folder, made.completion, extra_markers(scan.places, self.work.marks))
        rows += [Metric("completed", "in the browser"), Metric("shape", "known" if made.known else "found")]
        outcome = Outcome(folder, rows, {"complete": self.work.config}, judgement=made.completion.judgement)
        write_report(outcome, "scape complete --interactive", made.seconds)
        return rows
