"""Pictures and files of soft tissue on a character, and of where it deforms."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from model.body import BodyModel
from scanprep.pictures.camera import upright
from scanprep.pictures.colors import color_bar, heat
from scanprep.pictures.shading import Solid, render, side_by_side

from ..animate.report import facing
from ..animate.work import key_frames
from ..results import SoftTissue
from .creases import Creases, at_rest
from .soft_tissue import deformation, moving_character

FULL = 0.2                           # deformation at the end of the heat map
TURN = 35.0                          # degrees of the camera beside the front


def picture_transfer(model: BodyModel, soft: SoftTissue, character: BodyModel, moved: SoftTissue, count: int = 8,
                     height: int = 320, turn: float = TURN) -> np.ndarray:
    """Some frames in three rows: the person, the character, and the character by how far its skin is deformed.

    Parameters
    ----------
    model, soft
        The person.
    character, moved
        The character, and what `retarget_soft_tissue` made for it.
    turn : float, degrees
        Where the camera stands, from the front of the body.

    [MoSh]
    """
    frames = key_frames(soft.motion, count)
    person = moving_character(model, soft, frames)[1]
    fixed, changed = moving_character(character, moved, frames)
    colors = heat(deformation(character.template.faces, fixed, changed), 0.0, FULL)
    changed = Creases(at_rest(character), character.skeleton).smoothed(changed, moved.motion.poses[frames])
    rows = [_row(model, soft, person, frames, None, height, turn),
            _row(character, moved, changed, frames, None, height, turn),
            _row(character, moved, changed, frames, colors, height, turn)]
    seconds = [f"{t / soft.motion.rate:.2f} s" for t in frames]
    sheet = side_by_side([image for row in rows for image in row], ["" for _ in rows[0]] * 2 + seconds,
                         columns=len(frames))
    bar = color_bar(0.0, FULL, "deformation of the skin", scale=100.0, unit="%")
    return side_by_side([sheet, bar], columns=1)


def _row(model: BodyModel, soft: SoftTissue, bodies: np.ndarray, frames: np.ndarray, colors: np.ndarray | None,
         height: int, turn: float) -> list[np.ndarray]:
    """Pictures of bodies (n, N, 3), all of one scale."""
    subject, mesh = model.subject(soft.motion.betas), model.template
    size = 1.06 * np.ptp(bodies, axis=1).max(axis=0) / 2
    up = upright(mesh)[0]
    floor, images = bodies[..., up].min(), []
    for i, body in enumerate(bodies):
        middle = (body.min(axis=0) + body.max(axis=0)) / 2
        middle[up] = floor + size[up] / 1.06                        # all on one line
        camera = facing(subject, soft.motion.poses[frames[i]], np.stack([middle - size, middle + size]), turn)
        images.append(render(Solid(mesh.with_vertices(body), None if colors is None else colors[i]), camera,
                             int(0.62 * height), height))
    return images


def write_character(path: Path, character: BodyModel, soft: SoftTissue, keys: int = 60) -> np.ndarray:
    """Write an animated GLB with soft tissue, coloured by the most that the skin is deformed; returns that (N,).

    Parameters
    ----------
    character : BodyModel
        The model that the soft tissue is of: a character's, or the person's own.
    soft : SoftTissue
    keys : int
        Largest number of key frames.
    """
    from scanprep.pictures.gltf import write_animated_glb

    frames = key_frames(soft.motion, keys)
    fixed, changed = moving_character(character, soft, frames)
    most = deformation(character.template.faces, fixed, changed).max(axis=0)
    changed = Creases(at_rest(character), character.skeleton).smoothed(changed, soft.motion.poses[frames])
    rate = soft.motion.rate * max(len(frames) - 1, 1) / max(len(soft.motion.poses) - 1, 1)
    write_animated_glb(path, character.template.faces, changed, rate, heat(most, 0.0, FULL),
                       upright(character.template)[0], keys)
    return np.asarray(most)
