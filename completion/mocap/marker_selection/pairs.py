"""Markers that come and go together: left and right."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..marker_sets.symmetry import label_pairs


def symmetric_groups(labels: Sequence[str], partners: np.ndarray | None = None) -> tuple[tuple[int, ...], ...]:
    """Numbers of the markers of each pair, and of each marker alone.

    Parameters
    ----------
    labels : L strings
    partners : (L,) int, optional
        The marker on the other side, its own number or -1 where there is none: `marker_pairs` of a layout. Without
        it labels tell, such as LELB and RELB.

    Raises
    ------
    ValueError
        Another count, or a partner whose partner is another marker.
    """
    partners = label_pairs(labels) if partners is None else np.asarray(partners, dtype=np.int64)
    each = np.arange(len(labels))
    if partners.shape != each.shape or partners.max(initial=-1) >= len(each):
        raise ValueError(f"partners: expected a marker, or -1, for each of {len(each)}, got shape {partners.shape} "
                         f"up to {partners.max(initial=-1)}")
    other = np.where(partners < 0, each, partners)
    wrong = np.flatnonzero(other[other] != each)
    if len(wrong):
        raise ValueError(f"partners: expected that the partner of {labels[other[wrong[0]]]} is {labels[wrong[0]]}, got "
                         f"{labels[other[other[wrong[0]]]]}")
    return tuple((int(i),) if i == j else (int(i), int(j)) for i, j in enumerate(other) if i <= j)
