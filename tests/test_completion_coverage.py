"""Which parts of a body the markers tell of, and what a recording of few markers is worth."""
import csv
from functools import cache

import numpy as np
import pytest

from completion.mocap.files.markers import MarkerSequence, read_markers
from completion.mocap.files.motion_files import write_motion_folder
from completion.mocap.joint_angles import Known, anatomical_angles
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.marker_sets.named import load_layout
from completion.mocap.pose.coverage import between, find_coverage, find_told_parts, marker_labels, untold_spans
from completion.motion import Motion
from model.built_in import load_built_in_model

MODEL = load_built_in_model()         # small models have triangles that reach from the hip bone to the waist
KEPT = np.array(MODEL.info["people_vertices"])
LAYOUT = load_layout("plugingait39", MODEL.template, KEPT)
NAMES = np.array(MODEL.skeleton.names)
LEGS = tuple(label for label in LAYOUT.labels if label[1:] in ("ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE"))


@cache
def subject():
    return MODEL.subject(np.zeros(MODEL.n_betas))


def covered(labels, others=0, doubted=(), called="X"):
    """Of a recording of these labels of the set and so many others."""
    every = (*labels, *(f"{called}{i}" for i in range(others)))
    residuals = np.full((5, len(every)), np.nan)
    residuals[:, :len(labels)] = 0.005
    trusted = np.isfinite(residuals) & ~np.isin(every, doubted)
    motion = Motion(np.zeros((5, len(NAMES), 3)), np.zeros((5, 3)), None, 50.0, residuals, every, trusted=trusted)
    recorded = MarkerSequence(np.zeros((5, len(every), 3)), every, 50.0)
    return find_coverage(subject(), LAYOUT, [motion], [recorded]), motion


def test_a_whole_set_tells_of_the_whole_body():
    found, _ = covered(LAYOUT.labels)
    assert found.told.all() and not found.unseen and found.judgement().verdict == "good"
    assert found.metrics()[0].value == "39 of 39"


def test_legs_alone_say_what_they_did_not_see():
    found, _ = covered(LEGS)
    assert set(found.unseen) == {name for name in NAMES if name.startswith(
        ("abdomen", "chest", "head", "upper_arm", "forearm", "hand"))}
    assert found.judgement().verdict == "check" and "no marker saw" in found.judgement().why
    assert 0.45 < found.skin < 0.6               # by the rule of nines: head 9, arms 18, trunk above the hips 22 to 30%


@pytest.mark.parametrize(("labels", "others", "verdict", "words"), [
    (("LASI", "RASI", "C7"), 36, "failed", "3 of 39 markers used, a body needs 8"),
    (LAYOUT.labels[:7], 0, "failed", "7 of 7"), (LEGS, 40, "check", f"{len(LEGS)} of {len(LEGS) + 40} markers used"),
    (LAYOUT.labels, 39, "good", ""), (LAYOUT.labels, 63, "good", "")])       # of two sets at once
def test_a_recording_of_which_little_is_used(labels, others, verdict, words):
    judgement = covered(labels, others)[0].judgement()
    assert judgement.verdict == verdict and words in judgement.why


def test_points_that_plug_in_gait_computed_are_no_markers():
    """Nor are trajectories without a name: a file with 39 markers can have 240 points."""
    segments = {"A:" + stem + axis for stem in ("PEL", "LFE", "TRX") for axis in "OALP"}
    unnamed = {"*113", "U_2", "U3", "Unlabeled 1023", "Unidentified 4"}
    markers = {*("A:" + label for label in LAYOUT.labels), "LTHA", "LTHP", "LTHO", "U4D", "Centre"}
    assert marker_labels(markers | segments | unnamed | {"A:CentreOfMass", "CentreOfMassFloor"}) == markers
    found, _ = covered(LAYOUT.labels, 60, called="*")
    assert found.metrics()[0].value == "39 of 39" and found.judgement().verdict == "good"


def test_markers_that_were_never_seen_leave_parts_to_guess():
    """A recording names half of its markers and never shows them: the body was 11% too heavy, and good."""
    hidden = [label for label in LAYOUT.labels if label[-3:] in ("SHO", "UPA", "ASI", "PSI", "THI", "TIB", "CLAV"[-3:],
                                                                 "T10", "LAV", "TRN")]
    _, motion = covered(LAYOUT.labels)
    for count, words in ((2, ""), (len(hidden), "15 of 39 markers were never seen")):
        unseen = np.isin(LAYOUT.labels, hidden[:count])
        seen = Motion(motion.poses, motion.trans, None, 50.0, np.where(unseen, np.nan, 0.005) * np.ones((5, 1)),
                      LAYOUT.labels, trusted=np.tile(~unseen, (5, 1)))
        recording = MarkerSequence(np.where(unseen[:, None], np.nan, np.zeros((5, 39, 3))), LAYOUT.labels, 50.0)
        told = find_coverage(subject(), LAYOUT, [seen], [recording]).judgement()
        assert (words in told.doubts[0] and "thigh_left" in told.why) if words else told.verdict == "good", told


