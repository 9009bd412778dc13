"""Tables and files of a motion, and the motion on other bodies."""
import csv

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior

from completion.mocap.files.motion_files import joint_angles, joint_centres, rotation_vectors, write_motion_folder
from completion.mocap.retargeting.retarget import betas_over_time, lowest_heights, morph_vertices, retarget, world_up
from completion.motion import Motion
from scanprep.geometry.rotations import exp, log
from scanprep.pictures.camera import guess_upright

FRAMES = 40
BETAS = np.array([0.5, -0.5, 0.2])


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def subject(model):
    return model.subject(BETAS)


@pytest.fixture(scope="module")
def motion():
    t = np.arange(FRAMES) / 20
    poses = MEAN + np.sin(2 * t[:, None, None] + np.arange(4)[:, None]) * np.array([0.05, 0.3, 0.2])
    poses[:, 0] = np.stack([0.1 * np.sin(t), 0 * t, 6 * t], axis=1)
    trans = np.stack([1.2 * t, 0.1 * np.sin(4 * t), 0.2 * np.sin(3 * t)], axis=1)
    residuals = np.random.default_rng(0).random((FRAMES, 2))
    residuals[3, 0] = residuals[4] = np.nan
    return Motion(poses, trans, BETAS, 20.0, residuals, ("A", "B"))


def table(path):
    with open(path, newline="", encoding="utf-8") as lines:
        head, *body = csv.reader(lines)
    return head, np.array([[float(cell) if cell else np.nan for cell in row] for row in body])


def test_joint_angles_are_the_rotations_without_jumps(motion, model, subject, tmp_path):
    cut = Motion(motion.poses.copy(), motion.trans, None, 20.0, np.zeros((FRAMES, 0)))
    cut.poses[:] = log(exp(motion.poses))                          # jumps where the chart ends
    degrees = rotation_vectors(cut)
    assert np.abs(np.diff(cut.poses, axis=0)).max() > 3 and np.abs(np.diff(degrees, axis=0)).max() < 40
    np.testing.assert_allclose(exp(np.radians(degrees)), exp(motion.poses), atol=1e-9)
    write_motion_folder(tmp_path, cut, subject)
    head, rows = table(tmp_path / "joint_angles.csv")
    first, last = model.skeleton.names[0], model.skeleton.names[-1]
    assert head[:4] == ["time", f"{first}_rx", f"{first}_ry", f"{first}_rz"] and head[-1] == f"{last}_rz"
    np.testing.assert_allclose(rows[:, 1:], degrees.reshape(FRAMES, -1), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows[:, 0], np.arange(FRAMES) / 20, atol=1e-6)
    angles = joint_angles(cut, subject)
    assert list(angles) == head and np.array_equal(angles[f"{last}_rz"], degrees[:, -1, 2])


def test_joint_centres_are_those_of_the_surface(motion, subject, tmp_path):
    regressor = subject.skeleton.joint_regressor(subject.template)
    wanted = np.stack([regressor @ v for v in motion.vertices(subject)])
    np.testing.assert_allclose(joint_centres(motion, subject), wanted, atol=1e-10)
    np.testing.assert_allclose(wanted[:, 0], subject.origin + motion.trans, atol=1e-9)      # the rule of Place
    write_motion_folder(tmp_path, motion, subject)
    head, rows = table(tmp_path / "joint_centres.csv")
    assert len(head) == 13
    np.testing.assert_allclose(rows[:, 1:].reshape(FRAMES, 4, 3), wanted, rtol=1e-5, atol=1e-6)


def test_residuals_have_empty_cells_where_nothing_was_seen(motion, subject, tmp_path):
    write_motion_folder(tmp_path, motion, subject)
    head, rows = table(tmp_path / "residuals.csv")
    assert head == ["time", "mean", "A", "B"]
    np.testing.assert_allclose(rows[:, 2:], motion.residuals, rtol=1e-5)
    np.testing.assert_allclose(rows[0, 1], motion.residuals[0].mean(), rtol=1e-5)
    assert rows[3, 1] == pytest.approx(motion.residuals[3, 1], rel=1e-5) and np.isnan(rows[4, 1])


