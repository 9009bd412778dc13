"""Files for OpenSim: joint angles of known anatomical rotations, TRC, MOT, and joint centres in a C3D file."""
import numpy as np
import pytest
from completion_bodies import worm_with_prior
from people_bodies import small_people
from scipy.spatial.transform import Rotation
from test_completion_mosh_virtual import T, found, original

from completion.mocap.artefacts.results import write_virtual
from completion.mocap.files.c3d_points import add_points
from completion.mocap.files.markers import MarkerFileError, MarkerSequence, read_markers, write_markers
from completion.mocap.files.motion_files import joint_centres, write_motion_folder
from completion.mocap.files.opensim import write_mot
from completion.mocap.joint_angles import JointAngles, anatomy, angles_of, decompose, ground_axes
from completion.motion import Motion
from scanprep.geometry.rotations import exp, wrap_angle
from scanprep.synthetic.anatomy import LEG_ANGLE, LEG_LEAN, PARENTS, PARTS, BodyShape, RestFrames

__all__ = ["original"]
JOINTS = RestFrames(BodyShape()).joints                    # z is up, the face looks along -y, the left side is +x
BODY = anatomy(PARTS, PARENTS, JOINTS)
RIGHT, AHEAD, UP = np.array([-1.0, 0, 0]), np.array([0, -1.0, 0]), np.array([0, 0, 1.0])


def angles(R, body=BODY, centres=None):
    """{name: (T,) degrees} of part rotations (T, J, 3, 3)."""
    axes = body.move(R, centres_of(R) if centres is None else centres)
    degrees = angles_of(body, ground_axes(body.axes, R[:, 0]), axes)
    return dict(zip([n for joint in body.joints() for n in joint.angles], degrees.T, strict=True))


def centres_of(R):
    """Joint centres (T, 16, 3) of part rotations (T, 16, 3, 3): bones are rigid."""
    out = np.zeros((len(R), 16, 3))
    for j in range(1, 16):
        out[:, j] = out[:, PARENTS[j]] + R[:, PARENTS[j]] @ (JOINTS[j] - JOINTS[PARENTS[j]])
    return out


def posed(part, rotation):
    """Part rotations (1, 16, 3, 3): one joint turned by a rotation (3, 3) of the world."""
    local = np.tile(np.eye(3), (16, 1, 1))
    local[PARTS.index(part)] = rotation
    R = local.copy()
    for j in range(1, 16):
        R[j] = R[PARENTS[j]] @ local[j]
    return R[None]


def axes(segment, column):
    if segment.startswith("hip"):      # its second axis is across that which flexes, the pelvis', and the thigh's own
        floating = np.cross(axes(segment.replace("hip", "thigh"), 1), axes("pelvis", 2))
        return floating / np.linalg.norm(floating)
    return BODY.frames[segment][:, column]


def test_axes_of_the_body_at_rest():
    np.testing.assert_allclose(BODY.axes, np.stack([AHEAD, UP, RIGHT], axis=1), atol=1e-12)
    for name, frame in BODY.frames.items():
        np.testing.assert_allclose(frame.T @ frame, np.eye(3), atol=1e-12, err_msg=name)
        assert np.linalg.det(frame) == pytest.approx(1)
    for side, name in (("l", "left"), ("r", "right")):
        hip, knee = (JOINTS[PARTS.index(f"{part}_{name}")] for part in ("thigh", "shin"))
        np.testing.assert_allclose(axes(f"thigh_{side}", 1), (hip - knee) / np.linalg.norm(hip - knee), err_msg=name)
    rest = angles(np.tile(np.eye(3), (1, 16, 1, 1)))
    aside, ahead, down = np.cos(LEG_LEAN) * np.sin(LEG_ANGLE), -np.sin(LEG_LEAN), np.cos(LEG_LEAN) * np.cos(LEG_ANGLE)
    assert rest["hip_adduction_r"] == pytest.approx(-np.degrees(np.arcsin(aside)))
    assert rest["hip_flexion_l"] == pytest.approx(np.degrees(np.arctan2(ahead, down)))
    assert rest["shoulder_elevation_l"] == pytest.approx(36) and rest["shoulder_plane_r"] == pytest.approx(0, abs=1e-6)
    assert rest["elbow_flex_r"] == pytest.approx(14) and rest["forearm_pronation_l"] == pytest.approx(90)
    for joint in ("pelvis_tilt", "lumbar_extension", "neck_rotation", "knee_angle_r", "wrist_flex_l"):
        assert rest[joint] == pytest.approx(0, abs=1e-9), joint