def test_markers_on_one_part_alone_tell_of_no_body():
    many = tuple(f"H{i}" for i in range(9))
    head = MarkerLayout(many, np.repeat(LAYOUT.select(["LFHD"]).nearest, 9))
    motion = Motion(np.zeros((2, len(NAMES), 3)), np.zeros((2, 3)), None, 50.0, np.zeros((2, 9)), many)
    found = find_coverage(subject(), head, [motion], [MarkerSequence(np.zeros((2, 9, 3)), many, 50.0)])
    assert found.judgement().verdict == "failed" and "one part of the body, the head" in found.judgement().why


def test_markers_that_nobody_believes_tell_of_no_part():
    hand = tuple(label for label in LAYOUT.labels if label == "LFIN")
    found, _ = covered(LAYOUT.labels, doubted=hand)
    assert found.unseen == ("hand_left",) and found.judgement().verdict == "good"          # a hand is said, no more


@pytest.mark.parametrize(("seen", "more"), [
    (("pelvis", "shin_left"), ("thigh_left",)), (("pelvis", "foot_left"), ()),
    (("pelvis", "head", "upper_arm_left"), ("abdomen", "chest")), (("head",), ()), ((), ())])
def test_a_part_between_two_is_told_and_a_leg_of_two_links_is_not(seen, more):
    told = between(subject().skeleton, np.isin(NAMES, seen))
    assert set(NAMES[told]) == {*seen, *more}


def test_gaps_are_bridged_for_a_moment():
    """At 50 frames a second 10 frames are 0.2 s; longer gaps, and frames before the first marker, are not told."""
    trusted = np.ones((60, len(LAYOUT.labels)), dtype=bool)
    lower_leg = np.isin(LAYOUT.labels, ["LTIB", "LKNE", "LANK", "LHEE", "LTOE"])
    trusted[:5, lower_leg], trusted[10:20, lower_leg], trusted[30:41, lower_leg] = False, False, False
    motion = Motion(np.zeros((60, len(NAMES), 3)), np.zeros((60, 3)), None, 50.0, np.full(trusted.shape, 0.005),
                    LAYOUT.labels, trusted=trusted)
    told = find_told_parts(subject(), LAYOUT, motion)
    gone = np.isin(NAMES, ["shin_left", "foot_left"])
    assert told[:, ~gone].all()
    np.testing.assert_array_equal(np.flatnonzero(~told[:, gone].any(axis=1)), np.r_[0:5, 30:41])
    (row,) = untold_spans(subject().skeleton, told, 50.0)
    assert row.value == "; ".join(f"{part} 0.3 s, from 0.60 to 0.82 s" for part in NAMES[gone])
    assert not untold_spans(subject().skeleton, told[5:30], 50.0)
    # angles are empty there, and only there
    centres = subject().joints(motion.poses, motion.trans)
    angles = anatomical_angles(motion, subject(), centres, Known(told))
    degrees = dict(zip(angles.names, angles.degrees.T, strict=True))
    assert np.isnan(degrees["knee_angle_l"]).sum() == 16 and np.isfinite(degrees["knee_angle_r"]).all()


def test_angles_that_are_guesses_are_in_no_table(tmp_path):
    found, motion = covered(LEGS)
    write_motion_folder(tmp_path, motion, subject(), None, Known(find_told_parts(subject(), LAYOUT, motion)))
    lines = (tmp_path / "motion.mot").read_text().splitlines()
    head = lines[lines.index("endheader") + 1].split("\t")
    assert "knee_angle_r" in head and "hip_flexion_l" in head and head[1:7] == [
        "pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz"]
    assert not [name for name in head if name.startswith(("arm_", "elbow", "neck", "lumbar", "wrist", "shoulder"))]
    assert f"nColumns={len(head)}" in lines and any(line.startswith("Seen by no marker, left out: ") for line in lines)
    with open(tmp_path / "joint_angles.csv", newline="", encoding="utf-8") as rows:
        names, first = (next(csv.reader(rows)) for _ in range(2))
    empty = {name[:-3] for name, cell in zip(names, first, strict=True) if not cell}
    assert empty == set(found.unseen)
    centres = read_markers(tmp_path / "motion.trc")
    there = dict(zip(centres.labels, centres.seen.all(axis=0), strict=True))
    assert there["knee_l_joint"] and not there["elbow_l_joint"] and not there["head_joint"]
