"""`scape model export`: a model in the files of other programs."""
from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from model.priors import sample_poses
from scanprep.arguments import Called, UsageError
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, Progress, bar
from scanprep.geometry.files import name_of, write_mesh
from scanprep.judgement import Judgement
from scanprep.pictures.camera import upright
from scanprep.ranges import Beta, Positive

from ..body import BodyModel
from ..cli import ModelArg
from ..files import load_model
from ..linear import Subject
from ..motion.amass import write_amass
from ..motion.onto import BodyMotion, read_motion
from ..people import ASKED, person_judgement
from ..rig import Rig, joint_places, make_rig
from .bvh import write_bvh
from .conventions import for_programs, standing
from .correctives import motion_correctives, off_exact, pose_features, spaced, write_body_npz
from .glb import write_skinned_glb
from .names import Names, names_of
from .usd import USD, write_points_usd, write_skinned_usd

MEASURED = 40                        # poses in which the files are compared with the exact model
_MESHES = (".obj", ".ply", ".stl", ".off", ".ply.gz")
_PLACED = {"betas", "own_body", "up", "ground", "front"}
_BONES = _PLACED | {"motion", "fps", "rate", "root", "names"}
_TAKES = {"glb": _BONES | {"morphs", "correctives"}, "usd": _BONES | {"morphs", "correctives"},
          "point cache": {"betas", "own_body", "motion", "fps", "rate", "up"}, "bvh": _BONES | {"unit"},
          "npz": {"motion", "fps", "rate"},
          "mesh": _PLACED, "folder": {"betas", "own_body", "motion", "fps", "rate"}}


def export(model: ModelArg, output: Output, betas: tuple[Beta, ...] = (), own_body: bool = False,
           motion: Path | None = None, shapes: Annotated[int | None, Called("--morphs")] = None,
           correctives: int | None = None, unit: Unit | None = None, up: Literal["x", "y", "z"] | None = None,
           root: str | None = None, names: Names | None = None, ground: bool = False, front: bool = False,
           fps: Positive | None = None, rate: Positive | None = None) -> Outcome:
    """Write a model for other programs; what is written follows from the name of the output.

    OUT.glb: a body that hangs on joints, with two morph targets for each beta, and its motion. OUT.bvh: the skeleton
    and its motion. OUT.npz: the whole model as linear blend skinning under the usual array names; with --motion of a
    model of the SMPL family, that motion as AMASS has it. OUT.ply, .obj, .stl, .off: the mesh at rest. A folder: the
    exact mesh of every frame of the motion. OUT.usd, .usda, .usdc, .usdz: as GLB, in UsdSkel. OUT.points.usd: the exact
    mesh of every frame in one file.

    GLB, USD, BVH and NPZ hold bodies that are skinned with bones of fixed length: the table says how far they are from
    the model's own. In GLB and USD further morph targets bring a motion to it.

    Example: scape model export model.npz --motion walk/motion.npz --root pelvis --names mixamo --ground -o walk.glb

    Args:
        model: Model file.
        output: File or folder to write: .glb, .usd, .bvh, .npz, .ply, .obj, .stl, .off, or a folder.
        betas: Shape in standard deviations, the first of them; else that of the motion, else the mean person.
        own_body: The template's own body.
        motion: Motion file of scape animate (.npz), or BVH or AMASS, which is brought onto the body.
        shapes: Morph targets for so many of the first betas, two for each: 3 standard deviations up and down; 10
            where there are so many.
        correctives: Further morph targets by which the motion comes nearer to the exact one; as many as bring it within
            half a millimetre, at most 48; 0 for plain skinning.
        unit: Of the lengths in a BVH file; cm.
        up: Axis of the model that points up, which GLB, USD and BVH turn to y; else that of the largest extent.
        root: Part that the skeleton hangs on, as pelvis.
        names: Whose names the bones of a person have: mixamo, vrm, h-anim or opensim.
        ground: Soles on height 0, of the body and of the lowest frame.
        front: Face to the viewer: +z in GLB, USD and BVH, -y of a mesh with z up.
        fps: Frames a second of the motion, such as 24 or 30; else as many as its file has.
        rate: Frames a second of the motion's file, where it does not say or says it wrongly.
    """
    kind, axis = _kind(output), None if up is None else "xyz".index(up)
    _refuse_the_rest(kind, {"betas": betas, "own_body": own_body, "motion": motion, "morphs": shapes,
                            "correctives": correctives is not None, "unit": unit, "up": up is not None, "root": root,
                            "names": names, "ground": ground, "front": front, "fps": fps, "rate": rate})
    loaded = load_model(model)
    judgement = person_judgement(loaded, np.array(betas), ASKED) if betas else Judgement()
    if kind == "npz" and motion is None:
        return Outcome(output, _npz(output, loaded), judgement=judgement)
    chosen = loaded.subject(np.array(betas) if betas else None) if betas or own_body else None
    moves = None if motion is None else read_motion(motion, loaded, chosen, rate=rate)
    if moves is not None and fps is not None:
        moves = moves.at_rate(fps)
    if kind == "npz":
        assert moves is not None
        return Outcome(output, _amass(output, model, loaded, moves), judgement=judgement)
    person = _person(model, loaded, betas, own_body, moves)
    if kind == "folder":
        return Outcome(output, _folder(output, loaded, person, moves), judgement=judgement)
    if kind == "point cache":
        return Outcome(output, _points(output, loaded, person, moves, axis), judgement=judgement)
    if kind == "mesh":
        rest = np.zeros((len(loaded.skeleton.parents), 3))
        body = loaded.template.with_vertices(loaded.vertices(rest, person))
        body = standing(body, body, axis, ground, front)
        write_mesh(output, body)
        return Outcome(output, [Metric("vertices", len(body.vertices)), _size(output)], judgement=judgement)
    if shapes is None:
        # morph targets where nobody says how many
        shapes = 0 if person is None or kind == "bvh" else min(10, loaded.n_betas)
    rig = make_rig(loaded, person, shapes)
    axis = upright(rig.mesh)[0] if axis is None else axis
    rig, told = _measured_rig(kind, loaded, person, rig, moves, correctives)
    moves = moves or BodyMotion(np.zeros((0, len(loaded.skeleton.parents), 3)), np.zeros((0, 3)), person, 30.0)
    ready, poses, trans = for_programs(rig, moves.poses, moves.trans, axis, root, names, ground, front)
    if kind == "bvh":
        write_bvh(output, ready.skeleton, poses, trans, moves.rate, unit or "cm", axis, ready.mesh)
        told.insert(0, Metric("unit", unit or "cm"))
    elif kind == "usd":
        write_skinned_usd(output, ready, poses, trans, moves.rate, axis)
    else:
        write_skinned_glb(output, ready, poses if len(poses) else None, trans, moves.rate, axis)
    return Outcome(output, [_size(output), *moves.told, *_bones(rig, ready, names), Metric("up", "xyz"[axis]),
                            Metric("frames", len(poses)), *told], judgement=judgement)


