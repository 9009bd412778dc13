"""The first cover of a surface by patches, and their greedy union."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from ..geometry.farthest_points import farthest_points
from .motions import Moments, PosedSurface, rigid_costs, union_costs
from .sides import Sides, closure


def cover(surface: PosedSurface, count: int, sides: Sides, rng: np.random.Generator | None = None) -> np.ndarray:
    """(F,) patch of every triangle: about `count` seeds, each the farthest from those before, along the surface.

    The first is the farthest from the middle or, with `rng`, any. On a symmetric body the patches of one side are
    the mirror images of those of the other.
    """
    half, n = sides.half, len(sides.half)
    centre = surface.x[surface.mesh.faces[half]].mean(axis=1)
    a, b = sides.pairs.T
    step = np.linalg.norm(centre[a] - centre[b], axis=1)
    graph = csr_array(coo_array((np.r_[step, step], (np.r_[a, b], np.r_[b, a])), shape=(n, n)))
    seed = int(np.linalg.norm(centre, axis=1).argmax()) if rng is None else int(rng.integers(n))
    seeds = farthest_points(centre, -(-count // 2) if sides.tied else count, seed,
                            lambda i, limit: dijkstra(graph, indices=i, limit=limit))
    nearest = dijkstra(graph, indices=seeds, min_only=True, return_predecessors=True)[2]
    order = np.argsort(seeds)
    patch = order[np.searchsorted(seeds, nearest, sorter=order)]
    K = int(patch.max()) + 1
    return np.unique(sides.spread(patch, np.r_[np.arange(K) + K, np.arange(K)]), return_inverse=True)[1]


def agglomerate(moments: Moments, contacts: np.ndarray, count: int, partner: np.ndarray | None = None) -> np.ndarray:
    """The new number (P,) of every set after those that touch were joined, the cheapest union first, down to `count`.

    A set and its `partner` (P,), the mirror image with which it is joined too, count as one.
    """
    moments = moments[np.arange(len(moments.w))]
    cost = rigid_costs(moments)
    owner = np.arange(len(cost))
    partner = owner.copy() if partner is None else partner.copy()
    tied = bool((partner != owner).any())
    union: dict[tuple[int, int], float] = {}

    def measure(pairs: list[tuple[int, int]]) -> None:
        if pairs:
            extra = union_costs(moments, np.array(pairs)) - cost[np.array(pairs)].sum(axis=1)
            union.update(zip(pairs, extra.tolist(), strict=True))

    def price(pair: tuple[int, int]) -> float:
        a, b = int(partner[pair[0]]), int(partner[pair[1]])
        return union[pair] + union.get((min(a, b), max(a, b)), union[pair]) if tied else union[pair]

    measure([(int(a), int(b)) for a, b in contacts])
    left = int((partner >= owner).sum())
    while left > count and union:
        a, b = min(union, key=price)
        sets = closure(a, b, partner)
        gone = {c for together in sets for c in together[1:]}
        left -= len({min(c, int(partner[c])) for together in sets for c in together}) - 1
        for together in sets:
            for c in together[1:]:
                moments.absorb(together[0], c)
                owner[owner == c] = together[0]
            cost[together[0]] = rigid_costs(moments[np.array(together[:1])])[0]
        for together, other in zip(sets, sets[::-1], strict=True):
            partner[together[0]] = other[0]
        kept = {together[0] for together in sets}
        touched = [pair for pair in union if not kept.isdisjoint(pair) or not gone.isdisjoint(pair)]
        for pair in touched:
            del union[pair]
        now = {(int(owner[c]), int(owner[d])) for c, d in touched}
        measure(sorted({(min(pair), max(pair)) for pair in now if pair[0] != pair[1]}))
    return np.unique(owner, return_inverse=True)[1]


def halve(moments: Moments, contacts: np.ndarray, group: np.ndarray) -> np.ndarray:
    """What `agglomerate` down to two sets does, for many groups (P,) of sets side by side.

    Contacts (n, 2) are of sets of one group. Returns (P,) a set of those that became one; of every group two are left,
    or as many pieces as it is in.
    """
    moments = moments[np.arange(len(moments.w))]
    cost, owner, pairs = rigid_costs(moments), np.arange(len(group)), contacts
    left = np.bincount(group)
    extra = union_costs(moments, pairs) - cost[pairs].sum(axis=1) if len(pairs) else np.zeros(0)
    while True:
        open_ = left[group[pairs[:, 0]]] > 2
        pairs, extra = pairs[open_], extra[open_]
        if not len(pairs):
            return owner
        order = np.lexsort((extra, group[pairs[:, 0]]))
        first = np.r_[True, np.diff(group[pairs[order, 0]]) > 0]
        kept, gone = pairs[order[first]].T
        left[group[kept]] -= 1
        for array in moments.each():
            array[kept] += array[gone]
        cost[kept] = rigid_costs(moments[kept])
        into = np.arange(len(group))
        into[gone] = kept
        owner = into[owner]
        touched = np.isin(pairs, np.r_[kept, gone]).any(axis=1)
        now = np.sort(into[pairs[touched]], axis=1)
        now = np.unique(now[now[:, 0] != now[:, 1]], axis=0)
        fresh = union_costs(moments, now) - cost[now].sum(axis=1) if len(now) else np.zeros(0)
        pairs, extra = np.concatenate([pairs[~touched], now]), np.r_[extra[~touched], fresh]
