"""Files as scanners and other programs write them: each a small one of its kind, with the right value."""
import base64
import json
import struct

import numpy as np
import pytest
from fuzz_bombs import pictured_glb, png
from mesh_files import TETRAHEDRON, quiet, refused
from PIL import Image
from scipy.spatial.transform import Rotation

from scanprep.geometry.files import read_mesh, read_points, read_scan, write_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.textures import read_texture
from scanprep.pipeline.scans import find_scans

PLY = "ply\nformat {} 1.0\nelement vertex 4\n{}element {} {}\nproperty list {} int vertex_indices\nend_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
RGB = "property {0} red\nproperty {0} green\nproperty {0} blue\n"
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.0]])
STL = ("solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
       "endsolid a\n")


def same(mesh, other, atol=1e-6):
    np.testing.assert_array_equal(mesh.faces, other.faces)
    np.testing.assert_allclose(mesh.vertices, other.vertices, atol=atol)


# ---- PLY

@pytest.mark.parametrize("header", [b"\n", b"\r\n", b"\r"])
@pytest.mark.parametrize("last", [b"\n", b"\r\n", b"\r"])
def test_line_ends_of_a_binary_ply_may_be_mixed(tmp_path, header, last):
    if (header, last) == (b"\r", b"\r\n"):
        pytest.skip("LF is the first byte of the body")
    write_mesh(tmp_path / "a.ply", TETRAHEDRON)
    head, _, rest = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(head.replace(b"\n", header) + b"end_header" + last + rest)
    same(read_mesh(tmp_path / "a.ply"), TETRAHEDRON, 0)


def test_a_binary_body_that_begins_with_the_byte_of_a_line_end(tmp_path):
    tall = TETRAHEDRON.with_vertices(np.where(TETRAHEDRON.vertices == 0, np.float32(8.6e-33), TETRAHEDRON.vertices))
    first = struct.pack("<f", 8.6e-33)[1:]
    vertices = tall.vertices.copy()
    vertices[0, 0] = struct.unpack("<f", b"\n" + first)[0]
    write_mesh(tmp_path / "a.ply", tall.with_vertices(vertices), "single")
    data = (tmp_path / "a.ply").read_bytes()
    assert b"end_header\n\n" in data
    same(read_mesh(tmp_path / "a.ply"), tall.with_vertices(vertices), 1e-7)
    head, _, rest = data.partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes(head.replace(b"\n", b"\r") + b"end_header\r" + rest)
    same(read_mesh(tmp_path / "a.ply"), tall.with_vertices(vertices), 1e-7)


def test_strips_of_a_ply(tmp_path):
    text = PLY.format("ascii", XYZ, "tristrips", 3, "int") + "0 0 0\n1 0 0\n0 1 0\n1 1 0\n"
    (tmp_path / "a.ply").write_text(text + "9 0 1 2 3 -1 0 2 1 1\n2 0 1\n3 3 2 1\n")
    assert read_mesh(tmp_path / "a.ply").faces.tolist() == [[0, 1, 2], [2, 1, 3], [0, 2, 1], [3, 2, 1]]


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("name", ["a.obj", "a.off", "a.xyz"])
def test_a_mark_of_the_encoding_is_no_part_of_the_first_line(tmp_path, name, coding):
    """It hid the first vertex of an OBJ file, and every face was one vertex off."""
    rows = "0 0 0\n1 0 0\n0 1 0\n1 1 0\n"
    text = {"a.obj": "v " + rows[:-1].replace("\n", "\nv ") + "\nf 1 2 3\n", "a.off": f"OFF\n4 1 0\n{rows}3 0 1 2\n",
            "a.xyz": rows}[name]
    data = b"\xfe\xff" * (coding == "utf-16-be") + text.encode(coding)
    (tmp_path / name).write_bytes(data)
    np.testing.assert_array_equal(read_points(tmp_path / name).points, SQUARE)
    if name != "a.xyz":
        assert read_mesh(tmp_path / name).faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(("name", "text"), [
    ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1// 2//\nf\nf 1// 2// 3//\n"),
    ("a.ply", PLY.format("ascii", XYZ, "face", 3, "uchar") + "0 0 0\n1 0 0\n0 1 0\n1 1 0\n2 0 1\n0\n3 0 1 2\n")])
