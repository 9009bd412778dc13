"""Re-initialisation of misplaced limbs from random poses, where that explains the scan better."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from scanprep.skeleton.tree import Skeleton

from ..priors import GaussianPrior
from .bodies import FixedBody
from .free_space import INSIDE, PRESSED, Outside
from .named_points import distinct_bodies
from .scan import spread_points
from .scan_fit import CONTACT, EVIDENCE, ScanFit
from .starts import approach, best_starts, from_nothing, sample_vertices
from .upright import AXES, Upright, standing_axis

REACHES = (0.2, 0.15, 0.1)           # metres: largest match distance in the rounds after a limb was moved
SKIN, SCAN = 80, 120                 # vertices of a limb and points of the scan by which a random pose is judged
CAP = 0.1                            # metres: largest violation that counts; more is as bad
CAPS, NOISES = (0.4, 0.25, 0.15, 0.1), (0.4, 0.25, 0.15, 0.1)   # metres and radians: caps and noise of finer rounds
EXPLAINED = 0.04                     # metres: scan points this near to the rest of the body need no limb
FOLLOWED, APART = 4, 0.1             # random poses that are refined, and metres by which they differ at the limb's end
# Share of a scan without a body near from which on the whole body may be wrong. A person on a turntable lost 0.47, two
# in wide skirts 0.33 and 0.36; children, of whom the model knows none, and dressed people who are right at most 0.07.
ASTRAY = 0.15
NEARLY = 1.1                         # a body with a misfit up to this times the smallest explains nearly as well
AMISS = 30.0                         # energy from which on a limb counts as misplaced
BETTER, SHARE = 5.0, 0.01            # the misfit must fall by this, and by this share of it, for a limb to be moved
ROUNDS = 2                           # how often every limb may be tried


def with_limbs(fit: ScanFit, coarse: ScanFit, starts: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Find the best of starts (n, P), best first, after misplaced limbs were re-initialised: unknowns (P,).

    Starts after the first are tried only while limbs are badly misplaced. In a body that faces the wrong way, limbs
    explain nothing wherever they are moved. Without landmarks the second start is always tried on a depth picture,
    where front and back in clothes look alike. Also returns another body (P,) that explains the scan nearly as well, or
    None.
    """
    ends = [reinitialise_limbs(coarse, starts[0])]
    for x in starts[1:]:
        both = len(ends) == 1 and fit.cloud.person is not None and not len(fit.vertices)
        # an energy of 100, three times that of a misplaced limb: the whole body may be wrong
        if not both and not find_misplaced_limbs(coarse, min(ends, key=coarse.misfit), 100.0):
            break
        ends.append(reinitialise_limbs(coarse, x))
    if len(ends) == 1:
        return ends[0], None
    misfits = np.array([fit.misfit(x) for x in ends])
    first, *others = np.argsort(misfits)
    rival = next((ends[i] for i in others if misfits[i] < NEARLY * misfits[first]), None)
    return ends[first], rival


def with_standing(fit: ScanFit, coarse: ScanFit, x: np.ndarray, rival: np.ndarray | None
                  ) -> tuple[np.ndarray, np.ndarray | None]:
    """Try bodies that stand along an axis of the scan where x (P,) leaves much of it unexplained.

    A search in all orientations takes coarse steps, and a turntable or a wide skirt draws it away. Returns the best
    body and its rival, as `with_limbs`.
    """
    axis = standing_axis(fit.body.template, fit.body.skeleton)
    if axis is None or fit.upright is not None or len(fit.vertices) or \
            coarse.find_unexplained(x, coarse.thin).mean() < ASTRAY:
        return x, rival
    upright = Upright(AXES, axis)
    standing = replace(coarse, upright=upright)
    y, other = with_limbs(replace(fit, upright=upright), standing, best_starts(standing, from_nothing(standing)))
    best, *others = sorted((one for one in (x, y, rival, other) if one is not None), key=fit.misfit)
    # a rival explains nearly as much and is elsewhere
    rivals = (one for one in others if fit.misfit(one) < NEARLY * fit.misfit(best)
              and len(distinct_bodies(sample_vertices(coarse, np.array([best, one])), 2, APART)) == 2)
    return best, next(rivals, None)