def test_a_motion_on_its_own_body_is_the_same(motion, subject):
    same = retarget(motion, subject, subject)
    np.testing.assert_allclose(same.trans, motion.trans, atol=1e-9)
    np.testing.assert_array_equal(same.poses, motion.poses)
    assert same.labels == () and same.residuals.shape == (FRAMES, 0)


def test_another_body_stands_where_the_first_does(motion, subject, model):
    other = model.subject(np.array([-2.0, 1.5, 1.0]))
    moved = retarget(motion, subject, other)
    up, sign = world_up(motion, subject)
    low, its = (lowest_heights(who, m.poses, m.trans, up, sign) for who, m in ((subject, motion), (other, moved)))
    floor = np.percentile(low, 2)
    ratio = (its - floor) / (low - floor)
    high = low - floor > 0.05
    assert high.any() and np.ptp(ratio[high]) < 1e-6                # as high in the same ratio, which is the legs'
    away = np.delete(moved.trans - moved.trans[0], up, axis=1)
    np.testing.assert_allclose(away, ratio[high][0] * np.delete(motion.trans - motion.trans[0], up, axis=1), atol=1e-9)
    np.testing.assert_array_equal(moved.betas, other.betas)


def test_up_is_found_in_whatever_axes_the_world_has(motion, subject):
    axis = guess_upright(subject.template)[0]
    for to in range(3):
        R = np.roll(np.eye(3), to - axis, axis=0)
        turned = motion.poses.copy()
        turned[:, 0] = 0.1 * motion.poses[:, 0]
        turned[:, 0] = log(R @ exp(turned[:, 0]))
        found = Motion(turned, motion.trans, BETAS, 20.0, np.zeros((FRAMES, 0)))
        assert world_up(found, subject) == (to, 1.0)


def test_a_body_that_changes_is_in_each_frame_that_of_its_betas(motion, model):
    """But for a shift along the vertical, which puts its lowest point where that of the motion's own body is."""
    betas = np.random.default_rng(0).normal(size=(FRAMES, 3))
    got, (up, sign) = morph_vertices(model, motion, betas), world_up(motion, model.subject(BETAS))
    for t in (0, 17, 39):
        away = got[t] - model.subject(betas[t]).vertices(motion.poses[t], motion.trans[t])
        assert np.abs(np.delete(away, up, axis=1)).max() < 1e-9 and np.ptp(away, axis=0).max() < 1e-9
    np.testing.assert_allclose(morph_vertices(model, motion, betas, np.array([17]))[0], got[17], atol=1e-9)
    np.testing.assert_allclose((sign * got[:, :, up]).min(axis=1),
                               lowest_heights(model.subject(BETAS), motion.poses, motion.trans, up, sign), atol=1e-9)
    still = morph_vertices(model, motion, {0.0: BETAS})
    np.testing.assert_allclose(still, motion.vertices(model.subject(BETAS)), atol=1e-9)


def test_betas_go_straight_from_key_to_key():
    got = betas_over_time({2.0: np.array([2.0, 4.0]), 1.0: np.array([0.0])}, np.array([0.0, 1.0, 1.5, 2.0, 9.0]))
    np.testing.assert_allclose(got, [[0, 0], [0, 0], [1, 2], [2, 4], [2, 4]])
    with pytest.raises(ValueError, match="expected at least one key"):
        betas_over_time({}, np.zeros(2))


def test_wrong_betas_and_bodies_are_refused(motion, model, subject):
    with pytest.raises(ValueError, match=r"betas: expected \(40, k\) with k at most 3, got \(40, 4\)"):
        morph_vertices(model, motion, np.zeros((FRAMES, 4)))
    with pytest.raises(ValueError, match=r"with k at most 3, got \(3, 3\)"):
        morph_vertices(model, motion, np.zeros((3, 3)))
    short = Motion(motion.poses[:, :3], motion.trans, None, 20.0, np.zeros((FRAMES, 0)))
    with pytest.raises(ValueError, match="expected a body of the 4 parts"):
        retarget(short, subject, subject)
