"""A motion on another body, and on a body that changes while it moves."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry import rotations
from scanprep.pictures.camera import guess_upright

from ...motion import Motion

AT_ONCE = 256                        # frames whose meshes are held at a time


def retarget(motion: Motion, source: Subject, target: Subject) -> Motion:
    """The motion on another person, whose feet reach the ground when those of the first do.

    Joints turn as they did. The way over the ground is as long as the legs are: from the place of the first frame it
    is scaled by the ratio of how high the root stands at rest. Up and down, the lowest point of the target is
    as high above the floor, in the same ratio, as that of the source; the floor is where the source's lowest point
    mostly is when it is low. Residuals of markers are left out: they were another person's.

    Parameters
    ----------
    motion : Motion
    source, target : Subject
        Of the same model.

    Raises
    ------
    ValueError
        Bodies of different parts.
    """
    J = len(source.skeleton.parents)
    if len(target.skeleton.parents) != J or motion.poses.shape[1] != J:
        raise ValueError(f"target: expected a body of the {J} parts that move, got {len(target.skeleton.parents)}")
    up, sign = world_up(motion, source)
    ratio = _stands(target) / _stands(source)
    trans = motion.trans[0] + ratio * (motion.trans - motion.trans[0])
    trans[:, up] = motion.trans[:, up]
    low = lowest_heights(source, motion.poses, motion.trans, up, sign)
    floor = np.percentile(low, 2.0)                                  # where the lowest points are when they are low
    trans[:, up] += sign * (floor + ratio * (low - floor) - lowest_heights(target, motion.poses, trans, up, sign))
    none = np.zeros((len(motion.poses), 0))
    return replace(motion, trans=trans, betas=target.betas, residuals=none, labels=(), trusted=none.astype(bool))


def morph_vertices(model: BodyModel, motion: Motion, betas: np.ndarray | Mapping[float, np.ndarray],
                   frames: np.ndarray | slice = slice(None), grounded: bool = True) -> np.ndarray:
    """The meshes (n, N, 3), metres, of a motion while the body changes.

    Vertices are affine in betas, so a change along a line needs no more than two bodies. Few frames of a body that
    changes in many ways are made one by one.

    Parameters
    ----------
    model : BodyModel
    motion : Motion
    betas : (T, k) float, or {seconds: (k,) float}
        For every frame, or at some times and straight between them.
    frames : indices or slice, optional
    grounded : bool
        Move each frame up or down so that the lowest point is as high as that of the motion's own body.

    Raises
    ------
    ValueError
        Betas for another number of frames, or more than the model has.

    [SCAPE] §8
    """
    betas = betas_over_time(betas, motion.times)
    if betas.ndim != 2 or len(betas) != len(motion.poses) or betas.shape[1] > model.n_betas:
        raise ValueError(f"betas: expected ({len(motion.poses)}, k) with k at most {model.n_betas}, got {betas.shape}")
    poses, trans, betas = motion.poses[frames], motion.trans[frames], betas[frames]
    middle = betas.mean(axis=0)
    U, size, directions = np.linalg.svd(betas - middle, full_matrices=False)
    some = size > 1e-6 * max(size.max(initial=0), 1.0)
    shares, steps = U[:, some] * size[some], directions[some]
    if len(poses) < 20 * len(steps):                  # making a body costs as much as the meshes of 20 frames
        out = model.vertices(poses, betas, trans)
    else:
        first = model.subject(middle)
        out = first.vertices(poses, trans).astype(np.float64)
        for share, step in zip(shares.T, steps, strict=True):
            out += share[:, None, None] * model.operator(middle + step).plus(-1, first.operator).evaluate(poses)
    if grounded:
        own = model.subject(motion.betas)
        up, sign = world_up(motion, own)
        low = lowest_heights(own, poses, trans, up, sign)
        out[:, :, up] += (sign * (low - (sign * out[:, :, up]).min(axis=1)))[:, None]
    return out


def betas_over_time(betas: np.ndarray | Mapping[float, np.ndarray], times: np.ndarray) -> np.ndarray:
    """(T, k) betas at times (T,) seconds, straight between keys and held before the first and after the last."""
    if not isinstance(betas, Mapping):
        return np.asarray(betas, dtype=np.float64)
    if not betas:
        raise ValueError("betas: expected at least one key {seconds: betas}, got none")
    seconds = sorted(betas)
    width = max(len(betas[s]) for s in seconds)
    keys = np.array([np.pad(np.asarray(betas[s], dtype=np.float64), (0, width - len(betas[s]))) for s in seconds])
    return np.stack([np.interp(times, np.array(seconds, dtype=np.float64), column) for column in keys.T], axis=1)


def world_up(motion: Motion, subject: Subject) -> tuple[int, float]:
    """The axis of the world that is up in a motion, and which way: where the body's own up points on average."""
    body_up = np.eye(3)[guess_upright(subject.template)[0]]
    mean = (rotations.exp(motion.poses[:, 0]) @ body_up).mean(axis=0)
    axis = int(np.abs(mean).argmax())
    return axis, float(np.sign(mean[axis]) or 1.0)


def lowest_heights(subject: Subject, poses: np.ndarray, trans: np.ndarray, up: int, sign: float) -> np.ndarray:
    """(T,) metres: the height of the lowest point of every frame."""
    return np.concatenate([
        (sign * subject.vertices(poses[i:i + AT_ONCE], trans[i:i + AT_ONCE])[:, :, up]).min(axis=1)
        for i in range(0, len(poses), AT_ONCE)]) if len(poses) else np.zeros(0)


def _stands(subject: Subject) -> float:
    """How high the root's centroid stands above the lowest point at rest, metres."""
    up = guess_upright(subject.template)[0]
    rest = subject.vertices(np.zeros((len(subject.skeleton.parents), 3)))
    return float(subject.origin[up] - rest[:, up].min())
