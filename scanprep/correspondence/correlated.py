"""Correlated correspondence: many pairs of places on a template and a scan from a few, or from none.

1. The scan's sheets become one graph of points; paths over it tell how far every point is from the seeds.
2. Some two hundred points of the scan are variables, places of the template their values. What a place looks
   like from the seeds speaks for single values, edges that keep length and direction for pairs of them.
3. Loopy belief propagation, first over places spread wide, then over all vertices around the likely ones.

Seeds that nobody gave are the ends of the limbs, matched by the ways between them.

[CC]
"""
from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import permutations

import numpy as np

from ..geometry.farthest_points import farthest_points
from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh, check_template
from ..geometry.target import target_of
from ..threads import one_thread
from .correspondences import Correspondences, check_pairs
from .search import BeliefLevel, CorrelatedConfig, Seeds, propagate_beliefs, result, surfaces_of
from .sheet import Sheet

# Of the trial of a hypothesis: fewer points, and one coarse level
TRIAL = CorrelatedConfig(points=90, levels=(BeliefLevel(900, 60),), iterations=25)


@one_thread()
def find_correspondences(template: Mesh, scan: Mesh | np.ndarray, seeds: tuple[np.ndarray, np.ndarray] | None = None,
                         config: CorrelatedConfig | None = None,
                         progress: Callable[[int, int], None] | None = None) -> Correspondences:
    """From a few pairs of places on a template and a scan to nearly two hundred.

    Parameters
    ----------
    template, scan
        As in `register`.
    seeds : (S,) int and (S, 3) float, metres, optional
        Vertices of the template and where they are on the scan; three at least, spread over the body. Without them the
        ends of the limbs are looked for.
    progress : callable(done, total), optional

    Returns
    -------
    Correspondences
        Points of the scan that found an image, the most certain first.

    Raises
    ------
    ValueError
        What `register` refuses; seeds that are too few, do not exist, or were not found.

    [CC]
    """
    config, tell = config or CorrelatedConfig(), progress or (lambda done, total: None)
    check_template(template)
    if seeds is None:
        found = find_seeds(template, scan)
        seeds = (found.template_vertices, found.scan_points)
    vertices, places = check_pairs(template, *seeds, "seeds")
    total = 2 + 2 * len(config.levels)
    sheet = Sheet(target_of(scan), config.spacing * float(np.sqrt(template.face_areas.sum())))
    points = sheet.at(places)
    known = Seeds(vertices, places, points, _surface(template).distances(vertices), sheet.distances(points))
    surfaces, images = surfaces_of(template, sheet, known, config), None
    tell(2, total)
    for number, level in enumerate(config.levels):
        surfaces, images = propagate_beliefs(surfaces, images, level, config)
        tell(4 + 2 * number, total)
    assert images is not None, "levels: expected at least one"
    return result(surfaces, images, config)


@one_thread()
def find_seeds(template: Mesh, scan: Mesh | np.ndarray, ends: int = 5, hypotheses: int = 8) -> Correspondences:
    """The ends of the limbs on template and scan, with no click.

    Ends are places farther from the rest of the surface than all around them: head, hands and feet of a person
    whose limbs do not hide in each other; at most so many on the template, and two more on the scan. They are matched
    by the lengths of the ways between them; left and right, front and back are told by trying the best `hypotheses`:
    the right one keeps the surface the same way round, and its short edges. Nothing is assumed about which way is up.
    The confidence is how much worse the next hypothesis is. ValueError where either has fewer than three ends.
    """
    check_template(template)
    size = float(np.sqrt(template.face_areas.sum()))
    apart = 0.28  # of the template's size: an end is the farthest place within it along the surface
    own, ways = _template_ends(template, ends, apart * size)
    if len(own) < 3:
        raise ValueError(f"template: expected at least three limbs, found {len(own)} ends")
    sheet = Sheet(target_of(scan), TRIAL.spacing * size)
    seen, seen_ways = _ends(sheet.points, sheet.distances, ends + 2, apart * size)
    if len(seen) < 3:
        raise ValueError(f"scan: expected at least three ends of limbs, found {len(seen)}")
    matches = match_ends(ways[:, own], seen_ways[:, seen], hypotheses)
    trials = []
    for image in matches:
        there = image >= 0
        at = image[there]
        seeds = Seeds(own[there], sheet.points[seen[at]], seen[at], ways[there], seen_ways[at])
        surfaces, images = propagate_beliefs(surfaces_of(template, sheet, seeds, TRIAL), None, TRIAL.levels[0], TRIAL)
        trials.append(images.energy / len(surfaces.scan) + 2.0 * float((~there).sum()))
    order = np.argsort(trials)
    best = matches[order[0]]
    there = best >= 0
    margin = 1.0 if len(trials) < 2 else 1 - np.exp(trials[order[0]] - trials[order[1]])
    energies = {f"hypothesis {k}": float(trials[h]) for k, h in enumerate(order)}
    return Correspondences(own[there], sheet.points[seen[best[there]]], np.full(int(there.sum()), float(margin)),
                           "ends of limbs", energies, bool(margin > 0.2))


