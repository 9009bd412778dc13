"""One small good file of every kind that the project reads, how it is read, and what must hold of what was read."""
from __future__ import annotations

import json
import struct
from base64 import b64encode
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from conformance_bodies import KINDS
from model_bodies import random_poses, worm, worm_skeleton
from PIL import Image

from completion import MarkerLayout, MarkerSequence, read_markers, write_markers
from completion.mocap.animate.cli import read_betas_to
from completion.mocap.files.c3d import replace_points
from completion.mocap.mosh.recordings import _table_rows
from completion.mocap.soft_tissue.soft_tissue import SoftTissue
from completion.motion import Motion
from completion.partial.completion import Completion, load_completion
from completion.partial.masks import read_mask
from model.export.bvh import write_bvh
from model.files import KINDS as known_kinds  # noqa: N811
from model.files import load_model
from model.learning.cli import _read_sexes
from model.motion.bvh import read_bvh
from model.motion.onto import read_motion
from model.posing.cli import _read_betas, _read_turns
from model.statue.own_mesh import read_pieces
from scanprep import Mesh, RegisteredSet, read_landmarks, read_mesh, write_landmarks, write_mesh
from scanprep.correspondence.correspondences import Correspondences, read_correspondences, write_correspondences
from scanprep.decimation.registered_set import _load_map, write_decimated_set
from scanprep.geometry import storage
from scanprep.geometry.files import PointCloud, read_points, write_points
from scanprep.geometry.landmarks import read_landmark_vertices
from scanprep.pictures.textures import Texture, read_texture, write_textured
from scanprep.pipeline.scans import find_scans
from scanprep.skeleton.edit import read_edits
from scanprep.skeleton.tree import Skeleton
from scanprep.surfaces.cli import _read_views
from scanprep.synthetic.anatomy import BodyShape
from scanprep.synthetic.data_set import GroundTruth

MARKS = {"nose": 3, "left": 100, "right": 200, "tail": 380}


@dataclass(frozen=True)
class Seed:
    """A good file, the function that reads it, and the check of what it gave."""

    path: Path
    read: Callable[[Path], Any]
    check: Callable[[Any], None] = lambda found: None


def finite(*arrays: np.ndarray | None) -> None:
    assert all(a is None or np.isfinite(a).all() for a in arrays), "not finite"


def good_mesh(mesh: Mesh) -> None:
    finite(mesh.vertices, mesh.colors, mesh.vertex_normals, mesh.face_areas)
    assert mesh.faces.shape[1:] == (3,) and ((mesh.faces >= 0) & (mesh.faces < len(mesh.vertices))).all()


def good_points(cloud: PointCloud) -> None:
    finite(cloud.points, cloud.normals, cloud.colors)
    assert all(a is None or a.shape == cloud.points.shape == (len(a), 3) for a in (cloud.normals, cloud.colors))
    assert cloud.colors is None or 0 <= cloud.colors.min() <= cloud.colors.max() <= 1


def good_places(mesh: Mesh) -> Callable[[dict[str, Any]], None]:
    def check(found: dict[str, Any]) -> None:
        for value in found.values():
            finite(value)
            assert np.shape(value) == (3,) or 0 <= value < len(mesh.vertices)
    return check


def good_markers(found: MarkerSequence) -> None:
    assert found.rate > 0 and not np.isinf(found.positions).any() and len(set(found.labels)) == len(found.labels)
    finite(np.nan_to_num(found.positions) ** 2)


def good_motion(found: Motion) -> None:
    finite(found.poses, found.trans, found.betas, found.times)
    assert len(found.converged) == len(found.poses) and found.trusted.shape == found.residuals.shape


def good_model(model: Any) -> None:
    finite(model.vertices(np.full((len(model.skeleton.parents), 3), 0.1), np.ones(model.n_betas)),
           model.pose_covariance, model.explained, model.pose_examples)


def good_completion(found: Completion) -> None:
    good_mesh(found.completed)
    finite(found.pose, found.betas, found.trans, found.confidence, found.expected_error)
    assert len(found.seen) == len(found.completed.vertices) == len(found.predicted.vertices)


