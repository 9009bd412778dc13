"""Bodies that turn in a notebook, without server or network."""
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

HEIGHT = 460                         # pixels; buttons and legend are below


@dataclass(frozen=True, eq=False)
class Viewed:
    """What a notebook shows, and `write` saves to a file."""

    contents: Sequence[Content]
    over: bool = False
    up: str | None = None

    @cached_property
    def html(self) -> str:
        """The whole page as HTML."""
        up = None if self.up is None else AXES[self.up]
        _, panes = (over_each_other if self.over else arrange_side_by_side)(list(self.contents), up)
        page = Page("scapekit").bodies(panes, height=HEIGHT).html()
        return page.replace("<header><h1>scapekit</h1></header>\n", "").replace("<main>", '<main style="padding: 0">')

    def write(self, path: str | Path) -> None:
        """Write the page to a file that can be opened by itself."""
        from scanprep.geometry import storage

        storage.write_file(path, self.html)

    def _repr_html_(self) -> str:
        return (f'<iframe srcdoc="{escape(self.html)}" title="bodies, drag to turn" '
                f'style="width: 100%; height: {HEIGHT + 130}px; border: 0"></iframe>')


def view(*things: Any, over: bool = False, up: str | None = None) -> Viewed:
    """Show things in a notebook, where they can be turned; no server is needed, also where the notebook is sent to.

    Parameters
    ----------
    *things : Mesh, (n, 3) array, BodyModel, Subject, Completion, Statue, tuple, str or Path
        What is shown. A tuple is a motion and its subject, or soft tissue and its model; a str or Path is a file or
        folder as `scape view` takes it.
    over : bool
        Over each other instead of side by side.
    up : str, optional
        The axis that is up, such as "y" or "-y".

    Returns
    -------
    Viewed
        The last line of a cell shows it; `.write("page.html")` saves it.

    Raises
    ------
    ValueError
        Nothing to show, or a kind of thing that cannot be shown.

    Examples
    --------
    >>> from completion import view
    >>> from scanprep.synthetic.people import SyntheticPerson
    >>> page = view(SyntheticPerson().mesh, up="z")
    >>> page.html.startswith("<!doctype html>")
    True
    """
    if up is not None and up not in AXES:
        raise ValueError(f"up: expected one of {', '.join(AXES)}, got {up!r}")
    contents = [content for i, thing in enumerate(things) for content in _contents(thing, f"{i + 1}")]
    if not contents:
        raise ValueError("things: expected something to show, got nothing")
    return Viewed(contents, over, up)


def _contents(thing: Any, name: str) -> list[Content]:
    """Return what is seen of a thing; `name` distinguishes it from others."""
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
