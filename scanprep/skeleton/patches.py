"""The first cover of a surface by patches, and their greedy union."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from .motions import Moments, PosedSurface, fit_motions, union_costs


def cover(surface: PosedSurface, count: int) -> np.ndarray:
    """(F,) patch of every triangle: `count` seeds, each the farthest from those before, along the surface."""
    centre = surface.x[surface.mesh.faces].mean(axis=1)
    a, b = surface.pairs.T
    step = np.linalg.norm(centre[a] - centre[b], axis=1)
    n = len(centre)
    graph = csr_array(coo_array((np.r_[step, step], (np.r_[a, b], np.r_[b, a])), shape=(n, n)))
    distance, patch = np.full(n, np.inf), np.zeros(n, dtype=np.int64)
    seed = int(np.linalg.norm(centre, axis=1).argmax())
    for k in range(count):
        ahead = dijkstra(graph, indices=seed, limit=distance.max())
        nearer = ahead < distance
        patch[nearer], distance[nearer] = k, ahead[nearer]
        seed = int(distance.argmax())
    return np.unique(patch, return_inverse=True)[1]


def agglomerate(moments: Moments, contacts: np.ndarray, count: int) -> np.ndarray:
    """Join sets that touch, each time the pair whose union costs least more, until `count` are left.

    Parameters
    ----------
    moments : Moments of P sets
    contacts : (n, 2) int
    count : int

    Returns
    -------
    (P,) int, the new number of every set, 0..count-1
    """
    moments = moments[np.arange(len(moments.w))]
    cost = fit_motions(moments).cost
    owner = np.arange(len(cost))
    union: dict[tuple[int, int], float] = {}

    def measure(pairs: list[tuple[int, int]]) -> None:
        if pairs:
            union.update(zip(pairs, union_costs(moments, np.array(pairs)), strict=True))

    measure([(int(a), int(b)) for a, b in contacts])
    left = len(cost)
    while left > count and union:
        a, b = min(union, key=lambda pair: union[pair] - cost[pair[0]] - cost[pair[1]])
        cost[a] = union[a, b]
        moments.absorb(a, b)
        owner[owner == b] = a
        left -= 1
        touched = [pair for pair in union if a in pair or b in pair]
        others = {c for pair in touched for c in pair} - {a, b}
        for pair in touched:
            del union[pair]
        measure([(min(a, c), max(a, c)) for c in sorted(others)])
    return np.unique(owner, return_inverse=True)[1]
