"""A statue for other programs: glTF 2.0 with skin, images and motion, and X3D with an H-Anim skeleton."""
from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree as xml

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import writing
from scanprep.pictures.sheets import save_png

from ..export.glb import Material, write_skinned_glb
from ..export.rig import Rig, check_motion, strongest, turn_up
from .control.model import ControlModel
from .detail.subdivision import Subdivision, subdivide
from .detail.textures import chart_tangents, vertex_of_row
from .motion.retarget import StatueMotion


def write_statue_glb(path: str | Path, control: ControlModel, vertices: np.ndarray | None = None,
                     subdivision: Subdivision | None = None, texture: np.ndarray | None = None,
                     normals: np.ndarray | None = None, heights: np.ndarray | None = None,
                     motion: StatueMotion | None = None, up: int = 2) -> None:
    """Write a statue for any glTF 2.0 viewer, animation program or game engine; the axis `up` points up.

    glTF knows linear blend skinning only: joints carry the detailed vertices themselves, while `Reconstruction` moves
    the control mesh and sets the detail upon it anew. The rest pose is that of the scan. Without `vertices` (n, 3) of a
    subdivision it is the control mesh itself, which `normals` (`normal_image`) and `heights` detail; glTF has no place
    for heights, so they are an image that the material's `extras` name.
    """
    rig, material = statue_rig(control, vertices, subdivision, texture, normals, heights)
    if motion is None:
        write_skinned_glb(path, rig, up=up, material=material)
    else:
        write_skinned_glb(path, rig, motion.poses, motion.trans, motion.rate, up=up, material=material)


def statue_rig(control: ControlModel, vertices: np.ndarray | None, subdivision: Subdivision | None,
               texture: np.ndarray | None = None, normals: np.ndarray | None = None, heights: np.ndarray | None = None
               ) -> tuple[Rig, Material]:
    """The skin with its vertices repeated along the seams of the chart, and its material."""
    if (vertices is None) != (subdivision is None):
        raise ValueError("vertices, subdivision: expected both or none")
    if subdivision is None or vertices is None:
        subdivision, vertices = subdivide(control.mesh, control.chart, 0), control.mesh.vertices
    if np.shape(vertices) != (len(subdivision.parent), 3):
        raise ValueError(f"vertices: expected shape ({len(subdivision.parent)}, 3), got {np.shape(vertices)}")
    mesh, chart = Mesh(vertices, subdivision.faces), subdivision.chart
    weights = np.einsum("nc,ncj->nj", subdivision.bary, control.weights[control.mesh.faces[subdivision.parent]])
    row = vertex_of_row(mesh, chart)
    split = Mesh(mesh.vertices[row], chart.faces)
    tangents = None if normals is None else chart_tangents(mesh, chart)
    material = Material(chart.uv, mesh.vertex_normals[row], tangents, texture, normals, heights)
    return Rig(split, control.skeleton, strongest(weights)[row], np.zeros((0, *split.vertices.shape))), material


_DOCTYPE = ('<?xml version="1.0" encoding="UTF-8"?>\n<!DOCTYPE X3D PUBLIC "ISO//Web3D//DTD X3D 4.0//EN" '
            '"https://www.web3d.org/specifications/x3d-4.0.dtd">\n')
_RENAMED = {"wrist": "radiocarpal", "ankle": "talocrural"}       # joints that H-Anim 2.0 calls otherwise than 1.0


def write_x3d(path: str | Path, control: ControlModel, vertices: np.ndarray | None = None,
              subdivision: Subdivision | None = None, texture: np.ndarray | None = None,
              motion: StatueMotion | None = None, up: int = 2) -> None:
    """Write a statue as an `HAnimHumanoid` of X3D 4.0, and its texture as a PNG of the same name beside it.

    Joints have the names of H-Anim 2.0 where the control model's parts have those of 1.0, as the generic humanoid's,
    and their centres in the pose of the scan, where no joint is turned. Skin and joints share their coordinates.
    """
    path = Path(path)
    if (vertices is None) != (subdivision is None):
        raise ValueError("vertices, subdivision: expected both or none")
    if subdivision is None or vertices is None:
        subdivision, vertices = subdivide(control.mesh, control.chart, 0), control.mesh.vertices
    if np.shape(vertices) != (len(subdivision.parent), 3):
        raise ValueError(f"vertices: expected shape ({len(subdivision.parent)}, 3), got {np.shape(vertices)}")
    U = turn_up(up).T
    root = xml.Element("X3D", profile="Full", version="4.0")
    head = xml.SubElement(root, "head")
    xml.SubElement(head, "meta", name="generator", content="scapekit")
    scene = xml.SubElement(root, "Scene")
    names = _names(control)
    person = xml.SubElement(scene, "HAnimHumanoid", DEF="statue", name="statue", version="2.0")
    weights = np.einsum("nc,ncj->nj", subdivision.bary, control.weights[control.mesh.faces[subdivision.parent]])
    _skeleton(person, control, names, strongest(weights), U)
    for name in names:
        xml.SubElement(person, "HAnimJoint", USE=name, containerField="joints")
    image = None if texture is None else path.with_suffix(".png").name
    _skin(person, Mesh(vertices @ U, subdivision.faces), subdivision, image)
    if motion is not None:
        _play(scene, control, names, motion, U)
    if texture is not None:
        save_png(path.with_suffix(".png"), texture)
    xml.indent(root, " ")
    with writing(path) as beside:
        beside.write_text(_DOCTYPE + xml.tostring(root, encoding="unicode") + "\n", encoding="utf-8")


