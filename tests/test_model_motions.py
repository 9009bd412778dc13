"""Motions of files on models: our own come back, those of other skeletons point the same way."""
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from model_bodies import worm_model
from motion_files import FRAMES, Y_UP, apart, degrees, elsewhere, random_poses
from people_bodies import small_people

from model.export.bvh import write_bvh
from model.export.conventions import for_programs
from model.motion.bvh import read_bvh
from model.motion.error import measure_error
from model.motion.onto import read_motion, standing_rest
from model.motion.retarget import Pairing
from model.rig import joint_places, make_rig
from model.statue.control.files import humanoid
from model.statue.files import body_model
from scanprep.geometry import rotations
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import synthesise_walk


@pytest.mark.parametrize(("unit", "how"), [
    ("cm", {}), ("in", {}), ("cm", {"root": "chest"}), ("m", {"names": "mixamo"}), ("mm", {"names": "h-anim"}),
    ("cm", {"names": "vrm", "root": "chest"}), ("cm", {"names": "opensim"})])
def test_our_motion_comes_back_from_bvh(tmp_path, unit, how):
    model, rng = small_people(), np.random.default_rng(0)
    poses, trans = random_poses(), rng.normal(size=(FRAMES, 3))
    rig, moved, places = for_programs(make_rig(model, np.zeros(1)), poses, trans, 2, **how)
    write_bvh(tmp_path / "a.bvh", rig.skeleton, moved, places, 30.0, unit, 2, rig.mesh)
    found = read_motion(tmp_path / "a.bvh", model)              # the unit is not said: lengths tell
    assert degrees(found.poses, poses) < 1e-4 and found.rate == pytest.approx(30)
    if "names" in how:
        thigh = {"mixamo": "mixamorig:LeftUpLeg", "h-anim": "l_hip", "vrm": "leftUpperLeg",
                 "opensim": "femur_l"}[how["names"]]
        assert found.brought.matched["thigh_left"] == thigh and not found.brought.lacking
    else:
        assert np.abs(found.trans - trans).max() < 1e-6 and found.fit is None


def test_a_body_without_a_persons_names_gets_its_own_back(tmp_path):
    model, rng = worm_model(), np.random.default_rng(1)
    poses, trans = rng.normal(0, 0.3, (5, 4, 3)), rng.normal(size=(5, 3))
    rig = make_rig(model, np.zeros(1))
    write_bvh(tmp_path / "a.bvh", rig.skeleton, poses, trans, 25.0, "cm", 0, rig.mesh)
    found = read_motion(tmp_path / "a.bvh", model)
    assert degrees(found.poses, poses) < 1e-4 and np.abs(found.trans - trans).max() < 1e-6
    named = replace(rig.skeleton, names=("a", "b", "c", "d"))
    write_bvh(tmp_path / "b.bvh", named, poses, trans, 25.0, "cm", 0, rig.mesh)
    with pytest.raises(StorageError, match=r"b\.bvh: body: expected joints named like humanoid_root"):
        read_motion(tmp_path / "b.bvh", model)


def test_the_same_skeleton_of_another_person_turns_as_it_did_and_stands_on_its_feet(tmp_path):
    model, (poses, trans) = small_people(), synthesise_walk(20, 20)
    rig = make_rig(model, np.array([1.5, -1.0]))
    write_bvh(tmp_path / "a.bvh", rig.skeleton, poses, trans, 20.0, body=rig.mesh)
    found = read_motion(tmp_path / "a.bvh", model)
    assert degrees(found.poses, poses) < 1e-4
    body = model.subject(np.zeros(1))
    soles = body.vertices(np.zeros((16, 3)))[:, 2].min()
    assert np.percentile(body.vertices(found.poses, found.trans)[..., 2].min(axis=1), 5) == pytest.approx(soles)
    legs, theirs = (np.linalg.norm(np.diff(one.joints[[10, 11, 12]], axis=0), axis=1).sum()
                    for one in (body.rest_skeleton, rig.skeleton))
    assert np.ptp(found.trans[:, 1]) == pytest.approx(legs / theirs * np.ptp(trans[:, 1]), rel=0.05)


def test_another_skeleton_points_the_same_way_on_another_body(tmp_path):
    model, trans = small_people(), np.zeros((FRAMES, 3))
    poses = random_poses()
    path = elsewhere(tmp_path, poses, trans)
    found = read_motion(path, model)
    mean = model.subject(np.zeros(1))
    assert degrees(found.poses, poses) < 0.05, "whatever way the file is turned, it faces where the body did at rest"
    assert apart(mean.vertices(found.poses, found.trans), mean.vertices(poses)) < 0.01
    assert not found.brought.lacking
    assert found.brought.matched["abdomen"] == "LowerBack to Spine" and found.brought.matched["shin_left"] == "LeftLeg"
    heavy = model.subject(np.array([0.3, 1.5]))
    other = read_motion(path, model, heavy)
    assert apart(heavy.vertices(other.poses, other.trans), heavy.vertices(poses)) < 3      # bones at rest differ
    assert found.fit.angle < 3 and found.fit.distance < 0.02


