"""The control model of Animated Statues: the generic humanoid, charts, and control models of other programs."""
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from animal_bodies import Animal
from test_model_statue_cli import JOINTS

from completion.__main__ import main
from model.export.glb import write_skinned_glb
from model.rig import joint_places
from model.statue.control.chart import (
    Chart,
    automatic_chart,
    chart_problem,
    densities,
    make_chart,
)
from model.statue.control.files import STORED, humanoid, read_control, write_control
from model.statue.control.model import control_problem
from model.statue.files import load_statue
from model.statue.motion.motions import people_motion
from scanprep import write_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError
from scanprep.synthetic.people import SyntheticPerson, find_pose

NAMES = humanoid().skeleton.names
MIRROR = np.array([-1, 1, 1])


@pytest.fixture(scope="module")
def glb(tmp_path_factory):
    path = tmp_path_factory.mktemp("glb") / "person.glb"
    write_skinned_glb(path, humanoid().rig)
    return path


def changed(path, change):
    """The GLB file with its JSON changed, beside the first."""
    data = path.read_bytes()
    size = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20:20 + size])
    rest = bytearray(data[20 + size:])
    change(tree, rest)
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    out = path.with_name("changed.glb")
    out.write_bytes(data[:8] + struct.pack("<II", 20 + len(text) + len(rest), len(text)) + b"JSON" + text + bytes(rest))
    return out


def test_the_humanoid_is_one_closed_symmetric_surface_of_even_triangles():
    mesh = humanoid().mesh
    assert 950 <= len(mesh.vertices) <= 1150
    assert control_problem(humanoid()) is None
    assert mesh.is_closed and mesh.vertex_component.max() == 0
    assert len(mesh.vertices) - len(mesh.edges) + len(mesh.faces) == 2
    far = np.linalg.norm(mesh.vertices[:, None] * MIRROR - mesh.vertices, axis=2)
    twin = far.argmin(axis=1)
    assert far.min(axis=1).max() < 1e-12
    triangles = {tuple(sorted(f)) for f in mesh.faces.tolist()}
    assert triangles == {tuple(sorted(f)) for f in twin[mesh.faces].tolist()}
    sides = np.linalg.norm(mesh.corners - np.roll(mesh.corners, 1, axis=1), axis=2)
    quality = 4 * 3**0.5 * mesh.face_areas / (sides**2).sum(axis=1)         # 1 for equal sides
    assert quality.min() > 0.5 and np.median(quality) > 0.95
    assert STORED.stat().st_size < 150_000


def test_the_humanoid_turns_and_stretches_as_in_the_paper():
    control = humanoid()
    freedom = dict(zip(NAMES, map(len, control.axes), strict=True))
    assert sum(freedom.values()) + 3 == 38 and len(control.segments) == 9
    assert [freedom[n] for n in ("vl5", "l_hip", "r_shoulder", "l_sternoclavicular", "r_wrist", "l_elbow", "r_knee",
                                 "l_ankle")] == [3, 3, 3, 2, 2, 1, 1, 1]
    for name, axes, limits in zip(NAMES, control.axes, control.limits, strict=True):
        np.testing.assert_allclose(axes @ axes.T, np.eye(len(axes)), atol=1e-12)
        assert (limits[:, 0] < 0).all() and (limits[:, 1] > 0).all()
        if name.startswith("l_"):                                   # an axis of rotation mirrors the other way round
            right = control.axes[NAMES.index("r" + name[1:])]
            np.testing.assert_allclose(right, axes * [1, -1, -1], atol=1e-12)
    joints, parents = control.skeleton.joints, control.skeleton.parents
    for limb in ("elbow", "knee"):
        axis, j = control.axes[NAMES.index(f"l_{limb}")][0], NAMES.index(f"l_{limb}")
        assert abs(axis @ (joints[j] - joints[parents[j]])) < 1e-9 and abs(axis @ (joints[j + 1] - joints[j])) < 1e-9