def read_set(path: Path) -> tuple[RegisteredSet, np.ndarray]:
    """The set in which a file is, and the vertices of its meshes."""
    found = RegisteredSet.load(path.parents[1] if path.parent.name == "meshes" else path.parent)
    return found, found.vertices()


def good_set(found: tuple[RegisteredSet, np.ndarray]) -> None:
    good_mesh(found[0].template)
    finite(found[1])


def make_seeds(folder: Path) -> list[Seed]:
    """All of them, written into a folder, each in one of its own."""
    rng, body = np.random.default_rng(0), worm(5, 6)
    body = Mesh(body.vertices, body.faces, rng.random(body.vertices.shape))
    seeds: list[Seed] = []

    def place(name: str) -> Path:
        path = folder / f"{len(seeds):02d}" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def add(path: Path, *more: Any) -> None:
        seeds.append(Seed(path, *more))

    def text(name: str, content: str | bytes, *more: Any) -> None:
        path = place(name)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        add(path, *more)

    _add_meshes(body, place, add, text)
    _add_landmarks(worm(), place, add, text)
    _add_markers(rng, place, add, text)
    _add_models(rng, place, add)
    _add_sets(rng, place, add, text)
    _add_tables(body, place, add, text)
    return seeds


def _add_meshes(body: Mesh, place: Any, add: Any, text: Any) -> None:
    cloud = PointCloud(body.vertices, body.vertex_normals, body.colors)
    for ending in ("ply", "ply.gz", "obj", "stl", "off", "glb"):
        write_mesh(path := place(f"a.{ending}"), body)
        add(path, read_mesh, good_mesh)
    for ending in ("ply", "pcd", "xyz", "pts"):
        write_points(path := place(f"points.{ending}"), cloud)
        add(path, read_points, good_points)
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty double y\nproperty float z\n" \
           "property uchar red\nproperty uchar green\nproperty uchar blue\nelement face 2\n" \
           "property list uchar int vertex_indices\nend_header\n"
    rows = "0 0 0 1 2 3\n1 0 0 4 5 6\n1 1 0.5 7 8 9\n0 1 0 9 9 9\n"
    text("ascii.ply", head + rows + "3 0 1 2\n3 0 2 3\n", read_mesh, good_mesh)
    text("mixed.ply", head.replace("face 2", "face 3") + rows + "3 0 1 2\n4 0 1 2 3\n3 1 2 3\n", read_mesh, good_mesh)
    binary = head.replace("ascii", "binary_big_endian").encode()
    corners = np.array([(0, 0, 0, 1, 2, 3), (1, 0, 0, 4, 5, 6), (1, 1, 1, 7, 8, 9), (0, 1, 0, 9, 9, 9)])
    vertex = b"".join(np.array(tuple(row), dtype=">f4,>f8,>f4,u1,u1,u1").tobytes() for row in corners.tolist())
    lists = b"".join(bytes([n]) + np.arange(n, dtype=">i4").tobytes() for n in (3, 4))
    text("mixed_binary.ply", binary + vertex + lists, read_mesh, good_mesh)
    triangle = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    text("ascii.stl", f"solid a\n{triangle * 2}endsolid a\n", read_mesh, good_mesh)
    text("polygons.obj", "mtllib a.mtl\nv 0 0 0\nv 1 0 0 \nv 1 1 0\nv 0 1 0\nvt 0 0\nf 1/1/1 2/1 3//1 4\nf -1 -2 -3\n",
         read_mesh, good_mesh)
    text("ascii.pcd", "VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH 3\nHEIGHT 1\n"
         "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n0 0 0 4.2e9\n1 0 0 1\nnan 1 0 2\n", read_points, good_points)
    text("excel.txt", "x;y;z\n0;0;1\n1;0;0.5\n0;1;0\n", read_points, good_points)
    uv = np.random.default_rng(0).random((len(body.vertices), 2))
    write_textured(path := place("a.glb"), Texture(body, uv, np.full((4, 4, 3), 0.5)))
    add(path, lambda path: (read_mesh(path), read_texture(path)), lambda found: good_mesh(found[0]))
    write_textured(path := place("own.glb"), Texture(body, uv, np.full((4, 4, 3), 0.5)))
    add(path, lambda path: read_pieces(path, 1, 1.0))
    corners = np.eye(3, dtype="<f4")
    uri = "data:;base64," + b64encode(corners.tobytes() + np.full((3, 4), 0.25, "<f4").tobytes()).decode()
    text("a.gltf", json.dumps({
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [
            {"children": [1, 2], "scale": [1, 2, 1]}, {"mesh": 0, "rotation": [0, 0, 0, 1]}, {"mesh": 0, "skin": 0}],
        "skins": [{"joints": [0, 1], "inverseBindMatrices": 3}], "meshes": [{"primitives": [
            {"attributes": {"POSITION": 0, "COLOR_0": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}, "mode": 5}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3},
                      {"componentType": 5121, "type": "VEC4", "count": 3},
                      {"bufferView": 0, "byteOffset": 36, "componentType": 5126, "type": "VEC4", "count": 3},
                      {"componentType": 5126, "type": "MAT4", "count": 2}],
        "bufferViews": [{"buffer": 0, "byteLength": 84}], "buffers": [{"byteLength": 84, "uri": uri}]}),
         read_mesh, good_mesh)
    text("packed.pcd", b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 3\nDATA binary_compressed\n"
         + struct.pack("<II", 38, 36) + b"\x1f" + corners.tobytes()[:32] + b"\3" + corners.tobytes()[32:],
         read_points, good_points)
    (path := place("worn.obj")).with_name("a.mtl").write_text("newmtl A\nmap_Kd a.png\n")
    Image.new("RGB", (8, 8), (0, 200, 0)).save(path.with_name("a.png"))
    path.write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl A\n"
                    "f 1/1 2/2 3/3\nf 1/1 2/2 4/3\n")
    add(path, lambda path: (read_mesh(path), read_texture(path)), lambda found: good_mesh(found[0]))


