"""Meshes, points and folders: what is written comes back, others agree, and bad files say what is wrong."""
import gzip
import json
import struct
import warnings

import igl
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scanprep.geometry.files import (
    MeshFileError,
    PointCloud,
    list_meshes,
    read_mesh,
    read_points,
    read_registered,
    write_mesh,
    write_points,
)
from scanprep.geometry.format_glb import tallest, turn_up
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.people import BodyShape, Person

TETRAHEDRON = Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
EXACT = {".ply": 0, ".ply.gz": 0, ".obj": 1e-11, ".off": 1e-11, ".glb": 1e-6}


def body(rng, n=200):
    """A closed surface with vertices and faces in an order of no meaning, about a metre across."""
    points = rng.normal(size=(n, 3))
    mesh = trimesh.convex.convex_hull(points / np.linalg.norm(points, axis=1, keepdims=True))
    order = rng.permutation(len(mesh.vertices))
    vertices = np.empty_like(mesh.vertices)
    vertices[order] = mesh.vertices
    return Mesh(vertices * (0.3, 0.4, 0.9), order[rng.permutation(mesh.faces)], rng.random((len(vertices), 3)))


@st.composite
def meshes(draw):
    n = draw(st.integers(3, 12))
    number = st.floats(-4, 4, width=32)
    vertices = draw(st.lists(st.tuples(number, number, number), min_size=n, max_size=n, unique=True))
    faces = draw(st.lists(st.lists(st.integers(0, n - 1), min_size=3, max_size=3, unique=True), min_size=1,
                          max_size=8))
    return Mesh(np.array(vertices), np.array(faces))


def quiet(read, *args):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read(*args)


# ---- what is written comes back

