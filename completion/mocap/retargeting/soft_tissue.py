"""Pose and soft tissue of a person on a character [MoSh]."""
from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array

from model.body import BodyModel
from model.linear import Subject, posed_product

from ..soft_tissue.soft_tissue import SoftTissue
from .retarget import AT_ONCE, retarget, world_up

SOLES = 60                           # points that may touch the ground


def retarget_soft_tissue(soft: SoftTissue, model: BodyModel, character: BodyModel, factor: float = 1.0) -> SoftTissue:
    """The motion and the soft tissue of a person on a character.

    Joints turn as they did and betas change as they did, around the character instead of the person. The way over the
    ground is as long as the character's legs are, and it reaches the ground when the person does (see `retarget`).

    Parameters
    ----------
    soft : SoftTissue
        Of the person.
    model : BodyModel
        The person's.
    character : BodyModel
        The same with a character as its mean (`character_model`).
    factor : float
        How many times the soft tissue is taken: more than 1 exaggerates it, 0 leaves it out.

    Returns
    -------
    SoftTissue
        Of the character model: the character's own betas are zero, the factor is in the changes.

    Raises
    ------
    ValueError
        A character of other parts, or of fewer betas than change.

    [MoSh]
    """
    K = soft.changes.shape[1]
    if character.n_betas < K:
        raise ValueError(f"character: expected a model with the {K} betas that change, got {character.n_betas}")
    target = character.subject(np.zeros(K))
    motion = retarget(soft.motion, model.subject(soft.motion.betas), target)
    changes = factor * soft.changes
    up, sign = world_up(motion, target)
    soles = _soles(target, motion.poses, up, sign)
    points = character.points(soles, n_betas=K)
    trans = motion.trans.copy()
    for start in range(0, len(trans), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        fixed = points.operator(np.zeros(K)).evaluate(motion.poses[some])[..., up]
        flat = np.ascontiguousarray(points.shape_basis.transpose(1, 3, 0, 2)).reshape(-1, K * len(soles))
        slopes = posed_product(points.terms, flat, motion.poses[some])[..., up, :].reshape(-1, K, len(soles))
        changed = fixed + np.einsum("tkl,tk->tl", slopes, changes[some])
        trans[some, up] += sign * ((sign * fixed).min(axis=1) - (sign * changed).min(axis=1))
    return SoftTissue(replace(motion, trans=trans), changes)


def _soles(subject: Subject, poses: np.ndarray, up: int, sign: float) -> np.ndarray:
    """The vertices that are the lowest of some frame, at most `SOLES`."""
    found = [np.argmin(sign * subject.vertices(poses[i:i + AT_ONCE])[:, :, up], axis=1)
             for i in range(0, len(poses), AT_ONCE)]
    ids, often = np.unique(np.concatenate(found), return_counts=True)
    return np.sort(ids[np.argsort(-often, kind="stable")[:SOLES]])


def deformation(faces: np.ndarray, fixed: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """How far the skin is stretched or squeezed against the same pose without soft tissue.

    Of every triangle the larger of its two stretches, as a share of its length; a vertex has the mean of its
    triangles by area.

    Parameters
    ----------
    faces : (F, 3) int
    fixed, changed : (..., N, 3) float, metres

    Returns
    -------
    (..., N) float
        0.2 where the skin is a fifth longer or shorter.

    [MoSh]
    """
    before, after = (_products(vertices, faces) for vertices in (fixed, changed))
    (a, b, c), (p, q, r) = before, after
    area = a * c - b * b
    safe = np.maximum(area, np.finfo(float).tiny)
    half, whole = (p * c - 2 * q * b + r * a) / safe / 2, (p * r - q * q) / safe
    apart = np.sqrt(np.maximum(half**2 - whole, 0))
    stretches = np.sqrt(np.maximum([half - apart, half + apart], 0))
    strain = np.abs(stretches - 1).max(axis=0)
    weight = np.sqrt(np.maximum(area, 0))
    corners = csr_array((np.ones(faces.size), faces.ravel(), 3 * np.arange(len(faces) + 1)),
                        shape=(len(faces), fixed.shape[-2]))
    total, shares = ((a.reshape(-1, len(faces)) @ corners).reshape(fixed.shape[:-1]) for a in (weight * strain, weight))
    return np.asarray(total / np.maximum(shares, np.finfo(float).tiny))


def _products(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The products (..., F) of the two edges of every triangle: first with itself, with the second, second itself."""
    e = vertices[..., faces[:, 1], :] - vertices[..., faces[:, 0], :]
    f = vertices[..., faces[:, 2], :] - vertices[..., faces[:, 0], :]
    return (e * e).sum(axis=-1), (e * f).sum(axis=-1), (f * f).sum(axis=-1)


def moving_character(character: BodyModel, soft: SoftTissue, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The meshes (n, N, 3), metres, of some frames without and with soft tissue.

    `frames` (n,).
    """
    poses, trans = soft.motion.poses[frames], soft.motion.trans[frames]
    fixed = soft.motion.vertices(character.subject(soft.motion.betas), frames)
    return fixed, character.vertices(poses, soft.betas()[frames], trans)
