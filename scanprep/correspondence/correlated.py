"""Correlated correspondence: find about two hundred corresponding points of template and scan, from few seeds or none.

1. Build one graph of points over all sheets of the scan. Shortest paths give the distances to the seeds.
2. Some two hundred points of the scan are variables; template vertices are their values. Unary potentials compare
   distances and directions to the seeds. Pairwise potentials compare length and direction of edges.
3. Run loopy belief propagation, first over sparse template vertices, then over all vertices near the likely ones.

Without seeds, the ends of the limbs are detected and matched by the path lengths between them.

[CC]
"""
from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import permutations

import numpy as np

from ..geometry.farthest_points import farthest_points
from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh, check_template, take_any_mesh
from ..geometry.target import target_of
from ..threads import one_thread
from .correspondences import Correspondences, check_pairs
from .search import LEVELS, CorrelatedConfig, Seeds, propagate_beliefs, result, surfaces_of
from .sheet import Sheet

# To rank hypotheses, fewer points, candidates and rounds of messages are enough, at one level.
TRIAL_POINTS, TRIAL_PLACES, TRIAL_CHOICES, TRIAL_ROUNDS = 90, 900, 60, 25
ENDS = 5                             # head, hands and feet
HYPOTHESES = 8                       # that are tested, the best by path lengths; each costs a trial


@take_any_mesh
@one_thread()
def find_correspondences(template: Mesh, scan: Mesh | np.ndarray, seeds: tuple[np.ndarray, np.ndarray] | None = None,
                         config: CorrelatedConfig | None = None,
                         progress: Callable[[int, int], None] | None = None) -> Correspondences:
    """Find nearly two hundred corresponding points of a template and a scan, from a few seeds or none.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        It may have holes, borders, several overlapping sheets and noise.
    seeds : ((S,) int, (S, 3) float, metres), optional
        Vertices of the template and their positions on the scan; at least three, spread over the body. By default the
        ends of the limbs are detected.
    config : CorrelatedConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Correspondences
        Vertices (C,) of the template and points (C, 3) of the scan, metres; the most confident first.

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite; fewer than three
        seeds, seeds that do not exist, or limb ends that were not found.

    Examples
    --------
    >>> from scanprep.synthetic.people import SyntheticPerson, find_pose
    >>> person = SyntheticPerson()
    >>> scan = person.in_pose(find_pose("run"))
    >>> seeds = np.arange(0, len(scan), len(scan) // 9)
    >>> found = find_correspondences(person.mesh, scan, (seeds, scan[seeds]), CorrelatedConfig(points=60))
    >>> found.scan_points.shape == (len(found), 3)
    True

    [CC]
    """
    config, report_progress = config or CorrelatedConfig(), progress or (lambda done, total: None)
    check_template(template)
    if seeds is None:
        ends = find_seeds(template, scan)
        seeds = (ends.template_vertices, ends.scan_points)
    vertices, places = check_pairs(template, *seeds, "seeds")
    # one graph over the scan; distances from every seed on both surfaces
    total = 2 + 2 * len(LEVELS)
    sheet = Sheet(target_of(scan), config.spacing * float(np.sqrt(template.face_areas.sum())))
    points = sheet.at(places)
    known = Seeds(vertices, places, points, _surface(template).distances(vertices), sheet.distances(points))
    # features of both surfaces; then belief propagation, coarse to fine
    surfaces, images = surfaces_of(template, sheet, known, config.points), None
    report_progress(2, total)
    for number, (count, choices) in enumerate(LEVELS):
        surfaces, images = propagate_beliefs(surfaces, images, count, choices)
        report_progress(4 + 2 * number, total)
    assert images is not None, "there is a level"
    return result(surfaces, images)


