"""Sex from markers, and the person with the model of that sex."""
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior

from completion import MarkerLayout, MarkerSequence
from completion.mocap.mosh.mosh import MoshConfig, check_models, mosh_by_sex
from completion.mocap.subject.person import PersonConfig
from model.learning.sexes import PLANE, learn_sex_plane

QUICK = MoshConfig(person=PersonConfig(frames=4, annealing=(4.0, 1.0)))
SIDE = 1.2                           # of the first beta: a woman's is below zero


@pytest.fixture(scope="module")
def models():
    """The worm; of everybody with a plane, and of women and men, each with its own mean."""
    neutral = worm_with_prior()
    rng = np.random.default_rng(0)
    betas = rng.normal(size=(24, 3)) * [0.2, 1, 1] + np.repeat([[-SIDE, 0, 0], [SIDE, 0, 0]], 12, axis=0)
    plane = learn_sex_plane(betas, ["female"] * 12 + ["male"] * 12)
    found = {"neutral": replace(neutral, info={PLANE: plane.to_arrays(), "sex": "neutral"})}
    for sex, side in (("female", -SIDE), ("male", SIDE)):
        space = replace(neutral.shape_space, mean=neutral.shape_space.gradients(np.array([side])))
        found[sex] = replace(neutral, shape_space=space, info={"sex": sex})
    return found


@pytest.fixture(scope="module")
def layout(models):
    vertices = np.random.default_rng(4).choice(396, 34, replace=False)
    return MarkerLayout(tuple(f"M{i}" for i in range(34)), vertices, 0.012)


def markers(models, layout, betas, phase=0.0):
    """Markers of a worm of the neutral model that bends."""
    model, t = models["neutral"], np.arange(24) / 30
    poses = MEAN + np.sin(3 * t[:, None, None] + np.arange(4)[:, None] + phase) * np.array([0.05, 0.3, 0.2])
    meshes = model.subject(betas).vertices(poses, np.stack([t, 0 * t, 0 * t], axis=1))
    placed = np.stack([layout.place(model.template.with_vertices(v)) for v in meshes])
    return MarkerSequence(placed, layout.labels, 30.0)


@pytest.mark.parametrize("sex", ["female", "male"])
def test_the_model_of_the_sex_that_markers_tell_is_used(models, layout, sex):
    side = -SIDE if sex == "female" else SIDE
    betas = np.array([side, 0.5, -0.4])
    both = [markers(models, layout, betas), markers(models, layout, betas, 1.0)]
    guess, found = mosh_by_sex(models, both, layout, QUICK)
    assert guess.sex == sex and guess.margin * side > 0 and guess.probability > 0.7
    assert found.model is models[sex] and abs(found.betas[0]) < 0.6         # the mean of the sex is near
    assert [motion.gender for motion in found.motions] == [sex] * 2
    assert [soft.motion.gender for soft in found.soft_tissue] == [sex] * 2
    assert np.nanmean(found.motions[0].residuals) < 4e-3


def test_refuses_models_that_cannot_tell(models, layout):
    sequence = markers(models, layout, np.zeros(3))
    for wrong, word in (({"neutral": models["neutral"]}, "female and male missing"),
                        ({**models, "neutral": models["female"]}, "tells women from men"),
                        ({**models, "male": replace(models["male"], template=models["male"].template.submesh(
                            np.arange(700))[0])}, "'male'")):
        with pytest.raises(ValueError, match=word):
            mosh_by_sex(wrong, sequence, layout, QUICK)
    check_models(models)
