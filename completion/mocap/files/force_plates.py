"""Force plates of a C3D file: ground reaction forces for OpenSim, grf.mot.

Plates of types 1 to 4, as the user guide of c3d.org defines them. Axes of a plate: x from corner 2 to corner 1, y from
corner 4 to corner 1, z into the plate.
"""
from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.format_common import UNITS

from .c3d import Parameters, file_parameters, first_frame, point_table, read_analog
from .opensim import write_storage
from .text import MarkerFileError

LOADED = 10.0                        # N: what presses less on a plate is noise, and its centre of pressure anywhere
STOOD_ON = 100.0                     # N: a baseline beyond any drift of an amplifier; somebody stands on the plate
CHANNELS = {1: 6, 2: 6, 3: 8, 4: 6}  # of each type of plate
_NEWTON_METRES = {"nm": 1.0, "ncm": 0.01, "nmm": 0.001}


@dataclass(frozen=True, eq=False)
class GroundReactions:
    """Forces of the ground on a person, in the axes of `JointAngles.ground`; 0 where a plate is not loaded."""

    plates: tuple[int, ...]          # P numbers of the plates, from 1
    rate: float                      # samples per second
    forces: np.ndarray               # (S, P, 3) N
    points: np.ndarray               # (S, P, 3) metres
    moments: np.ndarray              # (S, P, 3) Nm, free moments
    notes: tuple[str, ...]           # plates that are left out, and why

    @property
    def times(self) -> np.ndarray:
        """(S,) float, seconds from the first frame."""
        return np.arange(len(self.forces)) / self.rate


def read_ground_reactions(path: Path, ground: np.ndarray, rate: float, unit: str | None = None
                          ) -> GroundReactions | None:
    """Read the force plates of a C3D file; None where it has none.

    Parameters
    ----------
    path : Path
        The file.
    ground : (3, 3) float
        Axes of the ground, columns x, y (up) and z, in the axes of the file.
    rate : float, frames per second
        Of the points; the analog rate is a multiple.
    unit : str, optional
        Unit of points and plates where the file says a wrong one.

    Returns
    -------
    GroundReactions or None
        A plate that cannot be read is left out, with a note.

    Raises
    ------
    MarkerFileError
        Damaged numbers and types of plates.
    """
    data = storage.read_bytes(path, "a C3D file")
    table = point_table(path, data)
    parameters, own_unit = file_parameters(data, table.numbers), unit or table.unit
    if own_unit not in UNITS:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(UNITS)}, found '{own_unit}'")
    try:
        used = max(int(sum(_own(parameters, "USED", 0, 1))), 0)
        kinds = [int(kind) for kind in _own(parameters, "TYPE", 0, used)]
    except (ValueError, OverflowError) as problem:
        raise MarkerFileError(f"{path}: FORCE_PLATFORM, USED and TYPE: expected whole numbers ({problem})") from None
    notes = [f"FORCE_PLATFORM names {used} plates, and the types of {len(kinds)}"] if len(kinds) < used else []
    plates: dict[int, _Plate] = {}
    for i, kind in enumerate(kinds):
        try:
            plates[i + 1] = _read_plate(path, data, parameters, i, kind, UNITS[own_unit], ground[:, 1])
            notes += [f"force plate {i + 1}: {plates[i + 1].note}"] if plates[i + 1].note else []
        except (ValueError, OverflowError) as problem:
            notes.append(f"force plate {i + 1} is left out: {str(problem).removeprefix(f'{path}: ')}")
    for note in notes:
        warnings.warn(f"{path.name}: {note}", stacklevel=2)
    if not plates:
        return None
    # some systems store what presses on the plate, some the reaction: people press, so the loads tell which
    pressed = np.array([plate.wrench[:, 2] for plate in plates.values()])
    sign = -1.0 if np.nansum(np.where(np.abs(pressed) > LOADED, pressed, 0)) > 0 else 1.0
    parts = [_place(sign * plate.wrench, plate.axes, plate.centre, ground) for plate in plates.values()]
    forces, points, moments = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
    return GroundReactions(tuple(plates), rate * len(forces) / table.frames, forces, points, moments, tuple(notes))


@dataclass(frozen=True, eq=False)
class _Plate:
    """A plate: its axes (3, 3) and centre (3,), metres, force and moment (S, 6) in its axes, and a doubt."""

    axes: np.ndarray
    centre: np.ndarray
    wrench: np.ndarray
    note: str


