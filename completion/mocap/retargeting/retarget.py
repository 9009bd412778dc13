"""Retarget a motion to another body, or to a body whose shape changes while it moves."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from model.body import BodyModel
from model.linear import Subject, check_subject
from scanprep.geometry import rotations
from scanprep.pictures.camera import guess_upright

from ...motion import Motion

AT_ONCE = 256                        # frames whose meshes are in memory at once


def retarget(motion: Motion, source: Subject, target: Subject) -> Motion:
    """Retarget a motion to another person, whose feet reach the ground when those of the first do.

    Joint rotations stay. The path over the ground is scaled by the ratio of the heights of the roots at rest, from the
    place of the first frame. The height is chosen so that the lowest point of the target is as far above the floor, in
    the same ratio, as that of the source. The floor is where the lowest point of the source is when it is low.
    Residuals of markers are removed: they were another person's.

    Parameters
    ----------
    motion : Motion
        Of the source.
    source, target : Subject
        Of the same model.

    Returns
    -------
    Motion
        The same poses (T, J, 3), new trans (T, 3) in metres, without markers.

    Raises
    ------
    ValueError
        Bodies with different parts.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> still = Motion(np.zeros((4, 16, 3)), np.zeros((4, 3)), None, 120.0, np.zeros((4, 0)))
    >>> tall = retarget(still, model.subject(), model.subject(np.array([2.0])))
    >>> tall.trans.shape, tall.betas.shape
    ((4, 3), (1,))

    [SCAPE] §8
    """
    J = len(check_subject(source).skeleton.parents)
    if len(check_subject(target).skeleton.parents) != J or motion.poses.shape[1] != J:
        raise ValueError(f"target: expected a body of the {J} parts that move, got {len(target.skeleton.parents)}")
    # scale the path over the ground
    up, sign = world_up(motion, source)
    ratio = _stands(target) / _stands(source)
    trans = motion.trans[0] + ratio * (motion.trans - motion.trans[0])
    trans[:, up] = motion.trans[:, up]
    # keep the lowest point at the same relative height above the floor
    low = lowest_heights(source, motion.poses, motion.trans, up, sign)
    floor = np.percentile(low, 2.0)                                  # 2%: robust against single low frames
    trans[:, up] += sign * (floor + ratio * (low - floor) - lowest_heights(target, motion.poses, trans, up, sign))
    none = np.zeros((len(motion.poses), 0))
    return replace(motion, trans=trans, betas=target.betas, residuals=none, labels=(), trusted=none.astype(bool))


def morph_vertices(model: BodyModel, motion: Motion, betas: np.ndarray | Mapping[float, np.ndarray],
                   frames: np.ndarray | slice = slice(None)) -> np.ndarray:
    """Compute the meshes (n, N, 3), metres, of a motion while the shape of the body changes.

    Each frame is moved vertically so that its lowest point is as high as that of the motion's own body.

    Vertices are affine in betas, so a change along a line needs two bodies only. A few frames of a body that changes in
    many directions are computed one by one.

    Parameters
    ----------
    model : BodyModel
        With betas.
    motion : Motion
        Of a person of this model.
    betas : (T, k) float, or {seconds: (k,) float}
        For every frame, or at some times, with linear interpolation.
    frames : indices or slice, optional
        Frames to compute, all by default.

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
    # the directions in which the betas change
    U, size, directions = np.linalg.svd(betas - middle, full_matrices=False)
    used = size > 1e-6 * max(size.max(initial=0), 1.0)
    shares, steps = U[:, used] * size[used], directions[used]
    if len(poses) < 20 * len(steps):                  # one body costs as much as the meshes of 20 frames
        out = model.vertices(poses, betas, trans)
    else:
        first = model.subject(middle)
        out = first.vertices(poses, trans).astype(np.float64)
        for share, step in zip(shares.T, steps, strict=True):
            out += share[:, None, None] * model.operator(middle + step).plus(-1, first.operator).evaluate(poses)
    body = model.subject(motion.betas)
    up, sign = world_up(motion, body)
    low = lowest_heights(body, poses, trans, up, sign)
    out[:, :, up] += (sign * (low - (sign * out[:, :, up]).min(axis=1)))[:, None]
    return out


def betas_over_time(betas: np.ndarray | Mapping[float, np.ndarray], times: np.ndarray) -> np.ndarray:
    """Interpolate betas (T, k) linearly at times (T,) seconds, constant before the first and after the last key."""
    if not isinstance(betas, Mapping):
        return np.asarray(betas, dtype=np.float64)
    if not betas:
        raise ValueError("betas: expected at least one key {seconds: betas}, got none")
    seconds = sorted(betas)
    width = max(len(betas[s]) for s in seconds)
    keys = np.array([np.pad(np.asarray(betas[s], dtype=np.float64), (0, width - len(betas[s]))) for s in seconds])
    return np.stack([np.interp(times, np.array(seconds, dtype=np.float64), column) for column in keys.T], axis=1)


def world_up(motion: Motion, subject: Subject) -> tuple[int, float]:
    """Return the world axis that is up in a motion, and its sign: where the body's up axis points on average."""
    body_up = np.eye(3)[guess_upright(subject.template)[0]]
    mean = (rotations.exp(motion.poses[:, 0]) @ body_up).mean(axis=0)
    axis = int(np.abs(mean).argmax())
    return axis, float(np.sign(mean[axis]) or 1.0)


def lowest_heights(subject: Subject, poses: np.ndarray, trans: np.ndarray, up: int, sign: float) -> np.ndarray:
    """Compute the height (T,), metres, of the lowest point of every frame."""
    return np.concatenate([
        (sign * subject.vertices(poses[i:i + AT_ONCE], trans[i:i + AT_ONCE])[:, :, up]).min(axis=1)
        for i in range(0, len(poses), AT_ONCE)]) if len(poses) else np.zeros(0)


def _stands(subject: Subject) -> float:
    """Compute the height of the root's centroid above the lowest point at rest, metres."""
    up = guess_upright(subject.template)[0]
    rest = subject.vertices(np.zeros((len(subject.skeleton.parents), 3)))
    return float(subject.origin[up] - rest[:, up].min())
