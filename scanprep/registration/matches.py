"""Matches between a deforming template and a scan, in both directions."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ..geometry.mesh import Mesh
from ..geometry.target import Target, orient
from ..threads import search_threads
from .energies import Pull, pull

NORMALS = 0.04                # of the template's size: what a difference of normals of one is worth when matching


@dataclass(frozen=True)
class Likeness:
    """What a match is sought by, each as the distance in metres that a difference of one is worth."""

    positions: float = 1.0       # less where the template does not lie near yet; 0 seeks by descriptors alone
    normals: float = 0.05
    descriptors: float = 0.0
    limit: float = 0.3           # descriptors that differ by more do not match


@dataclass(frozen=True, eq=False)
class Described:
    """Points with what they are matched by."""

    points: np.ndarray
    normals: np.ndarray
    descriptors: np.ndarray | None = None

    def of(self, sample: np.ndarray) -> Described:
        """Some of the points."""
        return Described(self.points[sample], self.normals[sample],
                         None if self.descriptors is None else self.descriptors[sample])

    def columns(self, like: Likeness) -> np.ndarray:
        """Points whose straight distances are how much they differ."""
        parts = [like.positions * self.points, like.normals * self.normals] if like.positions else []
        if like.descriptors and self.descriptors is not None:
            parts.append(like.descriptors * self.descriptors)
        return np.hstack(parts)

    def matched(self, others: Described, reach: float, like: Likeness) -> tuple[np.ndarray, np.ndarray]:
        """For each point the best of others, -1 where it is beyond the limits; and how far apart they are."""
        mine, theirs = self.columns(like), others.columns(like)
        _, index = cKDTree(theirs).query(mine, workers=search_threads(len(mine)))
        apart = np.linalg.norm(others.points[index] - self.points, axis=1)
        good = apart <= reach
        if like.positions:
            good &= np.einsum("nd,nd->n", others.normals[index], self.normals) >= 0.5
        if like.descriptors and self.descriptors is not None and others.descriptors is not None:
            good &= np.linalg.norm(others.descriptors[index] - self.descriptors, axis=1) <= like.limit
        return np.where(good, index, -1), apart


def match_both_ways(deformed: Mesh, sample: np.ndarray, area: float, target: Target, reach: float, slide: float,
                    like: Likeness, descriptors: np.ndarray | None = None) -> Pull:
    """What matches want of the vertices of a deformed template: some of them to the scan, and the scan to all of them.

    `sample` (n,) are the vertices that look for a match. Either direction weighs as much as an area, square metres.
    The weight of a match falls to zero at a distance of `reach`, metres; its force along the surface is a share,
    `slide`, of that across it. `descriptors` (N, q) are those of the vertices.
    """
    target = orient(target, deformed, max(like.normals, 1e-6))
    x, N = deformed.vertices, len(deformed.vertices)
    mine = Described(x, deformed.vertex_normals, descriptors)
    theirs = Described(target.points, target.normals, target.descriptors)
    p, apart = mine.of(sample).matched(theirs, reach, like)
    good = (p >= 0) & ~target.border[p]
    v, p = sample[good], p[good]
    weights = area / len(sample) * tukey(apart[good], reach)
    wanted = pull(N, v, target.points[p], weights, target.normals[p], slide)

    chosen, apart = theirs.matched(mine, reach, like)
    p = np.flatnonzero(chosen >= 0)
    weights = area / len(target.points) * tukey(apart[p], reach)
    return wanted + pull(N, chosen[p], target.points[p], weights, target.normals[p], slide)


def tukey(distances: np.ndarray, reach: float) -> np.ndarray:
    """Tukey's weight: one at zero distance, zero at `reach`."""
    return np.maximum(1 - (distances / reach) ** 2, 0) ** 2