@one_thread()
def find_seeds(template: Mesh, scan: Mesh | np.ndarray) -> Correspondences:
    """Detect and match the ends of the limbs of template and scan, without any landmark.

    Ends are local maxima of the mean distance along the surface: head, hands and feet of a person whose limbs do not
    touch. At most five are used on the template, and two more on the scan. They are matched by the path lengths
    between them. To tell left from right and front from back, the best hypotheses are tested by belief propagation:
    the right one keeps orientation and short edges. No axis is assumed to be up. The confidence says how much worse the
    second best hypothesis is. ValueError where either surface has fewer than three ends.
    """
    check_template(template)
    size = float(np.sqrt(template.face_areas.sum()))
    apart = 0.28  # in sizes: an end is the maximum within this distance along the surface, 40 cm on a man
    template_ends, template_paths = _template_ends(template, ENDS, apart * size)
    if len(template_ends) < 3:
        raise ValueError(f"template: expected at least three limbs, found {len(template_ends)} ends")
    sheet = Sheet(target_of(scan), CorrelatedConfig().spacing * size)
    scan_ends, scan_paths = find_path_ends(sheet.points, sheet.distances, ENDS + 2, apart * size)
    if len(scan_ends) < 3:
        raise ValueError(f"scan: expected at least three ends of limbs, found {len(scan_ends)}")
    matches = match_ends(template_paths[:, template_ends], scan_paths[:, scan_ends], HYPOTHESES)
    # test each hypothesis: energy per point of a coarse belief propagation, plus 2 for every unmatched end
    trials = []
    for image in matches:
        matched = image >= 0
        at = image[matched]
        seeds = Seeds(template_ends[matched], sheet.points[scan_ends[at]], scan_ends[at], template_paths[matched],
                      scan_paths[at])
        surfaces = surfaces_of(template, sheet, seeds, TRIAL_POINTS, TRIAL_PLACES)
        surfaces, images = propagate_beliefs(surfaces, None, TRIAL_PLACES, TRIAL_CHOICES, TRIAL_ROUNDS)
        trials.append(images.energy / len(surfaces.scan) + 2.0 * float((~matched).sum()))
    order = np.argsort(trials)
    best = matches[order[0]]
    matched = best >= 0
    # confidence from the gap between the two best hypotheses; below 0.2 it is ambiguous
    margin = 1.0 if len(trials) < 2 else 1 - np.exp(trials[order[0]] - trials[order[1]])
    energies = {f"hypothesis {k}": float(trials[h]) for k, h in enumerate(order)}
    return Correspondences(template_ends[matched], sheet.points[scan_ends[best[matched]]],
                           np.full(int(matched.sum()), float(margin)), "ends of limbs", energies, bool(margin > 0.2))


@lru_cache(maxsize=4)                # a folder of scans shares one template
def _surface(template: Mesh) -> SurfaceGraph:
    """Return the path graph of a template, cached."""
    return SurfaceGraph(template)


@lru_cache(maxsize=4)
def _template_ends(template: Mesh, count: int, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the ends of a template (E,), and the path lengths (E, N), metres, from them to all vertices."""
    return find_path_ends(template.vertices, _surface(template).distances, count, apart)


def find_path_ends(points: np.ndarray, distances: Callable[[np.ndarray], np.ndarray], count: int, apart: float,
                   samples: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Find local maxima (E,) of the mean path length, highest first, and path lengths (E, n) to all points.

    The mean is over the paths to as many `samples`, spread over the body; maxima are at least `apart`, metres.
    """
    # mean path length from every point to spread points: large at the ends of limbs
    sample = farthest_points(points, samples)
    ways = distances(sample)
    there = np.isfinite(ways)
    mean = np.full(ways.shape[1], np.nan)                     # stays NaN on pieces without a sample
    np.divide(np.where(there, ways, 0).sum(axis=0), there.sum(axis=0), out=mean, where=there.any(axis=0))
    chosen: list[int] = []
    todo = mean - np.nanmin(mean)
    # take maxima one by one; they must be the highest within `apart` and rise by half of it, and exclude what is near
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
    """Rank the assignments of ends by how well they keep path lengths, (E, E) and (F, F) metres; return the `count`
    best.

    Each assignment gives the scan's end for every end of the template (E,), -1 for none.
    """
    E, F = len(template), len(scan)
    # every assignment with at most two unmatched ends and at least three matched ones
    hidden = max(0, min(E - 3, 2))
    images = np.array(sorted(set(permutations([*range(F), *([-1] * hidden)], E))))
    images = images[(images >= 0).sum(axis=1) >= 3]
    a, b = np.triu_indices(E, 1)
    both = (images[:, a] >= 0) & (images[:, b] >= 0)
    # cost: mean error of log path lengths, capped at 0.5, after removing a common scale of at most a factor 1.4
    ratio = scan[images[:, a], images[:, b]] / template[a, b]
    log_ratio = np.where(both & np.isfinite(ratio) & (ratio > 0), np.log(np.where(ratio > 0, ratio, 1.0)), np.nan)
    scale = np.clip(np.nanmedian(log_ratio, axis=1), -0.35, 0.35)
    wrong = np.where(both, np.minimum(np.nan_to_num(np.abs(log_ratio - scale[:, None]), nan=0.5), 0.5), 0.0)
    # an unmatched end costs as much as paths that are wrong by 12%
    cost = wrong.sum(axis=1) / np.maximum(both.sum(axis=1), 1) + 0.12 * (images < 0).sum(axis=1)
    return list(images[np.argsort(cost, kind="stable")[:count]])
