"""Sex from markers, and the person with the model of that sex."""
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import worm_with_prior

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


def test_refuses_models_that_cannot_tell(models, layout):
    places = layout.place(models["neutral"].template)
    sequence = MarkerSequence(np.stack([places] * 2), layout.labels, 30.0)
    for wrong, word in (({"neutral": models["neutral"]}, "female and male missing"),
                        ({**models, "neutral": models["female"]}, "tells women from men"),
                        ({**models, "male": replace(models["male"], template=models["male"].template.submesh(
                            np.arange(700))[0])}, "'male'")):
        with pytest.raises(ValueError, match=word):
            mosh_by_sex(wrong, sequence, layout, QUICK)
    check_models(models)
