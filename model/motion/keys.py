"""Key poses in a table, as an animator writes them by hand, interpolated to a motion. [SCAPE-patent] par. 12"""
from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from scanprep.geometry import storage, tables
from scanprep.geometry.format_common import UNITS
from scanprep.judgement import Judgement
from scanprep.ranges import TURNS
from scanprep.skeleton.tree import Skeleton

from .onto import BodyMotion


def holds_keys(path: Path) -> bool:
    """Tell whether a table has columns of joint angles, as joint_angles.csv, and not of markers."""
    if path.suffix.lower() not in (".csv", ".tsv") or not path.is_file():
        return False
    with storage.taking_apart(path, "a table"):
        head = tables.decode_text(storage.read_bytes(path, "a table")).split("\n", 1)[0]
    return any(re.fullmatch(".+_r[xyz]", word.strip(' "\r').lower()) for word in re.split("[,;\t]", head))


def read_keys(path: Path, skeleton: Skeleton, betas: np.ndarray | None = None, unit: str | None = None,
              rate: float | None = None) -> BodyMotion:
    """Read key poses from a table and interpolate them to a motion.

    The columns are `time` in seconds, then `PART_rx, PART_ry, PART_rz` of some parts, their rotation vectors relative
    to the parent in degrees, as in joint_angles.csv: a line of that file is a key. `trans_x, trans_y, trans_z` are
    metres from where the model stands. A part without columns stays at rest; empty cells are no key. Interpolation does
    not overshoot, and values that are equal in two keys stay so between them. Joints turn the shorter way.

    Parameters
    ----------
    path : Path
        CSV or TSV.
    skeleton : Skeleton
        The body's parts.
    betas : (K,) float, optional
        Shape of the body that moves.
    unit : str, optional
        Of the trans columns, else metres.
    rate : float, optional
        Frames per second of the motion, else 30.

    Raises
    ------
    StorageError
        Another table, a part that the body does not have, times that do not increase.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> from model import load_built_in_model
    >>> path = Path(mkdtemp()) / "wave.csv"
    >>> _ = path.write_text("time,upper_arm_right_rx,upper_arm_right_ry,upper_arm_right_rz\\n0,0,0,0\\n1,90,0,0\\n")
    >>> read_keys(path, load_built_in_model().skeleton).poses.shape
    (31, 16, 3)

    [SCAPE-patent] par. 12
    """
    separator, rows = tables.table_rows(path, storage.read_bytes(path, "a table of keys"))
    head, names = [word.lower() for word in rows[0][1]] if rows else [], skeleton.names
    known = {f"{name}_r{axis}".lower(): (j, k) for j, name in enumerate(names) for k, axis in enumerate("xyz")}
    place = ("trans_x", "trans_y", "trans_z")
    # check the header: known columns, each once, and keys below it
    unknown = [word for word in head if word not in known and word not in ("time", *place)]
    if unknown:
        raise storage.StorageError(f"{path}: line 1: expected the columns time, PART_rx, PART_ry, PART_rz, ..., "
                                   f"trans_x, trans_y, trans_z, of the parts {', '.join(names)}, found {unknown[0]!r}")
    if head.count("time") != 1 or len(set(head)) < len(head):
        raise storage.StorageError(f"{path}: line 1: expected a column time and every column once, found "
                                   f"{','.join(head)[:80]}")
    if not rows[1:]:
        raise storage.StorageError(f"{path}: expected keys below the first line, found none")
    # numbers, with times that increase
    table = tables.table_numbers(path, rows[1:], len(head), separator, fill=True)
    lines = [number for number, _ in rows[1:]]
    times = table[:, head.index("time")]
    wrong = np.flatnonzero(~np.isfinite(times) | np.r_[False, ~(np.diff(times) > 0)])
    if len(wrong):
        raise storage.StorageError(f"{path}: line {lines[wrong[0]]}: expected a time in seconds that is later than "
                                   f"that of the key before, found {times[wrong[0]]:g}")
    # 30 frames a second by default; 200,000 frames are nearly two hours, more are times in other units than seconds
    rate = rate or 30.0
    span = (times[-1] - times[0]) * rate
    if span >= 200_000:
        raise storage.StorageError(f"{path}: expected times in seconds, those from {times[0]:g} to {times[-1]:g} would "
                                   f"be {span:.3g} frames at {rate:g} a second")
    at = times[0] + np.arange(int(span + 1e-6) + 1) / rate

    # interpolate every part between its own keys, then the place
    columns = {word: i for i, word in enumerate(head)}
    poses = np.zeros((len(at), len(names), 3))
    for j, name in enumerate(names):
        angles = _coordinates(path, table, columns, [f"{name}_r{axis}".lower() for axis in "xyz"], lines)
        keyed = np.isfinite(angles[:, 0])
        if keyed.any():
            TURNS.check(np.radians(angles[keyed]), f"{path}: {name}")
            poses[:, j] = interpolate_rotations(times[keyed], np.radians(angles[keyed]), at)
    places = _coordinates(path, table, columns, place, lines)
    keyed = np.isfinite(places[:, 0])
    trans = _between(times[keyed], UNITS[unit or "m"] * places[keyed], at) if keyed.any() else np.zeros((len(at), 3))
    return BodyMotion(poses, trans, betas, rate, how=f"between {len(times)} keys")


