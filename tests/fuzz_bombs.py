"""A hundred small files that unpack to much, show their parts without end, or say that they hold more than they do.

    python tests/fuzz_bombs.py            or        python tests/fuzz_bombs.py --only glb

Each is read or refused by a ValueError or OSError that names it, in at most 10 s and 1 GB; what fails is printed, and
the exit code is 1. The last line is JSON: read, refused, failed, longest, largest.
"""
from __future__ import annotations

import argparse
import gzip
import io
import json
import struct
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from fuzz import guard, measure
from fuzz_seeds import Seed

from completion import MarkerLayout, read_markers
from completion.motion import Motion
from completion.partial.masks import read_mask
from model.files import load_model
from model.motion.bvh import read_bvh
from model.statue.control.files import read_control
from model.statue.own_mesh import read_pieces
from scanprep import read_landmarks
from scanprep.geometry import storage
from scanprep.geometry.files import read_mesh, read_points, read_scan_mesh
from scanprep.pictures.textures import read_texture
from scanprep.skeleton.tree import Skeleton

SECONDS, MEGABYTES = 10.0, 1000.0
Bomb = tuple[str, Callable[[Path], Any], bytes | dict[str, bytes]]
CORNERS = np.eye(3, dtype="<f4").tobytes()


# ---- GLB

def glb(tree: dict[str, Any], binary: bytes = CORNERS) -> bytes:
    text = json.dumps({"asset": {"version": "2.0"}, "buffers": [{"byteLength": len(binary)}], **tree}).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


def scene(nodes: list[Any], count: int = 3, binary: bytes = CORNERS, roots: list[int] | None = None, **more: Any
          ) -> bytes:
    """One mesh of `count` vertices, and nodes that show it; `more` replaces parts of the document."""
    return glb({"scenes": [{"nodes": [0] if roots is None else roots}], "nodes": nodes, "bufferViews": [{"buffer": 0}],
                "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": count}],
                "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], **more}, binary)


def zeros(count: int, kind: str = "VEC3") -> dict[str, Any]:
    """An accessor that says nothing but its size."""
    return {"componentType": 5126, "type": kind, "count": count}


def glb_bombs() -> Iterator[bytes]:
    view = {"bufferView": 0, "componentType": 5126, "type": "VEC3"}
    yield scene([{"children": [i + 1] * 10} for i in range(12)] + [{"mesh": 0}])         # the twelve nodes of 3MF
    yield scene([{"children": [0]}])
    yield scene([{"children": [i + 1]} for i in range(50_000)] + [{"mesh": 0}])          # a chain
    yield scene([{"mesh": 0}] * 30_000, roots=list(range(30_000)))
    yield scene([{"mesh": 0}], roots=[0] * 100_000)
    yield scene([{"mesh": 0}] * 3000, 30_000, bytes(360_000), list(range(3000)))
    for count in (10**6, 10**8, 10**10, 10**30, -1, 2.5, True):
        yield scene([{"mesh": 0}], accessors=[zeros(count)])
        yield scene([{"mesh": 0}], accessors=[{**view, "count": count}])
    # every primitive has its own copy of the same zeros; lines, which are not shown
    shown = {"attributes": {"POSITION": 0}}
    yield scene([{"mesh": 0}], accessors=[zeros(10**5)], meshes=[{"primitives": [shown] * 5000}])
    yield scene([{"mesh": 0}], meshes=[{"primitives": [{**shown, "mode": 1}] * 400_000}])
    yield scene([{"mesh": 0}], accessors=[zeros(10**6)] * 1000, meshes=[{"primitives": [
        {"attributes": {"POSITION": i}} for i in range(1000)]}])
    # skins: weights of many joints, and one skin for many nodes
    skinned = {"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 1}}
    for joints, nodes, n in ((60_000, 1, 20_000), (2000, 3000, 3)):
        yield scene([{"mesh": 0, "skin": 0}] * nodes + [{}] * joints, n, bytes(16 * n), list(range(nodes + joints)),
                    skins=[{"joints": list(range(nodes, nodes + joints)), "inverseBindMatrices": 2}], accessors=[
            {**view, "count": n}, {**view, "type": "VEC4", "count": n}, zeros(joints, "MAT4")],
            meshes=[{"primitives": [skinned]}])
    # strips, fans and sparse arrays
    for mode in (5, 6):
        yield scene([{"mesh": 0}] * 500, 20_000, bytes(240_000), list(range(500)), meshes=[{"primitives": [
            {"attributes": {"POSITION": 0}, "mode": mode}]}])
    yield scene([{"mesh": 0}], accessors=[{**zeros(10**5), "sparse": {
        "count": 10**9, "indices": {"bufferView": 0, "componentType": 5123}, "values": {"bufferView": 0}}}])
    # buffers: the same file beside, a thousand times, and inside of a GLB
    yield glb({"buffers": [{}] * 100_000, "bufferViews": [], "nodes": []}, bytes(10**5))
    yield scene([{"mesh": 0}], bufferViews=[{"buffer": 0, "byteOffset": 10**20}])
    yield scene([{"mesh": 0}], extras=json.loads("[" * 400 + "]" * 400))


def beside() -> Iterator[bytes | dict[str, bytes]]:
    tree = {"asset": {"version": "2.0"}, "nodes": [], "buffers": [{"uri": "a.bin", "byteLength": 10**6}] * 2000}
    yield {"": json.dumps(tree).encode(), "a.bin": bytes(10**6)}
    packed = {**tree, "buffers": [{"uri": "a.bin.gz", "byteLength": 10**8}] * 20}
    yield {"": json.dumps(packed).encode(), "a.bin.gz": gzip.compress(bytes(3 * 10**7))}


# ---- pictures

def png(width: int, height: int) -> bytes:
    """A grey picture of one value, a few bytes a row."""
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    rows = zlib.compressobj(9)
    packed = b"".join(rows.compress(bytes(width + 1)) for _ in range(height)) + rows.flush()
    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
            + chunk(b"IDAT", packed) + chunk(b"IEND", b""))


