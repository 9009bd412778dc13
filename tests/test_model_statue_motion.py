"""A statue in motion: motions of its own parts, of the synthetic people, and of BVH files."""
from dataclasses import replace

import numpy as np
import pytest
from quiet_pictures import small_pictures  # noqa: F401 -- fixture

from completion.__main__ import main
from completion.motion import Motion
from completion.viewing.files import Files
from model.export.bvh import write_bvh
from model.motion.bvh import read_bvh
from model.motion.files import skeleton_arrays
from model.motion.onto import read_motion
from model.rig import joint_places
from model.statue.control.files import humanoid
from model.statue.control.model import MEASURED, DisplacementMap, Statue
from model.statue.files import body_model, save_statue
from model.statue.motion.motions import (
    bvh_motion,
    people_motion,
    read_statue_motion,
    write_body_motion,
)
from scanprep.geometry import rotations
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import PARTS, SyntheticPerson, find_pose, synthesise_walk

GENERIC = np.zeros((17, 3))
NAMES = humanoid().skeleton.names
SHARED = {"humanoid_root": 0, "skullbase": 3, "l_shoulder": 4, "l_elbow": 5, "l_wrist": 6, "r_shoulder": 7,
          "r_elbow": 8, "r_wrist": 9, "l_hip": 10, "l_knee": 11, "l_ankle": 12, "r_hip": 13, "r_knee": 14,
          "r_ankle": 15}


def scanned(turn=(0, 0, 0)):
    """The humanoid as fitted to a scan in another pose and place, and how its parts were turned."""
    control = humanoid()
    pose = people_motion(control, GENERIC, find_pose("lunge_left")[None]).poses[0]
    pose[0] = rotations.log(rotations.exp(np.array(turn, float)) @ rotations.exp(pose[0]))
    trans = np.array([2.0, -1.0, 0.5])
    return control.refit(control.rig.vertices(pose, trans), joint_places(control.skeleton, pose, trans)), pose


def world(control, motion):
    return control.skeleton.part_rotations(motion.poses)


def test_a_motion_of_its_own_parts(tmp_path):
    """In the file trans is the travel of the centroid of the root part, as in body models."""
    control, rng = humanoid(), np.random.default_rng(0)
    motion = people_motion(control, GENERIC, *synthesise_walk(4, 4), 25.0)
    motion = replace(motion, poses=rng.normal(0, 0.3, (4, 17, 3)), trans=rng.normal(size=(4, 3)))
    write_body_motion(tmp_path / "a.npz", control, motion)
    again, _ = read_statue_motion(statue_of(control), tmp_path / "a.npz")
    assert np.array_equal(again.poses, motion.poses) and again.rate == 25
    assert np.abs(again.trans - motion.trans).max() < 1e-12
    body = body_model(control)
    stored = read_motion(tmp_path / "a.npz", body)
    skinned = control.rig.vertices(motion.poses, motion.trans)
    assert np.abs(skinned - body.vertices(stored.poses, None, stored.trans)).max() < 1e-9
    assert np.linalg.norm(stored.trans - motion.trans, axis=1).max() > 1e-3, "the middle of the root part moves"
    good = dict(np.load(tmp_path / "a.npz"))
    for change, words in (({"part_parents": good["part_parents"][::-1]}, r"b\.npz.*parents"),
                          ({"poses": np.zeros((4, 48))}, "part_parents"), ({"trans": np.zeros((3, 3))}, "trans"),
                          ({"trans": good["trans"] * np.nan}, "finite"), ({"mocap_frame_rate": np.array(0.0)}, "rate")):
        np.savez(tmp_path / "b.npz", **{**good, **change})
        with pytest.raises(StorageError, match=words):
            read_statue_motion(statue_of(control), tmp_path / "b.npz")


def test_parts_turn_in_the_world_as_those_of_the_people():
    control, person = humanoid(), SyntheticPerson()
    poses = np.stack([find_pose("lunge_left"), find_pose("surrender")])
    poses[1, 2] = 0                                             # the trunk turns in one joint
    found = people_motion(control, GENERIC, poses)
    R, theirs = world(control, found), person.skeleton.part_rotations(poses)
    for name, part in SHARED.items():
        assert np.abs(R[:, NAMES.index(name)] - theirs[:, part]).max() < 1e-9, name
        assert found.matched[name] == PARTS[part]
    assert np.abs(R[1, NAMES.index("vl5")] - theirs[1, 2]).max() < 1e-9
    assert found.lacking == ("l_sternoclavicular", "r_sternoclavicular")


