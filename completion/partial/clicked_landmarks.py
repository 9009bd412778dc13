"""Compare clicked landmarks with a completion: which would help, and which are at wrong places."""
from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanprep.geometry.farthest_points import farthest_points
from scanprep.geometry.sides import other_side
from scanprep.viewer.surface_clicks import Clickable

from .completion import Completion

EXCHANGED = "left and right are exchanged"


def pairs_of(places: Mapping[str, np.ndarray], marks: Mapping[str, int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Return landmarks in the form that `complete` takes, None without any."""
    return (np.array([marks[name] for name in places]), np.array(list(places.values()))) if places else None


def far_apart_first(places: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the landmarks with ten that spread over the body first: a few clicks then tell most."""
    names = list(places)
    if not names:
        return {}
    # the ten that are farthest from each other
    first = [names[i] for i in farthest_points(np.array([places[name] for name in names]), min(10, len(names)))]
    return {name: places[name] for name in dict.fromkeys([*first, *names])}


def on_scan(done: Completion, marks: Mapping[str, int], scan: Clickable) -> dict[str, np.ndarray]:
    """Return where the completed body has its landmarks, for those on observed vertices."""
    return {name: scan.nearest(done.completed.vertices[vertex] / done.scale)
            for name, vertex in marks.items() if done.seen[vertex]}


def landmark_doubts(places: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> str:
    """Compare landmarks (3,), metres, with those of a body that was completed without them; return a sentence."""
    wrong = wrong_ones(places, found)
    if not wrong:
        return "all landmarks are where a body found without them has them"
    # landmarks that lie nearer to their partner on the other side than to their own place
    others = {name: found.get(other_side(name) or "", np.full(3, np.inf)) for name in wrong}
    sides = [name for name in wrong if np.linalg.norm(places[name] - others[name]) < wrong[name] / 2]
    if len(sides) > 1 and 2 * len(sides) > len(wrong):
        return f"{EXCHANGED}: press “swap left and right”, then “start over”"
    listed = ", ".join(f"{name} ({1000 * off:.0f} mm)" for name, off in wrong.items())
    return f"a body found without the landmarks has these elsewhere, where the rings are: {listed}"


def wrong_ones(places: Mapping[str, np.ndarray], found: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return landmarks far from where they were found, with the distance in metres, the farthest first."""
    off = {name: float(np.linalg.norm(place - found[name])) for name, place in places.items()}
    # 0.1: metres from the body that was found without the landmark, beyond which it is wrong
    return {name: off[name] for name in sorted(off, key=lambda name: -off[name]) if off[name] > 0.1}


def helpful(done: Completion, marks: Mapping[str, int], places: Mapping[str, np.ndarray]) -> list[str]:
    """Return up to 5 missing landmarks where the expected error is largest, the largest first."""
    error = done.expected_error
    if error is None:
        return []
    far = {name: float(error[vertex]) for name, vertex in marks.items() if name not in places}
    # 0.06: metres, as DOUBTFUL of the completion, beyond which a landmark there would help
    return [name for name in sorted(far, key=lambda name: -far[name]) if far[name] > 0.06][:5]
