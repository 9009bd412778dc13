"""Follow bodies through unlabelled points: key frames are solved, and vote for the labels of tracks."""
from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from .body_search import ALONE, JUDGED, BodySearch, Placement, assign_columns, robust_weights

EVERY = 0.1                          # seconds between key frames
GOOD = 0.7                           # share of markers within 10 cm below which the body is searched from scratch
BETTER = 0.2                         # misfit that a new start has to gain, in markers; a reversed foot costs 0.3 to 1
WAIT, LONGEST = 0.5, 2.0             # seconds from a search without success to the next, doubled up to LONGEST


@dataclass(frozen=True)
class Scales:
    """Scales, metres, of the distances of points from markers.

    `judged` is for the judgement of a solution, `matches` for successive rounds of matches, `held` for the distance
    from the marker's offset in the key frame before.
    """

    judged: float
    matches: tuple[float, ...]
    held: float


MEAN_PERSON = Scales(JUDGED, (0.15, 0.12), 0.06)
# for the fitted person; 0.08 for `judged`, as above, exchanged the markers of a foot in 2 of 4 recordings
OWN_PERSON = Scales(0.04, (0.12, 0.06), 0.04)


@dataclass(frozen=True, eq=False)
class KeyFrame:
    """The points (N, 3) of a frame, metres, their tracks (N,), and known labels (N,) as in `label_markers`."""

    points: np.ndarray
    tracks: np.ndarray
    known: np.ndarray


@dataclass(frozen=True, eq=False)
class Solution:
    """The solution of a body in a key frame.

    Attributes
    ----------
    x : (P,) float
        Pose and place.
    matches : (L,) int
        The point of each marker, -1 without one.
    off : (L, 3) float, metres
        Offset of the point of each marker from its place on the body; the last one for a marker without a point.
    total : float
        Misfit, multiplied by the number of markers.
    """

    x: np.ndarray
    matches: np.ndarray
    off: np.ndarray
    total: float

    @property
    def strain(self) -> float:
        """Cost of the markers that have a point."""
        return self.total - ALONE * float((self.matches < 0).sum())

    @property
    def near(self) -> np.ndarray:
        """Distance (L,) of each marker's point from its place, metres; infinite without one."""
        return np.where(self.matches >= 0, np.linalg.norm(self.off, axis=1), np.inf)

    def labels(self, tracks: np.ndarray) -> dict[int, int]:
        """Return track -> marker, for markers near their place."""
        # 0.15: metres from its place beyond which a point loses its label
        return {int(tracks[self.matches[row]]): int(row) for row in np.flatnonzero(self.near < 0.15)}


Solutions = tuple[Solution, ...]     # of each person


def key_frames(points: np.ndarray, tracks: np.ndarray, known: np.ndarray, rate: float, first: int
               ) -> tuple[np.ndarray, list[KeyFrame]]:
    """Return the key frames (K,), `first` among them, and their points."""
    every = max(1, round(EVERY * rate))
    times = np.arange(first % every, len(points), every)
    seen = [np.flatnonzero(tracks[t] >= 0) for t in times]
    return times, [KeyFrame(points[t, s], tracks[t, s], known[t, s]) for t, s in zip(times, seen, strict=True)]


