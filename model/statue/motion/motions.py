"""Motions of other skeletons, carried over to a statue: of the synthetic people and of BVH files."""
from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError, load_arrays, numbers, taking_apart, writing
from scanprep.skeleton.tree import Skeleton

from ...export.bvh import BvhMotion, read_bvh
from ...export.rig import check_motion, joint_places
from ..control.model import ControlModel, Statue
from .retarget import Pairing, StatueMotion, retargeted


def read_statue_motion(statue: Statue, path: Path) -> StatueMotion:
    """A motion for the skeleton of a statue: BVH, or `.npz` of its own parts or of the synthetic people."""
    if path.suffix.lower() == ".bvh":
        return bvh_motion(statue.control, statue.pose, read_bvh(path, "cm"))     # travel is scaled by the legs
    stored = load_arrays(path, "a motion (.npz) or BVH")
    if "poses" not in stored:
        raise StorageError(f"{path}: expected a motion, it lacks poses")
    count = stored["poses"].size // max(3 * len(np.atleast_1d(stored["poses"])), 1)
    own, people = len(statue.control.skeleton.parents), 16
    if count == own:
        return own_motion(statue.control, path)
    if count != people:
        raise StorageError(f"{path}: expected the {own} parts of the statue or the {people} of the synthetic people, "
                           f"found {count}; for a motion of a learned model name it with --model")
    rate = stored.get("mocap_frame_rate", stored.get("mocap_framerate", np.array(60.0)))
    poses = stored["poses"].astype(np.float64).reshape(-1, people, 3)
    return people_motion(statue.control, statue.pose, poses, stored.get("trans"), float(rate))


def own_motion(control: ControlModel, path: str | Path) -> StatueMotion:
    """A motion file (`poses`, `trans`, `mocap_frame_rate`) of the statue's own parts.

    In such files trans is the travel of the middle of part 0, as body models place themselves; here that of the root's
    joint, as in a rig. Skinning moves the one a little against the other.
    """
    stored = load_arrays(path, "a motion (.npz)")
    J, names = len(control.skeleton.parents), control.skeleton.names
    with taking_apart(path, f"a motion of the statue's {J} parts"):
        T = len(stored["poses"])
        poses = numbers({"poses": stored["poses"].reshape(T, -1)}, "poses", None, 3 * J).reshape(T, J, 3)
        rate = stored["mocap_frame_rate" if "mocap_frame_rate" in stored else "mocap_framerate"]
        poses, trans = check_motion(control.skeleton, poses, numbers(stored, "trans", T, 3), float(rate))
        return StatueMotion(poses, trans - middle_drift(control, poses), float(rate),
                            dict(zip(names, names, strict=True)))


def write_motion(path: str | Path, control: ControlModel, motion: StatueMotion) -> None:
    """Write a motion as `own_motion` reads it, with the array names that body-model files use."""
    arrays = {"poses": motion.poses.reshape(len(motion.poses), -1),
              "trans": motion.trans + middle_drift(control, motion.poses), "betas": np.zeros(0),
              "mocap_frame_rate": np.array(float(motion.rate)), "surface_model_type": np.array("skinning")}
    with writing(path) as beside, open(beside, "wb") as out:
        np.savez_compressed(out, allow_pickle=False, **arrays)  # type: ignore[arg-type]


def middle_drift(control: ControlModel, poses: np.ndarray) -> np.ndarray:
    """(T, 3) how far skinning moves the middle of part 0 from the root's joint in poses (T, J, 3), metres."""
    ids, share = control.skeleton.joint_weights(control.mesh, 0)
    some = replace(control.rig, mesh=Mesh(control.mesh.vertices[ids], np.zeros((0, 3), dtype=np.int64)),
                   weights=control.weights[ids], shapes=np.zeros((0, len(ids), 3)))
    return np.asarray(share @ some.vertices(poses) - control.skeleton.joints[0])


def people_motion(control: ControlModel, pose: np.ndarray, poses: np.ndarray, trans: np.ndarray | None = None,
                  rate: float = 60.0, girdle: float = 0.2) -> StatueMotion:
    """A motion of the synthetic people, poses (T, 16, 3) and trans (T, 3) of the average person, for a statue's `pose`.

    The generic control model rests as they do, so the rotations of the parts in the world carry over.
    """
    skeleton = _average_person()
    poses, trans = check_motion(skeleton, poses, trans, rate)
    offsets = skeleton.joints - np.where(skeleton.parents[:, None] < 0, 0, skeleton.joints[skeleton.parents])
    moving = BvhMotion(skeleton.names, skeleton.parents, offsets, {}, skeleton.part_rotations(poses),
                       joint_places(skeleton, poses, trans), rate)
    return retargeted(Pairing(control, pose, moving), True, girdle)


def bvh_motion(control: ControlModel, pose: np.ndarray, bvh: BvhMotion) -> StatueMotion:
    """The motion of a BVH file, by the names of its joints and the directions of its bones, for a statue's `pose`.

    A part follows the rotation of its joint against the rest of the file, in which somebody stands upright. A trunk of
    any number of joints becomes one rotation that brings neck and shoulders nearest to where it brings them. Travel is
    scaled by the length of the legs, so the unit of the file does not matter; the statue starts where the scan stands.
    Upwards is the axis of the file that is nearest to the trunk at rest: y, as BVH says, but some programs write z.
    ValueError for names that say too little.
    """
    return retargeted(Pairing(control, pose, bvh), False)


@lru_cache(maxsize=1)
def _average_person() -> Skeleton:
    from scanprep.synthetic.people import Person

    return Person().skeleton
