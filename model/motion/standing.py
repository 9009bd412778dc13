"""A rest for skeletons whose file has none of a person: a frame in which they stand."""
from __future__ import annotations

from dataclasses import replace

import numpy as np

from scanprep.skeleton.roles import numbered_roles

from .moving import MovingSkeleton

UPRIGHT = 0.8                        # cosine between segments and the vertical, from which on somebody stands


def standing_rest(moving: MovingSkeleton) -> tuple[MovingSkeleton, int | None]:
    """The skeleton at rest as in the frame in which trunk and legs are nearest to the vertical, and its number.

    Some files have bones at rest that all lie along one axis. A skeleton that stands at rest, or never, is returned as
    it is, and None. The vertical is y, as BVH says, or z where nobody stands along y.
    """
    roles = numbered_roles(moving.names, moving.rest)
    chains = [[roles.get(f"{side}_{name}") for name in ("shoulder", "hip", "knee", "ankle")] for side in "lr"]
    if any(j is None for chain in chains for j in chain):
        return moving, None
    joints = np.array(chains)
    if _upright(moving.rest[None], joints).max() > UPRIGHT / 2:
        return moving, None
    along = _upright(moving.places, joints)
    told = along[int(along[0].max() < UPRIGHT)]
    best = int(told.argmax())
    if told[best] < UPRIGHT:
        return moving, None
    rest = moving.places[best]
    offsets = rest - np.where(moving.parents[:, None] < 0, 0, rest[moving.parents])
    R = moving.rotations @ np.swapaxes(moving.rotations[best], -1, -2)
    return replace(moving, offsets=offsets, rotations=R), best


def _upright(places: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """(2, T) the least cosine between y, or z, and the segments from shoulders to ankles, (2, 4) joints."""
    steps = np.diff(places[:, joints], axis=2)
    size = np.linalg.norm(steps, axis=3)
    return np.stack([(-steps[..., axis] / np.maximum(size, 1e-12)).min(axis=(1, 2)) for axis in (1, 2)])
