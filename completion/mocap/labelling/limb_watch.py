"""Notice limbs that fit their points worse than usual, and search them again."""
from __future__ import annotations

import numpy as np

from .body_search import ALONE, LIMB_ROUNDS, BodySearch, Placement
from .follow_points import OWN_PERSON
from .live_matching import find_unmatched

WINDOW, LONG = 0.1, 2.0              # seconds: time constants of the strain, and of the usual strain
PATIENCE, LONGEST = 0.25, 4.0        # seconds from a search without success to the next, doubled up to LONGEST


class LimbWatch:
    """Watches the limbs of a body that is followed through points.

    Parameters
    ----------
    search : BodySearch
    """

    # strain above the usual, in markers, at which a limb is searched: a reversed foot had 1.3 to 1.9, a right one less
    WORSE = 0.8
    POSES = 8                            # poses tried for a limb, half of them only below its second joint

    def __init__(self, search: BodySearch) -> None:
        self.search = search
        self.rows = [rows_of_limb(search, limb) for limb in search.limbs]
        # poses are tried in turn, in random order
        self.order, self.tries = search.poses[np.random.default_rng(0).permutation(len(search.poses))], 0
        # 0.5 markers: usual strain at the start
        self.usual = np.full(len(self.rows), 0.5)
        self.patience = np.full(len(self.rows), PATIENCE)
        self.begin()

    def begin(self) -> None:
        """Start with a body that was just found."""
        # of each marker, 0 to 1: cost of the last frame, and its running mean
        self.cost, self.strain = np.zeros(self.search.body.count), np.zeros(self.search.body.count)
        self.quiet = np.zeros(len(self.rows))

    @property
    def mean_strain(self) -> float:
        """Mean strain of all markers, 0 to 1."""
        return float(self.strain.mean())

    def update(self, points: np.ndarray, chosen: np.ndarray, places: np.ndarray, dt: float) -> None:
        """Update strains: points (N, 3), the one of each marker (L,), and simulated markers (L, 3)."""
        there = chosen >= 0
        cost = np.zeros(len(chosen))
        squared = ((points[chosen[there]] - places[there])**2).sum(axis=1)
        cost[there] = squared / (squared + OWN_PERSON.judged**2)
        # a marker without a point counts as a fault only where a free point is near, within 20 cm
        free = find_unmatched(len(points), chosen)
        if len(free) and not there.all():
            apart = ((points[free] - places[~there][:, None])**2).sum(axis=-1).min(axis=1)
            cost[~there] = np.where(apart < 0.2**2, ALONE, 0.0)
        self.cost = cost
        self.strain += (cost - self.strain) * min(1.0, dt / WINDOW)
        strain = self._of_limbs(self.strain)
        # 0.5: most by which one frame may exceed the usual strain when that is updated
        self.usual += (np.minimum(strain, self.usual + 0.5) - self.usual) * min(1.0, dt / LONG)
        self.quiet -= dt

    def doubtful(self) -> np.ndarray:
        """Return a mask (L,) of markers on limbs that fit worse than usual."""
        doubted = np.zeros(len(self.strain), dtype=bool)
        for rows, worse in zip(self.rows, self._of_limbs(self.strain) - self.usual, strict=True):
            doubted[rows] = worse > self.WORSE
        return doubted

    def seek(self, x: np.ndarray, points: np.ndarray) -> tuple[Placement, np.ndarray, list[int]] | None:
        """Search the worst limb in other poses; return a better body, and the limb's markers and joints, or None.

        At most one limb is searched in a frame, which takes about 30 ms.
        """
        # only in a frame that shows the fault, as markers may be hidden in others
        strain, shown = self._of_limbs(self.strain), self._of_limbs(self.cost)
        worse = np.where((self.quiet > 0) | (shown < strain), -np.inf, strain - self.usual)
        limb = int(worse.argmax())
        if worse[limb] < self.WORSE:
            return None
        now = self.search.judge(x, points, OWN_PERSON.judged)
        found = self.search.refine(self._starts(x, limb), points, LIMB_ROUNDS, OWN_PERSON.judged)
        # 0.6: least gain in misfit, in markers; a reversed foot gained 2.5 to 4
        if (now.misfit - found.misfit) * self.search.body.count > 0.6:
            self.strain[self.rows[limb]] = 0.0
            self.quiet[limb] = self.patience[limb] = PATIENCE
            return found, self.rows[limb], self.search.limbs[limb]
        self.quiet[limb], self.patience[limb] = self.patience[limb], min(2 * self.patience[limb], LONGEST)
        return None

    def _starts(self, x: np.ndarray, limb: int) -> np.ndarray:
        """Return unknowns (n, P) with other poses of a limb, half of them only at its end."""
        poses = np.roll(self.order, -self.POSES * self.tries, axis=0)[:self.POSES]
        self.tries += 1
        starts = np.repeat(x[None], len(poses), axis=0)
        for depth, joint in enumerate(self.search.limbs[limb]):
            chosen = slice(0, None, 1 if depth > 1 else 2)
            starts[chosen, 3 * joint:3 * joint + 3] = poses[chosen, joint]
        return starts

    def _of_limbs(self, values: np.ndarray) -> np.ndarray:
        """Sum values (L,) of markers over each limb."""
        return np.array([values[rows].sum() for rows in self.rows])


def rows_of_limb(search: BodySearch, limb: list[int]) -> np.ndarray:
    """Return the markers (n,) that the first joint of a limb moves."""
    body = search.body
    x = np.zeros((2, body.n_unknowns))
    x[1, 3 * limb[0]:3 * limb[0] + 3] = 0.3                             # radians, which move markers by centimetres
    still, bent = body.positions(x)
    return np.flatnonzero(np.linalg.norm(bent - still, axis=1) > 0.01)
