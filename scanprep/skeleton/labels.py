"""Label triangles by a Markov random field: unary costs, and a price (Potts) for every border between labels."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from ..geometry.sparse import label_components


def field_energy(costs: np.ndarray, pairs: np.ndarray, prices: np.ndarray, label: np.ndarray) -> float:
    """Compute the energy of a labelling (F,): unary costs (F, P), and prices (n,) of neighbours (n, 2) that differ."""
    differ = label[pairs[:, 0]] != label[pairs[:, 1]]
    return float(costs[np.arange(len(label)), label].sum() + prices[differ].sum())


def relabel(costs: np.ndarray, pairs: np.ndarray, prices: np.ndarray, label: np.ndarray,
            rounds: int = 3) -> np.ndarray:
    """Lower the energy of a labelling by α-expansion moves, each of them optimal, until none improves it.

    Arguments as for `field_energy`; returns the new labels (F,).

    [Articulated] E-step
    """
    around = np.bincount(pairs.ravel(), np.repeat(prices, 2), len(label))
    unit = max(costs.mean() * 1e-4, np.finfo(float).tiny)       # resolution of the integer capacities
    energy = field_energy(costs, pairs, prices, label)
    vain = np.zeros(costs.shape[1], dtype=bool)              # labels whose expansion cannot improve anything now
    for _ in range(rounds):
        for alpha in np.flatnonzero(~vain).tolist():
            gain = costs[:, alpha] - costs[np.arange(len(label)), label]
            free = (label != alpha) & (gain < around)        # others lose more than all their borders cost
            turned = _expand(gain, pairs, prices, label, alpha, free, unit) & free if free.any() else free
            if turned.any():
                label = np.where(turned, alpha, label)
                vain[:] = False
            vain[alpha] = True                               # its optimal move is done
        before, energy = energy, field_energy(costs, pairs, prices, label)
        if energy >= before * (1 - 1e-5):
            break
    return label


def _expand(gain: np.ndarray, pairs: np.ndarray, prices: np.ndarray, label: np.ndarray, alpha: int,
            free: np.ndarray, unit: float) -> np.ndarray:
    """Find the triangles (F,) bool with label `alpha` in the optimal expansion, where any free one may switch to it.

    With x = 1 for a triangle that switches, a pair (i, j) costs, up to linear terms, W (1 - x_i) x_j with W ≥ 0. A
    triangle whose own cost outweighs all its neighbours is decided without a cut. The rest is a minimum cut.
    """
    # only free triangles and their neighbours matter
    near = free[pairs].any(axis=1)
    node, number = np.unique(np.r_[pairs[near].ravel(), np.flatnonzero(free)], return_inverse=True)
    i, j = number[:2 * near.sum()].reshape(-1, 2).T
    price, old = prices[near], label[node]
    # cost of each pair when none, only j, or only i switches, rewritten as linear terms and W
    keep_cost = np.where(old[i] != old[j], price, 0)
    j_turns = np.where(old[i] != alpha, price, 0)
    i_turns = np.where(old[j] != alpha, price, 0)
    n = len(node)
    own = gain[node] + np.bincount(i, i_turns - keep_cost, n) - np.bincount(j, i_turns, n)
    own, W = np.rint(own / unit), np.rint((j_turns + i_turns - keep_cost) / unit)
    # decide what is certain, again and again; fold the decided ones into the costs of their neighbours
    state = np.where(old == alpha, 1, np.where(free[node], -1, 0))    # 1 turns or is alpha, 0 keeps, -1 open
    own, i, j, W = _fold(own, i, j, W, state >= 0, state)
    while True:
        sure = (state < 0) & (np.abs(own) >= np.bincount(np.r_[i, j], np.r_[W, W], n))
        if not sure.any():
            break
        state[sure] = own[sure] < 0
        own, i, j, W = _fold(own, i, j, W, sure, state)
    if (state < 0).any():
        state = _cut(own, i, j, W, state)
    out = label == alpha
    out[node[state == 1]] = True
    return out


def _fold(own: np.ndarray, i: np.ndarray, j: np.ndarray, W: np.ndarray, new: np.ndarray, state: np.ndarray
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Turn pairs with a newly decided side (bool) into unary costs of the other side."""
    to_i, to_j = new[j] & (state[j] == 1), new[i] & (state[i] == 0)
    own = own - np.bincount(i[to_i], W[to_i], len(own)) + np.bincount(j[to_j], W[to_j], len(own))
    left = ~new[i] & ~new[j] & (W > 0)
    return own, i[left], j[left], W[left]


def _cut(own: np.ndarray, i: np.ndarray, j: np.ndarray, W: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Decide the rest by a minimum cut: the source side keeps its label, the sink side switches."""
    node = np.flatnonzero(state < 0)
    number = np.full(len(own), -1)
    number[node] = np.arange(len(node))
    source, sink = len(node), len(node) + 1
    unary = own[node].astype(np.int64)
    up, down = np.flatnonzero(unary > 0), np.flatnonzero(unary < 0)
    # graph: pairs with W, source to those that lose by switching, those that gain to the sink
    rows = np.r_[number[i], np.full(len(up), source), down]
    columns = np.r_[number[j], up, np.full(len(down), sink)]
    capacity = np.r_[W, unary[up], -unary[down]]
    if capacity.max(initial=0) > 2**29:               # sums must fit into 32 bits
        capacity = np.ceil(capacity * (2.0**29 / capacity.max()))
    graph = csr_array(coo_array((capacity.astype(np.int32), (rows, columns)), shape=(sink + 1, sink + 1)))
    # what the source still reaches in the residual graph lies on its side of the cut
    rest = graph - maximum_flow(graph, source, sink).flow
    rest.data = (rest.data > 0).astype(np.int32)
    rest.eliminate_zeros()
    keeps = np.zeros(sink + 1, dtype=bool)
    keeps[breadth_first_order(rest, source, return_predecessors=False)] = True
    out = state.copy()
    out[node] = ~keeps[:source]
    return out


def label_patches(pairs: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Number the connected pieces (F,) of equal labels."""
    a, b = pairs[label[pairs[:, 0]] == label[pairs[:, 1]]].T
    return label_components(a, b, len(label))


def keep_connected(costs: np.ndarray, pairs: np.ndarray, areas: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Make every label connected: smaller pieces go to the neighbouring label where they cost least."""
    label = label.copy()
    for _ in range(len(label)):
        before = label.copy()
        piece = label_patches(pairs, label)
        size = np.bincount(piece, areas)
        of_piece = np.zeros(len(size), dtype=np.int64)
        of_piece[piece] = label
        # the largest piece of each label is its main one; all others are stray
        main = np.full(costs.shape[1], -1)
        order = np.argsort(size, kind="stable")
        main[of_piece[order]] = order
        stray = [c for c in order if main[of_piece[c]] != c]
        if not stray:
            break
        for c in stray:
            inside = piece == c
            across = np.r_[pairs[inside[pairs[:, 0]] & ~inside[pairs[:, 1]], 1],
                           pairs[inside[pairs[:, 1]] & ~inside[pairs[:, 0]], 0]]
            around = np.setdiff1d(label[across], of_piece[c])
            if len(around):
                label[inside] = around[np.argmin(costs[np.ix_(inside, around)].sum(axis=0))]
        if np.array_equal(label, before):                # the rest touches no other label
            break
    return label
