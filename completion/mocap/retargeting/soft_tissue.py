"""Retarget pose and soft tissue of a person to a character [MoSh]: motion, pictures, smoothed creases."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components

from model.body import BodyModel
from model.fitting.bodies import at_rest
from scanprep.console import Metric
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import harmonic
from scanprep.pictures.colors import color_bar, heat
from scanprep.pictures.shading import contact_sheet
from scanprep.skeleton.tree import Skeleton

from ...motion_pictures import bodies_in_a_row, seconds
from ..files.motion_files import KEYS, write_glb
from ..soft_tissue.soft_tissue import SoftTissue
from .retarget import AT_ONCE, retarget, world_up


def retarget_soft_tissue(soft: SoftTissue, model: BodyModel, character: BodyModel, factor: float = 1.0) -> SoftTissue:
    """Retarget motion and soft tissue of a person to a character.

    Joint rotations and displacements of the skin stay the same. The path over the ground is scaled to the character's
    legs, and the character reaches the ground when the person does (see `retarget`).

    Parameters
    ----------
    soft : SoftTissue
        Of the person.
    model : BodyModel
        The person's.
    character : BodyModel
        The same model with a character as its mean (`character_model`).
    factor : float
        Factor on the soft tissue: more than 1 exaggerates it, 0 leaves it out.

    Returns
    -------
    SoftTissue
        Of the character model, with zero betas; the factor is in the soft tissue.

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
    moving = replace(soft.times(factor), motion=motion)
    up, sign = world_up(motion, target)
    # the soles: the 60 vertices that are the lowest in most frames
    lowest = [np.argmin(sign * target.vertices(motion.poses[i:i + AT_ONCE])[:, :, up], axis=1)
              for i in range(0, len(motion.poses), AT_ONCE)]
    ids, often = np.unique(np.concatenate(lowest), return_counts=True)
    soles = np.sort(ids[np.argsort(-often, kind="stable")[:60]])
    # lift every frame so that soft tissue of the soles does not change their height
    trans = motion.trans.copy()
    fixed, changed = (sign * each.points(character, soles[:, None], np.ones((len(soles), 1)))[..., up]
                      for each in (moving.times(0.0), moving))
    trans[:, up] += sign * (fixed.min(axis=1) - changed.min(axis=1))
    return replace(moving, motion=replace(motion, trans=trans))


def deformation(faces: np.ndarray, fixed: np.ndarray, changed: np.ndarray) -> np.ndarray:
    """Compute how far soft tissue stretches or squeezes the skin in each pose.

    For each triangle it is the larger of the two principal stretches minus 1. A vertex has the mean of its triangles,
    weighted by area.

    Parameters
    ----------
    faces : (F, 3) int
        Triangles.
    fixed : (..., N, 3) float, metres
        Vertices without soft tissue.
    changed : (..., N, 3) float, metres
        Vertices with soft tissue.

    Returns
    -------
    (..., N) float
        0.2 where the skin is a fifth longer or shorter.

    [MoSh]
    """
    # first fundamental forms: products of the two edges e, f of every triangle, e·e, e·f, f·f
    products = []
    for vertices in (fixed, changed):
        e, f = (vertices[..., faces[:, k], :] - vertices[..., faces[:, 0], :] for k in (1, 2))
        products.append(((e * e).sum(axis=-1), (e * f).sum(axis=-1), (f * f).sum(axis=-1)))
    (a, b, c), (p, q, r) = products
    area = a * c - b * b
    safe = np.maximum(area, np.finfo(float).tiny)
    # squared stretches are the eigenvalues of the deformed form relative to the fixed one: half ± apart
    half, whole = (p * c - 2 * q * b + r * a) / safe / 2, (p * r - q * q) / safe
    apart = np.sqrt(np.maximum(half**2 - whole, 0))
    stretches = np.sqrt(np.maximum([half - apart, half + apart], 0))
    strain = np.abs(stretches - 1).max(axis=0)
    # means of the triangles at each vertex
    weight = np.sqrt(np.maximum(area, 0))
    corners = csr_array((np.ones(faces.size), faces.ravel(), 3 * np.arange(len(faces) + 1)),
                        shape=(len(faces), fixed.shape[-2]))
    total, shares = ((a.reshape(-1, len(faces)) @ corners).reshape(fixed.shape[:-1]) for a in (weight * strain, weight))
    return np.asarray(total / np.maximum(shares, np.finfo(float).tiny))


