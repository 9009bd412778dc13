"""A statue on disk: control model, images over its chart, and files for other commands and programs."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.images import open_image
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic import people

from ..blend_weights import strongest
from ..export.glb import Material, write_skinned_glb
from ..export.names import Names, rename_bones
from ..features import linear_features
from ..motion.retarget import Retargeted
from ..rig import Rig
from ..skinning import SkinningModel
from .control.files import humanoid, humanoid_markers, read_control, write_control
from .control.model import ControlModel, Statue
from .detail.maps import read_map, write_map
from .detail.subdivision import Subdivision, subdivide_uniform
from .detail.texels import chart_tangents, normal_image, vertex_of_row
from .motion.motions import people_motion

KIND, VERSION = "statue", 1
CONTROL, ABOUT, TEXTURE, BODY = "control.npz", "statue.json", "texture.png", "body.npz"


def save_statue(folder: str | Path, statue: Statue) -> None:
    """Write a statue into a folder: control.npz, statue.json, the images of the map, and texture.png.

    Parameters
    ----------
    folder : str or Path
        Folder to write; it is made if it does not exist.
    statue : Statue
        The statue.

    Examples
    --------
    >>> import tempfile
    >>> from model.statue.control.files import humanoid
    >>> from model.statue.control.model import MEASURED, DisplacementMap
    >>> flat = DisplacementMap(np.zeros((16, 16), np.float32), np.full((16, 16), MEASURED, np.uint8))
    >>> statue = Statue(humanoid(), np.zeros((len(humanoid().skeleton.parents), 3)), flat)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     save_statue(folder, statue)
    ...     load_statue(folder).map.heights.shape
    (16, 16)

    [Statues]
    """
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
    """Read a statue from a folder of `save_statue`.

    Parameters
    ----------
    folder : str or Path
        Folder of a statue.
    edited : str or Path, optional
        An edited copy of displacement.png. Where it differs from the image of the folder, its heights are used.

    Returns
    -------
    Statue
        Control model, pose (J, 3) in radians, displacement map and texture.

    Raises
    ------
    StorageError
        The folder is missing or no statue, of an unknown version, or the image has another size or depth.

    Examples
    --------
    >>> from model.statue.control.files import humanoid
    >>> from model.statue.control.model import MEASURED, DisplacementMap
    >>> flat = DisplacementMap(np.zeros((16, 16), np.float32), np.full((16, 16), MEASURED, np.uint8))
    >>> save_statue("statue", Statue(humanoid(), np.zeros((len(humanoid().skeleton.parents), 3)), flat))
    >>> load_statue("statue").map.heights.shape
    (16, 16)
    """
    folder, texture = Path(folder), None
    about = storage.read_json(folder / ABOUT, "a folder of scape statue fit")
    if not isinstance(about, dict) or about.get("kind") != KIND:
        raise storage.StorageError(f"{folder / ABOUT}: expected a statue in JSON, found something else")
    if about.get("version") != VERSION:
        raise storage.StorageError(f"{folder / ABOUT}: statue version {about.get('version')} is not known here "
                                   f"(known: {VERSION})")
    control = read_control(folder / CONTROL)
    with storage.taking_apart(folder / ABOUT, "a whole statue"):
        pose = storage.numbers({"pose": np.array(about["pose"], dtype=np.float64)}, "pose",
                               len(control.skeleton.parents), 3)
    if about.get("texture"):
        with open_image(folder / TEXTURE, "the texture of the statue") as image:
            texture = np.asarray(image.convert("RGB"))
    return Statue(control, pose, read_map(folder, edited), texture)


def write_body(folder: Path, statue: Statue) -> None:
    """Write body.npz, a model that markers and points drive, and for the humanoid markers.json, a layout of markers.

    What random poses of the synthetic people do with these joints makes the pose prior of the humanoid.
    """
    control, poses = statue.control, None
    if control.skeleton.names == humanoid().skeleton.names:
        rng = np.random.default_rng(0)
        poses = people_motion(control, statue.pose, np.array([people.random_pose(rng) for _ in range(100)])).poses
        storage.write_json(folder / "markers.json", {"markersets": [{
            "type": "body", "distance_from_skin": 0.0095, "indices": humanoid_markers()}]})      # [MoSh]
    body_model(control, poses).save(folder / BODY)


def body_model(control: ControlModel, poses: np.ndarray | None = None) -> SkinningModel:
    """Convert a control model to a skinning model of one person, without betas.

    The poses (M, J, 3) that people take give the pose prior; without any, all rotations are about as likely.

    [Statues] Eq. 1
    """
    skeleton, N = control.skeleton, len(control.mesh.vertices)
    J = len(skeleton.parents)
    if poses is None:
        mean, covariance, poses = np.zeros((J, 3)), np.eye(3 * J), np.zeros((0, J, 3))
        covariance[:3, :3] = 0
    else:
        poses = poses.copy()
        poses[:, 0] = 0
        mean, covariance = poses.mean(axis=0), np.cov(poses.reshape(len(poses), -1).T)
    no_correctives = linear_features(skeleton, (np.zeros((3, 0)),) * J)
    return SkinningModel(
        control.mesh, skeleton, control.mesh.vertices, control.weights, no_correctives,
        np.zeros((0, N, 3)), control.mesh.vertices, np.zeros((0, N, 3)), np.zeros(0), 0.0, mean, covariance,
        {"made of": "a statue", "landmarks": dict(control.landmarks)}, pose_examples=poses)


def write_for_programs(folder: Path, statue: Statue, vertices: np.ndarray, fine: Subdivision, up: int) -> None:
    """Write statue.glb; the normals of the detailed `vertices` become an image."""
    normals = normal_image(statue.control, vertices, fine, len(statue.map.heights))
    write_statue_glb(folder / "statue.glb", statue.control, texture=statue.texture, normals=normals,
                     up=up)


def write_statue_glb(path: str | Path, control: ControlModel, vertices: np.ndarray | None = None,
                     subdivision: Subdivision | None = None, texture: np.ndarray | None = None,
                     normals: np.ndarray | None = None, motion: Retargeted | None = None, up: int = 2,
                     names: Names | None = None) -> None:
    """Write a statue for any glTF 2.0 viewer, animation program or game engine; the axis `up` points up.

    glTF knows linear blend skinning only: joints carry the detailed vertices themselves, while `Reconstruction` moves
    the control mesh and sets the detail upon it anew. The rest pose is that of the scan. Without `vertices` (n, 3) of a
    subdivision it is the control mesh itself, which `normals` (`normal_image`) detail.
    """
    if (vertices is None) != (subdivision is None):
        raise ValueError("vertices, subdivision: expected both or none")
    if subdivision is None or vertices is None:
        subdivision, vertices = subdivide_uniform(control.mesh, control.chart, 0), control.mesh.vertices
    if np.shape(vertices) != (len(subdivision.parent), 3):
        raise ValueError(f"vertices: expected shape ({len(subdivision.parent)}, 3), got {np.shape(vertices)}")
    mesh, chart = Mesh(vertices, subdivision.faces), subdivision.chart
    # blend weights of the fine vertices are interpolated; vertices repeat along the seams of the chart
    weights = np.einsum("nc,ncj->nj", subdivision.bary, control.weights[control.mesh.faces[subdivision.parent]])
    row = vertex_of_row(mesh, chart)                            # vertices are repeated along the seams of the chart
    split = Mesh(mesh.vertices[row], chart.faces)
    tangents = None if normals is None else chart_tangents(mesh, chart)
    material = Material(chart.uv, mesh.vertex_normals[row], tangents, texture, normals)
    rig = Rig(split, control.skeleton, strongest(weights)[row], np.zeros((0, *split.vertices.shape)))
    rig = rig if names is None else rename_bones(rig, names)
    poses, trans, rate = (None, None, 1.0) if motion is None else (motion.poses, motion.trans, motion.rate)
    write_skinned_glb(path, rig, poses, trans, rate, up=up, material=material)
