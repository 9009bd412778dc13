"""Correct labels that were exchanged throughout among the markers of one part, by the shape of the layout.

Four markers of a plate on a thigh are closer to each other than the plate is to its usual place. So their labels do not
follow from their places, but from their arrangement.
"""
from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components

ROUNDS = 10                          # most alternations of shift and assignment


def order_by_layout(places: np.ndarray, usual: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return which marker (L,) each marker really is, if labels may be exchanged within a part.

    The markers of a part may have moved together. The order with the least squared distances from the usual places is
    taken, if it is clearly better than the present labels.

    Parameters
    ----------
    places : (L, 3) float, metres
        Places of the markers on the body at rest, NaN for those that were not found.
    usual : (L, 3) float, metres
        Places of the layout.
    part : (L,) int
        The part of the body that carries each.

    Examples
    --------
    >>> plate = np.array([[0, 0, 0], [0, 0, 0.05], [0, 0.04, 0], [0, 0.04, 0.06]])
    >>> order_by_layout(plate[[0, 3, 2, 1]] + [0, 0, 0.07], plate, np.zeros(4, dtype=int)).tolist()
    [0, 3, 2, 1]
    """
    order = np.arange(len(places))
    # groups: markers of one part, then chains of markers less than 10 cm apart, since a plate may span two parts
    _, plate = connected_components(np.linalg.norm(usual[:, None] - usual, axis=2) < 0.10)
    gain = 0.5  # another order has to leave less than that share of the squared distances
    least = 0.015  # metres, root mean square, by which each changed marker has to come closer
    for group in (part, plate):
        at = np.full_like(places, np.nan)
        at[order] = places                                             # under the present labels
        change = np.arange(len(places))
        for of in np.unique(group):
            members = np.flatnonzero(group == of)
            seen = members[np.isfinite(at[members, 0])]
            if len(seen) < 3:
                continue
            as_it_is, _ = _least(at[seen], usual[members], np.searchsorted(members, seen), fixed=True)
            best, chosen = min((_least(at[seen], usual[members], start, fixed=False)
                                for start in _starts(at[seen], usual[members])), key=lambda one: one[0])
            changed = int((members[chosen] != seen).sum())
            if changed and best < gain * as_it_is and as_it_is - best > changed * least**2:
                change[seen] = members[chosen]
                # free labels go to the markers that lost theirs
                change[np.setdiff1d(members, seen)] = np.setdiff1d(members, members[chosen])
        order = change[order]
    return order


def _starts(places: np.ndarray, usual: np.ndarray) -> list[np.ndarray]:
    """Return initial orders: one for every shift that brings one place to a usual one."""
    starts = []
    for place in places:
        for goal in usual:
            apart = ((places + goal - place)[:, None] - usual)
            starts.append(linear_sum_assignment((apart**2).sum(axis=-1))[1])
    return starts


def _least(places: np.ndarray, usual: np.ndarray, chosen: np.ndarray, fixed: bool) -> tuple[float, np.ndarray]:
    """Compute the squared distances of an order after its best shift; unless fixed, improve the order in turns."""
    cost = np.inf
    for _ in range(ROUNDS):
        shift = np.median(places - usual[chosen], axis=0)
        # 0.15: metres beyond which the distance of a marker does not matter
        squared = np.minimum((((places - shift)[:, None] - usual)**2).sum(axis=-1), 0.15**2)
        better = chosen if fixed else linear_sum_assignment(squared)[1]
        cost = float(squared[np.arange(len(places)), better].sum())
        if (better == chosen).all():
            break
        chosen = better
    return cost, chosen