@pytest.mark.parametrize("suffix", EXACT)
@pytest.mark.parametrize("precision", ["double", "single"])
def test_round_trip_keeps_order_and_coordinates(tmp_path, suffix, precision):
    mesh = body(np.random.default_rng(1))
    write_mesh(tmp_path / f"a{suffix}", mesh, precision)
    back = read_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(back.faces, mesh.faces)
    assert np.abs(back.vertices - mesh.vertices).max() <= max(EXACT[suffix], 1e-6 if precision == "single" else 0)
    np.testing.assert_allclose(back.colors, mesh.colors, atol=0.5 / 255 + 1e-9)
    assert [p.name for p in tmp_path.iterdir()] == [f"a{suffix}"]
    write_mesh(tmp_path / f"b{suffix}", mesh, precision)
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / f"b{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", EXACT)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(mesh=meshes())
def test_round_trip_of_any_mesh(tmp_path, suffix, mesh):
    write_mesh(tmp_path / f"a{suffix}", mesh)
    back = quiet(read_mesh, tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(back.vertices, mesh.vertices, atol=1e-10)
    assert back.colors is None


def test_stl_gives_back_the_triangles_welded_in_order_of_use(tmp_path):
    mesh = body(np.random.default_rng(2))
    write_mesh(tmp_path / "a.stl", mesh)
    back = read_mesh(tmp_path / "a.stl")
    np.testing.assert_allclose(back.corners, mesh.corners, atol=1e-7)
    assert len(back.vertices) == len(mesh.vertices) and back.is_closed
    _, first = np.unique(back.faces.ravel(), return_index=True)
    assert (np.diff(first) > 0).all()
    write_mesh(tmp_path / "b.stl", back)
    write_mesh(tmp_path / "c.stl", back)
    assert (tmp_path / "b.stl").read_bytes() == (tmp_path / "c.stl").read_bytes()
    again = read_mesh(tmp_path / "b.stl")
    np.testing.assert_array_equal(again.vertices, back.vertices)
    np.testing.assert_array_equal(again.faces, back.faces)


# ---- other libraries agree

@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_we_read_what_trimesh_writes_and_others_read_ours(tmp_path, suffix):
    mesh = body(np.random.default_rng(5))
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(read_mesh(tmp_path / f"a{suffix}").corners, mesh.corners, atol=1e-6)
    write_mesh(tmp_path / f"b{suffix}", mesh)
    theirs = trimesh.load(tmp_path / f"b{suffix}", force="mesh", process=False)
    shown = mesh.corners @ turn_up(tallest(mesh.vertices)).T if suffix == ".glb" else mesh.corners
    np.testing.assert_allclose(theirs.vertices[theirs.faces], shown, atol=1e-6)
    if suffix != ".glb":
        write_mesh(tmp_path / f"b{suffix}", Mesh(mesh.vertices, mesh.faces))        # it expects no colours
        v, f = igl.read_triangle_mesh(str(tmp_path / f"b{suffix}"))
        np.testing.assert_allclose(v[f], mesh.corners, atol=1e-6)


@pytest.mark.parametrize("up", [0, 1, 2])
def test_glb_has_y_up_and_comes_back_as_it_was(tmp_path, up):
    mesh = Mesh(np.float32(np.roll([1.7, 0.3, 0.5], up) * np.random.default_rng(up).uniform(0, 1, (60, 3))),
                np.arange(60).reshape(20, 3), np.tile([0.2, 0.5, 0.7], (60, 1)))
    write_mesh(tmp_path / "a.glb", mesh)
    shown = trimesh.load(tmp_path / "a.glb", force="mesh", process=False).vertices
    assert np.ptp(shown, axis=0).argmax() == 1 and np.array_equal(shown, np.float32(mesh.vertices @ turn_up(up).T))
    again = read_mesh(tmp_path / "a.glb", "m")
    assert np.array_equal(again.vertices, mesh.vertices) and np.array_equal(again.faces, mesh.faces)
    assert np.allclose(again.colors, mesh.colors, atol=1e-6)
    data = (tmp_path / "a.glb").read_bytes()                # from elsewhere, or from before there was a mark
    for ours, theirs in ((b'"up"', b'"xx"'), (b'"scapekit"', b'"someones"')):
        (tmp_path / "b.glb").write_bytes(data.replace(ours, theirs))
        assert np.array_equal(read_mesh(tmp_path / "b.glb", "m").vertices, shown)


def test_arms_spread_wider_than_a_body_is_tall_do_not_lay_it_over():
    person = Person(BodyShape()).mesh.vertices
    width, _, height = np.ptp(person, axis=0)
    for wide in (0.9, 1.0, 1.1):
        assert tallest(person * [wide * height / width, 1, 1]) == 2
        assert tallest(np.roll(person * [wide * height / width, 1, 1], 1, axis=1)) == 0
    assert tallest(person * [2 * height / width, 1, 1]) == 0


def test_glb_places_every_mesh_by_its_node(tmp_path):
    box, ball = trimesh.creation.box((0.2, 0.4, 0.6)), trimesh.creation.icosphere(1)
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3), (0.1, 0, 0))
    mirror = np.diag([-1.0, 1, 1, 1])
    scene.add_geometry(box, transform=turn)
    scene.add_geometry(ball, transform=mirror @ turn)
    scene.add_geometry(box, transform=np.eye(4))
    scene.export(tmp_path / "scene.glb")
    mesh = read_mesh(tmp_path / "scene.glb")
    assert len(mesh.faces) == 2 * len(box.faces) + len(ball.faces)
    volumes = [piece.volume for piece in trimesh.Trimesh(mesh.vertices, mesh.faces, process=True).split()]
    np.testing.assert_allclose(sorted(volumes), sorted([box.volume, box.volume, ball.volume]), rtol=1e-5)
    # none is negative: the mirrored one is not inside out
    expected = np.concatenate([trimesh.transform_points(box.vertices, turn), box.vertices,
                               trimesh.transform_points(ball.vertices, mirror @ turn)])
    distance = np.linalg.norm(mesh.vertices[:, None] - expected, axis=2)
    assert distance.min(axis=1).max() < 1e-6 and distance.min(axis=0).max() < 1e-6


