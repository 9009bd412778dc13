"""Motions of files on models: our own come back, those of other skeletons point the same way."""
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
import pytest
from model_bodies import worm, worm_model
from people_bodies import small_people

from model.export.bvh import write_bvh
from model.export.cli import export
from model.export.conventions import for_programs
from model.export.rig import joint_places, make_rig
from model.features import linear_features
from model.files import load_model
from model.motion import amass
from model.motion.bvh import read_bvh
from model.motion.error import followed
from model.motion.files import read_motion_file
from model.motion.onto import read_motion
from model.motion.retarget import Pairing
from model.motion.standing import standing_rest
from model.motion.trunks import nearest_starts
from model.posing.cli import read_subject
from model.skinning import SkinningModel
from model.statue.control.files import humanoid
from model.statue.control.model import Statue
from model.statue.files import body_model
from model.statue.motion.motions import read_statue_motion
from scanprep.command_line import run
from scanprep.geometry import rotations
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import random_pose, walk

FRAMES = 8
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])      # from the axes of the people to those of files
OTHERS = {"pelvis": "Hips", "abdomen": "LowerBack", "chest": "Spine1", "head": "Head",
          **{f"{s}_{ours}": side + theirs for s, side in (("l", "Left"), ("r", "Right")) for ours, theirs in
             (("upper_arm", "Arm"), ("forearm", "ForeArm"), ("hand", "Hand"), ("thigh", "UpLeg"), ("shin", "Leg"),
              ("foot", "Foot"))}}


@lru_cache(maxsize=1)
def random_poses():
    rng = np.random.default_rng(5)
    return np.array([random_pose(rng) for _ in range(FRAMES)])


def degrees(a, b):
    """The largest angle between poses."""
    return np.degrees(np.linalg.norm(rotations.compose(-a.reshape(-1, 3), b.reshape(-1, 3)), axis=1)).max()


def apart(a, b):
    """Mean distance of surfaces (T, N, 3) whose middles are laid on each other in each frame, millimetres."""
    a, b = a - a.mean(axis=1, keepdims=True), b - b.mean(axis=1, keepdims=True)
    return 1000 * np.linalg.norm(a - b, axis=2).mean()


def with_names_of_parts(model):
    """The people with names as `scape prep skeleton` gives them."""
    sides = {"l": "left", "r": "right"}
    names = [f"{name[2:]}_{sides[name[0]]}" if name[1] == "_" else name for name in model.skeleton.names]
    return replace(model, skeleton=replace(model.skeleton, names=tuple(names)))


@pytest.mark.parametrize(("unit", "how"), [
    ("cm", {}), ("in", {}), ("cm", {"root": "chest"}), ("m", {"names": "mixamo"}), ("mm", {"names": "h-anim"}),
    ("cm", {"names": "vrm", "root": "chest"})])
def test_our_motion_comes_back_from_bvh(tmp_path, unit, how):
    model, rng = with_names_of_parts(small_people()), np.random.default_rng(0)
    poses, trans = random_poses(), rng.normal(size=(FRAMES, 3))
    rig, moved, places = for_programs(make_rig(model, np.zeros(1)), poses, trans, 2, **how)
    write_bvh(tmp_path / "a.bvh", rig.skeleton, moved, places, 30.0, unit, 2, rig.mesh)
    found = read_motion(tmp_path / "a.bvh", model)              # the unit is not said: lengths tell
    assert degrees(found.poses, poses) < 1e-4 and found.rate == pytest.approx(30)
    if "names" in how:
        thigh = {"mixamo": "mixamorig:LeftUpLeg", "h-anim": "l_hip", "vrm": "leftUpperLeg"}[how["names"]]
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
    model, (poses, trans) = small_people(), walk(20, 20)
    rig = make_rig(model, np.array([1.5, -1.0]))
    write_bvh(tmp_path / "a.bvh", rig.skeleton, poses, trans, 20.0, body=rig.mesh)
    found = read_motion(tmp_path / "a.bvh", model)
    assert degrees(found.poses, poses) < 1e-4
    body = model.subject(np.zeros(1))
    soles = body.vertices(np.zeros((16, 3)))[:, 2].min()
    assert np.percentile(body.vertices(found.poses, found.trans)[..., 2].min(axis=1), 5) == pytest.approx(soles)
    assert np.ptp(found.trans[:, 1]) == pytest.approx(found.brought.scale * np.ptp(trans[:, 1]), rel=0.05)