# What turns which angle up, on the right side: the part, the segment whose axis it is at rest, the axis and its sign.
# A flexed hip carries the knee ahead, and so on; about right, ahead and up of the other side the last two turn back.
SIDED = [("hip_flexion", "thigh", "pelvis", 2, 1), ("hip_rotation", "thigh", "thigh", 1, 1),
         ("hip_adduction", "thigh", "hip", 0, 1), ("knee_angle", "shin", "thigh", 2, -1),
         ("knee_rotation", "shin", "shank", 1, 1), ("ankle_angle", "foot", "shank", 2, 1),
         ("arm_flex", "upper_arm", "trunk", 2, 1), ("arm_rot", "upper_arm", "humerus", 1, 1),
         ("shoulder_rotation", "upper_arm", "humerus", 1, 1), ("shoulder_elevation", "upper_arm", "trunk", 0, -1),
         ("elbow_flex", "forearm", "humerus", 2, 1), ("forearm_pronation", "forearm", "forearm", 1, 1),
         ("wrist_flex", "hand", "forearm", 2, 1), ("wrist_dev", "hand", "forearm", 0, 1)]


@pytest.mark.parametrize("angle, part, segment, column, sign", SIDED)
@pytest.mark.parametrize("side", "lr")
def test_a_known_rotation_is_that_angle_and_no_other(side, angle, part, segment, column, sign):
    axis = axes(segment if segment in ("pelvis", "trunk") else f"{segment}_{side}", column)
    turn = sign * (1 if side == "r" or column == 2 else -1) * np.radians(30)
    whole = f"{part}_{'left' if side == 'l' else 'right'}"
    before, after = angles(posed("head", np.eye(3))), angles(posed(whole, exp(turn * axis)))
    assert after[f"{angle}_{side}"] - before[f"{angle}_{side}"] == pytest.approx(30, abs=1e-6)
    first = [joint for joint in BODY.joints() if joint.angles[0][:-2] in ("hip_flexion", "knee_angle", "elbow_flex")]
    for joint in first:                                  # the other joints, and those of the other side, stay
        if f"{angle}_{side}" not in joint.angles:
            for name in joint.angles:
                assert after[name] == pytest.approx(before[name], abs=1e-6), name


@pytest.mark.parametrize("angle, part, axis", [
    ("pelvis_tilt", "pelvis", RIGHT), ("pelvis_list", "pelvis", AHEAD), ("pelvis_rotation", "pelvis", UP),
    ("lumbar_extension", "abdomen", RIGHT), ("lumbar_bending", "chest", AHEAD), ("lumbar_rotation", "abdomen", UP),
    ("neck_extension", "head", RIGHT), ("neck_rotation", "head", UP)])
def test_trunk_and_head(angle, part, axis):
    after = angles(posed(part, exp(np.radians(20) * axis)))
    for name in ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "lumbar_extension", "lumbar_bending",
                 "lumbar_rotation", "neck_extension", "neck_bending", "neck_rotation"):
        assert after[name] == pytest.approx(20 if name == angle else 0, abs=1e-6), name


def test_a_raised_arm_points_where_its_plane_and_elevation_say():
    rng = np.random.default_rng(3)
    R = np.stack([posed("upper_arm_right", exp(rng.normal(0, 1.2, 3)))[0] for _ in range(30)])
    found, trunk = angles(R), BODY.frames["trunk"]
    arm = -(R[:, PARTS.index("upper_arm_right")] @ axes("humerus_r", 1)) @ trunk
    plane, elevation = (np.radians(found[f"shoulder_{name}_r"]) for name in ("plane", "elevation"))
    wanted = np.stack([np.sin(plane) * np.sin(elevation), -np.cos(elevation), np.cos(plane) * np.sin(elevation)], 1)
    np.testing.assert_allclose(arm, wanted, atol=1e-9)   # plane 0 is abduction, 90 forward flexion
    assert (elevation >= 0).all() and (elevation <= np.pi).all()


def composed(angles, sequence):
    """Rotations (n, 3, 3) of three angles each, about axes that turn with them: by scipy."""
    return Rotation.from_euler(sequence.upper(), angles).as_matrix()


