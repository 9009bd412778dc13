"""The built-in people: a mean body, how bodies differ, and how women and men are distributed.

Shapes are MakeHuman's (CC0), the statistics those of ANSUR II; `tests/people` makes the data file from both. A body is
linear in its betas b: vertices and joints are `mean + sum_k b_k directions_k`. The first beta is stature, the second
weight, the third leads from women to men. The betas of each sex are normally distributed.
"""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry import storage

STORED = Path(__file__).with_name("people.npz")
PARTS = ("pelvis", "abdomen", "chest", "head",
         "upper_arm_left", "forearm_left", "hand_left", "upper_arm_right", "forearm_right", "hand_right",
         "thigh_left", "shin_left", "foot_left", "thigh_right", "shin_right", "foot_right")
# parent of each part, and the part on the other side of the body
PARENTS = np.array([-1, 0, 1, 2, 2, 4, 5, 2, 7, 8, 0, 10, 11, 0, 13, 14])
MIRROR_PART = np.array([0, 1, 2, 3, 7, 8, 9, 4, 5, 6, 13, 14, 15, 10, 11, 12])


@dataclass(frozen=True, eq=False)
class Population:
    """The contents of the data file.

    Attributes
    ----------
    mean : (N + 33, 3) float, metres
        Vertices, 16 joints, 16 far ends of bones, the middle between the eyes; z up, facing -y, on the floor.
    directions : (K, N + 33, 3) float, metres
        For betas of variance 1 over women and men together.
    faces : (F, 3) int
    weights : (N, 16) float
        How much each part carries of a vertex.
    mirror : (N,) int
        The vertex at the mirrored place.
    moments : mapping of sex to (mean (K,), covariance (K, K))
        Distribution of the betas.
    landmarks, markers : dict of str to int
        Name to vertex.
    source : dict
        The header: how the file was made, where shapes and statistics come from.
    """

    mean: np.ndarray
    directions: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    mirror: np.ndarray
    moments: Mapping[str, tuple[np.ndarray, np.ndarray]]
    landmarks: dict[str, int]
    markers: dict[str, int]
    source: dict[str, Any]

    def rows(self, betas: np.ndarray) -> np.ndarray:
        """Compute the rows (N + 33, 3), metres, of a body of betas (k,), k <= K; its lowest vertex is on the floor."""
        out = self.mean + np.tensordot(betas, self.directions[:len(betas)], axes=1)
        return out - [0, 0, out[:len(self.weights), 2].min()]


@lru_cache(maxsize=1)
def population() -> Population:
    """Read the built-in people, once per process."""
    # of that file
    header, a = storage.load(STORED, "people", (1,))
    mirror = a["mirror"].astype(np.int64)
    count, swap = len(mirror), MIRROR_PART
    twin = np.concatenate([mirror, count + swap, count + 16 + swap, [count + 32]])
    # stored numbers are rounded: average with the mirror image, so that left and right stay exactly symmetric
    mean = a["mean"].astype(np.float64)
    mean = 0.5 * (mean + mean[twin] * [-1, 1, 1])
    directions = a["directions"] * a["scale"].astype(np.float64)[:, None, None]
    directions = 0.5 * (directions + directions[:, twin] * [-1, 1, 1])
    weights = a["weights"].astype(np.float64)
    weights += weights[mirror][:, swap]

    def vertices_by_name(kind: str) -> dict[str, int]:
        """Return name -> vertex."""
        return {str(name): int(v) for name, v in zip(a[kind], a[f"{kind}_vertices"], strict=True)}

    return Population(mean, directions, a["faces"].astype(np.int64),
                      weights / weights.sum(axis=1, keepdims=True), mirror,
                      {sex: (a[f"{sex}_mean"], a[f"{sex}_covariance"]) for sex in ("female", "male")},
                      vertices_by_name("landmarks"), vertices_by_name("markers"), header)
