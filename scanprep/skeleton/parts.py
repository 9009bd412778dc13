"""Rigid parts of a surface, found from its poses without being told how many there are."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from .labels import keep_connected, relabel
from .motions import Moments, Motions, PosedSurface, fit_motions, union_costs
from .patches import agglomerate, cover

BORDER_WIDTH = 0.01              # of the body's size: how much surface at mean cost a border is worth
STEADY = 5e-4                    # of the surface: fewer changes of label count as none


@dataclass(frozen=True)
class SkeletonConfig:
    """Settings of `find_skeleton`.

    Attributes
    ----------
    parts : int, optional
        Exact number of parts; without it the data decide.
    separation : float
        Two neighbours that are less apart become one part, see `PartSearch.separations`.
    tolerance : float
        Residual, as a fraction of the square root of the surface area, that counts as rigid.
    smallest : float
        Smallest part, as a fraction of the surface area.
    smoothness : float
        Price of the borders between parts.
    patches : int
        Number of patches of the first cover.
    start : int
        Number of parts after the patches were joined and before labels and motions alternate.
    """

    parts: int | None = None
    separation: float = 5.0
    tolerance: float = 0.001
    smallest: float = 0.005
    smoothness: float = 1.0
    patches: int = 300
    start: int = 30

    def __post_init__(self) -> None:
        if self.parts is not None and self.parts < 1:
            raise ValueError(f"parts: expected at least 1, got {self.parts}")
        for name in ("separation", "tolerance", "smallest", "smoothness"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}: expected more than 0, got {getattr(self, name)}")


class PartSearch:
    """The moves of the search: alternate, join, split.

    Parameters
    ----------
    surface : PosedSurface
    config : SkeletonConfig
    """

    def __init__(self, surface: PosedSurface, config: SkeletonConfig) -> None:
        self.surface, self.config = surface, config
        self.floor = config.tolerance**2 * surface.area
        self.width = config.smoothness * BORDER_WIDTH / np.sqrt(surface.area)
        self.patch = cover(surface, min(config.patches, len(surface.face_weights)))
        self._cuts: dict[bytes, tuple[np.ndarray, float]] = {}
        self._gains: dict[bytes, float] = {}

    def motions(self, label: np.ndarray) -> Motions:
        """Rigid motions of the parts (the M-step)."""
        return fit_motions(self.surface.moments(label))

    def alternate(self, label: np.ndarray, rounds: int) -> np.ndarray:
        """Alternate labels and motions until the labels (F,) stay.

        [Articulated]
        """
        s = self.surface
        for _ in range(rounds):
            label = np.unique(label, return_inverse=True)[1]
            motions = self.motions(label)
            costs = s.face_costs(motions)
            moved = relabel(costs, s.pairs, self.prices(motions, 1.0, s.pair_lengths), label, rounds=2)
            moved = keep_connected(costs, s.pairs, s.face_weights, moved)
            changed = s.face_weights[moved != label].sum()
            label = moved
            if changed < STEADY:
                break
        return np.unique(label, return_inverse=True)[1]

    def prices(self, motions: Motions, share: float, lengths: np.ndarray) -> np.ndarray:
        """Prices of borders of the given lengths where `share` of the surface follows the motions."""
        return self.width * max(float(motions.cost.sum()) / share, self.floor) * lengths

    def contacts(self, label: np.ndarray) -> np.ndarray:
        """(n, 2) pairs of labels that touch, lower first."""
        touching = np.sort(label[self.surface.pairs], axis=1)
        return np.unique(touching[touching[:, 0] != touching[:, 1]], axis=0)

    def separations(self, label: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For all pairs of labels that touch (n, 2), how far apart they are and what their union costs more.

        How far apart is the geometric mean of two ratios: the residual of one motion over that of two, and the
        gain of the border over that of the best cut through the smaller part. The first tells a joint from a
        surface that gives way everywhere, the second also from noise.
        """
        moments = self.surface.moments(label)
        pairs = self.contacts(label)
        if not len(pairs):
            return pairs, np.zeros(0), np.zeros(0)
        return pairs, *self._apart(moments, pairs, self._next_gains(label))

    def _next_gains(self, label: np.ndarray, first: int = 0) -> np.ndarray:
        """(P,) square metres: what each part from `first` on would gain by its best cut along the patches."""
        P, K = int(label.max()) + 1, int(self.patch.max()) + 1
        keys = [np.packbits(label == part).tobytes() for part in range(first, P)]
        if any(key not in self._gains for key in keys):
            used, piece = np.unique(label * K + self.patch, return_inverse=True)
            moments, contacts = self.surface.moments(piece), self.contacts(piece)
        for part, key in enumerate(keys, first):
            if key in self._gains:
                continue
            mine = np.flatnonzero(used // K == part)
            among = contacts[((contacts >= mine[0]) & (contacts <= mine[-1])).all(axis=1)] - mine[0]
            sub = moments[mine]
            half = agglomerate(sub, among, 2)
            whole = sub.gather(np.zeros(len(mine), dtype=np.int64))
            self._gains[key] = max(fit_motions(whole).cost[0] - fit_motions(sub.gather(half)).cost.sum(), 0.0)
        return np.array([0.0] * first + [self._gains[key] for key in keys])

    def join_down(self, label: np.ndarray, count: int | None) -> np.ndarray:
        """Join the pair that is least apart, alternate, and so on.

        Stops at `count` parts, or where it is None when all pairs are apart and no part is too small.
        """
        while True:
            label = self.alternate(label, rounds=2)
            pairs, separation, extra = self.separations(label)
            if not len(pairs) or len(np.unique(label)) <= (count or 1):
                return label
            share = np.bincount(label, self.surface.face_weights)
            small = (share[pairs] < self.config.smallest).any(axis=1)
            open_ = small | (separation < self.config.separation)
            if count is not None and not open_.any():
                open_ = separation <= separation.min()
            if not open_.any():
                return label
            least = int(np.where(open_, extra, np.inf).argmin())
            label = np.where(label == pairs[least, 1], pairs[least, 0], label)

    def split(self, label: np.ndarray, part: int) -> tuple[np.ndarray, float]:
        """Cut one part in two where it bends most.

        Returns
        -------
        (F,) int
            Labels, one more than before; unchanged if no acceptable cut was found.
        float
            How far apart the halves are, 0 where there is no cut.
        """
        key = (label == part).tobytes()
        if key not in self._cuts:
            self._cuts[key] = self._split(label == part)
        half, apart = self._cuts[key]
        return np.where(half, label.max() + 1, label), apart

    def _split(self, mine: np.ndarray) -> tuple[np.ndarray, float]:
        """Which triangles (F,) bool of a part `mine` (F,) bool to cut off, and how far apart the halves are."""
        s = self.surface
        inside = np.flatnonzero(mine)
        number = np.unique(self.patch[inside], return_inverse=True)[1]
        local = np.zeros(len(mine), dtype=np.int64)             # 0 outside, halves 1 and 2
        local[inside] = number + 1
        among = self.contacts(local)
        among = among[among[:, 0] > 0] - 1
        half = agglomerate(s.moments(local)[1:], among, 2)[number]
        within = mine[s.pairs].all(axis=1)
        pairs, lengths = np.searchsorted(inside, s.pairs[within]), s.pair_lengths[within]
        weights = s.face_weights[inside]
        for _ in range(4):
            if np.bincount(half, weights, 2).min() < self.config.smallest:
                return np.zeros_like(mine), 0.0
            local[inside] = half + 1
            moments = s.moments(local)[1:]
            motions = fit_motions(moments)
            costs = s.face_costs(motions)[inside]
            half = relabel(costs, pairs, self.prices(motions, weights.sum(), lengths), half, rounds=2)
            half = keep_connected(costs, pairs, weights, half)
        cut = np.zeros_like(mine)
        cut[inside[half == 1]] = True
        gains = self._next_gains(local, first=1)[1:]
        return cut, float(self._apart(moments, np.array([[0, 1]]), gains)[0][0])

    def _apart(self, moments: Moments, pairs: np.ndarray, gains: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        share = moments.w[pairs]
        cost = fit_motions(moments).cost[pairs].sum(axis=1)
        extra = np.maximum(union_costs(moments, pairs) - cost, 0)
        ratio = 1 + extra / (cost + self.floor * share.sum(axis=1))
        smaller = np.take_along_axis(pairs, share.argmin(axis=1)[:, None], axis=1)[:, 0]
        return np.sqrt(ratio * extra / (gains[smaller] + self.floor * moments.w[smaller])), extra


def find_parts(search: PartSearch,
               progress: Callable[[int, int], None] | None = None) -> np.ndarray:
    """Labels of triangles such that every label moves rigidly through the poses, as nearly as can be.

    Many patches are joined greedily, labels and motions alternate while the least separate parts go on
    being joined; then parts are cut where that shows a motion that was missed.

    Parameters
    ----------
    search : PartSearch
    progress : callable(done, total), optional

    Returns
    -------
    (F,) int, 0..P-1, every label connected

    [Articulated]
    """
    tell = progress or (lambda done, total: None)
    config, patch = search.config, search.patch
    start = max(config.start, 2 * (config.parts or 0))
    label = agglomerate(search.surface.moments(patch), search.contacts(patch), start)[patch]
    label = search.join_down(label, config.parts)
    tell(1, 3)
    label = _split_and_join(search, label)
    tell(2, 3)
    label = search.alternate(label, rounds=10)
    tell(3, 3)
    return label


def _split_and_join(search: PartSearch, label: np.ndarray) -> np.ndarray:
    """Cut parts and join again, as long as that gives more parts, or as many that fit better."""
    wanted = search.config.parts
    limit = search.config.separation
    tried: set[bytes] = set()
    for _ in range(2 * search.config.start):
        found = label.max() + 1
        cuts = [search.split(label, part) for part in range(found)]
        worth = [c for c in cuts if c[1] > 0 and c[0].tobytes() not in tried
                 and (c[1] >= limit or (wanted is not None and found < wanted))]
        if not worth:
            break
        cut = max(worth, key=lambda c: c[1])[0]
        tried.add(cut.tobytes())
        again = search.join_down(cut, wanted)
        more = again.max() + 1 - found
        if more > 0 or (more == 0 and search.motions(again).cost.sum() < 0.995 * search.motions(label).cost.sum()):
            label = again
    return label
