"""Output files of a motion: tables of joint angles, joint centres and residuals, BVH and GLB."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from model.export.bvh import write_bvh
from model.export.conventions import aim_bones
from model.export.correctives import body_correctives, motion_correctives, off_exact
from model.export.glb import write_skinned_glb
from model.linear import Subject, check_subject
from model.motion.files import skeleton_arrays
from model.rig import subject_rig
from scanprep.console import Metric, details
from scanprep.geometry import storage, tables
from scanprep.geometry.farthest_points import spread_indices
from scanprep.pictures.camera import guess_upright

from ...motion import Motion
from ..joint_angles import NOTHING_KNOWN, JointAngles, Known, as_table
from .markers import MarkerSequence
from .opensim import mask_unknown_centres, write_opensim

KEYS = 240                           # frames of a GLB whose bodies are made one by one, where the shape changes


def joint_angles(motion: Motion, subject: Subject) -> Any:
    """Compute the rotation of every part relative to its parent as a table of named columns, for any kind of body.

    It holds rotation vectors, of the root in the world: the direction is the axis, in the axes of the template at rest,
    the length is the angle. Anatomical angles of people, by ISB, are in `angle_table`.

    Parameters
    ----------
    motion : Motion
        Poses (T, J, 3) in radians.
    subject : Subject
        The body that moves.

    Returns
    -------
    pandas.DataFrame, or {str: (T,) float} where pandas is not installed
        The columns of `joint_angles.csv`: "time" in seconds, then degrees, such as "forearm_left_rx".

    Examples
    --------
    >>> from model import load_built_in_model
    >>> still = Motion(np.full((2, 16, 3), 0.1), np.zeros((2, 3)), None, 120.0, np.zeros((2, 0)))
    >>> float(joint_angles(still, load_built_in_model().subject())["head_rx"][1].round(2))
    5.73

    [SCAPE] §8
    """
    return as_table(angle_columns(motion, check_subject(subject).skeleton.names, rotation_vectors(motion)))


def angle_columns(motion: Motion, names: Sequence[str], angles: np.ndarray) -> dict[str, np.ndarray]:
    """Name the columns of rotation vectors (T, J, 3) of parts; the first is the time, seconds."""
    named = {f"{name}_r{axis}": angles[:, j, k] for j, name in enumerate(names) for k, axis in enumerate("xyz")}
    return {"time": motion.times, **named}


def rotation_vectors(motion: Motion) -> np.ndarray:
    """Compute rotation vectors (T, J, 3), degrees; of those of one rotation the nearest to the frame before."""
    turns = motion.poses.copy()
    for t in range(1, len(turns)):
        # add full turns about the axis until it is nearest to the frame before
        angle = np.linalg.norm(turns[t], axis=-1, keepdims=True)
        axis = turns[t] / np.maximum(angle, 1e-12)
        rounds = np.rint(((turns[t - 1] * axis).sum(axis=-1, keepdims=True) - angle) / (2 * np.pi))
        turns[t] += 2 * np.pi * rounds * axis * (angle > 1e-12)
    return np.degrees(turns)


def joint_centres(motion: Motion, subject: Subject) -> np.ndarray:
    """Compute the joint centres of a motion.

    They are affine combinations of the surface around the joints, or the model's own.

    Parameters
    ----------
    motion : Motion
        Poses (T, J, 3) in radians and trans (T, 3) in metres.
    subject : Subject
        The body that moves.

    Returns
    -------
    (T, J, 3) float, metres

    Examples
    --------
    >>> from model import load_built_in_model
    >>> still = Motion(np.zeros((2, 16, 3)), np.zeros((2, 3)), None, 120.0, np.zeros((2, 0)))
    >>> joint_centres(still, load_built_in_model().subject()).shape
    (2, 16, 3)

    [SCAPE] §4.2
    """
    return check_subject(subject).joints(motion.poses, motion.trans)


def write_motion_folder(folder: Path, motion: Motion, subject: Subject, markers: MarkerSequence | None = None,
                        known: Known = NOTHING_KNOWN) -> JointAngles | None:
    """Write motion.npz, .bvh, .trc and .mot, tables of joint angles and centres, and residuals.csv if there are any.

    `markers`, of as many frames, go into the TRC. What is `known` of the joint angles: values between parts that the
    markers do not determine are empty cells. Returned are the angles of the MOT.
    """
    skeleton, T, centres = subject.skeleton, len(motion.poses), joint_centres(motion, subject)
    names, angles = skeleton.names, rotation_vectors(motion)
    if (told := known.told) is not None:
        angles[~(told & told[:, np.maximum(skeleton.parents, 0)])] = np.nan     # unknown if either side is
    motion.save(folder / "motion.npz", **skeleton_arrays(subject.rest_skeleton))
    write_motion_bvh(folder / "motion.bvh", motion, subject)
    columns = angle_columns(motion, names, angles)
    write_numbers(folder / "joint_angles.csv", list(columns), np.column_stack(list(columns.values())))
    write_numbers(folder / "joint_centres.csv", ["time", *(f"{name}_{axis}" for name in names for axis in "xyz")],
                  np.c_[motion.times, mask_unknown_centres(centres, skeleton, told).reshape(T, -1)])
    anatomical = write_opensim(folder, motion, subject, centres, markers, known)
    if motion.labels:
        write_residuals(folder / "residuals.csv", motion)
    return anatomical


def write_residuals(path: Path, motion: Motion) -> None:
    """Write residuals as CSV: time in seconds, mean of the frame, then every marker, metres; empty where not seen."""
    seen = np.isfinite(motion.residuals)
    mean = np.where(seen, motion.residuals, 0).sum(axis=1) / np.where(seen.any(axis=1), seen.sum(axis=1), np.nan)
    write_numbers(path, ["time", "mean", *motion.labels], np.c_[motion.times, mean, motion.residuals])


def write_motion_bvh(path: Path, motion: Motion, subject: Subject) -> None:
    """Write a BVH in centimetres: the bones of the subject at rest, and the motion."""
    rest = subject.vertices(np.zeros((len(subject.skeleton.parents), 3)))
    write_bvh(path, subject.rest_skeleton, motion.poses, motion.trans, motion.rate,
              up=guess_upright(subject.template)[0], body=subject.template.with_vertices(rest))


def write_glb(path: Path, motion: Motion, subject: Subject, bodies: Callable[[np.ndarray], np.ndarray] | None = None,
              colors: np.ndarray | None = None) -> list[Metric]:
    """Write an animated GLB: the subject skinned to its skeleton, with corrective shapes for what skinning misses.

    `bodies` gives the vertices (n, N, 3), metres, of frames (n,) where the shape changes or is smoothed; at most `KEYS`
    frames are requested. `colors` (N, 3) are of the vertices. Returned is the distance from the exact bodies.
    """
    rig, T = subject_rig(subject), len(motion.poses)
    if bodies is None:
        extra = motion_correctives(rig, subject, motion.poses)
    else:
        extra = body_correctives(rig, motion.poses, motion.trans, bodies, spread_indices(T, KEYS))
    rig = replace(rig, mesh=replace(rig.mesh, colors=colors), correctives=extra)
    up, measured = guess_upright(subject.template)[0], spread_indices(T, 40)      # 40 frames to compare
    exact = motion.vertices(subject, measured) if bodies is None else bodies(measured)
    off = 1e3 * off_exact(rig, motion.poses, motion.trans, exact, measured)
    write_skinned_glb(path, aim_bones(rig, up), motion.poses, motion.trans, motion.rate, up)
    return details([Metric(f"{path.name}, distance from the exact body, mean", float(off.mean()), "mm"),
                    Metric("the same, largest", float(off.max()), "mm")])


def write_numbers(path: Path, columns: list[str], rows: np.ndarray) -> None:
    """Write numbers as CSV, whole or not at all; NaN becomes an empty cell."""
    storage.write_file(path, tables.number_table(columns, rows))
