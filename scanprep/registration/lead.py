"""Initialisation of a registration by a body model: it finds the body on a scan and proposes the template's vertices.

The package `model` does this with the built-in people or with your own model, and learns a model from a set. It is
found by the entry points `model`, `learn` and `person` of the group `scapekit.leads`, because nothing in `scanprep` may
import it.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..geometry.mesh import Mesh
from ..ranges import Axis
from ..skeleton.tree import Skeleton
from .person import PersonParts, has_limbs


@dataclass(frozen=True, eq=False)
class Proposal:
    """A body on a scan: the template's vertices (N, 3), metres, and points (n,) bool of the scan that are no skin.

    `worn` says in words what these are: "hair on head".
    """

    vertices: np.ndarray
    not_skin: np.ndarray | None = None
    worn: tuple[str, ...] = ()


class Lead(Protocol):
    """Finds bodies on scans, the likeliest first.

    The next body is sought only when it is asked for, so the first one comes fast.
    Landmarks are vertices (L,) of the template and points (L, 3), metres. `model` is the path of the model file, where
    it differs from the path the lead was made with. `up` is the axis of the scan that points up, where it is known.
    `landmarks` are those that the model names, on the template.
    """

    name: str
    parts: PersonParts | None        # of the template, where the model is of people
    landmarks: Mapping[str, int]

    def __call__(self, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
                 model: Path | None = None, up: Axis | None = None) -> Iterable[Proposal]: ...

    def person_size(self, scan: Mesh | np.ndarray) -> tuple[float, float]:
        """Find the length of a scan's unit and the stature of the person in it, both in metres."""
        ...


def lead_of(template: Mesh, through: str, progress: Callable[[int, int], None] | None = None) -> Lead | None:
    """Load what initialises registrations of a template; None for nothing.

    Parameters
    ----------
    template : Mesh
        Template to be registered.
    through : str
        "none"; "auto", the built-in people for a template that is a person, nothing for others; or the file of a model.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Lead or None

    Raises
    ------
    ValueError
        A model that does not fit the template, with the reason; or a file that is no model.
    """
    if through == "none" or (through == "auto" and not has_limbs(template)):
        return None
    return _load_entry_point("model", f"--through {through}")(template, through, progress)


def learn_model(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None, path: Path) -> None:
    """Learn a body model that initialises registrations of more scans, and write its file.

    Parameters
    ----------
    template : Mesh
        Template of the registrations.
    skeleton : Skeleton
        Of the template.
    poses : (M, N, 3) float, metres
        The template on one subject in several poses.
    shapes : (S, N, 3) float, metres, or None
        The template on other subjects.
    path : Path
        File to write.

    Raises
    ------
    ValueError
        Meshes that a model cannot be learned from, with the reason.
    """
    _load_entry_point("learn", "a model of this set")(template, skeleton, poses, shapes, path)


def find_scanned_person(scan: Mesh | np.ndarray) -> tuple[Mesh, dict[str, int]] | None:
    """Find the person on a scan with the built-in people.

    Parameters
    ----------
    scan : Mesh or (n, 3) float, metres
        A scan of the whole body.

    Returns
    -------
    (Mesh, dict of str to int) or None
        The body of the built-in people that lies on the scan, and their landmarks as its vertices. None where the scan
        shows something else, or a part of a body only.
    """
    return _load_entry_point("person", "a person's body")(scan)


def _load_entry_point(name: str, wanted: str) -> Callable[..., Any]:
    """Load an entry point of the package `model` by its name; ValueError where it is not installed."""
    group = "scapekit.leads"
    matching = [entry for entry in entry_points(group=group) if entry.name == name]
    if not matching:
        raise ValueError(f"{wanted}: scapekit is not installed whole, nothing is known as '{group}' {name}; "
                         "install it, or leave the model out with --through none")
    return matching[0].load()
