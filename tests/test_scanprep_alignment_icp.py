"""Rigid alignment against transforms that are known by construction."""
from __future__ import annotations

import numpy as np
import pytest
from jointed_bodies import crab
from scanned_shapes import bumpy

from scanprep.alignment.icp import RigidConfig, align_landmarks, align_rigid, apply
from scanprep.geometry import rotations


def transform(twist, translation, scale=1.0):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = scale * rotations.exp(np.array(twist)), translation
    return T


def test_landmarks_give_back_a_similarity():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(5, 3))
    T = transform([0.4, -2.0, 1.0], [3, -1, 2], 1.7)
    found = align_landmarks(source, apply(T, source), scale=True)
    np.testing.assert_allclose(found.T_target_source, T, atol=1e-12)
    assert found.rms < 1e-12 and found.converged
    rigid = align_landmarks(source, apply(T, source))
    np.testing.assert_allclose(np.linalg.det(rigid.T_target_source[:3, :3]), 1, atol=1e-12)
    assert rigid.rms > 0.1


def test_mirrored_landmarks_never_give_a_reflection():
    source = np.random.default_rng(1).normal(size=(8, 3))
    found = align_landmarks(source, source * [-1, 1, 1])
    np.testing.assert_allclose(np.linalg.det(found.T_target_source[:3, :3]), 1, atol=1e-12)


def test_surface_gives_back_a_small_motion():
    body = crab()
    T = transform([0.1, 0.15, -0.1], [0.03, -0.04, 0.02])
    found = align_rigid(body, body.with_vertices(apply(T, body.vertices)))
    np.testing.assert_allclose(found.T_target_source, T, atol=1e-5)
    assert found.converged and found.rms < 1e-5


def test_landmarks_start_what_is_far_away():
    body = crab()
    T = transform([0.0, 0.0, 2.8], [2, 1, 0])
    moved = body.with_vertices(apply(T, body.vertices))
    some = np.array([3, 200, 500, 800])
    noisy = moved.vertices[some] + np.random.default_rng(2).normal(0, 0.01, (4, 3))
    found = align_rigid(body, moved, (body.vertices[some], noisy))
    np.testing.assert_allclose(found.T_target_source, T, atol=1e-5)


def test_clutter_and_missing_data_are_trimmed():
    rng = np.random.default_rng(3)
    body = crab()
    points = body.sample(6000, rng)[0]
    points = points[points[:, 0] < 0.25]                     # an arm is missing
    T = transform([0.05, -0.08, 0.1], [0.02, 0.01, -0.03])
    clutter = rng.uniform(-1, 1, (150, 3)) + [0, 0, 2]
    found = align_rigid(points, np.vstack([apply(T, body.vertices), clutter]), config=RigidConfig(keep=0.9))
    away = rotations.log(found.T_target_source[:3, :3].T @ T[:3, :3])
    assert np.linalg.norm(away) < np.deg2rad(0.5)
    assert np.linalg.norm(apply(found.T_target_source, points) - apply(T, points), axis=1).max() < 0.005


def test_what_lies_beyond_the_border_of_the_target_does_not_pull():
    """Two thirds of a body have no partner on the part of it that is the target, but for its border."""
    body, T = bumpy(4), transform([0.02, -0.01, 0.015], [0.001, -0.002, 0.001])
    part = body.submesh(body.corners.mean(axis=1)[:, 2] > 0.05)[0]
    found = align_rigid(body, part.with_vertices(apply(T, part.vertices)), config=RigidConfig(keep=1.0))
    np.testing.assert_allclose(found.T_target_source, T, atol=1e-6)
    assert found.inliers < len(part.vertices) < 0.4 * len(body.vertices)


def test_equivariant_under_a_rigid_motion_of_the_target():
    body = crab()
    target = body.with_vertices(apply(transform([0.1, 0, 0.05], [0.02, 0, 0]), body.vertices))
    M = transform([0.5, 0.2, -0.9], [1, 2, 3])
    first = align_rigid(body, target).T_target_source
    second = align_rigid(body, target.with_vertices(apply(M, target.vertices)), start=M).T_target_source
    np.testing.assert_allclose(second, M @ first, atol=1e-5)


@pytest.mark.parametrize(("source", "target", "word"), [
    (np.zeros((2, 3)), np.zeros((2, 3)), "at least 3"),
    (np.zeros((4, 3)), np.zeros((5, 3)), "target"),
    (np.full((4, 3), np.nan), np.zeros((4, 3)), "source"),
    (np.zeros((4, 2)), np.zeros((4, 3)), "source")])
def test_bad_landmarks_are_named(source, target, word):
    with pytest.raises(ValueError, match=word):
        align_landmarks(source, target)


def test_empty_input_is_named():
    with pytest.raises(ValueError, match="source"):
        align_rigid(np.zeros((0, 3)), crab())
    with pytest.raises(ValueError, match="target"):
        align_rigid(crab(), np.zeros((0, 3)))
