"""BVH and motion files as programs write them."""
import numpy as np
import pytest

from model.motion.bvh import USUAL_RATE, read_bvh
from model.motion.files import is_motion, read_motion_file
from scanprep.geometry.storage import StorageError
from scanprep.skeleton.roles import NEEDED, find_roles

HEAD = """HIERARCHY
ROOT Hips
{
  OFFSET 0.0 0.0 0.0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Leg
  {
    OFFSET 9.0 -42.0 0.5
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT Foot
    {
      OFFSET 0.0 -41.0 2.5
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0.0 -6.0 14.5
      }
    }
  }
  JOINT Spine
  {
    OFFSET 0.0 12.5 -1.5
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0.0 18.0 0.0
    }
  }
}
"""
TABLE = np.round(np.random.default_rng(0).uniform(-40, 40, (5, 15)), 3) + [0.0, 89, *np.zeros(13)]


def motion(table=TABLE, frames="5", time="0.05", number="%.4f", colon=": "):
    rows = "".join(" ".join(number % v for v in row) + "\n" for row in table)
    return f"MOTION\nFrames{colon}{frames}\nFrame Time{colon}{time}\n{rows}"


def read(folder, text, encoding="utf-8", **named):
    (folder / "walk.bvh").write_bytes(text.encode(encoding))
    return read_bvh(folder / "walk.bvh", "cm", **named)


def same(found, wanted, shift=0.0):
    assert found.rate == pytest.approx(wanted.rate)
    np.testing.assert_allclose(found.rotations, wanted.rotations, atol=1e-6)
    np.testing.assert_allclose(found.places, wanted.places + shift, atol=1e-5)


@pytest.fixture
def good(tmp_path):
    found = read(tmp_path, HEAD + motion())
    assert found.rate == pytest.approx(20) and found.places.shape == (5, 4, 3)
    np.testing.assert_allclose(found.places[:, 0], TABLE[:, :3] / 100)
    return found


def scaled(head):
    """Channels of scale at every joint, and their values."""
    head = head.replace("CHANNELS 6", "CHANNELS 9").replace("CHANNELS 3", "CHANNELS 6") \
        .replace("Yrotation", "Yrotation Xscale Yscale Zscale")
    ones = np.ones((5, 3))
    parts = [TABLE[:, :6], ones]
    for k in range(6, 15, 3):
        parts += [TABLE[:, k:k + 3], ones]
    return head + motion(np.concatenate(parts, axis=1))


@pytest.mark.parametrize("change", [
    lambda text: text.replace("\n", "\r"), lambda text: text.replace("\n", "\r\n").replace("  ", "\t"),
    lambda text: "\ufeff" + text, lambda text: text.replace(".", ","),
    lambda text: HEAD + motion(colon=":"), lambda text: HEAD + motion(number="%.6e"),
    lambda text: scaled(HEAD)], ids="cr crlf mark commas colons exponents scales".split())
def test_a_bvh_as_programs_write_it(tmp_path, good, change):
    same(read(tmp_path, change(HEAD + motion())), good)


def test_a_bvh_in_utf_16(tmp_path, good):
    same(read(tmp_path, HEAD + motion(), "utf-16"), good)


@pytest.mark.parametrize("frames", ["4", "9"])
def test_frames_are_counted_and_not_believed(tmp_path, good, frames):
    with pytest.warns(UserWarning, match=f"Frames says {frames}, there are 5"):
        same(read(tmp_path, HEAD + motion(frames=frames)), good)


def test_numbers_without_a_blank_between(tmp_path):
    table = TABLE.copy()
    table[:, 3] = -7.5
    lines = (HEAD + motion(table)).split("\n")
    glued = [line.replace(" -7.5000", "-7.5000", 1) for line in lines]
    assert glued != lines
    same(read(tmp_path, "\n".join(glued)), read(tmp_path, "\n".join(lines)))


