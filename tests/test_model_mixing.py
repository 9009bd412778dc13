from dataclasses import replace

import numpy as np
import pytest
from model_bodies import random_poses, worm_model, worm_skeleton

from model import LearnConfig, learn_scape
from model.fitting.vertices import fit_pose, fit_shape
from model.learning.mixing import MIX, Within, learn_scape_mix

FAST = replace(MIX, prunings=(0.01,), ridges=(3e-4, 0.01), refinements=2)
FASTER = replace(MIX, prunings=(0.01,), ridges=(0.01,), refinements=1)


def mix(truth, people, each, seed, size=0.4):
    """Bodies (people * each, N, 3), whose they are, and their betas (people, 3)."""
    rng = np.random.default_rng(seed)
    betas = rng.normal(size=(people, 3))
    who = np.repeat(np.arange(people), each)
    return truth.vertices(random_poses(truth, len(who), rng, size), betas[who]), who.tolist(), betas


@pytest.fixture(scope="module")
def truth():
    return worm_model(bulge=0.1)


@pytest.fixture(scope="module")
def learned(truth):
    bodies, who, _ = mix(truth, 24, 3, 0)
    return learn_scape_mix(truth.template, bodies, who, truth.skeleton, FAST)


def error(model, bodies):
    return float(np.mean([fit_shape(model, y).mean for y in bodies]))


@pytest.fixture(scope="module")
def strangers(truth):
    return mix(truth, 5, 1, 1)[0]


@pytest.mark.slow
def test_a_mixed_truth_comes_back(truth, learned, strangers):
    """About as well as from as many bodies, half of them one person's poses and half other people near rest."""
    rng = np.random.default_rng(2)
    poses = truth.vertices(random_poses(truth, 36, rng, 0.4))
    poses[0] = truth.template.vertices
    shapes = truth.vertices(random_poses(truth, 36, rng, 0.1), rng.normal(size=(36, 3)))
    config = LearnConfig(features=FAST.features, prunings=FAST.prunings, ridges=FAST.ridges)
    separated = learn_scape(truth.template, poses, shapes, truth.skeleton, config)
    assert error(learned, strangers) < 1.2 * error(separated, strangers)
    assert error(learned, strangers) < 1e-3
    assert learned.shape_space.explained[2] > 0.7


def test_q_is_identity_at_rest(truth, learned):
    """The gauge: no twist, no deformation, so that the template's own body is the template."""
    rest = np.zeros((4, 3))
    np.testing.assert_allclose(learned.pose_space.gradients(rest), np.broadcast_to(np.eye(3), (792, 3, 3)), atol=1e-5)
    np.testing.assert_allclose(learned.vertices(rest), truth.template.vertices, atol=1e-6)


def test_the_template_need_not_be_among_the_people(truth, learned):
    """Its person was never seen, and yet is met in new poses."""
    bodies = truth.subject().vertices(random_poses(truth, 4, np.random.default_rng(5), 0.4))
    assert np.mean([fit_pose(learned.subject(), y).mean for y in bodies]) < 6e-3


def test_one_body_a_person(truth, strangers):
    bodies, who, _ = mix(truth, 30, 1, 3)
    model = learn_scape_mix(truth.template, bodies, who, truth.skeleton, FAST)
    assert model.info["people"] == 30 and error(model, strangers) < 5e-3


def test_labels_and_order_do_not_matter(truth):
    bodies, who, _ = mix(truth, 6, 2, 4)
    names = [f"person {w}" for w in who]
    a = learn_scape_mix(truth.template, bodies, names, truth.skeleton, FASTER)
    turned = np.roll(np.arange(12), 4)
    b = learn_scape_mix(truth.template, bodies[turned], [who[t] for t in turned], truth.skeleton, FASTER)
    pose = random_poses(truth, 1, np.random.default_rng(6))[0]
    np.testing.assert_allclose(b.vertices(pose), a.vertices(pose), atol=1e-5)
    np.testing.assert_allclose(b.shape_space.variances, a.shape_space.variances, rtol=1e-3)


def test_what_people_have_of_their_own_is_no_matter():
    """A regression with an effect a person finds the slope that is the same for all, and predicts who is left out."""
    rng = np.random.default_rng(7)
    who = np.repeat(np.arange(12), 3)
    x = rng.normal(size=36) + np.repeat(rng.normal(0, 2, 12), 3)
    y = 0.7 * x + np.repeat(-2 * x.reshape(12, 3).mean(axis=1), 3)          # between people it falls
    within = Within(who)
    X = within(np.stack([np.ones(36), x], axis=1))
    slope = np.linalg.lstsq(X, within(y), rcond=None)[0][1]
    assert abs(slope - 0.7) < 0.15 and np.polyfit(x, y, 1)[0] < -0.5
    operator = np.linalg.pinv(X)
    left = within.without_the_person(X, operator, within(y)[:, None])[:, 0]
    kept = who != 4
    again = np.linalg.lstsq(X[kept], within(y)[kept], rcond=None)[0]
    np.testing.assert_allclose(left[~kept], (within(y) - X @ again)[~kept], atol=1e-6)


def test_refuses_bad_input(truth):
    bodies, who, _ = mix(truth, 3, 2, 9)
    with pytest.raises(ValueError, match=r"subjects.*6 labels.*got 5"):
        learn_scape_mix(truth.template, bodies, who[:5], truth.skeleton)
    with pytest.raises(ValueError, match=r"subjects.*1 people"):
        learn_scape_mix(truth.template, bodies, ["a"] * 6, truth.skeleton)
    with pytest.raises(ValueError, match=r"bodies.*expected shape"):
        learn_scape_mix(truth.template, bodies[:, 1:], who, truth.skeleton)
    with pytest.raises(ValueError, match=r"bodies.*body 1"):
        learn_scape_mix(truth.template, np.where(np.arange(6)[:, None, None] == 1, np.nan, bodies), who, truth.skeleton)
    with pytest.raises(ValueError, match=r"skeleton.*joints\[0\]"):
        learn_scape_mix(truth.template, bodies, who, type(truth.skeleton)(
            truth.skeleton.part_of_face, truth.skeleton.parents, worm_skeleton(truth.template).joints + 0.1))
    for bad in (replace(MIX, regressor="svr"), replace(MIX, refinements=0)):
        with pytest.raises(ValueError, match="config"):
            learn_scape_mix(truth.template, bodies, who, truth.skeleton, bad)