def _read_plate(path: Path, data: bytes, parameters: Parameters, i: int, kind: int, metres: float, up: np.ndarray
                ) -> _Plate:
    """Read plate i, from 0, of a type; ValueError with what is wrong with it. `metres` is the unit of lengths."""
    if kind not in CHANNELS:
        raise ValueError(f"expected a type of {', '.join(map(str, CHANNELS))}, found {kind}")
    axes, centre = plate_axes(metres * _own(parameters, "CORNERS", i, 12))
    if axes[:, 2] @ up > 0.5:
        raise ValueError("its corners run the other way round, as of a plate on the ceiling")
    width = len(parameters.get(("FORCE_PLATFORM", "CHANNEL"), ())) // len(parameters["FORCE_PLATFORM", "TYPE"])
    channels = _own(parameters, "CHANNEL", i, width)[:CHANNELS[kind]].astype(int) - 1
    if len(channels) < CHANNELS[kind]:
        raise ValueError(f"expected {CHANNELS[kind]} channels, found {len(channels)}")
    signals = read_analog(path, data, channels.tolist())
    if not np.isfinite(signals).all():
        raise ValueError("its channels hold values that are no numbers")
    # the zero level is the mean over the frames from ZERO, which count as the frames of the recording do
    low, high = (int(value) for value in [*_own(parameters, "ZERO", 0, 2), 0, 0][:2])
    samples, first = len(signals) // point_table(path, data).frames, first_frame(data, parameters)
    empty = signals[samples * max(max(low, 1) - first, 0):samples * max(high - first + 1, 0)]
    level = empty.mean(axis=0) if len(empty) else np.zeros(len(channels))
    if kind == 1:
        level[3:5] = 0                   # a centre of pressure has no zero level
    stands = abs(plate_wrench(kind, level[None], parameters, i, channels, metres)[0, 2]) > STOOD_ON
    wrench = plate_wrench(kind, signals if stands else signals - level, parameters, i, channels, metres)
    return _Plate(axes, centre, wrench, f"loaded in frames {max(low, 1)} to {high}, which ZERO calls empty; its zero "
                  "level is left as it is" if stands else "")


