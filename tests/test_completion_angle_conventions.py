"""Joint angles by another convention than ISB along the hip centres: by ASIS and PSIS, and as Plug-in Gait has them."""
import csv
import sys
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import worm_with_prior
from config_files import config_file
from mosh_folders import QUICK, QuietWork, small_pictures
from people_bodies import kept, small_people
from test_completion_mosh_python import QUICKLY, markers, small
from test_completion_opensim import AHEAD, BODY, JOINTS, PARENTS, PARTS, RIGHT, UP, angles, posed

from completion import AngleConfig, MarkerLayout, load_layout, mosh, write_markers
from completion.__main__ import main
from completion.mocap.angle_conventions import define_segments, turn_segments
from completion.mocap.mosh import cli
from scanprep.geometry.rotations import exp

__all__ = ["small"]
TILT, PITCH, TOE_OUT = np.radians([10, 5, 7])
PIG = AngleConfig("plug-in-gait")


def landmarks():
    """Landmarks (3,) of `BODY`: the ASIS 10 degrees lower than the PSIS, toes 5 degrees up and 7 degrees out."""
    middle = np.cos(TILT) * AHEAD - np.sin(TILT) * UP
    at = {"LASI": 0.2 * middle - 0.12 * RIGHT, "RASI": 0.2 * middle + 0.12 * RIGHT, "LPSI": -0.04 * RIGHT,
          "RPSI": 0.04 * RIGHT}
    for side, out in (("L", -RIGHT), ("R", RIGHT)):
        at[f"{side}HEE"] = np.zeros(3)
        at[f"{side}TOE"] = np.cos(PITCH) * (np.cos(TOE_OUT) * AHEAD + np.sin(TOE_OUT) * out) + np.sin(PITCH) * UP
    return at


def body_by(convention):
    return turn_segments(AngleConfig(convention), BODY, JOINTS, landmarks())


@pytest.mark.parametrize("side, word", [("l", "left"), ("r", "right")])
def test_a_hip_that_flexes_on_a_tilted_pelvis(side, word):
    still, flexed = posed("head", np.eye(3)), posed(f"thigh_{word}", exp(np.radians(30) * RIGHT))
    usual = angles(still)
    for convention, tilt in (("isb-asis", -10), ("plug-in-gait", 10)):
        rest, after = (angles(R, body_by(convention)) for R in (still, flexed))
        assert rest["pelvis_tilt"] == pytest.approx(tilt) and rest["pelvis_list"] == pytest.approx(0, abs=1e-9)
        assert rest[f"hip_flexion_{side}"] == pytest.approx(usual[f"hip_flexion_{side}"] + 10)
        assert after[f"hip_flexion_{side}"] == pytest.approx(usual[f"hip_flexion_{side}"] + 40)
        for same in (f"hip_adduction_{side}", f"knee_angle_{side}"):
            assert after[same] == pytest.approx(angles(flexed)[same], abs=1e-6)
        assert rest["lumbar_extension"] == pytest.approx(10)


@pytest.mark.parametrize("angle, axis, sign", [("pelvis_list", AHEAD, -1), ("pelvis_rotation", UP, 1)])
def test_the_pelvis_is_positive_with_its_right_side_up_and_ahead(angle, axis, sign):
    for convention, turned in (("isb-asis", 1), ("plug-in-gait", sign)):
        R = posed("pelvis", exp(np.radians(20) * axis))
        assert np.sign(angles(R, body_by(convention))[angle]) == turned


@pytest.mark.parametrize("side, word", [("l", "left"), ("r", "right")])
def test_feet_of_plug_in_gait_point_from_heel_to_toe(side, word):
    """Vicon: dorsiflexion is the foot vector in the sagittal plane of the shank, rotation its angle with that plane."""
    foot, out = landmarks(), 1 if side == "r" else -1
    for turn in (np.zeros(3), np.radians(20) * RIGHT, np.radians(15) * out * UP, np.radians([-14, 5, 9])):
        found = angles(posed(f"foot_{word}", exp(turn)), body_by("plug-in-gait"))
        x, y, z = exp(turn) @ (foot[f"{side.upper()}TOE"] - foot[f"{side.upper()}HEE"]) @ BODY.frames[f"shank_{side}"]
        assert found[f"ankle_angle_{side}"] == pytest.approx(np.degrees(np.arctan2(y, x)), abs=1e-6)
        assert found[f"ankle_rotation_{side}"] == pytest.approx(-out * np.degrees(np.arcsin(z)), abs=1e-6)
    # the sole that turns to the other foot is positive
    inverted = posed(f"foot_{word}", exp(out * np.radians(15) * AHEAD))
    still = angles(posed("head", np.eye(3)), body_by("plug-in-gait"))[f"ankle_inversion_{side}"]
    assert angles(inverted, body_by("plug-in-gait"))[f"ankle_inversion_{side}"] - still == pytest.approx(15, abs=0.5)


