"""Bad files of meshes: one line with the name of the file, what was expected, what came."""
import gzip
import json
import struct

import numpy as np
import pytest
from mesh_files import PLY_HEADER, PLY_ROWS, TETRAHEDRON, body, refused

from scanprep.geometry.files import read_mesh, read_points, write_mesh


@pytest.mark.parametrize("suffix", [".ply", ".ply.gz", ".obj", ".stl", ".off", ".glb"])
def test_missing_empty_folder_and_foreign_files(tmp_path, suffix):
    refused(tmp_path / f"none{suffix}", "no such file")
    (tmp_path / f"empty{suffix}").touch()
    refused(tmp_path / f"empty{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    refused(tmp_path / f"folder{suffix}", "folder")
    foreign = b"<html>this is not the file you are looking for</html>\n"
    (tmp_path / f"foreign{suffix}").write_bytes(gzip.compress(foreign) if suffix.endswith("gz") else foreign)
    refused(tmp_path / f"foreign{suffix}")


@pytest.mark.parametrize("suffix", [".ply", ".ply.gz", ".stl", ".off", ".glb"])
def test_a_file_cut_off_anywhere_is_refused(tmp_path, suffix):
    write_mesh(tmp_path / f"whole{suffix}", body(np.random.default_rng(6), 40))
    data = (tmp_path / f"whole{suffix}").read_bytes()
    for part in (0.02, 0.3, 0.6, 0.9, 0.99):
        path = tmp_path / f"cut{suffix}"
        path.write_bytes(data[:int(part * len(data))])
        refused(path)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".stl", ".glb"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_vertex_that_is_not_finite_is_left_out_with_its_triangles(tmp_path, suffix, bad):
    vertices = np.where(TETRAHEDRON.vertices == 1.5, 1.25, TETRAHEDRON.vertices)
    write_mesh(tmp_path / f"a{suffix}", TETRAHEDRON.with_vertices(vertices), "single")
    data = (tmp_path / f"a{suffix}").read_bytes()
    if suffix in (".obj", ".off"):
        data = data.replace(b"1.25", str(bad).encode())
    else:
        data = data.replace(struct.pack("<f", 1.25), struct.pack("<f", bad))
    (tmp_path / f"a{suffix}").write_bytes(data)
    with pytest.warns(UserWarning, match="points are not finite and were left out, with 3 triangles"):
        mesh = read_mesh(tmp_path / f"a{suffix}")
    assert sorted(mesh.vertices.tolist()) == sorted(TETRAHEDRON.vertices[:3].tolist()) and len(mesh.faces) == 1
    np.testing.assert_array_equal(np.cross(*np.diff(mesh.corners[0], axis=0)), [0, 0, -1])
    if suffix != ".stl":
        assert mesh.of_file.tolist() == [0, 1, 2, -1]


STL = "solid\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n"


@pytest.mark.parametrize(("name", "text", "words"), [
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 7\n3 0 1 2\n", ["face 0", "vertex 7", "0..4"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "2 0 1\n2 1 2\n", ["face 0", "2 corners", "at least 3"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 2\n", ["truncated", "2 rows of element face", "found 1"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 2\n3 0 1 2\n3 0 1 2\n", ["5 vertex, 2 face", "1 more lines"]),
    ("a.ply", PLY_HEADER + PLY_ROWS.replace("0.5 0.5 1", "0.5 0.5") + "3 0 1 2\n3 0 1 2\n", ["line 15", "0.5 0.5"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 2\n3 0 1\n", ["line 17", "face"]),
    ("a.ply", PLY_HEADER.replace("face 2", "face 0") + PLY_ROWS, ["expected a mesh", "no faces"]),
    ("a.ply", PLY_HEADER.replace("vertex 5", "vertex 0").replace("face 2", "face 0"), ["no vertices"]),
    ("a.ply", PLY_HEADER.replace("float z", "float w") + PLY_ROWS + "3 0 1 2\n3 0 1 2\n", ["x, y, z", "'w'"]),
    ("a.ply", PLY_HEADER.replace("vertex 5", "vertex five"), ["line 4", "five"]),
    ("a.ply", PLY_HEADER.replace("ascii", "binary_middle_endian"), ["line 2", "binary_middle_endian"]),
    ("a.ply", PLY_HEADER.replace("end_header\n", ""), ["end_header"]),
    ("a.obj", "v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", ["line 2", "v 1 0"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n\nf 1 2 4\n", ["line 5", "face 0", "vertex 3", "0..2"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", ["line 4", "counted from 1"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf a b c\n", ["line 5", "f a b c"]),
    ("a.obj", "f 1 2 3\nv 0 0 0\nv 1 0 0\n", ["line 1", "face 0", "vertex 2", "0..1"]),                # cut off
    ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 x\n0 1 0\n3 0 1 2\n", ["line 4", "1 0 x"]),
    ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", ["line 6", "3 0 1"]),
    ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", ["truncated", "2 faces", "found 1"]),
    ("a.off", "OFF\nthree 1 0\n", ["line 2", "three"]),
    ("a.off", "OFF BINARY\n3 1 0\n", ["binary"]),
    ("a.stl", STL.replace("vertex 1 0 0\n", "vertex 1 0\n"), ["line 5", "vertex 1 0"]),
    ("a.stl", STL.replace("vertex 1 0 0\n", ""), ["3 vertex lines", "1 facets", "found 2"]),
    ("a.stl", STL.replace("endsolid\n", ""), ["truncated", "endsolid"]),
    ("a.xyz", "0 0 0\n1 0\n", ["line 2", "1 0"]),
    ("a.xyz", "nan 0 0\n1 0 nan\n", ["none of its 2 points is finite"]),
    ("a.csv", "1,5;2.5;3,5\n", ["line 1", "both points and commas"]),
    ("a.csv", "x;y;height\n1;2;3\n", ["line 1", "x, y and z"]),
    ("a.xyz", "# nothing\n", ["found none"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y\nSIZE 4 4\nTYPE F F\nCOUNT 1 1\nPOINTS 1\nDATA ascii\n0 0\n", ["x, y, z"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA ascii\n0 0 0\n", ["truncated"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA binary\nshort", ["truncated"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA binary_compressed\n",
     ["truncated", "24 bytes of 2 points"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 2\nDATA ascii\n", ["agree"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\n", ["DATA"]),
    ("a.pcd", "hello\nworld\n", ["line 1", "hello"]),
])
def test_a_bad_file_says_where(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    refused(tmp_path / name, *words, read=read_points if name.endswith(("xyz", "pcd", "csv")) else read_mesh)


def test_a_glb_with_a_face_out_of_range_or_damaged_json(tmp_path):
    write_mesh(tmp_path / "bad.glb", TETRAHEDRON)
    data = (tmp_path / "bad.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20:20 + size])
    surface = tree["meshes"][0]["primitives"][0]
    indices = tree["accessors"][surface["indices"]]
    at = 20 + size + 8 + tree["bufferViews"][indices["bufferView"]].get("byteOffset", 0)
    (tmp_path / "bad.glb").write_bytes(data[:at] + struct.pack("<I", 77) + data[at + 4:])
    refused(tmp_path / "bad.glb", "vertex 77", "0..3")
    del tree["accessors"][surface["attributes"]["POSITION"]]["componentType"]
    text = json.dumps(tree, separators=(",", ":")).encode().ljust(size)
    (tmp_path / "bad.glb").write_bytes(data[:20] + text + data[20 + size:])
    refused(tmp_path / "bad.glb", "componentType")
    (tmp_path / "bad.glb").write_bytes(data[:20] + b"{" * size + data[20 + size:])
    refused(tmp_path / "bad.glb", "JSON")


def test_lists_of_negative_length(tmp_path):
    head = PLY_HEADER.replace("ascii", "binary_little_endian").replace("list uchar", "list char").encode()
    body = np.arange(15, dtype="<f4").tobytes()
    for faces in (struct.pack("<b3ib3i", -1, 0, 1, 2, 3, 0, 1, 2), struct.pack("<b3ib3i", 3, 0, 1, 2, -3, 0, 1, 2)):
        (tmp_path / "a.ply").write_bytes(head + body + faces)
        refused(tmp_path / "a.ply", "element face", "a list of -")
