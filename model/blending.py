"""Triangles that follow the rotations of parts by blend weights, and the basis of the fast path that follows from it.

In SCAPE a triangle rotates with its part. In BlendSCAPE the triangles near a border follow a mixture of rotations,
`Σ_p w_kp R_p` [BlendSCAPE]. Both are weights (F, J), and nothing below tells them apart.
"""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .condensed import Condensation, Condensed, ShapedCondensed, slices
from .features import PoseFeatures
from .gradients import edges
from .linear import Subject
from .pose_space import PoseSpace
from .products import Terms
from .shape_space import ShapeSpace
from .stitching import StitchingSystem


@dataclass(frozen=True, eq=False)
class Block:
    """Triangles of one part, `chosen` (f,) among them, that follow the rotation of one part by `weights` (f,)."""

    part: int
    rotation: int
    chosen: np.ndarray
    weights: np.ndarray


def rigid_weights(skeleton: Skeleton) -> np.ndarray:
    """(F, J) weights that leave every triangle to the rotation of its own part."""
    return np.eye(len(skeleton.parents))[skeleton.part_of_face]


@dataclass(frozen=True, eq=False)
class BlendedTemplate:
    """A template and how much (F, J) each rotation counts for each triangle, rows summing to 1."""

    template: Mesh
    skeleton: Skeleton
    weights: np.ndarray

    @cached_property
    def blocks(self) -> list[Block]:
        """Which triangles follow which rotation."""
        found = []
        for p in range(len(self.skeleton.parents)):
            mine = self.weights[self.skeleton.part_of_face == p]
            for q in np.flatnonzero((mine != 0).any(axis=0)):
                chosen = np.flatnonzero(mine[:, q])
                found.append(Block(p, int(q), chosen, mine[chosen, q]))
        return found

    @cached_property
    def stitching(self) -> StitchingSystem:
        """The stitching system of the template, factored once."""
        return StitchingSystem(self.template, self.skeleton)

    @cached_property
    def v_hat(self) -> np.ndarray:
        """(F, 2, 3) edges of the template, metres."""
        return edges(self.template.vertices, self.template.faces)

    @cached_property
    def _kinds(self) -> tuple[np.ndarray, np.ndarray]:
        """Weights (K, J) that differ, and which of them every triangle (F,) has: whole parts turn alike."""
        kinds, which = np.unique(self.weights, axis=0, return_inverse=True)
        return kinds, which.ravel()

    def rotations(self, pose: np.ndarray) -> np.ndarray:
        """(F, 3, 3) rotation, or mixture of rotations, of every triangle at one pose (J, 3)."""
        kinds, which = self._kinds
        return np.tensordot(kinds, self.skeleton.part_rotations(pose), axes=1)[which]

    def deform_edges(self, Q: np.ndarray) -> np.ndarray:
        """`Q v̂` (..., F, 2, 3) for Q (..., F, 3, 3)."""
        return self.v_hat @ np.swapaxes(Q, -1, -2)

    def local_edges(self, vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Edges `R⁻¹ v` (..., F, 2, 3) of a body (..., N, 3), or of a difference, seen from the parts at a pose (J, 3).

        Or (M, F, 2, 3) of bodies (M, N, 3) at as many poses.

        [SCAPE] Eq. 1
        """
        if pose.ndim == 3:
            return np.stack([self.local_edges(y, p) for y, p in zip(vertices, pose, strict=True)])
        kinds, which = self._kinds
        back = np.linalg.inv(np.tensordot(kinds, self.skeleton.part_rotations(pose), axes=1))
        return edges(vertices, self.template.faces) @ np.swapaxes(back, -1, -2)[which]

    def stitch(self, Q: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Vertices (N, 3) for Q, or S Q, (F, 3, 3) at one pose, the root's joint in the origin.

        [SCAPE] Eq. 2
        """
        return self.stitching.stitch(self.deform_edges(self.rotations(pose) @ Q))

    def terms(self, features: PoseFeatures) -> Terms:
        """The products of features and rotations in which a body is linear, block by block."""
        each = [np.arange(features.count)[features.of_part(block.part)] for block in self.blocks]
        return Terms(features, np.repeat([block.rotation for block in self.blocks], [len(e) for e in each]),
                     np.concatenate(each))

    @cached_property
    def condensation(self) -> Condensation:
        """The stitching system, condensed onto the borders of the parts."""
        return Condensation(self.template.faces, self.skeleton.part_of_face, self.stitching.root_weights)

    def operator(self, space: PoseSpace, S: np.ndarray) -> Condensed:
        """All vertices of one body with shape deformation S (F, 3, 3).

        [SCAPE] Eq. 9
        """
        tables = tuple(self._tables(space, S[None], p)[0] for p in range(len(self.skeleton.parents)))
        return Condensed(self.condensation, self.terms(space.features), tables, self.skeleton.joints[0])

    def as_shaped(self, space: PoseSpace, shapes: ShapeSpace) -> ShapedCondensed:
        """All vertices as a function of pose and betas.

        [SCAPE] Eq. 9
        """
        own, mean = (self.operator(space, S) for S in (shapes.gradients(None), shapes.mean))
        flat = np.empty((shapes.count, sum(table.size for table in mean.tables)))
        for p, some in enumerate(slices([table.size for table in mean.tables])):
            flat[:, some] = self._tables(space, shapes.components, p).reshape(shapes.count, -1)
        return ShapedCondensed(own, mean, flat)

    def _tables(self, space: PoseSpace, S: np.ndarray, p: int) -> np.ndarray:
        """(K, M_p, 3, i_p + loads_p) metres: what the products of part p contribute for shapes S (K, F, 3, 3)."""
        part, blocks = self.condensation.parts[p], [block for block in self.blocks if block.part == p]
        rows, counts = len(part.inside) + len(part.loads), [len(space.coefficients[p])] * len(blocks)
        out = np.empty((len(S), sum(counts), 3, rows))
        for block, some in zip(blocks, slices(counts), strict=True):
            faces, a = _coefficients(space, block)
            posed = (self.v_hat[faces] * block.weights[:, None, None]) @ np.swapaxes(a, -1, -2)       # (n, f, 2, 3)
            posed = posed.transpose(1, 2, 0, 3).reshape(len(faces), -1, 3)                            # (f, 2n, 3)
            for start in range(0, len(S), 8):                       # as many columns as are solved for together
                shapes = S[start:start + 8, faces].transpose(1, 3, 0, 2)                              # (f, 3, k, 3)
                wanted = np.zeros((len(part.faces), 2 * len(a), 3 * shapes.shape[2]))
                wanted[block.chosen] = posed @ shapes.reshape(len(faces), 3, -1)
                found = part.table(wanted.reshape(2 * len(part.faces), -1)).reshape(rows, len(a), -1, 3)
                out[start:start + 8, some] = found.transpose(2, 1, 3, 0)
        return out

    def subject(self, space: PoseSpace, S: np.ndarray | None = None) -> Subject:
        """A body with a pose space in the making, the template's own unless S (F, 3, 3) is given."""
        S = np.broadcast_to(np.eye(3), (len(self.template.faces), 3, 3)) if S is None else S
        return Subject(self.template, self.skeleton, None, self.operator(space, S))


def _coefficients(space: PoseSpace, block: Block) -> tuple[np.ndarray, np.ndarray]:
    """The triangles (f,) of a block and their coefficients (n, f, 3, 3)."""
    faces = space.faces_of_part[block.part][block.chosen]
    return faces, space.coefficients[block.part][:, block.chosen].astype(np.float64)