def reinitialise_limbs(fit: ScanFit, x: np.ndarray) -> np.ndarray:
    """Re-initialise misplaced limbs where that explains the scan better; return unknowns (P,). The shape is held.

    The worst limb comes first. After a limb was moved the others are judged again, since it may now explain points that
    they could have explained.
    """
    if not find_misplaced_limbs(fit, x):
        return x
    free, held = fit.body.n_angles + 3, fit.fix_shape(x)
    moved = approach(held, x[:free], REACHES)
    tried: list[list[int]] = []                      # limbs that were tried without success on the present body
    for _ in range(ROUNDS * len(limb_runs(fit.body.skeleton))):
        limb = next((limb for limb in find_misplaced_limbs(held, moved) if limb not in tried), None)
        if limb is None:
            break
        before, moved = moved, _reinitialise(held, moved, limb)
        tried = [limb] if moved is not before else [*tried, limb]
    return np.concatenate([moved, x[free:]])


def find_misplaced_limbs(fit: ScanFit, x: np.ndarray, least: float = AMISS) -> list[list[int]]:
    """List misplaced limbs, worst first; a limb is a list of parts.

    Misplaced limbs violate space, or could explain scan points that nothing explains.
    """
    wrong = np.zeros(len(fit.ids))
    for weight, ids, found in fit.free_space_violations(fit.skin(x)):
        wrong[ids] += weight * np.minimum(found.excess, CAP)**2 / len(ids)
    lost, strange = fit.thin.points[fit.find_unexplained(x, fit.thin)], fit.strange(x)
    misplacements = {tuple(limb): misplacement(fit, x, limb, wrong, lost) + float(strange[limb].sum())
                     for limb in limb_runs(fit.body.skeleton)}
    return [list(limb) for limb in sorted(misplacements, key=lambda limb: -misplacements[limb])
            if misplacements[limb] > least]


def misplacement(fit: ScanFit, x: np.ndarray, limb: list[int], wrong: np.ndarray, lost: np.ndarray) -> float:
    """Compute the energy of a limb's violations and of unexplained scan points within its reach.

    `wrong` (n,) are violations of each vertex; `lost` (m, 3), metres, scan points with nothing near.
    """
    template, skeleton, own = fit.body.template, fit.body.skeleton, np.isin(fit.part, limb)
    joint = skeleton.joints[limb[0]]                  # how far the limb reaches is measured on the template
    reach = np.linalg.norm(template.vertices[fit.ids[own]] - joint, axis=1).max() + CAP
    ring = np.searchsorted(fit.ids, skeleton.ring(template, limb[0]))
    near = np.linalg.norm(lost - fit.skin(x).places[ring].mean(axis=0), axis=1) < reach
    share = EXPLAINED**2 * near.sum() / len(fit.thin.points)
    return float(EVIDENCE / fit.config.scan_sd**2 * (wrong[own].sum() + share))


def _reinitialise(fit: ScanFit, x: np.ndarray, limb: list[int]) -> np.ndarray:
    """Try a limb in random poses; return unknowns (P,) with the best after a few rounds, or the limb as it was."""
    best, search = fit.misfit(x), LimbSearch.around(fit, x, limb)
    # 12 times `random_starts` poses are drawn, since judging one takes little time
    drawn = search.best(draws(fit, x, limb, 12 * fit.config.random_starts))
    begun = sorted((approach(fit, one, REACHES[:1]) for one in drawn), key=fit.misfit)
    # the better two go on after the first round
    for one in begun[:2]:
        tried = approach(fit, one, REACHES[1:])
        if (misfit := fit.misfit(tried)) < best - max(BETTER, SHARE * best):
            x, best = tried, misfit
    return x


