"""`scape model mesh`, `repose` and `character`: bodies in poses, and a character as the mean of a model."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from scanprep.arguments import Alias, Called, Place, UsageError
from scanprep.cli import MeshArg, Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.geometry import rotations
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.format_common import UNKNOWN
from scanprep.geometry.landmarks import read_landmark_vertices, read_landmarks
from scanprep.geometry.storage import load_arrays, numbers, read_json, taking_apart
from scanprep.judgement import HAND, Judgement, size
from scanprep.ranges import BETAS, TURNS, Beta
from scanprep.registration.schedule import RegistrationConfig

from ..body import BodyModel
from ..cli import ModelArg, read_body
from ..export.cli import write_frames
from ..export.conventions import stand_mesh
from ..files import load_model
from ..linear import Subject
from ..motion.files import betas_for
from ..motion.onto import read_motion
from ..people import ASKED, person_judgement
from .character import Pose, character_problem, register_character
from .transfer import own_body, subject_from_body

BodyArg = Annotated[Path, Place("BODY")]


def repose(model: ModelArg, body: BodyArg, poses: Annotated[Path, Called("--motion")], output: Output,
           unit: Unit | None = None) -> Outcome:
    """Put one registered body, with all its detail, into the poses of a motion.

    Example: scape model repose model.npz man.ply --motion walk/motion.npz -o walking

    Args:
        model: Model file.
        body: Mesh with the triangles of the model.
        poses: Motion file of scape animate (.npz), BVH or AMASS; its betas are not used.
        output: Folder for the meshes.
        unit: Unit of the body.
    """
    loaded = load_model(model)
    mesh = read_body(body, loaded.template, unit)
    moves = read_motion(poses, loaded, rate=1.0)            # meshes have none
    found = own_body(loaded, mesh.vertices)
    with bar("writing meshes") as progress:
        written = write_frames(output, found.subject, moves.poses, moves.trans, progress=progress)
    return Outcome(output, [
        Metric("meshes", len(written)), *moves.told,
        Metric("distance from the body in its own pose, mean", 1e3 * found.mean, "mm"),
        Metric("distance from the body in its own pose, largest", 1e3 * found.largest, "mm")],
                   judgement=Judgement.of(None if found.mean <= HAND * size(loaded.template) else
        f"the body is {1e3 * found.mean:.0f} mm from the model's; registered otherwise, or the wrong unit (--unit)?",
        moves.doubts))


def character(mesh: MeshArg, model: Annotated[Path, Alias("-m")], output: Output, landmarks: Path | None = None,
              template_landmarks: Path | None = None, unit: Unit | None = None,
              pose: Pose = "found", register: RegistrationConfig = RegistrationConfig()) -> Outcome:
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
        pose: "found" estimates the character's pose from the mesh and undoes it; "rest" assumes the template's pose,
            so parts that look rotated have that shape.
        register: Settings of the registration.
    """
    from scanprep.pictures.shading import save_png

    from ..report import picture_character

    loaded, body = load_model(model), read_mesh(mesh, unit)
    same = np.array_equal(body.faces, loaded.template.faces)
    if landmarks is None and not same:
        raise ValueError(f"{mesh}: expected --landmarks for a mesh of other triangles than the model's "
                         f"({loaded.template}), found {body}")
    marks = None if landmarks is None else read_landmarks(landmarks, body, unit)
    ours = None if template_landmarks is None else read_landmark_vertices(template_landmarks, loaded.template)
    with bar("registering") as progress:
        found = register_character(loaded, body, marks, ours, register, progress, pose)
    found.model.save(output)
    save_png(output.with_suffix(".png"), picture_character(found.model))
    rows = [] if found.registration is None else [
        Metric("distance to the character, RMS", 1e3 * found.registration.rms, "mm"),
        Metric("character off the template", 100 * found.registration.uncovered, "%"),
        Metric("distance of landmarks, RMS", 1e3 * found.registration.landmark_rms, "mm"),
        Metric("inverted triangles", found.registration.inverted)]
    outside = ", ".join(name for name, within in zip(loaded.skeleton.names, found.inside, strict=True) if not within)
    rows += [Metric("height, length or width", float(np.ptp(found.mesh.vertices, axis=0).max()), "m"),
             Metric("joints inside it", f"{found.inside.sum()} of {len(found.inside)}"
                    + (f", outside: {outside}" if outside else "")),
             Metric("most turned joint", float(np.degrees(np.linalg.norm(found.pose[1:], axis=1).max())), "°")]
    return Outcome(output, rows, {"pose": pose, "register": register}, judgement=Judgement.of(
        character_problem(found), [f"outside: {outside}"] if outside else []))