def follow_keys(searches: Sequence[BodySearch], keys: Sequence[KeyFrame], begin: int, placements: Sequence[Placement],
                report_progress: Callable[[int], None]) -> list[Solutions | None]:
    """Solve the people in every key frame, forwards and backwards from the frame `begin` in which they were found.

    Tracks that continue keep their labels; other points are matched with the remaining markers of all people. Limbs,
    and a body that has lost its points, are searched again now and then, and where the fit gets worse. Where successive
    key frames disagree about the label of a track, each is solved again from the other.
    """
    solver = _KeyFrameSolver(searches, MEAN_PERSON)
    found: list[Solutions | None] = [None for _ in keys]
    done, N = 0, len(searches)
    for way in (range(begin, len(keys)), range(begin - 1, -1, -1)):
        before = solver.place([placement.x for placement in placements], keys[begin])
        nothing = [dict[int, int]() for _ in searches]
        held = nothing if way.step > 0 else _labels(found[begin] or before, keys[begin].tracks)
        wait, quiet, usual = np.full(N, WAIT), np.zeros(N), np.full(N, np.inf)
        for i in way:
            done += 1
            report_progress(done)
            quiet -= EVERY
            if len(keys[i].points) < 3:
                held = nothing
                continue
            after = solver.carry([before], [held], [keys[i]])[0]
            for k in range(N):
                # search limbs and body again after the waiting time, or when the fit is worse than usual
                if quiet[k] > 0 and after[k].strain <= usual[k] + BETTER:
                    continue
                new = solver.start_anew(after, k, keys[i])
                wait[k] = WAIT if new is not after else min(2 * wait[k], LONGEST)
                after, quiet[k], usual[k] = new, wait[k], new[k].strain
            found[i] = before = after
            held = _labels(after, keys[i].tracks)
    solver.reconcile(keys, found)
    return found


def solve_again(searches: Sequence[BodySearch], keys: Sequence[KeyFrame], found: Sequence[Solutions | None],
                labels: np.ndarray) -> list[Solutions | None]:
    """Solve key frames for fitted people, from solutions of other bodies and labels (K,) of tracks, -1 without.

    All key frames are solved together; limbs are searched again where the body fits worse than usual.
    """
    # all solved key frames again, with offsets forgotten and labels by track
    solver = _KeyFrameSolver(searches, OWN_PERSON)
    solved = {i: solutions for i, solutions in enumerate(found) if solutions is not None}
    some = list(solved)
    before = [tuple(replace(one, off=np.zeros_like(one.off)) for one in solved[i]) for i in some]
    held = [[{int(track): int(labels[track]) - first for track in keys[i].tracks if first <= labels[track] < end}
             for first, end in solver.rows] for i in some]
    now = dict(zip(some, solver.carry(before, held, [keys[i] for i in some]), strict=True))
    for k in range(len(searches)):
        usual, last = float(np.median([now[i][k].strain for i in some])) if some else 0.0, -np.inf
        for i in some:
            taken = sum(np.count_nonzero(one.matches >= 0) for one in now[i])
            lone = min(np.count_nonzero(now[i][k].matches < 0), len(keys[i].points) - taken)
            # search limbs where the fit is worse, or where 2 markers and 2 points have no partner
            if now[i][k].strain > usual + BETTER or (lone >= 2 and (i - last) * EVERY >= WAIT):
                now[i], last = solver.start_anew(now[i], k, keys[i]), i
    again = [now.get(i) for i in range(len(keys))]
    solver.reconcile(keys, again)
    return again


def count_votes(keys: Sequence[KeyFrame], found: Sequence[Solutions | None], count: int) -> np.ndarray:
    """Count how often key frames gave each track each label (count, L + 1), with L markers of all people.

    The last column is for no label, which counts half. Frames with a bad fit do not vote for labels.
    """
    sizes = next([len(one.matches) for one in solutions] for solutions in found if solutions is not None)
    ends = np.cumsum(sizes)
    votes = np.zeros((count, ends[-1] + 1))
    for key, solutions in zip(keys, found, strict=True):
        if solutions is None:
            continue
        votes[key.tracks, -1] += 0.5
        for one, end in zip(solutions, ends, strict=True):
            good = (one.near < 0.1).sum() > (GOOD - 0.1) * min(len(one.matches), len(key.points))
            for track, label in one.labels(key.tracks).items():
                votes[track, -1] -= 0.5
                votes[track, end - len(one.matches) + label] += float(good)
    return votes


def _labels(solutions: Solutions, tracks: np.ndarray) -> list[dict[int, int]]:
    """Return track -> marker for each person."""
    return [one.labels(tracks) for one in solutions]


