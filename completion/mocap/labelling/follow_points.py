"""A body followed through points without names: which track is which marker, as key frames vote."""
from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from ..pose.marked_body import MarkedBody
from .body_search import JUDGED, BodySearch, Placement, assign, match_points, robust_weights
from .tracks import mean_along_tracks

EVERY = 0.1                          # seconds between key frames
SCALES = (0.15, 0.12)                # metres, of the matches of a key frame, one round after the other
KNOWN = 0.06                         # metres, scale about where a marker was on the body in the key frame before
HELD = 0.3                           # what a track that has a label costs less with it
NEAR = 0.15                          # metres from its place beyond which no point keeps a label
GOOD = 0.7                           # share of markers within 10 cm, below which the body is sought anew
LONE = 2                             # markers and points without each other, from which on limbs are sought anew
WAIT = 0.5                           # seconds from a search that found nothing better to the next
# cost of a marker without a point, and the most that one away from its place counts, in half squared deviations
ALONE, AWAY = 6.0, 8.0
WINDOW = 0.25                        # seconds to either side over which a track is judged


def vote(search: BodySearch, points: np.ndarray, tracks: np.ndarray, rate: float, start: tuple[int, Placement],
         tell: Callable[[int], None]) -> np.ndarray:
    """How often key frames gave each track (K) each label (K, L + 1), the last column: none.

    The body goes from key frame to key frame, both ways from a frame in which it was found. Tracks that go on keep
    their label and carry it along; the rest are matched with what is left. Where the body has lost the points it is
    sought anew, a limb or all of it.
    """
    L, (first, placement) = search.body.count, start
    votes = np.zeros((tracks.max() + 1, L + 1))
    every = max(1, round(EVERY * rate))
    done = 0
    for way in (range(first, len(points), every), range(first, -1, -every)):
        follower = _Follower(search, placement.x, round(WAIT / EVERY))
        for t in way:
            seen = np.flatnonzero(np.isfinite(points[t, :, 0]))
            follower.push(points[t, seen], tracks[t, seen], votes)
            done += every
            tell(min(done, len(points)))
    return votes