def pictured_glb(picture: bytes) -> bytes:
    """A triangle with a picture inside."""
    tree = {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "materials": [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}], "textures": [{"source": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24},
                        {"buffer": 0, "byteOffset": 60, "byteLength": len(picture)}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3},
                      {"bufferView": 1, "componentType": 5126, "type": "VEC2", "count": 3}],
        "images": [{"bufferView": 2, "mimeType": "image/png"}]}
    return glb(tree, CORNERS + bytes(24) + picture)


def pictured() -> Iterator[tuple[str, bytes | dict[str, bytes]]]:
    """Pictures in the file, beside it, and as a URI."""
    text = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
    for width, height in ((8000, 8000), (9000, 9000), (20_000, 20_000)):
        picture = png(width, height)
        yield "a.obj", {"": (text + "usemtl A\nf 1/1 2/2 3/3\n").encode(), "a.mtl": b"newmtl A\nmap_Kd a.png\n",
                        "a.png": picture}
        yield "a.glb", pictured_glb(picture)
    # materials by the thousand
    yield "a.obj", {"": (text + "usemtl A\nf 1/1 2/2 3/3\nusemtl B\nf 1/1 2/2 3/3\n" * 20_000).encode(),
                    "a.mtl": b"newmtl A\nmap_Kd a.png\n", "a.png": png(8, 8)}
    yield "a.obj", {"": (text + "v 0 0 1\nvt 1 1\n" * 20_000
                         + "".join(f"usemtl {i}\nf 1/1 2/2 3/3\n" for i in range(5000))).encode(),
                    "a.mtl": b"".join(b"newmtl %d\nmap_Kd a.png\n" % i for i in range(5000)), "a.png": png(1000, 1000)}


# ---- meshes and points

HEAD = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face {}\nproperty list {} int vertex_indices\nend_header\n"


def ply_bombs() -> Iterator[bytes]:
    little = "binary_little_endian"
    for count in (10**9, 10**18, 10**30):
        yield (HEAD.format("ascii", count) + "end_header\n0 0 0\n").encode()
        yield (HEAD.format(little, count) + "end_header\n").encode() + bytes(100)
        yield (HEAD.format(little, 3) + FACES.format(count, "uchar")).encode() + bytes(100)
        yield f"ply\nformat {little} 1.0\nelement vertex {count}\nend_header\n".encode()
    yield (HEAD.format(little, 3) + FACES.format(2, "int")).encode() + bytes(36) + b"\xff\xff\xff\x7f" + bytes(100)
    yield (HEAD.format(little, 3) + FACES.format(10**5, "uchar")).encode() + bytes(36) + bytes(10**5)
    yield (HEAD.format("ascii", 3) + FACES.format(1, "uchar")).encode() + b"0 0 0\n1 0 0\n0 1 0\n3" + b" 1" * 10**6
    yield ("ply\nformat ascii 1.0\n" + "element a 0\n" * 100_000 + "end_header\n").encode()
    yield ("ply\nformat ascii 1.0\nelement vertex 1\n" + "property float x\n" * 100_000 + "end_header\n0\n").encode()