class _KeyFrameSolver:
    """Solves the bodies of some people in key frames, from those in other key frames."""

    def __init__(self, searches: Sequence[BodySearch], scales: Scales) -> None:
        self.searches, self.scales = searches, scales
        ends = np.cumsum([search.body.count for search in searches]).tolist()
        self.rows = list(zip([0, *ends[:-1]], ends, strict=True))       # first and last row of each person's markers

    def place(self, x: Sequence[np.ndarray], key: KeyFrame) -> Solutions:
        """Return the solution for given unknowns (P,) of each person."""
        out = []
        for search, one in zip(self.searches, x, strict=True):
            judged = search.judge(one, key.points, self.scales.judged)
            out.append(self._solution(search, one, judged.matches, key.points, np.zeros((search.body.count, 3))))
        return tuple(out)

    def carry(self, before: Sequence[Solutions], held: Sequence[Sequence[dict[int, int]]], keys: Sequence[KeyFrame]
              ) -> list[Solutions]:
        """Carry solutions of key frames to other key frames, where some tracks have a label already."""
        unknowns = [self._lay_on_tracks(search, [solutions[k] for solutions in before], [of[k] for of in held], keys)
                    for k, search in enumerate(self.searches)]
        # match all points with the simulated markers, and with their last offsets; then solve
        matches = np.full((len(keys), self.rows[-1][1]), -1)
        for scale in self.scales.matches:
            places = [search.body.positions(x) for search, x in zip(self.searches, unknowns, strict=True)]
            for i, key in enumerate(keys):
                cost = np.concatenate([self._costs(places[k][i], before[i][k].off, held[i][k], key, scale)
                                       for k in range(len(self.searches))])
                forbid(cost, key.known)
                matches[i] = assign_columns(cost, 0.75)[0]
            for k, (search, (first, end)) in enumerate(zip(self.searches, self.rows, strict=True)):
                targets = np.stack([take_points(key.points, row[first:end])
                                    for key, row in zip(keys, matches, strict=True)])
                unknowns[k] = _solve(search, unknowns[k], targets, scale)
        solved = []
        for i, key in enumerate(keys):
            solved.append(tuple(
                self._solution(search, unknowns[k][i], matches[i, first:end],
                               _others_hidden(key.points, np.delete(matches[i], np.s_[first:end])), before[i][k].off)
                for k, (search, (first, end)) in enumerate(zip(self.searches, self.rows, strict=True))))
        return solved

    def _lay_on_tracks(self, search: BodySearch, before: Sequence[Solution], held: Sequence[dict[int, int]],
                       keys: Sequence[KeyFrame]) -> np.ndarray:
        """Fit a body to the tracks that have a label; return unknowns (K, P)."""
        body, x = search.body, np.stack([solution.x for solution in before])
        targets = np.full((len(x), body.count, 3), np.nan)
        for target, labels, key in zip(targets, held, keys, strict=True):
            for point, track in zip(key.points, key.tracks, strict=True):
                if int(track) in labels:
                    target[labels[int(track)]] = point
        there = np.isfinite(targets[..., 0])
        # with 4 labelled points: move the body to them, then solve
        enough = there.sum(axis=1) >= 4
        if enough.any():
            n = body.body.n_angles
            step = np.where(there[..., None], targets - body.positions(x), 0.0).sum(axis=1)
            x[enough, n:n + 3] += (step / np.maximum(there.sum(axis=1, keepdims=True), 1))[enough]
            x[enough] = _solve(search, x[enough], targets[enough], np.inf)
        return x

    def _costs(self, places: np.ndarray, off: np.ndarray, held: dict[int, int], key: KeyFrame, scale: float
               ) -> np.ndarray:
        """Compute costs (L, N) of points as markers, by their places (L, 3) and by their last offsets."""
        cost = np.zeros((len(places), len(key.points)))
        for at, s in ((places, scale), (places + off, self.scales.held)):
            squared = ((at[:, None] - key.points)**2).sum(axis=-1)
            cost += 0.5 * squared / (squared + s**2)
        for j, track in enumerate(key.tracks):
            if int(track) in held:
                # 0.3: bonus for a track that keeps its label
                cost[held[int(track)], j] -= 0.3
        return cost

    def start_anew(self, solutions: Solutions, k: int, key: KeyFrame) -> Solutions:
        """Search a limb, or all of the body, of person k again; return the solutions, with k's if it is better."""
        search, scale, before = self.searches[k], self.scales.judged, solutions[k]
        others = np.concatenate([one.matches for j, one in enumerate(solutions) if j != k] or [np.empty(0, dtype=int)])
        points = _others_hidden(key.points, others)
        judged = search.judge(before.x, points, scale)
        candidate = search.restart_limbs(judged, points, scale)
        # the whole body if too few markers are near their points
        near = self._solution(search, candidate.x, candidate.matches, points, before.off).near
        visible = points[np.isfinite(points[:, 0])]
        if (near < 0.1).sum() < GOOD * min(search.body.count, len(visible)) and len(visible) > 3:
            other = search.judge(search.find(visible).x, points, scale)
            candidate = min(candidate, other, key=lambda one: one.misfit)
        if (judged.misfit - candidate.misfit) * search.body.count < BETTER:
            return solutions
        new = self._solution(search, candidate.x, candidate.matches, points, np.zeros_like(before.off))
        return (*solutions[:k], new, *solutions[k + 1:])

    def reconcile(self, keys: Sequence[KeyFrame], found: list[Solutions | None]) -> None:
        """Carry the solution between successive key frames that disagree about a track, where that gains."""
        pairs = deque(range(len(keys) - 1))
        waiting = set(pairs)
        while pairs:
            i = pairs.popleft()
            waiting.discard(i)
            for source, target in ((i, i + 1), (i + 1, i)):
                a, b = found[source], found[target]
                if a is None or b is None:
                    continue
                held, other = _labels(a, keys[source].tracks), _labels(b, keys[target].tracks)
                mine, theirs = ({track: (k, label) for k, labels in enumerate(of) for track, label in labels.items()}
                                for of in (held, other))
                if all(theirs.get(track, label) == label for track, label in mine.items()):
                    continue
                new = self.carry([a], [held], [keys[target]])[0]
                if sum(one.total for one in new) < sum(one.total for one in b) - 0.5 * BETTER:
                    found[target] = new
                    for near in (target - 1, target):
                        if 0 <= near < len(keys) - 1 and near not in waiting:
                            pairs.append(near)
                            waiting.add(near)

    def _solution(self, search: BodySearch, x: np.ndarray, matches: np.ndarray, points: np.ndarray, off: np.ndarray
                  ) -> Solution:
        """Make a solution; markers without a point keep their last offset, `off` (L, 3)."""
        new = take_points(points, matches) - search.body.positions(x)
        total = search.judge(x, points, self.scales.judged).misfit * search.body.count
        return Solution(x, matches, np.where(np.isnan(new), off, new), total)


