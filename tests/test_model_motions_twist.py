"""Limbs are turned about their bones as elbows and knees bend, whatever roll the bones of a file have at rest."""
import json
from dataclasses import replace

import numpy as np
import pytest
from motion_files import apart, degrees, export_rolled, limb_bones, random_poses
from people_bodies import small_people

from completion.__main__ import main
from model.export.bvh import write_bvh
from model.motion.error import measure_twist
from model.motion.onto import read_motion
from model.motion.twist import axial
from model.rig import make_rig
from scanprep.geometry import rotations
from scanprep.synthetic.people import synthesise_walk

FRONT = np.array([0.0, -1, 0])
WALK = synthesise_walk(40, 20)
STILL = np.zeros((8, 3))
ARM = {"upper_arm": -144, "forearm": -144, "hand": -144}
LEG = {"thigh": 170, "shin": 170}
FILES = [("cmu", 0, ARM), ("mixamo", 45, ARM | LEG), ("makehuman", None, {"upper_arm": -144}), ("cmu", 0, LEG),
         ("mixamo", 45, {"upper_arm": 90, "forearm": 90, "hand": 90}), ("makehuman", 0, {"forearm": 170, "hand": 170}),
         ("cmu", 88, {"thigh": -70, "shin": 120})]


def twist_errors(poses, found, skeleton):
    """{part: mean degrees by which it is turned about its bone otherwise}."""
    R = np.swapaxes(skeleton.part_rotations(poses), -1, -2) @ skeleton.part_rotations(found)
    return {name: np.degrees(np.abs(axial(R[:, skeleton.names.index(name)], bone)).mean())
            for name, bone in limb_bones(skeleton).items()}


def twisted(poses, name, angles):
    """The poses with one part turned about its bone by some angles (T,), radians; what it carries stays."""
    skeleton = make_rig(small_people(), np.zeros(1)).skeleton
    R, j = skeleton.part_rotations(poses), skeleton.names.index(name)
    R[:, j] = R[:, j] @ rotations.exp(np.multiply.outer(angles, limb_bones(skeleton)[name]))
    return skeleton.pose_of(R)


def own_file(path, poses):
    """The file that the toolkit writes of poses."""
    rig = make_rig(small_people(), np.zeros(1))
    write_bvh(path, rig.skeleton, poses, rate=20.0, body=rig.mesh)
    return path


@pytest.mark.parametrize(("kind", "down", "rolls"), FILES)
@pytest.mark.parametrize(("poses", "trans"), [WALK, (random_poses(), STILL)])
def test_the_roll_of_the_bones_at_rest_does_not_matter(tmp_path, kind, down, rolls, poses, trans):
    model = small_people()
    path = export_rolled(tmp_path / "a.bvh", poses, trans, kind, down, rolls)
    found, mean = read_motion(path, model), model.subject(np.zeros(1))
    off = twist_errors(poses, found.poses, model.skeleton)
    assert max(off.values()) < 8, "the plane of a bend is some degrees off the axis of the model's own hinge"
    assert apart(mean.vertices(found.poses, found.trans), mean.vertices(poses)) < 5
    assert not found.twist.reasons
    for part, angle in zip(found.twist.parts, found.twist.rolled, strict=True):
        side, _, name = part.partition(" ")
        known = rolls.get(name.replace(" ", "_"), 0) * (1 if side == "left" else -1)
        assert abs((angle - known + 180) % 360 - 180) < 8 and (angle == 0) == (known == 0)


@pytest.mark.parametrize(("kind", "down"), [("cmu", 0), ("mixamo", 45), ("makehuman", None), ("cmu", 88)])
def test_a_motion_whose_bones_are_not_rolled_is_exact(tmp_path, kind, down):
    for poses, trans in (WALK, (random_poses(), STILL)):
        found = read_motion(export_rolled(tmp_path / "a.bvh", poses, trans, kind, down), small_people())
        assert degrees(found.poses, poses) < 1e-3
        assert not found.twist.reasons and not found.twist.rolled.any() and not found.twist.changed.any()
    own = read_motion(own_file(tmp_path / "own.bvh", WALK[0]), small_people())
    assert degrees(own.poses, WALK[0]) < 1e-4 and own.twist.reasons == []


