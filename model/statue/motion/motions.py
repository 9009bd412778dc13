"""Motions of other skeletons, carried over to a statue: of the synthetic people and of BVH files."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import load_arrays, numbers, taking_apart, writing
from scanprep.skeleton.tree import Skeleton

from ...export.bvh_read import BvhMotion
from ...export.rig import check_motion, joint_places
from ..control.model import ControlModel
from .retarget import MotionConfig, Pairing, StatueMotion, retargeted


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
                  rate: float = 60.0, up: np.ndarray | None = None, config: MotionConfig | None = None
                  ) -> StatueMotion:
    """A motion of the synthetic people, poses (T, 16, 3) and trans (T, 3) of the average person; `pose` is that of the
    statue.

    The generic control model rests as they do, so the rotations of the parts in the world carry over; abdomen and chest
    become the one rotation that brings neck and shoulders nearest to where those two bring them.
    """
    skeleton = _average_person()
    poses, trans = check_motion(skeleton, poses, trans, rate)
    offsets = skeleton.joints - np.where(skeleton.parents[:, None] < 0, 0, skeleton.joints[skeleton.parents])
    moving = BvhMotion(skeleton.names, skeleton.parents, offsets, {}, skeleton.part_rotations(poses),
                       joint_places(skeleton, poses, trans), rate)
    return retargeted(Pairing(control, pose, moving, None, up), True, config or MotionConfig())


def bvh_motion(control: ControlModel, pose: np.ndarray, bvh: BvhMotion, reference: int | None = None,
               names: Mapping[str, str] | None = None, up: np.ndarray | None = None,
               config: MotionConfig | None = None) -> StatueMotion:
    """The motion of a BVH file, by the names of its joints and the directions of its bones.

    A part follows the rotation of its joint against the rest of the file, in which somebody stands upright: bones of
    arms and legs then point where those of the file do, hands continue the forearms as at rest, and trunk, head and
    feet are level where those of the file are turned as at rest. The trunk of the file, of any number of joints,
    becomes one rotation that brings neck and shoulders nearest to where it brings them. Joints between two that are
    matched count with the rotations below them.

    Travel is scaled by the length of the legs, so the unit of the file does not matter. The statue starts where the
    scan stands, it faces as the scan does where a person of the file faces as at rest, and its lowest vertex is as low
    as in the scan in all but a twentieth of the frames. Upwards is the axis of the file that is nearest to the trunk
    at rest: y, as BVH says, but some programs write z.

    Parameters
    ----------
    control : ControlModel
        Fitted.
    pose : (J, 3) float, radians
        `Statue.pose`.
    bvh : BvhMotion
    reference : int, optional
        A frame in which the person stands upright with straight limbs, in the place of the rest of the file: for
        files whose offsets all point the same way.
    names : {H-Anim name: name in the file}, optional
        Where the names say something else than `find_roles` finds.
    up : (3,) float, optional
        Upwards in the scan; else the axis nearest to the direction from feet to head.
    config : MotionConfig, optional

    Raises
    ------
    ValueError
        Names that say too little; a frame that does not exist.
    """
    if reference is not None:
        if not 0 <= reference < len(bvh.places):
            raise ValueError(f"reference: expected a frame of 0 to {len(bvh.places) - 1}, got {reference}")
        R, rest = bvh.rotations[reference], bvh.places[reference]
        bvh = replace(bvh, offsets=rest - np.where(bvh.parents[:, None] < 0, 0, rest[bvh.parents]),
                      rotations=bvh.rotations @ np.swapaxes(R, -1, -2))
    return retargeted(Pairing(control, pose, bvh, names, up), False, config or MotionConfig())


@lru_cache(maxsize=1)
def _average_person() -> Skeleton:
    from scanprep.synthetic.people import Person

    return Person().skeleton
