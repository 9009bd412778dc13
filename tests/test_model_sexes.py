from dataclasses import replace

import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model import LearnConfig, learn_scape
from model.fitting.vertices import fit_shape
from model.learning.sexes import guess_sex, learn_by_sex, learn_sex_plane
from model.shape_statistics import PLANE

CONFIG = LearnConfig(prunings=(0.01,), ridges=(0.001,), refinements=0)
SEXES = ["female", "male", "", "female", "male", "male", "female", "male", "female", ""]


@pytest.fixture(scope="module")
def truth():
    return worm_model()


@pytest.fixture(scope="module")
def data(truth):
    """Poses, and people whose first shape parameter is the sex."""
    rng = np.random.default_rng(0)
    poses = random_poses(truth, 12, rng, 0.4)
    poses[0] = 0
    betas = rng.normal(0, 0.5, (10, 3))
    betas[:, 0] = [{"female": -1.5, "male": 1.5, "": 0}[s] for s in SEXES]
    return truth.subject().vertices(poses), truth.vertices(random_poses(truth, 10, rng, 0.05), betas)


@pytest.fixture(scope="module")
def models(truth, data):
    return learn_by_sex(truth.template, *data, SEXES, truth.skeleton, CONFIG)


def test_each_model_is_that_of_its_people(truth, data, models):
    """One pose space; shapes, poses and digests as if learned from the group alone."""
    assert list(models) == ["neutral", "female", "male"]
    poses, shapes = data
    for sex, chosen in (("neutral", range(10)), ("female", [0, 3, 6, 8]), ("male", [1, 4, 5, 7])):
        alone = learn_scape(truth.template, poses, shapes[list(chosen)], truth.skeleton, CONFIG)
        model = models[sex]
        assert model.pose_space is models["neutral"].pose_space
        np.testing.assert_array_equal(model.shape_space.mean, alone.shape_space.mean)
        np.testing.assert_array_equal(model.shape_space.components, alone.shape_space.components)
        assert {**alone.info, "sex": sex} == {name: value for name, value in model.info.items() if name != PLANE}
        assert (PLANE in model.info) == (sex == "neutral")


def test_sex_is_no_component_of_the_model_of_one_sex(truth, models):
    """Women vary less than all people do, and a woman is met by the women's model with small betas."""
    assert models["female"].shape_space.total_variance < 0.6 * models["neutral"].shape_space.total_variance
    woman = truth.vertices(np.zeros((4, 3)), np.array([-1.5, 0.2, 0.2]))
    size = {sex: np.linalg.norm(fit_shape(models[sex], woman).betas) for sex in ("female", "male")}
    assert size["female"] < 0.5 * size["male"]


def test_too_few_of_a_sex_make_no_model(truth, data):
    sexes = ["male", "female"] + [""] * 3 + ["male"] * 5
    models = learn_by_sex(truth.template, *data, sexes, truth.skeleton, CONFIG)
    assert list(models) == ["neutral", "male"] and models["male"].info["shapes"] == 6


def test_refuses_bad_input(truth, data):
    poses, shapes = data
    for bad, word in ((SEXES[:4], "expected 10, one a person, got 4"), (["f", *SEXES[1:]], "got 'f'"),
                      ("male", "expected 10")):
        with pytest.raises(ValueError, match=f"sexes.*{word}"):
            learn_by_sex(truth.template, poses, shapes, bad, truth.skeleton, CONFIG)
    with pytest.raises(ValueError, match=r"shapes.*expected shape"):
        learn_by_sex(truth.template, poses, shapes[:, 1:], SEXES, truth.skeleton, CONFIG)


def test_the_neutral_model_tells_its_people_apart(truth, models):
    """People who were not learned from, found by the model, are told by their betas; a model of one sex cannot."""
    rng = np.random.default_rng(7)
    for sex, side in (("female", -1.2), ("male", 1.2)):
        for _ in range(3):
            body = truth.vertices(np.zeros((4, 3)), np.r_[side, rng.normal(0, 0.4, 2)])
            guess = guess_sex(models["neutral"], fit_shape(models["neutral"], body).betas)
            assert guess.sex == sex and guess.margin * side > 0 and 0.5 < guess.probability <= 1
    with pytest.raises(ValueError, match=r"model.*scape learn --by-sex"):
        guess_sex(models["male"], np.zeros(2))


def test_the_plane_lies_between_two_clouds():
    """Normal along the only beta that differs, halfway; said probabilities are those of new people."""
    rng = np.random.default_rng(1)
    men = rng.random(400) < 0.3
    betas = rng.normal(size=(400, 5))
    betas[:, 2] += np.where(men, 2.5, 0.5)
    plane = learn_sex_plane(betas[:200], np.where(men, "male", "female")[:200].tolist())
    assert plane.weights[2] > 0.9
    assert np.linalg.norm(plane.weights) == pytest.approx(1)
    assert abs(1.5 * plane.weights[2] + plane.bias) < 0.3
    margins = betas[200:] @ plane.weights + plane.bias
    right = (margins > 0) == men[200:]
    sure = 1 / (1 + np.exp(-(plane.slope * np.abs(margins))))
    assert abs(sure.mean() - right.mean()) < 0.08


def test_refuses_what_says_no_sex(models):
    neutral = models["neutral"]
    for betas in (np.zeros(neutral.n_betas + 1), np.array([np.nan]), np.zeros((1, 1))):
        with pytest.raises(ValueError, match="betas"):
            guess_sex(neutral, betas)
    damaged = {**neutral.info, PLANE: {**neutral.info[PLANE], "weights": [1.0]}}
    with pytest.raises(ValueError, match="damaged"):
        guess_sex(replace(neutral, info=damaged), np.zeros(1))