def _add_landmarks(body: Mesh, place: Any, add: Any, text: Any) -> None:
    points = {name: body.vertices[v] for name, v in MARKS.items()}
    check = good_places(body)
    write_landmarks(path := place("points.json"), points)
    add(path, lambda path: read_landmark_vertices(path, body), check)
    text("kinds.json", json.dumps({"a": 3, "b": [0.3, 0, 0.9], "c": {"face": 7, "bary": [0.2, 0.3, 0.5]}}),
         lambda path: read_landmark_vertices(path, body) | read_landmarks(path, body), check)
    rows = [(name, *map(float, p)) for name, p in points.items()]
    text("picked.pp", "<!DOCTYPE PickedPoints>\n<PickedPoints>" + "".join(
        f'<point x="{x}" y="{y}" z="{z}" name="{n}" active="1"/>' for n, x, y, z in rows) + "</PickedPoints>",
         lambda path: read_landmark_vertices(path, body), check)
    text("caesar.lnd", "SCAN = 1\n" + "".join(f"{i} 0 0 10 {1e3 * x} {1e3 * y} {1e3 * z} {n}\n"
                                              for i, (n, x, y, z) in enumerate(rows)),
         lambda path: read_landmark_vertices(path, body), check)
    text("words.txt", "".join(f"{x} {y} {z} {n}\n" for n, x, y, z in rows),
         lambda path: read_landmarks(path, body), check)
    columns = "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
    text("slicer.fcsv", "# CoordinateSystem = LPS\n" + columns + "".join(
        f"{i},{1e3 * x},{1e3 * y},{1e3 * z},0,0,0,1,1,1,0,{n},,\n" for i, (n, x, y, z) in enumerate(rows)),
         lambda path: read_landmarks(path, body), check)
    text("table.csv", "name,x,y,z\n" + "".join(f"{n},{x},{y},{z}\n" for n, x, y, z in rows),
         lambda path: read_landmarks(path, body), check)
    text("opensim.xml", "<MarkerSet>" + "".join(
        f'<Marker name="{n}"><body>a</body><location>{x} {y} {z}</location></Marker>' for n, x, y, z in rows)
         + "</MarkerSet>", lambda path: read_landmarks(path, body), check)
    text("slicer.mrk.json", json.dumps({"markups": [{
        "type": "Fiducial", "coordinateSystem": "RAS", "coordinateUnits": "m", "controlPoints": [
            {"label": n, "position": [x, y, z], "positionStatus": "defined"} for n, x, y, z in rows]}]}),
         lambda path: read_landmarks(path, body), check)


