"""What leads a template to a scan: something that finds a body on it, and where the template's vertices are then.

The package `model` does so by a model of people, or by one of your own; it makes itself known by the entry point
`model` of the group `scapekit.leads`, since nothing here may import it.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol

import numpy as np

from ..geometry.mesh import Mesh
from .person import PersonParts, has_limbs

GROUP = "scapekit.leads"


@dataclass(frozen=True, eq=False)
class Led:
    """A body that was found on a scan.

    `vertices` (N, 3), metres: where those of the template are then; `explained`: share of the scan near the body;
    `doubts`: what speaks against the body, in words.
    """

    vertices: np.ndarray
    explained: float
    doubts: tuple[str, ...] = ()


class Lead(Protocol):
    """Finds bodies on scans, the likeliest first; landmarks are vertices (L,) of the template and points (L, 3)."""

    name: str
    parts: PersonParts | None        # of the template, where the model is of people

    def __call__(self, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None = None
                 ) -> Sequence[Led]: ...


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
    found = [entry for entry in entry_points(group=GROUP) if entry.name == "model"]
    if not found:
        raise ValueError(f"--through {through}: scapekit is not installed whole, nothing is known as '{GROUP}'; "
                         "install it, or leave the model out with --through none")
    return found[0].load()(template, through, progress)
