"""A static trial tells the zero of joint angles, and whether it is one."""
import csv
import json

import numpy as np
import pytest
from config_files import config_file

from completion.__main__ import main
from completion.mocap.files.markers import MarkerSequence, write_markers
from completion.mocap.joint_angles import Known, anatomical_angles, find_static_zero
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.pose.marked_body import MarkedBody
from completion.motion import Motion
from model import load_built_in_model

MODEL = load_built_in_model()
NAMES = list(MODEL.skeleton.names)
LAYOUT = load_layout("cmu41", MODEL.template, np.array(MODEL.info["people_vertices"]))
SUBJECT = MODEL.subject()


def bending(degrees):
    """A motion of a person who bends the left knee by some degrees from frame to frame, the right one by 12."""
    poses = np.zeros((len(degrees), len(NAMES), 3))
    poses[:, NAMES.index("shin_left"), 0] = np.radians(degrees)
    poses[:, NAMES.index("shin_right"), 0] = np.radians(12)
    return Motion(poses, np.zeros((len(degrees), 3)), None, 50.0, np.zeros((len(degrees), 0)))


def recorded(motion, path):
    body = MarkedBody(SUBJECT, LAYOUT, 0.3, 0.3)
    write_markers(path, MarkerSequence(body.positions(body.body.join(motion.poses, motion.trans)), LAYOUT.labels, 50.0))
    return path


def test_angles_are_zero_in_the_static_trial_and_count_from_it():
    walk, still = bending(np.linspace(0, 50, 20)), bending(np.full(6, 9.0))
    zero = find_static_zero(still, SUBJECT)
    for motion, wanted in ((still, 0.0), (walk, None)):
        angles = anatomical_angles(motion, SUBJECT, SUBJECT.joints(motion.poses, motion.trans), Known(zero=zero))
        raw = anatomical_angles(motion, SUBJECT, SUBJECT.joints(motion.poses, motion.trans))
        for name, degrees, before in zip(angles.names, angles.degrees.T, raw.degrees.T, strict=True):
            if name.startswith("pelvis"):
                np.testing.assert_array_equal(degrees, before)
            elif wanted is not None:
                np.testing.assert_allclose(degrees, wanted, atol=1e-6, err_msg=name)
        if wanted is None:
            knee, own = (one.degrees[:, one.names.index("knee_angle_l")] for one in (angles, raw))
            np.testing.assert_allclose(knee, own - np.interp(9, np.linspace(0, 50, 20), own), atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize(("stands", "doubt"), [(9.0, None), (70.0, "knee_angle_l is ")])
def test_the_command_takes_it(stands, doubt, tmp_path):
    walk = recorded(bending(np.linspace(0, 50, 40)), tmp_path / "walk.trc")
    still = recorded(bending(np.full(10, stands)), tmp_path / "cal.trc")
    quick = config_file(tmp_path, soft_tissue=False, person=dict(frames=6, n_betas=4))
    assert main(["mosh", str(walk), "-o", str(tmp_path / "out"), "--static", str(still), "--config", str(quick)]) == 0
    (table,) = tmp_path.glob("out/*/walk/anatomical_angles.csv")
    rows = list(csv.DictReader(table.open()))
    knee = np.array([float(row["knee_angle_l"]) for row in rows])
    assert knee[0] == pytest.approx(-stands, abs=4) and knee[-1] == pytest.approx(50 - stands, abs=4)
    assert all(0 < float(row["knee_angle_l_sd"]) < 5 for row in rows)
    reasons = " ".join(json.loads((table.parent / "report.json").read_text())["judgement"]["reasons"])
    assert (doubt or "static trial") in reasons if doubt else "static trial" not in reasons
