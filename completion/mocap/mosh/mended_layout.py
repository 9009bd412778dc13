"""A layout in which somebody put markers elsewhere, exchanged them, or took them out of use; and the files of these."""
from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

from ..marker_sets.layout import MarkerLayout

FILE = "corrected_layout_{}.json"    # numbered: one that was run with is never written again


@dataclass(frozen=True, eq=False)
class Spot:
    """A place on the skin: vertices (3,) of a triangle and their weights (3,), the same on any body of a model."""

    corners: np.ndarray
    weights: np.ndarray

    @staticmethod
    def at(body: Mesh, place: np.ndarray) -> Spot:
        """That nearest to a place (3,), metres, on a body."""
        found = Surface(body).closest(place[None])
        return Spot(body.faces[found.faces[0]], found.bary[0])

    def on(self, body: Mesh) -> np.ndarray:
        """(3,) metres, on a body."""
        return self.weights @ body.vertices[self.corners]


Spots = Mapping[str, Spot | None]    # of markers by label; None for one out of use


def mended(layout: MarkerLayout, spots: Spots) -> MarkerLayout:
    """A layout with some markers elsewhere, and no longer loose, or without them."""
    kept = layout.without(list(spots))
    moved = {label: spot for label, spot in spots.items() if spot is not None}
    if moved:
        far = dict(zip(layout.labels, np.asarray(layout.distances), strict=True))
        there = MarkerLayout(tuple(moved), np.array([spot.corners for spot in moved.values()]),
                             np.array([far[label] for label in moved]),
                             np.array([spot.weights for spot in moved.values()]))
        kept = kept.joined(there) if kept.labels else there
    return replace(kept, aliases={a: label for a, label in layout.aliases.items() if label in kept.labels})


def changes(before: MarkerLayout, after: MarkerLayout) -> dict[str, Spot | None]:
    """What was done to a layout to get another; markers that are only in the other are no change."""
    found: dict[str, Spot | None] = {label: None for label in before.labels if label not in after.labels}
    (ids, weights), (old, shares) = after.skin, before.skin
    for label in before.labels:
        if label in found:
            continue
        new, was = after.labels.index(label), before.labels.index(label)
        if _spread(ids[new], weights[new]) != _spread(old[was], shares[was]):
            found[label] = Spot(np.resize(ids[new], 3), np.resize(np.append(weights[new], [0, 0]), 3))
    return found


def _spread(ids: np.ndarray, weights: np.ndarray) -> dict[int, float]:
    """The share of each vertex that has one."""
    return {int(i): float(w) for i, w in zip(ids, weights, strict=True) if w}


def next_file(folder: Path, used: str | None) -> Path:
    """Where the corrections of the layout that a folder was made with are written: after those it was made with."""
    folder, before = folder.absolute(), Path(used or "").absolute()
    number = re.fullmatch(FILE.format(r"(\d+)"), before.name) if before.parent == folder else None
    return folder / FILE.format(int(number[1]) + 1 if number else 1)
