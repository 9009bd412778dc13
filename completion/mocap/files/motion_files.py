"""Files of a motion: tables of joint angles, joint centres and residuals, BVH and GLB."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from model.export.bvh import write_bvh
from model.linear import Subject
from scanprep.geometry import tables
from scanprep.pictures.camera import upright

from ...motion import Motion, spread_frames

KEYS = 120                           # most key frames in a GLB


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
    """(T, J, 3) metres: where the joints are, as affine combinations of the surface around them, or the model's own."""
    return subject.operator.joints(subject.joint_regressor).astype(np.float64).evaluate(motion.poses, motion.trans)


def write_motion(folder: Path, motion: Motion, subject: Subject) -> None:
    """motion.npz, motion.bvh, joint_angles.csv, joint_centres.csv and residuals.csv; times are in seconds."""
    names, T = subject.skeleton.names, len(motion.poses)
    motion.save(folder / "motion.npz")
    write_motion_bvh(folder / "motion.bvh", motion, subject)
    write_table(folder / "joint_angles.csv", ["time", *(f"{name}_r{axis}" for name in names for axis in "xyz")],
                np.c_[motion.times, joint_angles(motion).reshape(T, -1)])
    write_table(folder / "joint_centres.csv", ["time", *(f"{name}_{axis}" for name in names for axis in "xyz")],
                np.c_[motion.times, joint_centres(motion, subject).reshape(T, -1)])
    write_residuals(folder / "residuals.csv", motion)


def write_residuals(path: Path, motion: Motion) -> None:
    """CSV: time in seconds, the mean of the frame, then every marker, metres; an empty cell where it was not seen."""
    seen = np.isfinite(motion.residuals)
    mean = np.where(seen, motion.residuals, 0).sum(axis=1) / np.where(seen.any(axis=1), seen.sum(axis=1), np.nan)
    write_table(path, ["time", "mean", *motion.labels], np.c_[motion.times, mean, motion.residuals])


def write_motion_bvh(path: Path, motion: Motion, subject: Subject) -> None:
    """BVH in centimetres: the subject's bones at rest, of fixed length, and the motion."""
    rest = subject.vertices(np.zeros((len(subject.skeleton.parents), 3)))
    skeleton = replace(subject.skeleton, joints=subject.joint_regressor @ rest)
    write_bvh(path, skeleton, motion.poses, motion.trans, motion.rate, up=upright(subject.template)[0],
              body=subject.template.with_vertices(rest))


def write_glb(path: Path, motion: Motion, subject: Subject, vertices: np.ndarray | None = None,
              colors: np.ndarray | None = None, keys: int = KEYS) -> None:
    """An animated GLB that lasts as long as the motion, of at most so many key frames.

    `vertices` (n, N, 3), metres, are of the key frames, where the body changes; else it is the subject's.
    """
    from scanprep.pictures.gltf import write_animated_glb

    chosen, mesh = spread_frames(len(motion.poses), keys), subject.template
    rate = motion.rate * max(len(chosen) - 1, 1) / max(len(motion.poses) - 1, 1)
    write_animated_glb(path, mesh.faces, motion.vertices(subject, chosen) if vertices is None else vertices, rate,
                       colors, upright(mesh)[0], keys)


def write_table(path: Path, columns: list[str], rows: np.ndarray) -> None:
    """Numbers as CSV, whole or not at all; NaN becomes an empty cell."""
    tables.write_table(path, columns, (["" if np.isnan(value) else f"{value:.6g}" for value in row]
                                       for row in rows.tolist()))
