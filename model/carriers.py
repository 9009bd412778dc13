"""Which rotations carry which triangles, and the basis of the fast path that follows from it.

In SCAPE a triangle is carried by the rotation of its part. In BlendSCAPE the triangles near a border are carried by
a mixture of rotations, `Σ_p w_kp R_p` [BlendSCAPE]. Both are lists of carriers, and nothing below tells them apart.
"""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .features import PoseFeatures, Terms
from .gradients import edges
from .linear import check_points
from .pose_space import PoseSpace
from .shape_space import ShapeSpace
from .stitching import StitchingSystem


@dataclass(frozen=True, eq=False)
class Carrier:
    """Triangles of one part that the rotation of one part carries.

    Parameters
    ----------
    part : int
        The part that the triangles belong to: its features deform them.
    turned_by : int
        The part whose rotation it is.
    chosen : (f,) int
        Places of the triangles among those of their part.
    weights : (f,) float
        How much of each triangle the rotation carries.
    """

    part: int
    turned_by: int
    chosen: np.ndarray
    weights: np.ndarray


def rigid_weights(skeleton: Skeleton) -> np.ndarray:
    """(F, J) weights that leave every triangle to the rotation of its own part."""
    return np.eye(len(skeleton.parents))[skeleton.part_of_face]


def make_carriers(skeleton: Skeleton, weights: np.ndarray) -> list[Carrier]:
    """The carriers of rotation weights (F, J), whose rows sum to 1."""
    carriers = []
    for p in range(len(skeleton.parents)):
        mine = weights[skeleton.part_of_face == p]
        for q in np.flatnonzero((mine != 0).any(axis=0)):
            chosen = np.flatnonzero(mine[:, q])
            carriers.append(Carrier(p, int(q), chosen, mine[chosen, q]))
    return carriers


def carried_terms(features: PoseFeatures, carriers: list[Carrier]) -> Terms:
    """The products of features and rotations that the carriers need, carrier by carrier."""
    each = [np.arange(features.count)[features.of_part(c.part)] for c in carriers]
    return Terms(features, np.repeat([c.turned_by for c in carriers], [len(e) for e in each]), np.concatenate(each))


def build_basis(system: StitchingSystem, template: Mesh, space: PoseSpace, S: np.ndarray, carriers: list[Carrier]
                ) -> np.ndarray:
    """T of every term for one body.

    Parameters
    ----------
    S : (F, 3, 3) float
        Shape deformation of every triangle.

    Returns
    -------
    (M, N, 3) float, metres

    [SCAPE] Eq. 9
    """
    v_hat, G = edges(template.vertices, template.faces), system.edge_operator
    blocks = []
    for carrier in carriers:
        faces, a = _carried(space, carrier)
        wanted = (v_hat[faces] * carrier.weights[:, None, None]) @ np.swapaxes(S[faces] @ a, -1, -2)  # (n, f, 2, 3)
        rows = (2 * faces[:, None] + np.arange(2)).ravel()
        columns = wanted.reshape(len(a), -1, 3).transpose(1, 0, 2).reshape(len(rows), -1)
        blocks.append((G[rows].T @ columns).reshape(system.n_vertices, len(a), 3))
    rhs = np.concatenate(blocks, axis=1)
    return system.solve(rhs.reshape(system.n_vertices, -1)).reshape(rhs.shape).transpose(1, 0, 2)


def build_shaped_points(system: StitchingSystem, template: Mesh, space: PoseSpace, shape_space: ShapeSpace,
                        carriers: list[Carrier], origin: np.ndarray, vertex_ids: np.ndarray,
                        weights: np.ndarray | None = None) -> ShapedPoints:
    """Stitch backwards from the points: what each triangle's edges contribute to each of them."""
    ids, weights = check_points(system.n_vertices, vertex_ids, weights)
    if weights is None:
        ids, weights = ids[:, None], np.ones((len(ids), 1))
    pick = np.zeros((system.n_vertices, len(ids)))
    np.add.at(pick, (ids, np.arange(len(ids))[:, None]), weights)
    reach = system.edge_operator @ system.solve_adjoint(pick)                # (2F, L)
    v_hat = edges(template.vertices, template.faces)
    shapes = [np.broadcast_to(np.eye(3), (len(v_hat), 3, 3)), shape_space.mean, *shape_space.components]
    blocks = []
    for carrier in carriers:
        faces, a = _carried(space, carrier)
        posed = (v_hat[faces] * carrier.weights[:, None, None]) @ np.swapaxes(a, -1, -2)              # (n, f, 2, 3)
        posed = posed.transpose(1, 2, 0, 3).reshape(len(faces), -1, 3)                                # (f, 2n, 3)
        mine = np.ascontiguousarray(reach[(2 * faces[:, None] + np.arange(2)).ravel()].T)
        block = np.empty((len(shapes), len(a), len(ids), 3))
        for k, S in enumerate(shapes):
            # one wide product a shape: a stack of products with three columns each takes four times as long
            wanted = (posed @ np.swapaxes(S[faces], -1, -2)).reshape(2 * len(faces), -1)
            block[k] = (mine @ wanted).reshape(len(ids), len(a), 3).transpose(1, 0, 2)
        blocks.append(block)
    basis = np.concatenate(blocks, axis=1)
    return ShapedPoints(carried_terms(space.features, carriers), basis[0], basis[1], basis[2:], origin)


def _carried(space: PoseSpace, carrier: Carrier) -> tuple[np.ndarray, np.ndarray]:
    """The triangles (f,) of a carrier and their coefficients (n, f, 3, 3)."""
    faces = space.faces_of_part[carrier.part][carrier.chosen]
    return faces, space.coefficients[carrier.part][:, carrier.chosen].astype(np.float64)
