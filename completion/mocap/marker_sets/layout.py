"""Marker layouts: where on the body the markers sit."""
from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh

from ..files.text import MarkerFileError

DISTANCE = 0.0095        # metres from the skin to the centre of a common marker


@dataclass(frozen=True, eq=False)
class MarkerLayout:
    """Places of markers on the skin of a body, with their distances from it.

    Parameters
    ----------
    labels : sequence of L strings
        All different.
    vertices : (L,) int, or (L, 3) int
        The vertex below each marker, or three vertices whose weighted mean is the point of the skin.
    distances : (L,) float, metres, or one number
        From the skin to the marker's centre, along the normal.
    weights : (L, 3) float, optional
        For three vertices; each row sums to 1.
    aliases : {label: label}
        Other labels for the same places, where files differ.
    loose : strings
        Labels of markers that may sit anywhere on their limb, not on a point of the anatomy. `vertices` has their usual
        places; `find_person` finds those on one person.
    wands : strings
        Labels of markers that may be on wands. Their distances are those on the skin; `find_person` finds those on one
        person.

    Raises
    ------
    ValueError
        Shapes that do not agree, a label that comes twice, a negative vertex, an alias of an unknown label, an
        unknown label among those that are loose or on wands.

    Examples
    --------
    >>> layout = MarkerLayout(("LKNE", "RKNE"), [120, 340], aliases={"L_KNEE": "LKNE"})
    >>> layout, layout.match_labels(["L_KNEE"], minimum=1)
    (MarkerLayout(2 markers), ('L_KNEE',))

    [MoSh]
    """

    labels: tuple[str, ...]
    vertices: np.ndarray
    distances: np.ndarray | float = DISTANCE
    weights: np.ndarray | None = None
    aliases: Mapping[str, str] = field(default_factory=dict)
    loose: tuple[str, ...] = ()
    wands: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        labels, vertices = tuple(self.labels), np.array(self.vertices, dtype=np.int64)
        L = len(labels)
        if len(set(labels)) < L:
            raise ValueError(f"labels: expected each once, "
                             f"{Counter(labels).most_common(1)[0][0]} comes more often")
        wanted = (L,) if self.weights is None else (L, 3)
        if vertices.shape != wanted:
            raise ValueError(f"vertices: expected shape {wanted} for {L} labels, got {vertices.shape}")
        if (vertices < 0).any():
            raise ValueError(f"vertices: expected numbers from 0, got {vertices.min()}")
        try:
            distances = np.broadcast_to(np.asarray(self.distances, dtype=np.float64), (L,)).copy()
        except ValueError:
            raise ValueError(f"distances: expected one number or {L}, got {np.shape(self.distances)}") from None
        if not np.isfinite(distances).all():
            raise ValueError("distances: expected finite numbers")
        values: dict[str, Any] = {"labels": labels, "vertices": vertices, "distances": distances}
        if self.weights is not None:
            weights = np.array(self.weights, dtype=np.float64)
            if weights.shape != (L, 3) or not np.allclose(weights.sum(axis=1), 1, atol=1e-6):
                raise ValueError(f"weights: expected shape ({L}, 3) with rows that sum to 1, got {weights.shape}")
            values["weights"] = weights
        # labels in aliases, loose and wands must exist
        wrong = [alias for alias, label in self.aliases.items() if label not in labels or alias in labels]
        if wrong:
            raise ValueError(f"aliases: expected new labels for markers of the layout, got {wrong[0]!r} for "
                             f"{self.aliases[wrong[0]]!r}")
        for name, some in (("loose", self.loose), ("wands", self.wands)):
            unknown = [label for label in some if label not in labels]
            if unknown:
                raise ValueError(f"{name}: {', '.join(unknown)} not among {', '.join(labels)}")
            values[name] = tuple(some)
        # store the checked values in the frozen dataclass; arrays become read-only
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        return f"MarkerLayout({len(self.labels)} markers)"

    @staticmethod
    def load(path: str | Path, n_vertices: int | None = None) -> MarkerLayout:
        """Read a layout of `save`, or a file of the same form.

        The form is `{"markersets": [{"type": ..., "distance_from_skin": 0.0095, "indices": {label: vertex}}]}`;
        in place of a vertex there may be `{"vertices": [a, b, c], "weights": [u, v, w]}`, a set may be `"loose": true`
        or `"wand": true`, and beside the sets there may be `"aliases": {other label: label}`.

        Parameters
        ----------
        path : str or Path
            JSON file.
        n_vertices : int, optional
            Number of vertices of the body, to refuse a layout for another one.

        Raises
        ------
        MarkerFileError
            Missing, of another form, a label that comes twice, a vertex that the body does not have.
        """
        path = Path(path)
        tree = storage.read_json(path, "a marker layout", MarkerFileError)
        with storage.taking_apart(path, "a whole marker layout", MarkerFileError):
            sets = tree.get("markersets") if isinstance(tree, Mapping) else None
            if not isinstance(sets, list):
                raise MarkerFileError(f'{path}: expected a marker layout {{"markersets": [...]}}, '
                                      "found something else")
            # one row for each marker: label, place, distance, and the set it belongs to
            rows = []
            for markers in sets:
                indices = markers.get("indices") if isinstance(markers, Mapping) else None
                distance = markers.get("distance_from_skin", DISTANCE) if isinstance(markers, Mapping) else None
                if not isinstance(indices, Mapping) or not isinstance(distance, int | float):
                    raise MarkerFileError(f"{path}: expected marker sets with 'indices' {{label: vertex}} and a number "
                                          f"'distance_from_skin'")
                for label, place in indices.items():
                    if isinstance(place, bool) or not isinstance(place, int | Mapping):
                        raise MarkerFileError(f"{path}: marker '{label}': expected a vertex, found {str(place)[:40]!r}")
                    rows.append((label, place, float(distance), markers))
            if not rows:
                raise MarkerFileError(f"{path}: expected markers in the layout, found none")
            labels, places, distances, owners = zip(*rows, strict=True)
            loose, wands = (tuple(label for label, of in zip(labels, owners, strict=True) if of.get(kind, False))
                            for kind in ("loose", "wand"))
            weights = None
            # vertices and triangles in one file all become triangles
            if not all(isinstance(place, int) for place in places):
                pairs = [([p] * 3, [1.0, 0.0, 0.0]) if isinstance(p, int) else (p["vertices"], p["weights"])
                         for p in places]
                places, weights = zip(*pairs, strict=True)
            layout = MarkerLayout(labels, np.array(places), np.array(distances),
                                  None if weights is None else np.array(weights), dict(tree.get("aliases", {})), loose,
                                  wands)
        if n_vertices is not None:
            layout._check(n_vertices, str(path))
        return layout

    @property
    def skin(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and weights (L, k), k = 1 or 3, of the points of the skin below the markers."""
        ids = self.vertices if self.vertices.ndim == 2 else self.vertices[:, None]
        return ids, np.ones(ids.shape) if self.weights is None else self.weights

    @property
    def nearest(self) -> np.ndarray:
        """The vertex (L,) with the largest weight for each marker."""
        ids, weights = self.skin
        return np.take_along_axis(ids, weights.argmax(axis=1)[:, None], axis=1)[:, 0]

    def skin_points(self, vertices: np.ndarray) -> np.ndarray:
        """Compute the points (L, 3) of the skin below the markers, metres, for vertices (N, 3)."""
        ids, weights = self.skin
        return np.einsum("lk,lkd->ld", weights, vertices[ids])

    def save(self, path: str | Path) -> None:
        """Write as JSON, with one marker set for each distance from the skin; the file is whole or absent."""
        # one set for each distance and kind; markers on triangles have three vertices and weights
        sets: dict[tuple[float, bool, bool], dict[str, Any]] = {}
        for i, (label, distance) in enumerate(zip(self.labels, np.asarray(self.distances).tolist(), strict=True)):
            place: Any = self.vertices[i].tolist()
            if self.weights is not None:
                place = {"vertices": place, "weights": self.weights[i].tolist()}
            sets.setdefault((distance, label in self.loose, label in self.wands), {})[label] = place
        tree: dict[str, Any] = {"markersets": [
            {"type": "body", "distance_from_skin": distance} | ({"loose": True} if loose else {})
            | ({"wand": True} if wand else {})
            | {"indices": indices} for (distance, loose, wand), indices in sets.items()]}
        storage.write_json(path, tree | ({"aliases": dict(self.aliases)} if self.aliases else {}))

    def match_labels(self, labels: Sequence[str], minimum: int = 3) -> tuple[str, ...]:
        """Return the labels that the layout knows, in their order; ValueError for fewer than `minimum`.

        An alias counts only where its marker is missing.
        """
        # an alias is dropped if its marker, or an earlier alias of it, is there too
        names = [label if label in self.labels else self.aliases.get(label) for label in labels]
        found = tuple(label for i, label in enumerate(labels)
                      if names[i] is not None and (names[i] == label or names[i] not in [*labels, *names[:i]]))
        if len(found) < minimum:
            raise ValueError(f"labels: expected at least {minimum} markers of the layout, found {len(found)}; "
                             f"layout: {', '.join(self.labels)}; sequence: {', '.join(labels) or 'none'}")
        return found

    def match_columns(self, labels: Sequence[str], minimum: int = 3) -> tuple[np.ndarray, MarkerLayout]:
        """Return the columns (n,) of a sequence that the layout knows, by `match_labels`, and that part of it."""
        known = self.match_labels(labels, minimum)
        return np.array([list(labels).index(label) for label in known], dtype=int), self.select(known)

    def with_spellings(self, labels: Sequence[str]) -> MarkerLayout:
        """Return the layout with aliases for labels that differ only in case, dots, blanks or dashes."""
        # simplified spelling -> labels; an ambiguous spelling is not used
        meant: dict[str, set[str]] = {}
        for name in (*self.labels, *self.aliases):
            meant.setdefault(_plain(name), set()).add(self.aliases.get(name, name))
        found = {label: meant[_plain(label)] for label in labels
                 if label not in self.labels and label not in self.aliases and _plain(label) in meant}
        more = {label: next(iter(names)) for label, names in found.items() if len(names) == 1}
        return replace(self, aliases={**self.aliases, **more}) if more else self

    def select(self, labels: Sequence[str]) -> MarkerLayout:
        """Return the markers of some labels, in that order; an alias becomes the label."""
        unknown = [label for label in labels if label not in self.labels and label not in self.aliases]
        if unknown:
            raise ValueError(f"labels: {', '.join(unknown)} not among {', '.join(self.labels)}")
        rows = [self.labels.index(self.aliases.get(label, label)) for label in labels]
        loose, wands = (tuple(label for label, row in zip(labels, rows, strict=True) if self.labels[row] in some)
                        for some in (self.loose, self.wands))
        return MarkerLayout(tuple(labels), self.vertices[rows], np.asarray(self.distances)[rows],
                            None if self.weights is None else self.weights[rows], loose=loose, wands=wands)

    def without(self, labels: Sequence[str]) -> MarkerLayout:
        """Return all other markers; an alias removes its marker, and aliases of removed markers are removed."""
        known = {**{label: label for label in self.labels}, **self.aliases}
        unknown = [label for label in labels if label not in known]
        if unknown:
            raise ValueError(f"labels: {', '.join(unknown)} not among {', '.join(self.labels)}")
        gone = {known[label] for label in labels}
        kept = self.select([label for label in self.labels if label not in gone])
        return replace(kept, aliases={a: label for a, label in self.aliases.items() if label not in gone})

    def merge(self, other: MarkerLayout) -> MarkerLayout:
        """Return the markers of both layouts, without common labels; aliases that become labels are dropped."""
        labels, both = (*self.labels, *other.labels), (self, other)
        aliases = {a: label for each in (other, self) for a, label in each.aliases.items() if a not in labels}
        weights = None
        # with weights in either layout, all places become triangles
        if self.weights is None and other.weights is None:
            places = np.concatenate([self.vertices, other.vertices])
        else:
            places = np.concatenate([np.broadcast_to(each.skin[0], (len(each.labels), 3)) for each in both])
            weights = np.concatenate([np.eye(3)[[0] * len(each.labels)] if each.weights is None else each.weights
                                      for each in both])
        return MarkerLayout(labels, places, np.r_[np.asarray(self.distances), np.asarray(other.distances)], weights,
                            aliases, (*self.loose, *other.loose), (*self.wands, *other.wands))

    def with_places(self, places: Mapping[str, int]) -> MarkerLayout:
        """Return the layout with some markers on other vertices, {label: vertex}; an alias moves its marker."""
        vertices, weights = self.vertices.copy(), None if self.weights is None else self.weights.copy()
        for label, vertex in places.items():
            row = self.labels.index(self.aliases.get(label, label))
            vertices[row] = vertex
            if weights is not None:
                weights[row] = [1.0, 0.0, 0.0]
        return replace(self, vertices=vertices, weights=weights)

    def place(self, mesh: Mesh | BodyModel) -> np.ndarray:
        """Compute the positions (L, 3), metres, of the markers on a body: points of the skin, moved along the normal.

        The normal is that of the vertex or of the triangle on which a marker sits. Of a model it is the template.
        """
        mesh = mesh.template if isinstance(mesh, BodyModel) else mesh
        self._check(len(mesh.vertices), "vertices")
        vertices, normals = mesh.vertices[self.vertices], mesh.vertex_normals[self.vertices]
        if self.weights is not None:
            # the triangle's normal, on the side of its vertex normals; without area, that of a vertex
            corners, smooth = vertices, normals
            vertices = self.skin_points(mesh.vertices)
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals *= np.where(np.einsum("ld,lcd->l", normals, smooth) < 0, -1.0, 1.0)[:, None]
            length = np.linalg.norm(normals, axis=1, keepdims=True)
            normals = np.divide(normals, length, out=smooth[:, 0].copy(), where=length > 0)
        return vertices + np.asarray(self.distances)[:, None] * normals

    def _check(self, n_vertices: int, what: str) -> None:
        """Check that all markers are on vertices of a body with so many."""
        outside = [label for label, v in zip(self.labels, self.vertices, strict=True) if np.max(v) >= n_vertices]
        if outside:
            place = self.vertices[self.labels.index(outside[0])].tolist()
            error = ValueError if what == "vertices" else MarkerFileError
            raise error(f"{what}: marker '{outside[0]}' sits on vertex {place}, the body has 0..{n_vertices - 1}")


def _plain(label: str) -> str:
    """Return a label without case, dots, blanks, dashes and underscores."""
    return re.sub(r"[ ._-]", "", label).upper()
