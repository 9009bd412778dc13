"""Gait: events of a synthetic walk and of C3D files, joint angles over cycles, and the folder and page of a take."""
from types import SimpleNamespace

import numpy as np
import pytest
from c3d_bytes import c3d_bytes
from people_bodies import small_people
from test_completion_force_plates import plate, steady

from completion.mocap.files.motion_files import joint_centres
from completion.mocap.gait.cycles import average_cycles, write_gait
from completion.mocap.gait.events import FROM_FEET, FROM_FILE, GaitEvents, find_gait_events, read_file_events
from completion.mocap.joint_angles import JointAngles, anatomical_angles
from completion.mocap.mosh.report import show_walk
from completion.mocap.mosh.work import write_walk
from completion.motion import Motion
from scanprep.geometry.rotations import exp, log
from scanprep.geometry.tables import read_table
from scanprep.pictures.page import Page
from scanprep.synthetic.people import synthesise_walk

RATE = 60.0
WALK = synthesise_walk(300, RATE)                    # left strikes every 1.1 s from 0 on, right ones between
LEFT, RIGHT = 1.1 * np.arange(1, 5), 1.1 * np.arange(4) + 0.55


def subject():
    return small_people().subject(np.zeros(4))


def moving(poses, trans, turn=0.0):
    """A motion, turned about the vertical by degrees, with joint centres and joint angles."""
    R = exp(np.radians(turn) * np.array([0, 0, 1.0]))
    poses = poses.copy()
    poses[:, 0] = log(R @ exp(poses[:, 0]))
    origin = subject().joints(np.zeros((16, 3)))[0]
    motion = Motion(poses, (trans + origin) @ R.T - origin, None, RATE, np.zeros((len(poses), 0)))
    centres = joint_centres(motion, subject())
    return motion, centres, anatomical_angles(motion, subject(), centres)


def events_of(poses, trans, turn=0.0):
    motion, centres, angles = moving(poses, trans, turn)
    return find_gait_events(motion, subject(), centres, angles), angles


def times(events, side, kind="strike"):
    return np.array([time for time, *which in events.events if which == [side, kind]])


@pytest.mark.parametrize("turn", [0, 37, 130, -90])
def test_a_walk_has_its_strikes_whatever_way_it_goes(turn):
    events, _ = events_of(*WALK, turn)
    assert events.source == FROM_FEET and events.cadence == pytest.approx(2 * 60 / 1.1, rel=0.01)
    # heels are farthest ahead two frames before they strike
    for found, true in ((times(events, "l"), LEFT), (times(events, "r"), RIGHT)):
        assert len(found) == len(true) and (true - found > 0).all() and (true - found < 0.06).all()
    # a foot leaves the floor after the other one has struck it, within a fifth of the cycle
    for side, other in ("lr", "rl"):
        after = times(events, side, "off")[:, None] - times(events, other, "strike")
        assert (((after > 0) & (after < 0.22)).sum(axis=1) == 1).all()
    assert {side: len(own) for side, own in events.cycles.items()} == {"l": 3, "r": 3}


def test_a_walk_on_a_treadmill_is_one_too():
    poses, trans = WALK
    still, treadmill = events_of(*WALK), events_of(poses, trans * [1, 0, 1])
    assert still[0].events == treadmill[0].events
    kept = [average_cycles(angles, RATE, events) for events, angles in (still, treadmill)]
    np.testing.assert_allclose(kept[0].mean, kept[1].mean, atol=0.5)


def jump(poses):
    """Both legs do what the left one does."""
    both = poses.copy()
    both[:, 13:16] = poses[:, 10:13] * [1, -1, -1]
    both[:, :1] = 0
    return both


