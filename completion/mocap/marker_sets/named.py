"""The layouts that come along: usual marker sets on the bodies that are known here."""
from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

if TYPE_CHECKING:
    from .layout import MarkerLayout

FOLDER = Path(__file__).parent / "layouts"
SYNTHETIC = "synthetic people"
OWN = ('write a file {"markersets": [{"distance_from_skin": 0.0095, "indices": {LABEL: VERTEX, ...}}]} '
       "and load it with MarkerLayout.load (--layout FILE)")


def faces_digest(faces: np.ndarray) -> str:
    """16 hexadecimal digits that tell one triangulation from another."""
    return hashlib.sha256(np.ascontiguousarray(faces, dtype="<i8").tobytes()).hexdigest()[:16]


def layout_names() -> tuple[str, ...]:
    """The marker sets that come along."""
    return tuple(sorted({tree["name"] for _, tree in _files()}))


def layout_summaries() -> list[tuple[str, int, str, str]]:
    """Name, number of markers, what it is, and the bodies it is known on, of every set that comes along."""
    out = []
    for name in layout_names():
        trees = [tree for _, tree in _files() if tree["name"] == name]
        count = sum(len(markers["indices"]) for markers in trees[0]["markersets"])
        out.append((name, count, trees[0]["about"], ", ".join(tree["body"]["name"] for tree in trees)))
    return out


def named_layout(name: str, template: Mesh, kept: np.ndarray | None = None) -> MarkerLayout:
    """See `MarkerLayout.named`."""
    from .layout import MarkerLayout

    if name not in layout_names():
        raise ValueError(f"name: expected a marker layout of {', '.join(layout_names())}, got {name!r}; for another, "
                         + OWN)
    bodies = [(path, tree["body"]) for path, tree in _files() if tree["name"] == name]
    digest = faces_digest(template.faces)
    for path, body in bodies:
        if (body["vertices"], body["faces"]) == (len(template.vertices), digest):
            return MarkerLayout.load(path)
    if kept is not None and len(kept) == len(template.vertices):
        for path, body in bodies:
            if body["name"] == SYNTHETIC:
                return _on_kept(MarkerLayout.load(path), template, np.asarray(kept))
    known = ", ".join(f"{body['name']} ({body['vertices']} vertices)" for _, body in bodies)
    raise ValueError(f"template: expected a body on which '{name}' is known: {known}; got another triangulation with "
                     f"{len(template.vertices)} vertices; for this one, {OWN}")


def _on_kept(layout: MarkerLayout, template: Mesh, kept: np.ndarray) -> MarkerLayout:
    """The layout of the synthetic people on a template that kept only some of their vertices."""
    from scanprep.synthetic.topology import load

    from .layout import MarkerLayout

    whole = load().mesh.vertices
    found = Surface(Mesh(whole[kept], template.faces)).closest(whole[layout.vertices])
    return MarkerLayout(layout.labels, template.faces[found.faces], layout.distances, found.bary, layout.aliases,
                        layout.loose)


@cache
def _files() -> tuple[tuple[Path, dict[str, Any]], ...]:
    return tuple((path, storage.read_json(path, "a marker layout")) for path in sorted(FOLDER.glob("*.json")))


def fitting_layout(labels: Sequence[str], template: Mesh, kept: np.ndarray | None = None
                   ) -> tuple[MarkerLayout, str]:
    """The named layout that knows most of some labels, and its name.

    Raises
    ------
    ValueError
        A body on which none is known, or labels of which none knows three.
    """
    found = {name: named_layout(name, template, kept) for name in layout_names()}
    best = max(found, key=lambda name: (len(found[name].matched(labels, 0)), -len(found[name].labels)))
    found[best].matched(labels)
    return found[best], best