def test_clavicles_rise_with_arms_above_the_horizontal():
    """By a fifth of what the upper arm rises above the horizontal."""
    control = humanoid()
    found = people_motion(control, GENERIC, np.stack([find_pose(name) for name in ("rest", "t_pose", "arms_up")]))
    hanging = found.poses.copy()
    hanging[:, [NAMES.index(f"{side}_sternoclavicular") for side in "lr"]] = 0
    places, low = (joint_places(control.skeleton, poses)[2] for poses in (found.poses, hanging))
    trunk_up = (low[[4, 8]] - low[[11, 14]]).mean(axis=0)
    for side in "lr":
        clavicle, arm, elbow = (NAMES.index(f"{side}_{n}") for n in ("sternoclavicular", "shoulder", "elbow"))
        bone = places[elbow] - places[arm]
        above = np.arcsin(bone @ trunk_up / np.linalg.norm(bone) / np.linalg.norm(trunk_up))
        assert not found.poses[:2, clavicle].round(9).any()
        assert np.linalg.norm(found.poses[2, clavicle]) == pytest.approx(0.2 * above)
        assert places[arm, 2] > low[arm, 2] + 0.02


@pytest.mark.parametrize("turn", [(0, 0, 0.7), (np.pi / 2, 0, 0)])
def test_the_pose_of_the_scan_does_not_matter(turn):
    """Joints go the same ways, in the scan's axes, whatever the pose that the statue was scanned in."""
    poses, trans = synthesise_walk(20, 20)
    plain = people_motion(humanoid(), GENERIC, poses, trans, 20)
    control, pose = scanned(turn)
    found = people_motion(control, pose, poses, trans, 20)
    ways = joint_places(control.skeleton, found.poses, found.trans)
    expected = joint_places(humanoid().skeleton, plain.poses, plain.trans)
    steps, R = np.diff(expected, axis=0), rotations.exp(np.array(turn, float))
    lunge = people_motion(humanoid(), GENERIC, find_pose("lunge_left")[None]).poses[0, 0]
    heading = rotations.exp(lunge) @ [0, -1, 0]                 # walks where the scan faces
    about = np.arctan2(heading[0], -heading[1])
    R = R @ rotations.exp(np.array([0, 0, about]))
    assert np.abs(np.diff(ways, axis=0) - steps @ R.T).max() < 1e-9
    up = R[:, 2]
    lowest = (control.rig.vertices(found.poses, found.trans) @ up).min(axis=1)
    assert np.percentile(lowest, 5) == pytest.approx((control.mesh.vertices @ up).min(), abs=1e-9)
    hips = control.skeleton.joints[[11, 14]].mean(axis=0)
    off = ways[0, [11, 14]].mean(axis=0) - hips
    assert np.abs(off - (off @ up) * up).max() < 1e-9


def test_a_bvh_that_was_exported_drives_the_statue(tmp_path):
    control, person = humanoid(), SyntheticPerson()
    poses, trans = synthesise_walk(12, 12)
    write_bvh(tmp_path / "walk.bvh", person.skeleton, poses, trans, 12, "in", body=person.mesh)
    found = bvh_motion(control, GENERIC, read_bvh(tmp_path / "walk.bvh", "in"))
    direct = people_motion(control, GENERIC, poses, trans, 12)
    turned = np.swapaxes(world(control, found), -1, -2) @ world(control, direct)
    angles = np.degrees(np.linalg.norm(rotations.log(turned), axis=-1))
    assert angles.max() < 5, "the rest poses differ by as much as the two skeletons do"
    assert np.abs(found.trans - direct.trans).max() < 0.02


def statue_of(control, pose=GENERIC):
    flat = DisplacementMap(np.zeros((16, 16), np.float32), np.full((16, 16), MEASURED, np.uint8))
    return Statue(control, pose, flat)


def humanoid_in_t_pose():
    """The humanoid with level arms at rest, as a statue of a T-pose, and how its parts were turned."""
    control = humanoid()
    pose = people_motion(control, GENERIC, find_pose("t_pose")[None]).poses[0]
    return control.refit(control.rig.vertices(pose), joint_places(control.skeleton, pose)), pose


