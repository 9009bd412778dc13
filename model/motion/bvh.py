"""Read BVH: a skeleton with its motion, as in motion databases."""
from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry import tables
from scanprep.geometry.format_common import metres_of
from scanprep.geometry.storage import LARGEST, StorageError, read_bytes, taking_apart

from .moving import MovingSkeleton

USUAL_RATE = 30.0                    # frames a second of a file that does not say: most programs play it so


def read_bvh(path: str | Path, unit: str, rate: float | None = None) -> MovingSkeleton:
    """Read a BVH file as programs write it.

    Rotations are taken in the order of the channels, each about axes that turn with the part. Scale channels are
    ignored. Position channels hold the change of the offset in some programs, and the whole offset in others; the
    reader chooses what gives bones of constant length. Those of the root are its position, unless bones hold changes.
    Each error of the file that could be repaired gives a UserWarning.

    Parameters
    ----------
    path : str or Path
        `.bvh` file.
    unit : "m", "cm", "mm" or "in"
        Unit of the lengths, which the file does not say.
    rate : float, optional
        Frames a second, where the file does not say or says it wrongly.

    Returns
    -------
    MovingSkeleton
        Names, offsets (J, 3), rotations (T, J, 3, 3) and positions (T, J, 3) in metres, in the axes of the file.

    Raises
    ------
    StorageError
        The file is missing or damaged (the message names the line), or holds the skeletons of several people.
    ValueError
        An unknown unit.

    Examples
    --------
    >>> from pathlib import Path
    >>> text = '''HIERARCHY
    ... ROOT Hips
    ... { OFFSET 0 90 0 CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
    ...   End Site { OFFSET 0 10 0 } }
    ... MOTION
    ... Frames: 1
    ... Frame Time: 0.04
    ... 0 90 0 0 0 0
    ... '''
    >>> _ = Path("stand.bvh").write_text(text)
    >>> read_bvh("stand.bvh", "cm")
    MovingSkeleton(1 joints, 1 frames at 25 1/s)
    """
    # hierarchy, then the table of channels, then rotations and positions by forward kinematics
    metre = metres_of(unit)
    data = read_bytes(path, "a BVH file")
    with taking_apart(path, "a BVH file"):
        lines = tables.decode_text(data).splitlines()
    words = _Words(path, lines)
    joints = _read_hierarchy(words)
    table, own_rate = _read_motion(words, joints, rate)
    R, places = _forward_kinematics(joints, table, metre)
    names, parents, offsets, _ = zip(*joints, strict=True)
    return MovingSkeleton(names, np.array(parents), metre * np.array(offsets), R, places, own_rate)


class _Words:
    """The words of a file one after the other, with the line of each."""

    def __init__(self, path: str | Path, lines: list[str]) -> None:
        self.path, self.lines, self.line = path, lines, 0
        self._row: list[str] = []

    def look(self, expected: str) -> str:
        """Return the next word without consuming it."""
        while not self._row:
            if self.line == len(self.lines):
                raise StorageError(f"{self.path}: expected {expected}, the file ends at line {self.line}")
            self._row = self.lines[self.line].replace("{", " { ").replace("}", " } ").split()[::-1]
            self.line += 1
        return self._row[-1]

    def take(self, expected: str) -> str:
        self.look(expected)
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
        if not _is_number(word):
            raise self.wrong(expected, word)
        return float(word.replace(",", "."))

    def whole(self, expected: str, least: int, most: int) -> int:
        value = self.number(expected)
        if value != int(value) or not least <= value <= most:
            raise self.wrong(expected, f"{value:g}")
        return int(value)

    def said(self, key: str, expected: str) -> float:
        """Read the number after a key of words, with or without colon and blanks."""
        self.look(f"{key}:")
        text = " ".join(self._row[::-1])
        found = re.match(key.replace(" ", r"\s*") + r"\s*:?\s*", text, re.IGNORECASE)
        if not found:
            raise self.wrong(f"{key}:", text)
        self._row = text[found.end():].split()[::-1]
        return self.number(expected)

    def name(self) -> str:
        """Read all words up to the opening brace."""
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
    """A joint as the file has it: its offset in the unit of the file, its channels as (kind, axis)."""

    name: str
    parent: int
    offset: list[float]
    channels: list[tuple[str, int]]


