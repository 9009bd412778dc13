"""Bodies whose betas change in every frame."""
from __future__ import annotations

import numpy as np

from model.body import BodyModel
from model.linear import check_pose

AT_ONCE = 32                         # bodies that are made together


def changing_bodies(model: BodyModel, poses: np.ndarray, betas: np.ndarray, trans: np.ndarray) -> np.ndarray:
    """Vertices (T, N, 3), metres, each frame with betas of its own (T, k), exact."""
    poses, trans = check_pose(model.skeleton, poses, trans)
    if betas.ndim != 2 or len(betas) != len(poses) or betas.shape[1] > model.n_betas:
        raise ValueError(f"betas: expected ({len(poses)}, k) with k at most {model.n_betas}, got {betas.shape}")
    out = np.empty((len(poses), len(model.template.vertices), 3))
    for start in range(0, len(poses), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        out[some] = model.bodies_of(poses[some], betas[some])
    out += (model.skeleton.joints[0] + trans)[:, None]
    return out


def skin_movement(model: BodyModel, changes: np.ndarray) -> np.ndarray:
    """How far changes of betas (T, k) move every vertex (N,), metres: the root of the mean square over time.

    In the mean pose; other poses turn the movement, and hardly lengthen it.
    """
    D = model.shape_jacobian(model.pose_mean)[..., :changes.shape[1]]
    moment = changes.T @ changes / max(len(changes), 1)
    return np.sqrt(np.maximum(np.einsum("ndk,ndk->n", D @ moment, D), 0.0))