def _add_markers(rng: np.random.Generator, place: Any, add: Any, text: Any) -> None:
    positions = rng.normal(0, 1, (6, 4, 3))
    positions[2, 1] = np.nan
    labels = ("LFHD", "RFHD", "CLAV", "T10")
    for ending in ("c3d", "csv"):
        write_markers(path := place(f"walk.{ending}"), MarkerSequence(positions, labels, 100.0))
        add(path, read_markers, good_markers)

    def replaced(path: Path) -> bytes:
        return replace_points(path, path.read_bytes(), np.arange(2), positions[:, :2], np.zeros((6, 2), dtype=int))
    write_markers(path := place("replaced.c3d"), MarkerSequence(positions, labels, 100.0))
    add(path, replaced)
    text("walk.trc", "PathFileType\t4\t(X/Y/Z)\tw.trc\nDataRate\tNumFrames\tNumMarkers\tUnits\n60\t3\t2\tmm\n"
         "Frame#\tTime\tA\t\t\tB\n\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n"
         + "".join(f"{i}\t{i / 60}\t1\t2\t3\t4\t\t6\n" for i in range(3)), read_markers, good_markers)
    text("excel.csv", "time;A_x;A_y;A_z\n0;0,5;1;2\n0,01;0,6;1;\n".encode("utf-16"), read_markers, good_markers)
    body = worm()
    on_body = {"check": lambda layout: finite(layout.place(body), layout.distances)}
    MarkerLayout(tuple(MARKS), np.array(list(MARKS.values())), 0.01, aliases={"snout": "nose"}, loose=("tail",)).save(
        path := place("layout.json"))
    add(path, lambda path: MarkerLayout.load(path, len(body.vertices)), on_body["check"])
    MarkerLayout(tuple(MARKS), body.faces[:4], np.arange(4) / 100, np.full((4, 3), 1 / 3)).save(
        path := place("weights.json"))
    add(path, lambda path: MarkerLayout.load(path, len(body.vertices)), on_body["check"])


def _add_models(rng: np.random.Generator, place: Any, add: Any) -> None:
    for name, make in KINDS.items():
        model = make()
        if model.kind not in known_kinds:                # the toy of the conformance tests
            continue
        model.save(path := place(f"{name}.npz"))
        add(path, load_model, good_model)
    old = Path(__file__).with_name("files") / "scape_version_1.npz"
    (path := place("old.npz")).write_bytes(old.read_bytes())
    add(path, load_model, good_model)
    motion = Motion(random_poses(model, 5, rng), rng.normal(0, 1, (5, 3)), np.ones(2), 60.0, rng.random((5, 2)),
                    ("a", "b"))
    motion.save(path := place("motion.npz"))
    add(path, Motion.load, good_motion)
    motion.save(path := place("theirs.npz"))
    add(path, lambda path: read_motion(path, model), lambda found: finite(found.poses, found.trans, found.betas))
    write_bvh(path := place("motion.bvh"), model.skeleton, motion.poses, motion.trans, unit="m", body=model.template)
    add(path, lambda path: read_bvh(path, "m"), lambda found: finite(found.rotations, found.places, found.rest))
    SoftTissue(motion, rng.normal(0, 1, (5, 3))).save(path := place("soft.npz"))
    add(path, SoftTissue.load, lambda found: finite(found.changes, found.betas()))
    motion.save(path := place("betas.npz"))
    add(path, _read_betas, finite)