def _read_hierarchy(words: _Words) -> list[_Joint]:
    """Read the joints of HIERARCHY; End Sites say nothing that a motion needs."""
    words.keyword("HIERARCHY")
    words.keyword("ROOT")
    names: set[str] = set()
    joints, above = [_read_joint(words, -1, names)], [0]
    while above:
        word = words.keyword("JOINT", "End", "}")
        if word == "}":
            above.pop()
        elif word == "end":
            words.name()
            words.offset()
            words.keyword("}")
        else:
            joints.append(_read_joint(words, above[-1], names))
            above.append(len(joints) - 1)
            if len(above) > 500:                                  # deeper trees are damaged files
                raise words.wrong("at most 500 joints below each other", "more")
    if words.look("MOTION").lower() == "root":
        more = [line.split()[1] for line in words.lines[words.line - 1:] if re.match(r"\s*root\s+\S", line, re.I)]
        raise StorageError(f"{words.path}, line {words.line}: expected the skeleton of one person, found several: "
                           f"{', '.join([joints[0].name, *more])[:80]}; export each to a file of its own")
    return joints


def _read_joint(words: _Words, parent: int, names: set[str]) -> _Joint:
    line, name = words.line, words.name()
    if not name:
        raise StorageError(f"{words.path}, line {line}: expected the name of a joint, found none")
    if name in names:
        twice, name = name, next(new for k in range(2, len(names) + 3) if (new := f"{name}_{k}") not in names)
        warnings.warn(f"{words.path}, line {line}: the joint {twice} comes again; it is called {name}", stacklevel=2)
    names.add(name)
    offset, channels = words.offset(), []
    if words.look("CHANNELS").lower() == "channels":
        words.take("CHANNELS")
        for _ in range(words.whole("the number of channels, 0 to 9", 0, 9)):
            word = words.take("a channel")
            found = re.fullmatch("([xyz])(position|rotation|scale)", word.lower())
            if not found:
                raise words.wrong("a channel as Xposition or Zrotation", word)
            channels.append((found[2], "xyz".index(found[1])))
    if len(set(channels)) != len(channels):
        raise words.wrong("channels that differ", " ".join("xyz"[axis] for _, axis in channels))
    return _Joint(name, parent, offset, channels)


