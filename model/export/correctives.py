"""What linear blend skinning lacks: the way to the exact model in the axes of the rest mesh, for one motion or for any.

With it the arrays of a body model under the names that its users expect.
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

AT_ONCE = 256                        # frames that are held at a time, of a few points
SEEN = 100                           # frames whose whole bodies say what is lacking: 200 say the same to 0.02 mm
POINTS = 600                         # that tell the weights of a frame; all 12,500 tell the same to 0.02 mm


def rest_corrections(rig: Rig, poses: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Changes of the rest mesh (T, N, 3), metres, that skinning carries onto the exact bodies (T, N, 3), trans zero."""
    out, parts = np.empty_like(exact, dtype=np.float64), np.ascontiguousarray(rig.weights.T)
    for t, pose in enumerate(poses):
        # mean rotations M (3, 3, N), coordinates before vertices: an element of all is one array
        M = (rig.skeleton.part_rotations(pose).reshape(-1, 9).T @ parts).reshape(3, 3, -1)
        off = np.ascontiguousarray((exact[t] - rig.vertices(pose)).T)
        # opposite rotations can cancel; the damped inverse leaves alone what they blot out
        # share of a blended rotation below which it is not undone
        square = np.einsum("kin,kjn->ijn", M, M)
        square += 0.1**2 * _rotation_loss(M) * np.eye(3)[..., None]
        out[t] = _solve_small(square, np.einsum("kin,kn->in", M, off)).T
    return out


