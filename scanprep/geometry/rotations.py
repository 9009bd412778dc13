"""Rotations and their conventions, a thin layer over `scipy.spatial.transform.Rotation`.

- A rotation is an active 3×3 matrix that acts on column vectors: `x_world = R_world_part @ x_part`.
- The target frame comes first in a name: `T_scan_template` takes template points to the scan.
- A rotation vector (twist) is axis times angle in radians; `exp` and `log` go between the two.
- A small rotation is applied from the left: `R ← exp(ω) R`, with ω in world axes.
- Points are stored as rows, so `points @ R.T` rotates them.

All functions take any number of leading dimensions.
"""
from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def exp(twist: np.ndarray) -> np.ndarray:
    """Convert rotation vectors (..., 3), radians, to rotation matrices (..., 3, 3)."""
    twist = np.require(twist, np.float64, "W")                  # SciPy refuses read-only arrays
    return Rotation.from_rotvec(twist.reshape(-1, 3)).as_matrix().reshape(*twist.shape, 3)


def log(R: np.ndarray) -> np.ndarray:
    """Convert rotation matrices (..., 3, 3) to rotation vectors (..., 3), radians, of length at most π.

    Well defined at angles 0 and π, where the formula printed in the paper is not.

    [SCAPE] §4.2
    """
    R = np.require(R, np.float64, "W")
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def compose(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Compute the rotation vectors (..., 3), at most π long, of `exp(first) @ exp(second)`; both have the same shape.

    By quaternions, in a third of the time of `log(exp(first) @ exp(second))`; solvers need it in every step.
    """
    p, a = _quaternion(first)
    q, b = _quaternion(second)
    # product of the quaternions (a, p) and (b, q)
    w = a * b - np.einsum("...i,...i->...", p, q)[..., None]
    v = a * q + b * p
    v[..., 0] += p[..., 1] * q[..., 2] - p[..., 2] * q[..., 1]
    v[..., 1] += p[..., 2] * q[..., 0] - p[..., 0] * q[..., 2]
    v[..., 2] += p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    sine = np.sqrt(np.einsum("...i,...i->...", v, v))[..., None]
    w, v = np.abs(w), np.where(w < 0, -v, v)
    half = np.arctan2(sine, w)
    return 2 * v * np.divide(half, sine, out=np.ones_like(sine), where=sine > 1e-12)


def _quaternion(twist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vector part (..., 3) and scalar part (..., 1) of the unit quaternions of rotation vectors."""
    half = 0.5 * np.sqrt(np.einsum("...i,...i->...", twist, twist))[..., None]
    return 0.5 * np.sinc(half / np.pi) * twist, np.cos(half)


def project(M: np.ndarray) -> np.ndarray:
    """Find the nearest proper rotation to each matrix (..., 3, 3) in the Frobenius norm, never a reflection."""
    # from 100 matrices on, vectorised arithmetic is faster than LAPACK on each
    if M.size < 9 * 100:
        return _project_by_svd(M)
    flat = M.reshape(-1, 3, 3)
    R, reliable = _project_by_newton(flat)
    if not reliable.all():
        R[~reliable] = _project_by_svd(flat[~reliable])
    return R.reshape(M.shape)


def _project_by_svd(M: np.ndarray) -> np.ndarray:
    """Project by singular value decomposition; a reflection flips the smallest direction."""
    U, _, Vt = np.linalg.svd(M)
    flip = np.linalg.det(U @ Vt) < 0
    U[flip, :, 2] *= -1
    return U @ Vt


def _project_by_newton(M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project by Newton's iteration; return rotations (n, 3, 3), and which (n,) are reliable: far from singular.

    The mean of X and its inverse transpose converges to the rotation. For many matrices this takes a fifth of the time
    of singular value decompositions.
    """
    X = np.ascontiguousarray(np.moveaxis(M, 0, 2), dtype=np.float64)
    size = np.sqrt(np.einsum("ijn,ijn->n", X, X))
    determinant = np.einsum("in,in->n", X[0], _cofactors(X)[0])
    good = determinant > 0.02 * size**3                          # a rotation has 0.19
    X[:, :, ~good] = np.eye(3)[..., None]
    X /= np.cbrt(np.where(good, determinant, 1.0))
    for _ in range(20):
        C = _cofactors(X)
        ahead = 0.5 * (X + C / np.einsum("in,in->n", X[0], C[0]))
        change, X = float(np.abs(ahead - X).max()), ahead
        if change < 1e-9:                                        # convergence is quadratic
            break
    return np.ascontiguousarray(np.moveaxis(X, 2, 0)), good


def _cofactors(X: np.ndarray) -> np.ndarray:
    """Compute the cofactors (determinant times inverse transpose) of matrices (3, 3, n)."""
    C = np.empty_like(X)
    for i in range(3):
        a, b = X[(i + 1) % 3], X[(i + 2) % 3]
        for j in range(3):
            k, l = (j + 1) % 3, (j + 2) % 3
            C[i, j] = a[k] * b[l] - a[l] * b[k]
    return C


def wrap_angle(angles: np.ndarray | float, centre: np.ndarray | float = 0.0) -> np.ndarray:
    """Bring angles, radians, into the half turn to both sides of `centre`: above centre - π, at most centre + π."""
    return np.asarray(centre + np.pi - (np.pi - (angles - centre)) % (2 * np.pi))


def mean(R: np.ndarray) -> np.ndarray:
    """Compute the chordal mean (3, 3) of rotations (n, 3, 3)."""
    return project(np.mean(R, axis=0)[None])[0]


def hat(v: np.ndarray) -> np.ndarray:
    """Return the matrices (..., 3, 3) with `hat(v) @ x == cross(v, x)`.

    [SCAPE] Eq. 11
    """
    v = np.asarray(v, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def right_jacobian(twist: np.ndarray) -> np.ndarray:
    """Compute J_r (..., 3, 3) with `exp(t + d) ≈ exp(t) exp(J_r(t) d)`."""
    angle, small, a, K = _terms(twist)
    first = np.where(small, 0.5 - angle**2 / 24, (1 - np.cos(a)) / a**2)
    second = np.where(small, 1 / 6 - angle**2 / 120, (a - np.sin(a)) / a**3)
    return np.eye(3) - first * K + second * K @ K


def inverse_right_jacobian(twist: np.ndarray) -> np.ndarray:
    """Compute the inverse (..., 3, 3) of `right_jacobian`, for rotation vectors shorter than 2π.

    `log(exp(t) exp(d)) ≈ t + J_r⁻¹(t) d`.
    """
    angle, small, a, K = _terms(twist)
    second = np.where(small, 1 / 12 + angle**2 / 720, 1 / a**2 - (1 + np.cos(a)) / (2 * a * np.sin(a)))
    return np.eye(3) + 0.5 * K + second * K @ K


def _terms(twist: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return angles (..., 1, 1), where they are too small to divide by, angles safe to divide by, and `hat`."""
    angle = np.linalg.norm(twist, axis=-1)[..., None, None]
    small = angle < 1e-3
    return angle, small, np.where(small, 1.0, angle), hat(twist)


def procrustes(source: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find R (..., 3, 3) and t (..., 3) with `target ≈ source @ R.T + t`, by least squares over points (..., n, 3)."""
    centre_s, centre_t = source.mean(axis=-2), target.mean(axis=-2)
    H = np.einsum("...ni,...nj->...ij", target - centre_t[..., None, :], source - centre_s[..., None, :])
    R = project(H.reshape(-1, 3, 3)).reshape(H.shape)
    return R, centre_t - np.einsum("...ij,...j->...i", R, centre_s)
