"""A search for correspondences under way: two surfaces seen from the seeds, and what is believed so far."""
from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree

from ..geometry.farthest_points import farthest_points
from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh
from ..ranges import Cell, Count, Positive, Settings, Share
from .belief_propagation import Beliefs, PairField, propagate
from .correspondences import Correspondences
from .places import Places, turns_between
from .potentials import PotentialConfig, edge_energy, most_edge_energy, most_place_energy, place_energy
from .sheet import Sheet


@dataclass(frozen=True)
class BeliefLevel(Settings):
    """One level from coarse to fine.

    Attributes
    ----------
    places : int
        Places of the template: up to 2000 are spread over it, more than that had better be all.
    domain : int
        Of them, how many a point of the scan may choose from.
    """

    places: Count
    domain: Count


@dataclass(frozen=True)
class CorrelatedConfig(Settings):
    """Settings of `find_correspondences`. Lengths are multiples of the template's size, √area.

    Attributes
    ----------
    points : int
        Points of the scan that look for an image.
    keep : int
        Most correspondences in the result: the most certain ones.
    spacing : float
        Distance that the scan is thinned to.
    links : int
        Edges that each point has to its nearest neighbours along the surface.
    frame : float
        Radius over which directions on the surface are averaged.
    bridged : float
        How much a way to a seed is trusted that bridges a gap of the scan or ends in one.
    levels : from coarse to fine
    potentials : PotentialConfig
    iterations : int
        Most rounds of messages at each level.
    damping : float
        Share of the old message that is kept.
    spread : float
        Beliefs of one level spread so far over the places of the next.
    certain : float
        Confidence is the belief that the image is within this distance of the one chosen.
    strained : float
        Mean energy of the edges around a point at which its confidence falls by e.
    neighbours : int
        Points of the scan over which its normals are averaged.
    """

    points: Count = 240
    keep: Count = 170
    spacing: Cell = 0.009
    links: Count = 6
    frame: Positive = 0.042
    bridged: Share = 0.3
    levels: tuple[BeliefLevel, ...] = (BeliefLevel(2000, 80), BeliefLevel(2000, 60), BeliefLevel(1_000_000, 60))
    potentials: PotentialConfig = field(default_factory=PotentialConfig)
    iterations: Count = 40
    damping: Share = 0.3
    spread: Positive = 0.012
    certain: Positive = 0.03
    strained: Positive = 4.0
    neighbours: Count = 16


