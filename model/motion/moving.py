"""A skeleton that moves, whatever kind of file it is from."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.skeleton.tree import Skeleton

from ..rig import joint_places


@dataclass(frozen=True, eq=False)
class MovingSkeleton:
    """A skeleton and its motion, in the axes of its file."""

    names: tuple[str, ...]           # of the J joints, parent before child
    parents: np.ndarray              # (J,) int, -1 at the root
    offsets: np.ndarray              # (J, 3) metres, each joint from its parent at rest, where no joint is turned
    rotations: np.ndarray            # (T, J, 3, 3) of every joint in the world: `R_j = R_parent(j) R`
    places: np.ndarray               # (T, J, 3) metres, of every joint in the world
    rate: float                      # frames a second

    def __repr__(self) -> str:
        return f"MovingSkeleton({len(self.names)} joints, {len(self.places)} frames at {self.rate:g} 1/s)"

    @cached_property
    def rest(self) -> np.ndarray:
        """(J, 3) float, metres: the joints where no joint is turned, the root at its offset."""
        out = self.offsets.copy()
        for j in range(1, len(out)):
            out[j] += out[self.parents[j]]
        return out


def set_in_motion(skeleton: Skeleton, poses: np.ndarray, trans: np.ndarray, rate: float) -> MovingSkeleton:
    """Build the moving skeleton of poses (T, J, 3), radians, and trans (T, 3), metres, of a body's parts."""
    offsets = skeleton.joints - np.where(skeleton.parents[:, None] < 0, 0, skeleton.joints[skeleton.parents])
    return MovingSkeleton(skeleton.names, skeleton.parents, offsets, skeleton.part_rotations(poses),
                          joint_places(skeleton, poses, trans), rate)
