"""A skinned body as glTF 2.0: joints, weights, shapes as morph targets, images, and a motion."""
from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry.format_glb import VERTICES, Glb, turn_up
from scanprep.geometry.storage import writing
from scanprep.pictures.gltf import skin_material
from scanprep.pictures.sheets import png_bytes

from ..blend_weights import CARRIERS
from ..rig import Rig, check_motion


@dataclass(frozen=True, eq=False)
class Material:
    """Texture and normal map of a rig whose vertices are repeated at the seams of the texture chart."""

    uv: np.ndarray                           # (N, 2): (0, 0) is the lower left corner of the images, (1, 1) opposite
    normals: np.ndarray                      # (N, 3) unit, the same at all vertices of one place
    # (N, 4): unit vectors along the image's rows, and 1 where the image's upwards is their left as seen from outside,
    # -1 where it is their right; needed for `relief`
    tangents: np.ndarray | None = None
    color: np.ndarray | None = None          # (H, W, 3) uint8
    relief: np.ndarray | None = None         # (H, W, 3) uint8, normals in the frames of `tangents` and `normals`


def write_skinned_glb(path: str | Path, rig: Rig, poses: np.ndarray | None = None, trans: np.ndarray | None = None,
                      rate: float = 30.0, up: int = 2, material: Material | None = None) -> None:
    """Write a skinned body for any glTF 2.0 viewer, animation program or game engine.

    Every joint is a node, at its rest position and with the axes of the rig. Morph targets are called `beta 1 +3`,
    `beta 1 -3`, ... (`Rig.beta_targets`). They do not move the joints, so export another person with betas of their
    own. The rig's correctives are further targets, which the motion drives. Everything is turned so that y is up.

    Parameters
    ----------
    path : str or Path
        `.glb` file to write.
    rig : Rig
        The body, see `model.rig.make_rig`.
    poses : (T, J, 3) float, radians, optional
        A motion: poses of all frames.
    trans : (T, 3) float, metres, optional
        Travel of the root's joint.
    rate : float, frames a second
        Frame rate of the motion.
    up : int
        0, 1 or 2: the axis of the body that points up.
    material : Material, optional
        Textures; by default one plain colour.

    Raises
    ------
    ValueError
        A motion of other parts, empty, not finite or of another length than the correctives; a rate that is
        not positive; an axis that does not exist.

    Examples
    --------
    >>> import os, tempfile
    >>> from model import load_built_in_model
    >>> from model.rig import make_rig
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_skinned_glb(f"{folder}/body.glb", make_rig(load_built_in_model()))
    ...     os.listdir(folder)
    ['body.glb']
    """
    data = encode_skinned_glb(rig, poses, trans, rate, up, material)
    with writing(path) as beside:
        beside.write_bytes(data)


def encode_skinned_glb(rig: Rig, poses: np.ndarray | None = None, trans: np.ndarray | None = None, rate: float = 30.0,
                       up: int = 2, material: Material | None = None) -> bytes:
    """Encode what `write_skinned_glb` writes, as bytes."""
    U = turn_up(up).T
    rig, glb = rig.with_attached().with_up(up), Glb()
    names, targets = rig.beta_targets()
    if rig.correctives is not None:
        names += [f"corrective {k + 1}" for k in range(len(rig.correctives.shapes))]
        targets = np.concatenate([targets, rig.correctives.shapes])
    # morph targets of betas, then of the motion; all start at weight 0
    mesh: dict[str, Any] = {"name": "body", "primitives": [_primitive(glb, rig, targets, material, U)]}
    if names:
        mesh |= {"weights": [0] * len(names), "extras": {"targetNames": names}}
    document = {"scene": 0, "scenes": [{"nodes": [0, 1]}], "nodes": build_nodes(rig), "meshes": [mesh],
                "skins": [add_skin(glb, rig)], **_materials(glb, material, rig.mesh.colors is not None)}
    if poses is not None:
        poses, trans = check_motion(rig.skeleton, poses, trans, rate)
        document["animations"] = [add_animation(glb, rig, poses @ U, trans @ U, rate, len(names))]
    elif rig.correctives is not None:
        raise ValueError("correctives: expected the poses that they belong to")
    return glb.pack(document, up)


