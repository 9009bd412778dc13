"""Corrections of a layout: markers that were moved, exchanged or removed; and their files."""
from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

from ..marker_sets.layout import MarkerLayout


@dataclass(frozen=True, eq=False)
class Spot:
    """A place of a marker on the skin, valid on any body of a model.

    Attributes
    ----------
    corners : (3,) int
        Vertices.
    weights : (3,) float
    distance : float, metres
        Distance of the marker from the skin.
    loose : bool
        Whether the marker may sit anywhere on its limb.
    """

    corners: np.ndarray
    weights: np.ndarray
    distance: float
    loose: bool = False

    @staticmethod
    def at(surface: Surface, place: np.ndarray, distance: float) -> Spot:
        """Return the spot on a body nearest to a place (3,), metres."""
        found = surface.closest(place[None])
        return Spot(surface.mesh.faces[found.faces[0]], found.bary[0], distance)

    @staticmethod
    def of(layout: MarkerLayout, label: str) -> Spot:
        """Return the spot of a marker of a layout."""
        row, (ids, weights) = layout.labels.index(label), layout.skin
        return Spot(np.resize(ids[row], 3), np.resize(np.append(weights[row], [0, 0]), 3),
                    float(np.asarray(layout.distances)[row]), label in layout.loose)

    def same(self, other: Spot) -> bool:
        """Tell whether another spot is the same."""
        return (_spread(self), self.distance, self.loose) == (_spread(other), other.distance, other.loose)

    def on(self, body: Mesh) -> np.ndarray:
        """Compute the place (3,), metres, on a body."""
        return self.weights @ body.vertices[self.corners]


Spots = Mapping[str, Spot | None]    # label -> spot; None for a marker that was removed


def apply_corrections(layout: MarkerLayout, spots: Spots) -> MarkerLayout:
    """Return a layout with some markers moved or removed."""
    kept = layout.without(list(spots))
    moved = {label: spot for label, spot in spots.items() if spot is not None}
    if moved:
        new_places = MarkerLayout(tuple(moved), np.array([spot.corners for spot in moved.values()]),
                                  np.array([spot.distance for spot in moved.values()]),
                                  np.array([spot.weights for spot in moved.values()]),
                                  loose=tuple(label for label, spot in moved.items() if spot.loose))
        kept = kept.merge(new_places) if kept.labels else new_places
    return replace(kept, aliases={a: label for a, label in layout.aliases.items() if label in kept.labels})


def changes(before: MarkerLayout, after: MarkerLayout) -> dict[str, Spot | None]:
    """Return the corrections that lead from one layout to another; markers only in the second are no change."""
    new = {label: Spot.of(after, label) if label in after.labels else None for label in before.labels}
    return {label: spot for label, spot in new.items() if spot is None or not spot.same(Spot.of(before, label))}


def _spread(spot: Spot) -> dict[int, float]:
    """Return vertex -> weight of a spot, without zeros."""
    return {int(i): float(w) for i, w in zip(spot.corners, spot.weights, strict=True) if w}


def next_file(folder: Path, used: str | None) -> Path:
    """Return the file for corrections, numbered after the one that the folder was made with."""
    folder, before = folder.absolute(), Path(used or "").absolute()
    file = "corrected_layout_{}.json"  # numbered, so that a file that was used is never overwritten
    number = re.fullmatch(file.format(r"(\d+)"), before.name) if before.parent == folder else None
    return folder / file.format(int(number[1]) + 1 if number else 1)
