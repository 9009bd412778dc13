"""Rotations: group axioms, scipy as oracle, finite differences."""
import numpy as np
import pytest
from derivatives import slope
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from scanprep.geometry import rotations

number = st.floats(-1, 1)
direction = st.tuples(number, number, number).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


@st.composite
def twists(draw, longest=np.pi - 1e-6):
    v = draw(direction)
    return v / np.linalg.norm(v) * draw(st.floats(0, longest))


@given(twists(), twists(), twists())
def test_rotations_are_a_group(a, b, c):
    A, B, C = rotations.exp(np.stack([a, b, c]))
    np.testing.assert_allclose((A @ B) @ C, A @ (B @ C), atol=1e-14)
    np.testing.assert_allclose(rotations.exp(np.zeros(3)), np.eye(3), atol=0)
    np.testing.assert_allclose(A @ rotations.exp(-a), np.eye(3), atol=1e-14)
    np.testing.assert_allclose(A.T @ A, np.eye(3), atol=1e-14)
    assert np.linalg.det(A @ B) == pytest.approx(1)


@given(twists())
def test_log_undoes_exp(t):
    np.testing.assert_allclose(rotations.log(rotations.exp(t)), t, atol=1e-7)


@given(twists(3 * np.pi))
def test_exp_is_the_matrix_exponential(t):
    np.testing.assert_allclose(rotations.exp(t), expm(rotations.hat(t)), atol=1e-12)


@given(direction)
def test_log_at_and_around_a_half_turn(v):
    v = v / np.linalg.norm(v)
    for angle in (np.pi, np.pi - 1e-9, np.pi - 1e-4):
        back = rotations.log(rotations.exp(angle * v))
        assert np.linalg.norm(back) == pytest.approx(angle, abs=1e-6)
        assert abs(back @ v) / np.linalg.norm(back) == pytest.approx(1, abs=1e-6)


def test_log_near_zero_keeps_its_digits():
    for size in (1e-4, 1e-8, 1e-12, 0):
        t = size * np.array([1.0, -2.0, 0.5])
        np.testing.assert_allclose(rotations.log(rotations.exp(t)), t, rtol=1e-6, atol=1e-16)


@given(twists(), direction)
def test_a_rotation_is_active_and_right_handed(t, x):
    np.testing.assert_allclose(rotations.exp(t) @ x, Rotation.from_rotvec(t).apply(x), atol=1e-12)
    np.testing.assert_allclose(rotations.hat(t) @ x, np.cross(t, x), atol=1e-12)


@given(twists(3.0), direction)
def test_right_jacobian_is_the_derivative(t, d):
    change = slope(lambda s: rotations.log(rotations.exp(t).T @ rotations.exp(t + s * d)), 1e-5)
    np.testing.assert_allclose(rotations.right_jacobian(t) @ d, change, atol=1e-8)


@given(twists(3.0), direction)
def test_inverse_right_jacobian_is_the_inverse_and_the_derivative_of_log(t, d):
    J, inverse = rotations.right_jacobian(t), rotations.inverse_right_jacobian(t)
    np.testing.assert_allclose(inverse @ J, np.eye(3), atol=1e-8)
    change = slope(lambda s: rotations.log(rotations.exp(t) @ rotations.exp(s * d)))
    np.testing.assert_allclose(inverse @ d, change, atol=1e-6)


@pytest.mark.parametrize("angle", [0, 1e-9, 9.9e-4, 1.01e-3, 0.1])
def test_the_series_for_small_angles_joins_the_formula(angle):
    t = angle * np.array([0.6, 0, 0.8])
    K = rotations.hat(t)
    series = sum(np.linalg.matrix_power(-K, n) / float(np.prod(np.arange(1, n + 2))) for n in range(12))
    np.testing.assert_allclose(rotations.right_jacobian(t), series, atol=1e-10)
    np.testing.assert_allclose(rotations.inverse_right_jacobian(t), np.linalg.inv(series), atol=1e-10)


def test_projection_gives_the_nearest_rotation_and_never_a_reflection():
    rng = np.random.default_rng(1)
    M = rng.normal(size=(40, 3, 3))
    R = rotations.project(M)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    np.testing.assert_allclose(np.swapaxes(R, -1, -2) @ R, np.tile(np.eye(3), (40, 1, 1)), atol=1e-12)
    others = Rotation.random(2000, rng=rng).as_matrix()
    for m, r in zip(M, R, strict=True):
        assert np.linalg.norm(m - r) <= np.linalg.norm(m - others, axis=(1, 2)).min() + 1e-12
    np.testing.assert_allclose(rotations.project(R), R, atol=1e-12)


def test_many_projections_are_those_of_each_alone():
    """Reflections, singular matrices and nothing at all are among them."""
    rng = np.random.default_rng(2)
    M = rng.normal(size=(3, 200, 3, 3)) * np.geomspace(1e-6, 1e6, 200)[:, None, None]
    M[1] = rotations.exp(rng.normal(size=(200, 3))) + 0.1 * rng.normal(size=(200, 3, 3))
    M[2, :3] = np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.diag([1.0, 1.0, -1.0])
    every = rotations.project(M)
    alone = np.stack([rotations.project(m[None])[0] for m in M.reshape(-1, 3, 3)]).reshape(M.shape)
    np.testing.assert_allclose(every, alone, atol=1e-9)


def test_procrustes_agrees_with_scipy_with_mirrored_points_too():
    rng = np.random.default_rng(2)
    source, target = rng.normal(size=(2, 30, 3)), rng.normal(size=(2, 30, 3))
    target[1] = source[1] * (-1, 1, 1)               # a reflection fits best, a rotation is wanted
    R, t = rotations.procrustes(source, target)
    for i in range(2):
        cs, ct = source[i].mean(axis=0), target[i].mean(axis=0)
        expected = Rotation.align_vectors(target[i] - ct, source[i] - cs)[0].as_matrix()
        np.testing.assert_allclose(R[i], expected, atol=1e-8)
        np.testing.assert_allclose(t[i], ct - expected @ cs, atol=1e-8)


def test_composed_rotation_vectors_are_those_of_the_product():
    a, b = np.random.default_rng(0).normal(0, 1.5, (2, 50, 3))
    a[0], b[0], a[1], b[1] = 0, 0, [np.pi, 0, 0], 0
    found = rotations.compose(a, b)
    np.testing.assert_allclose(rotations.exp(found), rotations.exp(a) @ rotations.exp(b), atol=1e-12)
    assert np.linalg.norm(found, axis=1).max() <= np.pi + 1e-12
