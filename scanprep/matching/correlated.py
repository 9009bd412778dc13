"""Correlated correspondence: many pairs of places on a template and a scan from a few.

1. The scan's sheets become one graph of points; paths over it tell how far every point is from the seeds.
2. Some two hundred points of the scan are variables, places of the template their values. What a place looks
   like from the seeds speaks for single values, edges that keep length and direction for pairs of them.
3. Loopy belief propagation, first over places spread wide, then over all vertices around the likely ones.

[CC]
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree

from ..geometry.geodesics import SurfaceGraph
from ..geometry.mesh import Mesh, check_template
from .beliefs import Beliefs, PairField, propagate
from .correlated_energies import (
    PotentialConfig,
    edge_energy,
    most_edge_energy,
    most_place_energy,
    place_energy,
)
from .correlated_places import Places, turns_between
from .correlated_sheet import Sheet
from .correspondences import Correspondences
from .graph import farthest_points
from .matches import target_of


@dataclass(frozen=True)
class BeliefLevel:
    """One level from coarse to fine.

    Attributes
    ----------
    places : int
        Places of the template that are spread over it; at most all vertices.
    domain : int
        Of them, how many a point of the scan may choose from.
    """

    places: int
    domain: int


@dataclass(frozen=True)
class CorrelatedConfig:
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
    neighbours : int
        Points of the scan over which its normals are averaged.
    """

    points: int = 200
    keep: int = 180
    spacing: float = 0.009
    links: int = 8
    frame: float = 0.042
    levels: tuple[BeliefLevel, ...] = (BeliefLevel(3000, 150), BeliefLevel(1_000_000, 80))
    potentials: PotentialConfig = field(default_factory=PotentialConfig)
    iterations: int = 40
    damping: float = 0.3
    spread: float = 0.012
    certain: float = 0.03
    neighbours: int = 16


def find_correspondences(template: Mesh, scan: Mesh | np.ndarray, seeds: tuple[np.ndarray, np.ndarray],
                         config: CorrelatedConfig | None = None,
                         progress: Callable[[int, int], None] | None = None) -> Correspondences:
    """From a few pairs of places on a template and a scan to nearly two hundred.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        May have holes, borders, several overlapping sheets, noise.
    seeds : (S,) int and (S, 3) float, metres
        Vertices of the template and where they are on the scan; three at least, spread over the body.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Correspondences
        Points of the scan that found an image, the most certain first.

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite, fewer than
        three seeds or seeds that do not exist.

    [CC]
    """
    config, tell = config or CorrelatedConfig(), progress or (lambda done, total: None)
    check_template(template)
    seeds = checked_seeds(template, seeds)
    total = 2 + 2 * len(config.levels)
    search = _Search(template, scan, seeds, config)
    tell(2, total)
    for number, level in enumerate(config.levels):
        search.descend(level)
        tell(4 + 2 * number, total)
    return search.result()