@pytest.mark.parametrize("name", ["standing", "backwards", "jumping", "short", "small steps", "tumbling"])
def test_who_does_not_walk_has_no_events(name):
    poses, trans = WALK
    tumble = poses.copy()
    tumble[:, 0] = log(exp(np.linspace(0, 25, 300)[:, None] * [1.0, 0, 0]) @ exp(poses[:, 0]))
    cases = {"standing": (0 * poses, 0 * trans), "backwards": (poses[::-1], trans[::-1]),
             "jumping": (jump(poses), trans), "short": (poses[:70], trans[:70]),
             "small steps": (0.25 * poses, 0.25 * trans), "tumbling": (tumble, trans)}
    assert events_of(*WALK)[0] is not None and events_of(*cases[name])[0] is None


def event_file(path, events, first=1, frames=300, more=(), subjects=None):
    """A C3D at 60 Hz with events: label, context and time, seconds from the beginning of the recording."""
    parameters = [("EVENT", "LABELS", [label for label, _, _ in events]),
                  ("EVENT", "CONTEXTS", [context for _, context, _ in events]),
                  ("EVENT", "TIMES", np.array([divmod(time, 60) for *_, time in events], float)),
                  ("TRIAL", "ACTUAL_START_FIELD", np.array([first, 0])), *more]
    if subjects:
        parameters.append(("EVENT", "SUBJECTS", subjects))
    path.write_bytes(c3d_bytes(np.ones((frames, 1, 3)), ["C7"], rate=RATE, more=parameters))
    return path


def test_events_of_the_file_count_from_the_beginning_of_the_recording(tmp_path):
    said = [("Foot Strike", "Right", 71.5), ("Foot Off", "Left", 70.5), ("Foot Strike", "Left", 71.0),
            ("Foot Strike", "Right", 70.25), ("Event", "General", 70.4), ("Sync", "Left", 70.6)]
    path = event_file(tmp_path / "a.c3d", said, first=4201)          # 70 s were cut away
    found = read_file_events(path, RATE)
    assert [event[1:] for event in found] == [("r", "strike"), ("l", "off"), ("l", "strike"), ("r", "strike")]
    assert [event[0] for event in found] == pytest.approx([0.25, 0.5, 1.0, 1.5], abs=1e-4)
    assert [event[0] for event in read_file_events(path, 2 * RATE)] == pytest.approx([0.125, 0.25, 0.5, 0.75], abs=1e-4)


@pytest.mark.parametrize("label, expected", [("LHS", ("l", "strike")), ("RTO", ("r", "off")), ("lfo", ("l", "off")),
                                             ("Right Toe Off", ("r", "off")), ("left heel strike", ("l", "strike")),
                                             ("Left initial contact", ("l", "strike")), ("Foot Strike", None),
                                             ("LTHS", None), ("Left", None)])
def test_labels_of_other_programs(tmp_path, label, expected):
    found = read_file_events(event_file(tmp_path / "a.c3d", [(label, "", 1.0)]), RATE)
    assert [event[1:] for event in found] == ([expected] if expected else [])


def test_of_several_people_each_has_his_own_events_and_those_of_nobody(tmp_path):
    said = [("Foot Strike", "Left", 1.0), ("Foot Strike", "Left", 2.0), ("Foot Strike", "Left", 3.0)]
    path = event_file(tmp_path / "a.c3d", said, subjects=["Ann", "Bob", ""])
    assert [len(read_file_events(path, RATE, who)) for who in ("Ann", "Bob:", None)] == [2, 2, 3]


def test_events_of_the_file_come_first_if_they_make_a_cycle(tmp_path):
    motion, centres, angles = moving(*WALK)
    said = [("Foot Strike", "Left", time) for time in (0.4, 1.5, 9.0)]           # the last is behind the end
    found = find_gait_events(motion, subject(), centres, angles, event_file(tmp_path / "a.c3d", said))
    assert found.source == FROM_FILE and len(found.events) == 2 and not len(found.cycles["r"])
    np.testing.assert_allclose(found.cycles["l"], [[0.4, 1.5]], atol=1e-6)
    found = find_gait_events(motion, subject(), centres, angles, event_file(tmp_path / "b.c3d", said[1:]))
    assert found.source == FROM_FEET


