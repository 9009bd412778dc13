"""Correlated correspondence from given seeds: features of both surfaces, and beliefs about images of scan points."""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree

from ..geometry.farthest_points import farthest_points
from ..geometry.mesh import Mesh
from ..ranges import Cell, Count, Settings
from .belief_propagation import Beliefs, PairField, propagate
from .correspondences import Correspondences
from .potentials import MOST_EDGE, SurfaceFeatures, distance_profile, edge_energy, most_place_energy, place_energy
from .sheet import Sheet

SPREAD = 2000                # candidate vertices of the template that are spread evenly, before all others
# Levels of belief propagation, coarse to fine: candidate vertices, and how many each point of the scan keeps, the
# likeliest; the last level has all vertices. At each level messages are sent at most so many rounds.
LEVELS = ((SPREAD, 80), (SPREAD, 60), (None, 60))
ROUNDS = 40
KEPT = 170                   # correspondences at most, the more certain ones of 240 points


@dataclass(frozen=True)
class CorrelatedConfig(Settings):
    """Settings of `find_correspondences`.

    Attributes
    ----------
    points : int
        Points of the scan for which an image is sought.
    spacing : float
        Distance to which the scan is thinned, as a multiple of the template's size, √area.

    Examples
    --------
    >>> CorrelatedConfig(points=100).spacing
    0.009
    """

    points: Count = 240
    spacing: Cell = 0.009


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points of the scan for which images are sought, and candidate places on the template.

    `edges` (E, 2) join neighbouring points of the scan. `vertices` (m,) are the template vertices of the places.
    `scale` says how much larger the scan is than the template; places are scaled to it.
    """

    size: float
    scan: SurfaceFeatures
    edges: np.ndarray
    places: SurfaceFeatures
    vertices: np.ndarray
    scale: float


@dataclass(frozen=True, eq=False)
class Images:
    """Beliefs: the state of every point (n,) within its domain (n, K) of places; state K means no image."""

    domains: np.ndarray
    beliefs: Beliefs
    energy: float

    @property
    def found(self) -> np.ndarray:
        """(n,) bool: the point has an image."""
        return self.beliefs.states < self.domains.shape[1]

    @property
    def chosen(self) -> np.ndarray:
        """(n,) int: the place of each point; arbitrary where it has no image."""
        state = np.minimum(self.beliefs.states, self.domains.shape[1] - 1)
        return self.domains[np.arange(len(state)), state]


def propagate_beliefs(surfaces: Surfaces, before: Images | None, count: int | None, choices: int, rounds: int = ROUNDS
                      ) -> tuple[Surfaces, Images]:
    """Run belief propagation at one level, in domains pruned by earlier beliefs, and rescale the template.

    Of `count` candidate vertices of the template, or all, each point of the scan keeps as many `choices`.
    """
    # candidates of each point: the best by unary energy, later the likeliest near earlier images
    spread = np.arange(len(surfaces.places))[:count]
    unary = place_energy(surfaces.scan, surfaces.places[spread], surfaces.size)
    wanted = unary if before is None else -_spread_beliefs(surfaces, before, spread)
    domains = np.argsort(wanted, axis=1)[:, :choices]
    n, K = domains.shape
    # one more state means "no image": it costs half of the largest unary energy, and its edges half of the largest
    # pairwise one; unary energies count half, because they overlap with the pairwise ones
    energies = np.full((n, K + 1), 0.5 * 0.5 * most_place_energy(surfaces.scan.to_seeds.shape[1]))
    energies[:, :K] = 0.5 * np.take_along_axis(unary, domains, axis=1)
    domains = spread[domains]
    pairwise = np.full((len(surfaces.edges), K + 1, K + 1), 0.5 * MOST_EDGE, dtype=np.float32)
    pairwise[:, :K, :K] = edge_energy(surfaces.scan, surfaces.places, surfaces.edges, domains, surfaces.size)
    field = PairField(energies, surfaces.edges, pairwise)
    beliefs = propagate(field, rounds)
    images = Images(domains, beliefs, field.energy(beliefs.states))
    # rescale the template by the short edges whose ends have images: bending changes long paths, but not short edges
    i, j = surfaces.edges[images.found[surfaces.edges].all(axis=1)].T
    x, y = surfaces.scan.points, surfaces.places.points[images.chosen]
    far = np.linalg.norm(y[i] - y[j], axis=1)
    ratio = np.linalg.norm(x[i] - x[j], axis=1)[far > 0] / far[far > 0]
    grown = float(np.median(ratio)) if len(ratio) else 1.0
    places = replace(surfaces.places, points=grown * surfaces.places.points)
    return replace(surfaces, places=places, scale=grown * surfaces.scale), images


def result(surfaces: Surfaces, images: Images) -> Correspondences:
    """Collect the correspondences, most confident first: by beliefs near the chosen image and strain of its edges."""
    # belief within 3% of the size of the chosen image: neighbouring vertices are as good
    matched, K = np.flatnonzero(images.found), images.domains.shape[1]
    image, domains = images.chosen[matched], images.domains[matched]
    apart = np.linalg.norm(surfaces.places.points[domains] - surfaces.places.points[image][:, None], axis=2)
    sure = (images.beliefs.probabilities[matched, :K] * (apart < 0.03 * surfaces.size)).sum(axis=1)
    # mean energy of the edges around every point, each with the images chosen
    edges = surfaces.edges[images.found[surfaces.edges].all(axis=1)]
    cost = edge_energy(surfaces.scan, surfaces.places, edges, images.chosen[:, None], surfaces.size)[:, 0, 0]
    total, count = (np.bincount(edges.ravel(), np.repeat(w, 2), len(images.domains))
                    for w in (cost, np.ones(len(edges))))
    # a mean edge energy of 4 divides the confidence by e
    confidence = sure * np.exp(-(total / np.maximum(count, 1))[matched] / 4.0)
    order = np.argsort(-confidence, kind="stable")[:KEPT]
    energies = {"field": images.energy, "scale": surfaces.scale,
                "without_image": float(len(images.domains) - len(matched))}
    return Correspondences(surfaces.vertices[image[order]], surfaces.scan.points[matched[order]], confidence[order],
                           "correlated", energies, images.beliefs.converged)


@dataclass(frozen=True, eq=False)
class Seeds:
    """Known correspondences, and the path lengths (S, N) and (S, n), metres, from them over both surfaces.

    Vertices (S,) of the template, points (S, 3) on the scan, and the nearest points (S,) of its sheet.
    """

    vertices: np.ndarray
    places: np.ndarray
    points: np.ndarray
    on_template: np.ndarray
    on_scan: np.ndarray


def surfaces_of(template: Mesh, sheet: Sheet, seeds: Seeds, count: int, most: int | None = None) -> Surfaces:
    """Compute the features of `count` points of the scan and at `most` so many of the template, or all."""
    size = float(np.sqrt(template.face_areas.sum()))
    clicked, on_scan, on_template = seeds.points, seeds.on_scan, seeds.on_template
    # scale of the scan: the median ratio of path lengths between seeds, as bending changes some of them
    a, b = np.triu_indices(len(clicked), 1)
    far, near = on_template[a, seeds.vertices[b]], on_scan[a, clicked[b]]
    good = np.isfinite(far) & np.isfinite(near) & (far > 0) & (near > 0)
    scale = float(np.median(near[good] / far[good])) if good.any() else 1.0
    chosen, edges = sheet.spread(count, 0.3 * size)
    off = np.linalg.norm(sheet.points[clicked] - seeds.places, axis=1)     # far for a click without data
    same = (sheet.piece[chosen][:, None] == sheet.piece[clicked]) & (off < 3 * sheet.spacing)
    # a path that crosses a gap of the scan, or ends in one, has a trust of 0.3
    radius = 0.042 * size                                                  # averages directions over 6 cm on a man
    scan = distance_profile(sheet.points, sheet.normals, on_scan, chosen, radius, np.where(same, 1.0, 0.3))
    vertices = _spread_vertices(template, min(most or len(template.vertices), len(template.vertices)))
    places = distance_profile(scale * template.vertices, template.vertex_normals, scale * on_template, vertices, radius,
                              np.ones((len(vertices), len(clicked))))
    return Surfaces(size, scan, edges, places, vertices, scale)


@lru_cache(maxsize=4)                # a folder of scans shares one template
def _spread_vertices(template: Mesh, count: int) -> np.ndarray:
    """Order vertices (count,): up to `SPREAD` spread over the template first, then the rest."""
    first = farthest_points(template.vertices, min(count, SPREAD))
    rest = np.setdiff1d(np.arange(len(template.vertices)), first)
    return np.concatenate([first, rest])[:count]


def _spread_beliefs(surfaces: Surfaces, images: Images, places: np.ndarray) -> np.ndarray:
    """Spread earlier beliefs over nearby places (n, m), not normalised."""
    n, K = images.domains.shape
    reach = 0.012 * surfaces.size
    # beliefs at the old places, blurred by a Gaussian of 1.2% of the size (17 mm on a man), cut at three widths
    old, column = np.unique(images.domains, return_inverse=True)
    p = np.zeros((n, len(old)))
    np.add.at(p, (np.repeat(np.arange(n), K), column.ravel()), images.beliefs.probabilities[:, :K].ravel())
    points = surfaces.places.points
    near = cKDTree(points[old]).sparse_distance_matrix(cKDTree(points[places]), 3 * reach, output_type="coo_matrix")
    share = csr_array(coo_array((np.exp(-0.5 * (near.data / reach) ** 2), (near.row, near.col)),
                                shape=(len(old), len(places))))
    return p @ share
