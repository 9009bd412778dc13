"""Poses that people take, carried to a skeleton, and mixed with the few that a body was seen in."""
import numpy as np
import pytest
from model_bodies import worm_model

from model.human_poses import WORTH, human_poses, with_human_poses
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton
from scanprep.synthetic.people import BodyShape, SyntheticPerson
from scanprep.synthetic.poses import random_pose


def as_named(person, R=None):
    """The person's mesh and skeleton, turned."""
    R = np.eye(3) if R is None else R
    return (Mesh(person.mesh.vertices @ R.T, person.mesh.faces),
            Skeleton(person.part_of_face, person.parents, person.joints @ R.T, PARTS))


PARTS = SyntheticPerson.names
PERSON = SyntheticPerson(BodyShape.random(np.random.default_rng(3)))


def test_on_a_synthetic_person_they_are_those_of_the_synthetic_people():
    found = human_poses(*as_named(SyntheticPerson()), 20, np.random.default_rng(1))
    rng = np.random.default_rng(1)
    wanted = np.stack([random_pose(rng) for _ in range(20)])
    wanted[:, 0] = 0
    between = rotations.log(np.swapaxes(rotations.exp(found), -1, -2) @ rotations.exp(wanted))
    assert np.linalg.norm(between, axis=-1).max() < np.radians(8)             # the end of a hand is not quite its axis


def test_they_turn_with_the_body():
    R = rotations.exp(np.array([0.7, -1.2, 2.0]))
    straight, turned = (human_poses(*as_named(PERSON, by), 20, np.random.default_rng(1)) for by in (None, R))
    np.testing.assert_allclose(turned, straight @ R.T, atol=1e-6)


def test_a_body_that_is_no_person_has_none():
    worm = worm_model()
    assert human_poses(worm.template, worm.skeleton, 5, np.random.default_rng(0)) is None
    mean, covariance = with_human_poses(worm.template, worm.skeleton, 8, np.ones((4, 3)), np.eye(12))
    assert (mean == 1).all() and (covariance == np.eye(12)).all()


@pytest.mark.parametrize("count", [WORTH, 9 * WORTH])
def test_the_fewer_were_seen_the_more_they_count(count):
    mean, covariance = np.zeros((16, 3)), np.zeros((48, 48))
    alone, spread = with_human_poses(*as_named(PERSON), 0, mean, covariance)
    mixed, wider = with_human_poses(*as_named(PERSON), count, mean, covariance)
    share = count / (count + WORTH)
    np.testing.assert_allclose(mixed, (1 - share) * alone)
    drawn = np.random.default_rng(5).multivariate_normal(alone.ravel(), spread, 40000) \
        * (np.random.default_rng(6).random(40000) > share)[:, None]
    np.testing.assert_allclose(wider, np.cov(drawn.T), atol=0.03)          # of a draw from one or the other
    assert np.linalg.eigvalsh(wider[3:, 3:]).min() > 0 and (wider[:3] == 0).all()
