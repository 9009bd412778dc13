"""The whole way from registered meshes to a model, for an animal: nothing in it knows of people."""
import numpy as np
import pytest
from animal_bodies import Animal, Build, random_pose

from model import LearnConfig, learn_scape
from model.fitting.vertices import fit_pose, fit_shape
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.parts import SkeletonConfig

CONFIG = LearnConfig(prunings=(0.01,), ridges=(0.001,), refinements=1)
TWELVE = SkeletonConfig(parts=12)


@pytest.fixture(scope="module")
def herd():
    """Template, its poses, other animals about at rest, and the size of the animal."""
    rng, first = np.random.default_rng(0), Animal()
    poses = np.stack([first.mesh.vertices, *(first.posed(random_pose(rng)) for _ in range(13))])
    others = np.stack([Animal(Build.random(rng)).posed(0.2 * random_pose(rng)) for _ in range(10)])
    return first.mesh, poses, others, float(np.ptp(first.straight.vertices, axis=0).max())


@pytest.fixture(scope="module")
def skeleton(herd):
    return find_skeleton(*herd[:2], TWELVE)


@pytest.fixture(scope="module")
def model(herd, skeleton):
    return learn_scape(*herd[:3], skeleton, CONFIG)


@pytest.mark.slow
def test_the_skeleton_is_found(herd, skeleton):
    """Barrel, neck and legs: parts lie within true parts, and the joints of the legs where they are."""
    mesh, _, _, size = herd
    truth = Animal().skeleton
    inside = sum(np.bincount(truth.part_of_face[skeleton.part_of_face == p],
                             mesh.face_areas[skeleton.part_of_face == p]).max() for p in range(12))
    assert inside / mesh.face_areas.sum() > 0.85
    for j in range(4, 12):
        assert np.linalg.norm(skeleton.joints - truth.joints[j], axis=1).min() < 0.04 * size


@pytest.mark.slow
def test_new_poses_and_new_animals_are_met(herd, model):
    size, rng, first = herd[3], np.random.default_rng(1), Animal()
    own = [fit_pose(model.subject(), first.posed(random_pose(rng))).mean for _ in range(3)]
    new = [fit_shape(model, Animal(Build.random(rng)).posed(random_pose(rng))).mean for _ in range(3)]
    assert max(own) < 0.01 * size and max(new) < 0.01 * size
