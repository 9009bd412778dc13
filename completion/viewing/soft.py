"""Soft tissue in the browser: a motion with changing shape, beside the same body with fixed shape."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from model.body import BodyModel
from scanprep.geometry.farthest_points import spread_indices
from scanprep.pictures.colors import Heat
from scanprep.pictures.shading import Moving, Solid

from ..mocap.files.markers import MarkerSequence
from ..mocap.soft_tissue.soft_tissue import SoftTissue
from ..motion import Motion
from .contents import Content
from .motions import AT_ONCE, MADE, columns_of, of_motion, with_markers


def of_soft_tissue(name: str, soft: SoftTissue, model: BodyModel) -> Content:
    """Show a motion with soft tissue; hidden at first, the same with the person's own shape throughout."""
    return with_soft_tissue(of_motion(name, soft.motion, model.subject(soft.motion.betas, np.float32)), soft, model)


def soft_tissue_of(path: Path, motion: Motion) -> SoftTissue | None:
    """Read soft tissue from a motion's file, or from beside a motion of as many frames; None where there is none."""
    beside = [path.with_name("soft_tissue.npz")] if path.name == "motion.npz" else []
    for file in (path, *beside):
        if file.is_file() and SoftTissue.is_in(file):
            soft = SoftTissue.load(file)
            return soft if len(soft.changes) == len(motion.poses) else None
    return None


def with_soft_tissue(content: Content, soft: SoftTissue, model: BodyModel, markers: MarkerSequence | None = None
                     ) -> Content:
    """Add the body with changing shape, and the markers, to a motion; the body with fixed shape is hidden at first.

    One of its colourings shows how far soft tissue moves the skin, root mean square over time.
    """
    sample = spread_indices(len(soft.motion.poses), MADE)
    frames = soft.vertices(model, sample)
    basis, coefficients = soft_columns(soft, model, frames)
    moved = soft.movement(model)
    shade = Heat(moved, 0.0, max(float(np.quantile(moved, 0.995)), 1e-3), "moved by soft tissue")
    # colour of the body with soft tissue, to tell it from the other
    body = Solid(model.template.with_vertices(frames[0]), (0.55, 0.66, 0.80), shades={"soft tissue": shade},
                 name="with soft tissue")
    changing = Moving(body, frames[:1].astype(np.float32), soft.motion.rate, (basis, coefficients))
    # the body of fixed shape is hidden at first
    fixed = [replace(shape, shape=replace(shape.shape, name="fixed shape", visible=False))
             if isinstance(shape, Moving) and isinstance(shape.shape, Solid) else shape for shape in content.shapes]
    content = replace(content, shapes=[*fixed, changing])
    if markers is None:
        return content
    note = f"{content.name}: markers are coloured by their distance from the body with soft tissue"
    return replace(with_markers(content, soft.motion, markers), notes=(*content.notes, note))


def soft_columns(soft: SoftTissue, model: BodyModel, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factor all vertices in all frames into columns (N, r) and coefficients (T, r, 3), from sample frames (n, N, 3).

    Like `as_columns` for a body of fixed shape. The fast path is linear in betas too, so every direction in which they
    change adds a product of its own. Skin that moves on the body adds its displacements.
    """
    basis = columns_of(frames)
    own = soft.betas(0.0)[0]
    # principal directions of the change of shape over time
    shares, sizes, directions = np.linalg.svd(soft.changes, full_matrices=False)
    # 0.003 standard deviations: smaller changes of shape cannot be seen
    shares = (shares * sizes)[:, sizes > 0.003 * np.sqrt(len(soft.changes))]
    rest, whole = model.operator(own), basis.sum(axis=0)[:, None]
    gained = [model.operator(own + direction).plus(-1, rest) for direction in directions[:shares.shape[1]]]
    amounts = np.hstack([np.ones((len(shares), 1)), shares])               # weight of each body, per frame
    poses = soft.motion.poses
    out = soft.motion.trans[:, :, None] * whole.T
    # add up the products of all directions, some frames at a time
    for body, amount in zip((rest, *gained), amounts.T, strict=True):
        columns, origin = body.combine(basis.T), body.origin[:, None] * whole.T
        for i in range(0, len(poses), AT_ONCE):
            now = slice(i, i + AT_ONCE)
            out[now] += amount[now, None, None] * (columns.relative_positions(poses[now]) + origin)
    out = np.swapaxes(out, 1, 2)
    return basis, out if soft.skin is None else out + soft.skin.at(basis.T @ soft.skin.modes, poses)
