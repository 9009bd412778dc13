"""What comes out of a motion: tables of joint angles, joint centres and residuals, and files of other programs."""
from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np

from model.export.bvh import write_bvh
from model.linear import PointOperator, Subject
from scanprep.geometry.storage import writing
from scanprep.pictures.camera import upright
from scanprep.skeleton.tree import Skeleton

from ...motion import Motion

AXES = "xyz"


def joint_angles(motion: Motion) -> np.ndarray:
    """(T, J, 3) rotation vectors in degrees: how every part is turned against its parent, the root in the world.

    The vector's direction is the axis, along the axes of the template at rest, its length the angle. Of two vectors
    for the same turn the one nearer to the frame before is taken, so that there are no jumps of a full turn.
    """
    turns = motion.poses.copy()
    for t in range(1, len(turns)):
        angle = np.linalg.norm(turns[t], axis=-1, keepdims=True)
        axis = turns[t] / np.maximum(angle, 1e-12)
        rounds = np.rint(((turns[t - 1] * axis).sum(axis=-1, keepdims=True) - angle) / (2 * np.pi))
        turns[t] += 2 * np.pi * rounds * axis * (angle > 1e-12)
    return np.degrees(turns)


def joint_centres(motion: Motion, subject: Subject) -> np.ndarray:
    """(T, J, 3) metres: where the joints are, as affine combinations of the surface around them."""
    regressor = subject.skeleton.joint_regressor(subject.template)
    M, N, _ = subject.basis.shape
    basis = (regressor @ subject.basis.transpose(1, 0, 2).reshape(N, -1)).reshape(-1, M, 3).transpose(1, 0, 2)
    operator = PointOperator(subject.terms, basis.astype(np.float64), subject.origin)
    return operator.evaluate(motion.poses, motion.trans)


def rest_skeleton(subject: Subject) -> Skeleton:
    """The skeleton with the joints that the subject has at rest."""
    rest = subject.vertices(np.zeros((len(subject.skeleton.parents), 3)))
    return replace(subject.skeleton, joints=subject.skeleton.joint_regressor(subject.template) @ rest)


def write_joint_angles(path: str | Path, motion: Motion, names: tuple[str, ...]) -> None:
    """CSV: time in seconds, then `PART_rx, PART_ry, PART_rz`, the rotation vectors of `joint_angles` in degrees."""
    columns = [f"{name}_r{axis}" for name in names for axis in AXES]
    _write_table(path, ["time", *columns], np.c_[motion.times, joint_angles(motion).reshape(len(motion.poses), -1)])


def write_joint_centres(path: str | Path, motion: Motion, subject: Subject) -> None:
    """CSV: time in seconds, then `PART_x, PART_y, PART_z` of the joint of each part with its parent, metres.

    The first, of the root part, is the centroid of its surface.
    """
    columns = [f"{name}_{axis}" for name in subject.skeleton.names for axis in AXES]
    places = joint_centres(motion, subject).reshape(len(motion.poses), -1)
    _write_table(path, ["time", *columns], np.c_[motion.times, places])


def write_residuals(path: str | Path, motion: Motion) -> None:
    """CSV: time in seconds, the mean of the frame, then every marker, metres; an empty cell where it was not seen."""
    seen = np.isfinite(motion.residuals)
    mean = np.where(seen, motion.residuals, 0).sum(axis=1) / np.where(seen.any(axis=1), seen.sum(axis=1), np.nan)
    _write_table(path, ["time", "mean", *motion.labels], np.c_[motion.times, mean, motion.residuals])


def write_motion_bvh(path: str | Path, motion: Motion, subject: Subject) -> None:
    """BVH in centimetres: the subject's bones at rest, of fixed length, and the motion."""
    body = subject.template.with_vertices(subject.vertices(np.zeros((len(subject.skeleton.parents), 3))))
    write_bvh(path, rest_skeleton(subject), motion.poses, motion.trans, motion.rate, up=upright(subject.template)[0],
              body=body)


def _write_table(path: str | Path, columns: list[str], rows: np.ndarray) -> None:
    """Numbers as CSV, whole or not at all; NaN becomes an empty cell."""
    with writing(path) as beside, open(beside, "w", newline="", encoding="utf-8") as out:
        table = csv.writer(out)
        table.writerow(columns)
        table.writerows(["" if np.isnan(value) else f"{value:.6g}" for value in row] for row in rows.tolist())
