"""Limbs in the wrong place begin again from draws, where that explains the scan better."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from scanprep.skeleton.tree import Skeleton

from ..priors import GaussianPrior
from .bodies import FixedBody
from .free_space import INSIDE, PRESSED, Outside
from .named_points import distinct_bodies
from .scan import spread_points
from .scan_fit import EVIDENCE, ScanFit
from .starts import approach

REACHES = (0.2, 0.15, 0.1)           # metres, of the rounds after a limb was moved
SKIN, SCAN = 80, 120                 # vertices of a limb and points of the scan that a draw is judged by
CAP = 0.1                            # metres: further off is as bad
CAPS, NOISES = (0.4, 0.25, 0.15, 0.1), (0.4, 0.25, 0.15, 0.1)   # metres, and radians, of draws around the best
CELL = 0.03                          # metres: of the table of the inside of a body
EXPLAINED = 0.04                     # metres of the body within which a point of the scan needs no limb
FOLLOWED, APART = 4, 0.1             # draws that are followed, and by how many metres they differ at the limb's end
AMISS = 30.0                         # energy of what is wrong with a limb from which on it is sought
BETTER, SHARE = 5.0, 0.01            # by how much, and what share of it, the misfit must fall for a limb to be moved
ROUNDS = 2                           # times that all limbs that are amiss are gone through


def with_limbs(fit: ScanFit, few: ScanFit, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Unknowns (P,) of the best of starts (n, P), best first, when limbs were moved to where they explain the scan.

    Those after the first have their turn while something grave is amiss: a body that faces the wrong way keeps limbs
    that explain nothing wherever they are moved. In clothes front and back are so much alike that without landmarks
    the second is always tried. Returns also another body (P,) that explains the scan nearly as well; None without one.
    """
    ends = [reinitialise_limbs(few, starts[0])]
    for x in starts[1:]:
        both = len(ends) == 1 and fit.cloud.person is not None and not len(fit.vertices)
        # energy from which on the whole body may be wrong
        if not both and not misplaced_limbs(few, min(ends, key=few.misfit), 100.0):
            break
        ends.append(reinitialise_limbs(few, x))
    if len(ends) == 1:
        return ends[0], None
    misfits = np.array([fit.misfit(x) for x in ends])
    first, *others = np.argsort(misfits)
    # times the least misfit that of another body may have to be nearly as good
    rival = next((ends[i] for i in others if misfits[i] < 1.1 * misfits[first]), None)
    return ends[first], rival


def reinitialise_limbs(fit: ScanFit, x: np.ndarray) -> np.ndarray:
    """Unknowns (P,) with limbs moved elsewhere where that explains the scan better; the shape is held.

    The worst has its turn first. Once one was moved the others are looked at anew: what they could have explained may
    be explained, and what stood in their way gone.
    """
    if not misplaced_limbs(fit, x):
        return x
    free, held = fit.body.n_angles + 3, fit.fix_shape(x)
    moved = approach(held, x[:free], REACHES)
    tried: list[list[int]] = []                      # as the body is now
    for _ in range(ROUNDS * len(limb_runs(fit.body.skeleton))):
        limb = next((limb for limb in misplaced_limbs(held, moved) if limb not in tried), None)
        if limb is None:
            break
        before, moved = moved, _reinitialise(held, moved, limb)
        tried = [limb] if moved is not before else [*tried, limb]
    return np.concatenate([moved, x[free:]])


def misplaced_limbs(fit: ScanFit, x: np.ndarray, least: float = AMISS) -> list[list[int]]:
    """The limbs, runs of parts, that stand where nothing can be or could explain what nothing does; worst first."""
    wrong = np.zeros(len(fit.ids))
    for weight, ids, found in fit.objections(fit.skin(x)):
        wrong[ids] += weight * np.minimum(found.excess, CAP)**2 / len(ids)
    lost, strange = fit.thin.points[fit.find_unexplained(x, fit.thin)], fit.strange(x)
    found_amiss = {tuple(limb): misplacement(fit, x, limb, wrong, lost) + float(strange[limb].sum())
                   for limb in limb_runs(fit.body.skeleton)}
    return [list(limb) for limb in sorted(found_amiss, key=lambda limb: -found_amiss[limb])
            if found_amiss[limb] > least]


def misplacement(fit: ScanFit, x: np.ndarray, limb: list[int], wrong: np.ndarray, lost: np.ndarray) -> float:
    """Energy of what is wrong with a limb, and of what it could explain.

    `wrong` (n,), of each vertex; `lost` (m, 3), metres, points of the scan with nothing near.
    """
    template, skeleton, mine = fit.body.template, fit.body.skeleton, np.isin(fit.part, limb)
    joint = skeleton.joints[limb[0]]                  # of the template, to know how far the limb reaches
    reach = np.linalg.norm(template.vertices[fit.ids[mine]] - joint, axis=1).max() + CAP
    ring = np.searchsorted(fit.ids, skeleton.ring(template, limb[0]))
    near = np.linalg.norm(lost - fit.skin(x).places[ring].mean(axis=0), axis=1) < reach
    share = EXPLAINED**2 * near.sum() / len(fit.thin.points)
    return float(EVIDENCE / fit.config.scan_sd**2 * (wrong[mine].sum() + share))


