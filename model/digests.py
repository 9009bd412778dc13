"""Checks of bodies against a template's topology, and digests by which a model recognises its training bodies."""
from __future__ import annotations

import hashlib

import numpy as np

from scanprep.geometry.mesh import Mesh

from .body import BodyModel


def body_digest(vertices: np.ndarray) -> str:
    """Compute a short digest of one registered body (N, 3), the same for float64 and float32."""
    # 16 hexadecimal digits are 64 bits: two of a billion bodies rarely share them by chance
    return hashlib.sha256(np.ascontiguousarray(vertices, dtype=np.float32).tobytes()).hexdigest()[:16]


def digest(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None) -> str:
    """Compute the SHA-256 of a whole training set: `info["digest"]` of a model."""
    total = hashlib.sha256()
    for array in (template.vertices, template.faces, poses, shapes):
        if array is not None:
            total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def body_digests(*sets: np.ndarray | None) -> list[str]:
    """Compute the digest of every body in training sets (M, N, 3): `info["digests"]` of a model."""
    return [body_digest(body) for bodies in sets if bodies is not None for body in bodies]


def was_trained_on(model: BodyModel, bodies: np.ndarray) -> np.ndarray | None:
    """Find which of the bodies (M, N, 3) the model was trained on, (M,) bool; None where its file does not say."""
    known = model.info.get("digests")
    if known is None:
        return None
    return np.array([body_digest(body) in set(known) for body in bodies], dtype=bool)


def check_bodies(template: Mesh, bodies: np.ndarray, name: str, least: int = 1) -> np.ndarray:
    """Check that bodies (n, N, 3) are finite, at least `least`, and in the template's topology, else ValueError."""
    bodies, N = np.asarray(bodies, dtype=np.float64), len(template.vertices)
    if bodies.ndim != 3 or bodies.shape[1:] != (N, 3):
        raise ValueError(f"{name}: expected shape (n, {N}, 3) like the template, got {bodies.shape}")
    bad = np.flatnonzero(~np.isfinite(bodies).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"{name}: expected finite numbers, body {bad[0]} has vertices that are not finite")
    if len(bodies) < least:
        raise ValueError(f"{name}: expected at least {least} bodies, got {len(bodies)}")
    return bodies
