"""OpenSim files of a motion: motion.trc with markers and joint centres, motion.mot with joint angles.

The angles are in anatomical_angles.csv too, with their expected errors. Files for OpenSim are in the axes of its
ground: y up, x where the person faces. Each of these is an axis of the recording, so numbers only change places and
signs.
"""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from model.linear import Subject
from scanprep.console import say
from scanprep.geometry import storage, tables
from scanprep.pictures.camera import stance
from scanprep.skeleton.roles import find_numbered_roles
from scanprep.skeleton.tree import Skeleton
from scanprep.words import printable

from ...motion import Motion
from ..joint_angles import NOTHING_KNOWN, JointAngles, Known, anatomical_angles, ground_axes
from .markers import MarkerSequence, write_markers


def write_opensim(folder: Path, motion: Motion, subject: Subject, centres: np.ndarray,
                  markers: MarkerSequence | None = None, known: Known = NOTHING_KNOWN) -> JointAngles | None:
    """Write motion.trc with markers, if any, and joint centres (T, J, 3), metres; joint angles for a person's body.

    Centres and angles between parts that the markers do not determine are empty cells, as far as that is `known`.
    Returned are the angles.
    """
    angles: JointAngles | None = None
    points = centre_sequence(mask_unknown_centres(centres, subject.skeleton, known.told), subject.skeleton, motion.rate)
    try:
        angles = anatomical_angles(motion, subject, centres, known)
    except ValueError as error:
        say(f"motion.mot is not written: {error}")
        # without a person's parts the ground follows from how the body stands
        up, ahead = stance(subject.template, subject.skeleton.part_rotations(motion.poses)[:, 0])
        ground = ground_axes(np.stack([ahead, up, np.cross(ahead, up)], axis=1), np.eye(3)[None])
    else:
        ground = angles.ground
        if angles.missing:
            say(f"motion.mot has no angles of {', '.join(angles.missing)}, for which this body has no parts")
        write_mot(folder / "motion.mot", angles, motion.rate)
        write_angles(folder / "anatomical_angles.csv", angles, motion.rate)
    # markers first, then joint centres with other labels
    labels, positions, rate = points.labels, points.positions, motion.rate
    if markers is not None:
        labels, rate = (*markers.labels, *unlike(labels, markers.labels)), markers.rate
        positions = np.concatenate([markers.positions, positions], axis=1)
    write_markers(folder / "motion.trc", MarkerSequence(positions @ ground, labels, rate))
    return angles


def remove_distrusted(motion: Motion, markers: MarkerSequence) -> MarkerSequence:
    """Return the markers of a motion with distrusted ones set to NaN; markers that are not in the layout stay."""
    doubted = np.isfinite(motion.residuals) & ~motion.trusted
    return MarkerSequence(np.where(doubted[..., None], np.nan, markers.positions), markers.labels, markers.rate)


def unlike(labels: Sequence[str], others: Sequence[str]) -> list[str]:
    """Append `_` to labels until none is among `others` or comes twice."""
    out: list[str] = []
    for label in labels:
        while label in others or label in out:
            label += "_"
        out.append(label)
    return out


def centre_sequence(centres: np.ndarray, skeleton: Skeleton, rate: float) -> MarkerSequence:
    """Return joint centres (T, J, 3), metres, as markers: hip_r_joint, knee_r_joint, ..., others by their part.

    The root has no joint, so it is left out.
    """
    return MarkerSequence(centres[:, 1:], centre_labels(skeleton), rate)


def mask_unknown_centres(centres: np.ndarray, skeleton: Skeleton, told: np.ndarray | None) -> np.ndarray:
    """Set joint centres (T, J, 3) between two undetermined parts to NaN; `told` (T, J) are the others."""
    if told is None:
        return centres
    return np.where((told | told[:, np.maximum(skeleton.parents, 0)])[..., None], centres, np.nan)


def centre_labels(skeleton: Skeleton) -> tuple[str, ...]:
    """Return the names (J - 1) of all joints but the root's."""
    sided = {j: f"{role[2:]}_{role[0]}_joint" for role, j in
             find_numbered_roles(skeleton.names, skeleton.joints).items() if role[:2] in ("l_", "r_")}
    taken = [sided.get(j, f"{name}_joint") for j, name in enumerate(skeleton.names)][1:]
    return tuple(label if taken.count(label) == 1 else f"{skeleton.names[j]}_joint{j}"
                 for j, label in enumerate(taken, start=1))


def write_angles(path: Path, angles: JointAngles, rate: float) -> None:
    """Write joint angles in degrees as CSV, each beside its expected error, NAME_sd; empty where not determined."""
    columns = angles.columns(rate)
    storage.write_file(path, tables.number_table([*columns], np.stack([*columns.values()], axis=1)))


def write_mot(path: str | Path, angles: JointAngles, rate: float) -> None:
    """Write joint angles in degrees, and the middle of the hips in metres, as a Storage file of OpenSim.

    The pelvis has the signs of OpenSim's models, whatever the convention of the angles.
    """
    first = 3 if "pelvis_tilt" in angles.names else 0               # angles of the pelvis come before its position
    table = np.c_[np.arange(len(angles.degrees)) / rate, angles.degrees[:, :first] * angles.signs[:first],
                  angles.pelvis, angles.degrees[:, first:]]
    names = ("time", *angles.names[:first], "pelvis_tx", "pelvis_ty", "pelvis_tz", *angles.names[first:])
    axes = [f"{'-' if axis.sum() < 0 else '+'}{'xyz'[int(np.abs(axis).argmax())]}" for axis in angles.ground.T]
    write_storage(path, names, table, [
        "Angles are in degrees, pelvis_tx, pelvis_ty and pelvis_tz in metres.",
        f"Axes x, y, z are {', '.join(axes)} of the recording.",
        *([f"No parts for: {', '.join(angles.missing)}."] if angles.missing else []),
        *([f"Seen by no marker, left out: {', '.join(angles.guessed)}."] if angles.guessed else [])])


def write_storage(path: str | Path, names: Sequence[str], table: np.ndarray, remarks: Sequence[str]) -> None:
    """Write columns (T, K) as a Storage file of OpenSim, with remarks in its header."""
    lines = [printable(Path(path).stem), "version=1", f"nRows={len(table)}", f"nColumns={len(names)}",
             "inDegrees=yes", "", *remarks, "", "endheader", "\t".join(names),
             *tables.number_lines(table, "%.8g", "\t")]
    with storage.writing(Path(path)) as beside:
        beside.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
