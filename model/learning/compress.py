"""A pose space with fewer features, which the fast path pays for one by one."""
from __future__ import annotations

import numpy as np

from scanprep.geometry.mesh import Mesh

from ..features import PoseFeatures
from ..pose_space import PoseSpace

NOTHING = 1e-9                       # relative size below which a direction of the features is none


def condense(space: PoseSpace, poses: np.ndarray, template: Mesh, tolerance: float) -> PoseSpace:
    """The same pose space with fewer features: those mixtures that matter for the edges in the poses seen.

    Parameters
    ----------
    poses : (M, J, 3) float, radians
    tolerance : float, metres
        Root mean square change of an edge that may be lost in each part.
    """
    features, delta = space.features, space.features.evaluate(poses)
    v_hat = np.swapaxes(template.corners[:, 1:] - template.corners[:, :1], -1, -2)
    part, mixes, coefficients = [], [], []
    for p, faces in enumerate(space.faces_of_part):
        mine = features.of_part(p)
        a = space.coefficients[p].astype(np.float64)
        X = delta[:, mine][:, 1:]
        centre = X.mean(axis=0)
        scale, axes = _principal(X - centre)                        # X - centre = U diag(scale) axesᵀ
        moved = (a[1:] @ v_hat[faces]).reshape(len(a) - 1, 6 * len(faces))
        U, s, _ = np.linalg.svd((scale[:, None] * (axes.T @ moved)), full_matrices=False)
        left = np.sqrt(np.maximum(np.cumsum((s**2)[::-1])[::-1], 0) / (len(poses) * 2 * len(faces)))
        r = int((left > tolerance).sum())
        W = axes @ (U[:, :r] / scale[:, None])                      # features -> r numbers of unit scatter
        back = (U[:, :r] * scale[:, None]).T @ axes.T               # r numbers -> features
        kept = np.tensordot(back, a[1:], axes=1)
        constant = a[0] + np.tensordot(centre, a[1:], axes=1) - np.tensordot(centre @ W, kept, axes=1)
        part += [p] * (1 + r)
        mixes.append(np.concatenate([np.zeros((*features.mix.shape[:2], 1)), features.mix[..., mine][..., 1:] @ W],
                                    axis=-1))
        coefficients.append(np.concatenate([constant[None], kept]).astype(np.float32))
    fewer = PoseFeatures(features.skeleton, features.lift, np.array(part), np.concatenate(mixes, axis=-1))
    return PoseSpace(fewer, tuple(coefficients))


def _principal(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Scales (k,) and axes (n, k) of centred features (M, n), without those in which nothing varies."""
    _, s, Vt = np.linalg.svd(X, full_matrices=False)
    good = s > NOTHING * max(s.max(initial=0.0), NOTHING)
    return s[good], Vt[good].T