def test_faces_with_less_than_three_corners_are_left_out(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    with pytest.warns(UserWarning, match="has 2 corners, expected at least 3; 2 such faces were left out"):
        assert read_mesh(tmp_path / name).faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize("properties", [True, False])
def test_a_ply_with_an_empty_element_of_faces_is_a_cloud(tmp_path, properties):
    text = PLY.format("ascii", XYZ, "face", 0, "uchar") + "0 0 0\n1 0 0\n0 1 0\n1 1 0\n"
    text = text if properties else text.replace("property list uchar int vertex_indices\n", "")
    (tmp_path / "a.ply").write_text(text)
    np.testing.assert_array_equal(read_scan(tmp_path / "a.ply"), SQUARE)


@pytest.mark.parametrize(("kind", "white"), [("uchar", 255), ("int", 255), ("ushort", 65535), ("float", 1),
                                             ("float", 255), ("double", 255)])
def test_colours_of_a_ply_are_of_the_scale_that_fits(tmp_path, kind, white):
    colors = white * np.array([[1, 0.6, 0.2]] * 4)
    text = PLY.format("ascii", XYZ + RGB.format(kind), "face", 1, "uchar")
    rows = "\n".join("{:g} {:g} {:g} {:g} {:g} {:g}".format(*p, *c) for p, c in zip(SQUARE, colors, strict=True))
    (tmp_path / "a.ply").write_text(f"{text}{rows}\n3 0 1 2\n")
    np.testing.assert_allclose(read_mesh(tmp_path / "a.ply").colors, [[1, 0.6, 0.2]] * 4, atol=1e-5)


# ---- text

@pytest.mark.parametrize("change", [str.upper, lambda text: text.replace("solid", "Solid", 1)])
def test_ascii_stl_in_capitals(tmp_path, change):
    (tmp_path / "a.stl").write_text(change(STL))
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.stl").corners, [SQUARE[:3]])


def test_binary_stl_that_begins_with_solid_and_has_bytes_behind(tmp_path):
    write_mesh(tmp_path / "a.stl", TETRAHEDRON)
    data = (tmp_path / "a.stl").read_bytes()
    (tmp_path / "a.stl").write_bytes(b"solid of Some Program".ljust(80) + data[80:] + b"made by Some Program")
    with pytest.warns(UserWarning, match="20 bytes behind the 4 triangles"):
        mesh = read_mesh(tmp_path / "a.stl")
    np.testing.assert_array_equal(mesh.corners, TETRAHEDRON.corners)


def test_an_off_header_glued_to_its_counts(tmp_path):
    (tmp_path / "a.off").write_text("OFF3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    np.testing.assert_array_equal(read_mesh(tmp_path / "a.off").corners, [SQUARE[:3]])


POINTS = [[1.5, 2.5, 3.5], [-1, 0.25, 2e-3]]


@pytest.mark.parametrize(("name", "text", "colors"), [
    ("a.pts", "2\n1.5 2.5 3.5 120 200 150 100\n-1 .25 2e-3 3 200 150 100\n", True),
    ("a.pts", "2\n1.5 2.5 3.5 -1000\n-1 .25 2e-3 3\n", False),
    ("a.asc", "//X Y Z R G B\n2\n1.5 2.5 3.5 200 150 100\n-1 .25 2e-3 200 150 100\n", True),
    ("a.txt", "//X,Y,Z,Scalar,R,G,B\n1.5,2.5,3.5,7,200,150,100\n-1,.25,2e-3,8,200,150,100\n", True),
    ("a.csv", "z;red;green;blue;y;x\n3.5;200;150;100;2.5;1.5\n2e-3;200;150;100;.25;-1\n", True),
    ("a.csv", '"Points:0","Points:1","Points:2"\n1.5,2.5,3.5\n-1,.25,2e-3\n', False),
    ("a.csv", "1.5, 2.5, 3.5\n-1, .25, 2e-3\n", False),
    ("a.xyz", "1,5 2,5 3,5\n-1 0,25 2e-3\n", False),
    ("a.xyz", "1,5;2,5;3,5\n-1;0,25;2e-3\n", False),
    ("a.txt", "1,5\t2,5\t3,5\t200\t150\t100\n-1\t0,25\t0,002\t200\t150\t100\n", True)])
def test_clouds_of_text_as_programs_write_them(tmp_path, name, text, colors):
    (tmp_path / name).write_text(text)
    cloud = quiet(read_points, tmp_path / name)
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-12)
    if colors:
        np.testing.assert_allclose(255 * cloud.colors, [[200, 150, 100]] * 2)
    else:
        assert cloud.colors is None


# ---- PCD

def lzf(data):
    """Packed by a slow and simple method: the longest copy that begins in what came before, or bytes as they are."""
    out, at = bytearray(), 0
    while at < len(data):
        length = next((n for n in range(60, 2, -1) if data.find(data[at:at + n], max(at - 8000, 0), at + n - 1) >= 0
                       and at + n <= len(data)), 0)
        if length:
            back = at - data.rfind(data[at:at + length], max(at - 8000, 0), at + length - 1) - 1
            long = length - 2 >= 7
            out += bytes([(7 if long else length - 2) << 5 | back >> 8, *[length - 9] * long, back & 255])
        else:
            out += bytes([0, data[at]])
        at += length or 1
    return bytes(out)


def test_compressed_pcd(tmp_path):
    rng = np.random.default_rng(2)
    points = rng.integers(0, 9, (300, 3)).astype("<f4")
    points[7] = np.nan
    rgb = np.tile(np.array([200 << 16 | 150 << 8 | 100], "<u4"), 300)
    body = points.T.tobytes() + rgb.tobytes()
    packed = lzf(body)
    assert len(packed) < len(body) / 2
    head = b"VERSION .7\nFIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nPOINTS 300\nDATA binary_compressed\n"
    (tmp_path / "a.pcd").write_bytes(head + struct.pack("<II", len(packed), len(body)) + packed)
    with pytest.warns(UserWarning, match="1 of 300 points are not finite"):
        cloud = read_points(tmp_path / "a.pcd")
    np.testing.assert_array_equal(cloud.points, np.delete(points, 7, axis=0))
    np.testing.assert_allclose(255 * cloud.colors, [[200, 150, 100]] * 299)
    for cut in (packed[:-3], packed[:40] + b"\xff\xff\xff" + packed[43:]):
        (tmp_path / "a.pcd").write_bytes(head + struct.pack("<II", len(cut), len(body)) + cut)
        refused(tmp_path / "a.pcd", read=read_points)


# ---- glTF

def gltf(tree, arrays):
    """A tree of glTF with its numbers as accessors 0, 1, ... in one buffer, whose URI is a data URI."""
    kinds = {"f4": 5126, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125}
    views, accessors, data = [], [], b""
    for values in map(np.asarray, arrays):
        shape = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (16,): "MAT4"}[values.shape[1:]]
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": values.nbytes})
        accessors.append({"bufferView": len(views) - 1, "componentType": kinds[values.dtype.str[1:]],
                          "count": len(values), "type": shape, "normalized": values.dtype.str[1:] in ("i2", "u1")})
        data += values.tobytes() + b"\0" * (-values.nbytes % 4)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return {"asset": {"version": "2.0"}, "buffers": [{"uri": uri, "byteLength": len(data)}], "bufferViews": views,
            "accessors": accessors, **tree}, data


