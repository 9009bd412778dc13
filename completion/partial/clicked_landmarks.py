"""What clicked landmarks and a completion tell of each other: which would help, and which are at wrong places."""
from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.sides import other_side
from scanprep.viewer.surface_clicks import Clickable

from .completion import Completion

EXCHANGED = "left and right are exchanged"


def pairs_of(places: Mapping[str, np.ndarray], marks: Mapping[str, int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Landmarks as `complete` takes them; None without any."""
    return (np.array([marks[name] for name in places]), np.array(list(places.values()))) if places else None


def far_apart_first(places: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The same landmarks, those first that lie all over the body: a few clicks are to tell most."""
    names = list(places)
    if not names:
        return {}
    # landmarks that are offered first: far from each other, all over the body
    first = [names[i] for i in farthest_points(np.array([places[name] for name in names]), min(10, len(names)))]
    return {name: places[name] for name in dict.fromkeys([*first, *names])}


def on_scan(done: Completion, marks: Mapping[str, int], scan: Clickable) -> dict[str, np.ndarray]:
    """Where the completed body has its landmarks, of those that the scan shows."""
    return {name: scan.nearest(done.completed.vertices[vertex] / done.scale)
            for name, vertex in marks.items() if done.seen[vertex]}


def landmark_doubts(places: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> str:
    """What landmarks at (3,), metres, are worth beside those of a body that was found without them."""
    wrong = wrong_ones(places, found)
    if not wrong:
        return "all landmarks are where a body found without them has them"
    others = {name: found.get(other_side(name) or "", np.full(3, np.inf)) for name in wrong}
    sides = [name for name in wrong if np.linalg.norm(places[name] - others[name]) < wrong[name] / 2]
    if len(sides) > 1 and 2 * len(sides) > len(wrong):
        return f"{EXCHANGED}: press “swap left and right”, then “start over”"
    told = ", ".join(f"{name} ({1000 * off:.0f} mm)" for name, off in wrong.items())
    return f"a body found without the landmarks has these elsewhere, where the rings are: {told}"


def wrong_ones(places: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Landmarks that are far from where they were found, with how far, metres; the farthest first."""
    off = {name: float(np.linalg.norm(place - found[name])) for name, place in places.items()}
    # metres off from where a body found without it has a landmark that is wrong
    return {name: off[name] for name in sorted(off, key=lambda name: -off[name]) if off[name] > 0.1}


def helpful(done: Completion, marks: Mapping[str, int], places: Mapping[str, np.ndarray]) -> list[str]:
    """Landmarks that are not among the `places` where the body may be far off, the most doubtful first."""
    error = done.expected_error
    if error is None:
        return []
    far = {name: float(error[vertex]) for name, vertex in marks.items() if name not in places}
    # metres that a part may be off, from which on a landmark there is asked for
    return [name for name in sorted(far, key=lambda name: -far[name]) if far[name] > 0.06][:5]
