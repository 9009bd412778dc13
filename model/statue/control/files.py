"""Files of control models: our own, the generic humanoid among them, and skinned meshes of other programs."""
from __future__ import annotations

import json
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry import format_glb as glb
from scanprep.geometry import storage
from scanprep.geometry.budget import reading
from scanprep.geometry.format_common import MeshFileError
from scanprep.geometry.mesh import Mesh
from scanprep.repair.hole_filling import close
from scanprep.skeleton.tree import Skeleton

from ...blend_weights import strongest
from ...rig import turn_up
from .chart import Chart, automatic_chart
from .model import ControlModel, control_problem, surface_problem

# share of the surface that the largest component must have: eyes, teeth and claws have a tenth, a second body a half
LEAST = 0.7
KIND, VERSION = "control model", 1
STORED = Path(__file__).with_name("humanoid.npz")           # our own mesh, once moved onto the built-in people


def read_control(path: str | Path) -> ControlModel:
    """Read a control model: a file of `write_control`, or a skinned mesh in a GLB file as Blender exports it.

    For a skinned mesh, the pose of the file is the default pose, turned so that z is up. Joints rotate about three axes
    with wide limits, every part is a segment of its own, and there are no landmarks. Joints without triangles are left
    out. A chart is made for the images. StorageError says what is wrong with a file.
    """
    readers = {".npz": _load, ".glb": _read_skinned}
    if Path(path).suffix.lower() not in readers:
        raise storage.StorageError(f"{path}: expected a control model in .npz or a skinned mesh in .glb")
    return readers[Path(path).suffix.lower()](Path(path))


def write_control(control: ControlModel, path: str | Path) -> None:
    """Write one `.npz` file, which `read_control` reads."""
    skeleton = control.skeleton
    storage.save(path, KIND, VERSION, {
        "vertices": control.mesh.vertices, "faces": control.mesh.faces.astype(np.int32),
        "part_of_face": skeleton.part_of_face.astype(np.int32), "parents": skeleton.parents, "joints": skeleton.joints,
        "weights": control.weights, "uv": control.chart.uv, "chart_faces": control.chart.faces.astype(np.int32),
        "axes": np.concatenate(control.axes), "limits": np.concatenate(control.limits),
        "freedom": np.array([len(axes) for axes in control.axes]), "segment_of_part": control.segment_of_part,
        "landmark_vertices": np.array(list(control.landmarks.values()), dtype=np.int64)},
                 {"names": list(skeleton.names), "segments": list(control.segments),
                  "landmarks": list(control.landmarks)})


def _load(path: Path) -> ControlModel:
    """Read a file of `write_control`."""
    header, arrays = storage.load(path, KIND, (VERSION,))
    with storage.taking_apart(path, "a whole control model"):
        freedom = storage.numbers(arrays, "freedom", None, kinds="iu")
        J, ends = len(freedom), np.cumsum(freedom)[:-1]
        mesh = Mesh(storage.numbers(arrays, "vertices", None, 3), storage.numbers(arrays, "faces", None, 3, kinds="iu"))
        N, k = len(mesh.vertices), int(freedom.sum())
        skeleton = Skeleton(storage.numbers(arrays, "part_of_face", len(mesh.faces), kinds="iu"),
                            storage.numbers(arrays, "parents", J, kinds="iu"), storage.numbers(arrays, "joints", J, 3),
                            tuple(header["names"]))
        marks = storage.numbers(arrays, "landmark_vertices", len(header["landmarks"]), kinds="iu")
        control = ControlModel(
            mesh, skeleton, storage.numbers(arrays, "weights", N, J),
            Chart(storage.numbers(arrays, "uv", None, 2),
                  storage.numbers(arrays, "chart_faces", len(mesh.faces), 3, kinds="iu").astype(np.int64)),
            dict(zip(header["landmarks"], marks.tolist(), strict=True)),
            tuple(np.split(storage.numbers(arrays, "axes", k, 3), ends)),
            tuple(np.split(storage.numbers(arrays, "limits", k, 2), ends)), tuple(header["segments"]),
            storage.numbers(arrays, "segment_of_part", J, kinds="iu"))
        problem = control_problem(control)
        if problem:
            raise ValueError(problem)
    return control


