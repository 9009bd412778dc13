"""Correct the markers of a `scape mosh` result in the browser, the worst first, and run it again."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from scanprep.batch.pool import Progress, Workers
from scanprep.batch.workspace import HOME, Results, Workspace
from scanprep.console import Metric, Outcome, judgement_of
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement
from scanprep.viewer.app import Send
from scanprep.viewer.clicked import Clicked
from scanprep.viewer.messages import Message
from scanprep.viewer.pick import SCAN
from scanprep.viewer.results import ResultsApp
from scanprep.viewer.surface_clicks import Clickable

from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout
from .call import MoshCall
from .cli import carry_out, describe
from .mended_layout import Spot, apply_corrections, changes, next_file
from .people import FoundPerson, load_people
from .work import ERRORS


@dataclass(frozen=True, eq=False)
class Result:
    """The content of a result folder: figures, people, the worst first, and the layout that was used."""

    call: MoshCall
    rows: dict[str, list[Metric]]
    people: list[FoundPerson]
    usual: MarkerLayout
    template: Mesh

    @staticmethod
    def read(folder: Path, call: MoshCall) -> Result:
        """Read the result of a folder, which need not be open."""
        # people with results, in the order of the page
        models, kept = call.models(), Workspace(folder, folder / HOME)
        names = set(kept.list_results(""))
        actors = [actor for actor in call.actors(folder) if actor.name in names]
        rows = {actor.name: kept.value(actor.name)[0] for actor in actors}
        order = describe(call, models.name).worst_first(Results(rows, {}, ()), rows)
        people = load_people(folder, sorted(actors, key=lambda actor: order.index(actor.name)), models, call.unit,
                             call.rate)
        return Result(call, rows, people, _usual(call, models.neutral, people), models.neutral.template)

    def figures(self, name: str) -> list[Metric]:
        """Return distances of a person's markers from the body: of all, and of those that are trusted."""
        off = next(one.off for one in self.people if one.name == name)
        known = [1000 * far for far in off.values() if np.isfinite(far)] or [np.nan]
        return [Metric("distance of all markers, mean", float(np.mean(known)), "mm"),
                Metric("distance of the worst marker", float(np.max(known)), "mm"),
                *(m for m in self.rows[name] if m.name in (*ERRORS, "markers in the mean distance"))]


