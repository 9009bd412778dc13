"""The program behind `scape view`: what is shown, its sliders, and what is saved.

A slider sends a message; the answer is `positions`: all vertices as float32 relative to the origin of their pane, and
where all sliders stand. Newer answers replace older ones that still wait.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.pictures.scene import pack_scene
from scanprep.viewer.app import App, Send
from scanprep.viewer.dropped import Dropped, with_camera
from scanprep.viewer.messages import Message, call_action, find_action

from .arrangement import arrange_side_by_side, over_each_other
from .controls import Controls, Shown
from .files import Entry, Files
from .pages import Inside
from .saving import save_bodies, save_poses
from .things import MOST, Things

# messages of sliders, buttons and mouse that move bodies; the fields of a message are the arguments
MOVES: Mapping[str, Callable[..., object]] = {
    "beta": Controls.set_beta, "turn": Controls.set_turn, "choose": Controls.choose_part, "touch": Controls.choose,
    "grab": Controls.grab, "drag": Controls.drag, "random_body": Controls.random_body,
    "random_pose": Controls.random_pose, "reset": Controls.reset}


class ViewApp(Things):
    """Things side by side, or over each other; ValueError where there are some and none can be read.

    Parameters
    ----------
    entries : sequence of Entry
        What can be shown; none at first where files will be dropped.
    over : bool
        Show all in one pane.
    output : Path
        Folder for what is saved.
    files : Files, optional
        The files that the entries are from; they recognise further files.
    """

    name, title = "view", "View"
    folders: Sequence[Path] = ()

    def __init__(self, entries: Sequence[Entry] = (), over: bool = False, output: Path = Path(),
                 files: Files | None = None) -> None:
        super().__init__(entries, files or Files())
        self.over, self.output = over, output
        self.controls, self.dropped = Controls(), Dropped()
        self.inside = Inside(self.files, output, self.dropped)
        self.written: list[Path] = []                     # files that were saved
        self.note = ""
        self.working: tuple[str, int, int] | None = None
        self.number = 0                                   # of the scene; positions carry it
        self._scene: list[Message] = []                   # messages that make up the scene
        self._notes: tuple[str, ...] = ()
        self._positions: dict[tuple[int, int], Message] = {}
        if self.entries:
            # show what is marked as first; of too many only the first one
            first = [i for i, entry in enumerate(self.entries) if entry.first] or [0]
            self.show(first if len(first) <= MOST else first[:1])
            if not self.shown:
                raise ValueError(next(iter(self.problems.values()), "FILES: nothing to show"))

    # what the page is sent

    def greet(self) -> list[Message]:
        """Return the scene, the state, and the positions since."""
        return [*self._scene, self.state(), *list(self._positions.values())]

    def state(self) -> Message:
        """Return everything but the shapes."""
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
        """Return where all sliders stand."""
        sliders = self.controls
        return {"betas": sliders.betas.tolist(), "turns": {name: turn.tolist() for name, turn in sliders.turns.items()},
                "chosen": sliders.chosen}

    # what is shown

    def show(self, wanted: Sequence[int]) -> None:
        """Read entries and show them; for those that cannot be read the reason is kept."""
        self.put(self.read(wanted))

    def put(self, read: Sequence[int]) -> None:
        """Show what was read, as a new scene."""
        super().put(read)
        if read:
            self._make_scene()

    # pages inside

    def enter(self, send: Send, wanted: Mapping[str, Any]) -> App:
        """Open the page that a button asks for."""
        def progress(done: int, total: int) -> None:
            self.working = ("building the synthetic people", done, total)
            send(self.state())

        self.note = ""
        try:
            return call_action(self.inside.enter, wanted, self.entries, progress)
        finally:
            self.working = None

    def on_return(self, app: App) -> None:
        """Show what a page has written."""
        for folder in self.inside.folders_written(app):
            if folder not in self.files.folders(self.entries):
                self.written.append(folder)
            self.join(folder)

    def _make_scene(self) -> None:
        """Build panes and layers for everything shown, with residuals of markers and sliders of bodies."""
        contents = [self.contents[i] for i in self.shown]
        self.cameras, panes = over_each_other(contents) if self.over else arrange_side_by_side(contents)
        self.number += 1
        self._scene = [Message("scene", {"number": self.number}, pack_scene(panes, whole=True))]
        # find the pane and layer of each body; over each other all are layers of one pane
        bodies, below = list[Shown](), 0
        for number, i in enumerate(self.shown):
            content = self.contents[i]
            pane, layer = (0, below) if self.over else (number, 0)
            below += len(content.shapes)
            if (markers := content.markers) is not None:
                fields = {"pane": pane, "layer": layer + markers.shape, "labels": markers.labels, **markers.colors()}
                self._scene.append(Message("residuals", fields, markers.residuals.astype("<f4").tobytes()))
            if i in self.bodies:
                bodies += [Shown(body, content.name, pane, layer + k) for k, body in enumerate(self.bodies[i].layers)]
        self._notes = tuple(note for content in contents for note in content.notes)
        self.controls.take(bodies)
        self._positions = {}
        for body in self.controls.shown:
            self._vertices_now(body)

    def _vertices_now(self, shown: Shown) -> Message:
        """Return the message with the present vertices of a body."""
        body = shown.body
        y, shift = self.controls.vertices(body), (body.origin - self.cameras[shown.pane].target).astype(np.float32)
        joint = body.joint(self.controls.chosen, y) + shift if self.controls.chosen in body.parts else None
        fields = {"scene": self.number, "pane": shown.pane, "layer": shown.layer, "joint": joint, **self._where()}
        message = Message("positions", fields, np.ascontiguousarray(y + shift, dtype="<f4").tobytes(),
                          f"positions {shown.pane} {shown.layer}")
        self._positions[shown.pane, shown.layer] = message
        return message

    # what the page sends

    def handle(self, message: Message, send: Send) -> None:
        """Act on a slider, a button or a click."""
        if (move := MOVES.get(message.kind)) is not None:
            call_action(move, message.fields, self.controls)
            for one in self.controls.shown:
                send(self._vertices_now(one))
        else:
            call_action(find_action(self, message.kind), message.fields, send)

    def receive(self, name: str, path: Path, send: Send) -> None:
        """Show a file dropped on the page with the other things; ValueError for one that cannot be shown."""
        with self.dropped.keeping(name, path) as copy:
            complete, self.note = with_camera(copy)
            if not self.note:
                self.join(complete)
        for message in self.greet():
            send(message)

    def close(self) -> None:
        """Remove dropped files; everything else was saved."""
        self.written += [folder for page in self.inside.completions for folder in self.inside.folders_written(page)]
        self.dropped.close()

    def on_show(self, send: Send, entries: list[int]) -> None:
        """Show other things; if none can be read, keep the present ones."""
        wanted = [i for i in dict.fromkeys(entries) if 0 <= i < len(self.entries)]
        before = self.shown, self.contents, self.bodies
        self.show(wanted)
        if not self.shown:
            self.shown, self.contents, self.bodies = before
        else:
            for message in [*self._scene, *self._positions.values()]:
                send(message)
        send(self.state())

    def on_save_body(self, send: Send) -> None:
        """Save each body as a mesh."""
        self.written += save_bodies(self.controls, self.output)
        send(self.state())

    def on_save_pose(self, send: Send) -> None:
        """Save the pose of each body as a motion of one frame."""
        self.written += save_poses(self.controls, self.output)
        send(self.state())