def _add_sets(rng: np.random.Generator, place: Any, add: Any, text: Any) -> None:
    body = worm(9, 6)
    tree = worm_skeleton(body)

    def filled(path: Path) -> RegisteredSet:
        return RegisteredSet.create(path, body, {"settings": {"a": 1}}).with_skeleton(tree).add("x", body, "ann")
    for name in ("set.json", "set.csv", "skeleton.json", "template.ply", "meshes/x.ply"):
        filled(place("set"))
        add(place("set") / name, read_set, good_set)
    tree.save(path := place("skeleton.json"))
    add(path, Skeleton.load)
    done = Completion(body, body, np.zeros((4, 3)), np.zeros(2), np.zeros(3), np.ones(len(body.vertices), bool),
                      0.001, 0.9, float("nan"), True, 5, {"data": 1.0}, 1.0, np.ones(len(body.vertices)),
                      np.ones(len(body.vertices)))
    for name in ("completion.npz", "predicted.ply"):
        done.save(place("done"))
        add(place("done") / name, lambda path: load_completion(path.parent), good_completion)
    source = filled(place("source"))
    write_decimated_set(source, place("small"), 60)
    add(place("small") / "decimation.npz", lambda path: _load_map(
        path, source, {k: storage.kind_of_stored(path) and v for k, v in _settings(path).items()}),
        lambda found: good_mesh(found.template))
    write_correspondences(path := place("pairs.json"), Correspondences(
        np.arange(4), rng.random((4, 3)), np.ones(4), "manual", {"all": float("nan")}, True))
    add(path, read_correspondences, lambda found: finite(found.scan_points, found.confidence))
    text("edits.json", json.dumps([{"merge": ["a", "b"]}, {"rename": {"a": "c"}}]), read_edits)
    GroundTruth(BodyShape(), np.zeros((4, 3)), np.zeros(3), body.vertices, body.faces, tree.part_of_face,
                tree.joints).save(path := place("truth.npz"))
    add(path, GroundTruth.load, lambda found: good_mesh(found.mesh))


def _settings(path: Path) -> dict[str, Any]:
    """What stands in the header, whatever it is: the settings are not what is tried here."""
    header = storage.load(path, "decimation", (1,))[0]
    return {key: value for key, value in header.items() if key not in ("kind", "version")}


def _add_tables(body: Mesh, place: Any, add: Any, text: Any) -> None:
    def scans(path: Path) -> list[Any]:
        return find_scans(path.parent)
    for content in ("name,subject,pose,sex\nbody0,anna,a,f\nbody1,ben,b,m\n".encode("utf-8-sig"),
                    "name;subject;pose\r\nbody0;Zoë;\r\n".encode("cp1252"),
                    "name\tsubject\r\nbody1\tZoë\r\n".encode("utf-16")):
        for k in range(2):
            write_mesh(place(f"body{k}.ply"), body)
        text("scans.csv", content, scans)
    write_mesh(place("people/body0.ply"), body)
    text("people/sexes.csv", "name,sex\nbody0,female\nbody1,male\n", lambda path: _read_sexes(path.parent))
    text("subjects.csv", "file;subject\r\nwalk.c3d;Zoë\r\nrun.c3d;Zoë\r\n".encode("cp1252"), _table_rows)
    text("subjects.json", '{"walk.c3d": "ann", "run.c3d": 5}', _table_rows)
    text("betas.json", '{"betas": [0.5, -1, 2e-1]}', _read_betas, finite)
    text("keys.json", '{"0": [0, 1], "2.5": [1, 1]}', lambda path: read_betas_to(path, 3))
    text("pose.json", '{"part1": [0, 0.5, 0], "part2": [1, 0, 0]}', _read_turns,
         lambda found: finite(*found.values()))
    write_mesh(place("views/a.ply"), body)
    text("views/cameras.json", '{"a": [0, 1, 2.5]}', lambda path: _read_views(path.parent, None),
         lambda found: finite(*(camera for _, camera in found)))
    marked = np.arange(len(body.vertices)) % 3 == 0
    text("mask.json", "[0, 3, 9]", lambda path: read_mask(path, body.vertices))
    write_points(path := place("painted.ply"), PointCloud(body.vertices, None, np.where(marked[:, None], [1, 0, 0], 1)))
    add(path, lambda path: read_mask(path, body.vertices))
