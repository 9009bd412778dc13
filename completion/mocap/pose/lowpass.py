"""A low-pass filter on a motion, without lag."""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

ORDER = 2                            # of each of the two passes


def low_pass(pose: np.ndarray, trans: np.ndarray, rate: float, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """A motion without what is faster than a frequency: Butterworth, forwards and backwards.

    Turns are filtered as unit quaternions of continuous sign, which have no jump at a half turn.

    Parameters
    ----------
    pose : (T, J, 3) float, radians
    trans : (T, 3) float, metres
    rate : float, frames per second
    cutoff : float, hertz
        Where half the power is left by each pass.

    Raises
    ------
    ValueError
        A cut-off that is not between zero and half the rate, too few frames to filter.
    """
    from scipy.signal import butter, sosfiltfilt

    if not 0 < cutoff < rate / 2:
        raise ValueError(f"low_pass: expected a frequency between 0 and half the rate, {rate / 2:g}, got {cutoff:g}")
    sections = butter(ORDER, cutoff, fs=rate, output="sos")
    if len(pose) <= 3 * (2 * len(sections) + 1):
        raise ValueError(f"low_pass: expected more than {3 * (2 * len(sections) + 1)} frames, got {len(pose)}")
    q = Rotation.from_rotvec(pose.reshape(-1, 3)).as_quat().reshape(*pose.shape[:2], 4)
    turned = np.einsum("tjc,tjc->tj", q[1:], q[:-1]) < 0
    q[1:] *= np.where(np.cumsum(turned, axis=0) % 2, -1.0, 1.0)[..., None]
    q = sosfiltfilt(sections, q, axis=0)
    return (Rotation.from_quat(q.reshape(-1, 4)).as_rotvec().reshape(pose.shape),
            sosfiltfilt(sections, trans, axis=0))
