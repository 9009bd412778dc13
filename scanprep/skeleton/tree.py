"""The articulated skeleton: parts of the surface, a tree over them, and a joint for every link."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array, csr_array

from ..geometry import rotations, storage
from ..geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Rigid parts of a template and the tree that links them.

    All arrays are read-only.

    Parameters
    ----------
    part_of_face : (F,) int
        Part of every triangle, 0..J-1; every part has triangles.
    parents : (J,) int
        Parent before child; part 0 is the root and its own parent is -1.
    joints : (J, 3) float, metres
        Position on the template where part j is linked to its parent. `joints[0]` is the centroid of the vertices of
        part 0.
    names : tuple of J str, optional
        Different names of the parts; by default part0, part1, ...

    Raises
    ------
    ValueError
        Not a tree with parents first, an empty part, or shapes that do not agree.

    Examples
    --------
    >>> skeleton = Skeleton([0, 0, 1], parents=[-1, 0], joints=[[0, 0, 0], [0, 0, 1]], names=("trunk", "head"))
    >>> skeleton.part_rotations(np.zeros((2, 3))).shape
    (2, 3, 3)
    """

    VERSION = 1              # of the file format

    part_of_face: np.ndarray
    parents: np.ndarray
    joints: np.ndarray
    names: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        part_of_face = np.array(self.part_of_face, dtype=np.int64)
        parents = np.array(self.parents, dtype=np.int64)
        joints = np.array(self.joints, dtype=np.float64)
        J = len(parents)
        if parents.ndim != 1 or joints.shape != (J, 3):
            raise ValueError(f"joints: expected shape ({J}, 3) for {J} parents, got {joints.shape}")
        if not np.isfinite(joints).all():
            raise ValueError("joints: expected finite numbers")
        if not J or parents[0] != -1:
            raise ValueError("parents: expected part 0 to be the root, with parent -1")
        # a parent must come before its children
        wrong = np.flatnonzero((parents[1:] < 0) | (parents[1:] >= np.arange(1, J))) + 1
        if len(wrong):
            raise ValueError(f"parents: part {wrong[0]} has parent {parents[wrong[0]]}, "
                             f"expected a part listed before it")
        if part_of_face.ndim != 1 or set(np.unique(part_of_face)) != set(range(J)):
            raise ValueError(f"part_of_face: expected every part of 0..{J - 1} to have triangles, "
                             f"found {np.unique(part_of_face).tolist()}")
        # store read-only copies
        names = tuple(self.names) or number_parts(J)
        if len(names) != J or len(set(names)) != J or not all(isinstance(name, str) for name in names):
            raise ValueError(f"names: expected {J} different names, got {list(names)}")
        for name, value in (("part_of_face", part_of_face), ("parents", parents), ("joints", joints)):
            value.flags.writeable = False
            object.__setattr__(self, name, value)
        object.__setattr__(self, "names", names)

    def __repr__(self) -> str:
        return f"Skeleton({len(self.parents)} parts, {len(self.part_of_face)} faces)"

    @cached_property
    def joints_of_part(self) -> tuple[tuple[int, ...], ...]:
        """The joints of each part: its own (unless it is the root) and those of its children."""
        return tuple(tuple(j for j in range(1, len(self.parents)) if j == p or self.parents[j] == p)
                     for p in range(len(self.parents)))

    @cached_property
    def depths(self) -> list[np.ndarray]:
        """The parts by depth in the tree: the root, its children, and so on."""
        depth = self.descends.sum(axis=1) - 1
        return [np.flatnonzero(depth == d) for d in range(depth.max() + 1)]

    @cached_property
    def descends(self) -> np.ndarray:
        """(J, J) bool: [p, j] is true where part p is j or a descendant of it."""
        J = len(self.parents)
        below = np.eye(J, dtype=bool)
        for p in range(1, J):
            below[p] |= below[self.parents[p]]
        return below

    def part_of_vertex(self, mesh: Mesh) -> np.ndarray:
        """Return the part (N,) of most triangles around each vertex; ties go to the lowest number."""
        votes = np.zeros((len(mesh.vertices), len(self.parents)), dtype=np.int64)
        for corner in range(3):
            np.add.at(votes, (mesh.faces[:, corner], self.part_of_face), 1)
        return votes.argmax(axis=1)

    def ring(self, mesh: Mesh, j: int, widen: int = 0) -> np.ndarray:
        """Return the vertices (n,) where part j meets its parent, and those within `widen` edges of them."""
        touches = np.zeros((len(mesh.vertices), 2), dtype=bool)
        for side, part in enumerate((j, self.parents[j])):
            touches[mesh.faces[self.part_of_face == part].ravel(), side] = True
        ring = touches.all(axis=1).astype(float)
        for _ in range(widen):
            ring = ((ring > 0) | (mesh.vertex_adjacency @ ring > 0)).astype(float)
        return np.flatnonzero(ring)

    def joint_regressor(self, template: Mesh) -> csr_array:
        """Build sparse weights (J, N), each row summing to 1, with `regressor @ template.vertices == joints`.

        A joint is a fixed affine combination of the vertices around the ring where the parts meet, for the root the
        mean of its vertices. So `regressor @ vertices` are the joints of any posed or reshaped body.
        """
        rings, values = zip(*(self.joint_weights(template, j) for j in range(len(self.parents))), strict=True)
        rows = np.repeat(np.arange(len(rings)), [len(r) for r in rings])
        return csr_array(coo_array((np.concatenate(values), (rows, np.concatenate(rings))),
                                   shape=(len(rings), len(template.vertices))))

    def joint_weights(self, template: Mesh, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the vertices around joint j and their weights: one row of `joint_regressor`."""
        if j == 0:
            ring = np.flatnonzero(self.part_of_vertex(template) == 0)
        else:
            ring = self.ring(template, j, widen=2)
            if not len(ring):
                raise ValueError(f"part_of_face: part {j} does not touch its parent {self.parents[j]}")
        return ring, affine_weights(template.vertices[ring], self.joints[j])

    def part_rotations(self, pose: np.ndarray) -> np.ndarray:
        """Compute world rotations (..., J, 3, 3) of the parts for poses (..., J, 3), radians.

        `R_j = R_parent(j) exp(pose_j)`, `R_0 = exp(pose_0)`.
        """
        R = rotations.exp(pose)
        for parts in self.depths[1:]:                    # all parts of one depth at once
            R[..., parts, :, :] = R[..., self.parents[parts], :, :] @ R[..., parts, :, :]
        return R

    def pose_of(self, R: np.ndarray) -> np.ndarray:
        """Compute poses (..., J, 3), radians, from part rotations (..., J, 3, 3): the inverse of `part_rotations`."""
        relative = R.copy()
        child = np.arange(1, len(self.parents))
        relative[..., 1:, :, :] = np.swapaxes(R[..., self.parents[child], :, :], -1, -2) @ R[..., 1:, :, :]
        return rotations.log(relative)

    def fit_rotations(self, template: Mesh, vertices: np.ndarray) -> np.ndarray:
        """Fit the rotation of every part (..., J, 3, 3) from the template to vertices (..., N, 3), by Procrustes."""
        R = np.empty((*vertices.shape[:-2], len(self.parents), 3, 3))
        for p in range(len(self.parents)):
            own = np.unique(template.faces[self.part_of_face == p])
            R[..., p, :, :] = rotations.procrustes(
                np.broadcast_to(template.vertices[own], (*vertices.shape[:-2], len(own), 3)),
                vertices[..., own, :])[0]
        return R

    def with_root_centred(self, template: Mesh) -> Skeleton:
        """Return the skeleton with `joints[0]` at the centroid of the vertices of part 0."""
        joints = self.joints.copy()
        joints[0] = template.vertices[self.part_of_vertex(template) == 0].mean(axis=0)
        return Skeleton(self.part_of_face, self.parents, joints, self.names)

    def save(self, path: str | Path) -> None:
        """Write the skeleton as JSON."""
        storage.write_json(path, {
            "kind": "skeleton", "version": self.VERSION, "names": list(self.names), "parents": self.parents.tolist(),
            "joints": self.joints.tolist(), "part_of_face": self.part_of_face.tolist()})

    @staticmethod
    def load(path: str | Path) -> Skeleton:
        """Read a skeleton from a file of `save`; StorageError for anything else."""
        stored = storage.read_json(path, "a skeleton")
        if not isinstance(stored, dict) or stored.get("kind") != "skeleton":
            raise storage.StorageError(f"{path}: expected a skeleton in JSON, found something else")
        if stored.get("version") != Skeleton.VERSION:
            raise storage.StorageError(f"{path}: skeleton version {stored.get('version')} is not known here "
                                       f"(known: {Skeleton.VERSION})")
        with storage.taking_apart(path, "a whole skeleton"):
            return Skeleton(stored["part_of_face"], stored["parents"], stored["joints"], tuple(stored["names"]))


def number_parts(count: int) -> tuple[str, ...]:
    """Return names for parts without names."""
    return tuple(f"part{j}" for j in range(count))


def affine_weights(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute weights (n,) nearest to equal that sum to 1 and average `points` (n, 3) to `target` (3,)."""
    n = len(points)
    scale = np.linalg.norm(points - points.mean(axis=0), axis=1).mean()
    if not scale > 0:
        raise ValueError("joints: expected vertices around each joint that are not all at one place")
    # least change from equal weights, subject to sum 1 and the weighted mean at the target
    A = np.vstack([np.ones(n), (points - points.mean(axis=0)).T / scale])
    b = np.r_[1.0, (target - points.mean(axis=0)) / scale]
    start = np.full(n, 1 / n)
    return start + np.linalg.lstsq(A, b - A @ start, rcond=None)[0]


def reorder(part_of_face: np.ndarray, links: np.ndarray, root: int) -> np.ndarray:
    """Order parts (old numbers) with `root` first, parents before children, larger ones first; links are (J - 1, 2)."""
    size = np.bincount(part_of_face)
    order, seen = [root], {root}
    for part in order:
        near = {int(a + b - part) for a, b in links if part in (a, b)}
        order += sorted(near - seen, key=lambda q: (-size[q], q))
        seen |= near
    return np.array(order)
