import numpy as np
import pytest

from completion import energy
from completion.priors import choose_prior, gaussian_prior, joint_limits, mixture_prior, typical_poses, unbranched

PARENTS = np.array([-1, 0, 1, 0])
EXAMPLES = np.random.default_rng(7).normal(0, 0.4, (12, 4, 3)) * (np.arange(4) > 0)[:, None]


def moments(J=4, seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3 * J - 3, 3 * J - 3))
    covariance = np.zeros((3 * J, 3 * J))
    covariance[3:, 3:] = root @ root.T / 10
    return rng.normal(0, 0.3, (J, 3)), covariance


def test_whitened_poses_have_unit_covariance():
    mean, covariance = moments()
    prior = gaussian_prior(mean, covariance, shrinkage=0, floor=0)
    np.testing.assert_allclose(prior.whitening @ covariance @ prior.whitening.T, np.eye(9), atol=1e-9)
    assert prior.free == 9
    np.testing.assert_array_equal(prior.whitening[:, :3], 0)           # the root turns freely


def test_shrinkage_and_floor_make_a_covariance_of_few_poses_safe():
    rng = np.random.default_rng(1)
    poses = rng.normal(0, 0.4, (5, 12))                                 # five poses, nine angles: singular
    covariance = np.cov(poses.T)
    covariance[:3] = covariance[:, :3] = 0
    prior = gaussian_prior(poses.mean(axis=0).reshape(4, 3), covariance, 0.3, 0.05)
    inner = covariance[3:, 3:]
    wanted = 0.7 * inner + np.diag(0.3 * np.diag(inner) + 0.05**2)
    np.testing.assert_allclose(np.linalg.inv(prior.whitening[:, 3:].T @ prior.whitening[:, 3:]), wanted, atol=1e-10)


def test_typical_poses_are_steps_along_the_main_directions():
    mean, covariance = moments()
    poses = typical_poses(mean, covariance, axes=2, deviation=1.5)
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
    assert unbranched(np.array([-1, 0, 1, 0, 1, 4, 5])) == [[1], [2], [3], [4, 5, 6]]


@pytest.mark.parametrize("sharp", [False, True])
def test_the_gaussian_near_a_pose_touches_the_mixture_from_above(sharp):
    prior = mixture_prior(EXAMPLES, PARENTS, sharp=sharp)
    rng = np.random.default_rng(0)
    for _ in range(5):
        pose = EXAMPLES[rng.integers(12)] + rng.normal(0, 0.2, (4, 3))
        near = prior.near(pose)
        x = pose.reshape(1, -1)
        residual = energy.pose_prior(x, near)
        gradient = 2 * (residual.values @ residual.jacobian[0])[0]
        slope, h = np.zeros(12), 1e-6
        for i in range(12):
            step = h * (np.arange(12) == i).reshape(4, 3)
            slope[i] = (prior.energy(pose + step) - prior.energy(pose - step)) / (2 * h)
        np.testing.assert_allclose(gradient, slope, atol=1e-6 * max(1, np.abs(slope).max()))
        gap = near.energy(pose) - prior.energy(pose)
        for _ in range(20):                                              # it lies above the mixture everywhere
            other = pose + rng.normal(0, 0.5, (4, 3))
            assert near.energy(other) - gap >= prior.energy(other) - 1e-9


def test_a_mixture_of_one_kernel_a_limb_is_the_gaussian_of_each_limb():
    prior = mixture_prior(EXAMPLES, PARENTS, width=1)
    flat = EXAMPLES.reshape(12, -1)
    covariance = np.cov(flat.T)
    covariance[3:9, 9:] = covariance[9:, 3:9] = 0                        # the limbs are angles 3-8 and 9-11
    gauss = gaussian_prior(flat.mean(axis=0).reshape(4, 3), covariance)
    for pose in EXAMPLES[:4] + 0.1:
        assert prior.energy(pose) == pytest.approx(gauss.energy(pose))
        assert prior.near(pose).energy(pose) == pytest.approx(gauss.energy(pose))


def test_kernels_keep_the_covariance_of_the_poses():
    prior = mixture_prior(EXAMPLES, PARENTS, shrinkage=0, width=0.6, floor=0)
    for limb, centres, W in zip(prior.limbs, prior.centres, prior.whitenings, strict=True):
        whole = np.cov(EXAMPLES.reshape(12, -1)[:, limb].T)
        np.testing.assert_allclose(np.linalg.inv(W.T @ W) + np.cov(centres.T), whole, atol=1e-9)


def test_a_limb_is_likely_wherever_one_training_pose_had_it():
    """Arms up in half of the poses and down in the others: between is less likely than for one Gaussian."""
    poses = np.random.default_rng(2).normal(0, 0.1, (40, 4, 3))
    poses[:, 3, 0] += np.where(np.arange(40) % 2, 1.5, -1.5)
    mixture = mixture_prior(poses, PARENTS, width=0.3)
    gauss = mixture_prior(poses, PARENTS, width=1)
    up, between = np.zeros((2, 4, 3))
    up[3, 0] = 1.5
    assert mixture.energy(between) - mixture.energy(up) > 2
    assert gauss.energy(between) < gauss.energy(up)
    mixed = poses[0].copy()                                              # one limb from here, another from there
    mixed[1:3] = poses[1, 1:3]
    assert mixture.energy(mixed) < mixture.energy(between)


def test_joint_limits_begin_beyond_what_was_seen():
    limits = joint_limits(EXAMPLES, margin=0.1, give=0.05)
    assert np.isinf(limits.low[:3]).all() and np.isinf(limits.high[:3]).all()
    flat = EXAMPLES.reshape(12, -1)
    assert energy.joint_limits(flat, limits).energy.max() == 0
    x = flat.max(axis=0)
    x[:3] = 100                                                          # the root turns freely
    x[5] += 0.1 + 0.05
    assert energy.joint_limits(x, limits).energy == pytest.approx(1)
    assert np.isinf(joint_limits(np.zeros((0, 4, 3))).high).all()


def test_a_model_without_examples_has_the_gaussian():
    mean, covariance = moments()
    plain = choose_prior("mixture", mean, covariance, np.zeros((0, 4, 3)), PARENTS)
    np.testing.assert_array_equal(plain.whitening, gaussian_prior(mean, covariance).whitening)
    assert choose_prior("nearest", mean, covariance, EXAMPLES, PARENTS).sharp
    with pytest.raises(ValueError, match="pose_prior: expected gaussian, mixture or nearest, got 'best'"):
        choose_prior("best", mean, covariance, EXAMPLES, PARENTS)


@pytest.mark.parametrize("examples, width, message", [
    (EXAMPLES[:1], 0.7, "at least 2 finite poses"), (EXAMPLES[:, 0], 0.7, "at least 2 finite poses"),
    (EXAMPLES, 0.0, "width: expected more than 0"),
])
def test_examples_that_cannot_be_used_are_refused(examples, width, message):
    with pytest.raises(ValueError, match=message):
        mixture_prior(examples, PARENTS, width=width)