@pytest.mark.parametrize(("joint", "axis", "towards"), [
    ("elbow", 0, "front"), ("knee", 0, "back"), ("hip", 1, "front"), ("shoulder", 1, "front"), ("shoulder", 0, "up"),
    ("hip", 0, "out"), ("sternoclavicular", 0, "up"), ("sternoclavicular", 1, "front"), ("ankle", 0, "down"),
    ("wrist", 0, "in"), ("wrist", 1, "front")])
def test_a_positive_angle_moves_a_limb_as_its_name_says(joint, axis, towards):
    control = humanoid()
    for side, out in (("l", 1), ("r", -1)):
        way = {"front": (0, -1, 0), "back": (0, 1, 0), "up": (0, 0, 1), "down": (0, 0, -1), "out": (out, 0, 0),
               "in": (-out, 0, 0)}[towards]
        j = NAMES.index(f"{side}_{joint}")
        pose = np.zeros((17, 3))
        pose[j] = 0.3 * control.axes[j][axis]
        mine = control.weights[:, j] > 0.99
        if joint == "sternoclavicular":
            mine = control.weights[:, j + 1] > 0.99
        moved = (control.rig.vertices(pose) - control.mesh.vertices)[mine].mean(axis=0)
        assert moved @ way > 0.6 * np.linalg.norm(moved)


def test_the_chart_is_one_to_one_and_even():
    control = humanoid()
    assert chart_problem(control.mesh, control.chart) is None
    density = densities(control.mesh, control.chart)
    assert density.min() > 0.5 and density.max() < 2
    assert control.chart.uv.min() > 5 / 1024 and control.chart.uv.max() < 1 - 5 / 1024
    rows, columns, faces, bary = control.chart.texels(300)
    assert len(rows) / 300**2 > 0.45
    assert len(np.unique(rows * 300 + columns)) == len(rows)
    back = np.einsum("nc,ncd->nd", bary, control.chart.uv[control.chart.faces[faces]])
    centres = np.column_stack([columns + 0.5, 300 - rows - 0.5]) / 300
    np.testing.assert_allclose(back, centres, atol=1e-12)


def test_a_chart_that_is_not_one_to_one_is_told():
    mesh, chart = humanoid().mesh, humanoid().chart
    assert "inverted" in chart_problem(mesh, replace(chart, uv=chart.uv[:, ::-1]))
    assert "leaves" in chart_problem(mesh, replace(chart, uv=chart.uv + 0.5))
    turn = np.linspace(0, 2.3 * np.pi, 60)                          # a ribbon that runs over its own beginning
    ribbon = 0.5 + 0.4 * np.concatenate([r * np.stack([np.cos(turn), np.sin(turn)], axis=1) for r in (0.7, 1.0)])
    i = np.arange(59)
    strip = np.vstack([np.stack([i, i + 60, i + 1], axis=1), np.stack([i + 1, i + 60, i + 61], axis=1)])
    assert "crosses" in chart_problem(Chart(ribbon, strip).flat, Chart(ribbon, strip))
    short = strip[(strip % 60 < 50).all(axis=1)]
    used, short = np.unique(short, return_inverse=True)
    part = Chart(ribbon[used], short.reshape(-1, 3))
    assert chart_problem(part.flat, part) is None
    faces = chart.faces.copy()                                      # one triangle on its own
    faces[7] = len(chart.uv) + np.arange(3)
    assert "2 charts" in chart_problem(mesh, Chart(np.vstack([chart.uv, chart.uv[chart.faces[7]]]), faces))
    with pytest.raises(ValueError, match="one disk"):
        make_chart(mesh, [])
    with pytest.raises(ValueError, match="no edge joins"):
        make_chart(mesh, [np.array([0, len(mesh.vertices) - 1])])


def test_an_animal_gets_a_chart():
    animal = Animal()
    chart = automatic_chart(animal.mesh, animal.skeleton)
    assert chart_problem(animal.mesh, chart) is None
    assert densities(animal.mesh, chart).min() > 1 / 3


