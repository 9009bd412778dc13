"""Bodies that turn in a notebook, without a server and without a network."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from model.statue.control.model import Statue
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.page import Page

from ..mocap.soft_tissue.soft_tissue import SoftTissue
from ..motion import Motion
from ..partial.completion import Completion
from .arrangement import arrange_side_by_side, over_each_other
from .contents import AXES, Content, of_completion, of_mesh, of_model, of_subject
from .files import Files
from .motions import of_motion
from .soft import of_soft_tissue
from .statues import of_statue

HEIGHT = 460                         # pixels of the bodies; buttons and legend stand below


@dataclass(frozen=True, eq=False)
class Viewed:
    """What a notebook shows, and `write` puts into a file."""

    contents: Sequence[Content]
    over: bool = False
    up: str | None = None

    @cached_property
    def html(self) -> str:
        """A whole page."""
        up = None if self.up is None else AXES[self.up]
        _, panes = (over_each_other if self.over else arrange_side_by_side)(list(self.contents), up)
        page = Page("scapekit").bodies(panes, height=HEIGHT).html()
        return page.replace("<header><h1>scapekit</h1></header>\n", "").replace("<main>", '<main style="padding: 0">')

    def write(self, path: str | Path) -> None:
        """The same as a page that can be opened by itself."""
        from scanprep.geometry import storage

        storage.write_file(path, self.html)

    def _repr_html_(self) -> str:
        return (f'<iframe srcdoc="{escape(self.html)}" title="bodies, drag to turn" '
                f'style="width: 100%; height: {HEIGHT + 130}px; border: 0"></iframe>')


def view(*things: Any, over: bool = False, up: str | None = None) -> Viewed:
    """Things that a notebook shows and that can be turned there; where they are sent, no server is needed.

    Parameters
    ----------
    things
        Meshes, points (n, 3), models, subjects, completions, statues, pairs of a motion and its subject or of soft
        tissue and its model, and files or folders as `scape view` takes them.
    over : bool
        Laid over each other instead of side by side.
    up : str, optional
        The axis that is up, such as "y" or "-y".

    Returns
    -------
    Viewed
        The last line of a cell shows it; `.write("page.html")` keeps it.

    Raises
    ------
    ValueError
        Nothing to show, or of a kind that cannot be shown.
    """
    if up is not None and up not in AXES:
        raise ValueError(f"up: expected one of {', '.join(AXES)}, got {up!r}")
    contents = [content for i, thing in enumerate(things) for content in _contents(thing, f"{i + 1}")]
    if not contents:
        raise ValueError("things: expected something to show, got nothing")
    return Viewed(contents, over, up)


def _contents(thing: Any, name: str) -> list[Content]:
    """What is seen of a thing; `name` is what tells it from others."""
    kinds: tuple[tuple[tuple[Any, ...], Callable[..., Content]], ...] = (
        ((Mesh | np.ndarray,), of_mesh), ((BodyModel,), of_model), ((Subject,), of_subject), ((Statue,), of_statue),
        ((Completion,), of_completion), ((Motion, Subject), of_motion), ((SoftTissue, BodyModel), of_soft_tissue))
    parts = thing if isinstance(thing, tuple) else (thing,)
    for kind, show in kinds:
        if len(parts) == len(kind) and all(map(isinstance, parts, kind)):
            return [show(name, *parts)]
    if isinstance(thing, str | Path):
        return [entry.load() for entry in Files((Path(thing),)).entries() if entry.first]
    raise ValueError("things: expected meshes, points, models, subjects, completions, statues, (motion, subject), "
                     f"(soft tissue, model) or files, got {type(thing).__name__}")