CORNERS, LINE = TETRAHEDRON.vertices.astype("<f4"), TETRAHEDRON.faces.ravel().astype("<u4")
PRIMITIVE = {"attributes": {"POSITION": 0}, "indices": 1}
ONE = {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}], "meshes": [{"primitives": [PRIMITIVE]}]}


def test_gltf_of_points_alone_is_a_cloud(tmp_path):
    cloud = {"attributes": {"POSITION": 0}, "mode": 0}
    tree, _ = gltf({**ONE, "meshes": [{"primitives": [cloud]}]}, [CORNERS, LINE])
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    np.testing.assert_allclose(read_points(tmp_path / "a.gltf").points, TETRAHEDRON.vertices, atol=1e-6)
    refused(tmp_path / "a.gltf", "found 4 vertices and no faces")
    tree["meshes"][0]["primitives"].append(PRIMITIVE)
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    same(read_mesh(tmp_path / "a.gltf"), TETRAHEDRON)


def test_gltf_with_its_numbers_inside_or_beside(tmp_path):
    tree, data = gltf(ONE, [CORNERS, LINE])
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    same(read_mesh(tmp_path / "a.gltf"), TETRAHEDRON)
    (tmp_path / "two parts.bin").write_bytes(data)
    (tmp_path / "in").mkdir()
    for uri, folder in (("two%20parts.bin", ""), ("../two parts.bin", "in")):
        tree["buffers"][0]["uri"] = uri
        (tmp_path / folder / "a.gltf").write_text(json.dumps(tree))
    same(read_mesh(tmp_path / "a.gltf"), TETRAHEDRON)
    refused(tmp_path / "in" / "a.gltf", "inside", "../two parts.bin")
    (tmp_path / "in" / "link.bin").symlink_to(tmp_path / "two parts.bin")
    tree["buffers"][0]["uri"] = "link.bin"
    (tmp_path / "in" / "a.gltf").write_text(json.dumps(tree))
    refused(tmp_path / "in" / "a.gltf", "leads out", "link.bin")
    (tmp_path / "two parts.bin").unlink()
    refused(tmp_path / "a.gltf", "a.gltf: its numbers cannot be read", "two parts.bin: no such file")


