"""BVH, read: any skeleton with its motion, as animation programs and motion databases write it."""
from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry.storage import LARGEST, LARGEST_TEXT, StorageError, read_bytes

from .bvh import UNITS

_DEEPEST = 500                       # joints below each other: more is no skeleton
_VALUES, _REPEATS = 10**6, 4         # joints of all frames, and so many more for each byte
_CHANNEL = re.compile("([xyz])(position|rotation)")


@dataclass(frozen=True, eq=False)
class BvhMotion:
    """A skeleton and its motion, in the axes of the file, which has y up.

    Attributes
    ----------
    names : J strings
        In the order of the file, parent before child.
    parents : (J,) int
        -1 at the root.
    offsets : (J, 3) float, metres
        Each joint from its parent at rest, where no joint is turned.
    ends : {joint number: (3,) float, metres}
        End Sites, from their joint at rest.
    rotations : (T, J, 3, 3) float
        Of every joint in the world: `R_j = R_parent(j) R`.
    places : (T, J, 3) float, metres
        Of every joint in the world.
    rate : float, frames a second
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    ends: dict[int, np.ndarray]
    rotations: np.ndarray
    places: np.ndarray
    rate: float

    def __repr__(self) -> str:
        return f"BvhMotion({len(self.names)} joints, {len(self.places)} frames at {self.rate:g} 1/s)"

    @cached_property
    def rest(self) -> np.ndarray:
        """(J, 3) float, metres: the joints where no joint is turned, the root at its offset."""
        out = self.offsets.copy()
        for j in range(1, len(out)):
            out[j] += out[self.parents[j]]
        return out


def read_bvh(path: str | Path, unit: str) -> BvhMotion:
    """Read a BVH file.

    Turns are taken in the order of the channels, each about axes that turn with the part. Position channels of the
    root are added to its offset. Of the other joints some programs write the change of the offset, others the offset
    itself, changed: what comes nearer to bones of constant length is taken.

    Parameters
    ----------
    path : str or Path
    unit : "m", "cm", "mm" or "in"
        Of the lengths, which the file does not say.

    Raises
    ------
    StorageError
        Missing, or damaged: the error names the line.
    ValueError
        An unknown unit.
    """
    if unit not in UNITS:
        raise ValueError(f"unit: expected one of {', '.join(UNITS)}, got {unit!r}")
    data = read_bytes(path, "a BVH file")
    if len(data) > LARGEST_TEXT:
        raise StorageError(f"{path}: expected a BVH file of at most {LARGEST_TEXT} bytes, found {len(data)}")
    lines = data.decode("utf-8-sig", "replace").splitlines()
    words = _Words(path, lines)
    tree = _Tree(words)
    table, rate = _motion(words, tree)
    return tree.moved(table, 1 / UNITS[unit], rate)


class _Words:
    """The words of a file one after the other, with the line of each."""

    def __init__(self, path: str | Path, lines: list[str]) -> None:
        self.path, self.lines, self.line = path, lines, 0
        self._row: list[str] = []

    def take(self, expected: str) -> str:
        while not self._row:
            if self.line == len(self.lines):
                raise StorageError(f"{self.path}: expected {expected}, the file ends at line {self.line}")
            self._row = self.lines[self.line].replace("{", " { ").replace("}", " } ").split()[::-1]
            self.line += 1
        return self._row.pop()

    def wrong(self, expected: str, found: str) -> StorageError:
        return StorageError(f"{self.path}, line {self.line}: expected {expected}, found {found[:40]!r}")

    def keyword(self, *expected: str) -> str:
        words = " or ".join(expected)
        word = self.take(words)
        if word.lower() not in {each.lower() for each in expected}:
            raise self.wrong(words, word)
        return word.lower()

    def number(self, expected: str) -> float:
        word = self.take(expected)
        try:
            value = float(word)
        except ValueError:
            raise self.wrong(expected, word) from None
        if not abs(value) <= LARGEST:
            raise self.wrong(expected, word)
        return value

    def whole(self, expected: str, least: int, most: int) -> int:
        value = self.number(expected)
        if value != int(value) or not least <= value <= most:
            raise self.wrong(expected, f"{value:g}")
        return int(value)

    def name(self) -> str:
        """All words up to the opening brace."""
        found: list[str] = []
        while (word := self.take("'{' after the name of a joint")) != "{":
            if word == "}" or len(found) > 20:
                raise self.wrong("'{' after the name of a joint", word)
            found.append(word)
        return " ".join(found)


class _Tree:
    """HIERARCHY: joints, offsets and channels in the units of the file."""

    def __init__(self, words: _Words) -> None:
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.channels: list[list[tuple[bool, int]]] = []         # (is a rotation, axis)
        self.ends: dict[int, list[float]] = {}
        words.keyword("HIERARCHY")
        words.keyword("ROOT")
        self._open(words, -1)
        above = [0]
        while above:
            word = words.keyword("JOINT", "End", "}")
            if word == "}":
                above.pop()
            elif word == "end":
                words.name()
                self.ends[above[-1]] = self._offset(words)
                words.keyword("}")
            else:
                self._open(words, above[-1])
                above.append(len(self.names) - 1)
                if len(above) > _DEEPEST:
                    raise words.wrong(f"at most {_DEEPEST} joints below each other", "more")

    def _open(self, words: _Words, parent: int) -> None:
        line, name = words.line, words.name()
        if not name or name in self.names:
            raise StorageError(f"{words.path}, line {line}: expected joints with names that differ, "
                               f"found {name[:40]!r}")
        self.names.append(name)
        self.parents.append(parent)
        self.offsets.append(self._offset(words))
        words.keyword("CHANNELS")
        mine: list[tuple[bool, int]] = []
        for _ in range(words.whole("the number of channels, 0 to 6", 0, 6)):
            word = words.take("a channel")
            found = _CHANNEL.fullmatch(word.lower())
            if not found:
                raise words.wrong("a channel as Xposition or Zrotation", word)
            mine.append((found[2] == "rotation", "xyz".index(found[1])))
        if len(set(mine)) != len(mine):
            raise words.wrong("channels that differ", " ".join("xyz"[axis] for _, axis in mine))
        self.channels.append(mine)

    @staticmethod
    def _offset(words: _Words) -> list[float]:
        words.keyword("OFFSET")
        return [words.number("a number of the OFFSET") for _ in range(3)]

    def moved(self, table: np.ndarray, metre: float, rate: float) -> BvhMotion:
        T, J = len(table), len(self.names)
        offsets = metre * np.array(self.offsets)
        R, y = np.empty((T, J, 3, 3)), np.empty((T, J, 3))
        start = 0
        for j, channels in enumerate(self.channels):
            values = table[:, start:start + len(channels)]
            start += len(channels)
            turned = [k for k, (is_turn, _) in enumerate(channels) if is_turn]
            mine = np.broadcast_to(np.eye(3), (T, 3, 3))
            if turned:
                order = "".join("XYZ"[channels[k][1]] for k in turned)
                mine = Rotation.from_euler(order, values[:, turned], degrees=True).as_matrix().reshape(T, 3, 3)
            step = np.broadcast_to(offsets[j], (T, 3))
            shifted = {axis: k for k, (is_turn, axis) in enumerate(channels) if not is_turn}
            if shifted:
                step = _stepped(offsets[j], {a: metre * values[:, k] for a, k in shifted.items()}, j == 0, T)
            p = self.parents[j]
            R[:, j] = mine if p < 0 else R[:, p] @ mine
            y[:, j] = step if p < 0 else y[:, p] + np.einsum("tab,tb->ta", R[:, p], step)
        ends = {j: metre * np.array(end) for j, end in self.ends.items()}
        return BvhMotion(tuple(self.names), np.array(self.parents), offsets, ends, R, y, rate)


def _stepped(offset: np.ndarray, moved: dict[int, np.ndarray], root: bool, frames: int) -> np.ndarray:
    """(T, 3) from the parent to a joint whose place has channels."""
    added, instead = np.tile(offset, (frames, 1)), np.tile(offset, (frames, 1))
    for axis, values in moved.items():
        added[:, axis] += values
        instead[:, axis] = values
    if root:
        return added
    long = np.linalg.norm(offset)
    off = [np.abs(np.linalg.norm(step, axis=1) - long).mean() for step in (instead, added)]
    return instead if off[0] <= off[1] else added


def _motion(words: _Words, tree: _Tree) -> tuple[np.ndarray, float]:
    """The table (T, C) of MOTION and the frames a second."""
    words.keyword("MOTION")
    if words.keyword("Frames:", "Frames") == "frames":
        words.keyword(":")
    count = words.whole("the number of frames", 0, 10**9)
    words.keyword("Frame")
    if words.keyword("Time:", "Time") == "time":
        words.keyword(":")
    time = words.number("the seconds of a frame")
    if not 1e-6 < time < 1e6:
        raise words.wrong("the seconds of a frame", f"{time:g}")
    wanted, joints = sum(map(len, tree.channels)), len(tree.names)
    size = sum(map(len, words.lines))
    if not wanted or count * joints > _VALUES + _REPEATS * size:
        raise StorageError(f"{words.path}: expected frames of joints with channels, found {count} frames of {joints} "
                           f"joints with {wanted} channels in {size} bytes")
    first = words.line                                           # numbers begin on a line of their own
    rows = [(first + k + 1, line.split()) for k, line in enumerate(words.lines[first:]) if line.strip()]
    flat = [word for _, row in rows for word in row]
    if len(flat) != count * wanted:                              # a frame may be broken into several lines
        odd = [(number, row) for number, row in rows if len(row) != wanted]
        if 0 < len(odd) < len(rows) / 2:
            raise StorageError(f"{words.path}, line {odd[0][0]}: expected the {wanted} numbers of a frame, "
                               f"found {len(odd[0][1])}")
        raise StorageError(f"{words.path}: expected {count} frames of {wanted} numbers, found {len(rows)} lines with "
                           f"{len(flat)} numbers")
    try:
        table = np.array(flat, dtype=float)
        good = bool((np.abs(table) <= LARGEST).all())
    except ValueError:
        good = False
    if not good:
        number, word = next((n, w) for n, row in rows for w in row if not _is_number(w))
        raise StorageError(f"{words.path}, line {number}: expected finite numbers, found {word[:40]!r}")
    if not count:
        raise StorageError(f"{words.path}: expected at least one frame, found none")
    return table.reshape(count, wanted), 1 / time


def _is_number(word: str) -> bool:
    try:
        return abs(float(word)) <= LARGEST
    except ValueError:
        return False