def elsewhere(tmp_path, poses, trans, scale=39.37):
    """The motion of the mean person as somebody else has it: arms level at rest, other names, one more joint in the
    trunk, fingers, turned about the vertical, in another unit; the path of the BVH.
    """
    rig = make_rig(small_people(), np.zeros(1))
    names, parents, J = list(rig.skeleton.names), rig.skeleton.parents, rig.skeleton.joints
    A = np.tile(np.eye(3), (16, 1, 1))
    for side, sign in (("l", 1), ("r", -1)):
        arm = [names.index(f"{side}_{part}") for part in ("upper_arm", "forearm", "hand")]
        bone = J[arm[1]] - J[arm[0]]
        A[arm] = rotations.exp(np.array([0, -sign * np.arctan2(-bone[2], abs(bone[0])), 0]))
    R = rig.skeleton.part_rotations(poses) @ np.swapaxes(A, -1, -2)
    rest = joint_places(rig.skeleton, rig.skeleton.pose_of(A))
    Q = rotations.exp(np.array([0, 1.1, 0])) @ Y_UP
    chest, hand = names.index("chest"), names.index("l_hand")
    middle = (rest[names.index("abdomen")] + rest[chest]) / 2
    # the abdomen in two joints that turn alike, and a finger that turns on its own
    order = [*range(chest), 16, *range(chest, 16), 17]
    above = np.array([*parents, names.index("abdomen"), hand])
    above[chest] = 16
    rest = np.vstack([rest, middle, rest[hand] + [0.08, 0, 0]])
    R = np.concatenate([R, R[:, [names.index("abdomen")]], R[:, [hand]] @ rotations.exp(np.array([0.4, 0, 0]))], axis=1)
    number, called = np.argsort(order), [*(OTHERS[name] for name in names), "Spine", "LeftHandIndex1"]
    tree = Skeleton(np.arange(18), np.array([-1 if above[j] < 0 else number[above[j]] for j in order]),
                    (rest @ Q.T)[order], tuple(called[j] for j in order))
    moved = (Q @ R @ Q.T)[:, order]
    write_bvh(tmp_path / "theirs.bvh", replace(tree, joints=scale * tree.joints), tree.pose_of(moved),
              scale * (trans @ Q.T), 24.0, "m", 1)
    return tmp_path / "theirs.bvh"


def test_another_skeleton_points_the_same_way_on_another_body(tmp_path):
    model, trans = small_people(), np.zeros((FRAMES, 3))
    poses = random_poses()
    path = elsewhere(tmp_path, poses, trans)
    found = read_motion(path, model)
    mean = model.subject(np.zeros(1))
    assert degrees(found.poses, poses) < 0.05, "whatever way the file is turned, it faces where the body did at rest"
    assert apart(mean.vertices(found.poses, found.trans), mean.vertices(poses)) < 0.01
    assert found.brought.scale == pytest.approx(2.54, rel=1e-3) and not found.brought.lacking
    assert found.brought.matched["abdomen"] == "LowerBack to Spine" and found.brought.matched["l_shin"] == "LeftLeg"
    heavy = model.subject(np.array([1.5, -1.0]))
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
    exact = followed(pair, poses, joint_places(rig.skeleton, poses))
    assert exact.angle < 1e-4 and exact.distance < 1e-7 and exact.lean < 1e-4
    bent, elbow = poses.copy(), rig.skeleton.names.index("l_elbow")
    R = rotations.exp(poses[:, elbow]) @ rotations.exp(np.array([0, 0, np.radians(20)]))
    bent[:, elbow] = rotations.log(R)
    off = followed(pair, bent, joint_places(rig.skeleton, bent))
    where = [name for name, angle in zip(off.names, off.angles.max(axis=0), strict=True) if angle > 1e-3]
    bone = rig.skeleton.joints[elbow + 1] - rig.skeleton.joints[elbow]
    assert where == ["l_wrist"] and off.distances[:, off.names.index("l_wrist")].max() > 0.01
    across = np.linalg.norm(np.cross(bone, [0, 0, 1])) / np.linalg.norm(bone)
    turned = 2 * np.degrees(np.arcsin(across * np.sin(np.radians(10))))
    assert off.angles[:, off.names.index("l_wrist")] == pytest.approx(turned, abs=1e-4)


