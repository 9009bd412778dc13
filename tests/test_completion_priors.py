import numpy as np
import pytest

from model.fitting.limbs import runs_without_branch
from model.priors import FLOOR, gaussian_prior, typical_poses


def moments(J=4, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3 * J - 3, 3 * J - 3))
    covariance = np.zeros((3 * J, 3 * J))
    covariance[3:, 3:] = root @ root.T / 10
    return rng.normal(0, 0.3, (J, 3)), covariance


def test_whitened_poses_have_unit_covariance():
    mean, covariance = moments()
    prior = gaussian_prior(mean, covariance - FLOOR**2 * np.diag(np.arange(12) > 2), shrinkage=0)
    np.testing.assert_allclose(prior.whitening @ covariance @ prior.whitening.T, np.eye(9), atol=1e-9)
    np.testing.assert_array_equal(prior.whitening[:, :3], 0)           # the root turns freely


def test_shrinkage_and_floor_make_a_covariance_of_few_poses_safe():
    rng = np.random.default_rng(1)
    poses = rng.normal(0, 0.4, (5, 12))                                 # five poses, nine angles: singular
    covariance = np.cov(poses.T)
    covariance[:3] = covariance[:, :3] = 0
    prior = gaussian_prior(poses.mean(axis=0).reshape(4, 3), covariance, 0.3)
    inner = covariance[3:, 3:]
    wanted = 0.7 * inner + np.diag(0.3 * np.diag(inner) + 0.05**2)
    np.testing.assert_allclose(np.linalg.inv(prior.whitening[:, 3:].T @ prior.whitening[:, 3:]), wanted, atol=1e-10)


def test_typical_poses_are_steps_along_the_main_directions():
    mean, covariance = moments()
    poses = typical_poses(mean, covariance, axes=2)
    assert poses.shape == (5, 4, 3)
    np.testing.assert_array_equal(poses[:, 0], 0)
    np.testing.assert_allclose(poses[0, 1:], mean[1:])
    np.testing.assert_allclose(poses[1] + poses[3], 2 * poses[0], atol=1e-12)
    steps = (poses[1:3] - poses[0]).reshape(2, -1)
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", steps[:, 3:], np.linalg.inv(covariance[3:, 3:]),
                                         steps[:, 3:]), 1.5**2)
    largest = np.sort(np.linalg.eigvalsh(covariance))[::-1]
    np.testing.assert_allclose((steps**2).sum(axis=1), 1.5**2 * largest[:2])
    assert typical_poses(mean, covariance, axes=0).shape == (1, 4, 3)


@pytest.mark.parametrize("covariance", [np.eye(9), np.full((12, 12), np.nan)])
def test_moments_that_do_not_agree_are_refused(covariance):
    with pytest.raises(ValueError, match="covariance"):
        gaussian_prior(np.zeros((4, 3)), covariance)


def test_limbs_are_runs_without_a_branch():
    assert runs_without_branch(np.array([-1, 0, 1, 0, 1, 4, 5])) == [[1], [2], [3], [4, 5, 6]]


