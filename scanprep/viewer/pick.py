"""Click landmarks in the browser: `scape pick`; `scape complete --interactive` builds on it.

The page sends rays and names. Where a ray meets the surface is computed here, and every change is saved at once. The
page gets the whole state, which is small, so that a second or reloaded tab shows the same.
"""
from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..console import say
from ..depth_camera.picture import is_picture
from ..geometry.landmark_names import landmark_name, pair_names
from ..geometry.mesh import Mesh
from ..geometry.sides import other_side
from ..judgement import extent
from ..pictures.scene import Pane, pack_scene
from ..words import explain_os_error, number_of
from .app import Send, Stopped
from .clicked import Clicked, Places, camera_like, camera_of, predict_landmarks
from .landmark_names import next_name
from .messages import Message, call_action, find_action

TEMPLATE, SCAN = 0, 1                # numbers of the panes on the page


@dataclass(frozen=True)
class Change:
    """Landmarks of one body before and after a change; None where there was none."""

    body: int
    before: Mapping[str, np.ndarray | None]
    after: Mapping[str, np.ndarray | None]
    drag: int = 0                        # number of the drag that it is part of; 0 for a click


class PickApp:
    """The state of `scape pick`: a template, scans one after the other, names, and changes to undo."""

    ENOUGH = 4                           # landmarks needed to predict the others: errors were measured with four

    name, title = "pick", "Landmarks"

    def __init__(self, template: Clicked, scans: Sequence[Clicked], names: Sequence[str],
                 fixed: Mapping[str, np.ndarray] | None = None) -> None:
        self.template, self.scans, self.current = template, list(scans), 0
        if fixed is not None:                                    # landmarks of a model: they cannot be changed
            template.places = dict(fixed)
        self.fixed = fixed is not None
        known = list(dict.fromkeys([*template.places, *(name for scan in self.scans for name in scan.places)]))
        known_meanings = {landmark_name(name) for name in known}
        self.names = (*known, *(name for name in names if landmark_name(name) not in known_meanings))
        self.building = not template.places        # it has none yet: its landmarks are clicked first
        self.alternating: int | None = None                      # pane on which the chosen name was clicked last
        self.question: dict[str, Any] | None = None              # about a click far from where it was expected
        self.depth: dict[str, Any] | None = None                 # where the ray of the last click is inside the body
        self.done: list[Change] = []
        self.undone: list[Change] = []
        self.chosen: str | None = None
        self.opened = 0                  # how often another scan was opened: the page then fits its cameras anew
        self.working: tuple[str, int, int] | None = None
        self.note = ""
        self._lock = threading.RLock()
        self.choose_next(None)

    # what the page is sent

    @property
    def scan(self) -> Clicked | None:
        """Return the scan that is shown, if any."""
        return self.scans[self.current] if self.scans else None

    def greet(self) -> list[Message]:
        """Return the bodies and the state."""
        with self._lock:
            return [self.scene(), self.state()]

    def scene(self) -> Message:
        """Return all panes."""
        panes = [self.template.pane(self.template.path.name)]
        if self.scan is not None:
            panes.append(self.scan_pane())
        return self.pack(panes)

    def pack(self, panes: Sequence[Pane]) -> Message:
        """Pack panes into a message."""
        return Message("scene", {"opened": self.opened}, pack_scene(panes))

    def scan_pane(self) -> Pane:
        """Return the shown scan, seen from the same side as the template."""
        assert self.scan is not None
        pane = self.scan.pane(self.scan.path.name)
        if is_picture(self.scan.path):
            return pane
        pairs = pair_names(self.template.places, self.scan.places)
        # names may be spelt differently on scan and template, so they are paired by meaning
        landmarks = None
        if len(pairs) >= self.ENOUGH:
            landmarks = (np.array([self.template.places[on_template] for on_template, _ in pairs]),
                         np.array([self.scan.places[on_scan] for _, on_scan in pairs]))
        return replace(pane, camera=camera_like(camera_of(self.template.body.shape), self.scan.body.shape, landmarks))

    def state(self) -> Message:
        """Return everything but the bodies."""
        with self._lock:
            shown = [self.template, *([self.scan] if self.scan else [])]
            return Message("state", {
                "names": list(self.names), "chosen": self.chosen, "fixed": self.fixed, "note": self.note,
                "panes": [{"places": _lists(one.places), "predicted": _lists(one.predicted), "file": one.file.name}
                          for one in shown],
                "scan": self.current,
                "scans": [{"name": one.path.name, "count": len(one.places)} for one in self.scans],
                "undo": bool(self.done), "redo": bool(self.undone), "working": self.working, "question": self.question,
                "pair": self._pair(), "can_swap": self.scan is not None and any(map(other_side, self.scan.places)),
                "can_predict": self._can_predict(), **self.more()}, latest="state")

    def _pair(self) -> str | None:
        """Return the landmark of the other side, where the scan has the chosen one and that."""
        other = other_side(self.chosen or "")
        return other if self.scan is not None and {self.chosen, other} <= set(self.scan.places) else None

    def _can_predict(self) -> bool:
        """Return whether the scan lacks landmarks of the template, and has enough others for a registration."""
        template, scan = self.template, self.scan
        common = sum(name in scan.places for name in template.places) if scan else 0
        return self.ENOUGH <= common < len(template.places) and template.body.has_surface

    def more(self) -> dict[str, Any]:
        """Return what an app built on this one adds to the state."""
        return {}

    # what the page sends

    def handle(self, message: Message, send: Send) -> None:
        """Act on a click, key or button; every change is saved before the page gets the new state."""
        action = find_action(self, message.kind)
        with self._lock:
            self.note, self.question = "", None
            self.depth = self.depth if message.kind == "slide" else None
            call_action(action, message.fields, send)
        send(self.state())

    def on_place(self, send: Send, pane: int, name: str, origin: list[float], direction: list[float],
                 inside: bool = False, seen: list[float] | None = None, drag: int = 0) -> None:
        """Place a landmark where a ray meets the surface; with `inside`, half way to where the ray leaves the body.

        The places of one drag, which has a number, are undone together. After a click on one pane the same name is
        next on the other pane; a second click on the same pane sets the next name.
        """
        clicked = self._editable(pane)
        if not drag and name == self.chosen and self.alternating == pane:
            # second click on the same pane: it is for the next name
            offered = self.names if pane == TEMPLATE or self.building else self._of_template()
            name = next_name(offered, set(clicked.places), name) or name
        body, ray = clicked.body, (as_point(origin), as_direction(direction))
        place = body.middle(*ray) if inside else body.hit(*ray)
        if place is None and seen is not None:       # the page draws a simplified surface: only that was hit
            place = body.nearest(as_point(seen))
        if place is None:
            self.note = "the click met nothing: turn the body so that the place faces you"
            return
        self.building |= pane == TEMPLATE
        self._change(self._number(pane), {self._scan_named(name): place}, drag)
        # share of a scan's size, 13 cm on a person: of 192 landmarks predicted from four the worst was 7 cm off; left
        # and right of one kind are at least 15 cm apart, only the eyes 7 cm
        far = 0.06
        if not drag:
            self.choose_next(name, pane)
            # ask back when a click is far from the prediction, probably on the wrong side
            expected = clicked.predicted.get(name)
            distance = 0.0 if expected is None else float(np.linalg.norm(place - expected))
            if pane == SCAN and distance > far * extent(clicked.body.points):
                self.chosen, self.alternating = name, None
                self.question = {"name": name, "away": distance,
                                 "text": f"This is {100 * distance:.0f} cm from where “{name}” was expected: keep it?"}
        self._predict_if_time(send, pane)

    def on_keep(self, send: Send, name: str) -> None:
        """Keep a questioned landmark where it is."""
        self.choose_next(name, SCAN)

    def on_slide(self, send: Send, pane: int, name: str, direction: list[float], by: float) -> None:
        """Move a landmark along a ray by `by` metres: into the body, to where a joint is."""
        places = self._editable(pane).places
        if name not in places:
            raise ValueError(f"name: expected a landmark that was clicked, got {name}")
        place = places[name] + by * as_direction(direction)
        self._change(self._number(pane), {name: place}, -1)         # -1: consecutive keystrokes are undone together

    def on_remove(self, send: Send, pane: int, name: str) -> None:
        """Remove a landmark."""
        if name in self._editable(pane).places:
            self._change(self._number(pane), {name: None})
            self.note = f"{name} is taken away; a click sets it again, undo brings it back"
        self.chosen = name

    def on_swap(self, send: Send, name: str | None = None) -> None:
        """Exchange left and right on the scan, the most frequent error in landmarks; it can be undone.

        With a name only this landmark is exchanged with that of the other side.
        """
        one = self._editable(SCAN)
        names = [each for each in one.places if name is None or name in (each, other_side(each))]
        others = {each: other for each in names if (other := other_side(each)) is not None}
        after = {other: one.places[each] for each, other in others.items()}
        if not after:
            raise ValueError("no landmark of the scan names a side")
        self._change(self.current, {**after, **{each: None for each in others if each not in after}})
        if name is None:
            one.predicted = {other_side(each) or each: place for each, place in one.predicted.items()}

    def on_choose(self, send: Send, name: str) -> None:
        """Choose the landmark that the next click sets; a new name joins the list."""
        self.chosen, self.alternating = self._scan_named(name), None

    def on_open(self, send: Send, scan: int) -> None:
        """Show another scan."""
        if not 0 <= scan < len(self.scans):
            raise ValueError(f"scan: expected 0 to {len(self.scans) - 1}, got {scan}")
        if scan != self.current:
            self.scans[self.current].forget()
            self.current, self.opened = scan, self.opened + 1
            self.choose_next(None)
            send(self.scene())

    def on_undo(self, send: Send) -> None:
        """Undo the last change."""
        self._step(self.done, self.undone, back=True, send=send)

    def on_redo(self, send: Send) -> None:
        """Redo the change that was undone last."""
        self._step(self.undone, self.done, back=False, send=send)

    def on_confirm(self, send: Send, names: list[str]) -> None:
        """Accept predicted landmarks as they are."""
        pane = TEMPLATE if self.scan is None else SCAN
        body = self._editable(pane)
        accepted = {name: body.predicted[name] for name in names if name in body.predicted}
        if accepted:
            self._change(self._number(pane), accepted)
            self.choose_next(None)
            self.note = f"{len(accepted)} taken as predicted; undo takes them back"

    def on_predict(self, send: Send) -> None:
        """Predict the other landmarks of the template on the scan."""
        if self.scan is not None:
            self._predict(self.scan, send)

    # the state itself

    def choose_next(self, last: str | None, pane: int = SCAN) -> None:
        """Choose the name for the next click: the same where the other pane lacks it, else the next missing one.

        Names that came with landmarks of scans but are not on the template are offered only after a click on the
        template.
        """
        template, scan, self.alternating = self.template.places, self.scan.places if self.scan else {}, None
        other = scan if pane == TEMPLATE else template
        if self.scan is not None and not self.fixed and last in (template if pane == TEMPLATE else scan) and \
                last not in other and (pane == TEMPLATE or self.building):
            self.chosen, self.alternating = last, pane
            return
        if self.scan is None:
            offered, complete = self.names, set(template)
        else:
            offered, complete = self.names if self.building else self._of_template(), set(template) & set(scan)
        self.chosen = next_name(offered, complete, last) or last or (self.names[0] if self.names else None)

    def _of_template(self) -> tuple[str, ...]:
        """Return the names that the template has."""
        return tuple(name for name in self.names if name in self.template.places)

    def _number(self, pane: int) -> int:
        """Return the number of a pane's body: -1 for the template, else that of the scan."""
        return -1 if pane == TEMPLATE else self.current

    def _editable(self, pane: int) -> Clicked:
        """Return the body of a pane; ValueError where it cannot be changed."""
        if pane == TEMPLATE and self.fixed:
            raise ValueError("the landmarks of the model are fixed; click on the scan")
        if pane not in (TEMPLATE, SCAN) or (pane == SCAN and self.scan is None):
            raise ValueError(f"pane: expected 0, the template, or 1, the scan, got {pane}")
        return self.template if pane == TEMPLATE else self.scans[self.current]

    def _scan_named(self, name: str) -> str:
        """Return a name without superfluous blanks; a new one joins the list."""
        name = " ".join(str(name).split())[:200]
        if not name:
            raise ValueError("a landmark needs a name")
        if name not in self.names:
            self.names = (*self.names, name)
        return name

    def _change(self, number: int, after: Mapping[str, np.ndarray | None], drag: int = 0) -> None:
        """Set landmarks, save them, and remember the former ones for undo; one drag is one change."""
        places = (self.template if number < 0 else self.scans[number]).places
        before = {name: places.get(name) for name in after}
        last = self.done[-1] if self.done else None
        if drag and last and (last.drag, last.body, *last.after) == (drag, number, *after):
            # a further step of the same drag: keep where it began
            before = dict(self.done.pop().before)
        self.done.append(Change(number, before, after, drag))
        self.undone.clear()
        self._set(number, after)

    def _set(self, number: int, places: Mapping[str, np.ndarray | None]) -> None:
        """Set or remove landmarks of a body and save them."""
        one = self.template if number < 0 else self.scans[number]
        for name, place in places.items():
            if place is None:
                one.places.pop(name, None)
            else:
                one.places[name] = place
        one.save()

    def _step(self, source: list[Change], target: list[Change], back: bool, send: Send) -> None:
        """Move the last change from one list to the other, and undo or redo it."""
        if source:
            change = source.pop()
            target.append(change)
            if change.body >= 0 and change.body != self.current:
                self.on_open(send, change.body)
            self._set(change.body, change.before if back else change.after)
            self.chosen = next(iter(change.after))

    # what registration says of the landmarks that are missing

    def _predict_if_time(self, send: Send, pane: int) -> None:
        """Predict when a scan has just got enough landmarks, and the template has more."""
        scan = self.scan
        if pane == SCAN and scan is not None and not scan.predicted and self.working is None and self._can_predict() \
                and sum(name in scan.places for name in self.template.places) == self.ENOUGH:
            self._predict(scan, send)

    def _predict(self, clicked: Clicked, send: Send) -> None:
        """Predict the missing landmarks of a scan in a thread of its own."""
        template = self.template.body.shape
        if not self._can_predict() or not isinstance(template, Mesh):
            raise ValueError(
                f"click {self.ENOUGH} landmarks that the template has too, then the others can be predicted")
        if self.working is not None:
            return
        on_template, on_scan, body = dict(self.template.places), dict(clicked.places), clicked.body

        def work(report_progress: Callable[[int, int], None]) -> str:
            predicted = predict_landmarks(template, on_template, body, on_scan, report_progress)
            with self._lock:
                clicked.predicted = predicted
                return f"{number_of(len(predicted.keys() - clicked.places), 'landmark')} predicted: confirm or correct"

        self.beside("looking for the other landmarks", work, send, "the other landmarks could not be predicted")

    # work beside the clicks that go on

    def beside(self, what: str, work: Callable[[Callable[[int, int], None]], str], send: Send, failed: str) -> None:
        """Run work in a thread of its own while clicks go on; the page shows its progress and its end.

        `work` gets a progress callback and returns what to say at the end. Any error it raises is reported after
        `failed`, so that the page does not wait for ever.
        """
        self.working = (what, 0, 1)

        def report_progress(done: int, total: int) -> None:
            self.working = (what, done, total)
            send(self.state())

        def run() -> None:
            try:
                try:
                    note = work(report_progress)
                except OSError as error:
                    note = f"{failed}: {explain_os_error(error, self.template.path)}"
                except ValueError as error:
                    note = f"{failed}: {error}"
                except Exception as error:         # an error in our code: its traceback goes to the terminal
                    note = f"{failed}: unexpected {type(error).__name__}: {error}"
                    say(traceback.format_exc())
                with self._lock:
                    self.working, self.note = None, note
                send(self.state())
            except Stopped:                                      # the server ended meanwhile
                return

        threading.Thread(target=run, daemon=True).start()


def _lists(places: Places) -> dict[str, list[float]]:
    """Return places as lists for JSON."""
    return {name: place.tolist() for name, place in places.items()}


def as_point(values: Any) -> np.ndarray:
    """Return three finite numbers as a point; ValueError for anything else."""
    point = np.asarray(values, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"expected three finite numbers, got {values}")
    return point


def as_direction(values: Any) -> np.ndarray:
    """Return three finite numbers as a unit vector; ValueError for anything else."""
    along = as_point(values)
    length = np.linalg.norm(along)
    if not length > 0:
        raise ValueError(f"direction: expected other than zero, got {values}")
    return np.asarray(along / length)
