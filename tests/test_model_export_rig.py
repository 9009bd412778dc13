"""Skinning weights, rigs and correctives: what the exported files are made of."""
from dataclasses import replace

import numpy as np
import pytest
from exported_worms import worm as worm_to_export  # noqa: F401 -- fixture
from exported_worms import worm_rig  # noqa: F401 -- fixture
from model_bodies import random_poses, worm, worm_skeleton

from model.blend_weights import skin_weights
from model.export.correctives import motion_correctives, rest_corrections
from model.rig import Rig, joint_places, make_rig, turn_up
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton


def placed(skeleton, pose, trans):
    """World matrices (J, 4, 4) of the joints, by plain multiplication of every joint's own with its parent's."""
    world = []
    for j, parent in enumerate(skeleton.parents):
        local = np.eye(4)
        local[:3, :3] = rotations.exp(pose[j])
        local[:3, 3] = skeleton.joints[j] - skeleton.joints[parent] if j else skeleton.joints[0] + trans
        world.append(world[parent] @ local if j else local)
    return np.array(world)


def test_labels_decay_by_the_width_along_a_tube():
    # in one dimension (1 - width² d²/dx²) w = label has the answer exp(-distance / width) / 2 beyond the border
    template = worm(161, 12)
    skeleton = worm_skeleton(template)
    weights = skin_weights(template, skeleton, 0.05)
    beyond = template.vertices[:1932, 0] - 0.3 + 0.35                     # of the border of parts 0 and 1
    near = np.abs(beyond) < 0.25
    decay = np.exp(-np.abs(beyond) / 0.05) / 2
    assert np.abs(weights[:1932, 0] - np.where(beyond > 0, 1 - decay, decay))[near].max() < 0.006


def test_weights_follow_a_moved_renumbered_and_larger_body():
    template = worm(17, 8)
    skeleton = worm_skeleton(template)
    before = skin_weights(template, skeleton, 0.1)
    rng = np.random.default_rng(3)
    order = rng.permutation(len(template.vertices))
    place = np.argsort(order)
    R = rotations.exp(np.array([0.3, -1.0, 0.5]))
    moved = Mesh(2.5 * (template.vertices @ R.T)[order] + [3.0, 0, 1], place[template.faces])
    after = skin_weights(moved, Skeleton(skeleton.part_of_face, skeleton.parents, skeleton.joints), 0.25)
    assert np.abs(after - before[order]).max() < 1e-9
    with pytest.raises(ValueError, match="width: expected a positive length"):
        skin_weights(template, skeleton, 0.0)


def test_a_rig_is_the_model_at_rest_with_shapes_linear_in_betas(model, rig):
    rest = np.zeros((4, 3))
    assert np.array_equal(rig.mesh.vertices, model.vertices(rest, np.array([0.5, -1.0])))
    for k in range(3):
        betas = np.array([0.5, -1.0, 0.0])
        betas[k] += 2
        assert np.abs(rig.mesh.vertices + 2 * rig.shapes[k] - model.vertices(rest, betas)).max() < 1e-12
    assert np.allclose(rig.skeleton.joints[0], model.skeleton.joints[0], atol=1e-12)
    assert np.abs(rig.skeleton.joints[1:] - model.skeleton.joints[1:]).max() > 1e-3, "the joints are this body's"


def test_skinning_is_the_weighted_mean_of_the_moved_parts(model, rig):
    rng = np.random.default_rng(0)
    poses, trans = random_poses(model, 3, rng), rng.normal(size=(3, 3))
    points = np.c_[rig.mesh.vertices, np.ones(len(rig.mesh.vertices))]
    for t, skinned in enumerate(rig.vertices(poses, trans)):
        world = placed(rig.skeleton, poses[t], trans[t])
        expected = 0
        for j in range(4):
            back = np.eye(4)
            back[:3, 3] = -rig.skeleton.joints[j]
            expected = expected + rig.weights[:, j, None] * (points @ (world[j] @ back).T)[:, :3]
        assert np.abs(skinned - expected).max() < 1e-12
        assert np.abs(rig.vertices(poses[t], trans[t]) - skinned).max() < 1e-12
        assert np.abs(joint_places(rig.skeleton, poses[t], trans[t]) - world[:, :3, 3]).max() < 1e-12


@pytest.mark.parametrize("up", [0, 1, 2])
def test_a_turned_rig_moves_as_the_turned_body(model, rig, up):
    U = turn_up(up)
    assert np.allclose(U @ U.T, np.eye(3)) and np.linalg.det(U) > 0 and np.allclose(U @ np.eye(3)[up], [0, 1, 0])
    rng = np.random.default_rng(1)
    pose, trans = random_poses(model, 1, rng)[0], rng.normal(size=3)
    assert np.abs(rig.with_up(up).vertices(pose @ U.T, U @ trans) - rig.vertices(pose, trans) @ U.T).max() < 1e-12


def test_bad_rigs_are_refused(model, rig):
    with pytest.raises(ValueError, match="shapes: the template's own body has none"):
        make_rig(model, None, 2)
    with pytest.raises(ValueError, match="weights: expected shape"):
        replace(rig, weights=np.ones((5, 4)) / 4)
    with pytest.raises(ValueError, match="sum to 1"):
        Rig(rig.mesh, rig.skeleton, 2 * rig.weights, rig.shapes)
    with pytest.raises(ValueError, match="up: expected 0, 1 or 2, got 3"):
        turn_up(3)


def test_corrections_undo_what_skinning_does(model, rig):
    rng = np.random.default_rng(2)
    poses = random_poses(model, 4, rng, 0.2)
    known = rng.normal(0, 0.01, (4, *rig.mesh.vertices.shape))
    found = rest_corrections(rig, poses, rig.vertices(poses, changes=known))
    assert np.abs(found - known).max() < 5e-4, "but for the damping where rotations cancel"
    stiff = Rig(rig.mesh, rig.skeleton, np.eye(4)[rig.weights.argmax(axis=1)], rig.shapes)
    found = rest_corrections(stiff, poses, stiff.vertices(poses, changes=known))
    assert np.abs(found - known).max() < 1e-12


def test_correctives_lead_to_the_exact_motion(model, rig):
    rng = np.random.default_rng(4)
    poses = random_poses(model, 6, rng, 0.3)
    subject = model.subject(np.array([0.5, -1.0]))
    exact = subject.vertices(poses)
    error = [np.abs(rig.vertices(poses) - exact).max()]
    for count in (1, 3, 6):
        found = motion_correctives(rig, subject, poses, count)
        assert found.shapes.shape == (count, *exact.shape[1:]) and found.weights.shape == (6, count)
        assert (found.weights[:, 0] == 1).all() and found.weights.min() >= 0 and found.weights.max() <= 1
        assert np.ptp(found.weights[:, 1:], axis=0) == pytest.approx(1)
        error.append(np.abs(rig.vertices(poses, changes=found.changes(np.arange(6))) - exact).max())
    assert error[0] > 0.01 > 2e-3 > error[3] and error == sorted(error, reverse=True)
