"""Pictures and files of soft tissue on a character, and of where it deforms."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from model.body import BodyModel
from scanprep.pictures.colors import color_bar, heat
from scanprep.pictures.shading import side_by_side

from ...bodies import at_rest
from ...motion import spread_frames
from ...motion_pictures import bodies_in_a_row, seconds
from ..files.motion_files import write_glb
from ..soft_tissue.soft_tissue import SoftTissue
from .creases import Creases
from .soft_tissue import deformation, moving_character

FULL = 0.2                           # deformation at the end of the heat map


def picture_transfer(model: BodyModel, soft: SoftTissue, character: BodyModel, moved: SoftTissue, count: int = 8,
                     height: int = 320) -> np.ndarray:
    """Some frames in three rows: the person, the character, and the character by how far its skin is deformed.

    `moved` is what `retarget_soft_tissue` made of the person's for the character.

    [MoSh]
    """
    frames = spread_frames(len(soft.motion.poses), count)
    person = moving_character(model, soft, frames)[1]
    fixed, changed = moving_character(character, moved, frames)
    colors = heat(deformation(character.template.faces, fixed, changed), 0.0, FULL)
    poses = moved.motion.poses[frames]
    changed = Creases(at_rest(character), character.skeleton).smoothed(changed, poses)
    who, what = model.subject(soft.motion.betas), character.subject(moved.motion.betas)
    rows = [bodies_in_a_row(who, soft.motion.poses[frames], person, None, height),
            bodies_in_a_row(what, poses, changed, None, height), bodies_in_a_row(what, poses, changed, colors, height)]
    sheet = side_by_side([image for row in rows for image in row],
                         [""] * 2 * len(frames) + seconds(soft.motion, frames), columns=len(frames))
    bar = color_bar(0.0, FULL, "deformation of the skin", scale=100.0, unit="%")
    return side_by_side([sheet, bar], columns=1)


def write_character(path: Path, character: BodyModel, soft: SoftTissue, keys: int = 60) -> np.ndarray:
    """Write an animated GLB of soft tissue on its character, coloured by the most that the skin is deformed.

    Returns that (N,).
    """
    frames = spread_frames(len(soft.motion.poses), keys)
    fixed, changed = moving_character(character, soft, frames)
    most = np.asarray(deformation(character.template.faces, fixed, changed).max(axis=0))
    changed = Creases(at_rest(character), character.skeleton).smoothed(changed, soft.motion.poses[frames])
    write_glb(path, soft.motion, character.subject(soft.motion.betas), changed, heat(most, 0.0, FULL), keys)
    return most
