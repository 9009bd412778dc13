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
    """Triangles of a part that follow one rotation: `chosen` (f,), by number in the part, with `weights` (f,)."""

    part: int
    rotation: int
    chosen: np.ndarray
    weights: np.ndarray


def rigid_weights(skeleton: Skeleton) -> np.ndarray:
    """Return weights (F, J) that give every triangle the rotation of its own part, as in SCAPE."""
    return np.eye(len(skeleton.parents))[skeleton.part_of_face]


@dataclass(frozen=True, eq=False)
class BlendedTemplate:
    """A template with blend weights (F, J) of the part rotations for each triangle; rows sum to 1."""

    template: Mesh
    skeleton: Skeleton
    weights: np.ndarray

    @cached_property
    def blocks(self) -> list[Block]:
        """Which triangles follow which rotation."""
        blocks = []
        for p in range(len(self.skeleton.parents)):
            of_part = self.weights[self.skeleton.part_of_face == p]
            for q in np.flatnonzero((of_part != 0).any(axis=0)):
                chosen = np.flatnonzero(of_part[:, q])
                blocks.append(Block(p, int(q), chosen, of_part[chosen, q]))
        return blocks

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
        """The distinct rows of weights (K, J), and the row that each triangle has (F,): most triangles share one."""
        kinds, which = np.unique(self.weights, axis=0, return_inverse=True)
        return kinds, which.ravel()

    def rotations(self, pose: np.ndarray) -> np.ndarray:
        """Compute the rotation, or blend of rotations, of every triangle (F, 3, 3) at one pose (J, 3)."""
        kinds, which = self._kinds
        return np.tensordot(kinds, self.skeleton.part_rotations(pose), axes=1)[which]

    def deform_edges(self, Q: np.ndarray) -> np.ndarray:
        """Compute the deformed template edges `Q v̂` (..., F, 2, 3) for Q (..., F, 3, 3)."""
        return self.v_hat @ np.swapaxes(Q, -1, -2)

    def local_edges(self, vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Compute the edges `R⁻¹ v` (..., F, 2, 3) of a body (..., N, 3) in the frames of the parts at a pose (J, 3).

        A difference of two bodies works too. For M poses (M, J, 3) and bodies (M, N, 3) the result is (M, F, 2, 3).

        [SCAPE] Eq. 1
        """
        if pose.ndim == 3:
            return np.stack([self.local_edges(y, p) for y, p in zip(vertices, pose, strict=True)])
        kinds, which = self._kinds
        back = np.linalg.inv(np.tensordot(kinds, self.skeleton.part_rotations(pose), axes=1))
        return edges(vertices, self.template.faces) @ np.swapaxes(back, -1, -2)[which]

    def stitch(self, Q: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Find the vertices (N, 3) for Q, or S Q, (F, 3, 3) at one pose (J, 3); the root's joint is in the origin.

        [SCAPE] Eq. 2
        """
        return self.stitching.stitch(self.deform_edges(self.rotations(pose) @ Q))

    def terms(self, features: PoseFeatures) -> Terms:
        """List the products of features and rotations in which a body is linear, block by block."""
        each = [np.arange(features.count)[features.of_part(block.part)] for block in self.blocks]
        return Terms(features, np.repeat([block.rotation for block in self.blocks], [len(e) for e in each]),
                     np.concatenate(each))

    @cached_property
    def condensation(self) -> Condensation:
        """The stitching system, condensed onto the borders of the parts."""
        return Condensation(self.template.faces, self.skeleton.part_of_face, self.stitching.root_weights)

    def operator(self, space: PoseSpace, S: np.ndarray) -> Condensed:
        """Build the fast path of all vertices of one body with shape deformation S (F, 3, 3).

        [SCAPE] Eq. 9
        """
        tables = tuple(self._tables(space, S[None], p)[0] for p in range(len(self.skeleton.parents)))
        return Condensed(self.condensation, self.terms(space.features), tables, self.skeleton.joints[0])

    def as_shaped(self, space: PoseSpace, shapes: ShapeSpace) -> ShapedCondensed:
        """Build the fast path of all vertices as a function of pose and betas.

        [SCAPE] Eq. 9
        """
        own, mean = (self.operator(space, S) for S in (shapes.gradients(None), shapes.mean))
        # the tables of every part, one after the other, for each shape component
        flat = np.empty((shapes.count, sum(table.size for table in mean.tables)))
        for p, some in enumerate(slices([table.size for table in mean.tables])):
            flat[:, some] = self._tables(space, shapes.components, p).reshape(shapes.count, some.stop - some.start)
        return ShapedCondensed(own, mean, flat)

    def _tables(self, space: PoseSpace, S: np.ndarray, p: int) -> np.ndarray:
        """Compute the tables (K, M_p, 3, i_p + loads_p) of part p, metres, for shapes S (K, F, 3, 3).

        They hold what every product of a feature and a rotation contributes to the inside and the border of the part.
        """
        part, blocks = self.condensation.parts[p], [block for block in self.blocks if block.part == p]
        rows, counts = len(part.inside) + len(part.loads), [len(space.coefficients[p])] * len(blocks)
        out = np.empty((len(S), sum(counts), 3, rows))
        for block, some in zip(blocks, slices(counts), strict=True):
            # edges that one feature contributes before the shape: w_kp a_k v̂
            faces, a = _coefficients(space, block)
            posed = (self.v_hat[faces] * block.weights[:, None, None]) @ np.swapaxes(a, -1, -2)       # (n, f, 2, 3)
            posed = posed.transpose(1, 2, 0, 3).reshape(len(faces), -1, 3)                            # (f, 2n, 3)
            # S times these edges, then the solve of the part, for eight shapes at once as the solver takes columns
            for start in range(0, len(S), 8):
                shapes = S[start:start + 8, faces].transpose(1, 3, 0, 2)                              # (f, 3, k, 3)
                wanted = np.zeros((len(part.faces), 2 * len(a), 3 * shapes.shape[2]))
                wanted[block.chosen] = posed @ shapes.reshape(len(faces), 3, -1)
                solved = part.table(wanted.reshape(2 * len(part.faces), -1)).reshape(rows, len(a), -1, 3)
                out[start:start + 8, some] = solved.transpose(2, 1, 3, 0)
        return out

    def subject(self, space: PoseSpace, S: np.ndarray | None = None) -> Subject:
        """Build a subject for a pose space that is being learned; the template's own body unless S (F, 3, 3) is given.
        """
        S = np.broadcast_to(np.eye(3), (len(self.template.faces), 3, 3)) if S is None else S
        return Subject(self.template, self.skeleton, None, self.operator(space, S))


def _coefficients(space: PoseSpace, block: Block) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles (f,) of a block and their pose coefficients (n, f, 3, 3)."""
    faces = space.faces_of_part[block.part][block.chosen]
    return faces, space.coefficients[block.part][:, block.chosen].astype(np.float64)
