"""How far clothes reach: as far as the scan is farther out than the body that bare parts tell of.

Clothes that follow the trunk look like a stouter one. So the body is fitted again to head, hands and feet alone, with
the rest of the scan around it; the scan is skin again where it comes near that body, for the error that this body has.
"""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanprep.geometry.geodesics import SurfaceGraph
from scanprep.skeleton.roles import part_kind

from .confidence import posterior_error
from .not_skin import NotSkin, Surroundings, split_pieces
from .rounds import solve_jointly
from .scan import set_apart
from .scan_fit import ScanData, ScanFit

BARE, NEAR = ("head", "hand", "foot"), 0.03      # kinds of parts; metres
# Expected errors of the body that bare parts tell of, from which on the scan is no skin: above hems of sleeves, above
# those of skirts and trousers, which end at the waist, and around hair and bags. In the median chests, bellies and hips
# of 57 naked men are 0.8, 0.5 and 0.5 out, in coats 0.9, 1.0 and 1.1; heavy naked men reach 1.3 to 1.7. Skin that is
# taken for clothes has wider errors, clothes that are taken for skin have wrong ones.
SLEEVED, BELOW, APART = 0.5, 0.8, 1.1
EDGE = 0.03                          # metres: a waistband lies on so much of skin that seems bare
BESIDE = 0.06                        # metres: so far hair and bags reach from where they were found
LEAST = 100                          # points of bare parts without which nothing can be said


def reach_farther(worn: NotSkin, fit: ScanFit, x: np.ndarray, count: int) -> NotSkin:
    """Let hair and clothes that were found reach as far as they do.

    Parameters
    ----------
    worn : NotSkin
        What was found.
    fit, x : ScanFit, (P,)
        The fit of the whole scan, and its unknowns.
    count : int
        Number of all points of the scan.
    """
    skeleton = fit.body.skeleton
    kinds = np.array([part_kind(name) for name in skeleton.names])[fit.part]
    cloud, around = fit.cloud, Surroundings(fit.mesh(x), fit.cloud)
    # all but bare parts is masked
    bare = around.points_on(np.isin(kinds, BARE) & ~worn.vertices) & (around.near.distances < NEAR)
    if bare.sum() < LEAST:
        return worn
    masked = np.ones(count, dtype=bool)
    masked[cloud.index[bare]] = False
    inner = replace(fit, data=ScanData(set_apart(cloud, masked), fit.config))
    x = solve_jointly(inner, inner.few(), x, lambda done: None).x
    around = Surroundings(inner.mesh(x), cloud)
    # 1.4 and 7.5 mm as in `estimate_error`
    error = np.hypot(1.4 * posterior_error(inner.body, x, inner.precision(x)), 0.0075)
    # what is out as far and hangs together with what was found
    limit = SLEEVED if worn.sewn[kinds == "upper_arm"].any() else BELOW if worn.sewn.any() else APART
    out = worn.vertices | ((around.out > limit * error) & ~np.isin(kinds, ["hand", "foot"]))
    vertices = np.any([piece for piece in split_pieces(around.body, out) if (piece & worn.vertices).any()], axis=0)
    graph = SurfaceGraph(around.body)
    if worn.sewn.any():
        vertices |= graph.nearest(np.flatnonzero(vertices))[0] < EDGE
    else:                                      # hair on a heavy man is no shirt
        vertices &= graph.nearest(np.flatnonzero(worn.vertices))[0] < BESIDE
    points = worn.points.copy()
    points[cloud.index[around.points_on(vertices) & ~bare]] = True
    return worn.with_more(NotSkin(vertices, points, (), worn.sewn), around.body, skeleton)
