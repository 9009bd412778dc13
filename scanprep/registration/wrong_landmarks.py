"""Which landmarks are wrong, where a body does not fit the scan: exchanged names, or one at another place.

Paths along the surface are as long in every pose, so they show which names may be exchanged and which landmark may be
elsewhere. The body is then fitted again without that fault. What it explains far better is named.
"""
from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.sides import other_side, side_of
from ..geometry.target import target_of
from ..judgement import HAND, size
from .matches import Landmarks
from .paths import path_lengths

# A fault is named if without it this share of the misfit is left, and at least 1 less: one limit's worth.
BETTER = 0.5
LEAST = 5                       # landmarks that are needed to tell which of them is wrong
FAULTS = 2                      # exchanged pairs that are tried, and landmarks that are left out; each costs a fit


def find_wrong_landmarks(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks, names: Sequence[str],
                         misfit: float, fit_again: Callable[[Landmarks], tuple[float, np.ndarray]]) -> str | None:
    """Name the fault in the landmarks of a body that does not fit, with what to do; None if none explains it.

    Parameters
    ----------
    template : Mesh
        N vertices.
    scan : Mesh or (n, 3) float, metres
        The scan.
    landmarks : ((L,) int, (L, 3) float, metres)
        Vertices of the template and points of the scan.
    names : sequence of L str
        Their names.
    misfit : float
        What speaks against the body as it is; 1 is the limit of one reason.
    fit_again : callable
        Fits the body to other landmarks, and returns its misfit and vertices (N, 3), metres.

    Returns
    -------
    str or None
    """
    vertices, points = landmarks
    if len(names) < LEAST:
        return None
    strange = _compare_paths(template, scan, landmarks)
    best, fault = min(BETTER * misfit, misfit - 1), None
    # names exchanged: of two landmarks, or left and right of all; a fit that leaves no doubt ends the search
    for order in [*_exchange_pairs(names, strange), *_exchange_sides(names)]:
        if fault and best < 1:
            break
        rest = fit_again((vertices, points[order]))[0]
        if rest < best:
            pair = [f"'{names[i]}'" for i in np.flatnonzero(order != np.arange(len(order))).tolist()]
            best, fault = rest, f"the landmarks {' and '.join(pair)} seem exchanged" if len(pair) == 2 else (
                "left and right of the landmarks seem exchanged, or the scan is a mirror image")
    # a landmark at another place than the body has it without
    for i in _find_strange(strange) if fault is None else ():
        kept = np.arange(len(names)) != i
        rest, body = fit_again((vertices[kept], points[kept]))
        apart = np.linalg.norm(body[vertices[i]] - points[i])
        if rest < best and apart > HAND * size(template) / 2:
            best, fault = rest, f"the landmark '{names[i]}' seems to be {100 * apart:.0f} cm from its place"
    return fault and f"{fault}: correct the file, or click anew with scape pick"


def _compare_paths(template: Mesh, scan: Mesh | np.ndarray, landmarks: Landmarks) -> np.ndarray:
    """Compare the paths between landmarks on template and scan, (L, L) metres each; return both, the scan's scaled."""
    target, cell = target_of(scan), 0.012 * size(template)
    nearest = cKDTree(target.points).query(landmarks[1])[1]
    on_scan = path_lengths(target.points, target.normals, landmarks[1], cell, target.oriented)[nearest]
    on_template = path_lengths(template.vertices, template.vertex_normals, template.vertices[landmarks[0]],
                               cell)[landmarks[0]]
    pairs = np.triu_indices(len(nearest), 1)
    scale = np.median(on_scan[pairs] / np.maximum(on_template[pairs], cell))
    return np.stack([on_template, (on_scan + on_scan.T) / 2 / scale])


def _misfit_of(paths: np.ndarray, order: np.ndarray) -> float:
    """Compute how much the paths of some landmarks, in an `order` of those of the scan, differ: mean over the pairs."""
    a, b = np.array(list(combinations(range(len(order)), 2))).T
    apart = np.abs(paths[0][a, b] - paths[1][order[a], order[b]])
    return float((apart / (paths[0][a, b] + paths[1][order[a], order[b]])).mean())


def _exchange_pairs(names: Sequence[str], paths: np.ndarray) -> list[np.ndarray]:
    """Return the orders (L,) in which two landmarks are exchanged and the paths fit better than as they are."""
    orders = []
    for i, j in combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[i, j]] = j, i
        orders.append((_misfit_of(paths, order), order))
    orders = [one for one in orders if one[0] < _misfit_of(paths, np.arange(len(names)))]
    return [order for _, order in sorted(orders, key=lambda one: one[0])[:FAULTS]]


def _exchange_sides(names: Sequence[str]) -> list[np.ndarray]:
    """Return the order (L,) in which left and right of all landmarks are exchanged; none with less than two pairs."""
    place = {name: i for i, name in enumerate(names)}
    order = np.array([place.get(other_side(name) or name, -1) for name in names])
    paired = np.array([side_of(name) != 0 for name in names])
    order[order < 0] = np.flatnonzero(order < 0)
    return [order] if paired.sum() >= 4 and (order != np.arange(len(order))).sum() >= 4 else []


def _find_strange(paths: np.ndarray) -> list[int]:
    """Return the landmarks without which the paths fit best."""
    every = np.arange(paths.shape[1])
    left = [_misfit_of(paths[:, every != i][:, :, every != i], every[:-1]) for i in every]
    return np.argsort(left)[:FAULTS].tolist()
