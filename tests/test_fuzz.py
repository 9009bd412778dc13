"""Damaged and hostile files are read or refused by a line that names them, quickly and in little memory.

`fuzz.py` makes them by the thousand; here it runs for half a minute at most (SCAPEKIT_FUZZ: how many files).
"""
import gzip
import io
import json
import os
import pickle
import struct
import subprocess
import sys
import time
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from conformance_bodies import KINDS
from model_bodies import worm

from completion import MarkerLayout, read_markers
from completion.motion import Motion
from model.files import load_model
from scanprep import Mesh, read_landmarks, read_mesh, write_mesh
from scanprep.geometry import storage
from scanprep.geometry.files import read_points
from scanprep.geometry.format_glb import tallest, turn_up
from scanprep.geometry.landmarks import read_landmark_vertices
from scanprep.skeleton.tree import Skeleton


@pytest.mark.slow
@pytest.mark.parametrize("seed", [31000304, 31005250, 41007051])
def test_damage_that_was_once_read_or_refused_wrongly(seed):
    """Views without triangles, a table of empty cells, and whole numbers that cannot become floating-point ones."""
    ran = subprocess.run([sys.executable, Path(__file__).with_name("fuzz.py"), "--count", "1", "--seed", str(seed)],
                         capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout[-5000:]


@pytest.mark.slow
def test_damaged_files_of_every_kind():
    count = os.environ.get("SCAPEKIT_FUZZ", "1500")
    ran = subprocess.run([sys.executable, Path(__file__).with_name("fuzz.py"), "--count", count], capture_output=True,
                         text=True, check=False)
    told = json.loads(ran.stdout.splitlines()[-1]) if ran.stdout else {}
    assert ran.returncode == 0, ran.stdout[-5000:] + ran.stderr[-5000:]
    assert told["failed"] == 0 and told["kinds"] >= 70
    assert told["read"] > int(count) // 20 and told["refused"] > int(count) // 2        # it does damage, and not all


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_bombs_of_every_kind():
    ran = subprocess.run([sys.executable, Path(__file__).with_name("fuzz_bombs.py")], capture_output=True, text=True,
                         check=False)
    told = json.loads(ran.stdout.splitlines()[-1]) if ran.stdout else {}
    assert ran.returncode == 0, ran.stdout[-5000:] + ran.stderr[-5000:]
    assert told["failed"] == 0 and told["refused"] > 100


def glb(tree, binary):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def scene(nodes, count=3, binary=None, **view):
    return glb({"scenes": [{"nodes": [0]}], "nodes": nodes, "accessors": [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": count}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "bufferViews": [{"buffer": 0, **view}]},
        np.eye(3, dtype="<f4").tobytes() if binary is None else binary)


def npy(shape, kind="<f8", content=b""):
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}".encode().ljust(118) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + content


def npz(**members):
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name + ".npy", content)
    return out.getvalue()


def c3d_with_parameters_over_each_other():
    """Parameters of 28,560 bytes each that begin nine bytes after one another."""
    one = b"\1\1A" + struct.pack("<h", 6) + b"\1\2\xff\x70"
    return bytes([2, 0x50]) + bytes(510) + b"\1\x50\1\x54" + 5000 * one + bytes(31_000)


HOSTILE = {                          # what a file holds, or what makes it where that takes long
    "a.glb": (scene([{"children": [i + 1, i + 1]} for i in range(30)] + [{"mesh": 0}]), "two nodes"),
    "loop.glb": (scene([{"children": [1]}, {"children": [0]}]), "two nodes"),
    "stride.glb": (scene([{"mesh": 0}], 2**28, byteStride=0), "one every 0"),
    "before.glb": (scene([{"mesh": 0}], byteOffset=-4), "from byte -4"),
    "often.glb": (glb({"scenes": [{"nodes": list(range(3000))}], "nodes": [{"mesh": 0}] * 3000, "accessors": [
        {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3000}], "bufferViews": [{"buffer": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}, bytes(36_000)), "more than .* MB"),
    "a.ply.gz": (lambda: gzip.compress(bytes(10**8)), "unpack to more"),
    "far.ply": (b"ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
                b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
                b"0 0 1e300\n1 0 0\n0 1 0\n3 0 1 2\n", r"1e\+300"),
    "many.ply": (b"ply\nformat binary_little_endian 1.0\nelement vertex 999999999999999\nproperty double x\n"
                 b"end_header\n", "truncated"),
    "nan.ply": (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list float int x\nend_header\n"
                + struct.pack("<f", np.nan), "header"),
    "many.off": (b"OFF\n99999999999999999999 1 0\n0 0 0\n", "numbers of vertices"),
    "two.obj": (b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "line 1"),
    "digits.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 " + b"9" * 30, "line 4"),
    "minus.pcd": (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS -1\nDATA binary\n" + bytes(48), "POINTS"),
    "wide.pcd": (b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 2 2 2\nPOINTS 2\nDATA binary\n" + bytes(48), "POINTS"),
    "over.c3d": (c3d_with_parameters_over_each_other(), "over each other"),
    "twice.csv": (("time" + ",A:a_x,A:a_y,A:a_z,B:a_x,B:a_y,B:a_z" * 10_000 + "\n" + "0," * 60_000 + "0\n").encode(),
                  "expected one subject"),
    "bomb.npz": (lambda: npz(a=npy("(30000000,)", content=bytes(240_000_000))), "would unpack"),
    "shape.npz": (npz(header=npy("(10000000000, 0)")), "header"),
    "deep.npz": (npz(header=npy("(" * 3000)), "damaged"),
}
READERS = {".glb": read_mesh, ".gz": read_mesh, ".ply": read_mesh, ".off": read_mesh, ".obj": read_points,
           ".pcd": read_points, ".c3d": read_markers, ".csv": read_markers, ".npz": load_model}


@pytest.mark.parametrize("name", HOSTILE)
def test_small_files_do_not_ask_for_much(tmp_path, name):
    content, words = HOSTILE[name]
    content = content() if callable(content) else content
    (tmp_path / name).write_bytes(content)
    start = time.process_time()
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=words) as caught:
            READERS[Path(name).suffix](tmp_path / name)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert name in str(caught.value) and "\n" not in str(caught.value)
    assert peak < 3e8 + 30 * len(content) and time.process_time() - start < 10        # it is slower while it is traced


def test_numpys_advice_to_allow_pickles_reaches_nobody(tmp_path):
    np.savez(tmp_path / "objects.npz", poses=np.array([{}], dtype=object))
    (tmp_path / "pickle.npz").write_bytes(pickle.dumps({"poses": 1}))
    (tmp_path / "long.npz").write_bytes(npz(poses=npy(" " * 20_000 + "(1,)")))
    for name in ("objects.npz", "pickle.npz", "long.npz"):
        for read in (Motion.load, load_model, storage.load_arrays, storage.kind_of_stored):
            if (name, read) == ("objects.npz", storage.kind_of_stored) or (name, read) == ("long.npz",
                                                                                           storage.kind_of_stored):
                continue
            with pytest.raises(storage.StorageError, match=name) as caught:
                read(tmp_path / name)
            assert "pickle" not in str(caught.value).replace("pickle.npz", "")


DAMAGE = {
    "part_of_face": lambda a: a[:-1], "faces": lambda a: a + 10_000, "vertices": lambda a: np.where(a > 1, np.nan, a),
    "joints": lambda a: a * np.inf, "parents": lambda a: a[::-1], "feature_mix": lambda a: a[..., :-1],
    "pose_mean": lambda a: a[:-1], "pose_covariance": lambda a: a[0], "pose_examples": lambda a: np.zeros((2, 9, 3)),
    "shape_mean": lambda a: a[1:], "shape_components": lambda a: np.full_like(a, np.nan),
    "shape_variances": lambda a: -a, "pose_coefficients": lambda a: a[:-1], "blend": lambda a: a * 2,
    "weights": lambda a: a.astype("U8"), "correctives": lambda a: a[:, :3], "lift_radius": lambda a: 0 * a,
}


@pytest.mark.parametrize("kind", ["scape-quaternion", "blendscape", "skinning-linear"])
def test_damaged_models_are_refused_when_they_are_loaded(tmp_path, kind):
    path = tmp_path / "model.npz"
    KINDS[kind]().save(path)
    whole = storage.load_arrays(path)
    tried = 0
    for name in set(DAMAGE) & set(whole):
        with np.errstate(invalid="ignore"):
            np.savez(path, **{**whole, name: DAMAGE[name](whole[name])})
        with pytest.raises(storage.StorageError, match=r"model\.npz: expected a whole model"):
            load_model(path)
        tried += 1
    assert tried >= 12
    np.savez(path, **whole)
    assert load_model(path).kind == kind.split("-")[0]


def test_a_node_per_mesh_is_as_before(tmp_path):
    body = worm()
    write_mesh(tmp_path / "a.glb", body)
    data = (tmp_path / "a.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20:20 + size])
    tree["nodes"] = [{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]
    (tmp_path / "b.glb").write_bytes(glb(tree, data[28 + size:]))
    again = read_mesh(tmp_path / "b.glb")
    n = len(body.vertices)
    np.testing.assert_allclose(again.vertices[:n], body.vertices, atol=1e-6)
    moved = np.array([5, 0, 0]) @ turn_up(tallest(body.vertices))                 # by the axes of the scene
    np.testing.assert_allclose(again.vertices[n:], body.vertices + moved, atol=1e-6)


@pytest.mark.parametrize("points", [
    {"nose": [1e300, 0, 0]}, {"nose": [0.3, -0.2, 900]},
    {f"m{v}": (700 * worm().vertices[v]).tolist() for v in (3, 100, 200)}])             # in no unit that there is
def test_landmarks_that_are_not_on_the_mesh(tmp_path, points):
    (tmp_path / "marks.json").write_text(json.dumps(points))
    with pytest.raises(ValueError, match=r"marks\.json: .*(same unit|1e\+300)"):
        read_landmark_vertices(tmp_path / "marks.json", worm())


def test_landmarks_near_the_mesh_are_what_they_were(tmp_path):
    body = worm()
    marks = {"a": (body.vertices[3] + [0, 0, 0.01]).tolist(), "b": 7, "c": body.vertices[200].tolist(),
             "d": (body.vertices[300] + 0.005).tolist()}
    (tmp_path / "marks.json").write_text(json.dumps(marks))
    assert read_landmark_vertices(tmp_path / "marks.json", body) == {"a": 3, "b": 7, "c": 200, "d": 300}


@pytest.mark.parametrize("content", [b"[" * 10**5, b'{"a": 1' + b"0" * 5000 + b"}", '{"a": "Zoë"}'.encode("latin-1"),
                                     b"\xff\xfe\x00", b"", b"{", b'{"markersets": 1e999}', b'{"markersets": NaN}'])
@pytest.mark.parametrize("read", [Skeleton.load, MarkerLayout.load, lambda p: read_landmarks(p, worm())])
def test_json_that_is_none(tmp_path, content, read):
    (tmp_path / "x.json").write_bytes(content)
    with pytest.raises(storage.StorageError, match=r"x\.json: ") as caught:
        read(tmp_path / "x.json")
    assert len(str(caught.value)) < 600


def test_polygons_of_several_sizes_in_binary(tmp_path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]])
    for order, sign in (("little", "<"), ("big", ">")):
        head = (f"ply\nformat binary_{order}_endian 1.0\nelement vertex 5\nproperty float x\nproperty double y\n"
                "property float z\nelement face 2\nproperty uchar flag\nproperty list uint8 uint16 vertex_indices\n"
                "end_header\n").encode()
        rows = b"".join(np.array(tuple(v), dtype=f"{sign}f4,{sign}f8,{sign}f4").tobytes() for v in vertices.tolist())
        faces = b"".join(bytes([9, len(f)]) + np.array(f, dtype=sign + "u2").tobytes()
                         for f in ([0, 1, 2, 3], [3, 2, 4]))
        (tmp_path / "a.ply").write_bytes(head + rows + faces)
        mesh = read_mesh(tmp_path / "a.ply")
        assert isinstance(mesh, Mesh) and mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 4]]
        np.testing.assert_array_equal(mesh.vertices, vertices)