def test_normalised_integers_of_gltf_are_fractions(tmp_path):
    whole = np.rint(TETRAHEDRON.vertices / 2 * 32767).astype("<i2")
    tree, _ = gltf({**ONE, "nodes": [{"mesh": 0, "scale": [2, 2, 2]}],
                    "extensionsRequired": ["KHR_mesh_quantization"]}, [whole, LINE])
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    same(read_mesh(tmp_path / "a.gltf"), TETRAHEDRON, 1e-4)


def test_sparse_numbers_of_gltf(tmp_path):
    tree, _ = gltf(ONE, [0 * CORNERS, LINE, np.array([1, 2, 3], "<u2"), CORNERS[1:]])
    tree["accessors"][0]["sparse"] = {"count": 3, "indices": {"bufferView": 2, "componentType": 5123},
                                      "values": {"bufferView": 3}}
    for base in (True, False):                                   # without a view all others are zero
        (tmp_path / "a.gltf").write_text(json.dumps(tree))
        same(read_mesh(tmp_path / "a.gltf"), TETRAHEDRON)
        tree["accessors"][0].pop("bufferView", base)


def test_extensions_that_a_gltf_requires_are_known_or_refused(tmp_path):
    for name, known in (("KHR_materials_unlit", True), ("EXT_meshopt_compression", False),
                        ("EXT_mesh_gpu_instancing", False)):
        (tmp_path / "a.gltf").write_text(json.dumps(gltf({**ONE, "extensionsRequired": [name]}, [CORNERS, LINE])[0]))
        if known:
            same(read_mesh(tmp_path / "a.gltf"), TETRAHEDRON)
        else:
            refused(tmp_path / "a.gltf", f"needs {name}")