def test_elbows_bend_forwards_and_knees_back(tmp_path):
    model = small_people()
    found = read_motion(export_rolled(tmp_path / "a.bvh", *WALK, "mixamo", 45, ARM | LEG), model)
    R, J = model.skeleton.part_rotations(found.poses), model.skeleton.joints
    number = {name: j for j, name in enumerate(model.skeleton.names)}
    for upper, lower, end, sign in (("upper_arm", "forearm", "hand", 1), ("thigh", "shin", "foot", -1)):
        for side in ("left", "right"):
            a, b, c = (number[f"{part}_{side}"] for part in (upper, lower, end))
            bone = np.swapaxes(R[:, a], -1, -2) @ R[:, b] @ (J[c] - J[b])
            ahead = sign * (bone @ FRONT) / np.linalg.norm(J[c] - J[b])
            assert ahead.max() > np.sin(np.radians(20)) and ahead.min() > -0.05


def test_arms_that_never_bend_are_judged_by_what_a_shoulder_can(tmp_path):
    poses = np.zeros((10, 16, 3))
    path = export_rolled(tmp_path / "a.bvh", poses, np.zeros((10, 3)), "cmu", 0, {"upper_arm": -144, "forearm": -144})
    found = read_motion(path, small_people())
    assert found.twist.twists[:, found.twist.parts.index("left upper arm")] == pytest.approx(144, abs=1)
    for side in ("left", "right"):
        assert (f"in 10 of 10 frames the {side} upper arm is twisted by 144 degrees about its axis, more than a "
                "person's") in found.twist.reasons
    assert all("upper arm" in reason for reason in found.twist.reasons)


def test_a_roll_that_the_elbow_contradicts_over_time_is_not_followed(tmp_path):
    model, poses = small_people(), WALK[0]
    spun = twisted(poses, "upper_arm_left", np.linspace(-2.0, 2.0, len(poses)))
    assert twist_errors(poses, spun, model.skeleton)["upper_arm_left"] > 50
    found = read_motion(export_rolled(tmp_path / "a.bvh", spun, WALK[1], "cmu", 0), model)
    off = twist_errors(poses, found.poses, model.skeleton)
    assert off["upper_arm_left"] < 5 and off["upper_arm_right"] < 1e-3 and off["forearm_left"] < 1e-3
    arm = model.skeleton.names.index("upper_arm_left")
    R = model.skeleton.part_rotations(found.poses)[:, arm]
    assert degrees(rotations.log(R[:-1]), rotations.log(R[1:])) < 15, "continuous"
    reason, = found.twist.reasons
    assert reason.endswith("against the bend of the left elbow, which was followed")


def test_the_verdict_of_a_copied_motion_tells_a_twisted_arm(tmp_path):
    small_people().save(tmp_path / "model.npz")
    poses = twisted(WALK[0], "upper_arm_left", np.full(len(WALK[0]), np.radians(-90)))
    rolled = export_rolled(tmp_path / "rolled.bvh", *WALK, "cmu", 0, ARM)
    verdicts = {}
    for path in (own_file(tmp_path / "own.bvh", poses), rolled):
        out = tmp_path / path.stem
        assert main(["animate", str(path), "-m", str(tmp_path / "model.npz"), "-o", str(out)]) == 0
        verdicts[path.stem] = {row["metric"]: row["value"] for row in json.loads((out / "report.json").read_text())[
            "metrics"]}
    assert verdicts["own"]["judgement"].startswith("check: in ")
    assert "beside its axis than a person's: is the left upper arm twisted?" in verdicts["own"]["judgement"]
    assert main(["model", "export", str(tmp_path / "model.npz"), "--motion", str(tmp_path / "own.bvh"), "-o",
                 str(tmp_path / "again.bvh")]) == 0
    exported = json.loads((tmp_path / "again.bvh.report.json").read_text())["judgement"]
    assert exported["verdict"] == "check" and "is the left upper arm twisted?" in exported["reasons"][0]
    assert verdicts["rolled"]["judgement"] == "good"
    assert "left upper arm -14" in verdicts["rolled"]["bones rolled otherwise at rest, allowed for"]


def test_no_twist_of_what_is_no_person():
    skeleton = replace(make_rig(small_people(), np.zeros(1)).skeleton, names=tuple("abcdefghijklmnop"))
    assert measure_twist(skeleton, np.zeros((2, 16, 3)), np.zeros((2, 16, 3))) is None