def test_the_pelvis_still_lies_along_its_hips():
    """Axes by landmarks go with the line of the hip centres, as measured."""
    R, centres = posed("head", np.eye(3)), JOINTS[None].copy()
    hips = list(BODY.hips)
    centres[:, hips] = centres[:, hips].mean(axis=1, keepdims=True) + (JOINTS[hips] - JOINTS[hips].mean(0)) @ exp(
        np.radians(6) * AHEAD).T
    assert angles(R, body_by("plug-in-gait"), centres)["pelvis_list"] == pytest.approx(-6, abs=0.1)
    assert PARENTS[PARTS.index("thigh_left")] == 0


@pytest.mark.parametrize("name", ["cmu41", "helenhayes29", "biomech57"])
def test_landmarks_are_markers_of_the_person_or_known_on_the_body(name):
    model = small_people()
    subject = model.subject(np.zeros(4))
    found, usual = (define_segments(PIG, model, subject, load_layout(of, model.template, kept())).turns
                    for of in (name, "plugingait39"))
    for segment, axes in found.items():
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
        assert np.linalg.det(axes) > 0 and np.degrees(np.arccos((np.trace(axes.T @ usual[segment]) - 1) / 2)) < 15


def test_a_model_without_landmarks_and_a_wrong_word_are_named():
    worm = worm_with_prior()
    layout = MarkerLayout(("LASI", "RASI", "X"), [1, 2, 3])
    with pytest.raises(ValueError, match=r"'isb-asis' needs LASI, .* missing LPSI, RPSI\. .* use 'isb'"):
        define_segments(AngleConfig("isb-asis"), worm, worm.subject(), layout)
    with pytest.raises(ValueError, match="missing LASI, RASI, LPSI, RPSI, LHEE"):
        define_segments(PIG, worm, worm.subject(), MarkerLayout(("X",), [3]))
    assert define_segments(AngleConfig(), worm, worm.subject(), layout) is None
    with pytest.raises(ValueError, match="expected one of isb, isb-asis, plug-in-gait, got 'pig'"):
        AngleConfig("pig")


def test_python_and_the_commands_take_the_convention(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "pandas", None)
    found = mosh(markers(), config=replace(QUICKLY, angles=PIG))
    table, usual = found.joint_angles(), replace(found, angles=AngleConfig()).joint_angles()
    tilt = (table["pelvis_tilt"] + usual["pelvis_tilt"]).mean()
    assert tilt > 2 and np.corrcoef(table["pelvis_list"], usual["pelvis_list"])[0, 1] < -0.9
    for side in "lr":
        shift = table[f"hip_flexion_{side}"] - usual[f"hip_flexion_{side}"]
        np.testing.assert_allclose(shift, tilt, atol=2)
    assert set(table) == set(usual) and "hip_flexion_r_sd" in table
    # the commands write the same, and motion.mot with the signs of OpenSim
    write_markers("walk.c3d", markers())
    monkeypatch.setattr(cli, "MoshTask", QuietWork)
    with small_pictures():
        for command, values in (("mosh", {"soft_tissue": False}), ("animate", {})):
            settings = config_file(tmp_path, person=QUICK, angles={"convention": "plug-in-gait"}, **values)
            assert main([command, "walk.c3d", "-o", command, "--workers", "1", "--config", str(settings)]) == 0
            path, = (path for path in tmp_path.glob(f"{command}/**/anatomical_angles.csv")
                     if ".scapekit" not in path.parts)
            written = [float(row["pelvis_tilt"]) for row in csv.DictReader(path.open(encoding="utf-8"))]
            np.testing.assert_allclose(written, table["pelvis_tilt"], atol=4)
            lines = (path.parent / "motion.mot").read_text().splitlines()
            at = lines.index("endheader") + 1
            column = np.loadtxt(lines[at + 1:])[:, lines[at].split("\t").index("pelvis_tilt")]
            np.testing.assert_allclose(column, -np.array(written), atol=1e-3)