def of_amass(poses, up=2):
    """The 22 joints of a motion of the mean person in a T-pose of its own, as AMASS has them: poses (T, 22, 3)."""
    ours = make_rig(small_people(), np.zeros(1)).skeleton
    names, rest = ours.names, amass.t_pose()
    part = dict.fromkeys(("spine1", "spine2"), "abdomen") | {"pelvis": "pelvis", "head": "head"}
    A = {}
    for side, s in (("left", "l"), ("right", "r")):
        for theirs, mine in (("hip", "thigh"), ("knee", "shin"), ("ankle", "foot"), ("foot", "foot"),
                             ("shoulder", "upper_arm"), ("elbow", "forearm"), ("wrist", "hand")):
            part[f"{side}_{theirs}"] = f"{s}_{mine}"
        for chain in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle")):
            R = Y_UP
            for a, b in pairwise(chain):
                i, k = (names.index(part[f"{side}_{end}"]) for end in (a, b))
                there = rest[amass.NAMES.index(f"{side}_{b}")] - rest[amass.NAMES.index(f"{side}_{a}")]
                bone = R @ (ours.joints[k] - ours.joints[i])
                axis = np.cross(bone, there)
                angle = np.arctan2(np.linalg.norm(axis), bone @ there)
                R = rotations.exp(angle * axis / np.linalg.norm(axis)) @ R
                A[f"{side}_{a}"] = R
            if chain[2] == "wrist":
                A[f"{side}_wrist"] = R
    world = ours.part_rotations(poses)
    R = np.stack([world[:, names.index(part.get(name, "chest"))] @ A.get(name, Y_UP).T for name in amass.NAMES], axis=1)
    if up == 1:
        R = Y_UP @ R
    return Skeleton(np.arange(22), amass.PARENTS, rest, amass.NAMES).pose_of(R)


@pytest.mark.parametrize("form", ["poses 52", "poses 24", "pieces 55", "y up"])
def test_amass_motions_point_the_same_way(tmp_path, form):
    model, poses = small_people(), random_poses()
    body = of_amass(poses, 1 if form == "y up" else 2)
    whole = np.zeros((FRAMES, 24 if form == "poses 24" else 52, 3))
    whole[:, :22] = body
    flat = whole.reshape(FRAMES, -1)
    told = {"poses": flat} if form != "pieces 55" else {
        "root_orient": flat[:, :3], "pose_body": flat[:, 3:66], "pose_jaw": np.zeros((FRAMES, 3)),
        "pose_eye": np.zeros((FRAMES, 6)), "pose_hand": flat[:, 66:], "surface_model_type": "smplx"}
    np.savez(tmp_path / "a.npz", **told, trans=np.zeros((FRAMES, 3)), betas=np.r_[0.5, np.zeros(15)],
             gender=np.array("female", dtype=object), mocap_framerate=120.0, labels=np.array(["A", None], dtype=object))
    found = read_motion(tmp_path / "a.npz", model)
    assert "T-pose" in found.rest and found.rate == 120 and not found.brought.lacking
    mean = model.subject(np.zeros(1))
    assert apart(mean.vertices(found.poses, found.trans), mean.vertices(poses)) < 4, "but for the bend of the trunk"
    limbs = [j for j, name in enumerate(model.skeleton.names) if name[1] == "_"]
    R, truth = (model.skeleton.part_rotations(some)[:, limbs] for some in (found.poses, poses))
    assert degrees(rotations.log(R), rotations.log(truth)) < 0.2, "the front of learned people is that much aside"
    statue = Statue(humanoid(), np.zeros((17, 3)), None)
    moved = read_statue_motion(statue, tmp_path / "a.npz")
    shin = humanoid().skeleton.names.index("l_knee")
    there = rotations.log(humanoid().skeleton.part_rotations(moved.poses)[:, shin])
    assert degrees(there, rotations.log(truth[:, limbs.index(model.skeleton.names.index("l_shin"))])) < 10