@pytest.mark.parametrize("beyond", [False, True])
@pytest.mark.parametrize("sequence", ["zxy", "yxy"])
def test_angles_compose_back(sequence, beyond):
    t = np.linspace(0, 3, 400)
    R = exp(np.stack([1.2 * np.sin(2 * t), 6 * t, np.cos(3 * t)], axis=1))
    R = np.concatenate([R, composed([[0.3, 0, 0.4], [0.3, -np.pi / 2, 0.4]], sequence)])
    got = decompose(R, sequence, beyond)
    np.testing.assert_allclose(composed(got, sequence), R, atol=1e-9)
    if sequence == "yxy":
        assert (got[:, 1] <= 0).all() and (got[:, 1] >= -np.pi).all()
    elif not beyond:
        assert (np.abs(got[:, 1]) <= np.pi / 2 + 1e-12).all()


def test_an_arm_beyond_a_right_angle_goes_on():
    b = np.radians(np.concatenate([np.arange(0, 130), np.arange(130, 0, -1)]))
    angles = np.stack([0.02 + 0 * b, -b, 0.01 + 0 * b], axis=1)
    np.testing.assert_allclose(decompose(composed(angles, "zxy"), "zxy", True), angles, atol=1e-9)


def test_one_false_turn_shifts_nothing_that_follows():
    """A shin that spins once about the thigh's own hinge for some frames is at the same angle as before after it."""
    turn = np.concatenate([np.zeros(5), np.radians([60, 150, 240, 330]), np.zeros(6)])
    R = np.concatenate([posed("shin_right", exp(-angle * axes("thigh_r", 2))) for angle in turn])
    knee = angles(R)["knee_angle_r"]
    np.testing.assert_allclose(knee, [0] * 5 + [60, 150, -120, -30] + [0] * 6, atol=1e-6)
    np.testing.assert_allclose(wrap_angle(np.radians([-180, 180, 541, 0])), np.radians([180, 180, -179, 0]), atol=1e-9)


def test_somebody_who_turns_round_goes_on_and_a_break_begins_anew():
    turn = np.radians(np.concatenate([np.arange(0, 500, 20), [300, 320]]))
    heading = angles(np.concatenate([posed("pelvis", exp(angle * UP)) for angle in turn]))["pelvis_rotation"]
    np.testing.assert_allclose(heading, np.concatenate([np.arange(0, 500, 20), [-60, -40]]), atol=1e-6)


def test_the_pelvis_lies_along_its_hips_and_limbs_along_their_joints():
    """Rotations of parts that answer to skin say otherwise; the turn about a bone stays that of the part."""
    R = posed("head", np.eye(3))
    centres = centres_of(R)
    knee, hip, ankle = (PARTS.index(f"{part}_right") for part in ("shin", "thigh", "foot"))
    centres[:, hip] += 0.03 * UP                              # the right hip higher, and a bent knee
    centres[:, ankle] = centres[:, knee] + 0.4 * (centres[:, knee] - centres[:, hip]) @ exp(-0.5 * RIGHT)
    told = angles(R, BODY, centres)
    width = np.linalg.norm((JOINTS[PARTS.index("thigh_left")] - JOINTS[hip])[:2])
    assert told["pelvis_list"][0] == pytest.approx(-np.degrees(np.arctan(0.03 / width)), abs=1e-6)
    upper, lower = centres[0, hip] - centres[0, knee], centres[0, knee] - centres[0, ankle]
    bend = np.degrees(np.arccos(upper @ lower / np.linalg.norm(upper) / np.linalg.norm(lower)))
    assert abs(told["knee_angle_r"][0]) == pytest.approx(bend, abs=1.0) and bend > 25
    still = R[:, PARTS.index("shin_right")] @ axes("shank_r", 2)
    assert BODY.move(R, centres)["shank_r"][0, :, 2] @ still[0] > 0.85


def test_angles_that_people_do_not_have_are_doubts():
    degrees = np.full((20, 3), 30.0)
    degrees[4:9, 0], degrees[7, 1], degrees[:, 2] = -45, 171.5, np.nan
    told = JointAngles(("knee_angle_l", "elbow_flex_r", "hip_flexion_r"), degrees, np.zeros((20, 3)), np.eye(3), ())
    assert told.doubts() == (
        "knee_angle_l of -45 degrees in 5 frames from 4 to 8: people have -20 to 170, so look at the limb there",
        "elbow_flex_r of 172 degrees in 1 frames from 7 to 7: people have -20 to 170, so look at the limb there")