def test_a_joint_without_channels_does_not_turn(tmp_path):
    still = TABLE.copy()
    still[:, 6:9] = 0
    head = HEAD.replace("    CHANNELS 3 Zrotation Xrotation Yrotation\n    JOINT Foot", "    JOINT Foot")
    same(read(tmp_path, head + motion(np.delete(TABLE, [6, 7, 8], axis=1))), read(tmp_path, HEAD + motion(still)))


def test_a_name_that_comes_twice_gets_a_number(tmp_path, good):
    with pytest.warns(UserWarning, match="line 20: the joint Leg comes again; it is called Leg_2"):
        found = read(tmp_path, HEAD.replace("Spine", "Leg") + motion())
    assert found.names == ("Hips", "Leg", "Foot", "Leg_2")
    same(found, good)


def test_two_people_in_a_file_are_named(tmp_path):
    second = HEAD.replace("HIERARCHY\n", "").replace("Hips", "Bob_Hips")
    with pytest.raises(StorageError, match=r"line 30: .* one person, found several: Hips, Bob_Hips"):
        read(tmp_path, HEAD + second + motion(np.c_[TABLE, TABLE]))


def test_a_frame_time_of_nothing(tmp_path, good):
    with pytest.warns(UserWarning, match=r"Frame Time is 0: 30 frames a second are assumed; say rate="):
        assert read(tmp_path, HEAD + motion(time="0")).rate == USUAL_RATE
    same(read(tmp_path, HEAD + motion(time="0"), rate=20.0), good)


# what the position channels mean

def test_the_place_of_the_root_has_its_offset_in_it(tmp_path, good):
    """As Blender and MotionBuilder have it: the offset is the place in the first frame."""
    same(read(tmp_path, HEAD.replace("OFFSET 0.0 0.0 0.0", "OFFSET 150.0 89.0 -40.0", 1) + motion()), good)


def test_hips_below_a_root_that_stays_have_their_place_in_the_channels(tmp_path, good):
    channels = next(line for line in HEAD.split("\n") if "CHANNELS 6" in line)
    head = HEAD.replace("ROOT Hips\n{\n  OFFSET 0.0 0.0 0.0\n", "ROOT joint_Root\n{\n  OFFSET 0 0 0\n" + channels +
                        "\n  JOINT Hips\n  {\n  OFFSET 1.0 94.0 -450.0\n")
    found = read(tmp_path, head.rstrip() + "\n}\n" + motion(np.c_[np.zeros((5, 6)), TABLE]))
    np.testing.assert_allclose(found.places[:, 1:], good.places, atol=1e-6)
    still = TABLE.copy()
    still[:, :3] = 0                     # nothing is said of the place
    found = read(tmp_path, head.rstrip() + "\n}\n" + motion(np.c_[np.zeros((5, 6)), still]))
    np.testing.assert_allclose(found.places[:, 1], np.tile([0.01, 0.94, -4.5], (5, 1)), atol=1e-9)


@pytest.mark.parametrize("changes", [False, True])
def test_position_channels_of_all_joints_mean_the_same(tmp_path, good, changes):
    """Bones of constant length tell whether they are offsets or changes of them; the root goes by that."""
    head = HEAD.replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ")
    offsets = [[9.0, -42.0, 0.5], [0.0, -41.0, 2.5], [0.0, 12.5, -1.5]]
    parts = [TABLE[:, :6]]
    for k, offset in enumerate(offsets):
        parts += [np.zeros((5, 3)) if changes else np.tile(offset, (5, 1)), TABLE[:, 6 + 3 * k:9 + 3 * k]]
    head = head.replace("OFFSET 0.0 0.0 0.0", "OFFSET 150.0 0.0 -40.0", 1)
    same(read(tmp_path, head + motion(np.concatenate(parts, axis=1))), good, [1.5, 0, -0.4] if changes else 0.0)


def test_names_of_makehuman():
    names = ["root", "spine05", "spine01", "neck01", "head"]
    limbs = "clavicle upperarm01 upperarm02 lowerarm01 wrist upperleg01 upperleg02 lowerleg01 foot".split()
    names += [f"{part}.{side}" for side in "LR" for part in limbs]
    roles = {role: names[j] for role, j in find_roles(names).items()}
    assert set(NEEDED) <= roles.keys()
    assert (roles["l_hip"], roles["r_knee"], roles["l_shoulder"], roles["r_elbow"]) == (
        "upperleg01.L", "lowerleg01.R", "upperarm01.L", "lowerarm01.R")