def moving_character(character: BodyModel, soft: SoftTissue, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute meshes (n, N, 3), metres, of some frames (n,) without and with soft tissue."""
    return soft.motion.vertices(character.subject(soft.motion.betas), frames), soft.vertices(character, frames)


FULL = 0.2                           # deformation at the end of the heat map, a fifth longer or shorter


def picture_transfer(model: BodyModel, soft: SoftTissue, character: BodyModel, moved: SoftTissue) -> np.ndarray:
    """Render eight frames in three rows: the person, the character with motion `moved`, its deformation. [MoSh]"""
    frames, height = spread_indices(len(soft.motion.poses), 8), 320
    person = moving_character(model, soft, frames)[1]
    fixed, changed = moving_character(character, moved, frames)
    colors = heat(deformation(character.template.faces, fixed, changed), 0.0, FULL)
    poses = moved.motion.poses[frames]
    changed = Creases(at_rest(character), character.skeleton).smooth(changed, poses)
    who, what = model.subject(soft.motion.betas), character.subject(moved.motion.betas)
    rows = [bodies_in_a_row(who, soft.motion.poses[frames], person, None, height),
            bodies_in_a_row(what, poses, changed, None, height), bodies_in_a_row(what, poses, changed, colors, height)]
    sheet = contact_sheet([image for row in rows for image in row],
                          [""] * 2 * len(frames) + seconds(soft.motion, frames), columns=len(frames))
    bar = color_bar(0.0, FULL, "deformation of the skin", scale=100.0, unit="%")
    return contact_sheet([sheet, bar], columns=1)


def write_character(path: Path, character: BodyModel, soft: SoftTissue) -> tuple[np.ndarray, list[Metric]]:
    """Write an animated GLB of soft tissue on a character, coloured by the largest deformation over time (N,).

    Returned are the deformations and how far the file is from the exact bodies.
    """
    frames = spread_indices(len(soft.motion.poses), KEYS)
    most = np.asarray(deformation(character.template.faces, *moving_character(character, soft, frames)).max(axis=0))
    creases = Creases(at_rest(character), character.skeleton)

    def bodies(some: np.ndarray) -> np.ndarray:
        return creases.smooth(moving_character(character, soft, some)[1], soft.motion.poses[some])

    return most, write_glb(path, soft.motion, character.subject(soft.motion.betas), bodies, heat(most, 0.0, FULL))


class Creases:
    """Finds inverted triangles of a posed body, and smooths them.

    A triangle is inverted when it faces away from its rest normal, rotated by its parts. Rotations are blended over
    six rings of vertices: at a raised shoulder the skin rightly faces away from its own part.
    """

    def __init__(self, rest: Mesh, skeleton: Skeleton) -> None:
        self.rest, self.skeleton = rest, skeleton
        self._near = csr_array(rest.vertex_adjacency, dtype=np.float64)
        shares = np.eye(len(skeleton.parents))[skeleton.part_of_vertex(rest)]
        spread = diags_array(1 / (1 + np.asarray(self._near.sum(axis=1)).ravel()))
        for _ in range(6):
            shares = spread @ (shares + self._near @ shares)
        self._shares = shares[rest.faces].mean(axis=1)

    def find_inverted(self, bodies: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Find inverted triangles (..., F) of bodies (..., N, 3) in poses (..., J, 3)."""
        corners = bodies[..., self.rest.faces, :]
        now = np.cross(corners[..., 1, :] - corners[..., 0, :], corners[..., 2, :] - corners[..., 0, :])
        R = np.tensordot(self._shares, self.skeleton.part_rotations(poses), axes=(1, -3))
        R = np.moveaxis(R, 0, -3)
        return np.asarray((now * (R @ self.rest.face_normals[..., None])[..., 0]).sum(axis=-1) < 0)

    def smooth(self, bodies: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Return bodies (n, N, 3) in poses (n, J, 3) with creases replaced by smooth patches.

        Patches around inverted triangles grow while some are left. A patch that leaves as many of them is not used.
        """
        out, faces = np.array(bodies), self.rest.faces
        for x, pose in zip(out, poses, strict=True):
            bad = self.find_inverted(x, pose)
            for rings in (1, 2, 2, 3, 3, 4):             # rings of vertices around inverted triangles, in each round
                free = np.zeros(len(x))
                free[faces[bad]] = 1
                for _ in range(rings - 1):
                    free = (free + self._near @ free > 0).astype(float)
                patched = np.flatnonzero(free)
                if len(patched) in (0, len(x)):
                    continue
                # a harmonic patch, as smooth as its border allows
                count, patch = connected_components(self._near[patched][:, patched])
                trial = harmonic(self._near, x, free == 0)
                left = self.find_inverted(trial, pose)
                # count inverted triangles of each patch before and after
                of_vertex = np.full(len(x), -1)
                of_vertex[patched] = patch
                of_face = of_vertex[faces].max(axis=1)   # no triangle touches two patches
                before, after = (np.bincount(of_face[some & (of_face >= 0)], minlength=count) for some in (bad, left))
                kept = patched[~(after < before)[patch]]
                trial[kept] = x[kept]
                x[:] = trial                             # a row of `out`
                bad = self.find_inverted(x, pose)
        return out
