import numpy as np
import pytest
from conformance_bodies import KINDS
from model_bodies import random_poses


@pytest.mark.parametrize("size", [0.0, 0.5, 2.5])             # 2.5: beyond half a turn, where twists wrap
@pytest.mark.parametrize("kind", list(KINDS))
def test_every_kind_of_model_goes_backwards(kind, size):
    rng, model = np.random.default_rng(2), KINDS[kind]()
    pose, betas = random_poses(model, 1, rng, size)[0], rng.normal(size=3)
    force, full = rng.normal(size=model.template.vertices.shape), model.jacobian(pose, betas)
    by_pose, by_betas = model.pull_back(force, pose, betas)
    np.testing.assert_allclose(by_pose, np.tensordot(force, full.pose, axes=2), atol=1e-5)
    np.testing.assert_allclose(by_betas, np.tensordot(force, full.betas, axes=2), atol=1e-5)
