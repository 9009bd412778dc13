"""All frames of a sequence coupled by how little a body accelerates; and a low-pass filter without lag."""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from scanprep.geometry.sparse import overlapping_windows, solve_smooth

from .foot_contact import HeldPoints
from .marked_body import BATCH, MarkedBody
from .settings import AnimateConfig

WINDOW, OVERLAP = 1000, 60           # frames solved at once, and those that each side lends to its neighbour
FURTHEST = 0.5                       # radians or metres that a step may go


def inertia(config: AnimateConfig, rate: float, n_unknowns: int) -> np.ndarray:
    """Information (P,) of the change of velocity from frame to frame."""
    out = np.full(n_unknowns, (config.angle_acceleration / rate**2)**-2)
    out[-3:] = (config.place_acceleration / rate**2)**-2
    return out


def smoothed(body: MarkedBody, stiffness: np.ndarray, x: np.ndarray, targets: np.ndarray, weights: np.ndarray,
             held: HeldPoints | None = None) -> np.ndarray:
    """Frames (T, P) that follow each other after one Gauss-Newton step, constant velocity (P,) as a prior.

    Markers (T, L, 3) have weights (T, L). The step is in small rotations of every joint from the right, so that nothing
    happens at a half turn; velocities are differences of these, which is exact for slow motion.
    """
    T, P = x.shape
    if T < 3:
        return x
    gradient, hessian = np.empty((T, P)), np.empty((T, P, P))
    for start in range(0, T, BATCH):
        some = slice(start, start + BATCH)
        _, gradient[some], hessian[some] = body.system(x[some], targets[some], weights[some])
        if held is not None:
            _, pull, stiff = held.system(*body.body.split(x[some])[:2], some)
            gradient[some] += pull
            hessian[some] += stiff
    step = coupled_steps(body, stiffness, x, gradient, hessian)
    longest = np.abs(step).max(axis=1, keepdims=True)
    return body.retract(x, step * np.minimum(1, FURTHEST / np.maximum(longest, 1e-12)))


def coupled_steps(body: MarkedBody, stiffness: np.ndarray, x: np.ndarray, gradient: np.ndarray, hessian: np.ndarray
                  ) -> np.ndarray:
    """The step (T, P) of frames that follow each other, T at least 3, `stiffness` (P,) on their change of velocity.

    Of everything else come half the gradient (T, P) and the Gauss-Newton matrix (T, P, P).
    """
    step = np.empty_like(x)
    for near, kept, where in overlapping_windows(len(x), WINDOW, OVERLAP):
        at = x[near]
        bend, pull = np.diff(body.step_to(at[:-1], at[1:]), axis=0), gradient[near].copy()
        for i, share in enumerate((1.0, -2.0, 1.0)):
            pull[i:len(at) - 2 + i] += share * stiffness * bend
        step[where] = -solve_smooth(hessian[near], stiffness, pull)[kept]
    return step


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