def _read_skinned(path: Path) -> ControlModel:
    what = "a GLB file with one mesh that hangs on joints"
    storage.check_regular(path, MeshFileError, what)
    with reading(path, MeshFileError), storage.taking_apart(path, what, MeshFileError):
        tree, binary = glb.chunks_of(path, storage.read_bytes(path, what, MeshFileError))
        # the nodes with a mesh on joints; one skin may move several meshes, such as body and eyes
        nodes = list(glb.nodes_of(tree))
        skinned = [node for _, node, _ in nodes if "mesh" in node and "skin" in node]
        sizes = [sum(glb.item(tree["accessors"], primitive["attributes"]["POSITION"])["count"]
                     for primitive in glb.item(tree["meshes"], node["mesh"])["primitives"]) for node in skinned]
        main = skinned[int(np.argmax(sizes))]["skin"] if skinned else -1
        on_main = sum(size for size, node in zip(sizes, skinned, strict=True) if node["skin"] == main)
        if on_main < LEAST * sum(sizes) or not on_main:
            meshes = sum("mesh" in node for _, node, _ in nodes)
            raise ValueError(f"found {len(skinned)} meshes that hang on joints, {meshes} meshes in all; expected those "
                             "of one skeleton")
        aside = [str(node.get("name", "unnamed")) for node in skinned if node["skin"] != main]
        if aside:
            warnings.warn(f"{path}: left out {', '.join(aside)}, which hang on another skeleton", stacklevel=2)
        skinned, skin = [node for node in skinned if node["skin"] == main], glb.item(tree["skins"], main)
        places = {number: matrix for number, _, matrix in nodes}
        joints = skin["joints"]
        # its surface in the pose of the file
        motion = glb.joint_matrices(tree, binary, skin, places)
        joint_places = np.stack([places[number] for number in joints])[:, :3, 3]
        whole = {"primitives": [primitive for node in skinned
                                for primitive in glb.item(tree["meshes"], node["mesh"])["primitives"]]}
        points, weights, faces = _corners(tree, binary, whole, len(joints))
        points = glb.apply_skin(points, weights, motion)
        if not np.isfinite(points).all():
            raise ValueError(f"{(~np.isfinite(points).all(axis=1)).sum()} vertices are not finite")
        # the joint next above every joint, -1 where there is none
        above = {child: number for number, node, _ in nodes for child in node.get("children", [])}
        parents = []
        for number in joints:
            up = above.get(number)
            while up is not None and up not in joints:
                up = above.get(up)
            parents.append(-1 if up is None else joints.index(up))
        return _control(path, _weld(points, weights, faces), joint_places, np.array(parents),
                        [str(glb.item(tree["nodes"], number).get("name", f"joint{number}")) for number in joints])


