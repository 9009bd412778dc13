"""Correlated correspondence: many pairs of places on a template and a scan from a few, or from none.

1. The scan's sheets become one graph of points; paths over it tell how far every point is from the seeds.
2. Some two hundred points of the scan are variables, places of the template their values. What a place looks
   like from the seeds speaks for single values, edges that keep length and direction for pairs of them.
3. Loopy belief propagation, first over places spread wide, then over all vertices around the likely ones.

[CC]
"""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh, check_template
from ..geometry.target import target_of
from ..threads import one_thread
from .correspondences import Correspondences, checked_pairs
from .search import CorrelatedConfig, result, search, surfaces_of
from .seeds import find_seeds
from .sheet import Sheet


@one_thread()
def find_correspondences(template: Mesh, scan: Mesh | np.ndarray, seeds: tuple[np.ndarray, np.ndarray] | None = None,
                         config: CorrelatedConfig | None = None,
                         progress: Callable[[int, int], None] | None = None) -> Correspondences:
    """From a few pairs of places on a template and a scan to nearly two hundred.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        May have holes, borders, several overlapping sheets, noise.
    seeds : (S,) int and (S, 3) float, metres, optional
        Vertices of the template and where they are on the scan; three at least, spread over the body. Without them the
        ends of the limbs are looked for.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Correspondences
        Points of the scan that found an image, the most certain first.

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite, fewer than
        three seeds or seeds that do not exist.

    [CC]
    """
    config, tell = config or CorrelatedConfig(), progress or (lambda done, total: None)
    check_template(template)
    if seeds is None:
        found = find_seeds(template, scan)
        seeds = (found.template_vertices, found.scan_points)
    seeds = checked_pairs(template, *seeds, "seeds")
    total = 2 + 2 * len(config.levels)
    sheet = Sheet(target_of(scan), config.spacing * float(np.sqrt(template.face_areas.sum())))
    surfaces, images = surfaces_of(template, sheet, SurfaceGraph(template), seeds, config), None
    tell(2, total)
    for number, level in enumerate(config.levels):
        surfaces, images = search(surfaces, images, level, config)
        tell(4 + 2 * number, total)
    assert images is not None, "levels: expected at least one"
    return result(surfaces, images, config)
