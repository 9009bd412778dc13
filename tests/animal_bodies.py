"""Four-legged animals with a known skeleton, in any pose, all with one triangulation.

Built from the implicit surfaces of `scanprep.scanning`. Nothing stands upright or looks along an axis: every body is
turned by an odd rotation, and the head is carried to one side unless told otherwise.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from implicit_surface import Field, Group, RoundCone, polygonise, project

from scanprep.decimation.decimate import decimate
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

NAMES = ("barrel", "neck", "head", "tail", "fore left", "fore left cannon", "fore right", "fore right cannon",
         "hind left", "hind left cannon", "hind right", "hind right cannon")
PARENTS = np.array([-1, 0, 1, 0, 0, 4, 0, 6, 0, 8, 0, 10])
ODD = rotations.exp(np.array([0.7, -0.4, 1.1]))
SOFT = 0.025                         # metres over which the motion of one part passes into that of the next


@dataclass(frozen=True)
class Build:
    """How one animal differs from another, each about 1; `aside` 0 makes it symmetric."""

    length: float = 1.0
    girth: float = 1.0
    legs: float = 1.0
    neck: float = 1.0
    head: float = 1.0
    tail: float = 1.0
    aside: float = 1.0

    @staticmethod
    def random(rng: np.random.Generator) -> Build:
        return Build(*(1 + 0.12 * np.clip(rng.normal(size=6), -2, 2)))


class Animal:
    """One animal at rest, and in any pose.

    Attributes
    ----------
    bones : (12, 2, 3) float, metres, from the joint of each part to its end, before the odd rotation
    radii : (12, 2) float, metres
    """

    def __init__(self, build: Build | None = None) -> None:
        b = build or Build()
        x, w = 0.42 * b.length, 0.11 * b.girth
        tips = {0: ((-x, 0, 0), (x, 0, 0.02))}
        tips[1] = ((x, 0, 0.06), (x + 0.26 * b.neck, 0.07 * b.aside, 0.06 + 0.30 * b.neck))
        nape = np.array(tips[1][1])
        tips[2] = (nape, nape + b.head * np.array([0.24, 0.09 * b.aside, -0.04]))
        tips[3] = ((-x - 0.06, 0, 0.03), (-x - 0.06 - 0.34 * b.tail, 0, -0.16 * b.tail))
        for k, (front, side) in enumerate(((1, 1), (1, -1), (-1, 1), (-1, -1))):
            top = np.array([front * 0.9 * x, side * w, -0.09])
            knee = top + b.legs * np.array([0.03 * front, 0.01 * side, -0.32])
            tips[4 + 2 * k] = (top, knee)
            tips[5 + 2 * k] = (knee, knee + b.legs * np.array([-0.03, 0, -0.31]))
        self.bones = np.array([tips[p] for p in range(12)], dtype=np.float64)
        g = b.girth
        self.radii = np.array([(0.17 * g, 0.16 * g), (0.10 * g, 0.075 * g), (0.085 * b.head, 0.05 * b.head),
                               (0.05, 0.03), *[(0.075 * g, 0.05), (0.05, 0.042)] * 4])

    @cached_property
    def parts(self) -> list[RoundCone]:
        return [RoundCone(a, b, *r) for (a, b), r in zip(self.bones, self.radii, strict=True)]

    @cached_property
    def field(self) -> Field:
        return Group([(part, 0.05) for part in self.parts])

    @cached_property
    def straight(self) -> Mesh:
        """At rest before the odd rotation: vertices moved with the bones, then put on the surface."""
        mesh, first = template(), Animal()
        weights, moved = blend(mesh.vertices), np.zeros_like(mesh.vertices)
        for p in range(12):
            change = _frame(self.bones[p], self.radii[p]) @ np.linalg.inv(_frame(first.bones[p], first.radii[p]))
            moved += weights[:, p:p + 1] * ((mesh.vertices - first.bones[p, 0]) @ change.T + self.bones[p, 0])
        return Mesh(project(self.field, moved, 6), mesh.faces)

    @cached_property
    def mesh(self) -> Mesh:
        return Mesh(self.straight.vertices @ ODD.T, self.straight.faces)

    @cached_property
    def skeleton(self) -> Skeleton:
        """The true parts and joints, on `mesh`."""
        centre = template().corners.mean(axis=1)
        parts, joints = blend(centre).argmax(axis=1), self.bones[:, 0] @ ODD.T
        in_barrel = Skeleton(parts, PARENTS, joints, NAMES).part_of_vertex(self.mesh) == 0
        joints[0] = self.mesh.vertices[in_barrel].mean(axis=0)
        return Skeleton(parts, PARENTS, joints, NAMES)

    def posed(self, pose: np.ndarray) -> np.ndarray:
        """Vertices (N, 3) in a pose (12, 3), radians: parts blended, and muscles that swell where a joint bends."""
        weights, rest = blend(template().vertices), self.straight
        R = self.skeleton.part_rotations(pose)
        bend = 1 - np.cos(np.linalg.norm(pose, axis=1))
        near = np.exp(-((rest.vertices[:, None] - self.bones[:, :1].transpose(1, 0, 2)) ** 2).sum(axis=2) / 0.08**2)
        x = (rest.vertices + ((near[:, 1:] @ bend[1:]) * 0.02)[:, None] * rest.vertex_normals) @ ODD.T
        joints, place = self.bones[:, 0] @ ODD.T, np.zeros((12, 3))
        place[0] = joints[0]
        for j in range(1, 12):
            place[j] = place[PARENTS[j]] + R[PARENTS[j]] @ (joints[j] - joints[PARENTS[j]])
        return sum(weights[:, p:p + 1] * ((x - joints[p]) @ R[p].T + place[p]) for p in range(12))


def random_pose(rng: np.random.Generator) -> np.ndarray:
    """A pose (12, 3), radians, of a walking, looking, tail-wagging animal that also turns as a whole."""
    return rng.normal(size=(12, 3)) * np.r_[0.5, 0.3, 0.3, 0.5, [0.35, 0.45] * 4][:, None]


def blend(points: np.ndarray) -> np.ndarray:
    """Smooth weights (n, 12) of the parts at points (n, 3) on the first animal, among neighbours in the tree."""
    far = np.stack([part(points) for part in Animal().parts], axis=1)
    nearest = far.argmin(axis=1)
    linked = np.eye(12, dtype=bool)
    linked[np.arange(1, 12), PARENTS[1:]] = linked[PARENTS[1:], np.arange(1, 12)] = True
    weights = np.exp(-(far - far.min(axis=1, keepdims=True)) / SOFT) * linked[nearest]
    return weights / weights.sum(axis=1, keepdims=True)


@lru_cache(maxsize=1)
def template() -> Mesh:
    """The shared triangulation on the first animal, before the odd rotation."""
    first = Animal()
    rough = polygonise(first.field, np.array([-1.2, -0.4, -0.95]), np.array([1.2, 0.4, 0.7]), 0.03)
    mesh = decimate(rough, 1200)
    for _ in range(6):                                          # even triangles, slid along the surface
        mean = mesh.vertex_adjacency @ mesh.vertices / mesh.vertex_adjacency.sum(axis=1)[:, None]
        step, normal = mean - mesh.vertices, mesh.vertex_normals
        step -= (step * normal).sum(axis=1, keepdims=True) * normal
        mesh = Mesh(project(first.field, mesh.vertices + 0.5 * step, 2), mesh.faces)
    return mesh


def _frame(bone: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """(3, 3) columns: along the bone by its length, across it by its thickness."""
    along = bone[1] - bone[0]
    side = np.cross(along, [0.13, 0.99, 0.07])
    side /= np.linalg.norm(side)
    up = np.cross(side, along) / np.linalg.norm(along)
    return np.stack([along, side * radii.mean(), up * radii.mean()], axis=1)
