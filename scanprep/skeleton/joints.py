"""From rigid parts to a tree with a joint on every link."""
from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, dijkstra

from .motions import Motions, fit_motions, union_costs
from .parts import PartSearch

WEAK_CONTACT = 0.2               # of the longer borders of both parts: thighs that touch are not linked
PULL_TO_RING = 0.01              # squared radians: turns smaller than 0.1 say little about where the joint is


def border_lengths(search: PartSearch, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of parts that touch (n, 2) and the length of their common border (n,), metres."""
    s = search.surface
    pairs = search.contacts(label)
    both = np.sort(label[s.pairs], axis=1)
    number = {(int(a), int(b)): i for i, (a, b) in enumerate(pairs)}
    of_pair = np.array([number.get((int(a), int(b)), len(pairs)) for a, b in both], dtype=np.int64)
    return pairs, np.bincount(of_pair, s.pair_lengths, len(pairs) + 1)[:len(pairs)]


def linked(links: np.ndarray, count: int) -> bool:
    """Whether links (n, 2) join all of `count` parts."""
    graph = coo_array((np.ones(len(links)), links.T), shape=(count, count))
    return bool(connected_components(graph, directed=False)[0] == 1)


def without_weak(pairs: np.ndarray, lengths: np.ndarray, count: int) -> np.ndarray:
    """The links (n, 2) without contacts that are short beside the other borders of both parts.

    A contact that alone holds parts together stays.
    """
    longest = np.zeros(count)
    for side in range(2):
        np.maximum.at(longest, pairs[:, side], lengths)
    weak = lengths < WEAK_CONTACT * longest[pairs].min(axis=1)
    keep = np.ones(len(pairs), dtype=bool)
    for i in np.argsort(lengths, kind="stable"):
        if weak[i]:
            keep[i] = False
            keep[i] = not linked(pairs[keep], count)
    return pairs[keep]


def to_tree(search: PartSearch, label: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge parts until those that touch form a tree.

    Of the links that lie on a loop, the one whose two parts cost least as one is merged, until there is no
    loop left: this joined the halves of crotch and chest in the paper, by hand.

    Parameters
    ----------
    search : PartSearch
    label : (F,) int

    Returns
    -------
    (F,) int
        Labels.
    (P - 1, 2) int
        Links.

    [SCAPE] §3
    """
    while True:
        count = int(label.max()) + 1
        links = without_weak(*border_lengths(search, label), count)
        if len(links) == count - 1:
            return label, links
        each = np.arange(len(links))
        loop = links[[linked(links[each != i], count) for i in each]]
        moments = search.surface.moments(label)
        extra = union_costs(moments, loop) - fit_motions(moments).cost[loop].sum(axis=1)
        a, b = loop[extra.argmin()]
        label = search.alternate(np.where(label == b, a, label), rounds=4)


def place_joints(search: PartSearch, label: np.ndarray, motions: Motions, links: np.ndarray) -> np.ndarray:
    """Points on the template that both parts of a link carry to the same place in every pose.

    Least squares over the poses. Along the axis of a hinge, and where the parts hardly turn, any point will
    do: there the joint is drawn to the centroid of the border.

    Parameters
    ----------
    search : PartSearch
    label : (F,) int
    motions : Motions of the parts
    links : (n, 2) int

    Returns
    -------
    (n, 3) float, metres
    """
    s = search.surface
    edge = s.mesh.edges[s.mesh.edge_use == 2]
    middle = s.x[edge].mean(axis=1)
    both = np.sort(label[s.pairs], axis=1)
    joints = np.empty((len(links), 3))
    for n, (a, b) in enumerate(links):
        border = (both == [min(a, b), max(a, b)]).all(axis=1)
        ring = np.average(middle[border], axis=0, weights=s.pair_lengths[border])
        dR = motions.R[a] - motions.R[b]
        gap = motions.t[a] - motions.t[b] + dR @ ring
        normal = np.einsum("mki,mkj->ij", dR, dR) / len(dR) + PULL_TO_RING * np.eye(3)
        joints[n] = ring - np.linalg.solve(normal, np.einsum("mki,mk->i", dR, gap) / len(dR))
    return joints + s.origin


def middle_part(areas: np.ndarray, centres: np.ndarray, links: np.ndarray, joints: np.ndarray) -> int:
    """The part nearest to the rest of the body, by paths through the joints, weighted by area.

    Parameters
    ----------
    areas : (P,) float
    centres : (P, 3) float, metres
    links : (P - 1, 2) int
    joints : (P - 1, 3) float, metres
    """
    P = len(areas)
    if P == 1:
        return 0
    step = sum(np.linalg.norm(centres[links[:, side]] - joints, axis=1) for side in range(2))
    graph = coo_array((np.maximum(step, 1e-9), links.T), shape=(P, P))
    return int((dijkstra(graph.tocsr(), directed=False) @ areas).argmin())