class Search:
    """Belief propagation from given seeds, level by level.

    Parameters
    ----------
    template : Mesh
    sheet : Sheet
        The scan.
    surface : SurfaceGraph
        Of the template.
    seeds : (S,) int and (S, 3) float, metres
    config : CorrelatedConfig
    """

    def __init__(self, template: Mesh, sheet: Sheet, surface: SurfaceGraph,
                 seeds: tuple[np.ndarray, np.ndarray], config: CorrelatedConfig) -> None:
        self.template, self.config = template, config
        self.size = float(np.sqrt(template.face_areas.sum()))
        clicked = sheet.at(seeds[1])
        on_scan = sheet.distances(clicked)
        on_template = surface.distances(seeds[0])
        self.scale = scale_between(on_template[:, seeds[0]], on_scan[:, clicked])
        self.chosen = farthest_points(sheet.points, min(config.points, len(sheet.points)))
        self.edges = neighbour_edges(sheet, self.chosen, config.links, 0.3 * self.size)
        off = np.linalg.norm(sheet.points[clicked] - seeds[1], axis=1)         # a click where there are no data
        same = (sheet.piece[self.chosen][:, None] == sheet.piece[clicked]) & (off < 3 * sheet.spacing)
        self.scan = seen_from(sheet.points, sheet.normals, on_scan, self.chosen, config.frame * self.size,
                              np.where(same, 1.0, config.bridged))
        most = min(max(level.places for level in config.levels), len(template.vertices))
        self.vertices = spread_vertices(template, most)
        self.places = seen_from(self.scale * template.vertices, template.vertex_normals, self.scale * on_template,
                                self.vertices, config.frame * self.size,
                                np.ones((most, len(seeds[0]))))
        self.beliefs: Beliefs | None = None
        self.domains = np.zeros((len(self.chosen), 0), dtype=np.int64)
        self.energy = np.nan

    def descend(self, level: BeliefLevel) -> None:
        """Belief propagation over the places of one level, in domains pruned by what is known."""
        spread = np.arange(min(level.places, len(self.places)))
        known = self.config.potentials
        unary = place_energy(self.scan, self.places[spread], known, self.size)
        wanted = unary if self.beliefs is None else -self.carried(spread)
        domains = np.argsort(wanted, axis=1)[:, :level.domain]
        self.domains = spread[domains]
        problem = self.problem(np.take_along_axis(unary, domains, axis=1))
        self.beliefs = propagate(problem, self.config.iterations, self.config.damping)
        self.energy = problem.energy(self.beliefs.states)
        self.resize()

    def resize(self) -> None:
        """Scale the template by the edges whose images are known: bending changes paths, but not short edges."""
        assert self.beliefs is not None
        found = self.beliefs.states < self.domains.shape[1]
        i, j = self.edges[found[self.edges].all(axis=1)].T
        image = np.take_along_axis(self.domains, np.minimum(self.beliefs.states, self.domains.shape[1] - 1)[:, None], 1)
        x, y = self.scan.points, self.places.points[image[:, 0]]
        far = np.linalg.norm(y[i] - y[j], axis=1)
        ratio = np.linalg.norm(x[i] - x[j], axis=1)[far > 0] / far[far > 0]
        grown = float(np.median(ratio)) if len(ratio) else 1.0
        self.places = replace(self.places, points=grown * self.places.points)
        self.scale *= grown

    def carried(self, places: np.ndarray) -> np.ndarray:
        """Beliefs so far, spread over other places: (n, m), not normalised."""
        assert self.beliefs is not None
        n, K = self.domains.shape
        reach = self.config.spread * self.size
        old, column = np.unique(self.domains, return_inverse=True)
        p = np.zeros((n, len(old)))
        np.add.at(p, (np.repeat(np.arange(n), K), column.ravel()), self.beliefs.probabilities[:, :K].ravel())
        i, j, distance = _pairs_within(self.places.points[old], self.places.points[places], 3 * reach)
        share = csr_array(coo_array((np.exp(-0.5 * (distance / reach) ** 2), (i, j)), shape=(len(old), len(places))))
        return p @ share

    def problem(self, unary: np.ndarray) -> PairField:
        """The field over the domains, with one more state that says: no image."""
        known, (n, K) = self.config.potentials, self.domains.shape
        energies = np.full((n, K + 1), known.nothing * known.place_weight * most_place_energy(
            known, self.scan.to_seeds.shape[1]))
        energies[:, :K] = known.place_weight * unary
        pairwise = np.full((len(self.edges), K + 1, K + 1), known.nothing * most_edge_energy(known), dtype=np.float32)
        pairwise[:, :K, :K] = edge_energy(self.scan, self.places, self.edges, self.domains, known, self.size)
        return PairField(energies, self.edges, pairwise)

    def result(self) -> Correspondences:
        """The images found, most certain first."""
        assert self.beliefs is not None
        n, K = self.domains.shape
        found = np.flatnonzero(self.beliefs.states < K)
        image = self.domains[found, self.beliefs.states[found]]
        apart = np.linalg.norm(self.places.points[self.domains[found]] - self.places.points[image][:, None], axis=2)
        sure = (self.beliefs.probabilities[found, :K] * (apart < self.config.certain * self.size)).sum(axis=1)
        confidence = sure * np.exp(-self.strain()[found] / self.config.strained)
        order = np.argsort(-confidence, kind="stable")[:self.config.keep]
        energies = {"field": self.energy, "scale": self.scale, "without_image": float(n - len(found))}
        return Correspondences(self.vertices[image[order]], self.scan.points[found[order]], confidence[order],
                               "correlated", energies, self.beliefs.converged)

    def strain(self) -> np.ndarray:
        """Mean energy (n,) of the edges around every point, each with the images chosen."""
        assert self.beliefs is not None
        n, K = self.domains.shape
        found = self.beliefs.states < K
        image = self.domains[np.arange(n), np.where(found, self.beliefs.states, 0)]
        edges = self.edges[found[self.edges].all(axis=1)]
        cost = edge_energy(self.scan, self.places, edges, image[:, None], self.config.potentials, self.size)[:, 0, 0]
        total, count = (np.bincount(edges.ravel(), np.repeat(w, 2), n) for w in (cost, np.ones(len(edges))))
        return total / np.maximum(count, 1)


SPREAD = 2000        # vertices beyond these come in no special order: all of them are wanted then


@lru_cache(maxsize=4)                # a folder of scans shares one template
def spread_vertices(template: Mesh, count: int) -> np.ndarray:
    """So many vertices (count,), the first of which, however few are taken, are spread over the template."""
    first = farthest_points(template.vertices, min(count, SPREAD))
    rest = np.setdiff1d(np.arange(len(template.vertices)), first)
    return np.concatenate([first, rest])[:count]


def scale_between(template: np.ndarray, scan: np.ndarray) -> float:
    """How much larger the scan is, by the distances (S, S) between seeds: bending changes some of them."""
    a, b = np.triu_indices(len(template), 1)
    far, near = template[a, b], scan[a, b]
    good = np.isfinite(far) & np.isfinite(near) & (far > 0) & (near > 0)
    return float(np.median(near[good] / far[good])) if good.any() else 1.0


def seen_from(points: np.ndarray, normals: np.ndarray, distances: np.ndarray, at: np.ndarray, frame: float,
              sure: np.ndarray) -> Places:
    """Some points of a surface as seen from the seeds, from which `distances` (S, m) are."""
    to_seeds = np.where(np.isfinite(distances[:, at]), distances[:, at], np.nan).T
    turns = turns_between(points, normals, distances, at, frame)
    return Places(points[at], normals[at], to_seeds, turns, sure)


def neighbour_edges(sheet: Sheet, chosen: np.ndarray, links: int, limit: float) -> np.ndarray:
    """Pairs (E, 2) of chosen points near to each other along the surface."""
    between = sheet.distances(chosen, limit=limit)[:, chosen]
    near = np.argsort(between, axis=1)[:, 1:links + 1]
    i, j = np.repeat(np.arange(len(chosen)), near.shape[1]), near.ravel()
    linked = np.isfinite(between[i, j])
    return np.unique(np.sort(np.stack([i[linked], j[linked]], axis=1), axis=1), axis=0)


def _pairs_within(a: np.ndarray, b: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pairs = cKDTree(a).sparse_distance_matrix(cKDTree(b), reach, output_type="coo_matrix")
    return pairs.row, pairs.col, pairs.data