def _reinitialise(fit: ScanFit, x: np.ndarray, limb: list[int]) -> np.ndarray:
    """Unknowns (P,) with a limb as it is, or as the draw that explains most after a few rounds."""
    best, search = fit.misfit(x), LimbSearch.around(fit, x, limb)
    # times as many poses of a limb are drawn as `random_starts` says
    drawn = search.best(draws(fit, x, limb, 12 * fit.config.random_starts))
    begun = sorted((approach(fit, one, REACHES[:1]) for one in drawn), key=fit.misfit)
    # of them, those that go on after the first round
    for one in begun[:2]:
        tried = approach(fit, one, REACHES[1:])
        if (misfit := fit.misfit(tried)) < best - max(BETTER, SHARE * best):
            x, best = tried, misfit
    return x


def draws(fit: ScanFit, x: np.ndarray, limb: list[int], count: int) -> np.ndarray:
    """Poses (count, P) of a limb, from its first joint or a later one on: of the prior, and of known poses."""
    roots, out = [j for j in limb for _ in range(3 if j == limb[0] else 1)], []
    for root in roots:
        some = count // (2 * len(roots)) + 1
        out += [examples_of(fit.body, x, root, some, fit.rng), redrawn(fit.body, x, root, fit.prior, some, fit.rng)]
    return np.concatenate(out)


