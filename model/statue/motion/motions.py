"""Motions of the synthetic people, of BVH files and of other skeletons, for a statue."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, csr_array

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError, save_arrays, taking_apart
from scanprep.geometry.surface import OrientedPoints, Surface
from scanprep.skeleton.tree import Skeleton

from ...motion.amass import moving_body
from ...motion.bvh import read_bvh
from ...motion.files import StoredMotion, read_motion_file, skeleton_arrays
from ...motion.keys import holds_keys, judge_keys, read_keys
from ...motion.moving import MovingSkeleton, set_in_motion
from ...motion.retarget import Pairing, Retargeted, retarget_pair
from ...motion.same import copy_motion
from ...rig import check_motion
from ..control.model import ControlModel, Statue


def read_statue_motion(statue: Statue, path: Path, rate: float | None = None) -> tuple[Retargeted, list[str]]:
    """Read a motion for a statue, with doubts: BVH, AMASS, keys in a table, or `.npz` of ours.

    A motion that holds its skeleton is copied where parts and rest pose are those of the statue, else retargeted.
    `rate` is frames a second, where the file does not say or says it wrongly.
    """
    control, parts = statue.control, statue.control.skeleton
    if holds_keys(path):
        keys = read_keys(path, parts, rate=rate)
        every = dict(zip(parts.names, parts.names, strict=True))
        return Retargeted(keys.poses, keys.trans, keys.rate, every), [*judge_keys(keys.poses).reasons]
    if path.suffix.lower() == ".bvh":
        # the unit does not matter, since travel is scaled by the legs
        return _with_file_name(path, bvh_motion, control, statue.pose, read_bvh(path, "cm", rate)), []
    stored = read_motion_file(path, rate=rate)
    if stored.skeleton is not None:
        same = stored.skeleton.names == parts.names and np.array_equal(stored.skeleton.parents, parts.parents)
        if same and np.abs(stored.skeleton.joints - parts.joints).max() < 0.001:      # metres: made for this statue
            return _own(control, path, stored), []
        moving = set_in_motion(stored.skeleton, stored.poses, stored.trans, stored.rate)
        return _with_file_name(path, bvh_motion, control, statue.pose, moving), []
    if stored.of_family:
        return _with_file_name(path, bvh_motion, control, statue.pose, moving_body(stored)), []
    raise StorageError(f"{path}: it does not say which skeleton its {stored.poses.shape[1]} parts are of; make the "
                       "file again (scape animate, scape demo), or bring BVH")


def _with_file_name(path: Path, make: Callable[..., Retargeted], *given: object) -> Retargeted:
    """Call a function; turn its ValueError into a StorageError that names the file."""
    try:
        return make(*given)
    except ValueError as problem:
        raise StorageError(f"{path}: {problem}") from None


def _own(control: ControlModel, path: str | Path, stored: StoredMotion) -> Retargeted:
    """Take a motion file (`poses`, `trans`, `mocap_frame_rate`) of the statue's own parts.

    In such files trans is the travel of the centroid of part 0, as in body models. Here it becomes that of the root's
    joint, as in a rig. Skinning moves one relative to the other a little.
    """
    J, names = len(control.skeleton.parents), control.skeleton.names
    with taking_apart(path, f"a motion of the statue's {J} parts"):
        poses, trans = check_motion(control.skeleton, stored.poses, stored.trans, stored.rate)
        return Retargeted(poses, trans - middle_drift(control, poses), stored.rate,
                          dict(zip(names, names, strict=True)))


def write_body_motion(path: str | Path, control: ControlModel, motion: Retargeted) -> None:
    """Write a motion of the statue's own parts, with the array names that body-model files use."""
    arrays = {"poses": motion.poses.reshape(len(motion.poses), -1),
              "trans": motion.trans + middle_drift(control, motion.poses), "betas": np.zeros(0),
              "mocap_frame_rate": np.array(float(motion.rate)), "surface_model_type": np.array("skinning"),
              **skeleton_arrays(control.skeleton)}
    save_arrays(path, arrays)


def middle_drift(control: ControlModel, poses: np.ndarray) -> np.ndarray:
    """Compute the shift (T, 3), metres, of the centroid of part 0 from the root's joint in poses (T, J, 3)."""
    ids, share = control.skeleton.joint_weights(control.mesh, 0)
    root_rig = replace(control.rig, mesh=Mesh(control.mesh.vertices[ids], np.zeros((0, 3), dtype=np.int64)),
                       weights=control.weights[ids], shapes=np.zeros((0, len(ids), 3)))
    return np.asarray(share @ root_rig.vertices(poses) - control.skeleton.joints[0])


def people_motion(control: ControlModel, pose: np.ndarray, poses: np.ndarray, trans: np.ndarray | None = None,
                  rate: float = 60.0) -> Retargeted:
    """Transfer a motion of the synthetic people, poses (T, 16, 3) and trans (T, 3), to a statue with its `pose`.

    The generic control model has the same rest pose, so world rotations of the parts are copied.
    """
    skeleton = _average_skeleton()
    moving = set_in_motion(skeleton, *check_motion(skeleton, poses, trans, rate), rate)
    return retarget_pair(Pairing(control.skeleton, control.rig.vertices, moving, pose), True, here=True)


@lru_cache(maxsize=1)
def _average_skeleton() -> Skeleton:
    """Build the skeleton of the average synthetic person, kept since its surface takes a second to make."""
    from scanprep.synthetic.people import SyntheticPerson

    return SyntheticPerson().skeleton


def bvh_motion(control: ControlModel, pose: np.ndarray, bvh: MovingSkeleton) -> Retargeted:
    """Retarget the motion of a BVH file to a statue with its `pose`, by names of joints and directions of bones.

    A part follows the rotation of its joint relative to the rest pose of the file, in which a person stands upright. A
    trunk of any number of joints becomes one rotation that carries neck and shoulders as nearly as possible. Travel is
    scaled by the legs, so the unit of the file does not matter. The statue starts where the scan stands. Up is the axis
    of the file nearest to the trunk at rest: y in BVH, but some programs write z. ValueError for unknown names.
    """
    same = copy_motion(control.skeleton, control.mesh, control.rig.vertices, bvh)
    return same or retarget_pair(Pairing(control.skeleton, control.rig.vertices, bvh, pose), here=True)


def bind_points(mesh: Mesh, body: Mesh, farthest: float = np.inf) -> csr_array:
    """Bind each vertex to a body point with a compatible normal: barycentric weights (n, N).

    Where none is within `farthest`, metres, it is the nearest point: the inside of a sleeve faces no body.
    """
    close = Surface(body).closest(mesh.vertices)
    corners, weights = body.faces[close.faces].copy(), close.bary.copy()
    facing = np.einsum("nd,nd->n", np.einsum("nc,ncd->nd", weights, body.vertex_normals[corners]), mesh.vertex_normals)
    wrong = np.flatnonzero(facing < 0.3)       # the nearest triangle is of another limb or side
    if len(wrong):
        there = OrientedPoints(body.vertices, body.vertex_normals)
        found = there.match(mesh.vertices[wrong], mesh.vertex_normals[wrong], farthest, 0.3)
        wrong, vertex = wrong[found.valid], found.index[found.valid]
        corners[wrong], weights[wrong] = vertex[:, None], [1, 0, 0]
    n = len(mesh.vertices)
    return csr_array(coo_array((weights.ravel(), (np.repeat(np.arange(n), 3), corners.ravel())),
                               shape=(n, len(body.vertices))))
