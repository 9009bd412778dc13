"""Greedy selection of marker sets, group by group, for all bodies and all candidates at once."""
from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ..marker_sets.symmetry import label_pairs
from .linear import LinearBodies


def symmetric_groups(labels: Sequence[str]) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of the markers of each pair of left and right, and of each single marker, by label."""
    pairs = label_pairs(labels)
    other = np.where(pairs < 0, np.arange(len(labels)), pairs)
    return tuple((int(i),) if i == j else (int(i), int(j)) for i, j in enumerate(other) if i <= j)


Groups = Sequence[tuple[int, ...]]
ADD, REMOVE = 1, -1                  # the sign s of the update formulas


@dataclass(frozen=True, eq=False)
class Path:
    """Marker sets, each with one group more or less than the one before."""

    start: np.ndarray                # (m,) int, groups of the first set, in rising order
    steps: tuple[int, ...]           # the group that was added or removed in each step
    added: bool                      # groups were added
    counts: np.ndarray               # (S,) int, markers of each set, the first included
    rmse: np.ndarray                 # (S,) float, metres

    def set(self, i: int) -> np.ndarray:
        """Return the groups of the i-th set, in rising order."""
        combine = np.union1d if self.added else np.setdiff1d
        return np.asarray(combine(self.start, np.array(self.steps[:i], dtype=np.int64)))

    def at(self, count: int) -> int:
        """Return which set has `count` markers, or the most below it; -1 where all have more."""
        below = np.flatnonzero(self.counts <= count)
        return int(below[np.argmax(self.counts[below])]) if len(below) else -1


class MarkerSets:
    """A set of groups of markers, its error on every body, and the change of the error by adding or removing a group.

    For a group with rows B that is added (s = +1) or removed (s = -1), with C the covariance of the step d and
    `k = (I + s B C Bᵀ)⁻¹ (g - B d)`, the step becomes `d + s C Bᵀ k` and the cost changes by
    `2 s k·q + kᵀ F k`, where `q = B C (G d - p)` and `F = B C G C Bᵀ`. These are stored for the rows of each group. So
    testing all groups costs small solves only, and a change of the set costs one pass over the rows.

    [MoSh] Eq. 26, Eq. 27
    """

    def __init__(self, linear: LinearBodies, groups: Groups, chosen: Collection[int]) -> None:
        Z, _, r, P = linear.rows.shape
        width = r * max(len(group) for group in groups)
        self.sizes = np.array([len(group) for group in groups])
        self.inside = np.isin(np.arange(len(groups)), np.array(sorted(chosen), dtype=np.int64))
        self._linear, self._groups = linear, groups
        self._rows, self._gaps = np.zeros((Z, len(groups), width, P)), np.zeros((Z, len(groups), width))
        for i, group in enumerate(groups):
            self._rows[:, i, :r * len(group)] = linear.rows[:, group].reshape(Z, -1, P)
            self._gaps[:, i, :r * len(group)] = linear.gaps[:, group].reshape(Z, -1)
        self.renew()

    def renew(self) -> None:
        """Solve from scratch, without the rounding errors of updates."""
        linear, (Z, _, _, P) = self._linear, self._rows.shape
        members = [c for group, inside in zip(self._groups, self.inside, strict=True) if inside for c in group]
        B = linear.rows[:, members].reshape(Z, -1, P)
        self._C = np.linalg.inv(np.swapaxes(B, -1, -2) @ B + linear.precision)
        d = linear.steps(members)
        self.costs = linear.surface_error(d)
        slope = ((linear.gram @ d[..., None])[..., 0] - linear.pull)[..., None]
        self._rho = self._gaps - (self._rows @ d[:, None, :, None])[..., 0]
        self._q = (self._rows @ (self._C @ slope)[:, None])[..., 0]
        self._S, self._F = np.empty((2, *self._gaps.shape, self._gaps.shape[-1]))
        for z in range(Z):                               # one body at a time, as products are as large as the rows
            W = self._rows[z] @ self._C[z]
            self._S[z] = W @ np.swapaxes(self._rows[z], -1, -2)
            self._F[z] = (W @ linear.gram[z]) @ np.swapaxes(W, -1, -2)

    @property
    def count(self) -> int:
        """Number of markers of the set."""
        return int(self.sizes[self.inside].sum())

    @property
    def rmse(self) -> float:
        """Root of the mean squared distance, metres."""
        return float(np.sqrt(self.costs.mean()))

    def score_groups(self, groups: np.ndarray, sign: int) -> np.ndarray:
        """Compute the mean squared distance (n,) after adding (+1) or removing (-1) each of some groups."""
        rho, S = self._rho[:, groups], self._S[:, groups]
        k = np.linalg.solve(np.eye(S.shape[-1]) + sign * S, rho[..., None])
        change = 2 * sign * (k[..., 0] * self._q[:, groups]).sum(axis=-1)
        change += (k * (self._F[:, groups] @ k)).sum(axis=(-1, -2))
        return np.asarray((self.costs[:, None] + change).mean(axis=0))

    def take(self, group: int, sign: int) -> None:
        """Add (+1) or remove (-1) a group, and update all stored products."""
        U = self._rows[:, group] @ self._C                                                # (Z, w, P)
        S, F, rho = self._S[:, group].copy(), self._F[:, group].copy(), self._rho[:, group, :, None].copy()
        M = np.linalg.inv(np.eye(S.shape[-1]) + sign * S)
        k = M @ rho
        # products of all rows with those of the group, by C and by C G C
        both = np.concatenate([U, U @ self._linear.gram @ self._C], axis=1)
        found = self._rows @ np.swapaxes(both, -1, -2)[:, None]
        K, L = np.split(found, 2, axis=-1)                                                # B C Bᵀ, B C G C Bᵀ
        KM = K @ M[:, None]
        self.costs = self.costs + (2 * sign * (k[..., 0] * self._q[:, group]).sum(axis=-1)
                                   + (k * (F @ k)).sum(axis=(-1, -2)))
        behind = self._q[:, group, :, None] + sign * (F @ k)
        self._q += (sign * (L @ k[:, None] - KM @ behind[:, None]))[..., 0]
        self._rho -= (sign * (K @ k[:, None]))[..., 0]
        # rank-one style updates (Woodbury) of S = B C Bᵀ, F = B C G C Bᵀ and C
        self._S -= sign * (KM @ np.swapaxes(K, -1, -2))
        cross = KM @ np.swapaxes(L, -1, -2)
        self._F += KM @ F[:, None] @ np.swapaxes(KM, -1, -2) - sign * (cross + np.swapaxes(cross, -1, -2))
        self._C -= sign * (np.swapaxes(U, -1, -2) @ M @ U)
        self.inside[group] = sign == ADD

    def state(self) -> tuple[np.ndarray, ...]:
        """Return a copy of the state for `put_back`; undoing by updates would lose digits."""
        return tuple(a.copy() for a in (self.inside, self.costs, self._C, self._S, self._F, self._rho, self._q))

    def put_back(self, state: tuple[np.ndarray, ...]) -> None:
        """Restore a state, which must not be used again."""
        self.inside, self.costs, self._C, self._S, self._F, self._rho, self._q = state


def improve_set(sets: MarkerSets, sign: int, movable: np.ndarray, until: int, through: Collection[int] = (),
                report_progress: Callable[[int], None] | None = None) -> Path:
    """Add or remove the best group, by its effect per marker, again and again.

    Only groups of `movable` (n,) change, down or up to `until` markers. Counts in `through` are hit exactly where
    single markers can do that.
    """
    start, steps = np.flatnonzero(sets.inside), list[int]()
    counts, rmse = [sets.count], [sets.rmse]
    while True:
        open_ = np.flatnonzero(movable & (sets.inside == (sign == REMOVE)))
        open_ = open_[sign * (sets.count + sign * sets.sizes[open_]) <= sign * until]
        if not len(open_):
            return Path(start, tuple(steps), sign == ADD, np.array(counts), np.array(rmse))
        # do not step over a count of `through` with a pair if a single marker can move
        passed = np.array([any(0 < sign * (stop - sets.count) < size for stop in through)
                           for size in sets.sizes[open_]])
        open_ = open_ if passed.all() else open_[~passed]
        gain = (sets.score_groups(open_, sign) - sets.costs.mean()) / sets.sizes[open_]
        steps.append(int(open_[np.argmin(gain)]))
        sets.take(steps[-1], sign)
        # the first markers determine the place a thousand times better than the prior, so updates lose digits
        if sign == ADD and sets.count < 8:
            sets.renew()
        counts.append(sets.count)
        rmse.append(sets.rmse)
        if report_progress is not None:
            report_progress(sets.count)


def exchange(sets: MarkerSets, movable: np.ndarray) -> int:
    """Try to exchange every group of the set, and single ones two at a time, for better ones; count the exchanges.

    A pair may be exchanged for two single markers and the other way round.
    """
    done = 0
    for group in np.flatnonzero(movable & sets.inside):
        if sets.inside[group]:
            done += _exchange(sets, movable, [int(group)])
    for group in np.flatnonzero(movable & sets.inside & (sets.sizes == 1)):
        others = np.flatnonzero(movable & sets.inside & (sets.sizes == 1))
        others = others[others != group]
        if sets.inside[group] and len(others):
            least = others[np.argmin(sets.score_groups(others, REMOVE))]
            done += _exchange(sets, movable, [int(group), int(least)])
    return done


def _exchange(sets: MarkerSets, movable: np.ndarray, out: list[int]) -> bool:
    """Exchange groups of the set for the best replacement; restore them where nothing is better."""
    before, enough = sets.state(), sets.costs.mean() * (1 - 1e-6)    # least gain: a millionth, above rounding errors
    for group in out:
        sets.take(group, REMOVE)
    new = _fill(sets, movable, int(sets.sizes[out].sum()))
    if set(new) != set(out) and sets.costs.mean() < enough:
        sets.renew()
        if sets.costs.mean() < enough:
            return True
    sets.put_back(before)
    return False


def _fill(sets: MarkerSets, movable: np.ndarray, size: int) -> list[int]:
    """Add one group of a size, or single markers in turn, whichever is better; return what was added."""
    whole, cost = _best(sets, movable, size)
    single, _ = _best(sets, movable, 1)
    if size == 1 or single < 0:
        sets.take(whole, ADD)
        return [whole]
    before = sets.state()
    sets.take(single, ADD)
    second, together = _best(sets, movable, size - 1)
    if second >= 0 and together < cost:
        return [single, *_fill(sets, movable, size - 1)]
    sets.put_back(before)
    sets.take(whole, ADD)
    return [whole]


def _best(sets: MarkerSets, movable: np.ndarray, size: int) -> tuple[int, float]:
    """Return the best group of a size, and the mean squared distance with it; -1 where there is none."""
    open_ = np.flatnonzero(movable & ~sets.inside & (sets.sizes == size))
    if not len(open_):
        return -1, float("inf")
    costs = sets.score_groups(open_, ADD)
    return int(open_[np.argmin(costs)]), float(costs.min())
