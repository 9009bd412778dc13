"""Where the frames of a person of unknown shape begin: the poses of the mean person in them."""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial import cKDTree

from model.body import BodyModel
from model.linear import Subject
from scanprep.geometry import rotations

from ..marker_sets.layout import MarkerLayout
from ..pose.initialise import search_pose
from ..pose.marked_body import AnimateConfig, MarkedBody

MEAN_PERSON = AnimateConfig(marker_sd=0.03)     # metres: the mean person carries the markers only roughly


def mean_person(mean: Subject, layout: MarkerLayout) -> MarkedBody:
    """The mean person with the markers of a layout."""
    return MarkedBody(mean, layout, MEAN_PERSON.prior_weight, MEAN_PERSON.prior_shrinkage)


def start_frames(body: MarkedBody, targets: np.ndarray, tell: Callable[[int], None]) -> np.ndarray:
    """Unknowns (B, 3J + 3) in frames of markers (B, L, 3), metres: one searched for from nothing, others from those."""
    found: list[np.ndarray] = []
    order = np.argsort(np.isnan(targets[..., 0]).sum(axis=1), kind="stable")
    for i in order:
        x = _from_found(body, found, targets[i]) if found else search_pose(body, targets[i], MEAN_PERSON)
        # metres, median distance of a frame's markers above which it is searched anew
        if found and np.nanmedian(np.linalg.norm(body.positions(x) - targets[i], axis=1)) > 0.1:
            x = search_pose(body, targets[i], MEAN_PERSON)
        found.append(x)
        tell(len(found))
    return np.array(found)[np.argsort(order)]


def _from_found(body: MarkedBody, found: Sequence[np.ndarray], targets: np.ndarray, most: int = 3) -> np.ndarray:
    """The best unknowns (P,) that the most fitting poses which were found reach from the markers (L, 3) of a frame."""
    x, there = np.array(found), ~np.isnan(targets[:, 0])
    for row, at in zip(x, body.positions(x), strict=True):
        R, _ = rotations.procrustes(at[there], targets[there])
        row[:3] = rotations.log(R @ rotations.exp(row[:3]))
    x[:, -3:] += (targets - body.positions(x))[:, there].mean(axis=1)
    off = np.nanmean(np.linalg.norm(body.positions(x) - targets, axis=2), axis=1)
    x = x[np.argsort(off)[:most]]
    end = body.solve(x, targets, np.full(len(targets), MEAN_PERSON.marker_sd**-2), 20, 1e-3)
    return end.x[np.argmin(end.energy)]


def find_loose(model: BodyModel, vertices: np.ndarray, layout: MarkerLayout, targets: np.ndarray,
               reach: tuple[np.ndarray, np.ndarray]) -> tuple[dict[str, int], np.ndarray]:
    """The vertex of its part below each loose marker, and distances (L,) from the skin, metres.

    `targets` (B, L, 3) are where the markers were seen on bodies (B, N, 3); `reach` is the least and the greatest
    distance (L,) of each. Those of other markers are the layout's.
    """
    template, distances, usual = model.template, np.array(layout.distances), layout.nearest
    meshes, found = [template.with_vertices(v) for v in vertices], {}
    normals = np.stack([mesh.vertex_normals for mesh in meshes])
    tree, part = cKDTree(template.vertices), model.skeleton.part_of_vertex(template)
    for row in np.flatnonzero(np.isin(layout.labels, layout.loose)):
        # metres from its usual place that a loose marker is looked for: half a thigh
        near = np.array(tree.query_ball_point(template.vertices[usual[row]], 0.2))
        near = near[part[near] == part[usual[row]]]
        seen = np.isfinite(targets[:, row, 0])
        if not seen.any():
            found[layout.labels[row]] = int(usual[row])
            continue
        off, lifts = stand_off(targets[seen, row], vertices[seen][:, near], normals[seen][:, near],
                               reach[0][row], reach[1][row])
        # metres beyond which it does not matter how far a loose marker is
        best = np.minimum(off**2, 0.06**2).mean(axis=0).argmin()
        found[layout.labels[row]], distances[row] = int(near[best]), lifts[best]
    return found, distances


def stand_off(targets: np.ndarray, points: np.ndarray, normals: np.ndarray, least: float, greatest: float
              ) -> tuple[np.ndarray, np.ndarray]:
    """How a marker seen at targets (B, 3) may stand off each of n points of the skin, whose distance is unknown.

    Returned are the distances (B, n) from the points (B, n, 3) lifted along their normals, and how far (n,) each was
    lifted: as far as the frames say on average, between the least and the greatest. Metres.
    """
    apart = targets[:, None] - points
    lift = np.clip(np.einsum("bnd,bnd->bn", apart, normals).mean(axis=0), least, greatest)
    return np.linalg.norm(apart - lift[:, None] * normals, axis=2), lift
