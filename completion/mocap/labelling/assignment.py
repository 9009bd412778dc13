"""Assign points to markers in every frame: by the votes of tracks, or by the simulated markers of a body."""
from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from ..pose.marked_body import batches
from .body_search import assign_columns
from .follow_points import forbid
from .tracks import mean_along_tracks

# Costs in half squared deviations: of a marker without a point, and the largest of a point far from its marker.
ALONE, AWAY = 6.0, 8.0
WINDOW = 0.25                        # seconds to either side over which costs of a track are averaged
MISSING = 0.3                        # a marker found in a smaller share of frames is searched elsewhere on its part


def elect(votes: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """Give each track the label with most votes of key frames; return the column (T, L) of each marker, -1 without."""
    L = votes.shape[1] - 1
    share = (votes / np.maximum(votes.sum(axis=1, keepdims=True), 1))[:, :L]
    columns = np.full((len(tracks), L), -1)
    for t, row in enumerate(tracks):
        seen = np.flatnonzero(row >= 0)
        chosen, _ = assign_columns(-share[row[seen]].T, -0.5)                   # a label needs half of the votes
        columns[t, chosen >= 0] = seen[chosen[chosen >= 0]]
    return columns


def label_of_track(columns: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """Return the most frequent label (K,) of each track in columns (T, L), -1 without one."""
    L = columns.shape[1]
    counts = np.zeros((tracks.max() + 1, L), dtype=int)
    frames, rows = np.nonzero(columns >= 0)
    np.add.at(counts, (tracks[frames, columns[frames, rows]], rows), 1)
    return np.where(counts.any(axis=1), counts.argmax(axis=1), -1)


def assign_by_places(points: np.ndarray, tracks: np.ndarray, known: np.ndarray, places: np.ndarray, rate: float,
                     sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign points by simulated markers; return the column (T, L) of each marker and its confidence (T, L).

    The cost of a point as a marker, half its squared deviations, is averaged along its track. Then every frame is
    matched by itself. So tracks may be cut, exchanged and joined where the body says so for a while.

    Parameters
    ----------
    points : (T, C, 3) float, metres
        Unlabelled points.
    tracks : (T, C) int
        Track of each point, -1 without one.
    known : (T, C) int
        As for `label_markers`.
    places : (T, L, 3) float, metres
        Simulated markers.
    rate : float, frames per second
        Of the points.
    sd : (L,) float, metres
        Standard deviation of each marker from its place, in each direction.
    """
    # costs of all points as all markers, averaged along tracks
    T, L = places.shape[:2]
    costs = np.full((*tracks.shape, L), AWAY)
    for some in batches(T):
        squared = ((points[some, :, None] - places[some, None])**2).sum(axis=-1)
        costs[some] = np.minimum(np.nan_to_num(squared / (2 * sd**2), nan=AWAY), AWAY)
    costs = mean_along_tracks(costs, tracks, max(1, round(WINDOW * rate)))
    columns, sure = np.full((T, L), -1), np.zeros((T, L))
    for t in range(T):
        seen = np.flatnonzero(tracks[t] >= 0)
        cost = costs[t, seen].T.copy()
        forbid(cost, known[t, seen])
        chosen, _ = assign_columns(cost, ALONE)
        rows = np.flatnonzero(chosen >= 0)
        columns[t, rows] = seen[chosen[rows]]
        sure[t] = certainty(cost, chosen, ALONE)
    return columns, sure


def certainty(cost: np.ndarray, chosen: np.ndarray, alone: float) -> np.ndarray:
    """Compute the confidence (L,), 0 to 1, of each match with costs (L, N); 0 without a point.

    It is that beside the next best: this point as another marker, another point as this marker, or none, which costs
    `alone`.
    """
    rows, sure = np.flatnonzero(chosen >= 0), np.zeros(len(cost))
    if len(rows):
        here, others = cost[rows, chosen[rows]], cost.copy()
        others[rows, chosen[rows]] = np.inf
        rival = np.minimum(np.minimum(others[:, chosen[rows]].min(axis=0), others[rows].min(axis=1)), alone)
        sure[rows] = 1 / (1 + np.exp(np.clip(here - rival, -50.0, 50.0)))
    return sure


def mean_offsets(points: np.ndarray, columns: np.ndarray, places: np.ndarray, turns: np.ndarray
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Compute median offsets (L, 3), metres, of labelled points from places (T, L, 3), in the axes of their parts.

    Returned with them are standard deviations (L,) in each direction. Both are zero for markers that are in fewer
    frames than `MISSING`.
    """
    L = columns.shape[1]
    offsets, deviations = np.zeros((L, 3)), np.zeros(L)
    for row in np.flatnonzero((columns >= 0).mean(axis=0) >= MISSING):
        t = np.flatnonzero(columns[:, row] >= 0)
        off = points[t, columns[t, row]] - places[t, row]
        local = np.einsum("tji,tj->ti", turns[t, row], off)
        offsets[row] = np.median(local, axis=0)
        # 1.54: median of a distance in space over the standard deviation of a coordinate
        deviations[row] = np.median(np.linalg.norm(local - offsets[row], axis=1)) / 1.54
    return offsets, deviations


def find_displaced(points: np.ndarray, columns: np.ndarray, places: np.ndarray, turns: np.ndarray, part: np.ndarray
                   ) -> np.ndarray:
    """Find misplaced markers on their part of the body; return offsets (L, 3), metres, in the axes of the part.

    Markers that are in few frames are searched among unlabelled points. Points that keep a place on the part in most
    frames, near the usual places, are these markers. Several are matched to their usual places, moved like the other
    markers of the part.

    Parameters
    ----------
    points : (T, C, 3) float, metres
        Labelled and unlabelled points.
    columns : (T, L) int
        Columns of the labelled markers.
    places : (T, L, 3) float, metres
        Simulated markers.
    turns : (T, L, 3, 3) float
        Rotations of their parts.
    part : (L,) int
        The part that carries each.
    """
    free = np.isfinite(points[..., 0])
    frames, rows = np.nonzero(columns >= 0)
    free[frames, columns[frames, rows]] = False
    # at most 300 frames are searched
    sampled = np.unique(np.linspace(0, len(points) - 1, 300).astype(int))
    missing = (columns >= 0).mean(axis=0) < MISSING
    (usual, _), offsets = mean_offsets(points, columns, places, turns), np.zeros((columns.shape[1], 3))
    reach = 0.25  # metres from its usual place within which a marker is searched
    for of in np.unique(part[missing]):
        lost, labelled = np.flatnonzero(missing & (part == of)), np.flatnonzero(~missing & (part == of))
        # everything in the axes of the part, from the first of its missing markers
        R, origin = turns[sampled, lost[0]], places[sampled, lost[0]]
        wanted = np.einsum("tji,tlj->tli", R, places[sampled][:, lost] - origin[:, None]).mean(axis=0)
        wanted += np.median(usual[labelled], axis=0) if len(labelled) else 0.0
        frame, column = np.nonzero(free[sampled])
        local = np.einsum("nji,nj->ni", R[frame], points[sampled[frame], column] - origin[frame])
        near = (np.linalg.norm(local[:, None] - wanted, axis=2) < reach).any(axis=1)
        # 0.5: least share of frames with a point at the place
        found = _steady_places(local[near], frame[near], 0.5 * len(sampled))
        if len(found):
            apart = np.linalg.norm(wanted[:, None] - found, axis=2)
            for row, place in zip(*linear_sum_assignment(apart), strict=True):
                if apart[row, place] < reach:
                    begin = np.einsum("tji,tj->ti", R, places[sampled, lost[row]] - origin).mean(axis=0)
                    offsets[lost[row]] = found[place] - begin
    return offsets


def _steady_places(local: np.ndarray, frame: np.ndarray, often: float) -> np.ndarray:
    """Find places (n, 3) with a point (N, 3) nearby in at least `often` frames (N,)."""
    places = list[np.ndarray]()
    while len(local):
        tries = local[:: max(1, len(local) // 500)]
        # 3 cm: radius within which a marker keeps its place on the part
        close = ((tries[:, None] - local)**2).sum(axis=-1) < 0.03**2
        counts = [len(np.unique(frame[each])) for each in close]
        best = close[int(np.argmax(counts))]
        if max(counts) < often:
            break
        places.append(local[best].mean(axis=0))
        local, frame = local[~best], frame[~best]
    return np.array(places).reshape(-1, 3)


def take_columns(points: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the points (T, L, 3) in some columns (T, L), NaN where the column is -1."""
    taken = np.take_along_axis(points, np.maximum(columns, 0)[..., None], axis=1)
    return np.where((columns < 0)[..., None], np.nan, taken)
