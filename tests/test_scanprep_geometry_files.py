"""Meshes and folders: what is written comes back, and others agree."""
import itertools
import struct
import warnings

import igl
import numpy as np
import pytest
import trimesh
from mesh_files import PLY_HEADER, PLY_ROWS, TETRAHEDRON, body, refused

from scanprep.geometry.files import UNITS, list_meshes, name_of, read_mesh, read_registered, write_mesh
from scanprep.geometry.format_glb import tallest, turn_up
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.people import BodyShape, SyntheticPerson

EXACT = {".ply": 0, ".ply.gz": 0, ".obj": 1e-11, ".off": 1e-11, ".glb": 1e-6}


# ---- names

@pytest.mark.parametrize(("file", "name"), [
    ("anna.ply", "anna"), ("2024.05.01 anna.ply", "2024.05.01 anna"), ("2024.05.01.PLY.GZ", "2024.05.01"),
    ("anna.v2.3mf", "anna.v2"), ("anna", "anna"), ("2024.05.01 anna", "2024.05.01 anna"), ("2024.05", "2024.05"),
    ("a.b.landmarks.json", "a.b"), ("a.mrk.json", "a"), ("a.b.json", "a.b"), (".ply", ".ply")])
def test_a_name_keeps_its_dots(tmp_path, file, name):
    assert name_of(file) == name_of(tmp_path / "c.d" / file) == name


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
    assert np.array_equal(shown[:, 1], np.float32(mesh.vertices[:, up])) and np.linalg.det(turn_up(up)) == 1
    again = read_mesh(tmp_path / "a.glb", "m")
    assert np.array_equal(again.vertices, mesh.vertices) and np.array_equal(again.faces, mesh.faces)
    assert np.allclose(again.colors, mesh.colors, atol=1e-6)
    data = (tmp_path / "a.glb").read_bytes()                # from elsewhere, or from before there was a mark
    for ours, theirs in ((b'"up"', b'"xx"'), (b'"scapekit"', b'"someones"')):
        (tmp_path / "b.glb").write_bytes(data.replace(ours, theirs))
        assert np.array_equal(read_mesh(tmp_path / "b.glb", "m").vertices, shown)


def test_arms_spread_wider_than_a_body_is_tall_do_not_lay_it_over():
    person = SyntheticPerson(BodyShape()).mesh.vertices
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


# ---- units

@pytest.mark.parametrize(("unit", "factor"), [("m", 1), ("mm", 1e-3), ("cm", 1e-2), ("in", 0.0254)])
@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_units_become_metres(tmp_path, unit, factor, suffix):
    write_mesh(tmp_path / f"a{suffix}", TETRAHEDRON.with_vertices(TETRAHEDRON.vertices / factor))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        mesh = read_mesh(tmp_path / f"a{suffix}", unit=unit)
    np.testing.assert_allclose(mesh.corners, TETRAHEDRON.corners, atol=1e-6)


@pytest.mark.parametrize(("unit", "stature"), [*itertools.product(["mm", "cm", "in"], [1.4, 1.75, 2.2]), ("mm", 0.45),
                                               ("cm", 0.95)])
@pytest.mark.parametrize("far", [0, 4e6])
def test_the_unit_in_which_it_is_a_person_is_taken(tmp_path, unit, far, stature):
    person = TETRAHEDRON.with_vertices(TETRAHEDRON.vertices * stature / 1.5 / UNITS[unit] + far)
    write_mesh(tmp_path / "person.ply", person)
    with pytest.warns(UserWarning, match=rf"person\.ply: read with unit='{unit}', .* {stature:.2f} m") as caught:
        mesh = read_mesh(tmp_path / "person.ply")
    assert len(caught) == 1
    np.testing.assert_array_equal(mesh.vertices, UNITS[unit] * person.vertices)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(read_mesh(tmp_path / "person.ply", "m").vertices, person.vertices)


def test_what_belongs_together_has_one_unit(tmp_path):
    for name, stature in (("a", 1750), ("child", 1100), ("hand", 190)):
        write_mesh(tmp_path / f"{name}.ply", TETRAHEDRON.with_vertices(TETRAHEDRON.vertices * stature / 1.5))
    with pytest.warns(UserWarning) as caught:
        bodies = read_registered(tmp_path)
    assert [str(w.message).split(",")[0] for w in caught] == [f"{tmp_path / 'a.ply'}: read with unit='mm'"]
    np.testing.assert_allclose(np.ptp(bodies.vertices, axis=1).max(axis=1), [1.75, 1.1, 0.19])


@pytest.mark.parametrize(("factor", "says"), [(2000, "unit='mm'"), (200, "unit='cm'"), (16, "unit='in'"),
                                              (1e-3, "divided by 1000")])
def test_a_giant_or_a_dwarf_of_no_certain_unit_warns_and_stays(tmp_path, factor, says):
    person = TETRAHEDRON.with_vertices(TETRAHEDRON.vertices * factor * 1.75 / 1.5)
    write_mesh(tmp_path / "person.ply", person)
    with pytest.warns(UserWarning, match=says) as caught:
        mesh = read_mesh(tmp_path / "person.ply")
    assert "person.ply" in str(caught[0].message)
    np.testing.assert_array_equal(mesh.vertices, person.vertices)


def test_an_unknown_unit_is_refused(tmp_path):
    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    with pytest.raises(ValueError, match=r"unit: expected one of m, mm, cm, in, or its length in metres, got 'feet'"):
        read_mesh(tmp_path / "a.ply", unit="feet")


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
     ["from face 2", "[1, 2, 3]", "[0, 3, 2]", "flipped"]),
    (Mesh(TETRAHEDRON.vertices, TETRAHEDRON.faces[:, [0, 2, 1]]), ["inside out"])])
def test_a_folder_of_two_topologies_names_the_file_and_the_difference(tmp_path, other, words):
    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    write_mesh(tmp_path / "b.ply", other)
    refused(tmp_path / "b.ply", "a.ply", *words, read=lambda _: read_registered(tmp_path))
