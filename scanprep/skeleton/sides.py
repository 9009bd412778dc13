"""Tie left and right: one side of a symmetric body is labelled, the other is its mirror image.

Every label has a partner, the label of the mirrored triangles. A label in the middle is its own partner. On a body that
is not symmetric nothing is tied, and every label is its own partner.
"""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from ..geometry.farthest_points import farthest_points
from .labels import keep_connected, relabel
from .motions import PosedSurface, closure
from .symmetry import Symmetry


class Sides:
    """The side that is labelled and its map to the other side; without a symmetry nothing is tied.

    `half` (H,) are the triangles that are labelled. `home` (F,) is the index in `half` of every triangle or of its
    mirror image. `mirrored` (F,) bool are triangles that take the partner of their home's label.
    """

    def __init__(self, surface: PosedSurface, symmetry: Symmetry | None = None) -> None:
        F = len(surface.face_weights)
        self.tied = symmetry is not None and symmetry.two_sided
        self.mirrored = ~symmetry.left if symmetry is not None and self.tied else np.zeros(F, dtype=bool)
        self.half = np.flatnonzero(~self.mirrored)
        self.home = np.arange(F)
        if symmetry is not None and self.tied:
            number = np.full(F, -1)
            number[self.half] = np.arange(len(self.half))
            self.home = number[np.where(self.mirrored, symmetry.partner, np.arange(F))]
        # neighbours on the labelled side, and neighbours across the mirror plane
        across = self.mirrored[surface.pairs]
        own, over = ~across.any(axis=1), across[:, 0] != across[:, 1]
        self.pairs = self.home[surface.pairs[own]]
        self.lengths = surface.pair_lengths[own] * (2 if self.tied else 1)          # with the mirrored borders
        self.middle = np.bincount(self.home[surface.pairs[over]].ravel(),           # metres of border on the plane
                                  np.repeat(surface.pair_lengths[over] / 2, 2), len(self.half))
        self.areas, self.surface = surface.face_weights[self.half], surface

    def partners(self, label: np.ndarray) -> np.ndarray:
        """Find the partner (P,) of every label (F,): most of its mirrored triangles have it, and vice versa."""
        P = int(label.max()) + 1
        if not self.tied:
            return np.arange(P)
        there = self.mirrored
        table = np.bincount(label[self.half][self.home[there]] * P + label[there], minlength=P * P).reshape(P, P)
        table = table + table.T
        partner = np.where(table.any(axis=1), table.argmax(axis=1), np.arange(P))
        return np.where(partner[partner] == np.arange(P), partner, np.arange(P))

    def spread(self, label: np.ndarray, partner: np.ndarray) -> np.ndarray:
        """Extend labels of the labelled side (H,) to all triangles (F,)."""
        everywhere = label[self.home]
        return np.where(self.mirrored, partner[everywhere], everywhere)

    def relabel(self, costs: np.ndarray, price: float, label: np.ndarray, partner: np.ndarray,
                inside: np.ndarray | None = None) -> np.ndarray:
        """Improve labels (F,) for costs (F, P) and a price per metre of border, keeping every label connected.

        Only triangles `inside` (F,) bool change; the labels of the others are ignored.
        """
        here = np.arange(len(self.half)) if inside is None else np.flatnonzero(inside[self.half])
        P = costs.shape[1]
        # costs of both sides together; a label on the plane that is not its own partner has a border there
        both = costs[self.half]
        if self.tied:
            there = np.flatnonzero(self.mirrored)
            for p in range(P):
                both[:, p] += np.bincount(self.home[there], costs[there, partner[p]], len(self.half))
            both += price * self.middle[:, None] * (partner != np.arange(P))
        within = slice(None) if inside is None else np.isin(self.pairs, here).all(axis=1)
        pairs, prices = np.searchsorted(here, self.pairs[within]), price * self.lengths[within]
        labels = label[self.half][here]
        labels = relabel(both[here], pairs, prices, labels, rounds=2)
        labels = keep_connected(both[here], pairs, self.areas[here], labels)
        labels, partner = self._apart(labels, partner, here)
        out = label[self.half]
        out[here] = labels
        spread = self.spread(out, partner)
        if self.tied:
            # the mirror image of a connected label need not be connected, as triangles are not paired one to one
            region = np.ones(len(label), dtype=bool) if inside is None else inside
            number = np.cumsum(region) - 1
            pairs = number[self.surface.pairs[region[self.surface.pairs].all(axis=1)]]
            of_each = np.hstack([costs, costs[:, partner[P:]]])[region]
            spread[region] = keep_connected(of_each, pairs, self.surface.face_weights[region], spread[region])
        return spread if inside is None else np.where(inside, spread, label)

    def _apart(self, label: np.ndarray, partner: np.ndarray, here: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split a middle label that no longer touches the mirror plane into two partners."""
        if not self.tied:
            return label, partner
        at_plane = np.unique(label[self.middle[here] > 0])
        for p in np.setdiff1d(label, at_plane):
            if partner[p] == p:
                partner = np.r_[partner, p]
                partner[p] = len(partner) - 1
        return label, partner

    def join(self, label: np.ndarray, a: int, b: int, partner: np.ndarray) -> np.ndarray:
        """Merge labels a and b, and merge their partners."""
        sets = closure(a, b, partner)
        for together in sets:
            label = np.where(np.isin(label, together), together[0], label)
        return label


def reductions(pairs: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Return by how much the number of labels falls (n,) when each of the pairs (n, 2) is merged."""
    a, b = pairs.T
    return np.where((partner[a] == b) | ((partner[a] == a) & (partner[b] == b)), 1, 2)


def mirror_pairs(pairs: np.ndarray, partner: np.ndarray) -> np.ndarray:
    """Return for pairs (n, 2), lower first, the index (n,) of their mirror image, or their own if there is none."""
    number = {(int(a), int(b)): i for i, (a, b) in enumerate(pairs)}
    image = np.sort(partner[pairs], axis=1)
    return np.array([number.get((int(a), int(b)), i) for i, (a, b) in enumerate(image)], dtype=np.int64)


def cover(surface: PosedSurface, count: int, sides: Sides, rng: np.random.Generator | None = None) -> np.ndarray:
    """Divide the surface into about `count` patches (F,) around farthest points along the surface.

    The first point is the farthest from the centroid, or random with `rng`. On a symmetric body the patches of one side
    are the mirror images of those of the other.
    """
    half, n = sides.half, len(sides.half)
    centre = surface.x[surface.mesh.faces[half]].mean(axis=1)
    a, b = sides.pairs.T
    # graph of neighbouring triangles; every triangle joins the seed with the shortest path
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
