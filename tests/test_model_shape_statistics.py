"""The Gaussian of each sex: its moments, bodies drawn from it, and models that do not tell women from men."""
import json
from dataclasses import replace

import numpy as np
import pytest
from model_bodies import worm_model

from completion.__main__ import main
from model import load_built_in_model
from model.evaluation.sampling import sample_bodies
from model.measurement.survey import survey
from model.posing.cli import read_subject
from model.shape_statistics import SEXES, draw_betas, list_sexes, shape_statistics


@pytest.fixture(scope="module")
def model():
    return load_built_in_model()


@pytest.mark.parametrize("sex", SEXES)
def test_drawn_betas_have_the_moments_of_the_sex(model, sex):
    people = shape_statistics(model, sex)
    betas, sexes = draw_betas(model, 20000, np.random.default_rng(0), sex)
    sds = np.sqrt(np.diag(people.covariance))
    assert np.abs((betas.mean(axis=0) - people.mean) / sds).max() < 0.04 and set(sexes) == {sex}
    assert np.abs((np.cov(betas.T) - people.covariance) / np.outer(sds, sds)).max() < 0.05
    assert np.allclose(people.root @ people.root.T, people.covariance, atol=1e-9)


def test_without_a_sex_half_are_women_and_nobody_is_in_between(model):
    """Third betas, which lead from women to men, are those of the two sexes and not of one Gaussian."""
    betas, sexes = draw_betas(model, 2001, np.random.default_rng(0))
    assert (sexes.count("female"), sexes.count("male")) == (1001, 1000)
    for sex in SEXES:
        people, mine = shape_statistics(model, sex), betas[np.array(sexes) == sex]
        sds = np.sqrt(np.diag(people.covariance))
        assert np.abs((mine.mean(axis=0) - people.mean) / sds).max() < 0.15
        assert np.abs(np.log(mine.std(axis=0) / sds)).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("sex", SEXES)
def test_drawn_bodies_are_as_tall_and_as_heavy_as_people(model, sex):
    drawn = sample_bodies(model, 150, np.random.default_rng(3), sex=sex)
    table, statures = survey(sex), np.ptp(drawn.vertices[..., 2], axis=1)
    volumes = [model.template.with_vertices(body).volume for body in drawn.vertices]
    for values, name, factor in ((statures, "stature", 1), (volumes, "weight", 985)):
        mean, sd = (array[table.names.index(name)] for array in (table.mean, table.sd))
        assert np.mean(values) * factor == pytest.approx(mean, abs=0.25 * sd), name
        assert np.std(values) * factor == pytest.approx(sd, rel=0.2), name


def test_a_model_that_does_not_tell_women_from_men(tmp_path, capsys):
    """Its betas are standard normal, as they were drawn before; a sex of it is refused, by the command too."""
    worm = worm_model()
    assert list_sexes(worm) == () and shape_statistics(worm).root.shape == (3, 3)
    betas, sexes = draw_betas(worm, 5, np.random.default_rng(4))
    assert np.array_equal(betas, np.random.default_rng(4).normal(size=(5, 3))) and sexes == (None,) * 5
    with pytest.raises(ValueError, match="sex: the model does not tell women from men, so it has no men"):
        sample_bodies(worm, 2, np.random.default_rng(0), sex="male")
    with pytest.raises(ValueError, match="sex: expected 'female' or 'male', got 'man'"):
        shape_statistics(worm, "man")
    worm.save(tmp_path / "worm.npz")
    assert main(["model", "sample", str(tmp_path / "worm.npz"), "--sex", "male", "-o", str(tmp_path / "out")]) == 1
    assert "take the built-in model, which is named people" in capsys.readouterr().err
    # a model of women alone has women, and no men
    women = replace(worm, info={"sex": "female"})
    assert np.array_equal(shape_statistics(women, "female").covariance, np.eye(3))
    with pytest.raises(ValueError, match="it has no men"):
        shape_statistics(women, "male")


@pytest.mark.parametrize("kept", [{}, {"mean": [0, 0], "covariance": [[1]]}, {"mean": [0.0] * 3, "covariance": "x"},
                                  {"mean": [float("nan")] * 3, "covariance": np.eye(3).tolist()}])
def test_damaged_statistics(kept):
    with pytest.raises(ValueError, match="model: its statistics of men are damaged"):
        shape_statistics(replace(worm_model(), info={"sexes": {"male": kept}}), "male")


def test_the_command_draws_women_of_the_built_in_people(model, tmp_path, capsys):
    assert main(["model", "sample", "people", "--sex", "female", "-n", "3", "-o", str(tmp_path / "women")]) == 0
    assert "women" in capsys.readouterr().out
    for k in (1, 2, 3):
        kept = json.loads((tmp_path / "women" / f"body_{k}.betas.json").read_text())
        assert kept["sex"] == "female"
        assert len(read_subject(model, tmp_path / "women" / f"body_{k}.betas.json").betas) == model.n_betas
    assert main(["model", "sample", "people", "-n", "2", "-o", str(tmp_path / "both")]) == 0
    assert json.loads((tmp_path / "both" / "body_2.betas.json").read_text())["sex"] == "male"