def _corners(tree: dict[str, Any], binary: bytes, mesh: dict[str, Any], joints: int
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Join all primitives of a mesh: points (n, 3), weights (n, joints) and triangles.

    Materials do not divide a control mesh. Points are repeated where normals or texture coordinates differ.
    """
    points, weights, faces = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    start = 0
    for primitive in mesh["primitives"]:
        if primitive.get("mode", 4) != 4:    # the mode of triangles
            raise ValueError(f"expected triangles, found a primitive of mode {primitive['mode']}")
        attributes = primitive["attributes"]
        points.append(glb.accessor(tree, binary, attributes["POSITION"], "VEC3").astype(np.float64))
        count, own = len(points[-1]), glb.primitive_triangles(tree, binary, primitive, len(points[-1]))
        if len(own) and (own.min() < 0 or own.max() >= count):
            raise ValueError(f"a triangle refers to vertex {own.max()}, expected 0..{count - 1}")
        weights.append(glb.weights_of(tree, binary, primitive, joints))
        faces.append(own + start)
        start += count
    return np.concatenate(points), np.concatenate(weights), np.concatenate(faces)


def _control(path: Path, surface: tuple[Mesh, np.ndarray], places: np.ndarray, parents: np.ndarray,
             names: list[str]) -> ControlModel:
    mesh, weights = _one_surface(path, *surface)
    problem = surface_problem(mesh)
    if problem:
        raise ValueError(f"not usable as a control mesh: {problem}")
    up = turn_up(2)                                                    # z up, as the people
    mesh, places = mesh.with_vertices(mesh.vertices @ up), places @ up
    kept, parents, weights, part_of_face = _with_triangles(mesh, weights, parents)
    joints, names = places[kept], [names[j] for j in kept]
    distinct = tuple(name if names.count(name) == 1 else f"{name} {k}" for k, name in enumerate(names))
    skeleton, J = Skeleton(part_of_face, parents, joints, distinct).with_root_centred(mesh), len(parents)
    control = ControlModel(mesh, skeleton, strongest(weights), automatic_chart(mesh, skeleton), {},
                           (np.eye(3),) * J, (np.array([[-np.pi, np.pi]] * 3),) * J, skeleton.names, np.arange(J))
    problem = control_problem(control)
    assert problem is None, problem
    return control


def _one_surface(path: Path, mesh: Mesh, weights: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Keep the largest part of a mesh, closed and manifold, with the weights of the nearest vertices; say what changed.

    Small parts such as eyes and teeth are left out: where the figure has them, they are in the detail.
    """
    if surface_problem(mesh) is None:
        return mesh, weights
    part = mesh.vertex_component[mesh.faces[:, 0]]
    areas = np.bincount(part, mesh.face_areas)
    share = areas.max() / areas.sum()
    if share < LEAST:
        raise ValueError(f"not usable as a control mesh: it has {(areas > 0).sum()} components, the largest is "
                         f"{100 * share:.0f}% of the surface; join them into one surface, with Blender for example")
    body = close(mesh.submesh(part == areas.argmax())[0])
    body = body if body.volume > 0 else Mesh(body.vertices, np.ascontiguousarray(body.faces[:, ::-1]))
    others = (areas > 0).sum() - 1
    left = f"left out {others} small components such as eyes" if others else "its surface was repaired and closed"
    warnings.warn(f"{path}: {left}; {len(body.faces)} of {len(mesh.faces)} triangles make the control mesh",
                  stacklevel=2)
    return body, weights[cKDTree(mesh.vertices).query(body.vertices)[1]]


def _weld(points: np.ndarray, weights: np.ndarray, corners: np.ndarray) -> tuple[Mesh, np.ndarray]:
    """Weld repeated points: mesh and weights with one vertex at every place."""
    _, first, place = np.unique(points.astype(np.float32), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))                              # vertices in the order of the file
    first, place = np.sort(first), order[place.reshape(-1)]
    faces = place[corners]
    # triangles that collapse by welding, and unused vertices, are dropped
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    used, number = np.unique(faces[whole], return_inverse=True)
    mesh = Mesh(points[first[used]], number.reshape(-1, 3))
    return mesh, weights[first[used]]


def _with_triangles(mesh: Mesh, weights: np.ndarray, parents: np.ndarray
                    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Keep the joints (k,) that have the largest weight on some triangle, parents first.

    Returns them with their parents, weights (N, k), and the part of every triangle. Weights of the other joints go to
    the next kept joint above. Where several trees are left, all are attached to the one with most triangles.
    """
    carrier = weights[mesh.faces].mean(axis=1).argmax(axis=1)
    size = np.bincount(carrier, minlength=len(parents))
    heir = np.arange(len(parents))
    for j in range(len(parents)):
        while heir[j] >= 0 and not size[heir[j]]:
            heir[j] = parents[heir[j]]
    own = np.flatnonzero(size)
    tops = [j for j in own if parents[j] < 0 or heir[parents[j]] < 0]
    root = max(tops, key=lambda j: size[j])
    above = {j: -1 if j == root else root if j in tops else heir[parents[j]] for j in own.tolist()}
    kept, ahead = [], [root]
    while ahead:                                                       # in the order of the file, parents first
        kept.append(ahead.pop())
        ahead += [j for j in reversed(above) if above[j] == kept[-1]]
    index = np.full(len(parents), -1)
    index[kept] = np.arange(len(kept))
    heir[heir < 0] = root
    gathered = np.zeros((len(weights), len(kept)))
    np.add.at(gathered.T, index[heir], weights.T)
    return np.array(kept), np.array([-1 if j == root else index[above[j]] for j in kept]), gathered, index[carrier]


@lru_cache(maxsize=1)
def humanoid() -> ControlModel:
    """The generic humanoid, the average of a man and a woman of 1.69 m, arms and legs a little apart.

    z is up, it faces -y and stands on z = 0, its left side is at +x. Its joints turn and its segments stretch as in the
    paper: with the place of the root 38 parameters of pose, and 9 lengths.

    [Statues] Section 3.1
    """
    return read_control(STORED)


@lru_cache(maxsize=1)
def humanoid_markers() -> dict[str, int]:
    """Label -> vertex of 41 motion-capture markers, labelled as in the CMU recordings."""
    return dict(json.loads(STORED.with_name("humanoid_markers.json").read_text(encoding="utf-8")))
