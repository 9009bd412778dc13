"""Rigs as animation programs expect them: root, names, bones along the limbs, on the ground, to the viewer."""
import json
from dataclasses import replace

import numpy as np
import pytest
from bvh_reader import Bvh
from exported_worms import worm, worm_motion, worm_rig  # noqa: F401 -- fixtures
from glb_reader import Glb
from model_bodies import worm_model
from scipy.spatial.transform import Rotation

from model.export.cli import export
from model.export.conventions import aim_bones, for_programs
from model.export.correctives import motion_correctives
from model.export.glb import encode_skinned_glb
from model.export.names import names_of
from model.posing.cli import mesh
from model.rig import change_root
from model.statue.control.files import humanoid
from scanprep.command_line import run
from scanprep.geometry import rotations
from scanprep.geometry.files import read_mesh
from scanprep.geometry.format_glb import turn_up
from scanprep.pictures.camera import stance
from scanprep.skeleton.tree import Skeleton


@pytest.fixture(scope="module")
def person():
    return humanoid().rig


def swaying(rig, frames=6):
    rng = np.random.default_rng(1)
    return 0.3 * rng.normal(size=(frames, len(rig.skeleton.parents), 3)), rng.normal(size=(frames, 3))


@pytest.mark.parametrize("root", ["part0", "part1", "part2", "part3"])
def test_another_root_moves_the_same_surface(rig, motion, root):
    poses, trans = motion
    other, turned, moved = change_root(rig, poses, trans, root)
    assert other.skeleton.names[0] == root and set(other.skeleton.names) == set(rig.skeleton.names)
    assert np.abs(other.vertices(turned, moved) - rig.vertices(poses, trans)).max() < 1e-12

    def links(one):
        return {frozenset((name, one.skeleton.names[p])): tuple(np.round(one.skeleton.joints[j], 12))
                for j, (name, p) in enumerate(zip(one.skeleton.names, one.skeleton.parents, strict=True)) if j}

    assert links(other) == links(rig), "the joints between parts stay where they are"
    inside = other.skeleton.part_of_vertex(rig.mesh) == 0
    assert np.allclose(other.skeleton.joints[0], rig.mesh.vertices[inside].mean(axis=0), atol=1e-12)
    back, again, places = change_root(other, turned, moved, "part0")
    assert np.abs(rotations.exp(again[:, [back.skeleton.names.index(n) for n in rig.skeleton.names]])
                  - rotations.exp(poses)).max() < 1e-9
    assert np.abs(places + back.skeleton.joints[0] - trans - rig.skeleton.joints[0]).max() < 1e-2     # the centroid
    still = change_root(rig, poses[:0], trans[:0], root)
    assert still[1].shape == (0, 4, 3) and still[2].shape == (0, 3)


def test_bones_of_any_axes_show_the_same(rig, motion):
    axes = rotations.exp(np.random.default_rng(5).normal(size=(4, 3)))
    subject = worm_model().subject(np.array([0.5, -1.0]))
    rig = replace(rig, correctives=motion_correctives(rig, subject, motion[0]))
    other, plain = Glb(encode_skinned_glb(replace(rig, axes=axes), *motion, 4.0)), Glb(encode_skinned_glb(rig, *motion,
                                                                                                          4.0))
    assert np.abs(other.skinned() - plain.skinned()).max() < 1e-6
    U = turn_up(2)
    for t in range(5):
        assert np.abs(other.skinned(t) - plain.skinned(t)).max() < 1e-5
    world = other.matrices()
    for j in range(4):
        assert np.abs(world[j + 1][:3, :3] - U @ axes[j]).max() < 1e-6
        assert np.abs(world[j + 1][:3, 3] - U @ rig.skeleton.joints[j]).max() < 1e-6