def _solve(search: BodySearch, x: np.ndarray, targets: np.ndarray, scale: float) -> np.ndarray:
    """Solve unknowns (K, P) for targets (K, L, 3), with robust weights of a scale."""
    weights = robust_weights(search.body.positions(x), targets, scale)
    return search.body.solve(x, targets, weights, 6, 1e-3).x


def _others_hidden(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return points (N, 3) with those of other people set to NaN."""
    if not len(others):
        return points
    points = points.copy()
    points[others[others >= 0]] = np.nan
    return points


def forbid(cost: np.ndarray, known: np.ndarray) -> None:
    """Raise costs (L, N), in place, of matches that contradict known labels (N,)."""
    labelled = np.flatnonzero(known >= 0)
    forced = 100.0  # cost of a forbidden match, above all others
    taken = cost[known[labelled], labelled] - forced                    # kept, as its row and column are raised
    cost[:, known != -1] += forced
    cost[known[labelled]] += forced
    cost[known[labelled], labelled] = taken


def take_points(points: np.ndarray, matches: np.ndarray) -> np.ndarray:
    """Return the point (L, 3) of each marker, NaN without one."""
    targets = np.full((len(matches), 3), np.nan)
    targets[matches >= 0] = points[matches[matches >= 0]]
    return targets
