import numpy as np
import pytest
from completion_bodies import worm_with_prior
from scipy.sparse import csr_array

from completion.energy import Residual
from completion.partial.free_surface import FreeSurface, edge_matrix
from completion.solve import MinimiseConfig, minimise
from model.gradients import edges

RNG = np.random.default_rng(0)


def linear(A, b):
    return lambda x: [Residual(x @ A.T - b, np.broadcast_to(A, (*x.shape[:-1], *A.shape)))]


def valley(x):
    """Rosenbrock's: the minimum is 0 at (1, 1)."""
    values = np.stack([10 * (x[:, 1] - x[:, 0]**2), 1 - x[:, 0]], axis=1)
    zero = np.zeros(len(x))
    J = np.stack([np.stack([-20 * x[:, 0], zero + 10], axis=1), np.stack([zero - 1, zero], axis=1)], axis=1)
    return [Residual(values, J)]


def test_a_linear_problem_ends_at_the_least_squares_solution():
    A, b = RNG.normal(size=(9, 4)), RNG.normal(size=9)
    end = minimise(linear(A, b), np.zeros((1, 4)), MinimiseConfig(tolerance=1e-14))
    np.testing.assert_allclose(end.x[0], np.linalg.lstsq(A, b, rcond=None)[0], atol=1e-8)
    assert end.converged.all()


def test_a_curved_valley_is_followed_to_its_end():
    end = minimise(valley, np.array([[-1.2, 1.0], [3.0, -2.0]]), MinimiseConfig(iterations=200, tolerance=1e-12))
    np.testing.assert_allclose(end.x, 1, atol=1e-5)
    assert (end.energy < 1e-10).all() and end.converged.all()


def test_batch_is_the_loop():
    starts = RNG.normal(size=(4, 2))
    config = MinimiseConfig(iterations=6)
    together = minimise(valley, starts, config)
    for b in range(4):
        np.testing.assert_allclose(together.x[b], minimise(valley, starts[b:b + 1], config).x[0], atol=1e-10)


def test_not_converging_is_a_fact_of_the_result_and_energy_never_rises():
    start = np.array([[-1.2, 1.0]])
    energies = [minimise(valley, start, MinimiseConfig(iterations=i)).energy[0] for i in range(8)]
    assert (np.diff(energies) <= 0).all()
    assert not minimise(valley, start, MinimiseConfig(iterations=2)).converged[0]


@pytest.fixture(scope="module")
def body():
    return worm_with_prior()


def test_edge_matrix_is_the_matrix_of_stitching(body):
    faces, n = body.template.faces, len(body.template.vertices)
    y = RNG.normal(size=(n, 3))
    difference = edges(y, faces)
    np.testing.assert_allclose(np.einsum("nd,nd->", y, edge_matrix(faces, n) @ y), (difference**2).sum())


def test_the_free_surface_minimises_equation_10(body):
    """Against the dense least squares over all edges with R, S and Q spelled out."""
    rng = np.random.default_rng(1)
    pose, betas = rng.normal(0, 0.4, (4, 3)), np.array([0.5, -1, 0.2])
    predicted = body.vertices(pose, betas)
    faces, n = body.template.faces, len(predicted)
    R = body.skeleton.part_rotations(pose)[body.skeleton.part_of_face]
    wanted = edges(body.template.vertices, faces) @ np.swapaxes(
        R @ body.shape_space.gradients(betas) @ body.pose_space.gradients(pose), -1, -2)
    rows = rng.choice(len(faces), 40, replace=False)
    bary = rng.dirichlet(np.ones(3), 40)
    C = csr_array((bary.ravel(), (np.repeat(np.arange(40), 3), faces[rows].ravel())), shape=(40, n))
    z, w = C @ predicted + rng.normal(0, 0.02, (40, 3)), rng.random(40)
    got = FreeSurface(body.template).solve(predicted, C, z, w)
    G = np.zeros((2 * len(faces), n))
    k = np.arange(len(faces))
    for j in (0, 1):
        np.add.at(G, (2 * k + j, faces[:, j + 1]), 1)
        np.add.at(G, (2 * k + j, faces[:, 0]), -1)
    A = np.vstack([G, np.sqrt(w)[:, None] * C.toarray()])
    dense = np.linalg.lstsq(A, np.vstack([wanted.reshape(-1, 3), np.sqrt(w)[:, None] * z]), rcond=None)[0]
    np.testing.assert_allclose(got, dense, atol=1e-7)


def test_without_data_the_free_surface_is_the_model(body):
    predicted = body.vertices(np.zeros((4, 3)))
    none = csr_array((0, len(predicted)))
    np.testing.assert_array_equal(FreeSurface(body.template).solve(predicted, none, np.zeros((0, 3)), np.zeros(0)),
                                  predicted)


def test_data_moved_as_one_move_the_whole_surface(body):
    predicted = body.vertices(np.zeros((4, 3)))
    C = csr_array(np.eye(len(predicted))[:50])
    shift = np.array([0.01, -0.02, 0.005])
    got = FreeSurface(body.template).solve(predicted, C, predicted[:50] + shift, np.ones(50))
    np.testing.assert_allclose(got, predicted + shift, atol=1e-6)
