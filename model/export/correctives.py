"""Corrective shapes: what linear blend skinning lacks of the exact model, for one motion or for any pose.

They are changes of the rest mesh. With them, `write_body_npz` writes a model in the usual layout of body models.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from model.priors import sample_poses
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points, spread_indices
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import save_arrays

from ..body import BodyModel
from ..linear import Subject
from ..rig import Correctives, Rig, make_rig

AT_ONCE = 256                        # frames that are worked on together, with POINTS points each
SEEN = 100                           # frames from whose whole bodies correctives are computed: 200 change 0.02 mm
POINTS = 600                         # points that give the weights of a frame: all 12,500 vertices change 0.02 mm


def rest_corrections(rig: Rig, poses: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Compute changes of the rest mesh (T, N, 3), metres, with which skinning gives the exact bodies (T, N, 3).

    The bodies are posed with trans zero.
    """
    out, parts = np.empty_like(exact, dtype=np.float64), np.ascontiguousarray(rig.weights.T)
    for t, pose in enumerate(poses):
        # mean rotations M (3, 3, N), coordinates before vertices: an element of all is one array
        M = (rig.skeleton.part_rotations(pose).reshape(-1, 9).T @ parts).reshape(3, 3, -1)
        off = np.ascontiguousarray((exact[t] - rig.vertices(pose)).T)
        # opposite rotations can cancel in the mean; the damped inverse does not amplify directions below a tenth
        square = np.einsum("kin,kjn->ijn", M, M)
        square += 0.1**2 * _rotation_loss(M) * np.eye(3)[..., None]
        out[t] = _solve_small(square, np.einsum("kin,kn->in", M, off)).T
    return out


