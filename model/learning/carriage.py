"""A template with the rotations that carry its triangles, and all that does not change while a model is learned."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from ..carriers import Carrier, build_basis, carried_terms, make_carriers
from ..gradients import edges, local_edges
from ..linear import Subject
from ..pose_space import PoseSpace
from ..stitching import StitchingSystem


@dataclass(frozen=True, eq=False)
class Carriage:
    """How rotations carry the triangles of a template.

    Parameters
    ----------
    template : Mesh
    skeleton : Skeleton
    weights : (F, J) float
        How much each rotation carries of each triangle.
    """

    template: Mesh
    skeleton: Skeleton
    weights: np.ndarray

    @cached_property
    def carriers(self) -> list[Carrier]:
        return make_carriers(self.skeleton, self.weights)

    @cached_property
    def system(self) -> StitchingSystem:
        return StitchingSystem(self.template, self.skeleton)

    @cached_property
    def v_hat(self) -> np.ndarray:
        return edges(self.template.vertices, self.template.faces)

    def turned(self, pose: np.ndarray) -> np.ndarray:
        """(F, 3, 3) rotation, or mixture of rotations, of every triangle at one pose (J, 3)."""
        return np.tensordot(self.weights, self.skeleton.part_rotations(pose), axes=1)

    def local_edges(self, bodies: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Edges (M, F, 2, 3) of bodies (M, N, 3), or of differences, as they were before rotations carried them.

        [SCAPE] Eq. 1
        """
        out = np.empty((len(bodies), *self.v_hat.shape))
        for i, (y, pose) in enumerate(zip(bodies, poses, strict=True)):
            out[i] = local_edges(y, self.template.faces, np.swapaxes(np.linalg.inv(self.turned(pose)), -1, -2))
        return out

    def stitched(self, Q: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Vertices (N, 3) of the template's own body for Q (F, 3, 3) at one pose, the root's joint in the origin.

        [SCAPE] Eq. 2
        """
        return self.system.stitch(self.v_hat @ np.swapaxes(self.turned(pose) @ Q, -1, -2))

    def subject(self, space: PoseSpace, S: np.ndarray | None = None) -> Subject:
        """A body with a pose space in the making, the template's own unless S (F, 3, 3) is given."""
        S = np.broadcast_to(np.eye(3), (len(self.template.faces), 3, 3)) if S is None else S
        basis = build_basis(self.system, self.template, space, S, self.carriers)
        return Subject(self.template, self.skeleton, None, carried_terms(space.features, self.carriers), basis,
                       self.skeleton.joints[0])