def test_a_side_or_the_names_are_missing():
    some = [j for j, name in enumerate(PARTS) if name not in ("shin_left", "foot_left", "hand_right")]
    parents = np.array([-1 if p < 0 else some.index(p) for p in PARENTS[some]])
    less = anatomy(tuple(PARTS[j] for j in some), parents, JOINTS[some])
    assert less.missing() == ("elbow_r", "wrist_r", "hip_l", "knee_l", "ankle_l")   # no far end, no axis
    R = exp(np.random.default_rng(5).normal(0, 0.3, (3, 16, 3)))
    whole, part = angles(R), angles(R[:, some], less, centres_of(R)[:, some])
    leg = {name for name in whole if name.startswith(("hip_", "knee_", "ankle_")) and name.endswith("l")}
    assert set(whole) - set(part) == leg | {
        "elbow_flex_r", "elbow_adduction_r", "forearm_pronation_r", "wrist_flex_r", "wrist_dev_r", "wrist_rotation_r"}
    for name, values in part.items():
        np.testing.assert_allclose(values, whole[name], atol=1e-9, err_msg=name)
    with pytest.raises(ValueError, match=r"of people: expected parts named pelvis, .* found part0, part1"):
        anatomy(("part0", "part1"), np.array([-1, 0]), np.zeros((2, 3)))


@pytest.mark.parametrize("turn", [np.zeros(3), [0, 0, 1.7], [0, 0, 3.1], [np.pi / 2, 0, 0], [0, np.pi / 2, 0]])
def test_the_ground_has_y_up_and_faces_x(turn):
    R = exp(np.array(turn))[None] @ exp(0.1 * np.random.default_rng(6).normal(size=(9, 3)))
    ground = ground_axes(BODY.axes, R)
    assert np.linalg.det(ground) == pytest.approx(1) and set(np.abs(ground).ravel()) == {0.0, 1.0}
    assert ground[:, 1] @ R.mean(axis=0) @ UP > 0.9 and ground[:, 0] @ R.mean(axis=0) @ AHEAD > 0.6


def test_files_of_a_motion_without_people(tmp_path, capsys):
    model = worm_with_prior()
    motion = Motion(np.zeros((1, 4, 3)), np.zeros((1, 3)), None, 50.0, np.zeros((1, 0)))      # and of one frame
    markers = MarkerSequence(np.full((1, 2, 3), np.nan), ("A b", "part1_joint"), 50.0)
    write_motion_folder(tmp_path, motion, model.subject(None), markers)
    assert "motion.mot is not written: joint angles are of people" in capsys.readouterr().err
    assert not (tmp_path / "motion.mot").exists()
    text, back = (tmp_path / "motion.trc").read_text(), read_markers(tmp_path / "motion.trc")
    assert back.labels == ("A_b", "part1_joint", "part1_joint_", "part2_joint", "part3_joint")
    assert back.seen.tolist() == [[False, False, True, True, True]] and "nan" not in text.lower()
    assert text.splitlines()[6].startswith("1\t0\t\t\t\t\t\t\t")