def test_the_error_that_is_told_is_that_of_the_joints(tmp_path):
    model = body_model(humanoid())                              # joints of a skinned body stay on its bones
    rig = make_rig(model)
    rng = np.random.default_rng(2)
    poses = rng.normal(0, 0.2, (4, 17, 3))
    write_bvh(tmp_path / "a.bvh", rig.skeleton, poses, rate=30.0, body=rig.mesh)
    pair = Pairing(rig.skeleton, rig.vertices, read_bvh(tmp_path / "a.bvh", "cm"))
    exact = measure_error(pair, poses, joint_places(rig.skeleton, poses))
    assert exact.angle < 1e-4 and exact.distance < 1e-7 and exact.lean < 1e-4
    bent, elbow = poses.copy(), rig.skeleton.names.index("l_elbow")
    R = rotations.exp(poses[:, elbow]) @ rotations.exp(np.array([0, 0, np.radians(20)]))
    bent[:, elbow] = rotations.log(R)
    off = measure_error(pair, bent, joint_places(rig.skeleton, bent))
    where = [name for name, angle in zip(off.names, off.angles.max(axis=0), strict=True) if angle > 1e-3]
    bone = rig.skeleton.joints[elbow + 1] - rig.skeleton.joints[elbow]
    assert where == ["l_wrist"] and off.distances[:, off.names.index("l_wrist")].max() > 0.01
    across = np.linalg.norm(np.cross(bone, [0, 0, 1])) / np.linalg.norm(bone)
    turned = 2 * np.degrees(np.arcsin(across * np.sin(np.radians(10))))
    assert off.angles[:, off.names.index("l_wrist")] == pytest.approx(turned, abs=1e-4)


@pytest.mark.parametrize("joints", [1, 2, 3, 6])
def test_a_trunk_of_any_number_of_joints_brings_the_shoulders_there(tmp_path, joints):
    """Somebody bends evenly forwards and aside in so many joints; ours has two. The chest points as theirs does."""
    rest = {"Hips": (0, 0.95, 0), "Head": (0, 1.55, 0)}
    spine = [f"Spine{k}" for k in range(joints)]
    rest |= {name: (0, 1.0 + 0.3 * k / joints, 0) for k, name in enumerate(spine)}
    for side, x in (("Left", 1), ("Right", -1)):
        rest |= {f"{side}UpLeg": (0.09 * x, 0.92, 0), f"{side}Leg": (0.09 * x, 0.5, 0),
                 f"{side}Foot": (0.09 * x, 0.1, 0), f"{side}Arm": (0.18 * x, 1.43, 0),
                 f"{side}ForeArm": (0.45 * x, 1.43, 0), f"{side}Hand": (0.7 * x, 1.43, 0)}
    above = {name: before for before, name in pairwise(["Hips", *spine, "Head"])}
    for side in ("Left", "Right"):
        for before, name in pairwise([spine[-1], f"{side}Arm", f"{side}ForeArm", f"{side}Hand"]):
            above[name] = before
        for before, name in pairwise(["Hips", f"{side}UpLeg", f"{side}Leg", f"{side}Foot"]):
            above[name] = before
    names = ["Hips", *above]
    tree = Skeleton(np.arange(len(names)), np.array([-1, *(names.index(above[name]) for name in names[1:])]),
                    np.array([rest[name] for name in names]), tuple(names))
    poses, whole = np.zeros((3, len(names), 3)), np.radians([[0, 0, 0], [50, 0, 0], [20, 0, 25]])
    poses[:, [names.index(name) for name in spine]] = whole[:, None] / joints
    write_bvh(tmp_path / "a.bvh", tree, poses, rate=10.0, up=1)
    model = small_people()
    found = read_motion(tmp_path / "a.bvh", model)
    R = model.skeleton.part_rotations(found.poses)
    down = found.fit.angles[:, found.fit.names.index("shoulders")]
    assert down.max() < (10 if joints == 1 else 3), "one bend at the waist is shared by two parts"
    turned = Y_UP.T @ rotations.exp(whole) @ Y_UP
    chest = degrees(rotations.log(R[:, 2]), rotations.log(turned))
    assert chest < (0.1 if joints <= 3 else 3), "of more joints the chest has those above its own start"
    limbs = [k for k, name in enumerate(found.fit.names) if name[2:] in ("wrist", "knee", "ankle")]
    assert found.fit.angles[:, limbs].max() < 3


def test_a_file_whose_bones_lie_along_one_axis_is_read_from_a_frame_that_stands(tmp_path):
    model, poses = small_people(), np.concatenate([random_poses(), np.zeros((1, 16, 3))])
    path = elsewhere(tmp_path, poses, np.zeros((9, 3)))
    usual = read_bvh(path, "cm")
    size = np.linalg.norm(usual.offsets, axis=1)
    along = usual.offsets.copy()
    along[1:] = size[1:, None] * [1, 0, 0]
    turn = np.tile(np.eye(3), (len(along), 1, 1))                # of each joint, that its next bone lies along x
    for j, p in enumerate(usual.parents):
        if p >= 0:
            axis = np.cross(usual.offsets[j], [1, 0, 0])
            angle = np.arctan2(np.linalg.norm(axis), usual.offsets[j][0])
            turn[p] = rotations.exp(angle * axis / max(np.linalg.norm(axis), 1e-9))
    lying = np.array(usual.offsets)
    for j, p in enumerate(usual.parents):
        lying[j] = turn[p] @ usual.offsets[j] if p >= 0 else usual.offsets[j]
    moving = replace(usual, offsets=lying, rotations=usual.rotations @ np.swapaxes(turn, -1, -2))
    tree = Skeleton(np.arange(len(lying)), usual.parents, moving.rest, usual.names)
    write_bvh(tmp_path / "lying.bvh", tree, tree.pose_of(moving.rotations), usual.places[:, 0] - usual.places[:1, 0],
              24.0, "m", 1)
    read = read_motion(tmp_path / "lying.bvh", model)
    assert "frame 8, in which it stands" in read.rest
    mean = model.subject(np.zeros(1))
    assert apart(mean.vertices(read.poses, read.trans), mean.vertices(poses)) < 1
    assert standing_rest(usual) == (usual, None)
