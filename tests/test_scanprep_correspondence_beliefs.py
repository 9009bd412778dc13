"""Belief propagation: exact on trees, the same as messages passed one at a time on loops."""
from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from scanprep.correspondence.belief_propagation import PairField, propagate

TREE = np.array([[0, 1], [2, 1], [1, 3], [3, 4]])
LOOPY = np.array([[0, 1], [1, 2], [0, 2], [2, 3], [3, 4], [4, 0]])


def random_field(edges: np.ndarray, rng: np.random.Generator, states: int = 3) -> PairField:
    n = int(edges.max()) + 1
    return PairField(rng.normal(size=(n, states)), edges, rng.normal(size=(len(edges), states, states)))


def slow(field: PairField, rounds: int, damping: float) -> np.ndarray:
    """Flooding messages, one entry at a time, as the definition says: probabilities (n, K)."""
    n, K = field.unary.shape
    links = [(i, j, field.pairwise[e]) for e, (i, j) in enumerate(field.edges)]
    links += [(j, i, field.pairwise[e].T) for e, (i, j) in enumerate(field.edges)]
    log_message = {(i, j): np.zeros(K) for i, j, _ in links}
    for _ in range(rounds):
        new = {}
        for i, j, table in links:
            m = np.zeros(K)
            for l in range(K):
                terms = [-field.unary[i, k] - table[k, l]
                         + sum(log_message[a, b][k] for a, b in log_message if b == i and a != j) for k in range(K)]
                m[l] = np.log(sum(np.exp(t) for t in terms))
            new[i, j] = damping * log_message[i, j] + (1 - damping) * (m - m.max())
        log_message = new
    belief = -field.unary + np.array([sum((log_message[a, b] for a, b in log_message if b == i), np.zeros(K))
                                      for i in range(n)])
    p = np.exp(belief)
    return p / p.sum(axis=1, keepdims=True)


@pytest.mark.parametrize("seed", range(3))
def test_matrix_products_give_the_messages_of_the_definition(seed):
    field = random_field(LOOPY, np.random.default_rng(seed))
    fast = propagate(field, 7, 0.0)
    assert fast.iterations == 7
    assert np.allclose(fast.probabilities, slow(field, 7, 0.3), atol=1e-5)


@pytest.mark.parametrize("seed", range(5))
def test_marginals_on_a_tree_are_those_of_all_assignments(seed):
    field = random_field(TREE, np.random.default_rng(seed))
    total = np.zeros_like(field.unary)
    for states in product(range(3), repeat=len(total)):
        total[np.arange(len(total)), states] += np.exp(-field.energy(np.array(states)))
    found = propagate(field, 200, 1e-9)
    assert found.converged
    assert np.allclose(found.probabilities, total / total.sum(axis=1, keepdims=True), atol=1e-5)


def test_variables_without_edges_keep_their_own_opinion():
    field = PairField(np.array([[1.0, 0.0], [0.0, 3.0]]), np.zeros((0, 2), dtype=int), np.zeros((0, 2, 2)))
    found = propagate(field, 40)
    assert found.converged and found.states.tolist() == [1, 0]
    assert np.allclose(found.probabilities, [[1 / (1 + np.e), np.e / (1 + np.e)],
                                             [1 / (1 + np.exp(-3)), np.exp(-3) / (1 + np.exp(-3))]])


def test_states_that_are_not_there_are_never_believed():
    field = random_field(LOOPY, np.random.default_rng(1))
    unary = field.unary.copy()
    unary[2, 1] = np.inf
    found = propagate(PairField(unary, field.edges, field.pairwise), 40)
    assert found.probabilities[2, 1] < 1e-20 and np.isfinite(found.probabilities).all()