def judge_keys(poses: np.ndarray) -> Judgement:
    """Judge poses (T, J, 3) from keys, radians: angles that were given in radians by mistake hardly move."""
    largest = float(np.degrees(np.linalg.norm(poses, axis=-1)).max())
    return Judgement.of(check=[f"no joint turns by more than {largest:.2g} degrees; if the table has radians, write "
                               "degrees"] if 0 < largest < 2 * np.pi else [])


def interpolate_rotations(times: np.ndarray, turns: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate rotation vectors (n, 3), radians, at increasing `times` (n,), at times `at` (T,).

    Unit quaternions of continuous sign are interpolated by monotone cubics. A spline of continuous acceleration, such
    as `RotationSpline`, would overshoot: an arm that is held up through two keys would not stay still.

    Examples
    --------
    >>> turns = np.radians([[0, 0, 0], [90, 0, 0]])
    >>> np.degrees(interpolate_rotations(np.array([0, 1]), turns, np.array([0.5]))).round(6).tolist()
    [[45.0, 0.0, 0.0]]
    """
    q = Rotation.from_rotvec(turns).as_quat()
    turned = np.einsum("nc,nc->n", q[1:], q[:-1]) < 0
    q[1:] *= np.where(np.cumsum(turned) % 2, -1.0, 1.0)[:, None]
    return Rotation.from_quat(_between(np.asarray(times), q, np.asarray(at))).as_rotvec()


def _between(times: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate values (n, K) of keys at some times (T,), constant before the first and after the last key."""
    if len(times) == 1:
        return np.repeat(values, len(at), axis=0)
    return PchipInterpolator(times, values)(np.clip(at, times[0], times[-1]))


def _coordinates(path: Path, table: np.ndarray, columns: dict[str, int], wanted: Sequence[str], lines: Sequence[int]
                 ) -> np.ndarray:
    """Return three columns (n, 3) of a table, 0 for missing columns; in a line all or none are NaN."""
    present = [k for k, word in enumerate(wanted) if word in columns]
    values = np.zeros((len(table), 3)) if present else np.full((len(table), 3), np.nan)
    for k in present:
        values[:, k] = table[:, columns[wanted[k]]]
    finite = np.isfinite(values[:, present])
    half = np.flatnonzero(finite.any(axis=1) & ~finite.all(axis=1))
    if len(half):
        raise storage.StorageError(f"{path}: line {lines[half[0]]}: expected numbers in all of "
                                   f"{', '.join(wanted[k] for k in present)}, or in none for a line without this key")
    if np.isinf(values).any():
        raise storage.StorageError(f"{path}: expected finite numbers in {wanted[0]}")
    values[~finite.all(axis=1)] = np.nan
    return values