def polygon_bombs() -> Iterator[bytes]:
    """Polygons of many corners over the same vertices, whose diagonals all meet."""
    for n, polygons in ((20_000, 2), (3000, 60)):
        turn = np.arange(n) * 2 * np.pi / n
        rows = "".join(f"{x:.6f} {y:.6f} 0\n" for x, y in zip(np.cos(turn), np.sin(turn), strict=True))
        rng = np.random.default_rng(n)
        faces = "".join(f"{n - 1} " + " ".join(map(str, rng.permutation(n)[1:])) + "\n" for _ in range(polygons))
        yield f"OFF\n{n} {polygons} 0\n{rows}{faces}".encode()
    n = 36_000                                          # all triangles at one edge
    yield (f"OFF\n{n} {n - 2} 0\n" + "".join(f"{i % 7} {i % 11} {i}\n" for i in range(n))
           + "".join(f"3 0 1 {i}\n" for i in range(2, n))).encode()
    yield (f"OFF\n3 {n} 0\n0 0 0\n1 0 0\n0 1 0\n" + "3 0 1 2\n" * n).encode()
    yield b"OFF\n3 999999999 0\n0 0 0\n1 0 0\n0 1 0\n"
    yield b"OFF\n999999999 1 0\n0 0 0\n"
    yield b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n999999999 0 1 2\n"
    yield b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 999999999999999999999\n"


def text_bombs() -> Iterator[tuple[str, bytes]]:
    square = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"
    for corner in (b"99999999999", b"-99999999999", b"1" * 10**6, b"1e9", b"2147483648"):
        yield "a.obj", square + b"f 1 2 " + corner + b"\n"
    yield "a.obj", square + b"f" + b" 1 2 3" * 300_000 + b"\n"
    yield "a.obj", square + b"f 1/" + b"/" * 10**6 + b" 2 3\n"
    yield "a.obj", square + b"o a\nf 1 2 3\n" * 100_000
    yield "a.obj", square + b"\\\n" * 10**6 + b"f 1 2 3\n"
    yield "a.xyz", b"1 " * 3 * 10**6
    yield "a.xyz", b"\n" * 10**7
    yield "a.csv", b"x,y,z\n" + b"1,2,3," * 10**6
    yield "a.csv", b"x,y,z\n" + b"1,5;2,5;3,5\n" * 200_000
    yield "a.asc", (b"9" * 400 + b" 0 0\n") * 1000
    yield "a.stl", b"x".ljust(80) + b"\xff\xff\xff\xff" + bytes(500)
    yield "a.stl", b"solid a\n" + b"facet\n" * 10**6 + b"endsolid"
    yield "a.stl", b"solid a\n" + b"vertex 0 0 0\n" * 300_000 + b"facet\n" * 100_000 + b"endsolid"
    for rest in (b"SIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 999999999\nPOINTS 1\nDATA ascii\n0 0 0\n",
                 b"SIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 99999999999999\nDATA binary\n" + bytes(99),
                 b"SIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 178956970\nDATA binary_compressed\n"
                 + struct.pack("<II", 3 * 10**5, 4294967280) + b"\xe0\xff\x00" * 10**5,
                 b"SIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 4000000\nDATA binary_compressed\n"
                 + struct.pack("<II", 545_460, 48_000_000) + b"\0\0" + b"\xe0\xff\x00" * 181_819):
        yield "a.pcd", b"FIELDS x y z\n" + rest


def packed_bombs() -> Iterator[tuple[str, bytes]]:
    """Files of their kind, so that they are not refused at the first byte, with much that packs well."""
    n = 3 * 10**6
    head = HEAD.format("binary_little_endian", n).encode()
    yield "a.ply.gz", head + b"end_header\n" + bytes(12 * n)
    yield "a.ply.gz", head + FACES.format(n, "uchar").encode() + bytes(13 * n)
    yield "b.ply.gz", (HEAD.format("binary_little_endian", 3) + FACES.format(2 * n, "uchar")).encode() + np.eye(
        3, dtype="<f4").tobytes() + (b"\3" + np.arange(3, dtype="<i4").tobytes()) * (2 * n)
    yield "a.xyz.gz", b"0 0 0\n" * 20_000_000
    yield "b.xyz.gz", b"0 0 0\n" * 5_000_000
    yield "a.obj.gz", b"v 0 0 0\n" * n + b"f 1 2 3\n"
    yield "a.off.gz", b"OFF\n3 4000000 0\n0 0 0\n1 0 0\n0 1 0\n" + b"3 0 1 2\n" * 4_000_000
    yield "a.stl.gz", bytes(80) + struct.pack("<I", 700_000) + bytes(50 * 700_000)
    yield "a.glb.gz", scene([{"mesh": 0}], 2_000_000, bytes(24_000_000))


