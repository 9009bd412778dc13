"""Potentials of correlated correspondence: what speaks for one image, and for two images together."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..ranges import Positive, Settings
from .places import Places


@dataclass(frozen=True)
class PotentialConfig(Settings):
    """Widths and weights of the potentials; a width is the error that costs one.

    Attributes
    ----------
    seed_share : float
        Width of a distance to a seed as a share of the distance: bending lengthens and shortens paths.
    seed_floor : float, multiples of the template's size
        Width of a distance to a seed beside that seed.
    turn : float
        Width of the sine between the directions away from two seeds.
    turn_weight : float
        Of all those sines together.
    length_share, length_floor : float, share and multiples of the template's size
        Width of the length of an edge.
    lean : float
        Width of the cosine between an edge and a normal at its ends.
    direction : float
        Width of the difference of an edge's ends in distance to a seed, as a share of its length.
    direction_weight : float
    place_weight : float
        Of all that speaks for a single image.
    nothing : float
        Cost of a point that has no image, and of each of its edges, as shares of the highest possible cost.
    """

    seed_share: float = 0.10
    seed_floor: Positive = 0.014
    turn: Positive = 0.4
    turn_weight: float = 3.0
    length_share: float = 0.08
    length_floor: Positive = 0.006
    lean: Positive = 0.25
    direction: Positive = 0.3
    direction_weight: float = 1.0
    place_weight: float = 0.5
    nothing: float = 0.5


def robust(r: np.ndarray, limit: float) -> np.ndarray:
    """r² for small residuals, limit² for any large one."""
    squared = r * r
    return squared / (1 + squared / limit**2)


def place_energy(scan: Places, template: Places, config: PotentialConfig, size: float) -> np.ndarray:
    """Energy (n, m) of every place of the template as the image of every place of the scan.

    [CC] geodesic potentials, as evidence for single places
    """
    energy = np.zeros((len(scan), len(template)))
    known = np.zeros_like(energy)
    for x, y, w in zip(scan.to_seeds.T, template.to_seeds.T, scan.sure.T, strict=True):
        width = config.seed_floor * size + config.seed_share * np.minimum(x[:, None], y[None])
        r = robust((x[:, None] - y[None]) / width * w[:, None], 2.0)
        energy += np.nan_to_num(r)
        known += np.isfinite(r)
    energy *= scan.to_seeds.shape[1] / np.maximum(known, 1)
    a, b = np.triu_indices(scan.to_seeds.shape[1], 1)
    both = (scan.sure[:, a] * scan.sure[:, b]).T
    for x, y, w in zip(scan.turns.T, template.turns.T, both, strict=True):
        energy += config.turn_weight / len(a) * w[:, None] * robust((x[:, None] - y[None]) / config.turn, 2.0)
    return energy


def edge_energy(scan: Places, template: Places, edges: np.ndarray, domains: np.ndarray, config: PotentialConfig,
                size: float) -> np.ndarray:
    """Energy (E, K, K) of the images of the two ends of every edge.

    The edge between two points of the scan against the edge between their images: its length, its angles to the
    normals at both ends and the angle between these, and its direction, told by how much nearer to every seed it
    leads. The last is a local frame that needs no estimate of the turn.

    Parameters
    ----------
    edges : (E, 2) int
        Pairs of places of the scan.
    domains : (n, K) int
        Places of the template that may be the image of each place of the scan.

    [CC] deformation potential
    """
    out = np.empty((len(edges), domains.shape[1], domains.shape[1]), dtype=np.float32)
    along = scan.points[edges[:, 1]] - scan.points[edges[:, 0]]
    length = np.maximum(np.linalg.norm(along, axis=1), 1e-9)
    at_i, at_j = (np.einsum("ed,ed->e", scan.normals[edges[:, side]], along / length[:, None]) for side in (0, 1))
    bend = np.einsum("ed,ed->e", scan.normals[edges[:, 0]], scan.normals[edges[:, 1]])
    nearer = scan.to_seeds[edges[:, 1]] - scan.to_seeds[edges[:, 0]]
    x, n, d = (np.asarray(a, dtype=np.float32) for a in (template.points, template.normals, template.to_seeds))
    for e, (i, j) in enumerate(edges):
        k, l = domains[i], domains[j]
        apart = x[l][None] - x[k][:, None]
        far = np.sqrt(np.einsum("kld,kld->kl", apart, apart)) + 1e-9
        width = config.length_floor * size + config.length_share * length[e]
        energy = robust((far - length[e]) / width, 3.0)
        lean_k = np.einsum("kld,kd->kl", apart, n[k]) / far
        lean_l = np.einsum("kld,ld->kl", apart, n[l]) / far
        energy += 0.5 * robust((lean_k - at_i[e]) / config.lean, 3.0)
        energy += 0.5 * robust((lean_l - at_j[e]) / config.lean, 3.0)
        energy += 0.5 * robust((n[k] @ n[l].T - bend[e]) / (1.5 * config.lean), 3.0)
        w = np.where(np.isfinite(nearer[e]), np.minimum(scan.sure[i], scan.sure[j]), 0.0)
        for s in np.flatnonzero(w):
            r = (d[l, s][None] - d[k, s][:, None] - nearer[e, s]) / (config.direction * length[e])
            energy += config.direction_weight * w[s] / w.sum() * robust(r, 2.0)
        out[e] = energy
    return out


def most_edge_energy(config: PotentialConfig) -> float:
    """No edge can cost more."""
    return 9.0 * 2.5 + 4.0 * config.direction_weight


def most_place_energy(config: PotentialConfig, seeds: int) -> float:
    """No place can cost more."""
    return 4.0 * (seeds + config.turn_weight)
