"""The model of the built-in people: that of the population, in the wheel, made by its recipe."""
import json
from pathlib import Path

import numpy as np
import pytest
from people_bodies import make_model

from completion.cli import read_model
from completion.mocap.joint_angles import anatomical_angles
from completion.motion import Motion
from completion.viewing.kinds import model_of_report
from model import fit_pose, load_model
from model.built_in import STORED, load_built_in_model, load_fingered_model
from scanprep.geometry import storage
from scanprep.synthetic.landmarks import landmarks, markers
from scanprep.synthetic.people import BodyShape, SyntheticPerson, random_pose
from scanprep.synthetic.population import STORED as PEOPLE
from scanprep.synthetic.population import population


@pytest.fixture(scope="module")
def model():
    return load_built_in_model()


def test_file_and_recipe_belong_together(model):
    """`tests/people/make_model.py` makes it anew from the same people; both files are small enough for the wheel."""
    assert model.info["recipe"] == make_model.recipe_digest()
    assert STORED.stat().st_size + PEOPLE.stat().st_size < 5e6
    assert "CC0" in model.info["source"] and "ANSUR II" in model.info["source"]


@pytest.mark.parametrize("seed", range(4))
def test_its_bodies_are_those_of_the_population(model, seed):
    """At rest nearly exactly, and in poses that it was not learned from, of people that it was not learned from."""
    rng, kept = np.random.default_rng(seed), np.array(model.info["people_vertices"])
    shape = BodyShape.random(rng, ("female", "male")[seed % 2])
    person, subject = SyntheticPerson(shape), model.subject(np.array(shape.betas))
    for pose, most in ((np.zeros((16, 3)), 0.0008), (random_pose(rng), 0.006)):
        truth = person.in_pose(pose)[kept]
        assert np.linalg.norm(fit_pose(subject, truth).vertices - truth, axis=1).mean() < most


def test_its_template_is_the_mean_person_with_landmarks(model):
    person, kept = SyntheticPerson(BodyShape("male", (0.0,) * 30)), np.array(model.info["people_vertices"])
    np.testing.assert_allclose(model.template.vertices, person.mesh.vertices[kept], atol=1e-9)
    assert model.template.is_closed and len(model.template.faces) == 10000 and model.skeleton.names == person.names
    for named, mine in ((landmarks(), model.info["landmarks"]), (markers(), model.info["markers"])):
        assert {name: kept[v] for name, v in mine.items()} == named


def test_the_first_betas_are_stature_weight_and_sex(model):
    def figures(betas):
        body = model.template.with_vertices(model.vertices(np.zeros((16, 3)), np.array(betas)))
        return np.ptp(body.vertices[:, 2]), body.volume

    (tall, volume), (taller, _), (same, more) = map(figures, ([0.0], [1.0], [0.0, 1.0]))
    assert 0.05 < taller - tall < 0.12 and abs(same - tall) < 0.01 and 1.08 < more / volume < 1.3
    female, male = (np.array(model.info["sexes"][sex]["mean"]) for sex in ("female", "male"))
    assert female[2] < -0.5 < 0.5 < male[2] and male[0] > female[0]


def test_women_and_men_together_have_betas_of_mean_0_and_variance_1(model):
    sexes = [model.info["sexes"][sex] for sex in ("female", "male")]
    means, covariances = (np.array([sex[key] for sex in sexes]) for key in ("mean", "covariance"))
    apart = (means[0] - means[1]) / 2
    np.testing.assert_allclose(means.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(covariances.mean(axis=0) + np.outer(apart, apart), np.eye(30), atol=1e-9)


# Degrees that healthy adults reach: American Academy of Orthopaedic Surgeons, 1965, and a few of slack
RANGES = {"knee_angle": (-5, 145), "hip_flexion": (-35, 125), "hip_adduction": (-50, 35), "hip_rotation": (-50, 50),
          "elbow_flex": (-5, 150), "ankle_angle": (-55, 25), "wrist_flex": (-80, 80), "wrist_dev": (-35, 25),
          "shoulder_elevation": (0, 180)}


def test_it_knows_poses_within_the_ranges_of_joints(model):
    poses = model.pose_examples
    still = Motion(poses, np.zeros((len(poses), 3)), np.zeros(30), 1.0, np.zeros((len(poses), 0)), ())
    person = model.subject(np.zeros(30))
    found = anatomical_angles(still, person, person.joints(still.poses, still.trans))
    for name, (low, high) in RANGES.items():
        for side in "lr":
            angles = found.degrees[:, found.names.index(f"{name}_{side}")]
            assert np.mean((angles < low) | (angles > high)) < 0.05, name
            assert np.ptp(angles) > 15


def test_it_is_named_people_wherever_a_model_is_asked_for(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert load_model("people") is load_built_in_model() and load_model("people-fingers").kind == "skinning"
    assert read_model(None) == (load_built_in_model(), "people")
    Path("people").write_bytes(b"a file of mine")
    with pytest.raises(storage.StorageError, match="people: "):
        load_model("people")


def test_a_model_that_was_moved_with_its_results_is_found(tmp_path, monkeypatch):
    """The report names it as it was named on the command line, relative to where that was given."""
    (tmp_path / "study" / "out" / "ann").mkdir(parents=True)
    for folder in ("study", "elsewhere"):                          # that of another study is where we are now
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / "model.npz").write_text("")
    report = tmp_path / "study" / "out" / "ann" / "report.json"
    report.write_text(json.dumps({"settings": {"model": "model.npz"}}))
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert model_of_report(report) == tmp_path / "study" / "model.npz"


def test_fingers_bend_in_their_bones():
    model, people = load_fingered_model(), population()
    names = model.skeleton.names
    assert len(names) == 46 and len(model.template.vertices) == 12500
    pose = np.zeros((46, 3))
    pose[names.index("index2_left")] = [0.5, 0, 0]
    moved = np.linalg.norm(model.vertices(pose) - model.vertices(np.zeros((46, 3))), axis=1) > 1e-6
    joint, knuckle = (model.skeleton.joints[names.index(f"index{k}_left")] for k in (2, 1))
    far = np.linalg.norm(model.template.vertices[moved] - joint, axis=1)
    assert 20 < moved.sum() < 300 and far.max() < 2.2 * np.linalg.norm(joint - knuckle)
    # joints of whoever it is are those of the population
    betas = BodyShape.random(np.random.default_rng(1), "female").betas
    rows = people.rows(np.array(betas))
    lift = people.rows(np.zeros(0))[0] - people.mean[0] - (rows - people.mean - np.tensordot(
        betas, people.directions, axes=1))[0]
    np.testing.assert_allclose(model.rest_joints(np.array(betas))[1:16], rows[12501:12516] + lift, atol=2e-3)
