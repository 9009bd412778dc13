"""`scape model repose` and `scape model character`: a registered body in other poses, a character as the mean."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.geometry.files import read_mesh
from scanprep.geometry.landmarks import read_landmark_vertices, read_landmarks
from scanprep.meaning import HAND, size

from ..body import BodyModel
from ..cli import ModelArg
from ..export.cli import read_motion
from ..export.meshes import write_frames
from ..files import load_model
from .character_mesh import Character, CharacterMeshConfig, character_problem, register_character
from .transfer import TransferConfig, own_body

MM = 1000.0

CharacterArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MESH")]
BodyArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="BODY")]


def repose(model: ModelArg, body: BodyArg, poses: Path, output: Output, unit: Unit | None = None,
           config: TransferConfig = TransferConfig()) -> Outcome:  # noqa: B008
    """Put one registered body, with all its detail, into the poses of a motion.

    Example: scape model repose model.npz man.ply --poses walk/motion.npz -o walking

    Args:
        model: Model file.
        body: Mesh with the triangles of the model.
        poses: Motion file (.npz), as of scape animate; its betas are not used.
        output: Folder for the meshes.
        unit: Unit of the body.
        config: Settings.
    """
    loaded, mesh = load_model(model), read_mesh(body, unit)
    if not np.array_equal(mesh.faces, loaded.template.faces):
        raise ValueError(f"{body}: expected the triangles of the model ({loaded.template}), found {mesh}; "
                         "register the template to it first (scape prep register)")
    moves = read_motion(poses, loaded)
    found = own_body(loaded, mesh.vertices, config=config)
    with bar("writing meshes") as progress:
        written = write_frames(output, found.subject, moves.poses, moves.trans, progress=progress)
    return Outcome(output, [
        Metric("meshes", len(written)),
        Metric("distance from the body in its own pose, mean", MM * found.mean, "mm"),
        Metric("distance from the body in its own pose, largest", MM * found.largest, "mm")], {"repose": config},
        problem=None if found.mean <= HAND * size(loaded.template) else
        f"the body is {MM * found.mean:.0f} mm from the model's; registered otherwise, or the wrong unit (--unit)?")


def character(mesh: CharacterArg, model: Annotated[Path, tyro.conf.arg(aliases=["-m"])], output: Output,
              landmarks: Path | None = None, template_landmarks: Path | None = None, unit: Unit | None = None,
              pictures: bool = True,
              config: CharacterMeshConfig = CharacterMeshConfig()  # noqa: B008
              ) -> Outcome:
    """A character of any triangles as the mean of a model: it moves as people do, betas are offsets from it.

    The template is registered to the character by landmarks of the same names on both, of which a dozen spread over the
    body are enough. Beside the model a picture shows the character in rest and in some poses of the model's people.

    Example: scape model character gnome.obj -m model.npz --landmarks gnome.json -o gnome.npz

    Args:
        mesh: The character, about in the template's pose, of any size, in any place and direction.
        model: Model of people, with betas.
        output: Model file to write.
        landmarks: Landmarks of the character; not needed for a mesh with the template's triangles.
        template_landmarks: Landmarks of the template; else those that the model keeps.
        unit: Unit of the character and its landmarks.
        pictures: Write a picture beside the model.
        config: Settings.
    """
    loaded, body = load_model(model), read_mesh(mesh, unit)
    same = np.array_equal(body.faces, loaded.template.faces)
    if landmarks is None and not same:
        raise ValueError(f"{mesh}: expected --landmarks for a mesh of other triangles than the model's "
                         f"({loaded.template}), found {body}")
    theirs = None if landmarks is None else read_landmarks(landmarks, body, unit)
    ours = None if template_landmarks is None else read_landmark_vertices(template_landmarks, loaded.template)
    with bar("registering") as progress:
        found = register_character(loaded, body, theirs, ours, config, progress)
    found.model.save(output)
    if pictures:
        from scanprep.pictures.shading import save_png

        from .character_picture import picture_character

        save_png(output.with_suffix(".png"), picture_character(found))
    return Outcome(output, _about(loaded, found), {"character": config}, problem=character_problem(found))


def _about(model: BodyModel, found: Character) -> list[Metric]:
    rows = [] if found.registration is None else [
        Metric("distance to the character, RMS", MM * found.registration.rms, "mm"),
        Metric("character off the template", 100 * found.registration.uncovered, "%"),
        Metric("distance of landmarks, RMS", MM * found.registration.landmark_rms, "mm"),
        Metric("inverted triangles", found.registration.inverted)]
    outside = [name for name, within in zip(model.skeleton.names, found.inside, strict=True) if not within]
    return [*rows, Metric("height, length or width", float(np.ptp(found.mesh.vertices, axis=0).max()), "m"),
            Metric("joints inside it", f"{found.inside.sum()} of {len(found.inside)}"
                   + (f", outside: {', '.join(outside)}" if outside else "")),
            Metric("most turned joint", float(np.degrees(np.linalg.norm(found.pose[1:], axis=1).max())), "°")]