def family_model(tmp_path, kind="smplh"):
    """A body of 24 joints that stands for one imported from the family: a tube in slices, in the family's tree."""
    mesh, parents = worm(60, 6), np.r_[amass.PARENTS, 20, 21]
    middle = mesh.corners.mean(axis=1)[:, 0]
    part = np.searchsorted(np.quantile(middle, np.arange(1, 24) / 24), middle)
    names = (*amass.NAMES, "left_hand", "right_hand")
    skeleton = Skeleton(part, parents, np.stack([mesh.corners.mean(axis=1)[part == j].mean(axis=0) for j in range(24)]),
                        names).with_root_centred(mesh)
    N = len(mesh.vertices)
    model = SkinningModel(mesh, skeleton, mesh.vertices, np.eye(24)[skeleton.part_of_vertex(mesh)],
                          linear_features(skeleton, (np.zeros((3, 0)),) * 24), np.zeros((0, N, 3)), mesh.vertices,
                          np.random.default_rng(0).normal(0, 0.01, (3, N, 3)), np.ones(3) / 3, 1.0, np.zeros((24, 3)),
                          np.eye(72), {"family": kind})
    model.save(tmp_path / "imported.npz")
    return load_model(tmp_path / "imported.npz")


def test_amass_on_a_model_of_its_family_is_copied_and_written_again(tmp_path, capsys):
    model, rng = family_model(tmp_path), np.random.default_rng(3)
    poses, trans = rng.normal(0, 0.4, (FRAMES, 52, 3)), rng.normal(size=(FRAMES, 3))
    np.savez(tmp_path / "amass.npz", poses=poses.reshape(FRAMES, -1), trans=trans, betas=np.r_[0.5, -1, np.zeros(14)],
             gender="male", mocap_framerate=60.0)
    found = read_motion(tmp_path / "amass.npz", model)
    assert np.array_equal(found.poses[:, :22], poses[:, :22]) and not found.poses[:, 22:].any()
    assert np.array_equal(found.trans, trans) and found.betas.tolist() == [0.5, -1, 0] and found.gender == "male"
    words = [str(tmp_path / "imported.npz"), "--motion", str(tmp_path / "amass.npz"), "-o"]
    assert run(export, "scape model export", [*words, str(tmp_path / "again.npz")]) == 0
    again = read_motion_file(tmp_path / "again.npz")
    with np.load(tmp_path / "again.npz", allow_pickle=False) as data:
        assert data["pose_body"].shape == (FRAMES, 63) and data["root_orient"].shape == (FRAMES, 3)
        assert str(data["surface_model_type"]) == "smplh" and float(data["mocap_frame_rate"]) == 60
    assert np.array_equal(again.poses, found.poses) and again.betas.tolist() == [0.5, -1, 0]
    small_people().save(tmp_path / "ours.npz")
    assert run(export, "scape model export", [str(tmp_path / "ours.npz"), *words[1:], str(tmp_path / "no.npz")]) == 1
    assert "ours.npz: a motion under the names of AMASS is one of an imported model" in capsys.readouterr().err
    assert not (tmp_path / "no.npz").exists()


def test_betas_that_a_model_lacks_count_only_where_they_are_not_zero(tmp_path):
    model = small_people()
    for betas, words in ((np.eye(16)[0], None), (np.eye(16)[15], "at most the 4 betas .* found 16")):
        np.savez(tmp_path / "m.npz", poses=np.zeros((2, 48)), trans=np.zeros((2, 3)), betas=betas, mocap_frame_rate=30)
        if words is None:
            assert read_motion(tmp_path / "m.npz", model).betas.tolist() == [1, 0, 0, 0]
            assert read_subject(model, tmp_path / "m.npz").betas.tolist() == [1, 0, 0, 0]
            continue
        for read in (read_motion, lambda path, model: read_subject(model, path)):
            with pytest.raises(StorageError, match=words):
                read(tmp_path / "m.npz", model)


