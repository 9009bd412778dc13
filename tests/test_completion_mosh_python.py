"""`mosh` from Python is as simple as the command: files, the set recognised, the built-in people; angles as a table."""
import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from config_files import config_file
from mosh_folders import QUICK, QuietWork, small_pictures
from people_bodies import kept, small_people
from test_completion_keypoints import LIMBS

from completion import MarkerSequence, MoshConfig, PersonConfig, load_layout, mosh, write_markers
from completion.__main__ import main
from completion.mocap.files.opensim import write_mot
from completion.mocap.joint_angles import Known, anatomical_angles
from completion.mocap.mosh import cli
from completion.mocap.pose.pelvis import follow_pelvis
from model import files
from scanprep.skeleton.roles import find_numbered_roles
from scanprep.synthetic.people import synthesise_walk

QUICKLY = MoshConfig(PersonConfig(frames=4, annealing=(10.0, 1.0)), soft_tissue=False, repair=False)
FRAMES, RATE = 24, 30.0


@pytest.fixture(autouse=True)
def small(monkeypatch, tmp_path):
    """The built-in people are small ones, and files lie where the user is."""
    load_model = files.load_model
    monkeypatch.setattr(files, "load_model",
                        lambda path: small_people() if str(path) == files.BUILT_IN else load_model(path))
    monkeypatch.chdir(tmp_path)


def walk(betas=(0.8, -0.5)):
    """A person of the small model, and how it walks."""
    subject = small_people().subject(np.array([*betas, 0.0, 0.0]))
    return subject, *synthesise_walk(FRAMES, RATE)


def markers(labels=slice(None)):
    """Of the set plugingait39 on that person."""
    layout = load_layout("plugingait39", small_people().template, kept())
    layout = layout.select(layout.labels[labels])
    subject, poses, trans = walk()
    return MarkerSequence(np.stack([layout.place(subject.template.with_vertices(v))
                                    for v in subject.vertices(poses, trans)]), layout.labels, RATE)


def keypoints():
    """The joint centres of that person, as HALPE_26 of Pose2Sim names them."""
    subject, poses, trans = walk()
    skeleton = subject.skeleton
    roles = find_numbered_roles(skeleton.names, skeleton.joints)
    centres, bodies = subject.joints(poses, trans), subject.vertices(poses, trans)
    worn = load_layout("plugingait39", small_people().template, kept())
    at = {label: bodies[:, vertex] for label, vertex in zip(worn.labels, worn.nearest, strict=True)}
    places = {f"{side}{word}": centres[:, roles[f"{side.lower()}_{word.lower()}"]] for side in "LR" for word in LIMBS}
    for side in "LR":
        toe = at[f"{side}TOE"]
        places |= {f"{side}Heel": at[f"{side}HEE"], f"{side}BigToe": toe, f"{side}SmallToe": toe}
    head = centres[:, roles["skullbase"]]
    places |= {"Neck": head - [0, 0, 0.05], "Nose": at["LFHD"] - [0, 0, 0.1], "Head": head + [0, 0, 0.15]}
    return MarkerSequence(np.stack(list(places.values()), axis=1), tuple(places), RATE)


def test_a_file_alone_is_enough():
    """The set is recognised and the model that of the built-in people, as if both had been named."""
    write_markers("walk.c3d", markers())
    found = mosh("walk.c3d", config=QUICKLY)
    assert set(found.layout.labels) == set(markers().labels) and found.model is small_people()
    layout = load_layout("plugingait39", small_people().template, kept())
    for same in (mosh(["walk.c3d"], small_people(), layout, QUICKLY), mosh("walk.c3d", layout="plugingait39",
                                                                           config=QUICKLY)):
        np.testing.assert_array_equal(same.betas, found.betas)
        np.testing.assert_array_equal(same.motions[0].poses, found.motions[0].poses)
    subject, poses, trans = walk()
    off = found.motions[0].vertices(found.subject) - subject.vertices(poses, trans)
    assert np.linalg.norm(off, axis=2).mean() < 0.02


def test_files_and_sequences_are_of_one_person_together(tmp_path):
    write_markers("walk.trc", markers())
    found = mosh([tmp_path / "walk.trc", markers().frames(slice(0, 10))], config=QUICKLY)
    assert [len(motion.poses) for motion in found.motions] == [FRAMES, 10]
    assert [len(found.joint_angles(i)["time"]) for i in (0, 1)] == [FRAMES, 10]


@pytest.mark.parametrize(("wrong", "words"), [
    ([], "a list of at least one of these, got none"), (3, "got int"), ("none.c3d", "none.c3d"), (["a.c3d"], "a.c3d")])
def test_what_is_no_recording_is_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        mosh(wrong)


def test_angles_are_a_table_with_names(monkeypatch, tmp_path):
    """Those of motion.mot: a dict, or with pandas a DataFrame of the same columns."""
    found = mosh(markers(), config=QUICKLY)
    monkeypatch.setitem(sys.modules, "pandas", None)
    table, motion, subject = found.joint_angles(), found.motions[0], found.subject
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda columns: ("frame", columns)))
    kind, columns = found.joint_angles()
    assert found.judgement.verdict == "good", found.judgement.why
    bare = replace(found, motions=(replace(motion, residuals=motion.residuals * np.nan),))
    assert bare.judgement.verdict == "failed" and "no marker" in bare.judgement.why
    assert isinstance(table, dict) and kind == "frame" and columns.keys() == table.keys()
    np.testing.assert_allclose(table["time"], np.arange(FRAMES) / RATE)
    pelvis = follow_pelvis(motion, subject, found.layout, found.artefacts[0].repaired)
    angles = anatomical_angles(motion, subject, subject.joints(motion.poses, motion.trans), Known(pelvis=pelvis))
    write_mot(tmp_path / "motion.mot", angles, RATE)
    lines = (tmp_path / "motion.mot").read_text().splitlines()
    at = lines.index("endheader") + 1
    written = dict(zip(lines[at].split("\t"), np.loadtxt(lines[at + 1:]).T, strict=True))
    for name in {"knee_angle_r", "hip_flexion_l", "elbow_flex_r", "lumbar_extension"} & {*table}:
        np.testing.assert_allclose(table[name], written[name], atol=1e-4)
    assert np.ptp(table["knee_angle_r"]) > 30                       # degrees, of a walk


def test_joint_centres_of_a_video_are_told(tmp_path):
    """In Python by a warning; by the command, which judges, as a reason, so that the person is never good."""
    write_markers("walk.trc", keypoints())
    with pytest.warns(UserWarning, match="joint centres of a video, not markers on skin"):
        mosh("walk.trc", config=QUICKLY)
    with small_pictures(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "MoshTask", QuietWork)
        settings = config_file(tmp_path, person=QUICK, soft_tissue=False)
        main(["mosh", "walk.trc", "-o", "out", "--workers", "1", "--config", str(settings)])
    judgement = json.loads((tmp_path / "out" / "report.json").read_text())["judgement"]
    assert judgement["verdict"] in ("check", "failed")
    assert any("joint centres of a video" in reason for reason in judgement["reasons"])