# ---- the forms a format may take

PLY_ROWS = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n0.5 0.5 1\n"
PLY_HEADER = ("ply\nformat ascii 1.0\ncomment made by hand\nelement vertex 5\nproperty float x\nproperty float y\n"
              "property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n")


BLOCK = "v {0} 0 0\nv {0} 1 0\nv {0} 0 1\nf -3 -2 -1\n"


@pytest.mark.parametrize(("name", "text", "faces", "colors"), [
    ("a.ply", PLY_HEADER + PLY_ROWS + "4 0 1 2 3\n3 0 1 4\n", [[0, 1, 2], [0, 2, 3], [0, 1, 4]], None),
    ("a.obj", "# a comment\nmtllib a.mtl\no thing\nv 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nvt 0 0\nvn 0 0 1\n"
     "f 1/1/1 2/1/1 3//1\nusemtl skin\n  v 0 1 0 1 1 1 # late\ns off\nf -4 -2 -1\nf 1 2 \\\n 3 4\n",
     [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 2, 3]], [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]),
    ("b.obj", "".join(BLOCK.format(i) for i in range(4)), np.arange(12).reshape(-1, 3), None),   # back from their line
    ("a.off", "# one\nCOFF 4 2 0 # counts\n0 0 0 255 0 0 255\n1 0 0 0 255 0 255\n\n"
     "1 1 0 0 0 255 255\n0 1 0 0 0 0 255\n4 0 1 2 3\n3 0 1 2 200 10 10\n",
     [[0, 1, 2], [0, 2, 3], [0, 1, 2]], [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]])])
def test_the_forms_of_text(tmp_path, name, text, faces, colors):
    """Polygons as fans, colours, comments, counts on the first line, faces of OBJ in all their ways."""
    (tmp_path / name).write_text(text)
    mesh = read_mesh(tmp_path / name)
    np.testing.assert_array_equal(mesh.faces, faces)
    if colors is not None:
        np.testing.assert_array_equal(mesh.colors, colors)
    if name == "a.ply":
        assert mesh.vertices[4].tolist() == [0.5, 0.5, 1]


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("sizes", [(3, 3), (4, 3)])
def test_ply_binary_of_both_byte_orders_skips_what_it_does_not_know(tmp_path, order, sizes):
    name = {"<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = (f"ply\r\nformat {name} 1.0\r\nelement camera 1\r\nproperty double f\r\nelement vertex 4\r\n"
              "property double x\r\nproperty uchar red\r\nproperty uchar green\r\nproperty uchar blue\r\n"
              "property uchar alpha\r\nproperty double y\r\nproperty double z\r\nelement face 2\r\n"
              "property uchar flags\r\nproperty list uint8 int32 vertex_index\r\n"
              "property list uchar float texcoord\r\nelement edge 1\r\nproperty int a\r\nend_header\r\n")
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.25]])
    data = header.encode() + struct.pack(order + "d", 7.0)
    for i, (x, y, z) in enumerate(corners):
        data += struct.pack(order + "d4Bdd", x, 51 * i, 0, 255, 255, y, z)
    for size in sizes:
        data += struct.pack(f"{order}BB{size}iB6f", 9, size, *range(size), 6, *([0.5] * 6))
    (tmp_path / "a.ply").write_bytes(data + struct.pack(order + "i", 5))
    mesh = read_mesh(tmp_path / "a.ply")
    np.testing.assert_array_equal(mesh.vertices, corners)
    np.testing.assert_allclose(mesh.colors, [[0.2 * i, 0, 1] for i in range(4)])
    expected = [[0, 1, 2], [0, 2, 3], [0, 1, 2]] if sizes[0] == 4 else [[0, 1, 2], [0, 1, 2]]
    np.testing.assert_array_equal(mesh.faces, expected)