def mesh(model: ModelArg, output: Output, pose: Path | None = None, betas: tuple[Beta, ...] = (),
         subject: Path | None = None, own_body: bool = False, ground: bool = False, front: bool = False) -> Outcome:
    """Write the mesh of one pose and shape.

    Example: scape model mesh model.npz --betas 2 -1 --ground --front -o body.ply

    Args:
        model: Model file.
        output: Mesh to write.
        pose: JSON {part name: [x, y, z]} of axis-angle turns against the parent in radians, others at rest.
        betas: Shape in standard deviations, the first of them; the mean person without.
        subject: Betas in JSON or .npz, or a mesh in the model's triangles, instead of --betas.
        own_body: The template's own body instead of the mean person.
        ground: Lowest point on height 0.
        front: Face to the viewer: -y where z is up, else +z.
    """
    loaded = load_model(model)
    turns = np.zeros((len(loaded.skeleton.parents), 3))
    for name, turn in (_read_turns(pose) if pose else {}).items():
        if name not in loaded.skeleton.names:
            raise ValueError(f"{pose}: no part '{name}'; the model has {', '.join(loaded.skeleton.names)}")
        try:
            turns[loaded.skeleton.names.index(name)] = turn
        except (TypeError, ValueError):
            raise ValueError(f"{pose}: {name}: expected [x, y, z] in radians, got {turn}") from None
    TURNS.check(turns, f"{pose}: turns")
    if (subject is not None) + bool(betas) + own_body > 1:
        raise UsageError("--betas, --subject and --own-body: expected one of them")
    # the body: named, the template's own, of given betas, or the mean person
    person = read_subject(loaded, subject) if subject is not None or own_body else loaded.subject(np.array(betas))
    vertices = person.vertices(turns)
    body = loaded.template.with_vertices(vertices)
    write_mesh(output, stand_mesh(body, loaded.template, ground, front, rotations.exp(turns[0])))
    return Outcome(output, [Metric("vertices", len(vertices)),
                            Metric("largest extent", float(np.ptp(vertices, axis=0).max()), "m")],
                   judgement=Judgement() if person.betas is None else person_judgement(loaded, person.betas, ASKED))


def _read_turns(path: Path) -> dict[str, np.ndarray]:
    """Read rotation vectors (3,), radians, by the names of parts."""
    wanted = "turns {part: [x, y, z]}"
    tree = read_json(path, wanted)
    with taking_apart(path, f"{wanted} in JSON"):
        turns = {name: np.array(turn, dtype=np.float64) for name, turn in tree.items()}
        return {name: numbers(turns, name, 3) for name in turns}


def read_subject(model: BodyModel, given: Path | None, unit: str | None = None) -> Subject:
    """Read the subject named on the command line: betas in JSON or a motion file, or a mesh in the model's topology.

    Without a name it is the template's own body. A mesh gives a subject with all its detail, beyond betas.
    """
    if given is None:
        return model.subject(None)
    if given.suffix in (".json", ".npz"):
        betas = betas_for(given, _read_betas(given), model)
        return model.subject(betas if betas is not None and len(betas) else None)
    own = None if unit == UNKNOWN else unit                  # the unknown one is that of the scan or recording
    return subject_from_body(model, read_body(given, model.template, own).vertices)


def _read_betas(path: Path) -> np.ndarray:
    """Read betas (k,) from JSON or from the array of that name in an `.npz`; none for the template's own body."""
    wanted = 'betas [b1, b2, ...] or {"betas": [...]}'
    if path.suffix == ".json":
        values = read_json(path, wanted)
        values = values.get("betas") if isinstance(values, dict) else values
    else:
        values = load_arrays(path, only=("betas",)).get("betas")
    try:
        betas = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        betas = np.array(np.nan)
    if betas.ndim != 1 or not np.isfinite(betas).all():
        raise ValueError(f"{path}: expected {wanted}, found something else")
    BETAS.check(betas, f"{path}: betas")
    return betas
