"""The upright prior: people mostly stand, so the up direction limits the orientation of a body."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.roles import LIMBS, find_numbered_roles
from scanprep.skeleton.tree import Skeleton

TILT = 0.35                          # radians: how far trunks of standing people lean, standard deviation
AXES = np.concatenate([np.eye(3), -np.eye(3)])       # of a scan: along one of them people mostly stand
PICTURE = np.array([[0, -1.0, 0], [0, 1.0, 0], [1.0, 0, 0], [-1.0, 0, 0]])    # a camera as it is, upside down, rolled
SPREAD = 3000                        # rotations, 15 degrees apart, of which the upright ones are tried
SPREAD_OF_MANY = 1500                # rotations where up is one of several directions, so that the time stays alike


@dataclass(frozen=True, eq=False)
class Upright:
    """Directions of which one is up in a scan, and the up direction in the frame of the body's trunk."""

    ups: np.ndarray                  # (n, 3) unit
    of_body: np.ndarray              # (3,) unit

    @staticmethod
    def of(template: Mesh, skeleton: Skeleton, up: tuple[float, float, float] | None, picture: bool) -> Upright | None:
        """Collect what is known of the up direction; None where nothing is known.

        `up` is that of the scan, if given; a camera that took a `picture` is upright, upside down, or rolled.
        """
        of_body = standing_axis(template, skeleton) if up is not None or picture else None
        if up is not None:
            length = float(np.linalg.norm(up))
            if length < 1e-9:
                raise ValueError(f"up: expected a direction, got {up}")
            if of_body is None:
                raise ValueError("up: expected none with a body that has no head and legs; name its parts "
                                 "(scape prep skeleton)")
            return Upright(np.array(up)[None] / length, of_body)
        return None if of_body is None else Upright(PICTURE, of_body)

    def rotations(self, spread: np.ndarray) -> np.ndarray:
        """Select those (T, 3, 3) of the rotations (n, 3, 3) in which the body stands."""
        # starts lean by at most 0.6 rad; the fit may lean more
        return spread[((spread @ self.of_body) @ self.ups.T).max(axis=1) > np.cos(0.6)]

    def nearest(self, x: np.ndarray) -> np.ndarray:
        """Find the direction (..., 3) among them that is up for bodies of unknowns (..., P)."""
        return self.ups[np.argmax(rotations.exp(x[..., :3]) @ self.of_body @ self.ups.T, axis=-1)]


def standing_axis(template: Mesh, skeleton: Skeleton) -> np.ndarray | None:
    """Find the coordinate axis (3,) of a template that points most from legs to head; None without head or legs."""
    part = skeleton.part_of_vertex(template)
    roles = find_numbered_roles(skeleton.names, skeleton.joints)
    legs = [p for role, p in roles.items() if role[2:] in LIMBS["leg"]]
    if not legs or "skullbase" not in roles:
        return None
    head, legs_middle = (template.vertices[np.isin(part, parts)].mean(axis=0) for parts in (roles["skullbase"], legs))
    way = head - legs_middle
    axis = np.zeros(3)
    axis[np.abs(way).argmax()] = np.sign(way[np.abs(way).argmax()])
    return axis
