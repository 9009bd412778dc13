"""Keeps the skin of drawn bodies from running through itself: lips, toes, armpits, thighs of the stout.

Bodies are linear in their betas, and so is what this adds to them. In each round bodies are drawn, farther out than
people are; where triangles cross, or turn over, the skin there is smoothed a little, and the mean and the directions
take up the regression of these moves on the betas.
"""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pymeshlab
from scipy.sparse import csr_array, diags_array

from scanprep.geometry.mesh import Mesh

FARTHER = 1.25                       # times the spread of people
RIDGE = 1e-3                         # share of the bodies
MIDDLE = 0.03                        # metres beside the middle that one half of a body is looked at


def crossing(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool, triangles that cross others which are not their neighbours."""
    used, few = np.unique(faces, return_inverse=True)
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices[used], few.reshape(-1, 3)))
    meshes.compute_selection_by_self_intersections_per_face()
    return meshes.current_mesh().face_selection_array()


def turned_over(vertices: np.ndarray, rest: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F,) bool, triangles that look away from where those of the body at `rest` look."""
    ways = [np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]]) for v in (vertices, rest)]
    return np.einsum("fd,fd->f", *ways) < 0


def keep_apart(mean: np.ndarray, directions: np.ndarray, faces: np.ndarray, mirror: np.ndarray,
               moments: Sequence[tuple[np.ndarray, np.ndarray]], people: int = 100, rounds: int = 24
               ) -> tuple[np.ndarray, np.ndarray]:
    """Mean (N, 3) and directions (K, N, 3) of bodies whose skin does not cross itself.

    `mirror` (N,) vertices at mirrored places; `moments` mean and covariance of the betas of each sex.
    """
    rng, k = np.random.default_rng(1), len(directions)
    betas = np.vstack([m + FARTHER * whitened(rng, people, k) @ np.linalg.cholesky(S).T for m, S in moments])
    X = np.column_stack([np.ones(len(betas)), betas])
    fit = np.linalg.solve(X.T @ X + RIDGE * len(X) * np.eye(k + 1), X.T)
    edges = Mesh(mean, faces).edges
    near = csr_array((np.ones(2 * len(edges)), np.vstack([edges, edges[:, ::-1]]).T), shape=(len(mean),) * 2)
    near = diags_array(1 / near.sum(axis=1)) @ near
    mean, directions = mean.copy(), directions.copy()
    # bodies are as good as symmetric: one half, and what crosses the middle
    half = faces[mean[faces][..., 0].mean(axis=1) > -MIDDLE]
    for turn in range(rounds):
        moves = np.zeros((len(betas), *mean.shape))
        if turn % 6 == 0:                        # in between only those that were at fault, which are few
            todo = np.arange(len(betas))
        for i in todo:
            body = mean + np.tensordot(betas[i], directions, 1)
            bad = np.unique(half[crossing(body, half) | turned_over(body, mean, half)])
            if len(bad):
                share = np.zeros(len(mean))
                share[bad] = 1
                share = np.maximum(share, share[mirror])
                share = np.maximum(share, 0.5 * (near @ share > 0))
                moves[i] = share[:, None] * (near @ body - body)
        todo = np.flatnonzero(np.abs(moves).max(axis=(1, 2)) > 0)
        change = np.tensordot(fit, moves, 1)
        mean += change[0]
        directions += change[1:]
    return mean, directions


def whitened(rng: np.random.Generator, count: int, k: int) -> np.ndarray:
    """(count, k) standard normal numbers, in pairs on opposite sides, whose covariance is exactly one."""
    Z = rng.standard_normal((count // 2, k))
    Z = np.vstack([Z, -Z])
    return Z @ np.linalg.inv(np.linalg.cholesky(np.cov(Z.T, bias=True))).T