def test_files_give_back_what_was_saved(tmp_path):
    control = humanoid()
    write_control(control, tmp_path / "a.npz")
    again = read_control(tmp_path / "a.npz")
    for one, other in ((control.mesh.vertices, again.mesh.vertices), (control.mesh.faces, again.mesh.faces),
                       (control.weights, again.weights), (control.chart.uv, again.chart.uv),
                       (control.chart.faces, again.chart.faces), (control.skeleton.joints, again.skeleton.joints),
                       (control.segment_of_part, again.segment_of_part),
                       (np.concatenate(control.axes), np.concatenate(again.axes)),
                       (np.concatenate(control.limits), np.concatenate(again.limits))):
        np.testing.assert_array_equal(one, other)
    assert (control.landmarks, control.segments, NAMES) == (again.landmarks, again.segments, again.skeleton.names)
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:9000])
    for damaged in ("b.npz", "missing.npz", "a.obj", "missing.glb"):
        with pytest.raises(StorageError, match=damaged):
            read_control(tmp_path / damaged)
    write_control(replace(control, weights=control.weights * 2), tmp_path / "c.npz")
    with pytest.raises(StorageError, match=r"c\.npz.*weights"):
        read_control(tmp_path / "c.npz")


def test_a_skinned_glb_becomes_the_same_control_model(tmp_path):
    """Of triangles that share no vertices."""
    control, corners = humanoid(), humanoid().mesh.faces.ravel()
    soup = Mesh(control.mesh.vertices[corners], np.arange(len(corners)).reshape(-1, 3))
    write_skinned_glb(tmp_path / "a.glb", replace(control.rig, mesh=soup, weights=control.weights[corners],
                                                  shapes=np.zeros((0, len(corners), 3))))
    again = read_control(tmp_path / "a.glb")
    np.testing.assert_allclose(again.skeleton.joints, control.skeleton.joints, atol=1e-6)
    assert again.skeleton.names == NAMES == again.segments and again.landmarks == {}
    np.testing.assert_array_equal(again.skeleton.parents, control.skeleton.parents)
    assert len(again.mesh.vertices) == len(control.mesh.vertices)
    np.testing.assert_allclose(again.mesh.corners, control.mesh.corners, atol=1e-6)      # triangles in order
    np.testing.assert_allclose(again.weights[again.mesh.faces], control.weights[control.mesh.faces], atol=1e-6)
    pose = 0.3 * np.random.default_rng(3).normal(size=(17, 3))
    np.testing.assert_allclose(again.rig.vertices(pose)[again.mesh.faces],
                               control.rig.vertices(pose)[control.mesh.faces], atol=1e-5)


