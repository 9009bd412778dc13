"""Key poses in a table, and another shape in every frame: what an animator writes by hand."""
import json

import numpy as np
import pytest
from people_bodies import small_people
from quiet_pictures import small_pictures  # noqa: F401 -- fixture
from scipy.spatial.transform import Rotation, Slerp
from test_completion_animate_cli import told
from test_completion_motions import WRITTEN

from completion.__main__ import main
from completion.motion import Motion
from model.motion.keys import holds_keys, interpolate_rotations, read_keys
from scanprep.geometry.rotations import exp
from scanprep.geometry.storage import StorageError

ARM = "upper_arm_right"


@pytest.fixture(scope="module")
def people(tmp_path_factory):
    place = tmp_path_factory.mktemp("people") / "model.npz"
    small_people().save(place)
    return place


def run(people, *words):
    return main(["animate", *map(str, words), "-m", str(people)])


def table(path, text):
    path.write_text(text)
    return path


def keyed(tmp_path, text, rate=10.0):
    return read_keys(table(tmp_path / "keys.csv", text), small_people().skeleton, None, None, rate)


def test_joints_go_the_shorter_way_and_stay_where_two_keys_are_alike():
    times, at = np.array([0.0, 1, 2, 3]), np.linspace(0, 3, 61)
    turns = np.radians([[0, 0, 0], [0, 90, 0], [0, 90, 0], [30, 0, 60]])
    found = interpolate_rotations(times, turns, at)
    np.testing.assert_allclose(exp(found[::20]), exp(turns), atol=1e-12)              # every key
    np.testing.assert_allclose(np.degrees(found[20:41]), [[0, 90, 0]] * 21, atol=1e-9)
    assert np.degrees(np.linalg.norm(found[:21], axis=1)).max() < 90 + 1e-9           # nothing swings beyond
    small = np.radians([[5, 0, 0], [0, 0, 20]])
    line = Slerp([0, 1], Rotation.from_rotvec(small))([0.25, 0.5, 0.75])
    off = line.inv() * Rotation.from_rotvec(interpolate_rotations([0, 1], small, [0.25, 0.5, 0.75]))
    assert np.degrees(off.magnitude()).max() < 0.02
    long = interpolate_rotations([0, 1], np.radians([[170, 0, 0], [-170, 0, 0]]), np.array([0.5]))
    assert np.degrees(np.linalg.norm(long)) == pytest.approx(180)                     # by 20 degrees, not by 340


def test_keys_of_parts_and_places_are_as_the_table_says(tmp_path):
    names = small_people().skeleton.names
    found = keyed(tmp_path, f"time,{ARM}_rx,thigh_left_rx,trans_z\n1,0,10,\n1.5,,,0.2\n2,80,,0.4\n")
    arm, thigh = names.index(ARM), names.index("thigh_left")
    assert found.poses.shape == (11, len(names), 3) and found.rate == 10
    angles = np.degrees(found.poses)
    np.testing.assert_allclose(angles[[0, 5, 10], arm], [[0, 0, 0], [40, 0, 0], [80, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(angles[:, thigh], [[10, 0, 0]] * 11)
    np.testing.assert_allclose(found.trans[[0, 5, 10]], [[0, 0, 0.2], [0, 0, 0.2], [0, 0, 0.4]])
    assert not angles[:, [j for j in range(len(names)) if j not in (arm, thigh)]].any()


@pytest.mark.parametrize("text, message", [
    ("", "line 1: expected a column time"),
    ("time,arm_rx\n0,1\n", "line 1: expected the columns time, PART_rx, .*upper_arm_right.*found 'arm_rx'"),
    (f"{ARM}_rx\n0\n", "line 1: expected a column time"),
    (f"time,{ARM}_rx\n", "expected keys below the first line"),
    (f"time,{ARM}_rx\n0,1\n0,2\n", "line 3: expected a time in seconds that is later"),
    (f"time,{ARM}_rx\n0,1\nsoon,2\n", "line 3: expected numbers"),
    (f"time,{ARM}_rx,{ARM}_ry\n0,1,\n", f"line 2: expected numbers in all of {ARM}_rx, {ARM}_ry"),
    (f"time,{ARM}_rx\n0,1\n1,inf\n", "expected finite numbers"),
    (f"time,{ARM}_rx\n0,1\n100000,2\n", "expected times in seconds"),
])
def test_what_is_wrong_with_a_table_is_told(tmp_path, text, message):
    with pytest.raises(StorageError, match=message):
        keyed(tmp_path, text)


def test_tables_of_markers_are_none_of_keys(tmp_path):
    assert not holds_keys(table(tmp_path / "a.csv", "time,ASIS_r_x,ASIS_r_y,ASIS_r_z\n0,1,2,3\n"))
    assert holds_keys(table(tmp_path / "b.csv", f"\ufefftime;{ARM}_rX\n0;1\n"))
    assert not holds_keys(tmp_path / "none.csv")


def test_lines_of_joint_angles_are_keys_and_every_frame_has_another_shape(people, tmp_path):
    """SCAPE-patent par. 12 and Fig. 8e, as commands: a spreadsheet's table, and what joint_angles.csv gives back."""
    keys = f"time;{ARM}_ry;trans_z\n0;0;0\n0,5;45,5;0,1\n1;-20;0\n"
    betas = np.linspace([-2.0, 0], [2, 1], 11)
    (tmp_path / "betas.json").write_text(json.dumps(betas.tolist()))
    out = tmp_path / "out"
    assert run(people, table(tmp_path / "keys.csv", keys), "-o", out, "--rate", "10", "--betas-to",
               tmp_path / "betas.json") == 0
    assert {p.name for p in out.glob("[!.]*")} == WRITTEN | {"morph.glb"}
    motion, rows = Motion.load(out / "motion.npz"), told(out)
    assert (len(motion.poses), motion.rate, rows["judgement"], rows["copied"]) == (11, 10, "good", "between 3 keys")
    names = small_people().skeleton.names
    assert np.degrees(motion.poses[5, names.index(ARM), 1]) == pytest.approx(45.5) and motion.trans[5, 2] == 0.1
    assert run(people, out / "joint_angles.csv", "-o", tmp_path / "again", "--rate", "10") == 0
    again = Motion.load(tmp_path / "again" / "motion.npz")
    np.testing.assert_allclose(again.poses, motion.poses, atol=1e-5)


def test_radians_and_betas_of_other_frames_are_told(people, tmp_path, capsys):
    radians = table(tmp_path / "keys.csv", f"time,{ARM}_ry\n0,0\n0.1,1.5\n")
    assert run(people, radians, "-o", tmp_path / "out") == 0
    assert "no joint turns by more than 1.5 degrees" in capsys.readouterr().err
    (tmp_path / "betas.json").write_text("[[0, 1], [1, 0]]")
    assert run(people, radians, "-o", tmp_path / "more", "--betas-to", tmp_path / "betas.json") == 1
    assert "--betas-to: expected betas of all 4 frames, got those of 2" in capsys.readouterr().err
