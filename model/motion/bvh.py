"""BVH, read: a skeleton with its motion, as motion databases have it."""
from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry.storage import LARGEST, LARGEST_TEXT, StorageError, read_bytes

from ..export.bvh import UNITS
from .moving import MovingSkeleton

_DEEPEST = 500                       # joints below each other: more is no skeleton


def read_bvh(path: str | Path, unit: str) -> MovingSkeleton:
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
    words, metre = _Words(path, lines), 1 / UNITS[unit]
    joints, ends = _read_hierarchy(words)
    table, rate = _read_motion(words, joints)
    R, places = _posed(joints, table, metre)
    names, parents, offsets, _ = zip(*joints, strict=True)
    return MovingSkeleton(names, np.array(parents), metre * np.array(offsets),
                     {j: metre * np.array(end) for j, end in ends.items()}, R, places, rate)


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

    def offset(self) -> list[float]:
        self.keyword("OFFSET")
        return [self.number("a number of the OFFSET") for _ in range(3)]


class _Joint(NamedTuple):
    """A joint as the file has it: its offset in the unit of the file, its channels as (is a rotation, axis)."""

    name: str
    parent: int
    offset: list[float]
    channels: list[tuple[bool, int]]


def _read_hierarchy(words: _Words) -> tuple[list[_Joint], dict[int, list[float]]]:
    """The joints of HIERARCHY, and the End Sites by the numbers of their joints."""
    words.keyword("HIERARCHY")
    words.keyword("ROOT")
    names: set[str] = set()
    joints, ends, above = [_read_joint(words, -1, names)], {}, [0]
    while above:
        word = words.keyword("JOINT", "End", "}")
        if word == "}":
            above.pop()
        elif word == "end":
            words.name()
            ends[above[-1]] = words.offset()
            words.keyword("}")
        else:
            joints.append(_read_joint(words, above[-1], names))
            above.append(len(joints) - 1)
            if len(above) > _DEEPEST:
                raise words.wrong(f"at most {_DEEPEST} joints below each other", "more")
    return joints, ends


def _read_joint(words: _Words, parent: int, names: set[str]) -> _Joint:
    line, name = words.line, words.name()
    if not name or name in names:
        raise StorageError(f"{words.path}, line {line}: expected joints with names that differ, found {name[:40]!r}")
    names.add(name)
    offset, channels = words.offset(), []
    words.keyword("CHANNELS")
    for _ in range(words.whole("the number of channels, 0 to 6", 0, 6)):
        word = words.take("a channel")
        found = re.fullmatch("([xyz])(position|rotation)", word.lower())
        if not found:
            raise words.wrong("a channel as Xposition or Zrotation", word)
        channels.append((found[2] == "rotation", "xyz".index(found[1])))
    if len(set(channels)) != len(channels):
        raise words.wrong("channels that differ", " ".join("xyz"[axis] for _, axis in channels))
    return _Joint(name, parent, offset, channels)


def _posed(joints: list[_Joint], table: np.ndarray, metre: float) -> tuple[np.ndarray, np.ndarray]:
    """World rotations (T, J, 3, 3) and places (T, J, 3), metres, of the joints by their channels (T, C)."""
    T, J = len(table), len(joints)
    R, y = np.empty((T, J, 3, 3)), np.empty((T, J, 3))
    start = 0
    for j, (_, p, offset, channels) in enumerate(joints):
        values = table[:, start:start + len(channels)]
        start += len(channels)
        turned = [k for k, (is_turn, _) in enumerate(channels) if is_turn]
        mine = np.broadcast_to(np.eye(3), (T, 3, 3))
        if turned:
            order = "".join("XYZ"[channels[k][1]] for k in turned)
            mine = Rotation.from_euler(order, values[:, turned], degrees=True).as_matrix().reshape(T, 3, 3)
        shifted = {axis: metre * values[:, k] for k, (is_turn, axis) in enumerate(channels) if not is_turn}
        step = _stepped(metre * np.array(offset), shifted, j == 0, T)
        R[:, j] = mine if p < 0 else R[:, p] @ mine
        y[:, j] = step if p < 0 else y[:, p] + np.einsum("tab,tb->ta", R[:, p], step)
    return R, y


def _stepped(offset: np.ndarray, moved: dict[int, np.ndarray], root: bool, frames: int) -> np.ndarray:
    """(T, 3) from the parent to a joint, some axes of whose place may have channels."""
    added, instead = np.tile(offset, (frames, 1)), np.tile(offset, (frames, 1))
    for axis, values in moved.items():
        added[:, axis] += values
        instead[:, axis] = values
    if root or not moved:
        return added
    long = np.linalg.norm(offset)
    off = [np.abs(np.linalg.norm(step, axis=1) - long).mean() for step in (instead, added)]
    return instead if off[0] <= off[1] else added


def _read_motion(words: _Words, joints: list[_Joint]) -> tuple[np.ndarray, float]:
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
    wanted = sum(len(joint.channels) for joint in joints)
    size = sum(map(len, words.lines))
    if not wanted or count * len(joints) > 10**6 + 4 * size:          # joints of all frames
        raise StorageError(f"{words.path}: expected frames of joints with channels, found {count} frames of "
                           f"{len(joints)} joints with {wanted} channels in {size} bytes")
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