def test_skinned_meshes_stand_where_their_joints_carry_them(tmp_path):
    """Stored in centimetres on two joints, one of them turned; a rigid mesh beside it in metres."""
    joints, shares = np.zeros((4, 4), "<u2"), np.tile(np.array([[1, 0, 0, 0]], "<f4"), (4, 1))
    joints[3, 0] = 1
    turned = Rotation.from_euler("x", 90, degrees=True).as_quat().tolist()
    inverse = np.tile(np.diag([0.01, 0.01, 0.01, 1]).T.ravel().astype("<f4"), (2, 1))
    skinned = {"attributes": {"POSITION": 2, "JOINTS_0": 3, "WEIGHTS_0": 4}, "indices": 1}
    tree, _ = gltf({"scenes": [{"nodes": [0, 1, 2]}], "skins": [{"joints": [2, 3], "inverseBindMatrices": 5}],
                    "meshes": [{"primitives": [skinned]}, {"primitives": [PRIMITIVE]}],
                    "nodes": [{"mesh": 0, "skin": 0, "translation": [9, 9, 9]}, {"mesh": 1, "translation": [3, 0, 0]},
                              {"children": [3]}, {"rotation": turned}]},
                   [CORNERS, LINE, 100 * CORNERS, joints, shares, inverse])
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    mesh = quiet(read_mesh, tmp_path / "a.gltf")
    np.testing.assert_allclose(mesh.vertices[:4], [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1.5, 0]], atol=1e-6)
    np.testing.assert_allclose(mesh.vertices[4:], TETRAHEDRON.vertices + [3, 0, 0], atol=1e-6)


# ---- formats that are not read

def test_a_gltf_of_draco_names_the_export_that_works(tmp_path):
    tree, _ = gltf(ONE, [CORNERS, LINE, np.zeros(9, "u1")])
    tree["meshes"][0]["primitives"][0] = {**PRIMITIVE, "extensions": {"KHR_draco_mesh_compression": {
        "bufferView": 2, "attributes": {"POSITION": 0}}}}
    (tmp_path / "a.gltf").write_text(json.dumps({**tree, "extensionsUsed": ["KHR_draco_mesh_compression"]}))
    same(read_mesh(tmp_path / "a.gltf"), TETRAHEDRON)            # with a copy that is not packed
    del tree["accessors"][0]["bufferView"]
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    refused(tmp_path / "a.gltf", "it needs KHR_draco_mesh_compression", "without compression")


@pytest.mark.parametrize(("name", "program"), [
    ("a.dae", "Blender"), ("a.3mf", "MeshLab"), ("a.wrl", "MeshLab"), ("a.E57", "CloudCompare"),
    ("a.drc", "draco_decoder"), ("a.fbx", "Blender")])
def test_formats_that_are_not_read_name_the_export_that_works(tmp_path, name, program):
    (tmp_path / name).write_bytes(b"anything")
    refused(tmp_path / name, program, "makes")
    write_mesh(tmp_path / "b.ply", TETRAHEDRON)
    with pytest.warns(UserWarning, match=rf"{name}.*{program}"):
        assert [task.name for task in find_scans(tmp_path)] == ["b"]


# ---- textures

def pictured(folder, picture="lost.png"):
    (folder / "a.mtl").write_text(f"newmtl A\nmap_Kd {picture}\nnewmtl B\nmap_Kd green.png\n")
    (folder / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 0 1\n"
                                  "usemtl A\nf 1/1 2/2 3/3\nusemtl B\nf 1/1 2/2 4/3\n")
    Image.new("RGB", (8, 8), (0, 200, 0)).save(folder / "green.png")
    return folder / "a.obj"