# .npz

T = 4
POSES = np.random.default_rng(1).normal(0, 0.2, (T, 52, 3))
TRANS = np.random.default_rng(2).normal(size=(T, 3))
FLAT = POSES.reshape(T, -1)


def stored(folder, **arrays):
    np.savez(folder / "m.npz", **{"trans": TRANS, **arrays})
    assert is_motion(folder / "m.npz")
    return read_motion_file(folder / "m.npz")


@pytest.mark.parametrize("rate", [
    {"fps": np.array(20)}, {"mocap_framerate": np.array(["20"])}, {"mocap_frame_rate": np.array([20.0])},
    {"frame_rate": 20.0}])
def test_rates_of_motion_files(tmp_path, rate):
    found = stored(tmp_path, poses=POSES, **rate)
    assert found.rate == 20
    np.testing.assert_array_equal(found.poses, POSES)


def test_a_motion_without_a_rate(tmp_path):
    with pytest.warns(UserWarning, match="does not say its frames a second .*30 are assumed; say rate="):
        assert stored(tmp_path, poses=FLAT).rate == USUAL_RATE
    assert read_motion_file(tmp_path / "m.npz", rate=25.0).rate == 25


@pytest.mark.parametrize(("more", "joints"), [
    ({}, 22), ({"left_hand_pose": FLAT[:, 66:111], "right_hand_pose": FLAT[:, 111:156]}, 52),
    ({"jaw_pose": np.zeros((T, 3)), "leye_pose": np.zeros((T, 3)), "reye_pose": np.zeros((T, 3)),
      "left_hand_pose": FLAT[:, 66:111], "right_hand_pose": FLAT[:, 111:156]}, 55),
    ({"left_hand_pose": np.zeros((T, 12)), "right_hand_pose": np.zeros((T, 12)), "jaw_pose": np.zeros((T, 3))}, 22)])
def test_names_of_the_smplx_library(tmp_path, more, joints):
    np.savez(tmp_path / "m.npz", global_orient=POSES[:, 0], body_pose=FLAT[:, 3:66], transl=TRANS, fps=20, **more)
    assert is_motion(tmp_path / "m.npz")
    found = read_motion_file(tmp_path / "m.npz")
    assert found.poses.shape == (T, joints, 3) and found.of_family
    np.testing.assert_array_equal(found.poses[:, :22], POSES[:, :22])
    np.testing.assert_array_equal(found.trans, TRANS)
    if joints > 22:
        np.testing.assert_array_equal(found.poses[:, -30:], POSES[:, 22:])


def test_smpl_as_the_library_has_it(tmp_path):
    np.savez(tmp_path / "m.npz", global_orient=POSES[:, :1], body_pose=FLAT[:, 3:72], transl=TRANS, fps=20)
    np.testing.assert_array_equal(read_motion_file(tmp_path / "m.npz").poses, POSES[:, :24])


def test_a_motion_of_another_program_says_what_to_export(tmp_path):
    (tmp_path / "walk.fbx").write_bytes(b"Kaydara FBX Binary")
    with pytest.raises(StorageError, match=r"walk\.fbx: expected a motion \(\.npz\), found FBX: .* export BVH"):
        read_motion_file(tmp_path / "walk.fbx")


def test_betas_of_every_frame(tmp_path):
    betas = np.arange(10) / 10.0
    found = stored(tmp_path, poses=FLAT, fps=20, betas=np.tile(betas, (T, 1)))
    np.testing.assert_array_equal(found.betas, betas)
    with pytest.warns(UserWarning, match="betas change from frame to frame; their median is taken"):
        stored(tmp_path, poses=FLAT, fps=20, betas=np.tile(betas, (T, 1)) + np.arange(T)[:, None])