def write_frames(folder: str | Path, subject: Subject, poses: np.ndarray, trans: np.ndarray | None = None,
                 ending: str = ".ply", progress: Progress | None = None) -> list[Path]:
    """Write the exact mesh of every frame, 00000.ply, 00001.ply, ...; the files in the order of the frames."""
    paths = []
    for t, pose in enumerate(poses):
        paths.append(Path(folder) / f"{t:05d}{ending}")
        vertices = subject.vertices(pose, None if trans is None else trans[t])
        write_mesh(paths[-1], subject.template.with_vertices(vertices), "single")
        if progress:
            progress(t + 1, len(poses))
    return paths


def _kind(output: Path) -> str:
    name = output.name.lower()
    if name.endswith(_MESHES):
        return "mesh"
    if output.suffix.lower() in USD:
        return "point cache" if name_of(name).endswith(".points") else "usd"
    if output.suffix.lower() in (".glb", ".bvh", ".npz"):
        return output.suffix.lower()[1:]
    if name_of(output) != output.name and not output.is_dir():
        raise ValueError(f"{output}: expected a name ending in .glb, .bvh, .npz, .usd, {', '.join(_MESHES)}, "
                         "or a folder")
    return "folder"


def _refuse_the_rest(kind: str, given: dict[str, object]) -> None:
    wrong = [name for name, value in given.items() if value and name not in _TAKES[kind]]
    if wrong:
        hint = "; name a folder for the meshes of a motion" if (kind, wrong[0]) == ("mesh", "motion") else ""
        raise UsageError(f"--{wrong[0].replace('_', '-')}: it says nothing about a {kind}{hint}")


def _person(path: Path, model: BodyModel, betas: tuple[float, ...], own_body: bool, moves: BodyMotion | None
            ) -> np.ndarray | None:
    """Betas of the body that is asked for; None is the template's own."""
    if own_body and betas:
        raise UsageError("--own-body: the template's own body has no betas")
    if own_body or (moves is not None and moves.betas is None and not betas):
        return None
    if not model.n_betas:
        raise ValueError(f"{path}: it has no shape components; ask for --own-body")
    return np.array(betas) if betas else moves.betas if moves is not None else np.zeros(1)


def _npz(output: Path, model: BodyModel) -> list[Metric]:
    arrays = write_body_npz(output, model)
    mean = np.zeros(1) if model.n_betas else None
    rig = make_rig(model, mean)
    poses = sample_poses(model, MEASURED, np.random.default_rng(1))      # not those of the fit
    exact = model.subject(mean).vertices(poses)
    changes = np.tensordot(pose_features(poses), arrays["posedirs"], axes=(1, 2))
    return [_size(output), Metric("joints", len(model.skeleton.parents)), Metric("shape directions", model.n_betas),
            Metric("pose directions", arrays["posedirs"].shape[-1]),
            Metric("measured on", f"{MEASURED} poses of the prior"),
            *_distances("exact body, skinning alone", np.linalg.norm(rig.vertices(poses) - exact, axis=-1)),
            *_distances("exact body, with pose directions",
                        np.linalg.norm(rig.vertices(poses, changes=changes) - exact, axis=-1))]


