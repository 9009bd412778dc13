"""Labels that were exchanged among the markers of one part of the body, all the time: told by the shape of the layout.

Four markers of a plate on a thigh lie closer to each other than the plate lies to its usual place. Which of them is
which is not told by where they are, but by how they lie to each other.
"""
from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

ROUNDS = 10


def order_by_layout(places: np.ndarray, usual: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Which marker (L,) each of the markers truly is, if those of one part may bear each other's label.

    The markers of a part may have moved together; of all orders the one is taken that leaves the least of the squared
    distances from the usual places, where it is clearly better than the labels as they are.

    Parameters
    ----------
    places : (L, 3) float, metres
        Where the markers were found on the body at rest, NaN for those that were not.
    usual : (L, 3) float, metres
        Where the layout has them.
    part : (L,) int
        The part of the body that carries each.

    Examples
    --------
    >>> plate = np.array([[0, 0, 0], [0, 0, 0.05], [0, 0.04, 0], [0, 0.04, 0.06]])
    >>> order_by_layout(plate[[0, 3, 2, 1]] + [0, 0, 0.07], plate, np.zeros(4, dtype=int)).tolist()
    [0, 3, 2, 1]
    """
    order = np.arange(len(places))
    # markers of one part, then those that are near each other: a plate may lie over two parts
    # metres between markers of one plate or hand
    _, plate = connected_components(np.linalg.norm(usual[:, None] - usual, axis=2) < 0.10)
    gain = 0.5  # share of the squared distances that another order leaves at most
    least = 0.015  # metres by which each marker that changes has to come closer, in the square mean
    for group in (part, plate):
        at = np.full_like(places, np.nan)
        at[order] = places                                             # under the labels they have by now
        change = np.arange(len(places))
        for of in np.unique(group):
            mine = np.flatnonzero(group == of)
            seen = mine[np.isfinite(at[mine, 0])]
            if len(seen) < 3:
                continue
            as_it_is, _ = _least(at[seen], usual[mine], np.searchsorted(mine, seen), fixed=True)
            best, chosen = min((_least(at[seen], usual[mine], start, fixed=False)
                                for start in _starts(at[seen], usual[mine])), key=lambda one: one[0])
            changed = int((mine[chosen] != seen).sum())
            if changed and best < gain * as_it_is and as_it_is - best > changed * least**2:
                change[seen] = mine[chosen]
                # labels that are given up go to the markers that lost theirs
                change[np.setdiff1d(mine, seen)] = np.setdiff1d(mine, mine[chosen])
        order = change[order]
    return order


def _starts(places: np.ndarray, usual: np.ndarray) -> list[np.ndarray]:
    """Orders to begin with: after every shift that brings one place to one of the usual ones."""
    starts = []
    for place in places:
        for goal in usual:
            apart = ((places + goal - place)[:, None] - usual)
            starts.append(linear_sum_assignment((apart**2).sum(axis=-1))[1])
    return starts


def _least(places: np.ndarray, usual: np.ndarray, chosen: np.ndarray, fixed: bool) -> tuple[float, np.ndarray]:
    """The squared distances that an order leaves after the shift that suits it, and that order, improved if not fixed.
    """
    cost = np.inf
    for _ in range(ROUNDS):
        shift = np.median(places - usual[chosen], axis=0)
        # metres from its place, all markers of the part moved together, that still counts
        squared = np.minimum((((places - shift)[:, None] - usual)**2).sum(axis=-1), 0.15**2)
        better = chosen if fixed else linear_sum_assignment(squared)[1]
        cost = float(squared[np.arange(len(places)), better].sum())
        if (better == chosen).all():
            break
        chosen = better
    return cost, chosen
