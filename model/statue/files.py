"""A statue on disk: the control model, the images over its chart, and the files for other commands."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic import people

from ..features import linear_features
from ..skinning import SkinningModel
from .control.files import read_control, write_control
from .control.humanoid import humanoid, humanoid_markers
from .control.model import ControlModel, Statue
from .detail.maps import read_map, write_map
from .detail.subdivision import Subdivision
from .detail.textures import normal_image
from .motion.motions import people_motion
from .skins import write_statue_glb, write_x3d

KIND, VERSION = "statue", 1
CONTROL, ABOUT, TEXTURE = "control.npz", "statue.json", "texture.png"
BODY, MARKERS = "body.npz", "markers.json"
SKIN = 0.0095                        # metres from the skin to the middle of a marker [MoSh]


def save_statue(folder: str | Path, statue: Statue) -> None:
    """Write control.npz, statue.json, the images of the map and texture.png into a folder."""
    from PIL import Image

    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_control(statue.control, folder / CONTROL)
    write_map(folder, statue.map)
    if statue.texture is not None:
        with storage.writing(folder / TEXTURE) as beside:
            Image.fromarray(statue.texture).save(beside)
    storage.write_json(folder / ABOUT, {"kind": KIND, "version": VERSION, "pose": statue.pose.tolist(),
                                        "texture": statue.texture is not None})


def load_statue(folder: str | Path, edited: str | Path | None = None) -> Statue:
    """Read a folder of `save_statue`.

    Parameters
    ----------
    edited : path, optional
        An edited copy of displacement.png: where it differs from the image of the folder, its heights count.

    Raises
    ------
    StorageError
        Missing, not a statue, a version that is not known, an image of another size or depth.
    """
    from PIL import Image

    folder = Path(folder)
    about = storage.read_json(folder / ABOUT, "a folder of scape statue fit")
    if not isinstance(about, dict) or about.get("kind") != KIND:
        raise storage.StorageError(f"{folder / ABOUT}: expected a statue in JSON, found something else")
    if about.get("version") != VERSION:
        raise storage.StorageError(f"{folder / ABOUT}: statue version {about.get('version')} is not known here "
                                   f"(known: {VERSION})")
    control = read_control(folder / CONTROL)
    texture = None
    with storage.taking_apart(folder / ABOUT, "a whole statue"):
        pose = storage.numbers({"pose": np.array(about["pose"], dtype=np.float64)}, "pose",
                               len(control.skeleton.parents), 3)
    if about.get("texture"):
        with storage.taking_apart(folder / TEXTURE, "the texture of the statue"), Image.open(folder / TEXTURE) as image:
            texture = np.asarray(image.convert("RGB"))
    return Statue(control, pose, read_map(folder, edited), texture)


def write_body(folder: Path, statue: Statue) -> None:
    """Write body.npz, a model that markers and points drive, and for the humanoid markers.json, a layout of markers."""
    control, poses = statue.control, None
    if control.skeleton.names == humanoid().skeleton.names:
        poses = people_motion(control, statue.pose, people_poses()).poses
        storage.write_json(folder / MARKERS, {"markersets": [{
            "type": "body", "distance_from_skin": SKIN, "indices": humanoid_markers()}]})
    body_model(control, poses).save(folder / BODY)


def write_for_programs(folder: Path, statue: Statue, vertices: np.ndarray, fine: Subdivision, up: int) -> None:
    """Write statue.glb, the control mesh with skin and all images, and statue.x3d, the same as H-Anim; `vertices` are
    those of the detailed surface, whose normals become the normal image.
    """
    normals = normal_image(statue.control, vertices, fine, len(statue.map.heights))
    write_statue_glb(folder / "statue.glb", statue.control, texture=statue.texture, normals=normals,
                     heights=statue.map.heights, up=up)
    write_x3d(folder / "statue.x3d", statue.control, texture=statue.texture, up=up)


POSES = 100                          # random poses of the synthetic people that make the pose prior
WIDEST = 1.0                         # radians: standard deviation of the turns of a joint without such poses


def body_model(control: ControlModel, poses: np.ndarray | None = None) -> SkinningModel:
    """The control model under linear blend skinning as a model of one person, without betas. The poses (M, J, 3) that
    people take make the pose prior; without any all rotations are about as likely. [Statues] Eq. 1
    """
    skeleton, N = control.skeleton, len(control.mesh.vertices)
    J = len(skeleton.parents)
    if poses is None:
        mean, covariance, poses = np.zeros((J, 3)), WIDEST**2 * np.eye(3 * J), np.zeros((0, J, 3))
        covariance[:3, :3] = 0
    else:
        poses = poses.copy()
        poses[:, 0] = 0
        mean, covariance = poses.mean(axis=0), np.cov(poses.reshape(len(poses), -1).T)
    return SkinningModel(
        control.mesh, skeleton, control.mesh.vertices, control.weights, _no_correctives(skeleton),
        np.zeros((0, N, 3)), control.mesh.vertices, np.zeros((0, N, 3)), np.zeros(0), 0.0, mean, covariance,
        {"made of": "a statue", "landmarks": dict(control.landmarks)}, pose_examples=poses)


def people_poses(count: int = POSES, seed: int = 0) -> np.ndarray:
    """Random poses (count, 16, 3), radians, of the synthetic people."""
    rng = np.random.default_rng(seed)
    return np.array([people.random_pose(rng) for _ in range(count)])


def _no_correctives(skeleton: Skeleton):  # type: ignore[no-untyped-def]
    return linear_features(skeleton, tuple(np.zeros((3, 0)) for _ in skeleton.parents))
