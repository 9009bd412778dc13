"""What leads a template to a scan: something that finds a body on it, and where the template's vertices are then.

The package `model` does so by a model of people, or by one of your own, and learns one from a set. It makes itself
known by the entry points `model` and `learn` of the group `scapekit.leads`, since nothing here may import it.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..geometry.mesh import Mesh
from ..skeleton.tree import Skeleton
from .person import PersonParts, has_limbs


class Lead(Protocol):
    """Finds bodies on scans: where the template's vertices (N, 3), metres, are on each, the likeliest body first.

    The next body is sought when it is asked for: whoever is content with the first does not wait for others.
    Landmarks are vertices (L,) of the template and points (L, 3), metres. `model` is where the file of the model lies
    for whoever asks, if it is not where the lead was made.
    """

    name: str
    parts: PersonParts | None        # of the template, where the model is of people

    def __call__(self, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
                 model: Path | None = None) -> Iterable[np.ndarray]: ...


def lead_of(template: Mesh, through: str, progress: Callable[[int, int], None] | None = None) -> Lead | None:
    """What leads a template, or None.

    Parameters
    ----------
    template : Mesh
    through : str
        "none"; "auto", the built-in people for a template that is a person, nothing for others; or the file of a model.
    progress : callable, optional
        Called as progress(done, total).

    Raises
    ------
    ValueError
        A model that cannot lead the template, and why; or a file that is none.
    """
    if through == "none" or (through == "auto" and not has_limbs(template)):
        return None
    return _load_entry_point("model", f"--through {through}")(template, through, progress)


def learn_model(template: Mesh, skeleton: Skeleton, poses: np.ndarray, shapes: np.ndarray | None, path: Path) -> None:
    """Learn a model that leads a template to more scans, and write its file.

    Parameters
    ----------
    template : Mesh
    skeleton : Skeleton
        Of the template.
    poses : (M, N, 3) float, metres
        The template on one subject in several poses.
    shapes : (S, N, 3) float, metres, or None
        The same on others.
    path : Path

    Raises
    ------
    ValueError
        Meshes that cannot teach, and why.
    """
    _load_entry_point("learn", "a model of this set")(template, skeleton, poses, shapes, path)


def _load_entry_point(name: str, wanted: str) -> Callable[..., Any]:
    """What the package `model` makes known by a name; ValueError where it is not installed."""
    group = "scapekit.leads"
    found = [entry for entry in entry_points(group=group) if entry.name == name]
    if not found:
        raise ValueError(f"{wanted}: scapekit is not installed whole, nothing is known as '{group}' {name}; "
                         "install it, or leave the model out with --through none")
    return found[0].load()
