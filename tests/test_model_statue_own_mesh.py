"""The file's own mesh on the skeleton of its statue: its places, materials and weights, read by a reader of its own."""
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from glb_reader import Glb
from PIL import Image
from quiet_pictures import small_pictures  # noqa: F401 -- fixture
from scipy.spatial import cKDTree
from test_model_statue_control import changed
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from completion.__main__ import main
from model.statue.commands import read_scan
from model.statue.control.files import humanoid, write_control
from model.statue.control.model import MEASURED, DisplacementMap, Statue
from model.statue.files import save_statue
from model.statue.motion.motions import people_motion, write_body_motion
from model.statue.own_mesh import animate_own_mesh, carry_weights, write_own_mesh
from scanprep import Mesh, read_mesh, write_mesh
from scanprep.geometry.format_glb import turn_up
from scanprep.pipeline.scans import ScanTask
from scanprep.synthetic.people import find_pose

HUMAN = humanoid()
NAMES = HUMAN.skeleton.names
HEIGHT = 1.69
TURN = trimesh.transformations.rotation_matrix(0.4, [0.2, 1, 0.1], [0.3, 0, 0.1])


@pytest.fixture(scope="module")
def statue():
    flat = DisplacementMap(np.zeros((64, 64), np.float32), np.full((64, 64), MEASURED, np.uint8))
    return Statue(HUMAN, np.zeros((len(NAMES), 3)), flat)