def test_a_skinned_glb_is_read_as_it_stands_in_the_scene(glb):
    """An armature that is scaled and turned, a bone without skin between two others, and a helper bone on top."""
    control = humanoid()

    def change(tree, rest):
        nodes = tree["nodes"]
        j = 1 + NAMES.index("l_elbow")
        nodes[1 + NAMES.index("l_shoulder")]["children"] = [len(nodes)]
        nodes.append({"name": "twist", "children": [j]})
        nodes.append({"name": "armature", "children": [1], "scale": [2, 2, 2]})
        tree["scenes"][0]["nodes"] = [0, len(nodes) - 1]

    again = read_control(changed(glb, change))
    assert again.skeleton.names == NAMES
    np.testing.assert_allclose(again.mesh.vertices, 2 * control.mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(again.skeleton.joints, 2 * control.skeleton.joints, atol=1e-6)
    assert chart_problem(again.mesh, again.chart) is None


def drop_weights(tree, rest):
    for name in ("WEIGHTS_0", "JOINTS_0"):
        del tree["meshes"][0]["primitives"][0]["attributes"][name]


def open_it(tree, rest):
    tree["accessors"][tree["meshes"][0]["primitives"][0]["indices"]]["count"] -= 3


def not_a_number(tree, rest):
    view = tree["bufferViews"][tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
                               ["bufferView"]]
    struct.pack_into("<f", rest, 8 + view.get("byteOffset", 0), np.nan)


def second_skeleton(tree, rest):
    tree["scenes"][0]["nodes"].append(len(tree["nodes"]))
    tree["nodes"].append({"name": "other", "mesh": 0, "skin": 1})
    tree["skins"].append(tree["skins"][0])


def lost_joint(tree, rest):
    tree["skins"][0]["joints"][3] = 999


@pytest.mark.parametrize(("change", "reason"), [
    (drop_weights, "WEIGHTS_0"), (not_a_number, "not finite"),
    (second_skeleton, "2 meshes that hang on joints"), (lost_joint, "999")])
def test_a_glb_that_is_no_control_model_is_refused_by_name(glb, change, reason):
    with pytest.raises(StorageError, match=rf"changed\.glb.*{reason}"):
        read_control(changed(glb, change))


def test_an_open_control_mesh_is_closed(glb):
    with pytest.warns(UserWarning, match="repaired and closed"):
        again = read_control(changed(glb, open_it))
    assert again.mesh.is_closed and len(again.mesh.faces) == len(humanoid().mesh.faces)


def with_eyes(path, pose=None):
    """A skinned GLB of the humanoid in a pose, with two eyes as components of their own; no landmarks."""
    control = humanoid()
    rig = control.rig if pose is None else replace(control.rig, mesh=control.mesh.with_vertices(
        control.rig.vertices(pose)), skeleton=replace(control.skeleton, joints=joint_places(control.skeleton, pose)))
    ball = trimesh.creation.icosphere(1, 0.012)
    head = NAMES.index("skullbase")
    for side in ("left eye", "right eye"):
        n, m = len(rig.mesh.vertices), len(ball.vertices)
        place = rig.mesh.vertices[control.landmarks[side]]
        mesh = Mesh(np.vstack([rig.mesh.vertices, ball.vertices + place]), np.vstack([rig.mesh.faces, ball.faces + n]))
        skeleton = replace(rig.skeleton, part_of_face=np.r_[rig.skeleton.part_of_face, [head] * len(ball.faces)])
        rig = replace(rig, mesh=mesh, skeleton=skeleton, weights=np.vstack([rig.weights, np.eye(17)[[head] * m]]),
                      shapes=np.zeros((0, n + m, 3)))
    write_skinned_glb(path, rig)


@pytest.mark.slow
def test_a_control_model_without_landmarks_in_another_pose_is_fitted_to_the_end(tmp_path, capsys):
    """A GLB with eyes, its arms spread, and joints by hand on a person whose arms hang."""
    pose = people_motion(humanoid(), np.zeros((17, 3)), find_pose("t_pose")[None]).poses[0]
    with_eyes(tmp_path / "eyes.glb", pose)
    person = SyntheticPerson()
    write_mesh(tmp_path / "scan.ply", person.mesh)
    (tmp_path / "features.json").write_text(json.dumps(
        {name: person.joints[j].tolist() for name, j in JOINTS.items()}))
    assert main(["statue", "fit", *map(str, (
        tmp_path / "scan.ply", "--control", tmp_path / "eyes.glb", "--features", tmp_path / "features.json",
        "--unit", "m", "-o", tmp_path / "out", "--size", 256))]) == 0
    assert "left out 2 small components" in capsys.readouterr().err
    told = json.loads((tmp_path / "out" / "report.json").read_text())["metrics"]
    rows = {row["metric"]: row["value"] for row in told}
    assert rows["level 3 to the scan, mean"] < 1.5 and (tmp_path / "out" / "report.html").is_file()
    statue = load_statue(tmp_path / "out")
    off = [np.linalg.norm(statue.control.skeleton.joints[NAMES.index(name)] - person.joints[j])
           for name, j in JOINTS.items()]
    assert max(off) < 0.03