@lru_cache(maxsize=4)                # a folder of scans shares one template
def _surface(template: Mesh) -> SurfaceGraph:
    return SurfaceGraph(template)


@lru_cache(maxsize=4)
def _template_ends(template: Mesh, count: int, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """The ends of a template, and the ways from them to all of its vertices."""
    return _ends(template.vertices, _surface(template).distances, count, apart)


def _ends(points: np.ndarray, distances: Callable[[np.ndarray], np.ndarray], count: int, apart: float
          ) -> tuple[np.ndarray, np.ndarray]:
    """Places (E,) farther from the rest than all around them, most pronounced first, and the ways (E, n) to all."""
    sample = farthest_points(points, 64)
    ways = distances(sample)
    there = np.isfinite(ways)
    mean = np.full(ways.shape[1], np.nan)                     # of pieces that no sample reaches
    np.divide(np.where(there, ways, 0).sum(axis=0), there.sum(axis=0), out=mean, where=there.any(axis=0))
    chosen: list[int] = []
    todo = mean - np.nanmin(mean)
    while len(chosen) < count and np.nanmax(todo) > 0:
        top = int(np.nanargmax(todo))
        ring = distances(np.array([top]))[0]
        near = ring < apart
        if mean[top] >= np.nanmax(mean[near]) and mean[top] - np.nanmin(mean[near]) > 0.5 * apart:
            chosen.append(top)
        todo = np.where(near, -1.0, todo)
    ends = np.array(chosen, dtype=np.int64)
    return ends, distances(ends) if len(ends) else np.zeros((0, len(points)))


def match_ends(template: np.ndarray, scan: np.ndarray, count: int) -> list[np.ndarray]:
    """So many matches of the ends that keep the ways between them, (E, E) and (F, F) metres, best, best first.

    Each is the scan's end for every end of the template (E,), -1 for none.
    """
    E, F = len(template), len(scan)
    hidden = max(0, min(E - 3, 2))
    images = np.array(sorted(set(permutations([*range(F), *([-1] * hidden)], E))))
    images = images[(images >= 0).sum(axis=1) >= 3]
    a, b = np.triu_indices(E, 1)
    both = (images[:, a] >= 0) & (images[:, b] >= 0)
    ratio = scan[images[:, a], images[:, b]] / template[a, b]
    log_ratio = np.where(both & np.isfinite(ratio) & (ratio > 0), np.log(np.where(ratio > 0, ratio, 1.0)), np.nan)
    scale = np.clip(np.nanmedian(log_ratio, axis=1), -0.35, 0.35)
    wrong = np.where(both, np.minimum(np.nan_to_num(np.abs(log_ratio - scale[:, None]), nan=0.5), 0.5), 0.0)
    cost = wrong.sum(axis=1) / np.maximum(both.sum(axis=1), 1) + 0.12 * (images < 0).sum(axis=1)
    return list(images[np.argsort(cost, kind="stable")[:count]])