def _forward_kinematics(joints: list[_Joint], table: np.ndarray, metre: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute world rotations (T, J, 3, 3) and positions (T, J, 3), metres, of the joints from their channels (T, C).

    Position channels are the offset itself or its change; whichever keeps bones at the length of the offset is right.
    The joints from the root to the first branch move the body through space and have no fixed length. They follow the
    majority of the bones, and are positions where no bone has such channels. Channels that are always 0 are changes.
    """
    T, J = len(table), len(joints)
    values = np.split(table, np.cumsum([len(joint.channels) for joint in joints])[:-1], axis=1)
    # (T, J, 3) from the parent to each joint, both ways, in the unit of the file
    added = np.tile(np.array([joint.offset for joint in joints], dtype=float), (T, 1, 1))
    instead = added.copy()
    for j, joint in enumerate(joints):
        for k, (kind, axis) in enumerate(joint.channels):
            if kind == "position":
                added[:, j, axis] += values[j][:, k]
                instead[:, j, axis] = values[j][:, k]
    # joints that carry the whole body: from the root to the first branch
    carriers = {0}
    while sum(joint.parent == max(carriers) for joint in joints) == 1:
        carriers.add(next(j for j, joint in enumerate(joints) if joint.parent == max(carriers)))
    length = np.linalg.norm([joint.offset for joint in joints], axis=1)
    off = [np.abs(np.linalg.norm(steps, axis=2) - length).mean(axis=0) for steps in (instead, added)]
    places = [[k for k, (kind, _) in enumerate(joint.channels) if kind == "position"] for joint in joints]
    bones = [j for j in range(J) if j not in carriers and places[j]]
    changes = off[1] < off[0]                                     # of each joint by itself
    most = 2 * changes[bones].sum() > len(bones)
    for j in carriers:
        changes[j] = most or not values[j][:, places[j]].any()
    steps = metre * np.where(changes[:, None], added, instead)
    # rotations and positions, parents first
    R, y = np.empty((T, J, 3, 3)), np.empty((T, J, 3))
    for j, (_, p, _, channels) in enumerate(joints):
        turned = [k for k, (kind, _) in enumerate(channels) if kind == "rotation"]
        own = np.broadcast_to(np.eye(3), (T, 3, 3))
        if turned:
            order = "".join("XYZ"[channels[k][1]] for k in turned)
            own = Rotation.from_euler(order, values[j][:, turned], degrees=True).as_matrix().reshape(T, 3, 3)
        R[:, j] = own if p < 0 else R[:, p] @ own
        y[:, j] = steps[:, j] if p < 0 else y[:, p] + np.einsum("tab,tb->ta", R[:, p], steps[:, j])
    return R, y


def _read_motion(words: _Words, joints: list[_Joint], rate: float | None) -> tuple[np.ndarray, float]:
    """Read the table (T, C) of MOTION and the frames a second."""
    words.keyword("MOTION")
    count = words.said("Frames", "the number of frames")
    time = words.said("Frame Time", "the seconds of a frame")
    if rate is None and not 1e-6 < time < 1e6:
        rate = USUAL_RATE
        warnings.warn(f"{words.path}: its Frame Time is {time:g}: {USUAL_RATE:g} frames a second are assumed; "
                      "say rate=", stacklevel=2)
    wanted = sum(len(joint.channels) for joint in joints)
    if not wanted:
        raise StorageError(f"{words.path}: expected joints with channels, found {len(joints)} joints without")
    # all numbers after the header, wherever the lines break
    first = words.line                                           # numbers begin on a line of their own
    rows = [(first + k + 1, line.split()) for k, line in enumerate(words.lines[first:]) if line.strip()]
    # programs may leave no blank between two numbers, the later one negative
    rows = [(number, row if len(row) >= wanted else re.sub(r"(?<=[\d.])(?=-)", " ", " ".join(row)).split())
            for number, row in rows]
    flat = [word for _, row in rows for word in row]
    frames = len(flat) // wanted
    if frames * len(joints) > 10**6 + 4 * sum(map(len, words.lines)):
        raise StorageError(f"{words.path}: expected frames of joints with channels, found {frames} frames of "
                           f"{len(joints)} joints with {wanted} channels")
    # a wrong count: where most lines hold one frame, name the first line that does not
    if len(flat) != frames * wanted:                             # a frame may be broken into several lines
        odd = [(number, row) for number, row in rows if len(row) != wanted]
        if 0 < len(odd) < len(rows) / 2:
            raise StorageError(f"{words.path}, line {odd[0][0]}: expected the {wanted} numbers of a frame, "
                               f"found {len(odd[0][1])}")
        raise StorageError(f"{words.path}: expected {count:g} frames of {wanted} numbers, found {len(rows)} lines with "
                           f"{len(flat)} numbers")
    if not frames:
        raise StorageError(f"{words.path}: expected at least one frame, found none")
    try:
        table = np.array(flat, dtype=float)
        good = bool((np.abs(table) <= LARGEST).all())
    except ValueError:
        good = False
    if not good:
        wrong = next(((n, w) for n, row in rows for w in row if not _is_number(w)), None)
        if wrong is not None:
            raise StorageError(f"{words.path}, line {wrong[0]}: expected finite numbers, found {wrong[1][:40]!r}")
        table = np.array([float(word.replace(",", ".")) for word in flat])
    if count != frames:
        warnings.warn(f"{words.path}: Frames says {count:g}, there are {frames}", stacklevel=2)
    return table.reshape(frames, wanted), rate or 1 / time


def _is_number(word: str) -> bool:
    """Return whether a word is a finite number, perhaps with a decimal comma."""
    try:
        return abs(float(word.replace(",", "."))) <= LARGEST
    except ValueError:
        return False