def four_carriers(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the four joints (N, 4) with the largest weights of each vertex, and these weights (N, 4).

    Vertices with fewer joints are filled up with joint 0 and weight 0.
    """
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :CARRIERS]
    largest = np.take_along_axis(weights, joints, axis=1)
    joints[largest == 0] = 0
    missing = CARRIERS - joints.shape[1]
    return np.pad(joints, ((0, 0), (0, missing))), np.pad(largest, ((0, 0), (0, missing)))


def continuous_quaternions(R: np.ndarray) -> np.ndarray:
    """Convert rotations (T, J, 3, 3) to unit quaternions (T, J, 4), scalar last, without sign changes over time."""
    q = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(*R.shape[:2], 4)
    same = (q[1:] * q[:-1]).sum(axis=-1, keepdims=True) >= 0
    q[1:] *= np.cumprod(np.where(same, 1, -1), axis=0)
    return q


def _primitive(glb: Glb, rig: Rig, targets: np.ndarray, material: Material | None, U: np.ndarray) -> dict[str, Any]:
    # surface with morph targets, then skinning attributes and tangents of the normal map
    joints, weights = four_carriers(rig.weights)
    out = (glb.add_surface(rig.mesh, targets=targets) if material is None else
           glb.add_surface(rig.mesh, material.normals @ U, material.uv, targets))
    out["attributes"] |= {"JOINTS_0": glb.add_joints(joints), "WEIGHTS_0": glb.add(weights, "VEC4", VERTICES)}
    if material is not None and material.tangents is not None:
        tangents = np.column_stack([material.tangents[:, :3] @ U, material.tangents[:, 3]])
        out["attributes"]["TANGENT"] = glb.add(tangents, "VEC4", VERTICES)
    return out


def _materials(glb: Glb, material: Material | None, colored: bool) -> dict[str, Any]:
    """Build the material with its images; it is white where vertices or a texture give the colour."""
    white = colored or (material is not None and material.color is not None)
    out = skin_material((1, 1, 1)) if white else skin_material()
    images: list[dict[str, Any]] = []

    def texture(image: np.ndarray, name: str) -> dict[str, int]:
        images.append(glb.add_png(png_bytes(image), name))
        return {"index": len(images) - 1}

    if material is not None and material.color is not None:
        out["pbrMetallicRoughness"]["baseColorTexture"] = texture(material.color, "color")
    if material is not None and material.relief is not None:
        out["normalTexture"] = texture(material.relief, "normal")
    if not images:
        return {"materials": [out]}
    # glTF codes: clamp to the edge, linear filter, smaller copies for distance
    edges = {"wrapS": 33071, "wrapT": 33071, "magFilter": 9729, "minFilter": 9987}
    textures = [{"name": image["name"], "sampler": 0, "source": k} for k, image in enumerate(images)]
    return {"materials": [out], "images": images, "textures": textures, "samplers": [edges]}


def build_nodes(rig: Rig) -> list[dict[str, Any]]:
    """Build the nodes: the mesh first, then the joints; joint j is node j + 1."""
    J = len(rig.skeleton.parents)
    turned = _quaternions(rig, np.zeros((1, J, 3)))[0]
    nodes: list[dict[str, Any]] = [{"name": "body", "mesh": 0, "skin": 0}]
    for j, name in enumerate(rig.skeleton.names):
        nodes.append({"name": name, "translation": rig.local_offsets[j].tolist(), "rotation": turned[j].tolist()})
        children = np.flatnonzero(rig.skeleton.parents == j)
        if len(children):
            nodes[-1]["children"] = (children + 1).tolist()
    return nodes


def add_skin(glb: Glb, rig: Rig) -> dict[str, Any]:
    """Add the inverse bind matrices of a rig's joints, nodes 1 to J; return its entry of `skins`."""
    J = len(rig.skeleton.parents)
    inverse = np.tile(np.eye(4), (J, 1, 1))                                   # column after column
    inverse[:, :3, :3] = rig.axes
    inverse[:, 3, :3] = -np.einsum("jba,jb->ja", rig.axes, rig.skeleton.joints)
    return {"name": "skeleton", "joints": list(range(1, J + 1)), "skeleton": 1,
            "inverseBindMatrices": glb.add(inverse.reshape(J, 16), "MAT4", None)}


def _quaternions(rig: Rig, poses: np.ndarray) -> np.ndarray:
    """Compute the quaternions (T, J, 4) of the joints' nodes in poses (T, J, 3)."""
    return continuous_quaternions(rig.local_rotations(poses))


def add_animation(glb: Glb, rig: Rig, poses: np.ndarray, trans: np.ndarray, rate: float, targets: int
                  ) -> dict[str, Any]:
    """Add a motion of the joints\' nodes, in the axes of the rig; return its entry of `animations`."""
    q = _quaternions(rig, poses)
    times = glb.add(np.arange(len(poses)) / rate, "SCALAR", None, bounds=True)
    places = glb.add(rig.skeleton.joints[0] + trans, "VEC3", None)
    out: dict[str, Any] = {"name": "motion", "samplers": [], "channels": []}
    _channel(out, times, places, 1, "translation")
    for j in range(q.shape[1]):
        _channel(out, times, glb.add(q[:, j], "VEC4", None), j + 1, "rotation")
    if rig.correctives is not None:
        frames = rig.correctives.frames
        if frames[-1] >= len(poses):
            raise ValueError(f"correctives: expected weights of {len(poses)} frames, got frame {frames[-1]}")
        # correctives may have weights in some frames only: they get times of their own
        if len(frames) < len(poses):
            times = glb.add(frames / rate, "SCALAR", None, bounds=True)
        weights = np.zeros((len(frames), targets))                            # those of the betas stay 0
        weights[:, targets - rig.correctives.weights.shape[1]:] = rig.correctives.weights
        _channel(out, times, glb.add(weights.ravel(), "SCALAR", None), 0, "weights")
    return out


def _channel(animation: dict[str, Any], times: int, values: int, node: int, path: str) -> None:
    animation["channels"].append({"sampler": len(animation["samplers"]), "target": {"node": node, "path": path}})
    animation["samplers"].append({"input": times, "output": values, "interpolation": "LINEAR"})
