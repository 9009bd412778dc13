"""Functional maps: known spectrum of the sphere, a body maps to itself, a bent body by its seeds."""
from __future__ import annotations

import numpy as np
import pytest
from matching_bodies import bent, crab

from scanprep.correspondence.functional import (
    FunctionalConfig,
    find_functional_correspondences,
    first_map,
    nearest_functions,
    spectrum,
    zoom_out,
)
from scanprep.correspondence.sheet import Sheet
from scanprep.geometry.mesh import Mesh
from scanprep.registration.matches import Target

SMALL = FunctionalConfig(first=12, last=50, spacing=0.02, sample=400, points=120)


def ball(count: int = 3000) -> Target:
    """Points spread evenly over the unit sphere."""
    k = np.arange(count) + 0.5
    polar, turn = np.arccos(1 - 2 * k / count), np.pi * (1 + 5**0.5) * k
    x = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    return Target(x, x, np.zeros(count, dtype=bool), True)


def sheet_of(mesh: Mesh) -> Sheet:
    size = float(np.sqrt(mesh.face_areas.sum()))
    return Sheet(Target(mesh.vertices, mesh.vertex_normals, np.zeros(len(mesh.vertices), dtype=bool), True),
                 SMALL.spacing * size)


def test_the_spectrum_of_a_sphere_is_known():
    found = spectrum(Sheet(ball(), 0.05), 16)
    degree = np.repeat(np.arange(4), [1, 3, 5, 7])
    assert np.allclose(found.values[1:] / found.values[1:4].mean(), (degree * (degree + 1) / 2)[1:], rtol=0.06)
    gram = found.functions.T @ (found.mass[:, None] * found.functions)
    assert np.allclose(gram, np.eye(16), atol=1e-8)


def test_a_body_maps_to_itself():
    a = spectrum(sheet_of(crab()), SMALL.last)
    marks = np.array([5, 300, 500])
    C = first_map(a, a, (marks, marks), SMALL)
    assert np.abs(C - np.eye(SMALL.first)).max() < 0.1
    sample = np.arange(0, len(a.mass), 3)
    assert (nearest_functions(a, a, zoom_out(a, a, C, sample, SMALL), sample) == sample).mean() > 0.98


def test_a_bent_body_by_its_seeds():
    body = crab()
    truth = body.with_vertices(bent(body, np.array([0.0, 0.0, 0.4]), np.array([0.0, 0.4, 0.0])))
    marks = np.array([820, 821, 9 * 20, 20 * 20, 20 * 20 + 10, 31 * 20 + 5])
    found = find_functional_correspondences(body, truth, (marks, truth.vertices[marks]), SMALL)
    apart = np.linalg.norm(truth.vertices[found.template_vertices] - found.scan_points, axis=1)
    assert len(found) == 120 and np.median(apart) < 0.03


def test_a_scan_with_too_few_points_is_refused():
    with pytest.raises(ValueError, match="points"):
        find_functional_correspondences(crab(), crab().vertices[:30], None, SMALL)


def test_wrong_seeds_are_refused():
    body = crab()
    with pytest.raises(ValueError, match="seeds: expected at least 3"):
        find_functional_correspondences(body, body, (np.array([0, 1]), body.vertices[:2]), SMALL)
    with pytest.raises(ValueError, match="seeds: vertex 999999"):
        find_functional_correspondences(body, body, (np.array([0, 1, 999999]), body.vertices[:3]), SMALL)
