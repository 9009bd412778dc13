"""The program behind `scape view`: what is shown, sliders, and what is saved of them.

A move of a slider answers with `positions`, the places of all vertices as float32 relative to the origin of their pane,
and with where all sliders stand. Older answers that still wait give way to newer ones.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.pictures.scene import pack_scene
from scanprep.viewer.app import App, Send
from scanprep.viewer.dropped import Dropped, with_camera
from scanprep.viewer.messages import Message

from .arrangement import arrange_side_by_side, over_each_other
from .controls import Controls, Shown
from .files import Entry, Files
from .pages import Inside
from .saving import save_bodies, save_poses
from .things import MOST, Things

# what sliders, buttons and the mouse do to the bodies; the fields of their messages are the arguments
MOVES: Mapping[str, Callable[..., object]] = {
    "beta": Controls.set_beta, "turn": Controls.set_turn, "choose": Controls.choose_part, "touch": Controls.choose,
    "grab": Controls.grab, "drag": Controls.drag, "random_body": Controls.random_body,
    "random_pose": Controls.random_pose, "reset": Controls.reset}


class ViewApp(Things):
    """Contents side by side, or over each other; ValueError where there are some and none can be read.

    Parameters
    ----------
    entries : sequence of Entry
        None at first where files will be dropped.
    over : bool
        All in one pane.
    output : Path
        Folder for what is saved.
    files : Files, optional
        Those that the entries are from, which tell what other files are.
    """

    name, title = "view", "View"
    folders: Sequence[Path] = ()

    def __init__(self, entries: Sequence[Entry] = (), over: bool = False, output: Path = Path(),
                 files: Files | None = None) -> None:
        super().__init__(entries, files or Files())
        self.over, self.output = over, output
        self.controls, self.dropped = Controls(), Dropped()
        self.inside = Inside(self.files, output, self.dropped)
        self.written: list[Path] = []                     # what was saved
        self.note = ""
        self.working: tuple[str, int, int] | None = None
        self.number = 0                                   # of the scene, which positions name
        self._scene: list[Message] = []                   # and what belongs to it
        self._notes: tuple[str, ...] = ()
        self._positions: dict[tuple[int, int], Message] = {}
        if self.entries:
            first = [i for i, entry in enumerate(self.entries) if entry.first] or [0]
            self.show(first if len(first) <= MOST else first[:1])
            if not self.shown:
                raise ValueError(next(iter(self.problems.values()), "FILES: nothing to show"))

    # what the page is sent

    def greet(self) -> list[Message]:
        """The scene, where everything stands, and what moved since."""
        return [*self._scene, self.state(), *list(self._positions.values())]

    def state(self) -> Message:
        """All but the shapes."""
        sliders = self.controls
        return Message("state", {
            "entries": [{"name": entry.name, "shown": i in self.shown, "problem": self.problems.get(i, ""),
                         "about": self.about.get(i, "")} for i, entry in enumerate(self.entries)],
            "notes": list(self._notes), "problems": list(self.problems.values()),
            "saved": [str(path) for path in self.written], "note": self.note, "working": self.working,
            "pages": self.inside.list_buttons(self.entries),
            "parts": list(sliders.turns), "models": [{"pane": one.pane, "layer": one.layer, "name": one.name}
                                                     for one in sliders.shown],
            **self._where()}, latest="state")

    def _where(self) -> dict[str, Any]:
        one = self.controls
        return {"betas": one.betas.tolist(), "turns": {name: turn.tolist() for name, turn in one.turns.items()},
                "chosen": one.chosen}

    # what is shown

    def show(self, wanted: Sequence[int]) -> None:
        """Read these entries and make their scene; those that cannot be read tell why."""
        self.put(self.read(wanted))

    def put(self, read: Sequence[int]) -> None:
        """Show what was read, as a new scene."""
        super().put(read)
        if read:
            self._make_scene()

    # pages inside

    def enter(self, send: Send, wanted: Mapping[str, Any]) -> App:
        """The page that a button asks for."""
        def progress(done: int, total: int) -> None:
            self.working = ("building the synthetic people", done, total)
            send(self.state())

        self.note = ""
        try:
            return self.inside.enter(self.entries, wanted, progress)
        finally:
            self.working = None

    def on_return(self, app: App) -> None:
        """What a page has written joins the things that are shown."""
        for folder in self.inside.folders_written(app):
            if folder not in self.files.folders(self.entries):
                self.written.append(folder)
            self.join(folder)

    def _make_scene(self) -> None:
        """A pane and its first layer for everything that is shown, residuals of its markers, sliders of its bodies."""
        contents = [self.contents[i] for i in self.shown]
        self.cameras, panes = over_each_other(contents) if self.over else arrange_side_by_side(contents)
        self.number += 1
        self._scene = [Message("scene", {"number": self.number}, pack_scene(panes, whole=True))]
        bodies, below = list[Shown](), 0
        for number, i in enumerate(self.shown):
            content = self.contents[i]
            pane, layer = (0, below) if self.over else (number, 0)
            below += len(content.shapes)
            if (known := content.markers) is not None:
                fields = {"pane": pane, "layer": layer + known.shape, "labels": known.labels, **known.colors()}
                self._scene.append(Message("residuals", fields, known.residuals.astype("<f4").tobytes()))
            if i in self.bodies:
                bodies += [Shown(body, content.name, pane, layer + k) for k, body in enumerate(self.bodies[i].layers)]
        self._notes = tuple(note for content in contents for note in content.notes)
        self.controls.take(bodies)
        self._positions = {}
        for one in self.controls.shown:
            self._vertices_now(one)

    def _vertices_now(self, one: Shown) -> Message:
        """Where the vertices of a body are now."""
        body = one.body
        y, shift = self.controls.vertices(body), (body.origin - self.cameras[one.pane].target).astype(np.float32)
        joint = body.joint(self.controls.chosen, y) + shift if self.controls.chosen in body.parts else None
        fields = {"scene": self.number, "pane": one.pane, "layer": one.layer, "joint": joint, **self._where()}
        message = Message("positions", fields, np.ascontiguousarray(y + shift, dtype="<f4").tobytes(),
                          f"positions {one.pane} {one.layer}")
        self._positions[one.pane, one.layer] = message
        return message

    # what the page sends

    def handle(self, message: Message, send: Send) -> None:
        """A slider, a button, a click."""
        if (move := MOVES.get(message.kind)) is not None:
            move(self.controls, **message.fields)
            for one in self.controls.shown:
                send(self._vertices_now(one))
        elif (action := getattr(self, f"on_{message.kind}", None)) is not None:
            action(send, **message.fields)
        else:
            raise ValueError(f"a message of kind '{message.kind}', which nothing here answers")

    def receive(self, name: str, path: Path, send: Send) -> None:
        """A file dropped on the page joins the things and is shown; ValueError for one that cannot be."""
        with self.dropped.keeping(name, path) as kept:
            whole, self.note = with_camera(kept)
            if not self.note:
                self.join(whole)
        for message in self.greet():
            send(message)

    def close(self) -> None:
        """Forget what was dropped; all else that was wanted was saved."""
        self.written += [folder for page in self.inside.completions for folder in self.inside.folders_written(page)]
        self.dropped.close()

    def on_show(self, send: Send, entries: list[int]) -> None:
        """Other things."""
        wanted = [i for i in entries if 0 <= i < len(self.entries)]
        before = self.shown, self.contents, self.bodies
        self.show(wanted)
        if not self.shown:
            self.shown, self.contents, self.bodies = before
        else:
            for message in [*self._scene, *self._positions.values()]:
                send(message)
        send(self.state())

    def on_save_body(self, send: Send) -> None:
        """Each body as a mesh."""
        self.written += save_bodies(self.controls, self.output)
        send(self.state())

    def on_save_pose(self, send: Send) -> None:
        """The pose of each as a motion of one frame."""
        self.written += save_poses(self.controls, self.output)
        send(self.state())
