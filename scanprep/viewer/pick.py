"""Landmarks clicked in the browser: `scape pick`, and what `scape complete --interactive` is built on.

The page sends rays and names; where a ray meets the surface is found here, every change is saved at once, and the
page is sent the whole state, which is small. So a second tab, or one that was loaded again, shows the same.
"""
from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..console import say
from ..depth_camera.picture import is_picture
from ..geometry.landmark_names import landmark_name, pair_names
from ..geometry.mesh import Mesh
from ..geometry.sides import other_side
from ..judgement import extent
from ..pictures.scene import Pane, pack_scene
from ..words import number_of
from .app import Send
from .clicked import Clicked, Places, camera_like, camera_of, predict_landmarks
from .landmark_names import next_name
from .messages import Message
from .worker import Stopped

TEMPLATE, SCAN = 0, 1                # panes
ENOUGH = 4                           # landmarks from which the others can be predicted


@dataclass(frozen=True)
class Change:
    """Landmarks before and after, on one of the bodies; None where there was none."""

    body: int
    before: Mapping[str, np.ndarray | None]
    after: Mapping[str, np.ndarray | None]
    drag: int = 0                        # number of the movement that it is part of; 0 for a click


class PickApp:
    """The state of `scape pick`: a template, scans one after the other, names, and what can be undone."""

    name, title = "pick", "Landmarks"
    folders: Sequence[Path] = ()

    def __init__(self, template: Clicked, scans: Sequence[Clicked], names: Sequence[str],
                 fixed: Mapping[str, np.ndarray] | None = None) -> None:
        self.template, self.scans, self.current = template, list(scans), 0
        if fixed is not None:                                    # a model's own: nothing to click or to save
            template.places = dict(fixed)
        self.fixed = fixed is not None
        known = list(dict.fromkeys([*template.places, *(name for one in self.scans for name in one.places)]))
        meant = {landmark_name(name) for name in known}
        self.names = (*known, *(name for name in names if landmark_name(name) not in meant))
        self.building = not template.places                      # names are still added to the template
        self.alternating: int | None = None                      # pane that the chosen name was just clicked on
        self.question: dict[str, Any] | None = None              # about a click far from where it was expected
        self.done: list[Change] = []
        self.undone: list[Change] = []
        self.chosen: str | None = None
        self.working: tuple[str, int, int] | None = None
        self.note = ""
        self._lock = threading.RLock()
        self.choose_next(None)

    # what the page is sent

    @property
    def scan(self) -> Clicked | None:
        """The scan that is shown."""
        return self.scans[self.current] if self.scans else None

    def greet(self) -> list[Message]:
        """The bodies and the state."""
        with self._lock:
            return [self.scene(), self.state()]

    def scene(self) -> Message:
        """All panes."""
        panes = [self.template.pane(self.template.path.name)]
        if self.scan is not None:
            panes.append(self.scan_pane())
        return Message("scene", {}, pack_scene(panes))

    def scan_pane(self) -> Pane:
        """The scan that is shown, from the side from which the template is shown."""
        assert self.scan is not None
        pane = self.scan.pane(self.scan.path.name)
        if is_picture(self.scan.path):
            return pane
        pairs = pair_names(self.template.places, self.scan.places)
        template, body = self.template.body.points, self.scan.body.shape
        landmarks = None
        if len(pairs) >= ENOUGH:
            landmarks = (np.array([self.template.places[ours] for ours, _ in pairs]),
                         np.array([self.scan.places[theirs] for _, theirs in pairs]))
        return replace(pane, camera=camera_like(camera_of(self.template.body.shape), template, body, landmarks))

    def state(self) -> Message:
        """Everything but the bodies."""
        with self._lock:
            shown = [self.template, *([self.scan] if self.scan else [])]
            return Message("state", {
                "names": list(self.names), "chosen": self.chosen, "fixed": self.fixed, "note": self.note,
                "panes": [{"places": _lists(one.places), "predicted": _lists(one.predicted), "file": one.file.name}
                          for one in shown],
                "scan": self.current,
                "scans": [{"name": one.path.name, "count": len(one.places)} for one in self.scans],
                "undo": bool(self.done), "redo": bool(self.undone), "working": self.working, "enough": ENOUGH,
                "question": self.question, **self.more()}, latest="state")

    def more(self) -> dict[str, Any]:
        """What an app that is built on this one adds to the state."""
        return {}

    # what the page sends

    def handle(self, message: Message, send: Send) -> None:
        """One click, key or button; everything that it changes is saved before the page is told."""
        action = getattr(self, f"on_{message.kind}", None)
        if action is None:
            raise ValueError(f"a message of kind '{message.kind}', which nothing here answers")
        with self._lock:
            self.note, self.question = "", None
            action(send, **message.fields)
        send(self.state())

    def receive(self, name: str, path: Path, send: Send) -> None:
        """Files cannot be dropped here: there would be no folder to save their landmarks in."""
        raise ValueError("name scans on the command line: their landmarks are saved beside them")

    def close(self) -> None:
        """Nothing is left to do: every click was saved."""

    def on_place(self, send: Send, pane: int, name: str, origin: list[float], direction: list[float],
                 inside: bool = False, seen: list[float] | None = None, drag: int = 0) -> None:
        """A landmark where a ray meets the surface; one inside is half way to where the ray leaves the body.

        The places of one drag, which has a number, are undone as one. After a click on one pane the same name is
        wanted on the other; a second click on the same pane is the next name's.
        """
        one = self._editable(pane)
        if not drag and name == self.chosen and self.alternating == pane:
            offered = self.names if pane == TEMPLATE or self.building else self._of_template()
            name = next_name(offered, set(one.places), name) or name
        body, ray = one.body, (_point(origin), _point(direction))
        place = body.middle(*ray) if inside else body.hit(*ray)
        if place is None and seen is not None:                   # the ray met the thinned surface, and just not ours
            place = body.nearest(_point(seen))
        if place is None:
            self.note = "the click met nothing: turn the body so that the place faces you"
            return
        self.building |= pane == TEMPLATE
        self._change(self._number(pane), {self._scan_named(name): place}, drag)
        # of a scan's size, 13 cm on a person: of 192 landmarks predicted after four the worst was 7 cm off; left and
        # right of one kind are 15 cm apart or more, but for the eyes, 7 cm
        far = 0.06
        if not drag:
            self.choose_next(name, pane)
            # a click on the scan that is far from where the landmark was predicted is questioned
            expected = one.predicted.get(name)
            away = 0.0 if expected is None else float(np.linalg.norm(place - expected))
            if pane == SCAN and away > far * extent(one.body.points):
                self.chosen, self.alternating = name, None
                self.question = {"name": name, "away": away,
                                 "text": f"This is {100 * away:.0f} cm from where “{name}” was expected: keep it?"}
        self._predict_if_time(send, pane)

    def on_keep(self, send: Send, name: str) -> None:
        """The landmark is where it should be, however far from where it was expected."""
        self.choose_next(name, SCAN)

    def on_slide(self, send: Send, pane: int, name: str, direction: list[float], by: float) -> None:
        """Move a landmark along a ray, metres: into the body, to where a joint is."""
        along = _point(direction)
        place = self._editable(pane).places[name] + by * along / np.linalg.norm(along)
        self._change(self._number(pane), {name: place}, -1)         # by key: one as long as they follow each other

    def on_remove(self, send: Send, pane: int, name: str) -> None:
        """Take a landmark away."""
        if name in self._editable(pane).places:
            self._change(self._number(pane), {name: None})
            self.note = f"{name} is taken away; a click sets it again, undo brings it back"
        self.chosen = name

    def on_swap(self, send: Send) -> None:
        """Exchange left and right of the scan: the commonest error of landmarks, and undone like any other change."""
        one = self._editable(SCAN)
        others = {name: other for name in one.places if (other := other_side(name)) is not None}
        after = {other: one.places[name] for name, other in others.items()}
        if not after:
            raise ValueError("no landmark of the scan names a side")
        self._change(self.current, {**after, **{name: None for name in others if name not in after}})
        one.predicted = {other_side(name) or name: place for name, place in one.predicted.items()}

    def on_choose(self, send: Send, name: str) -> None:
        """The landmark that the next click sets; a new name joins the list."""
        self.chosen, self.alternating = self._scan_named(name), None

    def on_open(self, send: Send, scan: int) -> None:
        """Another scan."""
        if not 0 <= scan < len(self.scans):
            raise ValueError(f"scan: expected 0 to {len(self.scans) - 1}, got {scan}")
        if scan != self.current:
            self.scans[self.current].forget()
            self.current = scan
            self.choose_next(None)
            send(self.scene())

    def on_undo(self, send: Send) -> None:
        """Take the last change back."""
        self._step(self.done, self.undone, back=True, send=send)

    def on_redo(self, send: Send) -> None:
        """Make it again."""
        self._step(self.undone, self.done, back=False, send=send)

    def on_confirm(self, send: Send, names: list[str]) -> None:
        """Take predicted landmarks as they are."""
        one = self._editable(SCAN)
        wanted = {name: one.predicted[name] for name in names if name in one.predicted}
        if wanted:
            self._change(self._number(SCAN), wanted)
            self.choose_next(None)
            self.note = f"{len(wanted)} taken as predicted; undo takes them back"

    def on_predict(self, send: Send) -> None:
        """Where the other landmarks of the template should be on the scan."""
        if self.scan is not None:
            self._predict(self.scan, send)

    # the state itself

    def choose_next(self, last: str | None, pane: int = SCAN) -> None:
        """Offer the same name where the other pane lacks it, else the next that one of the two lacks.

        Names that a template lacks which came with landmarks are offered only when somebody clicks on it.
        """
        template, scan, self.alternating = self.template.places, self.scan.places if self.scan else {}, None
        other = scan if pane == TEMPLATE else template
        if self.scan is not None and not self.fixed and last in (template if pane == TEMPLATE else scan) and \
                last not in other and (pane == TEMPLATE or self.building):
            self.chosen, self.alternating = last, pane
            return
        if self.scan is None:
            offered, done = self.names, set(template)
        else:
            offered, done = self.names if self.building else self._of_template(), set(template) & set(scan)
        self.chosen = next_name(offered, done, last) or last or (self.names[0] if self.names else None)

    def _of_template(self) -> tuple[str, ...]:
        return tuple(name for name in self.names if name in self.template.places)

    def _number(self, pane: int) -> int:
        return -1 if pane == TEMPLATE else self.current

    def _editable(self, pane: int) -> Clicked:
        if pane == TEMPLATE and self.fixed:
            raise ValueError("the landmarks of the model are fixed; click on the scan")
        if pane not in (TEMPLATE, SCAN) or (pane == SCAN and self.scan is None):
            raise ValueError(f"pane: expected 0, the template, or 1, the scan, got {pane}")
        return self.template if pane == TEMPLATE else self.scans[self.current]

    def _scan_named(self, name: str) -> str:
        name = " ".join(str(name).split())[:200]
        if not name:
            raise ValueError("a landmark needs a name")
        if name not in self.names:
            self.names = (*self.names, name)
        return name

    def _change(self, number: int, after: Mapping[str, np.ndarray | None], drag: int = 0) -> None:
        """Set landmarks, remember what they were, save; the changes of one drag are one."""
        places = (self.template if number < 0 else self.scans[number]).places
        before = {name: places.get(name) for name in after}
        last = self.done[-1] if self.done else None
        if drag and last and (last.drag, last.body, *last.after) == (drag, number, *after):
            before = dict(self.done.pop().before)
        self.done.append(Change(number, before, after, drag))
        self.undone.clear()
        self._set(number, after)

    def _set(self, number: int, places: Mapping[str, np.ndarray | None]) -> None:
        one = self.template if number < 0 else self.scans[number]
        for name, place in places.items():
            if place is None:
                one.places.pop(name, None)
            else:
                one.places[name] = place
        one.save()

    def _step(self, source: list[Change], target: list[Change], back: bool, send: Send) -> None:
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
        one = self.scan
        if pane == SCAN and one is not None and not one.predicted and self.working is None:
            common = [name for name in self.template.places if name in one.places]
            if len(common) == ENOUGH < len(self.template.places):
                self._predict(one, send)

    def _predict(self, one: Clicked, send: Send) -> None:
        common = [name for name in self.template.places if name in one.places]
        template = self.template.body.shape
        if len(common) < ENOUGH:
            raise ValueError(f"click {ENOUGH} landmarks that the template has too, then the others can be predicted")
        if self.working is not None or not isinstance(template, Mesh):
            return
        on_template, on_scan, body = dict(self.template.places), dict(one.places), one.body

        def work(tell: Callable[[int, int], None]) -> str:
            found = predict_landmarks(template, on_template, body, on_scan, tell)
            with self._lock:
                one.predicted = found
                return f"{number_of(len(found.keys() - one.places), 'landmark')} predicted: confirm or correct"

        self.beside("looking for the other landmarks", work, send, "the other landmarks could not be predicted")

    # work beside the clicks that go on

    def beside(self, what: str, work: Callable[[Callable[[int, int], None]], str], send: Send, failed: str) -> None:
        """Do some work in a thread of its own while clicks go on; the page sees its progress, and how it ended.

        `work` gets the callback of its progress and returns what to say at the end. Whatever it raises is told after
        `failed`, and does not leave the page waiting.
        """
        self.working = (what, 0, 1)

        def tell(done: int, total: int) -> None:
            self.working = (what, done, total)
            send(self.state())

        def run() -> None:
            try:
                try:
                    note = work(tell)
                except (ValueError, OSError) as error:
                    note = f"{failed}: {error}"
                except Exception as error:                       # which nobody foresaw
                    note = f"{failed}: unexpected {type(error).__name__}: {error}"
                    say(traceback.format_exc())
                with self._lock:
                    self.working, self.note = None, note
                send(self.state())
            except Stopped:                                      # the server ended meanwhile
                return

        threading.Thread(target=run, daemon=True).start()


def _lists(places: Places) -> dict[str, list[float]]:
    return {name: place.tolist() for name, place in places.items()}


def _point(values: Any) -> np.ndarray:
    point = np.asarray(values, dtype=float)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"expected three finite numbers, got {values}")
    return point