# ---- arrays, JSON, tables, recordings

def npy(shape: str, kind: str = "<f8", content: bytes = b"") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}}}".encode().ljust(118) + b"\n"
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(text)) + text + content


def npz(**members: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name + ".npy", content)
    return out.getvalue()


def array_bombs() -> Iterator[bytes]:
    yield npz(a=npy("(30000000,)", content=bytes(240_000_000)))
    yield npz(**{f"a{i}": npy("(2000000,)", content=bytes(16_000_000)) for i in range(20)})
    yield npz(**{f"a{i}": npy("()", content=bytes(8)) for i in range(50_000)})
    for shape in ("(10**12,)", "(1000000000000,)", "(0, 10000000000000)", "(-1,)", "(" * 20_000, "1" * 50_000):
        yield npz(header=npy(shape), poses=npy(shape))
    yield npz(poses=npy("(1,)", "<U99999999"))
    inner = npz(a=npy("(100,)", content=bytes(800)))
    yield inner.replace(struct.pack("<I", 928), struct.pack("<I", 2**31 - 1))      # the sizes of its directory


def json_bombs() -> Iterator[bytes]:
    yield b"[" * 10**6
    yield b'{"a":' * 10**5 + b"1" + b"}" * 10**5
    yield b'{"a": ' + b"9" * 10**6 + b"}"
    yield b'{"a": [' + b"0," * 3_000_000 + b"0]}"
    yield b'{"a": 1' + b"0" * 4000 + b".5e999999999}"
    yield b'{' + b",".join(b'"m%d": [1, 2, 3]' % i for i in range(100_000)) + b"}"


def table_bombs() -> Iterator[tuple[str, bytes]]:
    yield "a.csv", ("time" + ",A:a_x,A:a_y,A:a_z" * 20_000 + "\n" + "0," * 60_000 + "0\n").encode()
    yield "a.csv", b"time,a_x,a_y,a_z\n" + b"0," * 5_000_000
    yield "a.csv", b'time,a_x,a_y,a_z\n"' + b"0," * 5_000_000
    yield "a.trc", (b"PathFileType\t4\t(X/Y/Z)\tw.trc\nDataRate\tNumFrames\tNumMarkers\tUnits\n"
                    b"60\t999999999\t999999999\tmm\nFrame#\tTime\tA\n\t\tX1\n1\t0\t1\t2\t3\n")
    yield "a.bvh", (b"HIERARCHY\n" + b"ROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n"
                    + b"JOINT b\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n" * 20_000)
    yield "b.bvh", (b"HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\nCHANNELS 3 Xrotation Yrotation Zrotation\nEnd Site\n{\n"
                    b"OFFSET 0 1 0\n}\n}\nMOTION\nFrames: 999999999999\nFrame Time: 0.01\n0 0 0\n")


def xml_bombs() -> Iterator[bytes]:
    """Entities of entities, one long entity, and elements without end, as landmarks of MeshLab and OpenSim."""
    nine = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
    point = b'<point x="0" y="0" z="0" name="%s"/>'
    yield from (b"<!DOCTYPE a [<!ENTITY a0 'ha'>" + nine.encode() + b"]><a>" + point % b"&a9;" + b"</a>",
                 b"<!DOCTYPE a [<!ENTITY b '" + b"ha" * 50_000 + b"'>]><a>" + point % (b"&b;" * 20_000) + b"</a>",
                 b"<!DOCTYPE a [<!ENTITY b SYSTEM 'file:///etc/passwd'>]><a>" + point % b"&b;" + b"</a>",
                 b"<a>" * 200_000, b"<a>" * 100_000 + b"</a>" * 100_000, b"<a>" + point % b"x" * 50_000 + b"</a>")