def straight(names, degrees):
    pelvis = np.stack([np.arange(len(degrees)) / 100, *np.ones((2, len(degrees)))], axis=1)      # along x at 1 m/s
    return JointAngles(names, degrees, pelvis, np.eye(3), ())


def test_cycles_are_stretched_to_percent_and_averaged():
    names, t = ("knee_angle_l", "knee_angle_r", "neck_rotation"), np.arange(401)
    degrees = np.stack([t % 100, 2.0 * t, np.where(t < 150, 3.0, 5.0)], axis=1).astype(float)
    degrees[220, 1] = np.nan
    cycles = {"l": np.array([[0.0, 0.99], [1.0, 1.99]]), "r": np.array([[1.0, 2.0], [2.0, 3.0], [3.0, 3.5]])}
    found = average_cycles(straight(names, degrees), 100.0, GaitEvents((), cycles, FROM_FILE))
    column = dict(zip(found.names, range(4), strict=True))
    assert found.names == ("knee_angle_l", "neck_rotation_left_cycles", "knee_angle_r", "neck_rotation_right_cycles")
    assert found.counts.tolist() == [2, 2, 2, 3]                         # a cycle with NaN does not count
    np.testing.assert_allclose(found.mean[:, 0], np.linspace(0, 99, 101), atol=1e-9)
    np.testing.assert_allclose(found.sd[:, 0], 0, atol=1e-9)
    i = column["knee_angle_r"]                  # from 200 to 400 and from 600 to 700: mean 400 to 550, SD 400 / sqrt 2
    np.testing.assert_allclose(found.mean[[0, 100], i], [400, 550])
    np.testing.assert_allclose(found.sd[[0, 100], i], [400 / 2**0.5, 300 / 2**0.5])
    assert found.mean[0, column["neck_rotation_left_cycles"]] == 3
    assert found.columns("knee_angle") == [("l", 0), ("r", 2)]
    assert found.columns("neck_rotation") == [("l", 1), ("r", 3)] and found.columns("hip_flexion") == []


def test_the_pelvis_is_measured_from_the_way():
    """Also of somebody who walks across the axes of the room, or back."""
    kept = []
    for turn in (0, 37, 175):
        events, angles = events_of(*WALK, turn)
        kept.append(average_cycles(angles, RATE, events))
    for other in kept[1:]:
        assert other.names == kept[0].names
        np.testing.assert_allclose(other.mean, kept[0].mean, atol=0.3)
        np.testing.assert_allclose(other.sd, kept[0].sd, atol=0.3)
    # the walk is the same on both sides; the pelvis leans and turns the other way, and in the mean not at all
    mean = dict(zip(kept[0].names, kept[0].mean.T, strict=True))
    for name, size in (("hip_flexion", 30), ("knee_angle", 45), ("ankle_angle", 15)):
        np.testing.assert_allclose(mean[f"{name}_l"], mean[f"{name}_r"], atol=3)
        assert np.ptp(mean[f"{name}_l"]) > size
    for name, size in (("pelvis_list", 4), ("pelvis_rotation", 8)):
        left, right = mean[f"{name}_left_cycles"], mean[f"{name}_right_cycles"]
        np.testing.assert_allclose(left, -right, atol=1)
        assert abs(left.mean()) < 1 and np.ptp(left) > size
    assert mean["pelvis_rotation_right_cycles"][0] > 3         # the right foot strikes with the right side ahead


