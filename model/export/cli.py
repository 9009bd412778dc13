"""`scape model export`: a model in the files of other programs."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from model.priors import sample_poses
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, Progress, bar
from scanprep.geometry.files import write_mesh
from scanprep.geometry.storage import StorageError, load_arrays, numbers, taking_apart, text
from scanprep.pictures.camera import upright
from scanprep.ranges import BETAS, Beta

from ..body import BodyModel
from ..cli import ModelArg
from ..files import load_model
from ..linear import Subject
from .bvh import write_bvh
from .correctives import motion_correctives, pose_features, spaced, write_body_npz
from .glb import write_skinned_glb
from .rig import Rig, check_motion, joint_places, make_rig

MOTIONS_OF = "scape"                 # what motion files say they are made for
MEASURED = 40                        # poses in which the files are compared with the exact model
_MESHES = (".obj", ".ply", ".stl", ".off", ".ply.gz")
_TAKES = {"glb": {"betas", "own_body", "motion", "shapes", "correctives", "up"},
          "bvh": {"betas", "own_body", "motion", "unit", "up"}, "npz": set(), "mesh": {"betas", "own_body"},
          "folder": {"betas", "own_body", "motion"}}


@dataclass(frozen=True, eq=False)
class _Moves:
    """A motion as its file has it; without one, poses to measure with."""

    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray | None
    rate: float


def export(model: ModelArg, output: Output, betas: tuple[Beta, ...] = (), own_body: bool = False,
           motion: Path | None = None, shapes: int | None = None, correctives: int = 0,
           unit: Unit | None = None, up: Literal[0, 1, 2] | None = None) -> Outcome:
    """Write a model for other programs; what is written follows from the name of the output.

    OUT.glb: a body that hangs on joints, with a morph target for each beta, and its motion. OUT.bvh: the skeleton and
    its motion. OUT.npz: the whole model as linear blend skinning under the usual array names. OUT.ply, .obj, .stl,
    .off: the mesh at rest. A folder: the exact mesh of every frame of the motion.

    GLB, BVH and NPZ hold bodies that are skinned with bones of fixed length: the table says how far they are from the
    model's own. With --correctives a motion in GLB comes as near as you like.

    Example: scape model export model.npz --motion walk/motion.npz -o walk.glb

    Args:
        model: Model file.
        output: File or folder to write: .glb, .bvh, .npz, .ply, .obj, .stl, .off, or a folder.
        betas: Shape in standard deviations, the first of them; else that of the motion, else the mean person.
        own_body: The template's own body.
        motion: Motion file (.npz), as of scape animate.
        shapes: Morph targets for so many of the first betas; 10 where there are so many.
        correctives: Further morph targets by which the motion comes nearer to the exact one.
        unit: Of the lengths in a BVH file; cm.
        up: Axis of the model that points up, which GLB and BVH turn to y; else that of the largest extent.
    """
    kind = _kind(output)
    _refuse_the_rest(kind, {"betas": betas, "own_body": own_body, "motion": motion, "shapes": shapes,
                            "correctives": correctives, "unit": unit, "up": up is not None})
    loaded = load_model(model)
    if kind == "npz":
        return Outcome(output, _npz(output, loaded))
    moves = None if motion is None else read_motion(motion, loaded)
    person = _person(model, loaded, betas, own_body, moves)
    if kind == "mesh":
        body = loaded.template.with_vertices(loaded.vertices(np.zeros((len(loaded.skeleton.parents), 3)), person))
        write_mesh(output, body)
        return Outcome(output, [Metric("vertices", len(body.vertices)), _size(output)])
    if kind == "folder":
        return Outcome(output, _folder(output, loaded, person, moves))
    if shapes is None:
        # morph targets where nobody says how many
        shapes = 0 if person is None or kind == "bvh" else min(10, loaded.n_betas)
    rig = make_rig(loaded, person, shapes)
    axis = upright(rig.mesh)[0] if up is None else up
    if kind == "bvh":
        return Outcome(output, _bvh(output, loaded, person, rig, moves, unit or "cm", axis))
    return Outcome(output, _glb(output, loaded, person, rig, moves, correctives, axis))


def read_motion(path: Path, model: BodyModel) -> _Moves:
    """A motion file (`poses`, `trans`, `betas`, `mocap_frame_rate`) of a model's parts, or StorageError."""
    stored = load_arrays(path, "a motion (.npz)")
    stored.setdefault("mocap_frame_rate", stored.pop("mocap_framerate", np.array(np.nan)))
    lacking = [name for name in ("poses", "trans") if name not in stored]
    if lacking:
        raise StorageError(f"{path}: expected a motion, it lacks {' and '.join(lacking)}")
    with taking_apart(path, "a whole motion"):
        made_for = text(stored, "surface_model_type", model.kind)
        if made_for not in (MOTIONS_OF, model.kind):
            raise StorageError(f"{path}: expected surface_model_type '{MOTIONS_OF}', found '{made_for}'")
        J, T = len(model.skeleton.parents), len(np.atleast_1d(stored["poses"]))
        if not T or stored["poses"].size != T * 3 * J:
            raise StorageError(f"{path}: expected frames of the model's {J} parts, "
                               f"found shape {stored['poses'].shape}")
        betas = stored.get("betas", np.zeros(0))
        if betas.ndim != 1 or len(betas) > model.n_betas:
            raise StorageError(f"{path}: expected at most the {model.n_betas} betas of the model, found {betas.shape}")
        betas = numbers({"betas": betas}, "betas", None).astype(np.float64)
        BETAS.check(betas, "betas")
        poses, rate = stored["poses"].astype(np.float64).reshape(T, J, 3), float(stored["mocap_frame_rate"])
        poses, trans = check_motion(model.skeleton, poses, stored["trans"], rate)
        return _Moves(poses, trans, betas if betas.size else None, rate)


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
    ending = "".join(output.suffixes).lower()
    if ending.endswith(_MESHES):
        return "mesh"
    if output.suffix.lower() in (".glb", ".bvh", ".npz"):
        return output.suffix.lower()[1:]
    if output.suffix and not output.is_dir():
        raise ValueError(f"{output}: expected a name ending in .glb, .bvh, .npz, {', '.join(_MESHES)}, or a folder")
    return "folder"