def c3d_bombs() -> Iterator[bytes]:
    """Headers that say more points, frames and analogue samples than the file has; parameters over each other."""
    for points, analogue, first, last, scale in ((65535, 65535, 1, 65535, -1.0), (65535, 0, 1, 65535, 0.1),
                                                 (1, 65535, 0, 65535, 1e30), (0, 0, 65535, 1, np.nan)):
        header = struct.pack("<BB6HfH2f", 2, 0x50, points, analogue, first, last, 10, 3, scale, 1, 100.0, 0)[:512]
        yield header.ljust(512, b"\0") + b"\1\x50\1\x54" + bytes(508) + bytes(2000)
    one = b"\1\1A" + struct.pack("<h", 6) + b"\1\2\xff\x70"
    yield bytes([2, 0x50]) + bytes(510) + b"\1\x50\1\x54" + 5000 * one + bytes(31_000)
    yield bytes([2, 0x50]) + bytes(510) + b"\1\x50\xff\x54" + (b"\1\1A" + struct.pack("<h", 1)) * 10_000


def make_bombs() -> Iterator[Bomb]:
    """Name, reader and contents of every bomb, with those beside it by their names."""
    def scan(path: Path) -> Any:
        return read_scan_mesh(path, "m")

    def own(path: Path) -> Any:
        return read_pieces(path, 1, 1.0)

    for data in glb_bombs():
        yield "a.glb", read_mesh, data
        yield "own.glb", own, data
    # joints below nodes that no scene shows, and which hang below each other
    skinned = {"attributes": {"POSITION": 0, "JOINTS_0": 1, "WEIGHTS_0": 2}}
    yield "control.glb", read_control, scene(
        [{"mesh": 0, "skin": 0}, {}, {"children": [3, 1]}, {"children": [2]}], roots=[0, 1], skins=[{"joints": [1]}],
        meshes=[{"primitives": [skinned]}], binary=CORNERS + np.ones(12, "<f4").tobytes(), accessors=[
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3},
            {"componentType": 5121, "type": "VEC4", "count": 3},
            {"bufferView": 0, "byteOffset": 36, "componentType": 5126, "type": "VEC4", "count": 3}])
    for files in beside():
        yield "a.gltf", read_mesh, files
    for name, files in pictured():
        yield name, read_texture, files
    for data in ply_bombs():
        yield "a.ply", read_points, data
    for data in polygon_bombs():
        yield "a.off", scan, data
    for name, data in text_bombs():
        yield name, read_points, data
    for name, data in packed_bombs():
        yield name, read_points if "xyz" in name else scan, gzip.compress(data, 9)
    for data in array_bombs():
        for read in (load_model, Motion.load, storage.load_arrays):
            yield "a.npz", read, data
    yield "a.npy", lambda path: read_mask(path, np.zeros((5, 3))), npy("(99999999999999,)")
    for data in json_bombs():
        for read in (Skeleton.load, MarkerLayout.load, lambda path: read_landmarks(path, np.zeros((3, 3)))):
            yield "a.json", read, data
    for data in xml_bombs():
        for name in ("a.pp", "a.xml"):
            yield name, lambda path: read_landmarks(path, np.zeros((3, 3))), data
    for name, data in table_bombs():
        yield name, (lambda path: read_bvh(path, "m")) if "bvh" in name else read_markers, data
    for data in c3d_bombs():
        yield "a.c3d", read_markers, data


def run(only: str) -> dict[str, Any]:
    """Read every bomb; the figures, and what failed."""
    told: dict[str, Any] = {"read": 0, "refused": 0, "failed": 0, "longest_s": 0.0, "largest_MB": 0.0}
    guard()
    for number, (name, read, content) in enumerate(make_bombs()):
        if only not in f"{number} {name}":
            continue
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / name
            for other, data in (content if isinstance(content, dict) else {"": content}).items():
                (path if not other else path.with_name(other)).write_bytes(data)
            outcome, text, seconds, megabytes = measure(Seed(path, read), SECONDS, MEGABYTES)
            told[outcome] += 1
            told["longest_s"] = max(told["longest_s"], round(seconds, 2))
            told["largest_MB"] = max(told["largest_MB"], round(megabytes))
            if outcome == "failed":
                print(f"--- {number} {name}, {path.stat().st_size} bytes: {text.strip()[-600:]}", flush=True)
    return told


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="part of the number and name of a bomb, as printed")
    figures = run(parser.parse_args().only)
    print(json.dumps(figures))
    sys.exit(1 if figures["failed"] else 0)
