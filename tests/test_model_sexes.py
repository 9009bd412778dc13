import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model.fitting import fit_shape
from model.learning import LearnConfig, learn_scape
from model.learning.sexes import learn_by_sex

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
        assert {**alone.info, "sex": sex} == model.info


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