def test_ascii_stl_is_read_even_though_binary_ones_may_begin_with_solid(tmp_path):
    facets = "".join("facet normal 0 0 0\n outer loop\n" + "".join(f"  vertex {x:.9g} {y:.9g} {z:.9g}\n"
                     for x, y, z in corner) + " endloop\nendfacet\n" for corner in TETRAHEDRON.corners)
    (tmp_path / "a.stl").write_text(f"solid thing\n{facets}endsolid thing\n")
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.stl").corners, TETRAHEDRON.corners)
    write_mesh(tmp_path / "b.stl", TETRAHEDRON)
    data = (tmp_path / "b.stl").read_bytes()
    (tmp_path / "b.stl").write_bytes(b"solid of binary".ljust(80) + data[80:])
    np.testing.assert_array_equal(read_mesh(tmp_path / "b.stl").corners, TETRAHEDRON.corners)


# ---- units

@pytest.mark.parametrize(("unit", "factor"), [("m", 1), ("mm", 1e-3), ("cm", 1e-2), ("in", 0.0254)])
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_units_become_metres(tmp_path, unit, factor, suffix):
    write_mesh(tmp_path / f"a{suffix}", TETRAHEDRON.with_vertices(TETRAHEDRON.vertices / factor))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = read_mesh(tmp_path / f"a{suffix}", unit=unit)
    np.testing.assert_allclose(mesh.corners, TETRAHEDRON.corners, atol=1e-6)


@pytest.mark.parametrize(("factor", "says"), [(1000, "unit='mm'"), (100, "unit='cm'"), (1 / 0.0254, "unit='in'"),
                                              (1e-3, "divided by 1000")])
def test_a_giant_or_a_dwarf_warns_and_says_which_unit_it_looks_like(tmp_path, factor, says):
    person = TETRAHEDRON.with_vertices(TETRAHEDRON.vertices * factor * 1.75 / 1.5)
    write_mesh(tmp_path / "person.ply", person)
    with pytest.warns(UserWarning, match=says) as caught:
        mesh = read_mesh(tmp_path / "person.ply")
    assert "person.ply" in str(caught[0].message)
    np.testing.assert_array_equal(mesh.vertices, person.vertices)


def test_an_unknown_unit_is_refused(tmp_path):
    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    with pytest.raises(ValueError, match=r"unit: expected one of m, mm, cm, in, got 'feet'"):
        read_mesh(tmp_path / "a.ply", unit="feet")


# ---- bad files: one line with the name of the file, what was expected, what came

def refused(path, *words, read=read_mesh):
    with pytest.raises(MeshFileError) as caught:
        quiet(read, path)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message, message
    for word in words:
        assert word in message, message


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
def test_coordinates_that_are_not_finite_are_refused(tmp_path, suffix, bad):
    vertices = np.where(TETRAHEDRON.vertices == 1.5, 1.25, TETRAHEDRON.vertices)
    write_mesh(tmp_path / f"a{suffix}", TETRAHEDRON.with_vertices(vertices), "single")
    data = (tmp_path / f"a{suffix}").read_bytes()
    if suffix in (".obj", ".off"):
        data = data.replace(b"1.25", str(bad).encode())
    else:
        data = data.replace(struct.pack("<f", 1.25), struct.pack("<f", bad))
    (tmp_path / f"a{suffix}").write_bytes(data)
    refused(tmp_path / f"a{suffix}", "not finite")


STL = "solid\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid\n"