def _amass(output: Path, path: Path, model: BodyModel, moves: BodyMotion) -> list[Metric]:
    family = str(model.info.get("family") or "")
    if not family:
        raise ValueError(f"{path}: a motion under the names of AMASS is one of an imported model of the SMPL family "
                         f"(scape model import); write {output.stem}.bvh, .glb or a folder")
    write_amass(output, moves.poses, moves.trans, moves.betas, moves.rate, moves.gender, family)
    return [_size(output), Metric("frames", len(moves.poses)), Metric("rate", moves.rate, "1/s"),
            Metric("surface_model_type", family)]


def _folder(output: Path, model: BodyModel, person: np.ndarray | None, moves: BodyMotion | None) -> list[Metric]:
    if moves is None:
        raise ValueError(f"{output}: expected a motion for a folder of meshes; name it with --motion")
    with bar("writing meshes") as progress:
        paths = write_frames(output, model.subject(person), moves.poses, moves.trans, progress=progress)
    return [Metric("meshes", len(paths)), *moves.told, Metric("rate", moves.rate, "1/s"),
            Metric("size", sum(p.stat().st_size for p in paths) / 1e6, "MB")]


def _points(output: Path, model: BodyModel, person: np.ndarray | None, moves: BodyMotion | None, up: int | None
            ) -> list[Metric]:
    if moves is None:
        raise ValueError(f"{output}: expected a motion for the points of its frames; name it with --motion")
    subject, count = model.subject(person), len(moves.poses)
    rest = model.template.with_vertices(subject.vertices(np.zeros_like(moves.poses[0])))
    axis = upright(rest)[0] if up is None else up
    with bar("writing meshes") as progress:
        def frames() -> Iterator[np.ndarray]:
            for t in range(count):
                yield subject.vertices(moves.poses[t], moves.trans[t])
                progress(t + 1, count)

        write_points_usd(output, rest, frames(), count, moves.rate, axis)
    return [_size(output), Metric("frames", count), Metric("rate", moves.rate, "1/s"), Metric("up", "xyz"[axis])]


def _bones(rig: Rig, ready: Rig, names: Names | None) -> list[Metric]:
    """What became of the skeleton; parts that keep their names although others were asked for."""
    known = {} if names is None else names_of(rig.skeleton, names)
    kept = [name for name in rig.skeleton.names if name not in known]
    return [Metric("joints", len(ready.skeleton.names)), Metric("root", ready.skeleton.names[0]),
            *([Metric(f"parts without a name of {names}", ", ".join(kept))] if names and kept else [])]


def _measured_rig(kind: str, model: BodyModel, person: np.ndarray | None, rig: Rig, moves: BodyMotion | None,
                  count: int | None) -> tuple[Rig, list[Metric]]:
    """The rig, for GLB with the correctives of the motion, and how far it is from the exact body."""
    subject = model.subject(person)
    if moves is None:
        if count:
            raise UsageError("--correctives: expected the motion that they belong to; name it with --motion")
        poses, frames = sample_poses(model, MEASURED, np.random.default_rng(0)), np.arange(MEASURED)
        where = f"{MEASURED} poses of the prior"
    else:
        poses, frames = moves.poses, spaced(len(moves.poses), MEASURED)
        where = f"{len(frames)} frames of the motion"
    exact = subject.vertices(poses[frames])
    told = [Metric("measured on", where)]
    if kind == "bvh":
        joints = subject.joints(poses[frames])
        off = np.linalg.norm(joint_places(rig.skeleton, poses[frames]) - joints, axis=-1)
        return rig, [*told, *_distances("joints of the exact body", off)]
    if moves is not None and count != 0:
        rig = replace(rig, correctives=motion_correctives(rig, subject, poses, count))
    extra = 0 if rig.correctives is None else len(rig.correctives.shapes)
    return rig, [Metric("shape targets", 2 * len(rig.shapes)), Metric("corrective targets", extra), *told,
                 *_distances("exact body", off_exact(rig, poses, None, exact, frames))]


def _distances(what: str, off: np.ndarray) -> list[Metric]:
    distance = 1000.0 * off
    return [Metric(f"distance from {what}, mean", float(distance.mean()), "mm"),
            Metric("the same, 95th percentile", float(np.percentile(distance, 95)), "mm"),
            Metric("the same, largest", float(distance.max()), "mm")]


def _size(path: Path) -> Metric:
    return Metric("size", path.stat().st_size / 1e6, "MB")
