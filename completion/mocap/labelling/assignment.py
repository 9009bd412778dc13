"""Which point is which marker, in every frame: by the votes of tracks, or by where a body has its markers."""
from __future__ import annotations

import numpy as np

from ..pose.marked_body import batches
from .body_search import assign
from .follow_points import forbid
from .tracks import mean_along_tracks

# cost of a marker without a point, and the most that one away from its place counts, in half squared deviations
ALONE, AWAY = 6.0, 8.0
WINDOW = 0.25                        # seconds to either side over which a track is judged
MISSING = 0.3                        # share of frames below which a marker is sought elsewhere on its part of the body
REACH = 0.25                         # metres from its usual place within which it is sought
TIGHT = 0.03                         # metres within which it keeps its place on the part
OFTEN = 0.5                          # share of frames in which a point has to be there
FRAMES = 300                         # in which it is sought, at most


def elect(votes: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """The column (T, L) of each marker, -1 without one, where each track has the label most key frames gave it."""
    L = votes.shape[1] - 1
    share = (votes / np.maximum(votes.sum(axis=1, keepdims=True), 1))[:, :L]
    columns = np.full((len(tracks), L), -1)
    for t, row in enumerate(tracks):
        seen = np.flatnonzero(row >= 0)
        chosen, _ = assign(-share[row[seen]].T, -0.5)                   # no label without half of the votes
        columns[t, chosen >= 0] = seen[chosen[chosen >= 0]]
    return columns


def label_of_track(columns: np.ndarray, tracks: np.ndarray) -> np.ndarray:
    """The label (K,) that each track mostly has in columns (T, L), -1 without one."""
    L = columns.shape[1]
    counts = np.zeros((tracks.max() + 1, L), dtype=int)
    frames, rows = np.nonzero(columns >= 0)
    np.add.at(counts, (tracks[frames, columns[frames, rows]], rows), 1)
    return np.where(counts.any(axis=1), counts.argmax(axis=1), -1)


def assign_by_places(points: np.ndarray, tracks: np.ndarray, known: np.ndarray, places: np.ndarray, rate: float,
                     sd: float) -> tuple[np.ndarray, np.ndarray]:
    """The column (T, L) of each marker by where a body has them in every frame, and how sure that is (T, L).

    What a point costs as a marker, half its squared deviations, is averaged along its track; then every frame is
    matched by itself. So a track may be cut, exchanged and joined, where that is what the body says for a while.

    Parameters
    ----------
    points : (T, C, 3) float, metres
    tracks : (T, C) int
    known : (T, C) int
        As of `label_markers`.
    places : (T, L, 3) float, metres
    rate : float, frames per second
    sd : float, metres
        How far a marker lies from its place, in each direction.
    """
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
        chosen, _ = assign(cost, ALONE)
        rows = np.flatnonzero(chosen >= 0)
        columns[t, rows] = seen[chosen[rows]]
        # the next best: this point as another marker, another point as this marker, or none
        here = cost[rows, chosen[rows]]
        others = cost.copy()
        others[rows, chosen[rows]] = np.inf
        rival = np.minimum(np.minimum(others[:, chosen[rows]].min(axis=0, initial=np.inf),
                                      others[rows].min(axis=1, initial=np.inf)), ALONE)
        sure[t, rows] = 1 / (1 + np.exp(np.maximum(here - rival, -50.0)))
    return columns, sure


def find_displaced(points: np.ndarray, columns: np.ndarray, places: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Offsets (L, 3), metres, of markers that are worn elsewhere on their part of the body, in the part's own axes.

    A marker that hardly any frame has is sought among the points without a label: where one keeps its place on the
    part in most frames, within `REACH` of the usual place, it is that marker.

    Parameters
    ----------
    points : (T, C, 3) float, metres
    columns : (T, L) int
        Of the markers that are labelled.
    places : (T, L, 3) float, metres
        Where the body has the markers.
    turns : (T, L, 3, 3) float
        Rotations of their parts.
    """
    L = columns.shape[1]
    free = np.isfinite(points[..., 0])
    frames, rows = np.nonzero(columns >= 0)
    free[frames, columns[frames, rows]] = False
    offsets = np.zeros((L, 3))
    for row in np.flatnonzero((columns >= 0).mean(axis=0) < MISSING):
        open_frames = np.flatnonzero(columns[:, row] < 0)
        some = open_frames[np.unique(np.linspace(0, len(open_frames) - 1, FRAMES).astype(int))]
        frame, column = np.nonzero(free[some])
        local = np.einsum("nji,nj->ni", turns[some[frame], row], points[some[frame], column] - places[some[frame], row])
        near = np.linalg.norm(local, axis=1) < REACH
        local, frame = local[near], frame[near]
        if not len(local):
            continue
        # the place with a point in most frames, and the mean of the points there
        tries = local[:: max(1, len(local) // 500)]
        close = ((tries[:, None] - local)**2).sum(axis=-1) < TIGHT**2
        counts = [len(np.unique(frame[each])) for each in close]
        best = int(np.argmax(counts))
        if counts[best] >= OFTEN * len(some):
            offsets[row] = local[close[best]].mean(axis=0)
            here = np.zeros_like(free)
            here[some[frame[close[best]]]] = True
            free &= ~(here & _close_to(points, places[:, row] + np.einsum("tij,j->ti", turns[:, row], offsets[row])))
    return offsets


def _close_to(points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Which points (T, C, 3) are within `TIGHT` of one place (T, 3) of their frame."""
    return np.nan_to_num(np.linalg.norm(points - places[:, None], axis=2), nan=np.inf) < TIGHT


def take_columns(points: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The points (T, L, 3) in some columns (T, L), NaN where that is -1."""
    taken = np.take_along_axis(points, np.maximum(columns, 0)[..., None], axis=1)
    return np.where((columns < 0)[..., None], np.nan, taken)
