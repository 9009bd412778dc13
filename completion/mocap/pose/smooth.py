"""All frames of a sequence coupled by how little a body accelerates; and a low-pass filter without lag."""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from ...smoothing import coupled_steps
from .foot_contact import HeldPoints
from .marked_body import MarkedBody, batches

FURTHEST = 0.5                       # radians or metres that a step may go


def smoothed(body: MarkedBody, stiffness: np.ndarray, x: np.ndarray, targets: np.ndarray, weights: np.ndarray,
             held: HeldPoints | None = None) -> np.ndarray:
    """Frames (T, P) that follow each other after one Gauss-Newton step, see `coupled_steps`.

    Markers (T, L, 3) have weights (T, L).
    """
    T, P = x.shape
    if T < 3:
        return x
    gradient, hessian = np.empty((T, P)), np.empty((T, P, P))
    for some in batches(T):
        _, gradient[some], hessian[some] = body.system(x[some], targets[some], weights[some])
        if held is not None:
            _, pull, stiff = held.system(*body.body.split(x[some])[:2], some)
            gradient[some] += pull
            hessian[some] += stiff
    step = coupled_steps(x, gradient, hessian, stiffness)
    longest = np.abs(step).max(axis=1, keepdims=True)
    return body.retract(x, step * np.minimum(1, FURTHEST / np.maximum(longest, 1e-12)))


def low_pass(pose: np.ndarray, trans: np.ndarray, rate: float, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Poses (T, J, 3) and trans (T, 3) without what is faster than a frequency, hertz: Butterworth, there and back.

    Rotations are filtered as unit quaternions of continuous sign, which have no jump at a half turn.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0 < cutoff < rate / 2:
        raise ValueError(f"low_pass: expected a frequency between 0 and half the rate, {rate / 2:g}, got {cutoff:g}")
    sections = butter(2, cutoff, fs=rate, output="sos")
    if len(pose) <= 3 * (2 * len(sections) + 1):
        raise ValueError(f"low_pass: expected more than {3 * (2 * len(sections) + 1)} frames, got {len(pose)}")
    q = Rotation.from_rotvec(pose.reshape(-1, 3)).as_quat().reshape(*pose.shape[:2], 4)
    turned = np.einsum("tjc,tjc->tj", q[1:], q[:-1]) < 0
    q[1:] *= np.where(np.cumsum(turned, axis=0) % 2, -1.0, 1.0)[..., None]
    q = sosfiltfilt(sections, q, axis=0)
    return (Rotation.from_quat(q.reshape(-1, 4)).as_rotvec().reshape(pose.shape),
            sosfiltfilt(sections, trans, axis=0))
