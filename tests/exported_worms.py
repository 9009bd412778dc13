"""A worm to export: its model, rig and motion, as fixtures."""
import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model.rig import make_rig

BETAS = np.array([0.5, -1.0])


@pytest.fixture(name="model", scope="module")
def worm():
    return worm_model()


@pytest.fixture(name="rig", scope="module")
def worm_rig(model):
    return make_rig(model, BETAS, 3)


@pytest.fixture(name="motion", scope="module")
def worm_motion(model):
    rng = np.random.default_rng(0)
    return random_poses(model, 5, rng, 0.8), rng.normal(size=(5, 3))