@pytest.mark.parametrize(("name", "text", "words"), [
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 7\n3 0 1 2\n", ["face 0", "vertex 7", "0..4"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 -1\n3 0 1 2\n", ["face 0", "vertex -1"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "2 0 1\n3 0 1 2\n", ["face 0", "2 corners", "at least 3"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 2\n", ["truncated", "2 rows of element face", "found 1"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 2\n3 0 1 2\n3 0 1 2\n", ["5 vertex, 2 face", "1 more lines"]),
    ("a.ply", PLY_HEADER + PLY_ROWS.replace("0.5 0.5 1", "0.5 half 1") + "3 0 1 2\n3 0 1 2\n", ["line 15", "half"]),
    ("a.ply", PLY_HEADER + PLY_ROWS.replace("0.5 0.5 1", "0.5 0.5") + "3 0 1 2\n3 0 1 2\n", ["line 15", "0.5 0.5"]),
    ("a.ply", PLY_HEADER + PLY_ROWS + "3 0 1 2\n3 0 1\n", ["line 17", "face"]),
    ("a.ply", PLY_HEADER.replace("face 2", "face 0") + PLY_ROWS, ["expected a mesh", "no faces"]),
    ("a.ply", PLY_HEADER.replace("vertex 5", "vertex 0").replace("face 2", "face 0"), ["no vertices"]),
    ("a.ply", PLY_HEADER.replace("float z", "float w") + PLY_ROWS + "3 0 1 2\n3 0 1 2\n", ["x, y, z", "'w'"]),
    ("a.ply", PLY_HEADER.replace("vertex 5", "vertex five"), ["line 4", "five"]),
    ("a.ply", PLY_HEADER.replace("ascii", "binary_middle_endian"), ["line 2", "binary_middle_endian"]),
    ("a.ply", PLY_HEADER.replace("end_header\n", ""), ["end_header"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 zero\nf 1 2 3\n", ["line 3", "v 0 1 zero"]),
    ("a.obj", "v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", ["line 2", "v 1 0"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n\nf 1 2 4\n", ["line 5", "face 0", "vertex 3", "0..2"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 0\n", ["line 4", "counted from 1"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -9\n", ["line 4", "face 0"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", ["line 4", "2 corners"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\nf a b c\n", ["line 5", "f a b c"]),
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", ["no faces"]),
    ("a.obj", "f 1 2 3\nv 0 0 0\nv 1 0 0\n", ["line 1", "face 0", "vertex 2", "0..1"]),                # cut off
    ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", ["line 6", "vertex 3", "0..2"]),
    ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 x\n0 1 0\n3 0 1 2\n", ["line 4", "1 0 x"]),
    ("a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", ["line 6", "3 0 1"]),
    ("a.off", "OFF\n3 2 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", ["truncated", "2 faces", "found 1"]),
    ("a.off", "OFF\nthree 1 0\n", ["line 2", "three"]),
    ("a.off", "OFF BINARY\n3 1 0\n", ["binary"]),
    ("a.stl", STL.replace("vertex 1 0 0\n", "vertex 1 0\n"), ["line 5", "vertex 1 0"]),
    ("a.stl", STL.replace("vertex 1 0 0\n", ""), ["3 vertex lines", "1 facets", "found 2"]),
    ("a.stl", STL.replace("endsolid\n", ""), ["truncated", "endsolid"]),
    ("a.xyz", "0 0 0\n1 0\n", ["line 2", "1 0"]),
    ("a.xyz", "0 0 0\n1 0 x\n", ["line 2", "1 0 x"]),
    ("a.xyz", "0 0 0\n1 0 nan\n", ["not finite", "point 1"]),
    ("a.xyz", "# nothing\n", ["found none"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y\nSIZE 4 4\nTYPE F F\nCOUNT 1 1\nPOINTS 1\nDATA ascii\n0 0\n", ["x, y, z"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA ascii\n0 0 0\n", ["truncated"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA binary\nshort", ["truncated"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nPOINTS 2\nDATA binary_compressed\n",
     ["binary_compressed", "save the file as binary"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\nSIZE 4 4\nTYPE F F F\nPOINTS 2\nDATA ascii\n", ["agree"]),
    ("a.pcd", "VERSION 0.7\nFIELDS x y z\n", ["DATA"]),
    ("a.pcd", "hello\nworld\n", ["line 1", "hello"]),
])
def test_a_bad_file_says_where(tmp_path, name, text, words):
    (tmp_path / name).write_text(text)
    refused(tmp_path / name, *words, read=read_points if name.endswith(("xyz", "pcd")) else read_mesh)


def test_a_glb_with_a_face_out_of_range_or_damaged_json(tmp_path):
    write_mesh(tmp_path / "bad.glb", TETRAHEDRON)
    data = (tmp_path / "bad.glb").read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    (tmp_path / "bad.glb").write_bytes(data[:20 + size + 8] + struct.pack("<I", 77) + data[20 + size + 12:])
    refused(tmp_path / "bad.glb", "vertex 77", "0..3")
    tree = json.loads(data[20:20 + size])
    del tree["accessors"][1]["componentType"]
    text = json.dumps(tree, separators=(",", ":")).encode().ljust(size)
    (tmp_path / "bad.glb").write_bytes(data[:20] + text + data[20 + size:])
    refused(tmp_path / "bad.glb", "componentType")
    (tmp_path / "bad.glb").write_bytes(data[:20] + b"{" * size + data[20 + size:])
    refused(tmp_path / "bad.glb", "JSON")


def test_a_name_of_no_known_format(tmp_path):
    (tmp_path / "a.fbx").touch()
    refused(tmp_path / "a.fbx", ".ply", "'.fbx'")
    (tmp_path / "a").touch()
    refused(tmp_path / "a", ".ply", "found none")
    with pytest.raises(MeshFileError, match=r"a\.fbx.*'\.fbx'"):
        write_mesh(tmp_path / "a.fbx", TETRAHEDRON)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_a_damaged_file_is_read_or_refused_but_never_breaks(tmp_path, suffix, data):
    write_mesh(tmp_path / f"whole{suffix}", TETRAHEDRON)
    content = bytearray((tmp_path / f"whole{suffix}").read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    (tmp_path / f"bad{suffix}").write_bytes(bytes(content))
    try:
        assert len(quiet(read_mesh, tmp_path / f"bad{suffix}").faces)
    except MeshFileError as error:
        assert f"bad{suffix}" in str(error) and "\n" not in str(error)


def test_nothing_half_written_is_left_behind(tmp_path, monkeypatch):
    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    before = (tmp_path / "a.ply").read_bytes()
    monkeypatch.setattr("pathlib.Path.write_bytes", _fail_half_way)
    with pytest.raises(OSError, match="disk full"):
        write_mesh(tmp_path / "a.ply", body(np.random.default_rng(7)))
    assert (tmp_path / "a.ply").read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1


def _fail_half_way(path, data):
    with open(path, "wb") as out:
        out.write(data[:len(data) // 2])
    raise OSError("disk full")


# ---- points

def cloud(rng, normals=True, colors=True):
    n = rng.normal(size=(50, 3))
    return PointCloud(rng.normal(size=(50, 3)), n / np.linalg.norm(n, axis=1, keepdims=True) if normals else None,
                      rng.random((50, 3)) if colors else None)


@pytest.mark.parametrize("suffix", [".ply", ".ply.gz", ".pcd", ".xyz", ".txt"])
@pytest.mark.parametrize(("normals", "colors"), [(True, True), (True, False), (False, True), (False, False)])
def test_points_come_back(tmp_path, suffix, normals, colors):
    points = cloud(np.random.default_rng(8), normals, colors)
    write_points(tmp_path / f"a{suffix}", points)
    back = read_points(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(back.points, points.points, atol=1e-9)
    for mine, theirs, tolerance in ((back.normals, points.normals, 1e-6), (back.colors, points.colors, 0.5 / 255)):
        assert (mine is None) == (theirs is None)
        if mine is not None:
            np.testing.assert_allclose(mine, theirs, atol=tolerance + 1e-9)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_the_vertices_of_a_mesh_are_points_with_its_normals(tmp_path, suffix):
    write_mesh(tmp_path / f"a{suffix}", TETRAHEDRON)
    points, mesh = read_points(tmp_path / f"a{suffix}"), read_mesh(tmp_path / f"a{suffix}")
    np.testing.assert_array_equal(points.points, mesh.vertices)
    np.testing.assert_allclose(points.normals, mesh.vertex_normals, atol=1e-6)


def test_pcd_ascii_leaves_out_points_without_return_and_unpacks_colours(tmp_path):
    (tmp_path / "a.pcd").write_text(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 3\n"
        "HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 3\nDATA ascii\n0 0 1 16711680\nnan nan nan 0\n0.5 0 1 255\n")
    points = read_points(tmp_path / "a.pcd")
    np.testing.assert_array_equal(points.points, [[0, 0, 1], [0.5, 0, 1]])
    np.testing.assert_array_equal(points.colors, [[1, 0, 0], [0, 0, 1]])


def test_text_points_with_a_heading_commas_and_colours(tmp_path):
    (tmp_path / "a.txt").write_text("//X,Y,Z,R,G,B\n0,0,0,255,0,0\n1,0,0.5,0,51,0\n")
    points = read_points(tmp_path / "a.txt")
    np.testing.assert_array_equal(points.points, [[0, 0, 0], [1, 0, 0.5]])
    np.testing.assert_allclose(points.colors, [[1, 0, 0], [0, 0.2, 0]])
    assert points.normals is None


def test_points_have_units_too(tmp_path):
    write_points(tmp_path / "a.xyz", PointCloud(np.array([[0, 0, 0], [0, 0, 1800.0]])))
    with pytest.warns(UserWarning, match=r"a\.xyz.*unit='mm'"):
        read_points(tmp_path / "a.xyz")
    np.testing.assert_allclose(read_points(tmp_path / "a.xyz", unit="mm").points, [[0, 0, 0], [0, 0, 1.8]])


# ---- folders

def test_a_folder_of_one_topology_is_read_sorted_by_name(tmp_path):
    rng, mesh = np.random.default_rng(9), body(np.random.default_rng(9), 30)
    expected = {}
    for name in ("b.ply", "a.obj", "c.1.ply.gz"):
        expected[name.split(".ply")[0].split(".obj")[0]] = vertices = mesh.vertices + rng.normal(size=3)
        write_mesh(tmp_path / name, mesh.with_vertices(vertices))
    (tmp_path / "notes.md").write_text("not a mesh")
    registered = read_registered(tmp_path)
    assert registered.names == ("a", "b", "c.1") and len(list_meshes(tmp_path)) == 3
    np.testing.assert_array_equal(registered.faces, mesh.faces)
    for vertices, name in zip(registered.vertices, registered.names, strict=True):
        np.testing.assert_allclose(vertices, expected[name], atol=1e-10)


@pytest.mark.parametrize(("other", "words"), [
    (Mesh(np.r_[TETRAHEDRON.vertices, [[1, 1, 1.0]]], TETRAHEDRON.faces),
     ["4 vertices and 4 faces", "5 vertices and 4 faces"]),
    (Mesh(TETRAHEDRON.vertices, TETRAHEDRON.faces[[0, 1, 3, 2]]),
     ["from face 2", "[1, 2, 3]", "[0, 3, 2]", "flipped"])])
def test_a_folder_of_two_topologies_names_the_file_and_the_difference(tmp_path, other, words):
    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    write_mesh(tmp_path / "b.ply", other)
    refused(tmp_path / "b.ply", "a.ply", *words, read=lambda _: read_registered(tmp_path))


def test_a_folder_that_is_missing_or_holds_no_meshes(tmp_path):
    refused(tmp_path / "none", "no such folder", read=list_meshes)
    refused(tmp_path, "found none", read=list_meshes)
    (tmp_path / "file").touch()
    refused(tmp_path / "file", "expected a folder", read=list_meshes)


@pytest.mark.real
def test_real_scans_agree_with_igl(real_data):
    path = list_meshes(real_data / "scape_poses")[0]
    mesh, (v, f) = read_mesh(path), igl.read_triangle_mesh(str(path))
    np.testing.assert_array_equal(mesh.vertices, v)
    np.testing.assert_array_equal(mesh.faces, f)
