"""Models that lean on a known one where scans are few."""
from dataclasses import replace

import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from completion.__main__ import main
from model import LearnConfig, learn_blendscape, learn_scape, load_model
from model.fitting.search import ModelMismatchError
from model.fitting.vertices import fit_pose
from model.learning.prior import TemplatePrior
from model.learning.scape import judge_model
from model.learning.sexes import learn_by_sex
from model.pose_space import PoseSpace
from model.shape_space import add_people
from scanprep import read_mesh, write_mesh
from scanprep.decimation.decimate import decimate
from scanprep.registration.person import average_person

CONFIG = LearnConfig(refinements=1, components=6)


def prior_of(model, seed=0, count=30):
    """What a known model says of its own template."""
    poses = random_poses(model, count, np.random.default_rng(seed), 0.4)
    poses[0] = 0
    steps = np.vstack([np.zeros(model.n_betas), np.eye(model.n_betas)])
    people = np.stack([model.vertices(np.zeros((4, 3)), betas) for betas in steps])
    return TemplatePrior("worms", model.skeleton, model.subject().vertices(poses), people)


@pytest.fixture(scope="module")
def known():
    return worm_model()


@pytest.fixture(scope="module")
def other():
    """Another worm of the same skeleton, whose flesh moves in its own way."""
    return worm_model(seed=5)


def mean_error(model, truth, seed=9):
    bodies = truth.subject().vertices(random_poses(truth, 8, np.random.default_rng(seed), 0.4))
    return np.mean([fit_pose(model.subject(), body).mean for body in bodies])


@pytest.mark.parametrize("learn", [learn_scape, learn_blendscape])
def test_one_scan_is_enough(known, learn):
    """The movement and the people are the prior's; the rest shape is the template's own."""
    model = learn(known.template, known.template.vertices[None], None, known.skeleton, CONFIG, prior=prior_of(known))
    np.testing.assert_allclose(model.vertices(np.zeros((4, 3))), known.template.vertices, atol=1e-3)
    rigid = replace(known, pose_space=PoseSpace.identity(known.skeleton))
    assert mean_error(model, known) < 0.6 * mean_error(rigid, known)
    assert model.n_betas == known.n_betas
    assert model.info["prior"] == "worms" and model.info["joint_evidence"] == [1.0, 0.0, 0.0, 0.0]
    assert not judge_model(model).reasons


def test_without_a_prior_one_scan_is_refused(known):
    with pytest.raises(ValueError, match="poses: expected at least 2"):
        learn_scape(known.template, known.template.vertices[None], None, known.skeleton, CONFIG)


@pytest.mark.slow
def test_few_scans_gain_and_many_have_their_own_way(known, other):
    """The prior is of other flesh. With three poses it helps against nothing known; with sixty it changes little."""
    prior, errors = prior_of(known), {}
    for count in (3, 60):
        poses = random_poses(other, count, np.random.default_rng(2), 0.4)
        poses[0] = 0
        bodies = other.subject().vertices(poses)
        for name, given in (("with", prior), ("without", None)):
            model = learn_scape(other.template, bodies, None, other.skeleton, CONFIG, prior=given)
            errors[name, count] = mean_error(model, other)
    assert errors["without", 60] < 0.7 * errors["without", 3]
    assert errors["with", 60] < 1.05 * errors["without", 60]


def test_a_joint_that_no_scan_bends_is_said_to_be_of_the_prior(known):
    poses = random_poses(known, 12, np.random.default_rng(3), 0.4)
    poses[0], poses[:, 1] = 0, 0
    model = learn_scape(known.template, known.subject().vertices(poses), None, known.skeleton, CONFIG,
                        prior=prior_of(known))
    evidence = model.info["joint_evidence"]
    assert evidence[1] < 0.05 and min(evidence[2:]) > 0.5
    assert model.info["joints_of_prior"] == "joint of the part1"
    # what the scans never showed moves as known
    pose = np.zeros((4, 3))
    pose[1] = [0, 0.6, 0]
    body = known.subject().vertices(pose)
    alone = learn_scape(known.template, known.subject().vertices(poses), None, known.skeleton, CONFIG)
    assert fit_pose(model.subject(), body).mean < 0.8 * fit_pose(alone.subject(), body).mean


@pytest.mark.parametrize("count", [0, 6])
def test_people_and_what_is_known_of_others_add_up_as_normal_inverse_wishart(count):
    """Mean and covariance against the formula in full, of a few triangles; nobody leaves the prior's people."""
    rng = np.random.default_rng(4)
    prior, S, worth = rng.normal(size=(4, 5, 3, 3)), rng.normal(size=(count, 5, 3, 3)), 2.5
    space = add_people(S, np.ones(count), prior, np.ones(4), worth, 40)
    flat, known_mean = S.reshape(count, 45), prior[0].ravel()
    mean = (flat.sum(axis=0) + worth * known_mean) / (count + worth)
    U, people = prior[1:].reshape(3, -1) - known_mean, flat.sum(axis=0) / max(count, 1)
    off, apart = flat - people, people - known_mean
    scatter = off.T @ off + worth * U.T @ U + count * worth / (count + worth) * np.outer(apart, apart)
    components = space.components.reshape(len(space.components), -1)
    np.testing.assert_allclose(space.mean.ravel(), mean, atol=1e-6)
    np.testing.assert_allclose(components.T @ components, scatter / (count + worth), atol=1e-5)