def squat():
    return people_motion(HUMAN, np.zeros((17, 3)), np.stack([find_pose("rest"), find_pose("squat")]), rate=30.0)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A textured GLB of the humanoid with y up, a ball behind its lips and a staff beside its hand, all turned."""
    place = tmp_path_factory.mktemp("own") / "figure.glb"
    chart, turned = HUMAN.chart, turn_up(2).T
    corner = np.zeros(len(chart.uv), dtype=int)
    corner[chart.faces.ravel()] = HUMAN.mesh.faces.ravel()
    picture = Image.fromarray(np.tile(np.arange(64, dtype=np.uint8)[:, None, None], (1, 64, 3)))
    body = trimesh.Trimesh(HUMAN.mesh.vertices[corner] @ turned, chart.faces, process=False, visual=TextureVisuals(
        chart.uv, PBRMaterial(name="skin", baseColorTexture=picture, roughnessFactor=0.5)))
    mouth = HUMAN.mesh.vertices[HUMAN.landmarks["mouth"]]
    ball = trimesh.creation.icosphere(1, 0.01).apply_translation((mouth + [0, 0.03, 0]) @ turned)
    hand = HUMAN.skeleton.joints[NAMES.index("l_wrist")]
    staff = trimesh.creation.cylinder(0.01, 1.6).apply_translation(hand + [0.12, 0, 0])
    staff.vertices = staff.vertices @ turned
    scene = trimesh.Scene()
    inverse = np.linalg.inv(TURN)
    for name, mesh in (("body", body), ("ball", ball), ("staff", staff)):
        mesh.vertices = trimesh.transform_points(mesh.vertices, inverse)
        scene.add_geometry(mesh, name, name, transform=TURN)
    place.write_bytes(scene.export(file_type="glb", include_normals=True))
    return place


@pytest.fixture(scope="module")
def written(file, statue):
    # the statue stands as the file does, with y up
    standing = in_file_axes(statue)
    rows = write_own_mesh(file.with_name("own.glb"), file, 1.0, standing, "unity")
    return file.with_name("own.glb"), {row.name: row.value for row in rows}


def in_file_axes(statue):
    control, U = statue.control, turn_up(2).T
    # the pose says which axis of the scan is up
    pose = np.zeros((17, 3))
    pose[0] = [-np.pi / 2, 0, 0]
    return replace(statue, control=control.refit(control.mesh.vertices @ U, control.skeleton.joints @ U), pose=pose)


def places_of(file):
    """Vertices of a file without a skin, all of whose nodes are turned alike."""
    plain = Glb(file.read_bytes())
    return trimesh.transform_points(np.concatenate([
        plain.array(mesh["primitives"][0]["attributes"]["POSITION"]) for mesh in plain.json["meshes"]]), TURN)


def off(found, wanted):
    return float(np.abs(found - wanted).max())


def test_vertices_stand_where_they_stood_and_materials_stay(file, written):
    before, (path, _) = Glb(file.read_bytes()), written
    after = Glb(path.read_bytes())
    assert off(np.concatenate(after.vertices()), places_of(file)) < 1e-5 * HEIGHT
    assert after.json["materials"] == before.json["materials"] and after.json["textures"] == before.json["textures"]
    view = [one.json["bufferViews"][one.json["images"][0]["bufferView"]] for one in (before, after)]
    pictures = [one.buffer[v.get("byteOffset", 0):v.get("byteOffset", 0) + v["byteLength"]]
                for one, v in zip((before, after), view, strict=True)]
    assert pictures[0] == pictures[1]
    old, new = (one.json["meshes"][0]["primitives"][0] for one in (before, after))
    assert old["material"] == new["material"]
    np.testing.assert_array_equal(before.array(old["attributes"]["TEXCOORD_0"]), after.array(
        new["attributes"]["TEXCOORD_0"]))
    np.testing.assert_array_equal(before.array(old["indices"]), after.array(new["indices"]))
    normals = after.array(new["attributes"]["NORMAL"])
    np.testing.assert_allclose(normals, before.array(old["attributes"]["NORMAL"]) @ TURN[:3, :3].T, atol=1e-5)


def test_a_squat_moves_skin_as_the_statue_and_props_stiffly(file, written, statue, tmp_path):
    motion = squat()
    # the same motion in the axes of the file
    U = turn_up(2).T
    turned = replace(motion, poses=motion.poses @ U, trans=motion.trans @ U)
    animate_own_mesh(tmp_path / "own.glb", written[0], in_file_axes(statue), turned, "mixamo")
    moved = Glb((tmp_path / "own.glb").read_bytes())
    assert moved.bones[0] == "mixamorig:Hips" and written[1]["own mesh, loose parts that stay stiff"] == 2
    skin, ball, staff = moved.vertices(1)
    rest, ball_before, staff_before = moved.vertices()
    wanted = HUMAN.rig.vertices(motion.poses[1], motion.trans[1]) @ U
    nearest = trimesh.proximity.ProximityQuery(trimesh.Trimesh(wanted, HUMAN.mesh.faces, process=False)).vertex(skin)[0]
    assert nearest.max() < 0.002 and np.abs(skin - rest).max() > 0.3
    for after, before in ((ball, ball_before), (staff, staff_before)):
        sizes = [np.linalg.norm(one[:, None] - one[None], axis=2) for one in (after, before)]
        assert off(*sizes) < 1e-4                                      # no part of it bends
    # each keeps its distance to the part that it belongs to
    for part, prop, before in (("mouth", ball, ball_before), ("left middle finger", staff, staff_before)):
        vertex = HUMAN.landmarks[part]
        distance = [np.linalg.norm(prop.mean(axis=0) - wanted[vertex]),
                    np.linalg.norm(before.mean(axis=0) - HUMAN.mesh.vertices[vertex] @ U)]
        assert abs(np.subtract(*distance)) < 0.02


def test_the_inside_of_a_sleeve_follows_its_own_limb(statue):
    """A second skin 5 mm above the first that faces inwards: no place of the body faces that way near it."""
    mesh = HUMAN.mesh
    inner = Mesh(mesh.vertices + 0.005 * mesh.vertex_normals, np.ascontiguousarray(mesh.faces[:, ::-1]))
    weights, stiff = carry_weights(statue, inner)
    carried = (weights * HUMAN.weights).sum(axis=1) / np.maximum((HUMAN.weights**2).sum(axis=1), 1e-9)
    assert stiff == 0 and np.quantile(carried, 0.02) > 0.7
    assert (weights > 0).sum(axis=1).max() <= 4 and off(weights.sum(axis=1), 1) < 1e-9


@pytest.mark.parametrize("ending", ["obj", "ply", "stl"])
def test_other_files_become_glb_in_metres_with_y_up(statue, tmp_path, ending):
    """A mesh in millimetres with z up; OBJ with a picture."""
    path, mesh = tmp_path / f"scan.{ending}", HUMAN.mesh
    if ending == "obj":
        picture = Image.fromarray(np.full((8, 8, 3), (10, 200, 30), np.uint8))
        uv = np.column_stack([mesh.vertices[:, 0], mesh.vertices[:, 2] / 2])
        trimesh.Trimesh(1000 * mesh.vertices, mesh.faces, process=False, visual=TextureVisuals(
            uv, image=picture)).export(path)
    else:
        write_mesh(path, mesh.with_vertices(1000 * mesh.vertices))
    metres = read_scan(ScanTask("scan", path), "mm")[-1]
    assert metres == 0.001
    write_own_mesh(tmp_path / "own.glb", path, metres, statue)
    own = Glb((tmp_path / "own.glb").read_bytes())
    places = np.unique(np.concatenate(own.vertices()).round(5), axis=0)
    wanted = np.unique((mesh.vertices @ turn_up(2).T).round(5), axis=0)
    assert cKDTree(wanted).query(places)[0].max() < 2e-5 and len(own.bones) == len(NAMES)
    again = read_mesh(tmp_path / "own.glb")                                             # our reader turns it back
    assert off(np.ptp(again.vertices, axis=0), np.ptp(mesh.vertices, axis=0)) < 1e-4
    if ending == "obj":
        assert len(own.json["images"]) == 1 and "TEXCOORD_0" in own.json["meshes"][0]["primitives"][0]["attributes"]


def test_a_skin_of_the_file_is_replaced_and_morph_targets_stay(file, written, statue, tmp_path):
    """The written file as input: it is skinned already, by bones of other names."""
    def smiling(tree, rest):
        primitive = tree["meshes"][0]["primitives"][0]
        primitive["targets"] = [{"POSITION": primitive["attributes"]["NORMAL"]}]
        tree["meshes"][0]["extras"] = {"targetNames": ["smile"]}
        tree["asset"].pop("generator")

    again = changed(written[0], smiling)
    rows = {row.name: row.value for row in write_own_mesh(tmp_path / "own.glb", again, 2.0, replace(
        in_file_axes(statue), control=in_file_axes(statue).control.refit(
            2 * HUMAN.mesh.vertices @ turn_up(2).T, 2 * HUMAN.skeleton.joints @ turn_up(2).T)))}
    own = Glb((tmp_path / "own.glb").read_bytes())
    assert own.bones == list(NAMES) and len(own.json["skins"]) == 1 and rows["own mesh, morph targets kept"] == 1
    assert off(np.concatenate(own.vertices()), 2 * places_of(file)) < 2e-5 * HEIGHT
    assert own.json["meshes"][0]["extras"] == {"targetNames": ["smile"]}
    smile = own.array(own.json["meshes"][0]["primitives"][0]["targets"][0]["POSITION"])
    assert off(np.linalg.norm(smile, axis=1), 2) < 1e-4


def test_a_statue_without_or_with_another_mesh_says_what_to_do(statue, written, tmp_path, capsys):
    save_statue(tmp_path / "statue", statue)
    write_body_motion(tmp_path / "squat.npz", HUMAN, squat())
    words = ["statue", "animate", str(tmp_path / "statue"), str(tmp_path / "squat.npz"), "-o", str(tmp_path / "out"),
             "--own-mesh", "--level", "0"]
    assert main(words) == 1
    assert "run scape statue fit with --own-mesh again" in capsys.readouterr().err
    (tmp_path / "statue" / "own.glb").write_bytes(written[0].read_bytes())
    assert main(words) == 1
    assert "of another fit" in capsys.readouterr().err
    write_mesh(tmp_path / "scan.ply", HUMAN.mesh)
    write_own_mesh(tmp_path / "statue" / "own.glb", tmp_path / "scan.ply", 1.0, statue)
    assert main([*words, "--names", "unreal"]) == 0
    moved = Glb((tmp_path / "out" / "own.glb").read_bytes())
    assert moved.bones[:2] == ["pelvis", "spine_01"] == Glb((tmp_path / "out" / "statue.glb").read_bytes()).bones[:2]
    assert np.abs(np.concatenate(moved.vertices(1)) - np.concatenate(moved.vertices())).max() > 0.3


def test_what_has_no_mesh_or_no_such_names_is_refused_before_the_fit(tmp_path, capsys):
    np.savetxt(tmp_path / "cloud.xyz", HUMAN.mesh.vertices)
    words = ["statue", "fit", str(tmp_path / "cloud.xyz"), "-o", str(tmp_path / "out"), "--own-mesh"]
    assert main(words) == 1
    assert "expected triangles for --own-mesh, found points" in capsys.readouterr().err
    horse = replace(HUMAN, skeleton=replace(HUMAN.skeleton, names=tuple(f"bone{k}" for k in range(len(NAMES)))))
    write_control(horse, tmp_path / "horse.npz")
    write_mesh(tmp_path / "scan.ply", HUMAN.mesh)
    (tmp_path / "features.json").write_text("{}")
    words = ["statue", "fit", str(tmp_path / "scan.ply"), "-o", str(tmp_path / "out"), "--own-mesh", "--names", "unity",
             "--control", str(tmp_path / "horse.npz"), "--features", str(tmp_path / "features.json")]
    assert main(words) == 1
    assert "names: expected a person's parts" in capsys.readouterr().err and not (tmp_path / "out").exists()