def upper_arms(control, motion):
    """Directions (T, 2, 3) of the upper arms."""
    places = joint_places(control.skeleton, motion.poses, motion.trans)
    shoulders, elbows = ([NAMES.index(f"{side}_{joint}") for side in "lr"] for joint in ("shoulder", "elbow"))
    bones = places[:, elbows] - places[:, shoulders]
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


def test_a_motion_of_an_a_pose_statue_moves_one_in_t_pose_alike(tmp_path):
    """Matched by the rest pose in the file: the arms hang as they did, and do not stand out at shoulder height."""
    control, (other, pose) = humanoid(), humanoid_in_t_pose()
    walk = people_motion(control, GENERIC, *synthesise_walk(12, 12), 12.0)
    write_body_motion(tmp_path / "walk.npz", control, walk)
    moved, doubts = read_statue_motion(statue_of(other, pose), tmp_path / "walk.npz")
    cosine = (upper_arms(control, walk) * upper_arms(other, moved)).sum(axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 5 and not doubts
    same, _ = read_statue_motion(statue_of(control), tmp_path / "walk.npz")
    np.testing.assert_allclose(same.poses, walk.poses, atol=1e-9)


def test_a_motion_of_a_model_with_other_parts_in_another_order_is_told_by_its_names(tmp_path):
    """As the demo writes it: sixteen parts like the synthetic people's, but not in their order."""
    person = SyntheticPerson()
    poses, trans = synthesise_walk(12, 12)
    wanted = people_motion(humanoid(), GENERIC, poses, trans, 12.0)
    # the legs before the arms
    order = [0, 1, 2, 3, *range(10, 16), *range(4, 10)]
    parents = np.array([-1 if p < 0 else order.index(p) for p in person.skeleton.parents[order]])
    names = [person.skeleton.names[j] for j in order]
    skeleton = Skeleton(np.arange(16), parents, person.skeleton.joints[order], names)
    motion = Motion(poses[:, order], trans, None, 12.0, np.zeros((12, 0)))
    motion.save(tmp_path / "told.npz", **skeleton_arrays(skeleton))
    moved, doubts = read_statue_motion(statue_of(humanoid()), tmp_path / "told.npz")
    cosine = (upper_arms(humanoid(), wanted) * upper_arms(humanoid(), moved)).sum(axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 10 and not doubts
    off = humanoid().rig.vertices(moved.poses, moved.trans) - humanoid().rig.vertices(wanted.poses, wanted.trans)
    off -= off.mean(axis=(0, 1))
    assert np.linalg.norm(off, axis=-1).mean() < 0.03
    # without its skeleton it is refused, with the way
    motion.save(tmp_path / "silent.npz")
    with pytest.raises(StorageError, match=r"does not say which skeleton its 16 parts are of.*scape animate.*BVH"):
        read_statue_motion(statue_of(humanoid()), tmp_path / "silent.npz")


def test_key_poses_move_a_statue_from_the_command_line(tmp_path, capsys):
    save_statue(tmp_path / "statue", statue_of(humanoid()))
    keys = tmp_path / "keys.csv"
    keys.write_text("time,l_shoulder_rx,l_shoulder_ry,l_shoulder_rz,trans_z\n0,0,0,0,0\n1,0,-80,0,0.2\n")
    words = ["statue", "animate", str(tmp_path / "statue"), str(keys), "-o", str(tmp_path / "out"), "--level", "0"]
    assert main([*words, "--rate", "10"]) == 0
    with np.load(tmp_path / "out" / "motion.npz") as stored:
        assert stored["part_names"].tolist() == list(NAMES) and stored["poses"].shape == (11, 51)
        np.testing.assert_allclose(np.degrees(stored["poses"].reshape(11, 17, 3)[5, NAMES.index("l_shoulder")]),
                                   [0, -40, 0], atol=1e-4)
        assert stored["trans"][-1, 2] == pytest.approx(0.2, abs=0.01)
    # what was written opens in the viewer, on its own body
    entry = Files((tmp_path / "out",)).entries()[0]
    assert entry.load().shapes
    capsys.readouterr()
    keys.write_text("time,upper_arm_left_rx\n0,0\n1,40\n")
    assert main(words) == 1
    assert "of the parts humanoid_root, vl5" in capsys.readouterr().err
    keys.write_text("time,l_shoulder_rx\n0,0\n1,1.5\n")
    assert main(words) == 0
    assert "if the table has radians" in capsys.readouterr().err
