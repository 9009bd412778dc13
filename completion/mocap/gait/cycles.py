"""Joint angles over normalised gait cycles: mean and standard deviation from strike to strike of the same foot."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry import storage, tables

from ..joint_angles import JointAngles, decompose
from .events import GaitEvents, face_ahead

PERCENT = np.arange(101)
SIDES = {"l": "left", "r": "right"}


@dataclass(frozen=True, eq=False)
class GaitCycles:
    """Joint angles, degrees, over gait cycles of 101 places.

    Angles of the left side are over left cycles, those of the right over right ones. Angles of pelvis, trunk and head
    come twice, as pelvis_tilt_left_cycles and pelvis_tilt_right_cycles.
    """

    names: tuple[str, ...]
    mean: np.ndarray                 # (101, K)
    sd: np.ndarray                   # (101, K), NaN for a single cycle
    counts: np.ndarray               # (K,) cycles that count
    events: GaitEvents

    def columns(self, name: str) -> list[tuple[str, int]]:
        """Return side and column of an angle without side, as hip_flexion, where it has cycles."""
        found = {side: next((i for i, full in enumerate(self.names) if full in (f"{name}_{side}",
                             f"{name}_{SIDES[side]}_cycles")), None) for side in "lr"}
        return [(side, i) for side, i in found.items() if i is not None and self.counts[i]]


def average_cycles(angles: JointAngles, rate: float, events: GaitEvents) -> GaitCycles:
    """Average joint angles over the gait cycles of a walk.

    The pelvis is measured from the way of each cycle, whatever the axes of the room. A cycle in which an angle is NaN
    does not count for that angle.

    Parameters
    ----------
    angles : JointAngles
        Of T frames.
    rate : float, frames per second
        Of the angles.
    events : GaitEvents
        With the cycles.

    Returns
    -------
    GaitCycles
    """
    names, means, deviations, counts = list[str](), list[np.ndarray](), list[np.ndarray](), list[int]()
    frames = np.arange(len(angles.degrees))
    for side, word in SIDES.items():
        own = [i for i, name in enumerate(angles.names) if name[-2:] not in ("_l", "_r") or name.endswith(f"_{side}")]
        curves = np.full((len(events.cycles[side]), len(PERCENT), len(own)), np.nan)
        for curve, (begin, end) in zip(curves, rate * events.cycles[side], strict=True):
            places, degrees = np.linspace(begin, end, len(PERCENT)), _from_the_way(angles, begin, end)
            curve[:] = np.stack([np.interp(places, frames, degrees[:, i]) for i in own], axis=1)
        for k, i in enumerate(own):
            whole = curves[np.isfinite(curves[:, :, k]).all(axis=1), :, k]
            n = len(whole)
            name = angles.names[i]
            names.append(name if name[-2:] in ("_l", "_r") else f"{name}_{word}_cycles")
            means.append(whole.mean(axis=0) if n else np.full(len(PERCENT), np.nan))
            deviations.append(whole.std(axis=0, ddof=1) if n > 1 else np.full(len(PERCENT), np.nan))
            counts.append(n)
    return GaitCycles(tuple(names), np.stack(means, axis=1), np.stack(deviations, axis=1), np.array(counts), events)


def _from_the_way(angles: JointAngles, begin: float, end: float) -> np.ndarray:
    """Return the angles (T, K), degrees, with those of the pelvis measured from the way between two frames."""
    if "pelvis_tilt" not in angles.names:
        return angles.degrees
    cycle, k = slice(int(begin), int(np.ceil(end)) + 1), angles.names.index("pelvis_tilt")
    way = (angles.pelvis[cycle][-1] - angles.pelvis[cycle][0]) * [1, 0, 1]
    # who walks on a treadmill, less than 0.2 m in a cycle, walks where the pelvis faces
    if not np.linalg.norm(way) > 0.2:
        way = face_ahead(angles)[cycle].mean(axis=0)
    turn = Rotation.from_euler("y", -np.arctan2(-way[2], way[0]))
    pelvis = (turn * angles.turns).as_matrix()
    degrees = angles.degrees.copy()
    # + 0 * keeps the cells empty in which no marker tells
    degrees[:, k:k + 3] = np.degrees(decompose(pelvis, "zxy")) * angles.signs + 0 * degrees[:, k:k + 3]
    return degrees


def write_gait(folder: Path, gait: GaitCycles) -> None:
    """Write gait_events.csv, seconds, and gait_cycles.csv: mean, standard deviation and count of every angle."""
    tables.write_table(folder / "gait_events.csv", ("time", "side", "event", "source"),
                       [(f"{time:.5g}", SIDES[side], f"foot {kind}", gait.events.source)
                        for time, side, kind in gait.events.events])
    columns = [f"{name}_{what}" for name in gait.names for what in ("mean", "sd", "count")]
    values = np.stack([gait.mean, gait.sd, np.tile(gait.counts, (len(PERCENT), 1))], axis=2).reshape(len(PERCENT), -1)
    storage.write_file(folder / "gait_cycles.csv", tables.number_table(["percent", *columns], np.c_[PERCENT, values]))