def _solve_small(A: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Solve N symmetric systems A x = y, (3, 3, N) and (3, N), by Cramer's rule: a tenth of LAPACK's time."""
    (a, b, c), (_, d, e), (_, _, f) = A
    cofactors = np.stack([d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b])
    p, q, r, s, t, u = cofactors
    determinant = a * p + b * q + c * r
    return np.stack([p * y[0] + q * y[1] + r * y[2], q * y[0] + s * y[1] + t * y[2],
                     r * y[0] + t * y[1] + u * y[2]]) / determinant


def _rotation_loss(M: np.ndarray) -> np.ndarray:
    """Measure how far mean rotations (3, 3, N) are from a rotation, (N,): 0 for a rotation, 1 where all cancelled."""
    (a, b, c), (d, e, f), (g, h, i) = M
    return 1 - np.clip(np.abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)), 0, 1)


def motion_correctives(rig: Rig, subject: Subject, poses: np.ndarray, count: int | None = None) -> Correctives:
    """Compute the correctives that bring a skinned motion to that of the exact body.

    The first corrective holds what skinning always lacks, with weight 1. The others are scaled so that their weights
    go from 0 to 1, since programs clamp others.

    Parameters
    ----------
    rig : Rig
        The skinned body.
    subject : Subject
        The exact body.
    poses : (T, J, 3) float, radians
        The motion.
    count : int, optional
        Number of correctives, at most that of the frames; by default as few as bring the motion within 0.5 mm.
    """
    poses = np.asarray(poses, dtype=np.float64)
    seen = poses[spread_indices(len(poses), SEEN)]
    mean, basis = _directions(rest_corrections(rig, seen, subject.vertices(seen)), count)
    # weights of every frame from a few points, by the pseudo-inverse of the correctives there
    ids = farthest_points(rig.mesh.vertices, min(POINTS, len(rig.mesh.vertices)))
    points_rig = replace(rig, mesh=Mesh(rig.mesh.vertices[ids], np.zeros((0, 3))), weights=rig.weights[ids],
                         shapes=np.zeros((0, len(ids), 3)), correctives=None)
    solve = np.linalg.pinv(basis[:, ids].reshape(len(basis), 3 * len(ids)))
    points, weights = subject.points(ids), np.empty((len(poses), len(basis)))
    for start in range(0, len(poses), AT_ONCE):
        batch = poses[start:start + AT_ONCE]
        lacking = rest_corrections(points_rig, batch, points.evaluate(batch)) - mean[ids]
        weights[start:start + AT_ONCE] = lacking.reshape(len(batch), -1) @ solve
    return _scale_to_unit(mean, basis, weights, np.arange(len(poses)))


def body_correctives(rig: Rig, poses: np.ndarray, trans: np.ndarray, bodies: Callable[[np.ndarray], np.ndarray],
                     frames: np.ndarray) -> Correctives:
    """Compute correctives for bodies that also change shape or are smoothed; as `motion_correctives` without a count.

    `bodies` returns the vertices (n, N, 3), metres, of given frames (n,). Between the frames correctives are
    interpolated linearly.
    """
    lacking = np.concatenate([rest_corrections(rig, poses[some], bodies(some) - trans[some, None])
                              for some in np.array_split(frames, -(-len(frames) // SEEN))])
    mean, basis = _directions(lacking[spread_indices(len(frames), SEEN)], None)
    weights = (lacking - mean).reshape(len(frames), -1) @ basis.reshape(len(basis), mean.size).T
    return _scale_to_unit(mean, basis, weights, frames)


def off_exact(rig: Rig, poses: np.ndarray, trans: np.ndarray | None, exact: np.ndarray,
              frames: np.ndarray) -> np.ndarray:
    """Compute the distance (n, N), metres, of the skinned mesh from exact bodies (n, N, 3) in some frames (n,)."""
    changes = None if rig.correctives is None else rig.correctives.changes(frames)
    skinned = rig.vertices(poses[frames], None if trans is None else trans[frames], changes)
    return np.linalg.norm(skinned - exact, axis=-1)


def _directions(lacking: np.ndarray, count: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean (N, 3) of changes (n, N, 3) and their main orthonormal directions (C - 1, N, 3), by PCA."""
    mean = lacking.mean(axis=0)
    changes = (lacking - mean).reshape(len(lacking), -1)
    power, modes = np.linalg.eigh(changes @ changes.T)
    order = np.argsort(-power)
    power = np.maximum(power[order], 0)
    left = np.sqrt(np.maximum(power.sum() - np.cumsum(np.r_[0, power]), 0) / lacking[..., 0].size)
    # by default as many as leave 0.5 mm RMS, at most 48: two seconds of kicks and punches need 11, 15 seconds 37
    wanted = min(int(np.argmax(left <= 5e-4)), 48 - 1) if count is None else count - 1
    main = order[:wanted][power[:wanted] > 1e-12 * max(float((lacking**2).sum()), 1e-12)]
    basis = modes[:, main].T @ changes
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    return mean, basis.reshape(len(basis), *mean.shape)


def _scale_to_unit(mean: np.ndarray, basis: np.ndarray, weights: np.ndarray, frames: np.ndarray) -> Correctives:
    """Rescale weights (n, C - 1) of a basis about a mean to the range from 0 to 1."""
    low, span = weights.min(axis=0), np.maximum(np.ptp(weights, axis=0), 1e-12)
    shapes = np.concatenate([(mean + np.tensordot(low, basis, axes=1))[None], basis * span[:, None, None]])
    return Correctives(shapes, np.column_stack([np.ones(len(weights)), (weights - low) / span]), frames)


def write_body_npz(path: str | Path, model: BodyModel, draws: int = 300) -> dict[str, np.ndarray]:
    """Write a model as linear blend skinning with shape and pose directions, in the usual layout of body models.

    The pose is `Σ_j weights_j G_j (v_template + shapedirs @ betas + posedirs @ vec(R_1 - I, ..., R_{J-1} - I))`.
    G_j rotates about `J_regressor @ (v_template + shapedirs @ betas)`. R_j is the rotation of part j relative to its
    parent, row by row. With zero betas it is the mean person, or the template's own body of a model without betas.
    Models learned here are not linear in R - I, so the pose directions are fitted to random poses.

    Parameters
    ----------
    path : str or Path
        `.npz` file to write; it holds no pickled objects.
    model : BodyModel
        The model.
    draws : int
        Random poses to which pose directions are fitted; 0 for none. An imported model has its own.

    Returns
    -------
    dict of str to array
        `v_template` (N, 3) metres, `f` (F, 3), `weights` (N, J), `kintree_table` (2, J): parents (-1 for the root) over
        parts, `J_regressor` (J, N), `J` (J, 3) metres, `shapedirs` (N, 3, K) metres per standard deviation, `posedirs`
        (N, 3, 9 (J - 1)) metres, `part_names` (J,), `betas_unit`, `length_unit`.

    Examples
    --------
    >>> import tempfile
    >>> from model import load_built_in_model
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     arrays = write_body_npz(f"{folder}/body.npz", load_built_in_model(), draws=0)
    >>> arrays["shapedirs"].shape
    (5002, 3, 30)

    Loper et al., SMPL, 2015.
    """
    mean = np.zeros(0)
    rig = make_rig(model, mean, model.n_betas)
    J = len(model.skeleton.parents)
    arrays = {
        "v_template": rig.mesh.vertices, "f": rig.mesh.faces.astype(np.int64), "weights": rig.weights,
        "kintree_table": np.stack([model.skeleton.parents, np.arange(J)]),
        "J_regressor": model.joint_regressor.toarray(), "J": rig.skeleton.joints,
        "shapedirs": np.moveaxis(rig.shapes, 0, -1).astype(np.float32),
        "part_names": np.array(model.skeleton.names, dtype=str), "betas_unit": np.array("standard deviation"),
        "length_unit": np.array("metre")}
    if model.pose_directions is not None:
        arrays["posedirs"] = model.pose_directions
    elif draws and J > 1:
        poses = sample_poses(model, draws, np.random.default_rng(0))
        arrays["posedirs"] = pose_directions(rig, poses, model.subject(mean).vertices(poses)).astype(np.float32)
    save_arrays(path, arrays)
    return arrays


def pose_features(poses: np.ndarray) -> np.ndarray:
    """Compute `R - I` (T, 9 (J - 1)) of all parts but the root relative to their parents, row by row."""
    return (rotations.exp(poses[:, 1:]) - np.eye(3)).reshape(len(poses), -1)


def pose_directions(rig: Rig, poses: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Fit pose directions (N, 3, 9 (J - 1)), linear in `pose_features`, to exact bodies (T, N, 3) in T poses."""
    X = pose_features(poses)
    changes = rest_corrections(rig, poses, exact).reshape(len(X), -1)
    # ridge regression: features with a mean square below 1e-3 have little influence
    B = np.linalg.solve(X.T @ X + 1e-3 * len(X) * np.eye(X.shape[1]), X.T @ changes)
    return np.moveaxis(B.reshape(-1, *rig.mesh.vertices.shape), 0, -1)