def _names(control: ControlModel) -> list[str]:
    """Names of the parts as XML takes them for an identity."""
    plain = [re.sub(r"[^A-Za-z0-9_]", "_", name) for name in control.skeleton.names]
    plain = [name if name[:1].isalpha() else f"part_{name}" for name in plain]
    return [name if plain.count(name) == 1 and name != "statue" else f"{name}_{j}" for j, name in enumerate(plain)]


def _skeleton(person: xml.Element, control: ControlModel, names: list[str], weights: np.ndarray, U: np.ndarray
              ) -> None:
    nodes: list[xml.Element] = []
    for j, parent in enumerate(control.skeleton.parents):
        carried = np.flatnonzero(weights[:, j])
        nodes.append(xml.SubElement(
            nodes[parent] if j else person, "HAnimJoint", DEF=names[j],
            name=re.sub("^([lr]_)(wrist|ankle)$", lambda found: found[1] + _RENAMED[found[2]], names[j]),
            containerField="children" if j else "skeleton", center=_row(control.skeleton.joints[j] @ U),
            skinCoordIndex=" ".join(map(str, carried)), skinCoordWeight=_row(weights[carried, j])))


def _skin(person: xml.Element, mesh: Mesh, subdivision: Subdivision, image: str | None) -> None:
    xml.SubElement(person, "Coordinate", DEF="skin_points", containerField="skinCoord", point=_rows(mesh.vertices))
    xml.SubElement(person, "Normal", DEF="skin_normals", containerField="skinNormal",
                   vector=_rows(mesh.vertex_normals))
    shape = xml.SubElement(person, "Shape", containerField="skin")
    look = xml.SubElement(shape, "Appearance")
    xml.SubElement(look, "Material", diffuseColor="0.8 0.77 0.74" if image is None else "1 1 1")
    if image is not None:
        xml.SubElement(look, "ImageTexture", url=f'"{image}"', repeatS="false", repeatT="false")
    chart = subdivision.chart
    surface = xml.SubElement(shape, "IndexedFaceSet", coordIndex=_faces(mesh.faces), texCoordIndex=_faces(chart.faces))
    xml.SubElement(surface, "Coordinate", USE="skin_points")
    xml.SubElement(surface, "Normal", USE="skin_normals")
    xml.SubElement(surface, "TextureCoordinate", point=_rows(chart.uv))


def _play(scene: xml.Element, control: ControlModel, names: list[str], motion: StatueMotion, U: np.ndarray) -> None:
    poses, trans = check_motion(control.skeleton, motion.poses, motion.trans, motion.rate)
    T = len(poses)
    xml.SubElement(scene, "TimeSensor", DEF="clock", cycleInterval=f"{max(T - 1, 1) / motion.rate:.9g}", loop="true")
    key = _row(np.linspace(0, 1, T))
    xml.SubElement(scene, "PositionInterpolator", DEF="travel", key=key, keyValue=_rows(trans @ U))
    angles = np.linalg.norm(poses, axis=-1, keepdims=True)
    axes = np.where(angles > 0, poses / np.maximum(angles, 1e-300), [0, 0, 1]) @ U
    for j, name in enumerate(names):
        xml.SubElement(scene, "OrientationInterpolator", DEF=f"turn_{name}", key=key,
                       keyValue=_rows(np.concatenate([axes[:, j], angles[:, j]], axis=1)))
    for source in ["travel", *(f"turn_{name}" for name in names)]:
        xml.SubElement(scene, "ROUTE", fromNode="clock", fromField="fraction_changed", toNode=source,
                       toField="set_fraction")
    for source, name, kind in [("travel", names[0], "translation"), *((f"turn_{n}", n, "rotation") for n in names)]:
        xml.SubElement(scene, "ROUTE", fromNode=source, fromField="value_changed", toNode=name, toField=f"set_{kind}")


def _row(values: np.ndarray) -> str:
    return " ".join(f"{value:.7g}" for value in np.round(values, 8) + 0.0)


def _rows(values: np.ndarray) -> str:
    return ", ".join(map(_row, values))


def _faces(faces: np.ndarray) -> str:
    return " ".join(f"{a} {b} {c} -1" for a, b, c in faces)