GOOD = {"poses": np.zeros((2, 48)), "trans": np.zeros((2, 3)), "mocap_frame_rate": np.array(30.0)}


@pytest.mark.parametrize(("change", "words"), [
    ({"poses": np.array([None, 1], dtype=object)}, r"array poses: expected numbers or text, found Python objects"),
    ({"mocap_frame_rate": None}, "expected mocap_frame_rate or mocap_framerate, the frames a second"),
    ({"mocap_frame_rate": np.array([30.0, 60.0])}, "mocap_frame_rate: expected one number"),
    ({"poses": np.full((2, 48), np.nan)}, "poses: 96 values are not finite"),
    ({"poses": np.zeros((0, 48)), "trans": np.zeros((0, 3))}, "frames of the model's 16 parts"),
    ({"poses": np.zeros((2, 60))}, "frames of the model's 16 parts, found 20 parts"),
    ({"poses": np.zeros((2, 50))}, "three numbers each"),
    ({"poses": None}, "it lacks poses"), ({"trans": np.zeros((3, 3))}, r"trans: expected shape \(2, 3\)"),
    ({"poses": np.zeros((2, 30)), "surface_model_type": "smpl"}, "at least the 22 joints"),
    ({"surface_model_type": "mano"}, "expected surface_model_type 'scape', found 'mano'")])
def test_wrong_motions_are_refused_in_our_words(tmp_path, change, words):
    arrays = {name: value for name, value in {**GOOD, **change}.items() if value is not None}
    np.savez(tmp_path / "m.npz", **arrays)
    with pytest.raises(StorageError, match=words) as caught:
        read_motion(tmp_path / "m.npz", small_people())
    assert "m.npz" in str(caught.value) and "allow_pickle" not in str(caught.value)


def test_a_bvh_that_is_cut_in_half_names_its_line(tmp_path):
    path = elsewhere(tmp_path, random_poses(), np.zeros((FRAMES, 3)))
    text = path.read_text()
    for share in (0.1, 0.5, 0.9):
        path.write_text(text[:int(share * len(text))])
        with pytest.raises(StorageError, match=r"theirs\.bvh.*(line|frames)"):
            read_motion(path, small_people())


def test_joints_of_a_trunk_are_shared_out_by_height():
    assert nearest_starts(np.array([0.1, 0.5]), np.array([0, 0.2, 0.55, 0.9])) == [0, 2]
    assert nearest_starts(np.array([0.0, 0.9, 0.95]), np.array([0, 0.1, 0.2])) == [0, 1, 2]
    assert nearest_starts(np.array([0.0, 0.0, 0.0]), np.arange(5) / 4) == [0, 1, 2]
    assert nearest_starts(np.array([0.0]), np.arange(5) / 4) == [0]


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
    found, frame = standing_rest(moving)
    assert frame == 8 and np.abs(found.places - usual.places).max() == 0
    again = np.einsum("tjab,jb->tja", found.rotations[:, found.parents[1:]], found.offsets[1:])
    assert np.abs(again - (usual.places[:, 1:] - usual.places[:, usual.parents[1:]])).max() < 1e-9
    tree = Skeleton(np.arange(len(lying)), usual.parents, moving.rest, usual.names)
    write_bvh(tmp_path / "lying.bvh", tree, tree.pose_of(moving.rotations), usual.places[:, 0] - usual.places[:1, 0],
              24.0, "m", 1)
    read = read_motion(tmp_path / "lying.bvh", model)
    assert "frame 8, in which it stands" in read.rest
    mean = model.subject(np.zeros(1))
    assert apart(mean.vertices(read.poses, read.trans), mean.vertices(poses)) < 1
    assert standing_rest(usual) == (usual, None)
