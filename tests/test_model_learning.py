import numpy as np
import pytest
from model_bodies import random_poses, worm, worm_model, worm_skeleton

from model import LearnConfig, learn_scape
from model.fitting.vertices import fit_pose, fit_shape
from model.learning.scape import estimate_pose_prior
from model.pose_space import PoseSpace
from model.scape import ScapeModel
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton


@pytest.fixture(scope="module")
def truth():
    return worm_model()


@pytest.fixture(scope="module")
def training(truth):
    rng = np.random.default_rng(0)
    poses = random_poses(truth, 40, rng, 0.4)
    poses[0] = 0
    shapes = np.stack([truth.vertices(p, b) for p, b in zip(random_poses(truth, 12, rng, 0.1),
                                                            rng.normal(size=(12, 3)), strict=True)])
    return truth.subject().vertices(poses), shapes


@pytest.fixture(scope="module")
def learned(truth, training):
    return learn_scape(truth.template, *training, truth.skeleton, LearnConfig(components=5, refinements=2))


def test_new_poses_of_the_truth_are_met(truth, training):
    """Data the model made itself come back; without refinement and with rigid parts alone less well."""
    rng = np.random.default_rng(1)
    rigid = ScapeModel(truth.template, truth.skeleton, PoseSpace.identity(truth.skeleton), truth.shape_space,
                       truth.pose_mean, truth.pose_covariance)
    bodies = truth.subject().vertices(random_poses(truth, 8, rng, 0.4))
    plain = learn_scape(truth.template, training[0], None, truth.skeleton, LearnConfig(refinements=0))
    refined = learn_scape(truth.template, training[0], None, truth.skeleton, LearnConfig(refinements=4))
    error, unrefined, stiff = (np.mean([fit_pose(m.subject(), y).mean for y in bodies])
                               for m in (refined, plain, rigid))
    assert error < 0.8 * unrefined and error < 0.35 * stiff


def test_new_people_of_the_truth_are_met(truth, learned):
    rng = np.random.default_rng(2)
    bodies = [truth.vertices(p, b) for p, b in zip(random_poses(truth, 4, rng, 0.1), rng.normal(size=(4, 3)),
                                                   strict=True)]
    assert np.mean([fit_shape(learned, y).mean for y in bodies]) < 2e-3
    assert learned.shape_space.explained[2] > 0.97


def test_affine_people_are_learned_exactly(truth, training):
    """S is one matrix over the whole body, so Eq. 8 has a zero, and the space one direction."""
    scale = np.linspace(0.9, 1.1, 6)
    centre = truth.template.vertices.mean(axis=0)
    people = np.stack([(truth.template.vertices - centre) * [1, s, s] for s in scale])
    still = np.broadcast_to(truth.template.vertices, (2, *truth.template.vertices.shape))
    model = learn_scape(truth.template, still, people, truth.skeleton, LearnConfig(refinements=0))
    assert model.shape_space.explained[0] > 0.9999
    fit = fit_shape(model, (truth.template.vertices - centre) * [1, 1.07, 1.07] + [1.0, 2, 3])
    assert fit.rms < 2e-5
    np.testing.assert_allclose(model.vertices(np.zeros((4, 3))), truth.template.vertices, atol=1e-6)


def test_how_people_stand_counts_as_much_as_the_poses(truth, training, learned):
    """12 people near rest and 40 wide poses: the mean lies half-way, and the people's poses are kept as examples."""
    assert learned.pose_examples.shape == (52, 4, 3) and (learned.pose_examples[:, 0] == 0).all()
    wide, near = (kind.reshape(len(kind), -1) for kind in np.split(learned.pose_examples, [40]))
    assert near.std() < 0.5 * wide.std()
    mean, covariance = estimate_pose_prior(learned.template, learned.skeleton, learned.pose_examples, 40)
    np.testing.assert_allclose(mean.ravel(), (wide.mean(axis=0) + near.mean(axis=0)) / 2, atol=1e-12)
    np.testing.assert_array_equal(learned.pose_mean, mean)
    twice = estimate_pose_prior(learned.template, learned.skeleton,
                                np.concatenate([wide, near, near]).reshape(-1, 4, 3), 40)
    np.testing.assert_allclose(twice[0], mean, atol=1e-12)
    np.testing.assert_allclose(twice[1], covariance, atol=1e-12)


def test_rigid_motion_of_the_data_changes_nothing_within(truth, training):
    rng = np.random.default_rng(3)
    from scanprep.geometry import rotations

    R = rotations.exp(rng.normal(size=(40, 3)))
    moved = training[0] @ np.swapaxes(R, -1, -2) + rng.normal(size=(40, 1, 3))
    config = LearnConfig(refinements=0)
    a = learn_scape(truth.template, training[0], None, truth.skeleton, config)
    b = learn_scape(truth.template, moved, None, truth.skeleton, config)
    pose = random_poses(truth, 1, rng)[0]
    np.testing.assert_allclose(b.vertices(pose), a.vertices(pose), atol=1e-6)


def test_a_body_of_one_part(training):
    template = worm()
    one = Skeleton(np.zeros(len(template.faces), int), [-1], [template.vertices.mean(axis=0)])
    model = learn_scape(template, training[0][:3], training[1][:4], one)
    fit = fit_pose(model.subject(), template.vertices + [1.0, 0, 0])
    assert fit.pose.shape == (1, 3) and fit.converged


def test_refuses_bad_input(truth, training):
    poses, shapes = training
    template, skeleton = truth.template, truth.skeleton
    broken = poses[:3].copy()
    broken[1, 5, 0] = np.nan
    for bad, word in ((poses[:1], "at least 2"), (poses[:, :-1], "expected shape"), (broken, "body 1")):
        with pytest.raises(ValueError, match=f"poses.*{word}"):
            learn_scape(template, bad, None, skeleton)
        with pytest.raises(ValueError, match=f"shapes.*{word}"):
            learn_scape(template, poses, bad, skeleton)
    with pytest.raises(ValueError, match=r"skeleton.*faces"):
        learn_scape(template, poses, shapes, worm_skeleton(worm(rings=20)))
    with pytest.raises(ValueError, match=r"skeleton.*joints\[0\]"):
        moved = Skeleton(skeleton.part_of_face, skeleton.parents, skeleton.joints + 0.1)
        learn_scape(template, poses, shapes, moved)
    double = Mesh(np.vstack([template.vertices, template.vertices + 5]),
                  np.vstack([template.faces, template.faces + len(template.vertices)]))
    with pytest.raises(ValueError, match="components"):
        learn_scape(double, poses, None, skeleton)