def test_files_of_a_person(tmp_path):
    body = small_people().subject(np.zeros(4))
    poses = np.random.default_rng(7).normal(0, 0.2, (5, 16, 3))
    motion = Motion(poses, np.ones((5, 3)), None, 50.0, np.zeros((5, 0)))
    write_motion_folder(tmp_path, motion, body)
    centres, points = joint_centres(motion, body), read_markers(tmp_path / "motion.trc")
    text = (tmp_path / "motion.mot").read_text()
    names, *rows = [line.split("\t") for line in text.split("endheader\n")[1].splitlines()]
    told = dict(zip(names, np.array(rows, float).T, strict=True))
    assert "nan" not in text.lower() and len(told) == 55
    hips = [points.positions[:, points.labels.index(f"hip_{side}_joint")] for side in "lr"]
    pelvis = np.stack([told[f"pelvis_t{axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_allclose(pelvis, np.mean(hips, axis=0), atol=1e-6)
    here, there = (p[:, :, None] - p[:, None] for p in (centres[:, 1:], points.positions))      # turned, not bent
    np.testing.assert_allclose(np.linalg.norm(there, axis=3), np.linalg.norm(here, axis=3), atol=1e-6)
    height = dict(zip(points.labels, points.positions[..., 1].mean(axis=0), strict=True))
    assert height["head_joint"] > height["hip_r_joint"] + 0.4 > height["ankle_l_joint"] + 1


def storage_file(path):
    names = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "hip_flexion_r")
    told = JointAngles(names, np.arange(12.0).reshape(3, 4), 0.1 * np.ones((3, 3)), np.eye(3), ("knee_r",))
    write_mot(path, told, 50.0)
    return path


def test_joint_centres_are_further_points_of_the_c3d(tmp_path, original):
    ezc3d = pytest.importorskip("ezc3d")
    faults, rng = found(original), np.random.default_rng(8)
    joints = MarkerSequence(rng.normal(0, 0.5, (T, 3, 3)), ("hip_r_joint", "knee_r_joint", "C7"), 100.0)
    for source, who in ((original, "Bob:"), (None, "")):
        write_virtual(tmp_path / "before.c3d", faults, source)
        write_virtual(tmp_path / "v.c3d", faults, source, joints=joints)
        old, new = (ezc3d.c3d(str(tmp_path / name)) for name in ("before.c3d", "v.c3d"))
        before = old["parameters"]["POINT"]["LABELS"]["value"]
        added = [f"{who}hip_r_joint", f"{who}knee_r_joint", f"{who}C7_"]
        assert new["parameters"]["POINT"]["LABELS"]["value"] == before + added
        assert new["parameters"]["POINT"]["DESCRIPTIONS"]["value"][-3:] == [
            "joint centre of the model (hip_r_joint)", "joint centre of the model (knee_r_joint)",
            "joint centre of the model (C7)"]
        count = len(before)
        np.testing.assert_array_equal(new["data"]["points"][:, :count], old["data"]["points"])
        np.testing.assert_allclose(new["data"]["points"][:3, count:], 1000 * joints.positions.transpose(2, 1, 0),
                                   atol=1e-3)
        assert (new["data"]["meta_points"]["residuals"][0, count:] == 0).all()
        np.testing.assert_array_equal(new["data"]["meta_points"]["residuals"][:, :count],
                                      old["data"]["meta_points"]["residuals"])
        np.testing.assert_array_equal(new["data"]["analogs"], old["data"]["analogs"])
        if source:
            for group, name in (("EVENT", "LABELS"), ("ANALOG", "LABELS"), ("POINT", "ANGLES"), ("POINT", "RATE")):
                assert new["parameters"][group][name]["value"] == pytest.approx(old["parameters"][group][name]["value"])
        back = read_markers(tmp_path / "v.c3d")
        again = back.select(("hip_r_joint", "knee_r_joint", "C7_"))
        np.testing.assert_allclose(again.positions, joints.positions, atol=1e-6)
        np.testing.assert_allclose(back.positions[:, :4], faults.virtual().positions, atol=1e-6)
    data = original.read_bytes()
    many = [f"joint {i}" for i in range(300)]
    (tmp_path / "many.c3d").write_bytes(add_points(original, data, many, many, np.zeros((T, 300, 3))))
    assert read_markers(tmp_path / "many.c3d").labels[-1] == "joint 299"
    with pytest.raises(MarkerFileError, match="group POINT that can take more points"):
        add_points(original, data.replace(b"POINT", b"PLINT"), ["a"], ["a"], np.zeros((T, 1, 3)))
    with pytest.raises(MarkerFileError, match="expected a file of 3 frames, found 12"):
        add_points(original, data, ["a"], ["a"], np.zeros((3, 1, 3)))


def test_opensim_reads_them(tmp_path):
    opensim = pytest.importorskip("opensim", reason="OpenSim's own reader is not installed")
    opensim.Logger.removeFileSink()                                  # else opensim.log stays behind
    positions = np.random.default_rng(9).normal(size=(4, 3, 3))
    positions[1, 0] = positions[2, 2] = np.nan
    write_markers(tmp_path / "a.trc", MarkerSequence(positions, ("RASI", "LASI", "hip_r_joint"), 120.0))
    read = opensim.TimeSeriesTableVec3(str(tmp_path / "a.trc"))
    got = np.array([[read.getRowAtIndex(t).getElt(0, i).to_numpy() for i in range(3)] for t in range(4)])
    np.testing.assert_allclose(got, 1000 * positions, atol=1e-4)
    assert read.getTableMetaDataString("Units") == "mm" and read.getTableMetaDataString("DataRate").startswith("120")
    angles = opensim.TimeSeriesTable(str(storage_file(tmp_path / "a.mot")))
    assert angles.getTableMetaDataString("inDegrees") == "yes" and list(angles.getColumnLabels())[3] == "pelvis_tx"
    np.testing.assert_allclose(angles.getDependentColumn("hip_flexion_r").to_numpy(), [3, 7, 11])