class MoshApp(ResultsApp):
    """State of the page on which a result of `scape mosh` is corrected.

    The first pane shows the layout on the model's template. The second shows a person at rest with the markers as they
    were found; here they are moved, exchanged or removed. The third shows a frame. ValueError for a folder without the
    arguments of its call.
    """

    name, title = "mosh", "Mend markers"

    def __init__(self, folder: Path) -> None:
        self.folder, self.frame = folder, 0
        self.before: dict[str, list[Metric]] = {}
        self._begin_with(self.read_results())
        super().__init__(self.template, self.scans, (), fixed=self.template.places)
        self.outside = self.result.call.ask_outside(folder)

    def read_results(self) -> Result:
        """Read what the folder holds now, for the last call."""
        return Result.read(self.folder, MoshCall.read(self.folder))

    def show_results(self, results: Result) -> None:
        """Show new results for the same person and marker, with nothing to undo."""
        person = self.person.name
        self._begin_with(results)
        self.done.clear()
        self.undone.clear()
        self.current = next((i for i, one in enumerate(results.people) if one.name == person), 0)
        self.frame = 0
        self.choose_next(self.chosen)

    def _begin_with(self, result: Result) -> None:
        """Start with a result, and with corrections that were not run yet."""
        self.result, self.file = result, next_file(self.folder, result.call.layout)
        self.spots = changes(result.usual, MarkerLayout.load(self.file)) if self.file.exists() else {}
        self.template = Clicked(Path("layout"), self.file, surface=Clickable(result.template))
        at = result.usual.skin_points(result.template.vertices)
        self.template.places = dict(zip(result.usual.labels, at, strict=True))
        self.scans = [Clicked(Path(one.name), self.file, surface=Clickable(one.body)) for one in result.people]
        self._place()

    @property
    def person(self) -> FoundPerson:
        """The person that is shown."""
        return self.result.people[self.current]

    # what the page is sent

    def scene(self) -> Message:
        """Return the panes: the layout, the person at rest, and a frame."""
        assert self.scan is not None, "a result is of somebody"
        frame = self.person.worst[self.frame]
        panes = [replace(self.template.pane("the layout"), label="where the layout has them"),
                 self.scan.pane(f"{self.person.name}: where they were found"), self.person.pane(frame)]
        return self.pack(panes)

    def judgements(self) -> Iterable[Judgement | None]:
        """Return the judgement of every person."""
        return (judgement_of(self.result.rows[one.name]) or Judgement() for one in self.result.people)

    def more(self) -> dict[str, Any]:
        """Return doubts about markers, the frames, and figures beside those of the run before."""
        person = self.person
        before = {m.name: m.text() for m in self.before.get(person.name, [])}
        changed = [label for label in person.names if self._own(label) in self.spots]
        return {**super().more(),
                "off": {label: 1000 * far for label, far in person.off.items() if np.isfinite(far)},
                "doubts": person.doubts, "changed": changed, "frame": self.frame,
                "frames": [one.told for one in person.worst], "corrected": self.file.name,
                "rows": [[m.name, before.get(m.name, ""), m.text(), m.unit]
                         for m in self.result.figures(person.name)]}

    def choose_next(self, last: str | None, pane: int = SCAN) -> None:
        """Keep the chosen marker; at first choose the worst."""
        self.names = tuple(self.person.names)
        self.chosen = last if last in self.names else self.names[0]

    # what the page sends

    def on_open(self, send: Send, scan: int) -> None:
        """Show another person; unlike scans, people are not read again."""
        if not 0 <= scan < len(self.scans):
            raise ValueError(f"person: expected 0 to {len(self.scans) - 1}, got {scan}")
        if scan != self.current:
            self.current, self.frame, self.opened = scan, 0, self.opened + 1
            self.choose_next(None)
            send(self.scene())

    def on_frame(self, send: Send, frame: int) -> None:
        """Show another of the worst frames."""
        if not 0 <= frame < len(self.person.worst):
            raise ValueError(f"frame: expected 0 to {len(self.person.worst) - 1}, got {frame}")
        self.frame = frame
        send(self.scene())

    def on_exchange(self, send: Send, name: str, other: str) -> None:
        """Exchange two markers with mixed-up labels: each gets the layout's place of the other.

        The places that were found do not count, as they belong to the wrong labels.
        """
        if name == other or not {name, other} <= set(self.person.names):
            raise ValueError("choose two markers of this person, to exchange them")
        self._change(self.current, {name: self._layout_place(other), other: self._layout_place(name)})

    def _layout_place(self, label: str) -> np.ndarray:
        """Return the place of a marker in the layout, as corrected so far, on the shown person."""
        spot = self.spots.get(self._own(label)) or Spot.of(self.result.usual, self._own(label))
        return spot.on(self.person.body)

    def _spot(self, number: int, label: str, place: np.ndarray) -> Spot:
        """Return a place for the layout: that of one of its markers with its distance, or the nearest on the skin."""
        person, usual = self.result.people[number], self.result.usual
        for spot in [*self.spots.values(), *(Spot.of(usual, other) for other in usual.labels)]:
            if spot is not None and np.array_equal(spot.on(person.body), place):
                return spot
        return Spot.at(person.skin, place, Spot.of(usual, self._own(label)).distance)

    def on_run(self, send: Send) -> None:
        """Run the same call with the corrected layout."""
        if self.working is not None:
            return
        if not self.spots:
            raise ValueError("nothing was corrected: move, exchange or take away a marker first")
        call = replace(self.result.call, layout=str(self.file))
        labels = {label for one in self.result.people for label in one.names}
        # ValueError where the corrected layout keeps fewer than the 3 markers that a person needs
        apply_corrections(self.result.usual, self.spots).match_labels(sorted(labels), 3)
        # the figures of this run, before its files are replaced
        before = {one.name: self.result.figures(one.name) for one in self.result.people}

        mended = "scape mosh, mended in the browser"
        def do(space: Workspace, report_progress: Progress) -> tuple[Outcome, str]:
            outcome = carry_out(call, space, Workers(workers=1), mended, lambda done, total: None, report_progress)
            self.before = before
            failed = f"; failed: {'; '.join(outcome.failures)}" if outcome.failures else ""
            return outcome, f"run again with {Path(str(call.layout)).name}{failed}"

        self.do_again("finding shape, markers and motion", mended, do, send, "it could not be run again")

    # the state itself

    def _editable(self, pane: int) -> Clicked:
        """Return the person for edits; the layout cannot be edited."""
        if pane != SCAN:
            raise ValueError("the first body shows the layout as it was; click on the person beside it")
        return super()._editable(pane)

    def _predict_if_time(self, send: Send, pane: int) -> None:
        """Do nothing: markers are not predicted."""

    def _set(self, number: int, places: Mapping[str, np.ndarray | None]) -> None:
        """Set places of markers for a person, and so for all, who share the layout; write the file at once."""
        person = self.result.people[number]
        # a marker at its found place is no correction
        for label, place in places.items():
            original = person.places.get(label)
            if place is None if original is None else place is not None and np.array_equal(place, original):
                self.spots.pop(self._own(label), None)
            else:
                self.spots[self._own(label)] = None if place is None else self._spot(number, label, place)
        self._place()
        if self.spots:
            apply_corrections(self.result.usual, self.spots).save(self.file)
        else:
            self.file.unlink(missing_ok=True)

    def _place(self) -> None:
        """Show the markers of all people as they were found, with the corrections."""
        for person, scan in zip(self.result.people, self.scans, strict=True):
            scan.places = dict(person.places)
            for label in person.names:
                if self._own(label) in self.spots:
                    scan.places.pop(label, None)
                    if (spot := self.spots[self._own(label)]) is not None:
                        scan.places[label] = spot.on(person.body)

    def _own(self, label: str) -> str:
        """Return the layout's name of a marker."""
        return self.result.usual.aliases.get(label, label)


def _usual(call: MoshCall, model: BodyModel, people: list[FoundPerson]) -> MarkerLayout:
    """Return the layout that all people share, as it was before corrections; ValueError for several."""
    names = [call.layout] if call.layout else sorted({one.layout_name for one in people})
    if len(names) > 1:
        raise ValueError(f"the people of this folder wear different sets of markers ({', '.join(names)}); run "
                         "scape mosh for each of them into a folder of its own")
    labels = tuple(dict.fromkeys(label for one in people for label in one.labels))
    return choose_layout(model, names[0], labels)[0]
