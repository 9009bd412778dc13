"""Gradients of functions of all vertices, by going backwards through the model once."""
from __future__ import annotations

from functools import singledispatch

import numpy as np

from scanprep.geometry import rotations

from .body import BodyModel
from .scape import ScapeModel


@singledispatch
def pull_back(model: BodyModel, force: np.ndarray, pose: np.ndarray, betas: np.ndarray
              ) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (3J,), (k,) by pose (J, 3) and betas (k,) of a function with gradient `force` (N, 3) by the vertices.

    It costs about as much as the vertices themselves, where derivatives of all vertices cost twenty times that.
    """
    found = model.jacobian(pose, betas)
    return np.einsum("nd,ndp->p", force, found.pose), np.einsum("nd,ndk->k", force, found.betas)


@pull_back.register
def _(model: ScapeModel, force: np.ndarray, pose: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    skeleton, space, weights = model.skeleton, model.pose_space, model.blend_weights
    R, v_hat, Q = skeleton.part_rotations(pose), model.parts.v_hat, space.gradients(pose)
    pulled = (model.stitching.edge_operator @ model.stitching.solve_adjoint(force)).reshape(-1, 2, 3)
    S, posed = model.shape_space.gradients(betas), v_hat @ np.swapaxes(Q, -1, -2)                 # rows (Q v̂)ᵀ
    local = pulled @ np.tensordot(weights, R, axes=1)                                            # rows (Rᵀ z)ᵀ
    by_S = np.swapaxes(local, -1, -2) @ posed                                                    # Σ_j Rᵀ z (Q v̂)ᵀ
    by_Q = np.swapaxes(S, -1, -2) @ (np.swapaxes(local, -1, -2) @ v_hat)
    by_R = np.tensordot(weights, np.swapaxes(pulled, -1, -2) @ (posed @ np.swapaxes(S, -1, -2)), axes=(0, 0))
    components = model.shape_space.components[:len(betas)]
    by_betas = components.reshape(len(components), -1) @ by_S.ravel().astype(components.dtype)
    delta = np.concatenate([a.reshape(len(a), -1) @ by_Q[faces].ravel() for faces, a in
                            zip(space.faces_of_part, space.coefficients, strict=True)])
    # a turn ω of part p changes R_p by hat(ω) R_p, and turns all that hangs below it
    M = by_R @ np.swapaxes(R, -1, -2)
    turn = np.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], axis=-1)
    below = skeleton.descends.T.astype(float) @ turn
    by_pose = np.einsum("pd,pdc->pc", below, R @ rotations.right_jacobian(pose))
    by_pose += np.tensordot(delta, space.features.derivative(pose), axes=1)
    return by_pose.ravel(), by_betas.astype(np.float64)
