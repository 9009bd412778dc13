"""`scape model export`: a model in the files of other programs."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from model.priors import sample_poses
from scanprep.arguments import Called, UsageError
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, Progress, bar
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.files import name_of, write_mesh
from scanprep.judgement import Judgement
from scanprep.pictures.camera import guess_upright
from scanprep.ranges import Beta, Positive

from ..body import BodyModel, Up
from ..cli import ModelArg
from ..files import load_model
from ..linear import Subject
from ..motion.amass import write_amass
from ..motion.onto import BodyMotion, read_motion
from ..people import ASKED, person_judgement
from ..rig import Rig, joint_places, make_rig
from .bvh import write_bvh
from .conventions import for_programs, stand_mesh
from .correctives import motion_correctives, off_exact, pose_features, write_body_npz
from .glb import write_skinned_glb
from .names import Names, names_of

MEASURED = 40                        # poses or frames in which the files are compared with the exact model


def export(model: ModelArg, output: Output, betas: tuple[Beta, ...] = (), own_body: bool = False,
           motion: Path | None = None, shapes: Annotated[int | None, Called("--morphs")] = None,
           correctives: int | None = None, unit: Unit | None = None, up: Up | None = None,
           root: str | None = None, names: Names | None = None, ground: bool = False, front: bool = False,
           fps: Positive | None = None, rate: Positive | None = None) -> Outcome:
    """Write a model for other programs; what is written follows from the name of the output.

    OUT.glb: a body that hangs on joints, with two morph targets for each beta, and its motion. OUT.bvh: the skeleton
    and its motion. OUT.npz: the whole model as linear blend skinning under the usual array names; with --motion of a
    model of the SMPL family, that motion as AMASS has it. OUT.ply, .obj, .stl, .off: the mesh at rest. A folder: the
    exact mesh of every frame of the motion.

    GLB, BVH and NPZ hold bodies that are skinned with bones of fixed length: the table says how far they are from the
    model's own. In GLB further morph targets bring a motion to it.

    Example: scape model export model.npz --motion walk/motion.npz --root pelvis --names mixamo --ground -o walk.glb

    Args:
        model: Model file.
        output: File or folder to write: .glb, .bvh, .npz, .ply, .obj, .stl, .off, or a folder.
        betas: Shape in standard deviations, the first of them; else that of the motion, else the mean person.
        own_body: The template's own body.
        motion: Motion file of scape animate (.npz), or BVH or AMASS, which is brought onto the body.
        shapes: Morph targets for so many of the first betas, two for each: 3 standard deviations up and down; 10
            where there are so many.
        correctives: Further morph targets by which the motion comes nearer to the exact one; as many as bring it within
            half a millimetre, at most 48; 0 for plain skinning.
        unit: Of the lengths in a BVH file; cm.
        up: Axis of the model that points up, which GLB and BVH turn to y; else as the model says.
        root: Part that the skeleton hangs on, as pelvis.
        names: Whose names the bones of a person have: mixamo, unity, unreal, vrm, h-anim or opensim.
        ground: Soles on height 0, of the body and of the lowest frame.
        front: Face to the viewer: +z in GLB and BVH, -y of a mesh with z up.
        fps: Frames a second of the motion, such as 24 or 30; else as many as its file has.
        rate: Frames a second of the motion's file, where it does not say or says it wrongly.
    """
    # the writer for the name of the output; options that say nothing about this kind of file are an error
    ending = max((ending for ending in WRITERS if output.name.lower().endswith(ending)), key=len)
    if not ending and name_of(output) != output.name and not output.is_dir():
        raise ValueError(f"{output}: expected a name ending in {', '.join(filter(None, WRITERS))}, or a folder")
    writer = WRITERS[ending]
    given = {"betas": betas, "own_body": own_body, "motion": motion, "morphs": shapes,
             "correctives": correctives is not None, "unit": unit, "up": up is not None, "root": root, "names": names,
             "ground": ground, "front": front, "fps": fps, "rate": rate}
    wrong = [name for name, value in given.items() if value and name not in writer.takes]
    if wrong:
        hint = "; name a folder for the meshes of a motion" if (writer.kind, wrong[0]) == ("mesh", "motion") else ""
        raise UsageError(f"--{wrong[0].replace('_', '-')}: it says nothing about a {writer.kind}{hint}")
    # the motion, and the betas of the body that is asked for; None is the template's own
    loaded = load_model(model).with_up(up)
    chosen = loaded.subject(np.array(betas) if betas else None) if betas or own_body else None
    moves = None if motion is None else read_motion(motion, loaded, chosen, rate=rate)
    if moves is not None and fps is not None:
        moves = moves.at_rate(fps)
    if own_body and betas:
        raise UsageError("--own-body: the template's own body has no betas")
    person = np.array(betas) if betas else None if own_body else moves.betas if moves is not None else np.zeros(0)
    order = Order(output, model, loaded, person, moves, shapes, correctives, unit or "cm",
                  root, names, ground, front)
    judgement = Judgement.of(check=moves.doubts if moves is not None else ())
    return Outcome(output, writer.write(order),
                   judgement=judgement.merge(person_judgement(loaded, np.array(betas), ASKED)) if betas else judgement)


@dataclass(frozen=True, eq=False)
class Order:
    """What to write, from the arguments of `export`."""

    output: Path
    path: Path                       # of the model
    model: BodyModel
    person: np.ndarray | None        # betas; None is the template's own body
    moves: BodyMotion | None
    shapes: int | None
    correctives: int | None
    unit: str                        # of a BVH file
    root: str | None
    names: Names | None
    ground: bool
    front: bool

    def motion(self, what: str) -> BodyMotion:
        """Return the motion; ValueError where none was named."""
        if self.moves is None:
            raise ValueError(f"{self.output}: expected a motion for {what}; name it with --motion")
        return self.moves


def write_frames(folder: str | Path, subject: Subject, poses: np.ndarray, trans: np.ndarray | None = None,
                 progress: Progress | None = None) -> list[Path]:
    """Write the exact mesh of every frame, 00000.ply, 00001.ply, ...; return the files in the order of the frames."""
    paths = []
    for t, pose in enumerate(poses):
        paths.append(Path(folder) / f"{t:05d}.ply")
        vertices = subject.vertices(pose, None if trans is None else trans[t])
        write_mesh(paths[-1], subject.template.with_vertices(vertices), "single")
        if progress:
            progress(t + 1, len(poses))
    return paths


def _mesh(order: Order) -> list[Metric]:
    """Write the mesh of the body at rest."""
    model = order.model
    rest = np.zeros((len(model.skeleton.parents), 3))
    body = model.template.with_vertices(model.vertices(rest, order.person), model.template.up)
    write_mesh(order.output, stand_mesh(body, body, order.ground, order.front))
    return [Metric("vertices", len(body.vertices)), _size(order.output)]


def _npz(order: Order) -> list[Metric]:
    """Write the model as linear blend skinning; with a motion, that motion under the names of AMASS."""
    model, moves = order.model, order.moves
    if moves is not None:
        family = str(model.info.get("family") or "")
        if not family:
            raise ValueError(f"{order.path}: a motion under the names of AMASS is one of an imported model of the SMPL "
                             f"family (scape model import); write {order.output.stem}.bvh, .glb or a folder")
        write_amass(order.output, moves.poses, moves.trans, moves.betas, moves.rate, moves.gender, family)
        return [_size(order.output), Metric("frames", len(moves.poses)), Metric("rate", moves.rate, "1/s"),
                Metric("surface_model_type", family)]
    arrays = write_body_npz(order.output, model)
    rig = make_rig(model, np.zeros(0))
    # the error against the exact model, with and without pose correctives
    poses = sample_poses(model, MEASURED, np.random.default_rng(1))      # not those of the fit
    exact = model.mean_subject.vertices(poses)
    changes = np.tensordot(pose_features(poses), arrays["posedirs"], axes=(1, 2))
    return [_size(order.output), Metric("joints", len(model.skeleton.parents)),
            Metric("shape directions", model.n_betas),
            Metric("pose directions", arrays["posedirs"].shape[-1]),
            Metric("measured on", f"{MEASURED} poses of the prior"),
            *_distances("exact body, skinning alone", np.linalg.norm(rig.vertices(poses) - exact, axis=-1)),
            *_distances("exact body, with pose directions",
                        np.linalg.norm(rig.vertices(poses, changes=changes) - exact, axis=-1))]


def _folder(order: Order) -> list[Metric]:
    """Write the exact mesh of every frame, each in its own file."""
    subject, moves = order.model.subject(order.person), order.motion("a folder of meshes")
    with bar("writing meshes") as progress:
        paths = write_frames(order.output, subject, moves.poses, moves.trans, progress=progress)
    return [Metric("meshes", len(paths)), *moves.told, Metric("rate", moves.rate, "1/s"),
            Metric("size", sum(p.stat().st_size for p in paths) / 1e6, "MB")]


def _bvh(order: Order) -> list[Metric]:
    """Write the skeleton and its motion as BVH."""
    rig = make_rig(order.model, order.person)
    where, poses, frames = _poses_to_measure(order)
    off = joint_places(rig.skeleton, poses[frames]) - order.model.subject(order.person).joints(poses[frames])
    rows = _write_rig(order, rig, lambda ready, poses, trans, rate, up: write_bvh(
        order.output, ready.skeleton, poses, trans, rate, order.unit, up, ready.mesh))
    return [*rows, Metric("unit", order.unit), where,
            *_distances("joints of the exact body", np.linalg.norm(off, axis=-1))]


def _skin(order: Order, write: Callable[..., None]) -> list[Metric]:
    """Write a skinned body with morph targets for betas and, in a motion, for what skinning lacks."""
    shapes, moves = order.shapes, order.moves
    if shapes is None:
        # ten betas by default: more sliders are hard to use
        shapes = 0 if order.person is None else min(10, order.model.n_betas)
    rig, subject = make_rig(order.model, order.person, shapes), order.model.subject(order.person)
    if moves is None and order.correctives:
        raise UsageError("--correctives: expected the motion that they belong to; name it with --motion")
    where, poses, frames = _poses_to_measure(order)
    if moves is not None and order.correctives != 0:
        rig = replace(rig, correctives=motion_correctives(rig, subject, moves.poses, order.correctives))
    extra = 0 if rig.correctives is None else len(rig.correctives.shapes)
    off = off_exact(rig, poses, None, subject.vertices(poses[frames]), frames)
    return [*_write_rig(order, rig, partial(write, order.output)), Metric("shape targets", 2 * len(rig.shapes)),
            Metric("corrective targets", extra), where, *_distances("exact body", off)]


def _poses_to_measure(order: Order) -> tuple[Metric, np.ndarray, np.ndarray]:
    """Choose where a rig is compared with the exact body: poses (T, J, 3), and frames (n,) of them."""
    if order.moves is None:
        poses = sample_poses(order.model, MEASURED, np.random.default_rng(0))
        return Metric("measured on", f"{MEASURED} poses of the prior"), poses, np.arange(MEASURED)
    frames = spread_indices(len(order.moves.poses), MEASURED)
    return Metric("measured on", f"{len(frames)} frames of the motion"), order.moves.poses, frames


def _write_rig(order: Order, rig: Rig, write: Callable[..., None]) -> list[Metric]:
    """Write a rig and its motion in the conventions of other programs; return figures of the skeleton."""
    axis = guess_upright(rig.mesh)[0]
    rest = np.zeros((0, len(rig.skeleton.parents), 3))
    moves = order.moves or BodyMotion(rest, rest[:, 0], order.person, 30.0)
    ready, poses, trans = for_programs(rig, moves.poses, moves.trans, axis, order.root, order.names, order.ground,
                                       order.front)
    write(ready, poses if len(poses) else None, trans, moves.rate, up=axis)
    # report parts that have no name in the other program and keep ours
    known = {} if order.names is None else names_of(rig.skeleton, order.names)
    ours = [name for name in rig.skeleton.names if name not in known]
    return [_size(order.output), *moves.told, Metric("joints", len(ready.skeleton.names)),
            Metric("root", ready.skeleton.names[0]),
            *([Metric(f"parts without a name of {order.names}", ", ".join(ours))] if order.names and ours else []),
            Metric("up", "xyz"[axis]), Metric("frames", len(poses))]


def _distances(what: str, off: np.ndarray) -> list[Metric]:
    distance = 1000.0 * off
    return [Metric(f"distance from {what}, mean", float(distance.mean()), "mm"),
            Metric("the same, 95th percentile", float(np.percentile(distance, 95)), "mm"),
            Metric("the same, largest", float(distance.max()), "mm")]


def _size(path: Path) -> Metric:
    return Metric("size", path.stat().st_size / 1e6, "MB")


class Writer(NamedTuple):
    """A kind of file: which options of the command line apply to it, and the function that writes it."""

    kind: str
    takes: set[str]
    write: Callable[[Order], list[Metric]]


_PLACED = {"betas", "own_body", "up", "ground", "front"}
_BONES = _PLACED | {"motion", "fps", "rate", "root", "names"}
_MOVES = {"betas", "own_body", "motion", "fps", "rate"}
# writers by the ending of the output's name; without an ending the output is a folder
WRITERS = {
    ".glb": Writer("glb", _BONES | {"morphs", "correctives"}, partial(_skin, write=write_skinned_glb)),
    ".bvh": Writer("bvh", _BONES | {"unit"}, _bvh),
    ".npz": Writer("npz", {"motion", "fps", "rate"}, _npz),
    **dict.fromkeys((".obj", ".ply", ".stl", ".off", ".ply.gz"), Writer("mesh", _PLACED, _mesh)),
    "": Writer("folder", _MOVES, _folder),
}
