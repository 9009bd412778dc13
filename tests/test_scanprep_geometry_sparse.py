"""Factored systems against dense solves."""
import pickle

import numpy as np
import pytest
from scipy.sparse import csc_array, eye_array, random_array
from scipy.spatial import ConvexHull

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sparse import Factored, conjugate_gradients, factor, harmonic, solve_smooth


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


@pytest.mark.parametrize("solver", [factor, Factored])
@pytest.mark.parametrize("matrix", [np.diag([1.0, 0.0, 1.0]), np.diag([1.0, np.nan, 1.0]), np.full((3, 3), np.inf)],
                         ids=["singular", "NaN", "infinite"])
def test_what_has_no_one_solution_is_refused(solver, matrix):
    with pytest.raises(ValueError, match="matrix: "):
        solver(csc_array(matrix))


def test_a_factored_system_can_be_sent_to_another_process():
    A, b = system(), np.random.default_rng(3).normal(size=(80, 3))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(Factored(A))).solve(b), Factored(A).solve(b))


@pytest.mark.parametrize("columns", [(), (2,)], ids=["one side", "two sides"])
def test_frames_are_coupled_by_their_second_differences(columns):
    """As the whole matrix says: blocks on its diagonal, and D2 of every unknown with its own stiffness."""
    rng, (T, P) = np.random.default_rng(4), (9, 3)
    roots, stiffness, rhs = rng.normal(size=(T, P, P)), rng.uniform(1, 5, P), rng.normal(size=(T, P, *columns))
    blocks = roots @ np.swapaxes(roots, 1, 2) + 0.1 * np.eye(P)
    D2 = np.diff(np.eye(T), n=2, axis=0)
    whole = np.kron(D2.T @ D2, np.diag(stiffness))
    for t in range(T):
        whole[P * t:P * t + P, P * t:P * t + P] += blocks[t]
    expected = np.linalg.solve(whole, rhs.reshape(T * P, -1)).reshape(rhs.shape)
    np.testing.assert_allclose(solve_smooth(blocks, stiffness, rhs), expected, rtol=1e-6, atol=1e-8)


def test_harmonic_values_are_means_of_their_neighbours():
    rng = np.random.default_rng(3)
    points = rng.normal(size=(300, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    faces = ConvexHull(points).simplices
    two = Mesh(np.concatenate([points, points + 5]), np.concatenate([faces, faces + len(points)]))
    values = rng.random((len(two.vertices), 2))
    known = two.vertices[:, 2] * (two.vertices[:, 2] < 2) > 0.3                       # nothing of the second piece
    filled = harmonic(two.vertex_adjacency, values, known)
    untouched = known | (two.vertices[:, 2] > 2)
    np.testing.assert_array_equal(filled[untouched], values[untouched])
    means = (two.vertex_adjacency @ filled) / two.vertex_adjacency.sum(axis=1)[:, None]
    np.testing.assert_allclose(filled[~untouched], means[~untouched], atol=1e-9)
    assert filled[~untouched].max() <= values[known].max() and filled[~untouched].min() >= values[known].min()


def test_conjugate_gradients_end_after_as_many_steps_as_there_are_values():
    rng = np.random.default_rng(5)
    values, axes = np.geomspace(1, 100, 6), np.linalg.qr(rng.normal(size=(6, 6)))[0]
    A, b, scale = axes * values @ axes.T, rng.normal(size=6), rng.uniform(0.5, 2, 6)
    found = conjugate_gradients(lambda d: A @ d, b, lambda r: scale * r, 6, 1e-12)
    np.testing.assert_allclose(A @ found, b, atol=1e-8)
