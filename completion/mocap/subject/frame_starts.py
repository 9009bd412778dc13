"""Initialise the frames of a person of unknown shape: poses of the mean person."""
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

MEAN_PERSON = AnimateConfig(marker_sd=0.03)     # metres: on the mean person markers fit only roughly


def mean_person(mean: Subject, layout: MarkerLayout) -> MarkedBody:
    """Return the mean person with the markers of a layout."""
    return MarkedBody(mean, layout, MEAN_PERSON.prior_weight, MEAN_PERSON.prior_shrinkage)


def start_frames(body: MarkedBody, targets: np.ndarray, report_progress: Callable[[int], None]) -> np.ndarray:
    """Find unknowns (B, 3J + 3) for frames of markers (B, L, 3), metres: the fullest by a search, others from it."""
    found: list[np.ndarray] = []
    order = np.argsort(np.isnan(targets[..., 0]).sum(axis=1), kind="stable")
    for i in order:
        x = _from_found(body, found, targets[i]) if found else search_pose(body, targets[i], MEAN_PERSON)
        # 0.1: metres, median distance of the markers above which a frame is searched from scratch
        if found and np.nanmedian(np.linalg.norm(body.positions(x) - targets[i], axis=1)) > 0.1:
            x = search_pose(body, targets[i], MEAN_PERSON)
        found.append(x)
        report_progress(len(found))
    return np.array(found)[np.argsort(order)]


def _from_found(body: MarkedBody, found: Sequence[np.ndarray], targets: np.ndarray) -> np.ndarray:
    """Fit a frame of markers (L, 3) from the poses found so far that suit it best; return the unknowns (P,)."""
    # lay every pose on the markers by Procrustes, and solve from the best ones
    x, there = np.array(found), ~np.isnan(targets[:, 0])
    for row, at in zip(x, body.positions(x), strict=True):
        R, _ = rotations.procrustes(at[there], targets[there])
        row[:3] = rotations.log(R @ rotations.exp(row[:3]))
    x[:, -3:] += (targets - body.positions(x))[:, there].mean(axis=1)
    off = np.nanmean(np.linalg.norm(body.positions(x) - targets, axis=2), axis=1)
    x = x[np.argsort(off)[:3]]
    end = body.solve(x, targets, np.full(len(targets), MEAN_PERSON.marker_sd**-2), 20, 1e-3)
    return end.x[np.argmin(end.energy)]


def find_loose(model: BodyModel, vertices: np.ndarray, layout: MarkerLayout, targets: np.ndarray,
               reach: tuple[np.ndarray, np.ndarray]) -> tuple[dict[str, int], np.ndarray]:
    """Find the vertex below each loose marker on its part, and distances (L,) from the skin, metres.

    `targets` (B, L, 3) are the measured markers on bodies (B, N, 3); `reach` has the least and the greatest distance
    (L,) of each. Other markers keep the distances of the layout.
    """
    template, distances, usual = model.template, np.array(layout.distances), layout.nearest
    meshes, vertex_of = [template.with_vertices(v) for v in vertices], {}
    normals = np.stack([mesh.vertex_normals for mesh in meshes])
    tree, part = cKDTree(template.vertices), model.skeleton.part_of_vertex(template)
    for row in np.flatnonzero(np.isin(layout.labels, layout.loose)):
        # 0.2: metres from its usual place within which a loose marker is searched, half a thigh
        near = np.array(tree.query_ball_point(template.vertices[usual[row]], 0.2))
        near = near[part[near] == part[usual[row]]]
        seen = np.isfinite(targets[:, row, 0])
        if not seen.any():
            vertex_of[layout.labels[row]] = int(usual[row])
            continue
        off, lifts = stand_off(targets[seen, row], vertices[seen][:, near], normals[seen][:, near],
                               reach[0][row], reach[1][row])
        # 0.06: metres beyond which a frame counts as an outlier
        best = np.minimum(off**2, 0.06**2).mean(axis=0).argmin()
        vertex_of[layout.labels[row]], distances[row] = int(near[best]), lifts[best]
    return vertex_of, distances


def stand_off(targets: np.ndarray, points: np.ndarray, normals: np.ndarray, least: float, greatest: float
              ) -> tuple[np.ndarray, np.ndarray]:
    """Compute how far a marker at targets (B, 3) is from each of n points of the skin, lifted along their normals.

    Points and normals are (B, n, 3). The lift (n,) of each point is the mean over the frames, between the least and the
    greatest. Returned are the distances (B, n) and the lifts (n,), metres.
    """
    apart = targets[:, None] - points
    lift = np.clip(np.einsum("bnd,bnd->bn", apart, normals).mean(axis=0), least, greatest)
    return np.linalg.norm(apart - lift[:, None] * normals, axis=2), lift