@pytest.mark.parametrize("what", ["folder", "outside", "huge"])
def test_pictures_that_are_none_or_too_large_are_named(tmp_path, what):
    (tmp_path / "in").mkdir()
    obj = pictured(tmp_path / "in", {"outside": "../lost.png"}.get(what, "lost.png"))
    if what == "folder":
        (tmp_path / "in" / "lost.png").mkdir()
    else:
        size, place = (8200, 8200) if what == "huge" else (8, 8), tmp_path / ("" if what == "outside" else "in")
        Image.new("1", size).save(place / "lost.png")
    says = {"folder": "found a folder",
            "outside": "expected the name of a file inside", "huge": "8200 x 8200 pixels"}[what]
    with pytest.warns(UserWarning, match=says):
        read_texture(obj)


@pytest.mark.parametrize(("picture", "says"), [(b"\xabKTX 20\xbb of another program", "its colours are left out"),
                                               (png(9000, 9000), "9000 x 9000 pixels")])
def test_a_picture_in_a_glb_that_cannot_be_read_is_named(tmp_path, picture, says):
    (tmp_path / "a.glb").write_bytes(pictured_glb(picture))
    if says.startswith("its"):
        with pytest.warns(UserWarning, match=says):
            assert read_texture(tmp_path / "a.glb") is None
    else:
        with pytest.raises(ValueError, match=rf"a\.glb.*{says}"):
            read_texture(tmp_path / "a.glb")


def test_seams_and_lost_points_together_keep_the_numbers_of_the_file(tmp_path):
    twice = Mesh(np.r_[TETRAHEDRON.vertices, [[9, 9, 9]], TETRAHEDRON.vertices], np.r_[TETRAHEDRON.faces[:2],
                                                                                        TETRAHEDRON.faces[2:] + 5])
    write_mesh(tmp_path / "a.obj", twice)
    text = (tmp_path / "a.obj").read_text()
    (tmp_path / "a.obj").write_text(text.replace("v 9 9 9", "v nan 0 0"))
    mesh = quiet(read_mesh, tmp_path / "a.obj")
    assert mesh.of_file.tolist() == [0, 1, 2, 3, -1, 0, 1, 2, 3]
    same(mesh, TETRAHEDRON, 0)


def test_a_range_grid_is_joined_where_neighbours_are_near(tmp_path):
    rows, columns = 6, 8
    y, x = np.mgrid[:rows, :columns] * 0.01
    z = np.where(x > 0.035, 0.5, 0.0)                            # a step half a metre deep between columns 3 and 4
    seen = np.ones((rows, columns), bool)
    seen[0, 0] = False
    points = np.stack([x, y, z], axis=2)[seen]
    number = iter(range(len(points)))
    cells = "\n".join(f"1 {next(number)}" if there else "0" for there in seen.ravel())
    header = PLY.format("ascii\nobj_info num_cols 8\nobj_info num_rows 6\ncomment", XYZ, "range_grid", 48, "uchar")
    header = header.replace("comment 1.0", "").replace("ascii", "ascii 1.0").replace("vertex 4", "vertex 47")
    rows_of_points = "\n".join(" ".join(f"{v:.9g}" for v in p) for p in points)
    (tmp_path / "a.ply").write_text(header.replace("\n\n", "\n") + rows_of_points + "\n" + cells + "\n")
    with pytest.warns(UserWarning, match="range grid of 6 x 8.* 59 triangles, 10 that span jumps"):
        mesh = read_mesh(tmp_path / "a.ply")
    assert mesh.vertices.shape == (47, 3)
    np.testing.assert_allclose(mesh.face_normals, np.tile([0.0, 0, 1], (59, 1)), atol=1e-9)       # towards the scanner


def test_points_that_are_not_finite_are_left_out(tmp_path):
    text = PLY.format("ascii", XYZ, "face", 1, "uchar") + "0 0 0\nnan nan nan\n1 0 0\n0 1 0\n3 0 2 3\n"
    (tmp_path / "a.ply").write_text(text)
    with pytest.warns(UserWarning, match="1 of 4 points are not finite and were left out$"):
        mesh = read_mesh(tmp_path / "a.ply")
    assert mesh.faces.tolist() == [[0, 1, 2]] and mesh.of_file.tolist() == [0, -1, 1, 2]