def test_bones_point_along_the_limbs(person):
    rig = aim_bones(person, 2)
    names, joints = rig.skeleton.names, rig.skeleton.joints
    assert np.allclose(np.linalg.det(rig.axes), 1)
    for part, child in (("humanoid_root", "vl5"), ("vl5", "skullbase"), ("l_shoulder", "l_elbow"),
                        ("l_elbow", "l_wrist"), ("r_hip", "r_knee"), ("r_knee", "r_ankle")):
        way = joints[names.index(child)] - joints[names.index(part)]
        assert np.allclose(rig.axes[names.index(part)][:, 1], way / np.linalg.norm(way)), part
    vertical, ahead = stance(person.mesh, vertical=np.eye(3)[2])
    aside = np.cross(vertical, ahead)
    for part in ("l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle"):
        assert rig.axes[names.index(part)][:, 0] @ aside < -0.9, "the hinge of a leg points to the right"
    for name in (n for n in names if n.startswith("l_")):
        left, right = rig.axes[names.index(name)], rig.axes[names.index("r" + name[1:])]
        mirror = np.eye(3) - 2 * np.outer(aside, aside)
        assert np.allclose(mirror @ left[:, 1:], right[:, 1:], atol=0.05), "of both sides mirror each other"
    # heads are ahead of the nape
    assert rig.axes[names.index("skullbase")][:, 1] @ vertical > 0.85, "a leaf points to the end of its surface"


def chain(*names, places=()):
    """A skeleton of parts in a row along x, at some places or 1 m apart, metres."""
    n = len(names)
    x = np.array(places) if places else np.arange(n)
    return Skeleton(np.arange(n), np.arange(-1, n - 1), np.c_[x, 0 * x, 0 * x], names)


def test_names_of_other_programs():
    parts = chain("pelvis", "abdomen", "chest", "head", "upper_arm_left", "hand_right", "thigh_right", "shin_left",
                  "tail")
    assert names_of(parts, "mixamo") == {
        "pelvis": "mixamorig:Hips", "abdomen": "mixamorig:Spine", "chest": "mixamorig:Spine1",
        "head": "mixamorig:Head", "upper_arm_left": "mixamorig:LeftArm", "hand_right": "mixamorig:RightHand",
        "thigh_right": "mixamorig:RightUpLeg", "shin_left": "mixamorig:LeftLeg"}
    assert names_of(parts, "opensim") == {
        "pelvis": "pelvis", "chest": "torso", "head": "head", "upper_arm_left": "humerus_l", "hand_right": "hand_r",
        "thigh_right": "femur_r", "shin_left": "tibia_l"}
    four = chain("pelvis", *(f"{limb}{k}_left" for limb in ("arm", "leg") for k in (1, 2, 3, 4)),
                 places=(0, 0.1, 0.2, 0.5, 0.8, 1.0, 1.2, 1.45, 1.9))                # a clavicle, a thigh in two pieces
    assert names_of(four, "vrm") == dict(zip((n for n in four.names if n != "leg2_left"), [
        "hips", "leftShoulder", "leftUpperArm", "leftLowerArm", "leftHand", "leftUpperLeg", "leftLowerLeg",
        "leftFoot"], strict=True))
    with pytest.raises(ValueError, match=r"names: expected a person's parts .* found part0, part1"):
        names_of(chain("part0", "part1"), "vrm")


@pytest.mark.parametrize("turn", [0.0, 1.1, -2.5])
def test_soles_on_the_ground_and_face_to_the_viewer(person, turn):
    """However it stood before: z up and -y to the viewer, which is y up and +z in GLB."""
    R = rotations.exp(np.array([0, 0, turn]))
    poses, trans = swaying(person)
    poses[:, 0] *= 0.1
    before = person.transform(R, np.array([3.0, 4, 5]))
    turns = poses @ R.T
    turns[:, 0] = rotations.log(rotations.exp(turns[:, 0]) @ rotations.exp(np.array([0, 0, 2.0])))
    rig, new, places = for_programs(before, turns, trans, 2, "vl5", None, ground=True, front=True)
    assert rig.mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-12)
    assert np.allclose(stance(rig.mesh, vertical=np.eye(3)[2])[1], [0, -1, 0], atol=1e-6)
    shown = rig.vertices(new, places)
    assert shown[..., 2].min() == pytest.approx(0, abs=1e-12)
    ahead = rig.skeleton.part_rotations(new)[:, rig.skeleton.names.index("humanoid_root")].mean(axis=0) @ [0, -1, 0]
    assert ahead[1] < 0 and abs(ahead[0]) < 1e-3 * abs(ahead[1])
    old = before.vertices(turns, trans)
    apart = np.linalg.norm(old[:, :, None, :][:, ::200] - old[:, None, ::200], axis=-1)
    assert np.allclose(np.linalg.norm(shown[:, ::200, None] - shown[:, None, ::200], axis=-1), apart, atol=1e-9)
    glb = Glb(encode_skinned_glb(rig, new, places))
    assert glb.skinned()[:, 1].min() == pytest.approx(0, abs=1e-6)