def test_a_prior_of_another_template_is_refused(known):
    prior = prior_of(worm_model(rings=25))
    with pytest.raises(ValueError, match="prior: it was brought to a template of 302 vertices"):
        learn_scape(known.template, known.template.vertices[None], None, known.skeleton, CONFIG, prior=prior)


def test_models_by_sex_take_the_movement_alone_from_the_prior(known):
    rng = np.random.default_rng(3)
    people = np.stack([known.vertices(np.zeros((4, 3)), betas) for betas in rng.normal(size=(5, 3))])
    models = learn_by_sex(known.template, known.template.vertices[None], people, ["female"] * 3 + ["male"] * 2,
                          known.skeleton, CONFIG, prior=prior_of(known))
    assert {name: model.n_betas for name, model in models.items()} == {"neutral": 4, "female": 2, "male": 1}
    assert mean_error(models["female"], known) < 0.02 and models["male"].info["prior"] == "worms"
    assert {model.info["prior_people"] for model in models.values()} == {0}


def test_people_told_to_be_one_are_doubted(known, other):
    """Poses of one worm and meshes of others: the prior misses what it knows, and the judgement asks who it is."""
    rng = np.random.default_rng(8)
    bodies = [known.vertices(pose, 2 * rng.normal(size=3)) for pose in random_poses(known, 6, rng, 0.4)]
    model = learn_scape(known.template, np.stack([known.template.vertices, *bodies]), None, known.skeleton, CONFIG,
                        prior=prior_of(known))
    assert any("two people" in reason for reason in judge_model(model).reasons)


@pytest.mark.slow
def test_a_model_file_is_the_prior_of_a_command(known, tmp_path, capsys):
    known.save(tmp_path / "known.npz")
    write_mesh(tmp_path / "poses" / "one.ply", known.template)
    words = ["learn", "--poses", str(tmp_path / "poses"), "--prior", str(tmp_path / "known.npz"), "-o"]
    assert main([*words, str(tmp_path / "m.npz")]) == 0
    model = load_model(tmp_path / "m.npz")
    assert model.n_betas == known.n_betas and model.info["prior"] == "scape"
    assert "joints as in the prior" in capsys.readouterr().out
    for more in (["--kind", "skinning"], ["--preset", "published"]):
        assert main([*words, str(tmp_path / "n.npz"), *more]) == 2
        assert "expected the kind scape or blendscape and not --preset published" in capsys.readouterr().err
    assert main([*words[:3], "--prior", "none", "-o", str(tmp_path / "n.npz")]) == 1
    assert "expected at least 3, got 1" in capsys.readouterr().err


@pytest.mark.slow
def test_a_model_of_something_else_is_refused_by_name_and_left_out_by_itself(known, tmp_path, monkeypatch, capsys):
    """The built-in people asked for on a worm; and on a template that has limbs and is no person after all."""
    def does_not_lie(*_given):
        raise ModelMismatchError("the model does not come to lie on the template")

    monkeypatch.setattr("model.learning.prior.lay_model", does_not_lie)
    monkeypatch.setattr("model.learning.body.has_limbs", lambda template: True)
    poses = random_poses(known, 12, np.random.default_rng(0), 0.4)
    for i, body in enumerate(known.subject().vertices(poses)):
        write_mesh(tmp_path / "poses" / f"{i:02d}.ply", known.template.with_vertices(body))
    known.skeleton.save(tmp_path / "skeleton.json")
    words = ["learn", "--poses", str(tmp_path / "poses"),
             "--skeleton", str(tmp_path / "skeleton.json"), "-o", str(tmp_path / "m.npz")]
    assert main([*words, "--prior", "people"]) == 1
    assert "--prior people: the model does not come to lie" in capsys.readouterr().err
    assert main(words) == 0
    assert "learned without the built-in people" in capsys.readouterr().err
    assert "prior" not in load_model(tmp_path / "m.npz").info
    # of many poses and people nobody asks
    monkeypatch.setattr("model.learning.body.ENOUGH", 12)
    assert main([*words, "--shapes", str(tmp_path / "poses")]) == 0
    assert "without the built-in people" not in capsys.readouterr().err


@pytest.mark.slow
def test_one_scan_of_a_person_gives_a_model_that_moves(tmp_path):
    """Without a flag, of a template that is a person; its triangles are not those of the built-in people."""
    write_mesh(tmp_path / "poses" / "one.ply", decimate(average_person().mesh, 4000))
    assert main(["learn", "--poses", str(tmp_path / "poses"), "-o", str(tmp_path / "m.npz")]) == 0
    model, people = load_model(tmp_path / "m.npz"), load_model("people")
    assert model.info["prior"] == "built-in people" and model.n_betas == people.n_betas
    assert {"thigh_left", "shin_left", "foot_left"} <= set(model.skeleton.names)
    # a bent knee takes the foot up and back, and keeps the volume
    pose = np.zeros((len(model.skeleton.parents), 3))
    pose[model.skeleton.names.index("shin_left")] = [1.0, 0, 0]
    body = model.template.with_vertices(model.subject().vertices(pose))
    foot = model.skeleton.part_of_vertex(model.template) == model.skeleton.names.index("foot_left")
    assert (body.vertices - model.template.vertices)[foot, 2].mean() > 0.08
    assert body.volume == pytest.approx(read_mesh(tmp_path / "poses" / "one.ply").volume, rel=0.04)