def _solve_small(A: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Solutions (3, N) of symmetric A x = y, (3, 3, N) and (3, N), by Cramer's rule: a tenth of LAPACK's time."""
    (a, b, c), (_, d, e), (_, _, f) = A
    cofactors = np.stack([d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b])
    p, q, r, s, t, u = cofactors
    determinant = a * p + b * q + c * r
    return np.stack([p * y[0] + q * y[1] + r * y[2], q * y[0] + s * y[1] + t * y[2],
                     r * y[0] + t * y[1] + u * y[2]]) / determinant


def _rotation_loss(M: np.ndarray) -> np.ndarray:
    """(N,) how far mean rotations (3, 3, N) are from a rotation: 0 for one, 1 where all has cancelled."""
    (a, b, c), (d, e, f), (g, h, i) = M
    return 1 - np.clip(np.abs(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)), 0, 1)


def motion_correctives(rig: Rig, subject: Subject, poses: np.ndarray, count: int | None = None) -> Correctives:
    """What brings a skinned motion (T, J, 3) to that of the exact body, the subject.

    The first corrective holds what is always lacking, with the weight 1; the others are scaled so that their weights
    go from 0 to 1, since programs clamp others.

    Parameters
    ----------
    count : int, optional
        Of correctives, at most as many as there are frames; else as few as come within `NEAR`.
    """
    poses = np.asarray(poses, dtype=np.float64)
    seen = poses[spread_indices(len(poses), SEEN)]
    mean, basis = _directions(rest_corrections(rig, seen, subject.vertices(seen)), count)
    ids = farthest_points(rig.mesh.vertices, min(POINTS, len(rig.mesh.vertices)))
    few = replace(rig, mesh=Mesh(rig.mesh.vertices[ids], np.zeros((0, 3))), weights=rig.weights[ids],
                  shapes=np.zeros((0, len(ids), 3)), correctives=None)
    solve = np.linalg.pinv(basis[:, ids].reshape(len(basis), 3 * len(ids)))
    points, weights = subject.points(ids), np.empty((len(poses), len(basis)))
    for start in range(0, len(poses), AT_ONCE):
        some = poses[start:start + AT_ONCE]
        lacking = rest_corrections(few, some, points.evaluate(some)) - mean[ids]
        weights[start:start + AT_ONCE] = lacking.reshape(len(some), -1) @ solve
    return _scale_to_unit(mean, basis, weights, np.arange(len(poses)))


def body_correctives(rig: Rig, poses: np.ndarray, trans: np.ndarray, bodies: Callable[[np.ndarray], np.ndarray],
                     frames: np.ndarray) -> Correctives:
    """As `motion_correctives` without a count, for bodies that change as they move, or are smoothed.

    Of frames (n,) of the motion `bodies` tells the vertices (n, N, 3), metres; between them the correctives go straight
    from one to the next.
    """
    lacking = np.concatenate([rest_corrections(rig, poses[some], bodies(some) - trans[some, None])
                              for some in np.array_split(frames, -(-len(frames) // SEEN))])
    mean, basis = _directions(lacking[spread_indices(len(frames), SEEN)], None)
    weights = (lacking - mean).reshape(len(frames), -1) @ basis.reshape(len(basis), mean.size).T
    return _scale_to_unit(mean, basis, weights, frames)


def off_exact(rig: Rig, poses: np.ndarray, trans: np.ndarray | None, exact: np.ndarray,
              frames: np.ndarray) -> np.ndarray:
    """(n, N) metres: how far the skinned mesh, as programs show it, is from exact bodies (n, N, 3) of some frames."""
    changes = None if rig.correctives is None else rig.correctives.changes(frames)
    skinned = rig.vertices(poses[frames], None if trans is None else trans[frames], changes)
    return np.linalg.norm(skinned - exact, axis=-1)


def _directions(lacking: np.ndarray, count: int | None) -> tuple[np.ndarray, np.ndarray]:
    """The mean (N, 3) of changes (n, N, 3), and the directions (C - 1, N, 3), orthonormal, in which they vary most."""
    mean = lacking.mean(axis=0)
    changes = (lacking - mean).reshape(len(lacking), -1)
    power, modes = np.linalg.eigh(changes @ changes.T)
    order = np.argsort(-power)
    power = np.maximum(power[order], 0)
    left = np.sqrt(np.maximum(power.sum() - np.cumsum(np.r_[0, power]), 0) / lacking[..., 0].size)
    # at most 48 correctives: 2 s of kicks and punches need 11, 15 s need 37
    # metres, root mean square: where no number is asked for, correctives end here
    wanted = min(int(np.argmax(left <= 5e-4)), 48 - 1) if count is None else count - 1
    kept = order[:wanted][power[:wanted] > 1e-12 * max(float((lacking**2).sum()), 1e-12)]
    basis = modes[:, kept].T @ changes
    basis /= np.linalg.norm(basis, axis=1, keepdims=True)
    return mean, basis.reshape(len(basis), *mean.shape)


def _scale_to_unit(mean: np.ndarray, basis: np.ndarray, weights: np.ndarray, frames: np.ndarray) -> Correctives:
    """Correctives with weights from 0 to 1 for those (n, C - 1) of a basis about a mean."""
    low, span = weights.min(axis=0), np.maximum(np.ptp(weights, axis=0), 1e-12)
    shapes = np.concatenate([(mean + np.tensordot(low, basis, axes=1))[None], basis * span[:, None, None]])
    return Correctives(shapes, np.column_stack([np.ones(len(weights)), (weights - low) / span]), frames)


def write_body_npz(path: str | Path, model: BodyModel, weights: np.ndarray | None = None, draws: int = 300
                   ) -> dict[str, np.ndarray]:
    """Write a model as linear blend skinning with shape and pose directions, an `.npz` without objects; its arrays.

    Posed by `Σ_j weights_j G_j (v_template + shapedirs @ betas + posedirs @ vec(R_1 - I, ..., R_{J-1} - I))`, where G_j
    rotates about `J_regressor @ (v_template + shapedirs @ betas)` and R_j is the rotation of part j against its parent,
    row by row. With betas of zero it is the mean person, or the template's own body where the model has no betas. No
    kind of model that is learned here is linear in R - I, so the pose directions are fitted to so many draws from the
    prior, with 0 there are none; an imported model has its own. Weights (N, J) are as for `make_rig`.

    `v_template` (N, 3) metres, `f` (F, 3), `weights` (N, J), `kintree_table` (2, J) with the parents (-1 for the root)
    over the parts, `J_regressor` (J, N), `J` (J, 3) metres, `shapedirs` (N, 3, K) metres per standard deviation,
    `posedirs` (N, 3, 9 (J - 1)) metres, `part_names` (J,), `betas_unit`, `length_unit`.
    """
    mean = np.zeros(1) if model.n_betas else None
    rig = make_rig(model, mean, model.n_betas, weights)
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
    """(T, 9 (J - 1)): the turns of all parts but the root against their parents, less the identity, row by row."""
    return (rotations.exp(poses[:, 1:]) - np.eye(3)).reshape(len(poses), -1)


def pose_directions(rig: Rig, poses: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """(N, 3, 9 (J - 1)) changes of the rest mesh by `pose_features` that bring skinning nearest to exact bodies (T, N,
    3).
    """
    X = pose_features(poses)
    changes = rest_corrections(rig, poses, exact).reshape(len(X), -1)
    # mean square of a pose feature that counts as nothing
    B = np.linalg.solve(X.T @ X + 1e-3 * len(X) * np.eye(X.shape[1]), X.T @ changes)
    return np.moveaxis(B.reshape(-1, *rig.mesh.vertices.shape), 0, -1)