def checked_seeds(template: Mesh, seeds: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Seeds as arrays, or ValueError with what is wrong with them."""
    vertices, points = np.asarray(seeds[0]), np.asarray(seeds[1], dtype=np.float64)
    if vertices.ndim != 1 or not np.issubdtype(vertices.dtype, np.integer):
        raise ValueError(f"seeds: expected vertex numbers of shape (S,), got {vertices.dtype} of shape "
                         f"{vertices.shape}")
    if points.shape != (len(vertices), 3):
        raise ValueError(f"seeds: expected points of shape ({len(vertices)}, 3), got {points.shape}")
    if len(vertices) < 3:
        raise ValueError(f"seeds: expected at least 3, got {len(vertices)}")
    outside = (vertices < 0) | (vertices >= len(template.vertices))
    if outside.any():
        raise ValueError(f"seeds: vertex {vertices[outside][0]} is outside 0..{len(template.vertices) - 1}")
    if not np.isfinite(points).all():
        raise ValueError(f"seeds: {(~np.isfinite(points).all(axis=1)).sum()} points are not finite")
    return vertices.astype(np.int64), points


class _Search:
    """A search under way: both surfaces as seen from the seeds, and what is believed so far."""

    def __init__(self, template: Mesh, scan: Mesh | np.ndarray, seeds: tuple[np.ndarray, np.ndarray],
                 config: CorrelatedConfig) -> None:
        self.template, self.config = template, config
        self.size = float(np.sqrt(template.face_areas.sum()))
        sheet = Sheet(target_of(scan, config.neighbours), config.spacing * self.size)
        clicked = sheet.at(seeds[1])
        on_scan = sheet.distances(clicked)
        on_template = SurfaceGraph(template).distances(seeds[0])
        self.scale = scale_between(on_template[:, seeds[0]], on_scan[:, clicked])
        self.chosen = farthest_points(sheet.points, min(config.points, len(sheet.points)))
        self.edges = neighbour_edges(sheet, self.chosen, config.links, 0.3 * self.size)
        self.scan = seen_from(sheet.points, sheet.normals, on_scan, self.chosen, config.frame * self.size)
        self.places = seen_from(self.scale * template.vertices, template.vertex_normals, self.scale * on_template,
                                np.arange(len(template.vertices)), config.frame * self.size)
        self.beliefs: Beliefs | None = None
        self.domains = np.zeros((len(self.chosen), 0), dtype=np.int64)
        self.energy = np.nan

    def descend(self, level: BeliefLevel) -> None:
        """Belief propagation over the places of one level, in domains pruned by what is known."""
        everywhere = np.arange(len(self.places))
        spread = (everywhere if level.places >= len(everywhere)
                  else np.sort(farthest_points(self.places.points, level.places)))
        known = self.config.potentials
        if self.beliefs is None:
            unary = place_energy(self.scan, self.places[spread], known, self.size)
            domains = np.argsort(unary, axis=1)[:, :level.domain]
        else:
            domains = np.argsort(-self.carried(spread), axis=1)[:, :level.domain]
            unary = place_energy(self.scan, self.places[spread], known, self.size)
        self.domains = spread[domains]
        problem = self.problem(np.take_along_axis(unary, domains, axis=1))
        self.beliefs = propagate(problem, self.config.iterations, self.config.damping)
        self.energy = problem.energy(self.beliefs.states)

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
        p = self.beliefs.probabilities[:, :K]
        found = np.flatnonzero(self.beliefs.states < K)
        image = self.domains[found, self.beliefs.states[found]]
        apart = np.linalg.norm(self.places.points[self.domains[found]] - self.places.points[image][:, None], axis=2)
        confidence = (p[found] * (apart < self.config.certain * self.size)).sum(axis=1)
        order = np.argsort(-confidence, kind="stable")[:self.config.keep]
        energies = {"field": self.energy, "scale": self.scale, "without_image": float(n - len(found))}
        return Correspondences(image[order], self.scan.points[found[order]], confidence[order],
                               "correlated", energies, self.beliefs.converged)


def scale_between(template: np.ndarray, scan: np.ndarray) -> float:
    """How much larger the scan is, by the distances (S, S) between seeds: bending changes some of them."""
    a, b = np.triu_indices(len(template), 1)
    far, near = template[a, b], scan[a, b]
    good = np.isfinite(far) & np.isfinite(near) & (far > 0) & (near > 0)
    return float(np.median(near[good] / far[good])) if good.any() else 1.0


def seen_from(points: np.ndarray, normals: np.ndarray, distances: np.ndarray, at: np.ndarray, frame: float
              ) -> Places:
    """Some points of a surface as seen from the seeds, from which `distances` (S, m) are."""
    to_seeds = np.where(np.isfinite(distances[:, at]), distances[:, at], np.nan).T
    turns = turns_between(points, normals, distances, at, frame)
    return Places(points[at], normals[at], to_seeds, turns, np.zeros((len(at), 0)))


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
