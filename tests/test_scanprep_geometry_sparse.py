"""Factored systems against dense solves."""
import pickle

import numpy as np
import pytest
from scipy.sparse import csc_array, eye_array, random_array

from scanprep.geometry.sparse import Factored, factor


def system(n=80, seed=0):
    rng = np.random.default_rng(seed)
    A = random_array((n, n), density=0.05, rng=rng)
    return csc_array(A.T @ A + 0.1 * eye_array(n))


@pytest.mark.parametrize("solver", [factor, lambda A: Factored(A).solve], ids=["factor", "Factored"])
@pytest.mark.parametrize("shape", [(80,), (80, 1), (80, 3), (80, 300)])
def test_solutions_agree_with_dense_algebra(solver, shape):
    A, b = system(), np.random.default_rng(1).normal(size=shape)
    kept = b.copy()
    x = solver(A)(b)
    assert x.shape == shape
    np.testing.assert_allclose(x, np.linalg.solve(A.toarray(), b), atol=1e-9)
    np.testing.assert_array_equal(b, kept)


@pytest.mark.parametrize("layout", [np.asfortranarray, lambda b: b[:, ::2], lambda b: b[::-1]],
                         ids=["fortran", "strided", "reversed"])
def test_right_hand_sides_may_lie_in_memory_in_any_way(layout):
    A, b = system(), layout(np.random.default_rng(2).normal(size=(80, 8)))
    solved = np.linalg.solve(A.toarray(), b)
    np.testing.assert_allclose(Factored(A).solve(b), solved, atol=1e-9)
    np.testing.assert_allclose(factor(A)(np.ascontiguousarray(b)), solved, atol=1e-9)


@pytest.mark.parametrize("solver", [factor, Factored])
@pytest.mark.parametrize("matrix", [np.diag([1.0, 0.0, 1.0]), np.diag([1.0, np.nan, 1.0]), np.full((3, 3), np.inf)],
                         ids=["singular", "NaN", "infinite"])
def test_what_has_no_one_solution_is_refused(solver, matrix):
    with pytest.raises(ValueError, match="matrix: "):
        solver(csc_array(matrix))


def test_an_empty_system_is_refused_or_solved():
    with pytest.raises(ValueError, match="matrix: expected finite entries, got a 0 x 0"):
        Factored(csc_array((0, 0)))
    assert factor(csc_array((0, 0)))(np.zeros(0)).shape == (0,)


def test_a_factored_system_can_be_sent_to_another_process():
    A, b = system(), np.random.default_rng(3).normal(size=(80, 3))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(Factored(A))).solve(b), Factored(A).solve(b))
