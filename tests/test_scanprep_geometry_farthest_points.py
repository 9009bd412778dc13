"""Farthest points against a search over all points, with any distance."""
from __future__ import annotations

import numpy as np
import pytest

from scanprep.geometry.farthest_points import farthest_points


def by_search(points, count, chosen):
    """The same, one distance table for all."""
    table = np.linalg.norm(points[:, None] - points, axis=2)
    while len(chosen) < count:
        chosen = [*chosen, int(table[chosen].min(axis=0).argmax())]
    return chosen


@pytest.mark.parametrize("start", [[3], [3, 8], None])
def test_each_is_the_farthest_from_those_before(start):
    points = np.random.default_rng(0).normal(size=(60, 3))
    first = start or [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    assert farthest_points(points, 12, start).tolist() == by_search(points, 12, first)


def test_points_in_one_place_count_once_unless_all_are_wanted():
    points = np.repeat([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], 4, axis=0)
    assert len(farthest_points(points, 10)) == 3
    assert sorted(farthest_points(points, 12, least=-0.5)) == list(range(12))
    assert len(farthest_points(points, 99, 0)) == 3 and farthest_points(points, 1, [5, 6]).tolist() == [5]
