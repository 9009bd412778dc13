"""The program behind `scape view`: what is shown, its sliders, and what is saved.

A slider sends a message; the answer is `positions`: all vertices as float32 relative to the origin of their pane, and
where all sliders stand. Newer answers replace older ones that still wait.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.pictures.scene import pack_scene
from scanprep.viewer.app import Send
from scanprep.viewer.messages import Message, call_action, find_action

from .arrangement import arrange_side_by_side, over_each_other
from .contents import Content
from .controls import Controls, Shown
from .files import Entry
from .movable import MovableBody
from .saving import save_bodies, save_poses
from .statues import movable

MOST = 12                            # things shown at a time: more are too small to see
# messages of sliders and buttons that move bodies; the fields of a message are the arguments
MOVES: Mapping[str, Callable[..., object]] = {
    "beta": Controls.set_beta, "turn": Controls.set_turn, "choose": Controls.choose_part, "reset": Controls.reset}


class ViewApp:
    """Things side by side, or over each other; ValueError where none can be read.

    Parameters
    ----------
    entries : sequence of Entry
        What can be shown.
    over : bool
        Show all in one pane.
    output : Path
        Folder for what is saved.

    Attributes
    ----------
    shown : list of int
        Numbers of the entries that are shown.
    contents, bodies : dict
        By number, contents of the shown things, and the bodies of those that are models.
    problems, about : dict
        By number, why a thing cannot be read; a description of one that was.
    written : list of Path
        Files that were saved.
    """

    name, title = "view", "View"

    def __init__(self, entries: Sequence[Entry], over: bool = False, output: Path = Path()) -> None:
        self.entries, self.over, self.output = list(entries), over, output
        self.shown: list[int] = []
        self.contents: dict[int, Content] = {}
        self.bodies: dict[int, MovableBody] = {}
        self.problems: dict[int, str] = {}
        self.about: dict[int, str] = {}
        self.written: list[Path] = []
        self.controls = Controls()
        self.number = 0                                   # of the scene; positions carry it
        self._scene: list[Message] = []                   # messages that make up the scene
        self._notes: tuple[str, ...] = ()
        self._positions: dict[tuple[int, int], Message] = {}
        # show what is marked as first; of too many only the first one
        first = [i for i, entry in enumerate(self.entries) if entry.first] or [0]
        if not self.show(first if len(first) <= MOST else first[:1]):
            raise ValueError(next(iter(self.problems.values())))

    # what the page is sent

    def greet(self) -> list[Message]:
        """Return the scene, the state, and the positions since."""
        return [*self._scene, self.state(), *list(self._positions.values())]

    def state(self) -> Message:
        """Return everything but the shapes."""
        return Message("state", {
            "entries": [{"name": entry.name, "shown": i in self.shown, "problem": self.problems.get(i, ""),
                         "about": self.about.get(i, "")} for i, entry in enumerate(self.entries)],
            "notes": list(self._notes), "problems": list(self.problems.values()),
            "saved": [str(path) for path in self.written], "parts": list(self.controls.turns), **self._where()},
            latest="state")

    def _where(self) -> dict[str, Any]:
        """Return where all sliders stand."""
        sliders = self.controls
        return {"betas": sliders.betas.tolist(), "turns": {name: turn.tolist() for name, turn in sliders.turns.items()},
                "chosen": sliders.chosen}

    # what is shown

    def show(self, wanted: Sequence[int]) -> bool:
        """Read entries and show them as a new scene; for those that cannot be read the reason is kept.

        False where none can be read: then everything stays as it is.
        """
        if len(wanted) > MOST:
            raise ValueError(f"at most {MOST} can be shown at a time")
        contents: dict[int, Content] = {}
        for i in wanted:
            try:
                contents[i] = self.contents[i] if i in self.contents else self._load(i)
                model = contents[i].model
                if model is not None and i not in self.bodies:
                    self.bodies[i] = movable(model, contents[i].statue)
            except (ValueError, OSError) as problem:
                self.problems[i] = str(problem)
            else:
                self.problems.pop(i, None)
        shown = [i for i in contents if i not in self.problems]
        if not shown:
            return False
        self.shown, self.contents = shown, {i: contents[i] for i in shown}
        self.bodies = {i: body for i, body in self.bodies.items() if i in shown}
        self._make_scene()
        return True

    def _load(self, i: int) -> Content:
        """Read an entry."""
        content = self.entries[i].load()
        self.about[i] = content.about
        return replace(content, name=self.entries[i].name, stance=content.start or content.stance)

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
                fields = {"scene": self.number, "pane": pane, "layer": layer + markers.shape, "labels": markers.labels,
                          **markers.colors()}
                self._scene.append(Message("residuals", fields, markers.residuals.astype("<f4").tobytes(),
                                           f"residuals {pane} {layer}"))
            if i in self.bodies:
                bodies.append(Shown(self.bodies[i], content.name, pane, layer))
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
        """Act on a slider or a button."""
        if (move := MOVES.get(message.kind)) is not None:
            call_action(move, message.fields, self.controls)
            for one in self.controls.shown:
                send(self._vertices_now(one))
        else:
            call_action(find_action(self, message.kind), message.fields, send)

    def on_show(self, send: Send, entries: list[int]) -> None:
        """Show other things; if none can be read, keep the present ones."""
        if self.show([i for i in dict.fromkeys(entries) if 0 <= i < len(self.entries)]):
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