@pytest.fixture(scope="module")
def files(model, motion, tmp_path_factory):
    folder = tmp_path_factory.mktemp("export")
    named = replace(model, skeleton=replace(model.skeleton, names=("chest", "pelvis", "head", "tail")))
    named.save(folder / "named.npz")
    model.save(folder / "model.npz")
    np.savez(folder / "motion.npz", poses=motion[0].reshape(5, -1), trans=motion[1], betas=np.array([0.5, -1.0]),
             mocap_frame_rate=np.array(4.0), surface_model_type=np.array("scape"))
    return folder


def test_the_command_has_root_names_ground_and_front(files, model, rig, motion):
    told = []
    for name in ("a.glb", "b.bvh"):
        assert run(export, "scape model export", [
            str(files / "named.npz"), "-o", str(files / name), "--motion", str(files / "motion.npz"), "--root",
            "pelvis", "--names", "mixamo", "--ground", "--up", "y"]) == 0
        told.append({m["metric"]: m["value"] for path in files.glob(f"{name[0]}*.json")
                     for m in json.loads(path.read_text())["metrics"]})
        assert told[-1]["root"] == "mixamorig:Hips" and told[-1]["parts without a name of mixamo"] == "tail"
    glb, bvh = Glb((files / "a.glb").read_bytes()), Bvh((files / "b.bvh").read_text())
    assert glb.json["nodes"][1]["name"] == "mixamorig:Hips" == bvh.names[0]
    exact = model.subject(np.array([0.5, -1.0])).vertices(*motion)
    exact = exact - [0, rig.vertices(*motion)[..., 1].min(), 0]
    off = [1000 * np.linalg.norm(glb.skinned(t) - exact[t], axis=1) for t in range(5)]
    assert np.mean(off) == pytest.approx(told[0]["distance from exact body, mean"], rel=1e-2) and np.mean(off) < 1
    for t in range(5):
        world, places = glb.matrices(t), bvh.positions(t)
        for j, node in enumerate(glb.json["nodes"][1:], 1):
            assert np.abs(world[j][:3, 3] - 0.01 * places[node["name"]]).max() < 1e-5


@pytest.mark.parametrize("name", ["d.ply", "d.glb"])
def test_a_mesh_stands_on_the_ground_and_looks_at_the_viewer(files, model, name):
    arguments = [str(files / "model.npz"), "-o", str(files / name), "--own-body"]
    assert run(mesh, "scape model mesh", [*arguments, "--ground", "--front"]) == 0
    body = read_mesh(files / name, "m")
    up = int(np.ptp(model.template.vertices, axis=0).argmax())
    assert body.vertices[:, up].min() == pytest.approx(0, abs=1e-7)
    # the front is that of the template; a worm has hardly any, so it is not sought again on what was written
    own = model.subject(None).vertices(np.zeros((len(model.skeleton.parents), 3)))
    turn = Rotation.align_vectors(body.vertices - body.vertices.mean(axis=0), own - own.mean(axis=0))[0]
    ahead = turn.apply(stance(model.template, vertical=np.eye(3)[up])[1])
    assert ahead @ turn_up(up).T @ [0, 0, 1] == pytest.approx(1, abs=1e-9)