def test_the_tables(tmp_path):
    events, angles = events_of(*WALK)
    gait = average_cycles(angles, RATE, events)
    write_gait(tmp_path, gait)
    wanted = ("percent", "knee_angle_l_mean", "knee_angle_l_sd", "knee_angle_l_count")
    rows = [row for _, row in read_table(tmp_path / "gait_cycles.csv", wanted)]
    assert [row["percent"] for row in rows] == [str(k) for k in range(101)] and rows[0]["knee_angle_l_count"] == "3"
    i = gait.names.index("knee_angle_l")
    np.testing.assert_allclose([float(row["knee_angle_l_mean"]) for row in rows], gait.mean[:, i], atol=1e-3)
    np.testing.assert_allclose([float(row["knee_angle_l_sd"]) for row in rows], gait.sd[:, i], atol=1e-3)
    assert {"pelvis_tilt_left_cycles_mean", "pelvis_tilt_right_cycles_mean"} <= set(rows[0])
    said = [row for _, row in read_table(tmp_path / "gait_events.csv", ("time", "side", "event", "source"))]
    assert [(float(row["time"]), row["side"][0], row["event"]) for row in said] == [
        (pytest.approx(time, abs=1e-4), side, f"foot {kind}") for time, side, kind in events.events]


def test_the_folder_and_the_page_of_a_take(tmp_path):
    motion, _, angles = moving(*WALK)
    path = event_file(tmp_path / "a.c3d", [("Foot Strike", "Left", 1.0)])
    take = SimpleNamespace(source=SimpleNamespace(path=path, who=None), motion=motion, subject=subject(), unit=None)
    gait, reactions = write_walk(tmp_path, take, angles)
    assert {"gait_cycles.csv", "gait_events.csv"} <= {file.name for file in tmp_path.iterdir()}
    assert reactions is None and not (tmp_path / "grf.mot").exists()
    page = Page("a walk")
    show_walk(page, gait, reactions)
    text = page.html()
    assert "3 left and 3 right gait cycles, 109 steps a minute" in text and FROM_FEET in text and "Force" not in text
    # somebody who stands on a plate, of which one is broken
    (tmp_path / "stand").mkdir()
    analog = np.repeat(steady(2)[:1], 10, axis=0)
    corners = np.stack([np.zeros((4, 3)), plate()[3][2][0]])
    path.write_bytes(c3d_bytes(np.ones((10, 1, 3)), ["C7"], rate=RATE, analog=analog,
                               more=plate(count=2, CORNERS=corners)))
    standing = moving(0 * WALK[0][:10], 0 * WALK[1][:10])
    take.motion = standing[0]
    with pytest.warns(UserWarning, match="force plate 1 is left out"):
        gait, reactions = write_walk(tmp_path / "stand", take, standing[2])
    assert [file.name for file in (tmp_path / "stand").iterdir()] == ["grf.mot"] and gait is None
    np.testing.assert_allclose(reactions.forces[:, 0, 1], 700, atol=1e-2)         # y is up in the ground
    page = Page("a stand")
    show_walk(page, gait, reactions)
    assert "Gait" not in page.html() and "Force plate 1 is left out: its corners are no rectangle" in page.html()
    # damaged parameters cost the files that need them, and no others
    parameters = [("EVENT", "LABELS", ["LHS"]), ("EVENT", "TIMES", np.array([[0, 0.1]])),
                  ("TRIAL", "ACTUAL_START_FIELD", np.array([np.nan, np.nan])), *plate(TYPE=["II"])]
    path.write_bytes(c3d_bytes(np.ones((10, 1, 3)), ["C7"], rate=RATE, analog=analog, more=parameters))
    (tmp_path / "damaged").mkdir()
    with pytest.warns(UserWarning) as caught:
        gait, reactions = write_walk(tmp_path / "damaged", take, standing[2])
    assert gait is None and reactions is None and not list((tmp_path / "damaged").iterdir())
    texts = " ".join(str(note.message) for note in caught)
    assert "its events cannot be read" in texts and "grf.mot is not written" in texts
    empty = Page("nothing")
    show_walk(empty, None, None)
    assert empty.html() == Page("nothing").html()