class _Follower:
    """The body on its way through key frames."""

    def __init__(self, search: BodySearch, x: np.ndarray, wait: int) -> None:
        self.search, self.body, self.x = search, search.body, x
        self.held: dict[int, int] = {}                                  # track -> marker
        self.off = np.zeros((self.body.count, 3))                       # of each point from its marker's place
        self.wait, self.quiet = wait, 0

    def push(self, points: np.ndarray, tracks: np.ndarray, votes: np.ndarray) -> None:
        """The next key frame: points (N, 3) of tracks (N,)."""
        body, L = self.body, self.body.count
        if len(points) < 3:
            self.held = {}
            return
        # the body where the tracks that go on have it
        x = self.x[None]
        targets = np.full((L, 3), np.nan)
        for point, track in zip(points, tracks, strict=True):
            if track in self.held:
                targets[self.held[track]] = point
        there = np.isfinite(targets[:, 0])
        if there.sum() >= 4:
            n = body.body.n_angles
            x = x.copy()
            x[:, n:n + 3] += (targets - body.positions(x[0]))[there].mean(axis=0)
            x = self._solve(x, targets, np.inf)
        # all points, matched with where the body has its markers and where they were on it before
        for scale in SCALES:
            places = body.positions(x[0])
            cost = sum(0.5 * squared / (squared + s**2) for at, s in ((places, scale), (places + self.off, KNOWN))
                       for squared in [((at[:, None] - points)**2).sum(axis=-1)])
            for j, track in enumerate(tracks):
                if track in self.held:
                    cost[self.held[track], j] -= HELD
            matches, _ = assign(cost, 0.75)
            targets = _targets(points, matches)
            x = self._solve(x, targets, scale)
        x, matches, share = self._anew(x[0], matches, points)
        # what was found, for the next key frame and for the votes
        self.x, off = x, _targets(points, matches) - body.positions(x)
        self.off = np.where(np.isnan(off), self.off, off)
        near = np.nan_to_num(np.linalg.norm(off, axis=1), nan=np.inf) < NEAR
        self.held = {int(tracks[matches[row]]): int(row) for row in np.flatnonzero(near)}
        for track in tracks:
            label = self.held.get(int(track))
            if label is None:
                votes[track, L] += 0.5
            elif share > GOOD - 0.1:
                votes[track, label] += 1

    def _anew(self, x: np.ndarray, matches: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Unknowns, matches and the share of markers near their points, after a search where they speak for one."""
        judged = self.search.judge(x, points)
        lone = min((judged.matches < 0).sum(), len(points) - (judged.matches >= 0).sum())
        self.quiet -= 1
        if self.quiet <= 0 and lone >= LONE:
            found = self.search.restart_limbs(judged, points)
            if self._share(found.x, found.matches, points) < GOOD:
                found = min(found, self.search.find(points), key=lambda one: one.misfit)
            if found.misfit < 0.85 * judged.misfit:
                x, matches = found.x, found.matches
                self.off[:] = 0
            else:
                self.quiet = self.wait
        return x, matches, self._share(x, matches, points)

    def _share(self, x: np.ndarray, matches: np.ndarray, points: np.ndarray) -> float:
        """The share of markers, or of points if they are fewer, whose match is within 10 cm."""
        off = np.linalg.norm(_targets(points, matches) - self.body.positions(x), axis=1)
        return float((off < 0.1).sum() / min(self.body.count, len(points)))

    def _solve(self, x: np.ndarray, targets: np.ndarray, scale: float) -> np.ndarray:
        weights = robust_weights(self.body.positions(x), targets, scale)
        return self.body.solve(x, targets[None], weights, 6, 1e-3).x


def _targets(points: np.ndarray, matches: np.ndarray) -> np.ndarray:
    """The point (L, 3) of each marker, NaN without one."""
    targets = np.full((len(matches), 3), np.nan)
    targets[matches >= 0] = points[matches[matches >= 0]]
    return targets


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


def assign_by_places(points: np.ndarray, tracks: np.ndarray, places: np.ndarray, rate: float, sd: float,
                     fixed: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The column (T, L) of each marker by where a body has them in every frame, and how sure that is (T, L).

    What a point costs as a marker, half its squared deviations, is averaged along its track; then every frame is
    matched by itself. So a track may be cut, exchanged and joined, where that is what the body says for a while.

    Parameters
    ----------
    points : (T, C, 3) float, metres
    tracks : (T, C) int
    places : (T, L, 3) float, metres
    rate : float, frames per second
    sd : float, metres
        How far a marker lies from its place, in each direction.
    """
    T, L = places.shape[:2]
    costs = np.full((*tracks.shape, L), AWAY)
    for some in _pieces(T):
        squared = ((points[some, :, None] - places[some, None])**2).sum(axis=-1)
        costs[some] = np.minimum(np.nan_to_num(squared / (2 * sd**2), nan=AWAY), AWAY)
    costs = mean_along_tracks(costs, tracks, max(1, round(WINDOW * rate)))
    columns, sure = np.full((T, L), -1), np.zeros((T, L))
    for t in range(T):
        seen = np.flatnonzero(tracks[t] >= 0)
        chosen, _ = assign(costs[t, seen].T, ALONE)
        rows = np.flatnonzero(chosen >= 0)
        own = costs[t, seen[chosen[rows]]]                              # (n, L) of each chosen point as every marker
        as_this = own[np.arange(len(rows)), rows].copy()
        own[np.arange(len(rows)), rows] = np.inf
        of_this = costs[t, seen][:, rows].T.copy()                      # (n, N) of every point as this marker
        of_this[np.arange(len(rows)), chosen[rows]] = np.inf
        rival = np.minimum(np.minimum(own.min(axis=1, initial=np.inf), of_this.min(axis=1, initial=np.inf)), ALONE)
        columns[t, rows] = seen[chosen[rows]]
        sure[t, rows] = 1 / (1 + np.exp(as_this - rival))
    return columns, sure


def _pieces(count: int, size: int = 256) -> Iterator[slice]:
    return (slice(start, start + size) for start in range(0, count, size))


def take_columns(points: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """The points (T, L, 3) in some columns (T, L), NaN where that is -1."""
    taken = np.take_along_axis(points, np.maximum(columns, 0)[..., None], axis=1)
    return np.where((columns < 0)[..., None], np.nan, taken)