def draws(fit: ScanFit, x: np.ndarray, limb: list[int], count: int) -> np.ndarray:
    """Draw poses (about count, P) of a limb, from the prior and from known poses.

    Half of them change the whole limb, others only the part beyond a later joint.
    """
    roots, out = [j for j in limb for _ in range(3 if j == limb[0] else 1)], []
    for root in roots:
        each = count // (2 * len(roots)) + 1
        out += [examples_of(fit.body, x, root, each, fit.rng), redrawn(fit.body, x, root, fit.prior, each, fit.rng)]
    return np.concatenate(out)


@dataclass(frozen=True, eq=False)
class LimbSearch:
    """The search for the pose of one limb; the rest of the body is held and explains part of the scan."""

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
        """Prepare the search for a limb of unknowns (P,)."""
        skin, own = fit.skin(x), np.isin(fit.part, limb)
        ids = np.flatnonzero(own)
        ids = ids[spread_points(fit.body.template.vertices[fit.ids[ids]], SKIN)]
        away = cKDTree(skin.places[~own]).query(fit.coarse.points)[0] > EXPLAINED
        return LimbSearch(fit, limb, ids, np.flatnonzero(fit.part[ids] == limb[-1]), fit.part[ids] != limb[0],
                          fit.coarse.some(away).thin(SCAN).points, float(away.mean()),
                          InsideBody.of(skin.places[~own], skin.normals[~own]), fit.data.outside)

    def best(self, drawn: np.ndarray) -> np.ndarray:
        """Find the best distinct poses among unknowns (n, P), refined by random poses closer and closer to them."""
        angles = (3 * np.array(self.limb)[:, None] + np.arange(3)).ravel()
        for cap, noise in zip(CAPS, NOISES, strict=True):
            places, cost = self.evaluate(drawn, cap)
            order = np.argsort(cost)
            # the 24 best distinct poses stay; the next random poses are drawn around them
            kept = drawn[order[distinct_bodies(places[order][:, self.end], 24, noise / 4)]]
            near = np.repeat(kept, len(drawn) // len(kept), axis=0)
            near[:, angles] += self.fit.rng.normal(0, noise, (len(near), len(angles)))
            drawn = np.vstack([kept, near])
        places, cost = self.evaluate(drawn, CAPS[-1])
        order = np.argsort(cost)
        return drawn[order[distinct_bodies(places[order][:, self.end], FOLLOWED, APART)]]

    def evaluate(self, drawn: np.ndarray, cap: float) -> tuple[np.ndarray, np.ndarray]:
        """Compute the limb's vertices (n, L, 3), metres, for unknowns (n, P), and energies (n,) up to a constant.

        Distances above `cap`, metres, count as `cap`.
        """
        fit, config = self.fit, self.fit.config
        pose, trans, _ = fit.body.split(drawn)
        places = fit.body.subject.points(self.ids).evaluate(pose, trans)
        share = np.isin(fit.part[fit.sample.spread], fit.part[self.ids]).mean()
        # inside the rest of the body, in free space, off the scan points that it should explain; and the prior
        depth = self.rest.depth(places) * self.loose
        cost = CONTACT * share * (np.minimum(depth, cap)**2).mean(axis=1)
        if self.free is not None:
            cost += config.free_space_weight * share * (np.minimum(self.free.at(places), cap)**2).mean(axis=1)
        if len(self.wanted):
            cost += self.lacking * np.minimum(nearest_squared(places, self.wanted), cap**2).mean(axis=1)
        unlikely = sum(term.energy for term in fit.prior_terms(drawn).values())
        return places, EVIDENCE / config.scan_sd**2 * cost + unlikely


def nearest_squared(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Compute squared distances (n, m) of points (m, 3) to the nearest of L vertices in n poses (n, L, 3).

    In single precision: accurate to a millimetre.
    """
    middle = points.mean(axis=0)
    to, out = (points - middle).astype(np.float32).T, np.empty((len(places), len(points)), dtype=np.float32)
    for i, one in enumerate((places - middle).astype(np.float32)):
        # |a - b|² = |b|² + (|a|² - 2 a·b)
        out[i] = ((one**2).sum(axis=1)[:, None] - 2 * one @ to).min(axis=0)
    return np.maximum(out + (to**2).sum(axis=0), 0)


@dataclass(frozen=True, eq=False)
class InsideBody:
    """A table of how deep points are inside part of a body."""

    CELL = 0.03                          # metres: cell of the table of the inside of a body

    low: np.ndarray                  # (3,), metres
    deep: np.ndarray                 # (a, b, c), metres

    @staticmethod
    def of(vertices: np.ndarray, normals: np.ndarray) -> InsideBody:
        """Build the table for vertices (n, 3), metres, with their normals (n, 3)."""
        low = vertices.min(axis=0)
        axes = [np.arange(a, b + InsideBody.CELL, InsideBody.CELL) for a,
                b in zip(low, vertices.max(axis=0), strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        far, hit = cKDTree(vertices).query(grid.reshape(-1, 3), distance_upper_bound=INSIDE)
        near = np.isfinite(far)
        deep = np.zeros(len(far))
        deep[near] = np.einsum("nd,nd->n", normals[hit[near]], vertices[hit[near]] - grid.reshape(-1, 3)[near])
        return InsideBody(low, np.maximum(deep - PRESSED, 0).reshape(grid.shape[:3]))

    def depth(self, places: np.ndarray) -> np.ndarray:
        """Look up the depth (...), metres, of points (..., 3)."""
        cell = np.rint((places - self.low) / self.CELL).astype(np.int64)
        within = ((cell >= 0) & (cell < self.deep.shape)).all(axis=-1)
        cell = np.where(within[..., None], cell, 0)
        return np.where(within, self.deep[cell[..., 0], cell[..., 1], cell[..., 2]], 0.0)


def runs_without_branch(parents: np.ndarray) -> list[list[int]]:
    """Split a tree of parts into its longest runs without a branch; the root is in none."""
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
    """List the limbs: runs of parts without a branch that end in a leaf, the longest first."""
    parents = skeleton.parents
    return sorted((run for run in runs_without_branch(parents) if run[-1] not in parents), key=len, reverse=True)


def examples_of(body: FixedBody, x: np.ndarray, root: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw poses (count or 0, P) of the limb at a joint from known poses, with some noise."""
    known = body.known_poses.reshape(-1, body.n_angles)
    drawn = np.repeat(x[None], count if len(known) else 0, axis=0)
    if len(drawn):
        parts = np.flatnonzero(body.skeleton.descends[:, root])
        angles = (3 * parts[:, None] + np.arange(3)).ravel()
        drawn[:, angles] = known[np.arange(count) * max(1, len(known) // count) % len(known)][:, angles]
        # noise of 0.1 rad: known poses are few
        drawn[:, angles] += rng.normal(0, 0.1, (count, len(angles)))
    return drawn


def redrawn(body: FixedBody, x: np.ndarray, root: int, prior: GaussianPrior, count: int,
            rng: np.random.Generator) -> np.ndarray:
    """Draw poses (count, P) of the limb at a joint from the prior, given the other joints of x (P,)."""
    parts = np.flatnonzero(body.skeleton.descends[:, root])
    angles = (3 * parts[:, None] + np.arange(3)).ravel()
    # conditional Gaussian: precision Λ_aa, mean μ_a - Λ_aa⁻¹ Λ_ab (x_b - μ_b)
    precision = prior.whitening.T @ prior.whitening
    others = np.setdiff1d(np.arange(body.n_angles), angles)
    block = precision[np.ix_(angles, angles)]
    pull = precision[np.ix_(angles, others)] @ (x[others] - prior.mean[others])
    drawn = np.repeat(x[None], count, axis=0)
    spreads = np.linalg.solve(np.linalg.cholesky(block).T, rng.normal(size=(len(angles), count))).T
    drawn[:, angles] = prior.mean[angles] - np.linalg.solve(block, pull) + spreads
    return drawn