def plate_axes(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes (3, 3) of a plate, columns x, y and z into it, and its centre (3,), from 12 numbers in metres.

    ValueError unless the corners are those of a rectangle.
    """
    if len(corners) != 12:
        raise ValueError(f"expected 4 corners of 3 coordinates, found {len(corners)} numbers")
    first, second, third, fourth = corners.reshape(4, 3)
    x, y, sides = first - second, first - fourth, np.linalg.norm([first - second, first - fourth], axis=1)
    # 5 cm to 10 m; corners are measured by hand, real ones are 1% off a rectangle
    if not ((0.05 < sides).all() and (sides < 10).all() and abs(x @ y) < 0.1 * sides.prod()
            and np.linalg.norm(first - second + third - fourth) < 0.05 * sides.min()):
        raise ValueError(f"its corners are no rectangle of 0.05 to 10 m: {np.array2string(corners, precision=4)}")
    z = np.cross(x, y)
    axes = np.stack([x, np.cross(z, x), z], axis=1)
    return axes / np.linalg.norm(axes, axis=0), corners.reshape(4, 3).mean(axis=0)


def plate_wrench(kind: int, signals: np.ndarray, parameters: Parameters, i: int,
                 channels: np.ndarray, metres: float) -> np.ndarray:
    """Compute force, N, and moment about the centre of the surface, Nm, (S, 6), of a plate in its axes.

    `signals` (S, C) are those of its channels, `metres` is the unit of lengths in the file.
    """
    origin = metres * _own(parameters, "ORIGIN", i, 3)
    if len(origin) < 3 or not np.isfinite(origin).all():
        raise ValueError(f"expected an origin of 3 numbers, found {origin.tolist()}")
    units = [re.sub("[^a-z]", "", str(unit).lower()) for unit in parameters.get(("ANALOG", "UNITS"), ())]
    own = [units[channel] if channel < len(units) else "" for channel in channels]
    newton_metres = _NEWTON_METRES.get(own[5], metres)
    # the origin points from the transducers up to the surface; many files have it the other way round
    rise = -origin if origin[2] > 0 and kind != 3 else origin
    if kind == 3:
        a, b, height = abs(origin[0]), abs(origin[1]), -abs(origin[2])
        x12, x34, y14, y23, z1, z2, z3, z4 = signals.T
        force = np.stack([x12 + x34, y14 + y23, z1 + z2 + z3 + z4], axis=1)
        moment = np.stack([b * (z1 + z2 - z3 - z4), a * (z2 + z3 - z1 - z4), b * (x34 - x12) + a * (y14 - y23)], axis=1)
        moment += np.cross(force, [0, 0, height])
        return np.c_[force, _correct_kistler(force, moment, _own(parameters, "FPCOPPOLY", i, 12), metres)]
    if kind == 1:
        # the centre of pressure itself: m = p x F + free moment
        force = signals[:, :3]
        x, y = UNITS.get(own[3], metres) * signals[:, 3:5].T
        turn = newton_metres * signals[:, 5] + x * force[:, 1] - y * force[:, 0]
        return np.c_[force, y * force[:, 2], -x * force[:, 2], turn]
    if kind == 4:
        matrix = _own(parameters, "CAL_MATRIX", i, 36)
        if len(matrix) == 36:
            rows = "".join(map(str, parameters.get(("FORCE_PLATFORM", "MATRIX_STORE"), ()))).upper() == "BYROW"
            signals = signals @ matrix.reshape(6, 6, order="C" if rows else "F").T
        elif own[5] not in _NEWTON_METRES:
            raise ValueError("its type 4 needs CAL_MATRIX, which is not there")
    force, moment = signals[:, :3], newton_metres * signals[:, 3:6]
    return np.c_[force, moment + np.cross(force, rise)]


def _correct_kistler(force: np.ndarray, moment: np.ndarray, powers: np.ndarray, metres: float) -> np.ndarray:
    """Correct moments (S, 3) so that the centre of pressure moves as the maker's polynomial (12,) says, if any."""
    if len(powers) != 12 or not powers.any():
        return moment
    loaded = np.where(np.abs(force[:, 2]) > LOADED, force[:, 2], np.inf)
    x, y = -moment[:, 1] / loaded / metres, moment[:, 0] / loaded / metres
    shift_x, shift_y = ((c[0] * b**4 + c[1] * b**2 + c[2]) * a**3 + (c[3] * b**4 + c[4] * b**2 + c[5]) * a
                        for a, b, c in ((x, y, powers[:6]), (y, x, powers[6:])))
    vertical = np.where(np.isinf(loaded), 0, loaded)
    return moment + metres * np.stack([-shift_y * vertical, shift_x * vertical, 0 * x], axis=1)


def write_ground_reactions(path: Path, reactions: GroundReactions) -> None:
    """Write grf.mot, a Storage file with force, point and free moment of every plate, as OpenSim's tools take it."""
    names, columns = ["time"], [reactions.times[:, None]]
    for p, number in enumerate(reactions.plates):
        for name, values in (("force_{}_v", reactions.forces), ("force_{}_p", reactions.points),
                             ("torque_{}_", reactions.moments)):
            names += [f"ground_{name.format(number)}{axis}" for axis in "xyz"]
            columns.append(values[:, p])
    write_storage(path, names, np.concatenate(columns, axis=1), [
        "Forces of the ground on the person in N, points in metres, free moments in Nm, in the axes of motion.mot.",
        f"0 where less than {LOADED:g} N press on a plate.", *reactions.notes])


def _own(parameters: Parameters, name: str, i: int, width: int) -> np.ndarray:
    """Return the numbers of plate i, `width` of each; fewer where the file has fewer."""
    return np.array(parameters.get(("FORCE_PLATFORM", name), [])[i * width:(i + 1) * width], dtype=np.float64)


def _place(wrench: np.ndarray, axes: np.ndarray, centre: np.ndarray, ground: np.ndarray
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return force, point and free moment (S, 3) in the ground, of the reaction (S, 6) on a plate."""
    Fx, Fy, Fz, Mx, My, Mz = np.where(wrench[:, 2:3] < -LOADED, wrench, np.nan).T
    x, y, flat = -My / Fz, Mx / Fz, 0 * Fz
    parts = (np.stack([Fx, Fy, Fz], axis=1) @ axes.T, centre + np.stack([x, y, flat], axis=1) @ axes.T,
             np.stack([flat, flat, Mz - x * Fy + y * Fx], axis=1) @ axes.T)
    force, point, moment = (np.nan_to_num(part @ ground) for part in parts)
    return force, point, moment
