"""The topology that all synthetic people share, and how much each part carries of its vertices."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.sparse import csr_array, diags_array

from ..geometry.mesh import Mesh
from ..geometry.sparse import factor
from ..skeleton.tree import Skeleton
from .anatomy import MIRROR_PART, PARENTS, BodyShape, RestFrames
from .population import population


@dataclass(frozen=True, eq=False)
class Template:
    """The shared triangulation on the average of women and men."""

    mesh: Mesh
    mirror: np.ndarray  # (N,) int: the vertex at the mirrored place
    part_of_face: np.ndarray  # (F,) int
    anatomy: RestFrames

    @cached_property
    def part_of_vertex(self) -> np.ndarray:
        """(N,) int: the part of most triangles around each vertex."""
        return Skeleton(self.part_of_face, PARENTS, self.anatomy.joints).part_of_vertex(self.mesh)


@lru_cache(maxsize=1)
def load_topology() -> Template:
    """Return the template of the built-in people."""
    people = population()
    anatomy = RestFrames(BodyShape("male", (0.0,)))
    mesh = Mesh(anatomy.vertices, people.faces)
    part = label_faces(mesh, anatomy, people.weights)
    # copy the parts of the left half to the right, as rounding could break the symmetry at borders
    left = mesh.corners.mean(axis=1)[:, 0] > 0
    twin = {tuple(sorted(face)): f for f, face in enumerate(people.mirror[people.faces].tolist())}
    other = np.array([twin[tuple(sorted(face))] for face in people.faces.tolist()])
    part[~left] = MIRROR_PART[part[other[~left]]]
    return Template(mesh, people.mirror, part, anatomy)


def label_faces(mesh: Mesh, anatomy: RestFrames, weights: np.ndarray) -> np.ndarray:
    """Assign triangles (F,) of the left half to parts: cut by a plane through each joint, arms by weights."""
    # c: centres of the triangles; j: joints
    c, j = mesh.corners.mean(axis=1), anatomy.joints
    arm = weights[mesh.faces][:, :, 4:7].sum(axis=(1, 2)) > 0.75              # a quarter of each corner
    part = np.zeros(len(c), dtype=np.int64)

    def beyond(joint: int, normal: np.ndarray, by: float = 0.0) -> np.ndarray:
        """Return which triangles lie beyond a plane through a joint."""
        return (c - j[joint]) @ normal > by * anatomy.scale

    # markers sit on the crest of the hip bone and on the ends of forearm and shin: these stay on the part of their bone
    part[c[:, 2] > j[1, 2] + 0.005 * anatomy.scale] = 1
    part[c[:, 2] > j[2, 2]] = 2
    part[beyond(3, np.array([0, -0.35, 1.0])) & (np.abs(c[:, 0]) < 0.12)] = 3
    # the shoulder is cut from the armpit outwards and up
    up = anatomy.upper_arm_frame[2]
    armpit = j[4] - [0.012 * anatomy.scale, 0, 0]
    own_faces = arm & ((c - armpit) @ (0.75 * up + 0.66 * np.array([1, 0, 0.25])) > 0)
    part[own_faces] = 4
    part[own_faces & beyond(5, up + anatomy.forearm_frame[2])] = 5
    part[own_faces & beyond(6, anatomy.forearm_frame[2], 0.018)] = 6
    # the hip from the groin to its crest
    own_faces = ((c - j[10]) @ np.array([0.72, 0, -1.0]) > 0) & (c[:, 0] > 0) & (c[:, 2] < j[0, 2] + 0.02) & ~arm
    part[own_faces] = 10
    part[own_faces & (c[:, 2] < j[11, 2])] = 11
    part[own_faces & beyond(12, np.array([0, -0.3, -1.0]), 0.012)] = 12         # with all of the heel
    return part


@lru_cache(maxsize=1)
def blending() -> tuple[np.ndarray, np.ndarray]:
    """Compute smooth part weights (N, 16) on the shared topology: for carrying, and for posing."""
    template = load_topology()
    mesh = template.mesh
    count = len(mesh.vertices)
    # share of each part in the area around a vertex
    share = np.zeros((count, len(PARENTS)))
    for corner in range(3):
        np.add.at(share, (mesh.faces[:, corner], template.part_of_face), mesh.face_areas / 3)
    share /= share.sum(axis=1, keepdims=True)
    a, b = mesh.edges.T
    # metres over which the motion of one part blends into the next, by joint; a vertex takes that of the nearest joints
    widths = {1: 0.075, 2: 0.075, 3: 0.040, 4: 0.052, 5: 0.030, 6: 0.020, 10: 0.080, 11: 0.034, 12: 0.020}
    v = np.abs(template.mesh.vertices * [1, 0, 0]) + template.mesh.vertices * [0, 1, 1]
    distances = np.stack([np.linalg.norm(v - template.anatomy.joints[j], axis=1) for j in widths], axis=1)
    near = np.exp(-0.5 * ((distances - distances.min(axis=1, keepdims=True)) / 0.04)**2)
    width = near @ np.array(list(widths.values())) / near.sum(axis=1)
    results = []
    # diffuse the shares over the surface, over that width (two implicit steps)
    for spread in (1.3, 1.0):
        coupling = (spread * 0.5 * (width[a] + width[b]) / mesh.edge_lengths)**2 / 6
        A = csr_array((np.r_[coupling, coupling], (np.r_[a, b], np.r_[b, a])), shape=(count, count))
        solve = factor((diags_array(1 + A.sum(axis=1)) - A).tocsc())
        weights = solve(solve(share))
        results.append(weights / weights.sum(axis=1, keepdims=True))
    return results[0], results[1]


@lru_cache(maxsize=1)
def neighbour_mean() -> csr_array:
    """Return the operator (N, N) that averages the neighbours of a vertex."""
    A = load_topology().mesh.vertex_adjacency
    return csr_array(diags_array(1 / A.sum(axis=1)) @ A)