def _refuse_the_rest(kind: str, given: dict[str, object]) -> None:
    wrong = [name for name, value in given.items() if value and name not in _TAKES[kind]]
    if wrong:
        hint = "; name a folder for the meshes of a motion" if (kind, wrong[0]) == ("mesh", "motion") else ""
        raise ValueError(f"--{wrong[0].replace('_', '-')}: it says nothing about a {kind}{hint}")


def _person(path: Path, model: BodyModel, betas: tuple[float, ...], own_body: bool, moves: _Moves | None
            ) -> np.ndarray | None:
    """Betas of the body that is asked for; None is the template's own."""
    if own_body and betas:
        raise ValueError("--own-body: the template's own body has no betas")
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
            *_distances("exact body, skinning alone", rig.vertices(poses) - exact),
            *_distances("exact body, with pose directions", rig.vertices(poses, changes=changes) - exact)]


def _folder(output: Path, model: BodyModel, person: np.ndarray | None, moves: _Moves | None) -> list[Metric]:
    if moves is None:
        raise ValueError(f"{output}: expected a motion for a folder of meshes; name it with --motion")
    with bar("writing meshes") as progress:
        paths = write_frames(output, model.subject(person), moves.poses, moves.trans, progress=progress)
    return [Metric("meshes", len(paths)), Metric("rate", moves.rate, "1/s"),
            Metric("size", sum(p.stat().st_size for p in paths) / 1e6, "MB")]


def _bvh(output: Path, model: BodyModel, person: np.ndarray | None, rig: Rig, moves: _Moves | None, unit: str, up: int
         ) -> list[Metric]:
    if moves is None:
        write_bvh(output, rig.skeleton, unit=unit, up=up, body=rig.mesh)
    else:
        write_bvh(output, rig.skeleton, moves.poses, moves.trans, moves.rate, unit, up, rig.mesh)
    poses, where = _measured(model, moves)
    exact = model.operator(person).joints(model.joint_regressor).evaluate(poses)
    off = joint_places(rig.skeleton, poses) - exact
    return [_size(output), Metric("joints", len(rig.skeleton.parents)), Metric("unit", unit), Metric("up", "xyz"[up]),
            Metric("frames", 1 if moves is None else len(moves.poses)), Metric("measured on", where),
            *_distances("joints of the exact body", off)]


def _glb(output: Path, model: BodyModel, person: np.ndarray | None, rig: Rig, moves: _Moves | None, count: int, up: int
         ) -> list[Metric]:
    subject = model.subject(person)
    poses, where = _measured(model, moves)
    extra, changes = None, None
    if moves is None:
        if count:
            raise ValueError("--correctives: expected the motion that they belong to; name it with --motion")
        write_skinned_glb(output, rig, up=up)
    else:
        if count:
            extra = motion_correctives(rig, subject, moves.poses, count)
            changes = extra.changes(spaced(len(moves.poses), MEASURED))
        write_skinned_glb(output, rig, moves.poses, moves.trans, moves.rate, extra, up)
    return [_size(output), Metric("joints", len(rig.skeleton.parents)), Metric("shape targets", len(rig.shapes)),
            Metric("corrective targets", 0 if extra is None else len(extra.shapes)), Metric("up", "xyz"[up]),
            Metric("frames", 0 if moves is None else len(moves.poses)), Metric("measured on", where),
            *_distances("exact body", rig.vertices(poses, changes=changes) - subject.vertices(poses))]


def _measured(model: BodyModel, moves: _Moves | None) -> tuple[np.ndarray, str]:
    """Poses in which a skinned body is compared with the exact one, and where they are from."""
    if moves is None:
        return sample_poses(model, MEASURED, np.random.default_rng(0)), f"{MEASURED} poses of the prior"
    chosen = spaced(len(moves.poses), MEASURED)
    return moves.poses[chosen], f"{len(chosen)} frames of the motion"


def _distances(what: str, off: np.ndarray) -> list[Metric]:
    distance = 1000.0 * np.linalg.norm(off, axis=-1)
    return [Metric(f"distance from {what}, mean", float(distance.mean()), "mm"),
            Metric("the same, 95th percentile", float(np.percentile(distance, 95)), "mm"),
            Metric("the same, largest", float(distance.max()), "mm")]


def _size(path: Path) -> Metric:
    return Metric("size", path.stat().st_size / 1e6, "MB")