@dataclass(frozen=True, eq=False)
class LimbSearch:
    """One limb of a body of which all else stays, judged by a few of its vertices and what the rest leaves open."""

    fit: ScanFit
    limb: list[int]                  # its parts, from the body outwards
    ids: np.ndarray                  # (L,) vertices of the limb
    end: np.ndarray                  # which of them are of its last part
    loose: np.ndarray                # (L,) bool: not of the part that hangs on the rest of the body
    wanted: np.ndarray               # (m, 3) points of the scan that the rest of the body does not explain, metres
    lacking: float                   # their share of the scan
    rest: InsideBody
    free: Outside | None             # where the cameras saw that nothing is

    @staticmethod
    def around(fit: ScanFit, x: np.ndarray, limb: list[int]) -> LimbSearch:
        """The search for a limb of unknowns (P,)."""
        skin, mine = fit.skin(x), np.isin(fit.part, limb)
        ids = np.flatnonzero(mine)
        ids = ids[spread_points(fit.body.template.vertices[fit.ids[ids]], SKIN)]
        away = cKDTree(skin.places[~mine]).query(fit.coarse.points)[0] > EXPLAINED
        return LimbSearch(fit, limb, ids, np.flatnonzero(fit.part[ids] == limb[-1]), fit.part[ids] != limb[0],
                          fit.coarse.some(away).thin(SCAN).points, float(away.mean()),
                          InsideBody.of(skin.places[~mine], skin.normals[~mine]), fit.data.outside)

    def best(self, drawn: np.ndarray) -> np.ndarray:
        """Those few of unknowns (n, P) that explain most and differ, each after draws closer and closer around it."""
        angles = (3 * np.array(self.limb)[:, None] + np.arange(3)).ravel()
        for cap, noise in zip(CAPS, NOISES, strict=True):
            places, cost = self.evaluate(drawn, cap)
            order = np.argsort(cost)
            # draws around which the next are made
            kept = drawn[order[distinct_bodies(places[order][:, self.end], 24, noise / 4)]]
            near = np.repeat(kept, len(drawn) // len(kept), axis=0)
            near[:, angles] += self.fit.rng.normal(0, noise, (len(near), len(angles)))
            drawn = np.vstack([kept, near])
        places, cost = self.evaluate(drawn, CAPS[-1])
        order = np.argsort(cost)
        return drawn[order[distinct_bodies(places[order][:, self.end], FOLLOWED, APART)]]

    def evaluate(self, drawn: np.ndarray, cap: float) -> tuple[np.ndarray, np.ndarray]:
        """Places (n, L, 3), metres, of the limb's vertices for unknowns (n, P), and energies (n,) up to a constant.

        What is off by more than `cap`, metres, is as bad.
        """
        fit, config = self.fit, self.fit.config
        pose, trans, _ = fit.body.split(drawn)
        places = fit.body.subject.points(self.ids).evaluate(pose, trans)
        share = np.isin(fit.part[fit.sample.spread], fit.part[self.ids]).mean()
        depth = self.rest.depth(places) * self.loose
        cost = config.contact_weight * share * (np.minimum(depth, cap)**2).mean(axis=1)
        if self.free is not None:
            cost += config.free_space_weight * share * (np.minimum(self.free.at(places), cap)**2).mean(axis=1)
        if len(self.wanted):
            cost += self.lacking * np.minimum(nearest_squared(places, self.wanted), cap**2).mean(axis=1)
        unlikely = sum(term.energy for term in fit.prior_terms(drawn).values())
        return places, EVIDENCE / config.scan_sd**2 * cost + unlikely


def nearest_squared(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, m) square metres from points (m, 3) to the nearest of the places (L, 3) of each of n, within a millimetre."""
    middle = points.mean(axis=0)
    to, out = (points - middle).astype(np.float32).T, np.empty((len(places), len(points)), dtype=np.float32)
    for i, one in enumerate((places - middle).astype(np.float32)):
        # |a - b|² = |b|² + (|a|² - 2 a·b)
        out[i] = ((one**2).sum(axis=1)[:, None] - 2 * one @ to).min(axis=0)
    return np.maximum(out + (to**2).sum(axis=0), 0)


@dataclass(frozen=True, eq=False)
class InsideBody:
    """A table of how deep places are inside some of a body."""

    low: np.ndarray                  # (3,), metres
    deep: np.ndarray                 # (a, b, c), metres

    @staticmethod
    def of(vertices: np.ndarray, normals: np.ndarray) -> InsideBody:
        """The table for vertices (n, 3), metres, with their normals (n, 3)."""
        low = vertices.min(axis=0)
        axes = [np.arange(a, b + CELL, CELL) for a, b in zip(low, vertices.max(axis=0), strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        far, hit = cKDTree(vertices).query(grid.reshape(-1, 3), distance_upper_bound=INSIDE)
        near = np.isfinite(far)
        deep = np.zeros(len(far))
        deep[near] = np.einsum("nd,nd->n", normals[hit[near]], vertices[hit[near]] - grid.reshape(-1, 3)[near])
        return InsideBody(low, np.maximum(deep - PRESSED, 0).reshape(grid.shape[:3]))

    def depth(self, places: np.ndarray) -> np.ndarray:
        """(...) metres, of places (..., 3)."""
        cell = np.rint((places - self.low) / CELL).astype(np.int64)
        within = ((cell >= 0) & (cell < self.deep.shape)).all(axis=-1)
        cell = np.where(within[..., None], cell, 0)
        return np.where(within, self.deep[cell[..., 0], cell[..., 1], cell[..., 2]], 0.0)


def runs_without_branch(parents: np.ndarray) -> list[list[int]]:
    """The limbs of a tree of parts: longest runs without a branch, the root in none."""
    children = [np.flatnonzero(np.asarray(parents) == j) for j in range(len(parents))]
    runs = []
    for j in range(1, len(parents)):
        if parents[j] != 0 and len(children[parents[j]]) == 1:
            continue
        run = [j]
        while len(children[run[-1]]) == 1:
            run.append(int(children[run[-1]][0]))
        runs.append(run)
    return runs


def limb_runs(skeleton: Skeleton) -> list[list[int]]:
    """Runs of parts without a branch that end in a part from which nothing hangs, the largest first."""
    parents = skeleton.parents
    return sorted((run for run in runs_without_branch(parents) if run[-1] not in parents), key=len, reverse=True)


def examples_of(body: FixedBody, x: np.ndarray, root: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws (count or none, P) of the limb at a joint: as it is in known poses, loosened a little."""
    known = body.known_poses.reshape(-1, body.n_angles)
    drawn = np.repeat(x[None], count if len(known) else 0, axis=0)
    if len(drawn):
        parts = np.flatnonzero(body.skeleton.descends[:, root])
        angles = (3 * parts[:, None] + np.arange(3)).ravel()
        drawn[:, angles] = known[np.arange(count) * max(1, len(known) // count) % len(known)][:, angles]
        # radians around the limb of a known pose
        drawn[:, angles] += rng.normal(0, 0.1, (count, len(angles)))
    return drawn


def redrawn(body: FixedBody, x: np.ndarray, root: int, prior: GaussianPrior, count: int,
            rng: np.random.Generator) -> np.ndarray:
    """Draws (count, P) of the limb at a joint from the prior, given the other joints of x (P,)."""
    parts = np.flatnonzero(body.skeleton.descends[:, root])
    angles = (3 * parts[:, None] + np.arange(3)).ravel()
    precision = prior.whitening.T @ prior.whitening
    others = np.setdiff1d(np.arange(body.n_angles), angles)
    block = precision[np.ix_(angles, angles)]
    pull = precision[np.ix_(angles, others)] @ (x[others] - prior.mean[others])
    drawn = np.repeat(x[None], count, axis=0)
    spreads = np.linalg.solve(np.linalg.cholesky(block).T, rng.normal(size=(len(angles), count))).T
    drawn[:, angles] = prior.mean[angles] - np.linalg.solve(block, pull) + spreads
    return drawn
