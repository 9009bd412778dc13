"""Surface distances whose true value is known."""
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

sys.path.insert(0, str(Path(__file__).with_name("benchmarks")))
from surface_distances import surface_distance

from scanprep.geometry.mesh import Mesh


def ball(radius, subdivisions=4):
    sphere = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(sphere.vertices, sphere.faces)


def square(height, side=1.0):
    x = side / 2 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    return Mesh(np.c_[x, np.full(4, height)], [[0, 1, 2], [0, 2, 3]])


def test_balls_in_one_another():
    found = surface_distance(ball(0.5), ball(0.6), samples=5000)
    for way in (found, found.a_to_b, found.b_to_a):
        for value in (way.mean, way.rms, way.p95, way.hausdorff):
            assert value == pytest.approx(0.1, abs=2e-3)


def test_both_ways_differ_where_one_surface_is_larger():
    small, large = square(0), square(0, side=3)
    found = surface_distance(small, large, samples=200_000)
    assert found.a_to_b.hausdorff < 1e-9
    assert found.b_to_a.hausdorff == pytest.approx(np.sqrt(2))               # a corner to a corner: exact
    assert found.hausdorff == found.b_to_a.hausdorff
    # Of the area 9 the ring around: four strips of mean 1/2, four corners of mean (√2 + asinh 1) / 3.
    mean = (4 * 0.5 + 4 * (np.sqrt(2) + np.arcsinh(1)) / 3) / 9
    assert found.b_to_a.mean == pytest.approx(mean, rel=0.01)
    assert found.b_to_a.rms == pytest.approx(np.sqrt((4 / 3 + 4 * 2 / 3) / 9), rel=0.01)
    assert found.mean == pytest.approx((found.a_to_b.mean + found.b_to_a.mean) / 2)
    assert found.rms == pytest.approx(found.b_to_a.rms / np.sqrt(2))
    back = surface_distance(large, small, samples=200_000)
    assert back.mean == pytest.approx(found.mean, rel=0.01) and back.hausdorff == found.hausdorff
