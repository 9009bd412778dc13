"""Built-in layouts: common marker sets on the bodies that are known here."""
from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from scanprep.geometry import storage
from scanprep.geometry.landmarks import read_landmarks
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import size
from scanprep.skeleton.tree import Skeleton

from ..files.text import MarkerFileError
from .keypoints import CENTRES, REMEDY, find_keypoints
from .layout import MarkerLayout
from .opensim import opensim_places

FOLDER = Path(__file__).parent / "layouts"
OWN = ('write a file {"markersets": [{"distance_from_skin": 0.0095, "indices": {LABEL: VERTEX, ...}}]} '
       "and load it with MarkerLayout.load (--layout FILE)")


def faces_digest(faces: np.ndarray) -> str:
    """Compute 16 hexadecimal digits that identify a triangulation."""
    return hashlib.sha256(np.ascontiguousarray(faces, dtype="<i8").tobytes()).hexdigest()[:16]


def layout_names() -> tuple[str, ...]:
    """Return the names of the built-in marker sets.

    Returns
    -------
    tuple of str

    Examples
    --------
    >>> "cmu41" in layout_names()
    True

    [MoSh]
    """
    return tuple(sorted({tree["name"] for _, tree in _files()}))


def set_labels(name: str) -> tuple[str, ...]:
    """Return the labels of a built-in marker set."""
    tree = next(tree for _, tree in _files() if tree["name"] == name)
    return tuple(label for markers in tree["markersets"] for label in markers["indices"])


def layout_summaries() -> list[tuple[str, int, str, str]]:
    """Return name, number of markers, description and bodies of every built-in marker set."""
    out = []
    for name in layout_names():
        trees = [tree for _, tree in _files() if tree["name"] == name]
        count = sum(len(markers["indices"]) for markers in trees[0]["markersets"])
        out.append((name, count, trees[0]["about"], ", ".join(tree["body"]["name"] for tree in trees)))
    return out


@take_any_mesh
def load_layout(name: str, template: Mesh | BodyModel, kept: np.ndarray | None = None) -> MarkerLayout:
    """Load a built-in marker set for a known body: the triangles of SCAPE and SPRING, or of the synthetic people.

    Parameters
    ----------
    name : str
        One of `layout_names()`, such as "cmu41".
    template : Mesh or BodyModel
        Recognised by its triangles, in any shape and pose. Of a model its template.
    kept : (N,) int, optional
        The vertices of the synthetic people that a template with fewer triangles kept; a model knows them.

    Returns
    -------
    MarkerLayout

    Raises
    ------
    ValueError
        An unknown set, or a body on which it is not known.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> load_layout("cmu41", model)
    MarkerLayout(41 markers)

    [MoSh]
    """
    if name not in layout_names():
        raise ValueError(f"name: expected a marker layout of {', '.join(layout_names())}, got {name!r}; for another, "
                         + OWN)
    if isinstance(template, BodyModel):
        kept = template.info.get("people_vertices") if kept is None else kept
        template = template.template
    bodies = [(path, tree["body"]) for path, tree in _files() if tree["name"] == name]
    digest = faces_digest(template.faces)
    for path, body in bodies:
        if (body["vertices"], body["faces"]) == (len(template.vertices), digest):
            return MarkerLayout.load(path)
    # a decimated template of the synthetic people: the nearest places on its triangles
    if kept is not None and len(kept) == len(template.vertices):
        for path, body in bodies:
            if body["name"] == "synthetic people":
                from scanprep.synthetic.topology import load_topology

                layout, whole = MarkerLayout.load(path), load_topology().mesh.vertices
                on_kept = Surface(Mesh(whole[np.asarray(kept)], template.faces)).closest(whole[layout.vertices])
                return replace(layout, vertices=template.faces[on_kept.faces], weights=on_kept.bary)
    known = ", ".join(f"{body['name']} ({body['vertices']} vertices)" for _, body in bodies)
    raise ValueError(f"template: expected a body on which '{name}' is known: {known}; got another triangulation with "
                     f"{len(template.vertices)} vertices; for this one, {OWN}")


@cache
def _files() -> tuple[tuple[Path, dict[str, Any]], ...]:
    """Read all built-in layout files, once."""
    return tuple((path, storage.read_json(path, "a marker layout")) for path in sorted(FOLDER.glob("*.json")))


