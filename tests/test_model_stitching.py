import numpy as np
import pytest
from model_bodies import worm, worm_skeleton

from model.gradients import edges
from model.stitching import StitchingSystem


@pytest.fixture(scope="module")
def system():
    template = worm()
    return StitchingSystem(template, worm_skeleton(template))


def root_centred(system, vertices):
    return vertices - system.root_weights @ vertices


def test_true_edges_give_back_the_body(system):
    body = worm()
    y = system.stitch(edges(body.vertices, body.faces))
    np.testing.assert_allclose(y, root_centred(system, body.vertices), atol=1e-12)


def test_agrees_with_dense_least_squares(system):
    wanted = np.random.default_rng(0).normal(size=(len(system.faces), 2, 3))
    y = system.stitch(wanted)
    dense = np.linalg.lstsq(system.edge_operator.toarray(), wanted.reshape(-1, 3), rcond=None)[0]
    np.testing.assert_allclose(y, root_centred(system, dense), atol=1e-11)


def test_batch_is_the_loop(system):
    wanted = np.random.default_rng(2).normal(size=(2, 3, len(system.faces), 2, 3))
    y = system.stitch(wanted)
    for i in np.ndindex(2, 3):
        np.testing.assert_allclose(y[i], system.stitch(wanted[i]), atol=1e-12)


def test_adjoint_of_the_solve(system):
    rng = np.random.default_rng(3)
    rhs = system.edge_operator.T @ rng.normal(size=(2 * len(system.faces), 4))
    pick = rng.normal(size=(system.n_vertices, 5))
    np.testing.assert_allclose(system.solve_adjoint(pick).T @ rhs, pick.T @ system.solve(rhs), atol=1e-10)
