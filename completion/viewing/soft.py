"""Soft tissue in the browser: a motion in which the shape changes, beside the same body of fixed shape."""
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

SOFT = (0.55, 0.66, 0.80)


def of_soft_tissue(name: str, soft: SoftTissue, model: BodyModel) -> Content:
    """A motion with soft tissue, and the same with the person's own shape throughout, to be shown instead."""
    return with_soft_tissue(of_motion(name, soft.motion, model.subject(soft.motion.betas, np.float32)), soft, model)


def soft_tissue_of(path: Path, motion: Motion) -> SoftTissue | None:
    """What is stored in a motion's file of soft tissue, or lies beside a motion of as many frames; None without."""
    beside = [path.with_name("soft_tissue.npz")] if path.name == "motion.npz" else []
    for file in (path, *beside):
        if file.is_file() and SoftTissue.is_in(file):
            soft = SoftTissue.load(file)
            return soft if len(soft.changes) == len(motion.poses) else None
    return None


def with_soft_tissue(content: Content, soft: SoftTissue, model: BodyModel, markers: MarkerSequence | None = None
                     ) -> Content:
    """A motion, whose body is hidden at first, and with it the body whose shape changes, and what was measured.

    Where the skin is soft is one of its colours: how far the change moves it, the root of the mean square over time.
    """
    some = spread_indices(len(soft.motion.poses), MADE)
    frames = soft.vertices(model, some)
    basis, coefficients = soft_columns(soft, model, frames)
    moved = soft.movement(model)
    shade = Heat(moved, 0.0, max(float(np.quantile(moved, 0.995)), 1e-3), "moved by soft tissue")
    body = Solid(model.template.with_vertices(frames[0]), SOFT, shades={"soft tissue": shade}, name="with soft tissue")
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
    """Columns (N, r) and coefficients (T, r, 3) of all vertices in all frames, from some of the frames (n, N, 3).

    As `as_columns` for a body of fixed shape: what the fast path adds up is linear in betas too, so every direction in
    which they change adds a product of its own. Skin that moves on the body adds its displacements.
    """
    basis = columns_of(frames)
    own = soft.betas(0.0)[0]
    shares, sizes, directions = np.linalg.svd(soft.changes, full_matrices=False)
    # standard deviations: a direction in which the shape changes less is left out
    shares = (shares * sizes)[:, sizes > 0.003 * np.sqrt(len(soft.changes))]
    rest, whole = model.operator(own), basis.sum(axis=0)[:, None]
    gained = [model.operator(own + direction).plus(-1, rest) for direction in directions[:shares.shape[1]]]
    amounts = np.hstack([np.ones((len(shares), 1)), shares])               # of each body, in every frame
    poses = soft.motion.poses
    out = soft.motion.trans[:, :, None] * whole.T
    for body, amount in zip((rest, *gained), amounts.T, strict=True):
        columns, origin = body.combine(basis.T), body.origin[:, None] * whole.T
        for i in range(0, len(poses), AT_ONCE):
            now = slice(i, i + AT_ONCE)
            out[now] += amount[now, None, None] * (columns.relative_positions(poses[now]) + origin)
    out = np.swapaxes(out, 1, 2)
    return basis, out if soft.skin is None else out + soft.skin.at(basis.T @ soft.skin.modes, poses)
