"""Synthetic people with known shape, skeleton and pose.

z is up. A person faces -y, stands on z = 0 and has the left side at +x; at rest the arms hang about 36 degrees away
from the body. All people share one closed triangulation, and vertex i is the same anatomical place on everybody.
Posing is not linear blend skinning: see `posing`.
"""
from __future__ import annotations

from functools import cached_property

import numpy as np

from ..geometry.mesh import Mesh
from ..skeleton.tree import Skeleton
from .anatomy import PARENTS, PARTS, BodyShape, RestFrames
from .landmarks import landmarks, markers
from .poses import NAMED_POSES, compose_pose, find_pose, mirror_synthetic_pose, random_pose, synthesise_walk
from .posing import Poser
from .topology import load_topology

__all__ = ["NAMED_POSES", "PARENTS", "PARTS", "BodyShape", "SyntheticPerson", "compose_pose", "find_pose",
           "mirror_synthetic_pose",
           "random_pose", "synthesise_walk"]


class SyntheticPerson:
    """One person: the surface at rest, the skeleton, and the surface in any pose.

    `mesh` is at rest, with `part_of_face` (F,) and `part_of_vertex` (N,). Every part turns about one of the `joints`
    (16, 3), metres; the first is the centroid of the vertices of part 0.

    Parameters
    ----------
    shape : BodyShape, optional
        By default the average man.

    Examples
    --------
    >>> person = SyntheticPerson()
    >>> person.in_pose(np.zeros((16, 3))).shape == person.mesh.vertices.shape
    True
    """

    parents = PARENTS
    names = PARTS

    def __init__(self, shape: BodyShape | None = None) -> None:
        self.shape = shape or BodyShape()
        template = load_topology()
        self.anatomy = RestFrames(self.shape)
        self.mesh = Mesh(self.anatomy.vertices, template.mesh.faces)
        self.part_of_face = template.part_of_face
        self.part_of_vertex = template.part_of_vertex
        self.joints = self.anatomy.joints.copy()
        self.joints[0] = self.mesh.vertices[self.part_of_vertex == 0].mean(axis=0)

    def __repr__(self) -> str:
        return f"Person({self.shape})"

    @cached_property
    def skeleton(self) -> Skeleton:
        """Return the true parts, tree and joints."""
        return Skeleton(self.part_of_face, self.parents, self.joints, self.names)

    @cached_property
    def _poser(self) -> Poser:
        """Return what posing needs; built when first used."""
        return Poser(self.anatomy, self.mesh.vertices, self.joints[0])

    def in_pose(self, pose: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """Compute the vertices (N, 3), metres, in a pose (16, 3): axis-angle of each part relative to its parent.

        `pose[0]` turns the body about `joints[0]`. Adds `trans` (3,), metres.
        """
        pose = _check(pose)
        return self._poser(pose) + (0 if trans is None else np.asarray(trans, dtype=np.float64))

    def joints_in_pose(self, pose: np.ndarray, trans: np.ndarray | None = None) -> np.ndarray:
        """Compute the joints (16, 3), metres, in a pose; shoulders move in the chest as the arms are raised.

        The first one is always `joints[0] + trans`.
        """
        pose = _check(pose)
        joints = self._poser.part_motion(pose)[1] + self._poser.settling(pose)
        joints[0] = self.joints[0]
        return joints + (0 if trans is None else np.asarray(trans, dtype=np.float64))

    def part_rotations(self, pose: np.ndarray) -> np.ndarray:
        """Compute the world rotations (16, 3, 3) of the parts in a pose."""
        return self._poser.part_motion(_check(pose))[0]


def _check(pose: np.ndarray) -> np.ndarray:
    """Return a pose as floats; ValueError for anything but finite (16, 3)."""
    pose = np.asarray(pose, dtype=np.float64)
    if pose.shape != (len(PARTS), 3) or not np.isfinite(pose).all():
        raise ValueError(f"pose: expected finite rotation vectors ({len(PARTS)}, 3), got shape {pose.shape}")
    return pose


def __getattr__(name: str) -> dict[str, int]:
    """Return LANDMARKS or MARKERS, name -> vertex of the shared topology, built when first used."""
    if name == "LANDMARKS":
        return landmarks()
    if name == "MARKERS":
        return markers()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
