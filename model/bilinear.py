"""Some surface points of a body whose shape is free: bilinear in (1, β) and the features δ."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.geometry.mesh import Mesh

from .gradients import edges
from .linear import PointOperator, check_points, posed_product
from .pose_space import JointFeatures, PoseSpace
from .shape_space import ShapeSpace
from .stitching import StitchingSystem


@dataclass(frozen=True, eq=False)
class ShapedPoints:
    """Surface points as a function of pose, betas and place, with derivatives.

    Parameters
    ----------
    features : JointFeatures
    template_basis, mean_basis : (A, L, 3) float, metres
        The basis of the template's own body and of the mean person.
    shape_basis : (K, A, L, 3) float, metres
        Change of the basis for one standard deviation of each beta.
    origin : (3,) float, metres
    """

    features: JointFeatures
    template_basis: np.ndarray
    mean_basis: np.ndarray
    shape_basis: np.ndarray
    origin: np.ndarray

    def operator(self, betas: np.ndarray | None = None) -> PointOperator:
        """The points of the body with betas (k,), k ≤ K; None is the template's own body."""
        if betas is None:
            return PointOperator(self.features, self.template_basis, self.origin)
        betas = np.asarray(betas, dtype=np.float64)
        if betas.ndim != 1 or len(betas) > len(self.shape_basis):
            raise ValueError(f"betas: expected at most {len(self.shape_basis)} numbers, got shape {betas.shape}")
        change = np.tensordot(betas, self.shape_basis[:len(betas)], axes=1)
        return PointOperator(self.features, self.mean_basis + change, self.origin)

    def shape_jacobian(self, pose: np.ndarray) -> np.ndarray:
        """Derivative (L, 3, K) of the points with respect to betas at a pose (J, 3), metres."""
        K, _, L, _ = self.shape_basis.shape
        by_beta = posed_product(self.features, self._flat, np.asarray(pose, dtype=np.float64)).reshape(3, K, L)
        return by_beta.transpose(2, 0, 1)

    @cached_property
    def _flat(self) -> np.ndarray:
        K, A, L, _ = self.shape_basis.shape
        return np.ascontiguousarray(self.shape_basis.transpose(1, 3, 0, 2)).reshape(3 * A, K * L)


def build_shaped_points(system: StitchingSystem, template: Mesh, pose_space: PoseSpace, shape_space: ShapeSpace,
                        origin: np.ndarray, vertex_ids: np.ndarray, weights: np.ndarray | None = None
                        ) -> ShapedPoints:
    """Stitch backwards from the points: what each triangle's edges contribute to each of them."""
    ids, weights = check_points(system.n_vertices, vertex_ids, weights)
    if weights is None:
        ids, weights = ids[:, None], np.ones((len(ids), 1))
    pick = np.zeros((system.n_vertices, len(ids)))
    np.add.at(pick, (ids, np.arange(len(ids))[:, None]), weights)
    reach = system.edge_operator @ system.solve_adjoint(pick)                # (2F, L)
    v_hat = edges(template.vertices, template.faces)
    features = pose_space.features
    shapes = np.concatenate([np.broadcast_to(np.eye(3), (1, len(v_hat), 3, 3)), shape_space.mean[None],
                             shape_space.components])
    basis = np.empty((len(shapes), features.count, len(ids), 3))
    for p, faces in enumerate(pose_space.faces_of_part):
        a = pose_space.coefficients[p].astype(np.float64)
        posed = v_hat[faces] @ np.swapaxes(a, -1, -2)                        # (n, f, 2, 3)
        mine = reach[(2 * faces[:, None] + np.arange(2)).ravel()].T
        for k, S in enumerate(shapes):
            wanted = (posed @ np.swapaxes(S[faces], -1, -2)).reshape(len(a), -1, 3)
            basis[k, features.of_part(p)] = mine @ wanted
    return ShapedPoints(features, basis[0], basis[1], basis[2:], origin)