def fitting_layout(labels: Sequence[str], template: Mesh | BodyModel, kept: np.ndarray | None = None
                   ) -> tuple[MarkerLayout, str]:
    """Find the built-in layout that knows most labels, and its name; ValueError where none knows three of them.

    Markers that other built-in sets know by exactly that label are added: SACR worn instead of LPSI and RPSI.
    """
    layouts = {name: load_layout(name, template, kept).with_spellings(labels) for name in layout_names()}
    known = {name: len(layout.match_labels(labels, 0)) for name, layout in layouts.items()}
    best = max(layouts, key=lambda name: (known[name], -len(layouts[name].labels)))
    fewest = 3  # least known labels
    if known[best] < fewest:
        told = ", ".join(f"{name} {count}" for name, count in sorted(known.items(), key=lambda item: -item[1]))
        if keypoints := find_keypoints(labels):
            raise ValueError(f"labels: {', '.join(keypoints)} are {CENTRES}, and no marker set has them: {REMEDY}")
        raise ValueError(f"labels: expected at least {fewest} of a marker set, of these {len(labels)} the sets know "
                         f"{told}. The sets: scape layout list, scape layout show NAME; your own: --layout FILE, which "
                         f"scape pick makes of the model's template. Labels found: {', '.join(labels) or 'none'}")
    fitting = layouts[best]
    for other in layouts.values():
        fitting = fitting.merge(other.select([label for label in other.match_labels(labels, 0) if label not in
                                              (*fitting.labels, *fitting.aliases)]))
    return fitting, best


def choose_layout(model: BodyModel, given: str | Path | None, labels: Sequence[str]) -> tuple[MarkerLayout, str]:
    """Return the layout that is named, or in a file, or the built-in one that fits labels best; and its name."""
    if given is None:
        return fitting_layout(labels, model)
    found = read_layout(given, model.template, model.info.get("people_vertices"), model.skeleton)
    return found.with_spellings(labels), str(given)


def read_layout(given: str | Path, template: Mesh, kept: np.ndarray | None = None, skeleton: Skeleton | None = None
                ) -> MarkerLayout:
    """Read a layout for a body: a built-in name, a layout file, or places clicked on the template, as by `scape pick`.

    With the skeleton of the template, also a marker set of OpenSim (.xml) or a model with one (.osim). MarkerFileError
    for places that are not on the template.

    [SCAPE] §8
    """
    named = layout_or_file(given)
    if isinstance(named, str):
        return load_layout(named, template, kept)
    if named.suffix.lower() in (".xml", ".osim") and skeleton is not None:
        return layout_on(template, opensim_places(named, template, skeleton))[0]
    clicked = named.suffix.lower() != ".json" or named.name.endswith(".mrk.json")
    if not clicked:                      # landmarks are JSON as well
        tree = storage.read_json(named, "a marker layout", MarkerFileError)
        clicked = isinstance(tree, dict) and bool(tree) and "markersets" not in tree and all(
            isinstance(place, list | int) or (isinstance(place, dict) and "face" in place) for place in tree.values())
    if not clicked:
        return MarkerLayout.load(named, len(template.vertices))
    places = read_landmarks(named, template)
    if not places:
        raise MarkerFileError(f"{named}: expected markers in the layout, found none")
    layout, distances = layout_on(template, places)
    far = distances.argmax()
    if distances[far] > 0.015 * size(template):                        # clicks are at most 1.5% of the size off
        raise MarkerFileError(f"{named}: expected places on the model's template, '{layout.labels[far]}' is "
                              f"{1000 * distances[far]:.0f} mm off it; click them on the template")
    return layout


def layout_on(body: Mesh, places: Mapping[str, np.ndarray]) -> tuple[MarkerLayout, np.ndarray]:
    """Make a layout from places (3,), metres, on a body; return it and the distances (L,) of the places from the skin.

    With a body in the model's triangles, completed from a scan of the person with markers, it gives their places on the
    model.

    [SCAPE] §8
    """
    found = Surface(body).closest(np.array(list(places.values())))
    inside = np.clip(found.bary, 0.0, 1.0)                        # rounding errors may be outside the triangle
    weights = inside / inside.sum(axis=1, keepdims=True)
    return MarkerLayout(tuple(places), body.faces[found.faces], weights=weights), found.distances


def layout_or_file(given: str | Path) -> str | Path:
    """Return a name from a command line as text, or a file as Path, so that results depend on its content."""
    if str(given) in layout_names():
        return str(given)
    if not Path(given).exists():
        raise ValueError(f"layout: expected a file or one of {', '.join(layout_names())}, got '{given}'")
    return Path(given)
