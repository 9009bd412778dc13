"""Markers that come and go together: left and right."""
from __future__ import annotations

from collections.abc import Sequence


def symmetric_groups(labels: Sequence[str], pairs: Sequence[tuple[str, str]] | None = None
                     ) -> tuple[tuple[int, ...], ...]:
    """Numbers of the markers of each pair, and of each marker alone.

    Parameters
    ----------
    labels : strings
    pairs : (left, right), optional
        Without it two markers are a pair whose labels differ in a first L or R alone.

    Raises
    ------
    ValueError
        A pair of a marker that is not there, or a marker in two pairs.
    """
    place = {label: i for i, label in enumerate(labels)}
    if pairs is None:
        pairs = [(label, "R" + label[1:]) for label in labels if label[:1] == "L" and "R" + label[1:] in place]
    named = [label for pair in pairs for label in pair]
    wrong = [label for label in named if label not in place or named.count(label) > 1]
    if wrong:
        raise ValueError(f"pairs: expected markers of the candidates, each in one pair, got {wrong[0]!r}")
    groups = [tuple(sorted((place[a], place[b]))) for a, b in pairs]
    return tuple(sorted([*groups, *((i,) for label, i in place.items() if label not in named)]))
