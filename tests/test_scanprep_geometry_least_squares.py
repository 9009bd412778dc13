import numpy as np
import pytest
from derivatives import differences
from scipy.sparse import csc_array

from scanprep.geometry import rotations
from scanprep.geometry.least_squares import (
    Arrow,
    Residual,
    Sparse,
    by_rotations,
    levenberg_marquardt,
    normal_equations,
    retract_pose,
)

RNG = np.random.default_rng(0)


def linear(A, b):
    return lambda x: normal_equations([Residual(x @ A.T - b, np.broadcast_to(A, (*x.shape[:-1], *A.shape)))])


def valley(x):
    """Rosenbrock's: the minimum is 0 at (1, 1)."""
    values = np.stack([10 * (x[:, 1] - x[:, 0]**2), 1 - x[:, 0]], axis=1)
    zero = np.zeros(len(x))
    J = np.stack([np.stack([-20 * x[:, 0], zero + 10], axis=1), np.stack([zero - 1, zero], axis=1)], axis=1)
    return normal_equations([Residual(values, J)])


def test_a_linear_problem_ends_at_the_least_squares_solution():
    A, b = RNG.normal(size=(9, 4)), RNG.normal(size=9)
    end = levenberg_marquardt(linear(A, b), np.zeros((1, 4)), tolerance=1e-14)
    np.testing.assert_allclose(end.x[0], np.linalg.lstsq(A, b, rcond=None)[0], atol=1e-8)
    assert end.converged.all()


def test_batch_is_the_loop():
    starts = RNG.normal(size=(4, 2))
    together = levenberg_marquardt(valley, starts, 6)
    for b in range(4):
        np.testing.assert_allclose(together.x[b], levenberg_marquardt(valley, starts[b:b + 1], 6).x[0], atol=1e-10)


def test_not_converging_is_a_fact_of_the_result_and_energy_never_rises():
    start = np.array([[-1.2, 1.0]])
    energies = [levenberg_marquardt(valley, start, i).energy[0] for i in range(8)]
    assert (np.diff(energies) <= 0).all()
    assert not levenberg_marquardt(valley, start, 2).converged[0]


@pytest.mark.parametrize("damping", [1e-6, 1.0])
def test_the_gain_is_what_the_quadratic_model_loses(damping):
    A, b = RNG.normal(size=(3, 8, 5)), RNG.normal(size=(3, 8))
    now = normal_equations([Residual(-b, A)])
    step, gain = now.step(np.full(3, damping))
    after = ((np.einsum("bmp,bp->bm", A, step) - b)**2).sum(axis=1)
    np.testing.assert_allclose(gain, now.energy - after, rtol=1e-9)
    sparse = Sparse(float(now.energy[0]), lambda: (now.gradient[0], csc_array(now.hessian[0])))
    for one, all_ in zip(sparse.step(np.array([damping])), (step[0], gain[:1]), strict=True):
        np.testing.assert_allclose(one, all_, rtol=1e-9)


@pytest.mark.parametrize("damping", [1e-6, 1.0])
def test_frames_that_share_unknowns_are_solved_as_one_system(damping):
    """The arrow's step and gain against those of the dense normal equations of the same problem."""
    B, n, S = 3, 4, 5
    A, b, C, d = (RNG.normal(size=s) for s in ((B, 9, n + S), (B, 9), (1, 6, S), (1, 6)))
    arrow = Arrow(normal_equations([Residual(-b, A)]), S, normal_equations([Residual(-d, C)]))
    whole = np.zeros((B * 9 + 6, B * n + S))
    for i in range(B):
        whole[9 * i:9 * i + 9, n * i:n * i + n], whole[9 * i:9 * i + 9, B * n:] = A[i, :, :n], A[i, :, n:]
    whole[B * 9:, B * n:] = C[0]
    dense = normal_equations([Residual(-np.concatenate([b.ravel(), d[0]])[None], whole[None])])
    np.testing.assert_allclose(arrow.energy, dense.energy)
    (step, gain), (expected, loss) = (e.step(np.array([damping])) for e in (arrow, dense))
    np.testing.assert_allclose(step[:, :n].ravel(), expected[0, :B * n], atol=1e-7)
    np.testing.assert_allclose(step[:, n:], np.tile(expected[0, B * n:], (B, 1)), atol=1e-7)
    np.testing.assert_allclose(gain, loss, rtol=1e-6)


def test_rotations_are_found_that_lie_far_away():
    """Wahba's problem, from identity to turns near π, against the solution by singular values."""
    points, R = RNG.normal(size=(5, 12, 3)), rotations.exp(3.1 * rotations.project(RNG.normal(size=(5, 3, 3)))[:, 0])
    goal = points @ np.swapaxes(R, 1, 2) + 0.01 * RNG.normal(size=(5, 12, 3))

    def equations(x):
        now = rotations.exp(x)
        J = -now[:, None] @ rotations.hat(points)
        values = points @ np.swapaxes(now, 1, 2) - goal
        return normal_equations([Residual(values.reshape(5, -1), J.reshape(5, -1, 3))])

    end = levenberg_marquardt(equations, 0.1 * RNG.normal(size=(5, 3)), 60, 1e-12, retract=rotations.compose)
    H = np.swapaxes(goal, 1, 2) @ points
    np.testing.assert_allclose(rotations.exp(end.x), rotations.project(H), atol=1e-5)
    assert (np.linalg.norm(end.x, axis=1) <= np.pi + 1e-12).all()


def test_steps_are_rotations_where_derivatives_are_by_rotation_vectors():
    """An arrow whose frames begin with two rotation vectors: its equations against finite differences."""
    x, goal = RNG.normal(size=(2, 9)), RNG.normal(size=(2, 12))

    def residual(x):
        R = rotations.exp(x[:, :6].reshape(-1, 2, 3))
        return np.concatenate([R[:, 0] @ [1, 2, 3] + x[:, 6:], (R[:, 0] @ R[:, 1]).reshape(-1, 9)], axis=1) - goal

    def equations(x):
        by_x = differences(lambda step: residual(x + step), np.zeros(9))
        return Arrow(normal_equations([Residual(residual(x), by_x)]), 3)

    found, retract = by_rotations(equations(x), x, 6).rows, retract_pose(6)
    J = differences(lambda step: residual(retract(x, np.tile(step, (2, 1)))), np.zeros(9))
    expected = normal_equations([Residual(residual(x), J)])
    np.testing.assert_allclose(found.gradient, expected.gradient, atol=1e-7)
    np.testing.assert_allclose(found.hessian, expected.hessian, atol=1e-7)
    end = levenberg_marquardt(equations, np.tile(x[:1], (2, 1)), 80, 1e-9, angles=6)
    assert (np.linalg.norm(end.x[:, :6].reshape(-1, 3), axis=1) <= np.pi + 1e-12).all() and end.converged.all()
