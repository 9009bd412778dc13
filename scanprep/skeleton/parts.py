"""Find the rigid parts of a surface from its poses, and their number."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ..ranges import FLAG, Count, Positive, Seed, Settings
from .motions import Moments, Motions, PosedSurface, agglomerate, fit_motions, halve, rigid_costs, union_costs
from .sides import Sides, cover, mirror_pairs
from .symmetry import Symmetry

PATCHES = 300                    # at first, about ten for each of the parts they are joined to
START = 30                       # parts after the patches are joined: twice those of a person
FADING = 0.8                     # a part dissolves when a blend of its neighbours explains this share of its motion


@dataclass(frozen=True)
class SkeletonConfig(Settings):
    """Settings of `find_skeleton`.

    Attributes
    ----------
    parts : int, optional
        Number of parts, or the nearest that gives a tree; by default the data decide.
    separation : float
        Neighbours with a smaller separation are merged, see `PartSearch.separations`.
    tolerance : float
        Residual, as a fraction of the square root of the surface area, that counts as rigid.
    symmetric : bool, optional
        Whether left and right have the same parts; by default they do if the body is symmetric.
    restarts : int
        Number of restarts with other patches; the best result is kept.
    seed : int
        Seed of the random numbers that place the patches.

    Examples
    --------
    >>> SkeletonConfig(parts=16).parts
    16
    """

    parts: Annotated[Count | None, FLAG] = None
    separation: Positive = 5.0
    tolerance: Positive = 0.001
    symmetric: bool | None = None
    restarts: Count = 3
    seed: Seed = 0


class PartSearch:
    """The moves of the search: alternate, join, split. With a symmetry every move is made on both sides.

    The generator places the initial patches.
    """

    SMALLEST = 0.005                 # share of the surface: a smaller part is merged with a neighbour

    def __init__(self, surface: PosedSurface, config: SkeletonConfig, symmetry: Symmetry | None = None,
                 rng: np.random.Generator | None = None, patches: int = PATCHES) -> None:
        self.surface, self.config = surface, config
        self.sides = Sides(surface, symmetry)
        self.floor = config.tolerance**2 * surface.area
        self.width = 0.01 / np.sqrt(surface.area)       # price of a metre of border, in surface at mean cost
        self.patch = cover(surface, min(patches, len(surface.face_weights)), self.sides, rng)
        self.forget()

    def forget(self) -> None:
        """Clear the caches, whose last digits depend on the order of the moves."""
        self._cuts: dict[bytes, tuple[np.ndarray, float]] = {}
        self._gains: dict[bytes, float] = {}

    def motions(self, label: np.ndarray) -> Motions:
        """Fit the rigid motions of the parts (the M-step)."""
        return fit_motions(self.surface.moments(label))

    def alternate(self, label: np.ndarray, rounds: int, core: bool = False) -> np.ndarray:
        """Alternate labels (E-step) and motions (M-step) until the labels (F,) stay; `core` fits motions to part cores.

        [Articulated]
        """
        s = self.surface
        for _ in range(rounds):
            label = np.unique(label, return_inverse=True)[1]
            motions = self.motions(label)
            costs = s.face_costs(s.core_motions(label) if core else motions)
            moved = self.sides.relabel(costs, self.price(motions, 1.0), label, self.sides.partners(label))
            changed = s.face_weights[moved != label].sum()
            label = moved
            if changed < 5e-4:                                       # share of the surface that still changes
                break
        return np.unique(label, return_inverse=True)[1]

    def price(self, motions: Motions, share: float) -> float:
        """Return the price of a metre of border, where `share` of the surface follows the motions."""
        return self.width * max(float(motions.cost.sum()) / share, self.floor)

    def energy(self, label: np.ndarray) -> float:
        """Compute the energy of a labelling, square metres: residual of the parts plus price of their borders."""
        s, motions = self.surface, self.motions(label)
        border = s.pair_lengths[label[s.pairs[:, 0]] != label[s.pairs[:, 1]]].sum()
        return float(motions.cost.sum() + self.price(motions, 1.0) * border)

    def contacts(self, label: np.ndarray) -> np.ndarray:
        """Return the pairs (n, 2) of labels that touch, lower first."""
        touching = np.sort(label[self.surface.pairs], axis=1)
        return np.unique(touching[touching[:, 0] != touching[:, 1]], axis=0)

    def separations(self, label: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute for all pairs of touching labels (n, 2) their separation and the extra cost of their union.

        The separation is the geometric mean of two ratios: the residual of one motion over that of two, and the gain of
        this border over that of the best cut through the smaller part. The first separates a joint from a surface that
        is soft everywhere, the second also from noise.
        """
        moments = self.surface.moments(label)
        pairs = self.contacts(label)
        if not len(pairs):
            return pairs, np.zeros(0), np.zeros(0)
        return pairs, *self._apart(moments, pairs, self._next_gains(label), self.sides.partners(label))

    def _next_gains(self, label: np.ndarray, first: int = 0) -> np.ndarray:
        """Compute the gain (P,), square metres, of the best cut of each part from `first` on, along the patches."""
        P, K = int(label.max()) + 1, int(self.patch.max()) + 1
        # gains are cached by the triangles of a part
        keys = [np.packbits(label == part).tobytes() for part in range(first, P)]
        new = [part for part, key in enumerate(keys, first) if key not in self._gains]
        if new:
            # the patches of all new parts, joined down to two each
            used, piece = np.unique(label * K + self.patch, return_inverse=True)
            ours, contacts = np.flatnonzero(np.isin(used // K, new)), self.contacts(piece)
            number, place = np.full(len(used), -1), np.full(P, -1)
            number[ours], place[new] = np.arange(len(ours)), np.arange(len(new))
            moments, among, group = self.surface.moments(piece)[ours], number[contacts], place[used[ours] // K]
            among = among[(among >= 0).all(axis=1)]
            among = among[group[among[:, 0]] == group[among[:, 1]]]
            half, of_set = np.unique(halve(moments, among, group), return_inverse=True)
            cut = np.bincount(group[half], rigid_costs(moments.gather(of_set)), len(new))
            gains = np.maximum(rigid_costs(moments.gather(group)) - cut, 0)
            self._gains.update(zip((keys[part - first] for part in new), gains.tolist(), strict=True))
        return np.array([0.0] * first + [self._gains[key] for key in keys])

    def _apart(self, moments: Moments, pairs: np.ndarray, gains: np.ndarray, partner: np.ndarray
               ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the separation (n,) of pairs and the extra cost (n,) of their unions; see `separations`."""
        share = moments.w[pairs]
        cost = rigid_costs(moments)[pairs].sum(axis=1)
        extra = np.maximum(union_costs(moments, pairs) - cost, 0)
        base = cost + self.floor * share.sum(axis=1)
        smaller = np.take_along_axis(pairs, share.argmin(axis=1)[:, None], axis=1)[:, 0]
        gain = gains[smaller] + self.floor * moments.w[smaller]
        if self.sides.tied:                                          # a pair and its mirror image are judged as one
            image = mirror_pairs(pairs, partner)
            extra, base, gain = ((value + value[image]) / 2 for value in (extra, base, gain))
        return np.sqrt((1 + extra / base) * extra / gain), extra

    def join(self, label: np.ndarray, a: int, b: int) -> np.ndarray:
        """Merge labels a and b, on a symmetric body on both sides; return labels (F,)."""
        return self.sides.join(label, a, b, self.sides.partners(label))

    def join_down(self, label: np.ndarray) -> np.ndarray:
        """Merge pairs and alternate until all parts are separated and none is too small; cheapest unions first.

        A pair that the alternation splits again stays two.
        """
        label = self.alternate(label, rounds=2)
        while True:
            pairs, separation, extra = self.separations(label)
            share = np.bincount(label, self.surface.face_weights)
            open_ = (share[pairs] < self.SMALLEST).any(axis=1) | (separation < self.config.separation)
            for i in np.flatnonzero(open_)[np.argsort(extra[open_], kind="stable")]:
                joined = self.alternate(self.join(label, *pairs[i]), rounds=2)
                if joined.max() < label.max():
                    label = joined
                    break
            else:
                return label

    def split(self, label: np.ndarray, part: int) -> tuple[np.ndarray, float]:
        """Cut one part where it bends most; return labels (F,) and the separation of the pieces, 0 without a cut.

        It is cut in two or, in the middle of a symmetric body, in three.
        """
        partner = self.sides.partners(label)
        inside = (label == part) | (label == partner[part])
        key = inside.tobytes() + bytes([int(partner[part] == part)])
        if key not in self._cuts:
            self._cuts[key] = self._split(inside, label == part)
        piece, apart = self._cuts[key]
        if apart == 0:
            return label, 0.0
        return np.unique(np.where(inside, label.max() + piece, label), return_inverse=True)[1], apart

    def _split(self, inside: np.ndarray, one: np.ndarray) -> tuple[np.ndarray, float]:
        """Cut a part and its mirror image, `inside` (F,) bool; return pieces (F,), from 1, and their separation.

        `one` (F,) bool is the part alone.
        """
        s, sides = self.surface, self.sides
        two = bool((inside & ~one).any())
        local = np.zeros(len(inside), dtype=np.int64)             # 0 outside
        local[inside] = np.unique(2 * self.patch[inside] + one[inside], return_inverse=True)[1] + 1
        # join the patches down to two sets; patches of the part never join those of its mirror image
        of_one = np.bincount(local, one & inside) > 0
        among = self.contacts(local)
        among = among[(among[:, 0] > 0) & (of_one[among[:, 0]] == of_one[among[:, 1]])] - 1
        partner = sides.partners(local)[1:] - 1 if sides.tied else None
        piece = agglomerate(s.moments(local)[1:], among, 2, partner)
        local[inside] = piece[local[inside] - 1] + 1
        # alternate motions and labels a few times inside the part
        weights = s.face_weights[inside]
        for _ in range(4):
            shares = np.bincount(local[inside] - 1, weights)
            if len(shares) < (4 if two else 2) or shares.min() < self.SMALLEST:
                return local, 0.0
            motions = fit_motions(s.moments(local)[1:])
            partner = sides.partners(local)[1:] - 1 if sides.tied else np.arange(len(shares))
            moved = sides.relabel(s.face_costs(motions), self.price(motions, weights.sum()),
                                  np.maximum(local - 1, 0), partner, inside)
            local[inside] = np.unique(moved[inside], return_inverse=True)[1] + 1
        return local, self._least_apart(local, one, two)

    def _least_apart(self, local: np.ndarray, one: np.ndarray, two: bool) -> float:
        """Return the smallest separation between the pieces of a part."""
        moments, pairs = self.surface.moments(local)[1:], self.contacts(local)
        pairs = pairs[pairs[:, 0] > 0]
        if two:
            of_one = np.bincount(local, one) > 0
            pairs = pairs[of_one[pairs[:, 0]] == of_one[pairs[:, 1]]]
        if not len(pairs):
            return 0.0
        partner = self.sides.partners(local)[1:] - 1
        return float(self._apart(moments, pairs - 1, self._next_gains(local, first=1)[1:], partner)[0].min())


def find_parts(search: PartSearch) -> np.ndarray:
    """Find connected labels (F,) of triangles that move as rigidly as possible through the poses.

    Many patches are joined greedily. Labels and motions alternate while the least separated parts are merged. Then
    parts are cut where that reveals a motion not yet found.

    [Articulated]
    """
    patch, tied = search.patch, search.sides.tied
    sets = -(-3 * START // 5) if tied else START    # a part and its mirror image are one
    label = agglomerate(search.surface.moments(patch), search.contacts(patch), sets,
                        search.sides.partners(patch) if tied else None)[patch]
    label = _split_and_join(search, search.join_down(label))
    return search.alternate(label, rounds=10)


def _split_and_join(search: PartSearch, label: np.ndarray) -> np.ndarray:
    """Cut parts and merge again, as long as that gives more parts, or as many that fit better."""
    tried: set[bytes] = set()
    for _ in range(2 * START):
        cuts = [search.split(label, part) for part in range(label.max() + 1)]
        worth = [c for c in cuts if c[1] >= search.config.separation and c[0].tobytes() not in tried]
        if not worth:
            break
        cut = max(worth, key=lambda c: c[1])[0]
        tried.add(cut.tobytes())
        again = search.join_down(cut)
        # as many parts must fit better by half a per cent
        more = again.max() - label.max()
        if more > 0 or (more == 0 and search.motions(again).cost.sum() < 0.995 * search.motions(label).cost.sum()):
            label = again
    return label
