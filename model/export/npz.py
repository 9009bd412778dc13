"""The arrays of a body model under the names that its users expect."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from model.priors import sample_poses
from scanprep.geometry import rotations
from scanprep.geometry.storage import writing

from ..body import BodyModel
from .correctives import rest_corrections
from .rig import Rig, make_rig


def write_body_npz(path: str | Path, model: BodyModel, weights: np.ndarray | None = None, draws: int = 300
                   ) -> dict[str, np.ndarray]:
    """Write a model as linear blend skinning with shape and pose directions, an `.npz` without objects.

    Posed by `Σ_j weights_j G_j (v_template + shapedirs @ betas + posedirs @ vec(R_1 - I, ..., R_{J-1} - I))`, where G_j
    rotates about `J_regressor @ (v_template + shapedirs @ betas)` and R_j is the rotation of part j against its parent,
    row by row. With betas of zero it is the mean person, or the template's own body where the model has no betas. No
    kind of model here is linear in R - I, so the pose directions are fitted to so many draws from the prior; with 0
    there are none.

    Parameters
    ----------
    path : str or Path
    model : BodyModel
    weights : (N, J) float
        As for `make_rig`.
    draws : int

    Returns
    -------
    dict
        `v_template` (N, 3) metres, `f` (F, 3), `weights` (N, J), `kintree_table` (2, J) with the parents (-1 for
        the root) over the parts, `J_regressor` (J, N), `J` (J, 3) metres, `shapedirs` (N, 3, K) metres per
        standard deviation, `posedirs` (N, 3, 9 (J - 1)) metres, `part_names` (J,), `betas_unit`, `length_unit`.
    """
    mean = np.zeros(1) if model.n_betas else None
    rig = make_rig(model, mean, model.n_betas, weights)
    J = len(model.skeleton.parents)
    arrays = {
        "v_template": rig.mesh.vertices, "f": rig.mesh.faces.astype(np.int64), "weights": rig.weights,
        "kintree_table": np.stack([model.skeleton.parents, np.arange(J)]),
        "J_regressor": model.skeleton.joint_regressor(model.template).toarray(), "J": rig.skeleton.joints,
        "shapedirs": np.moveaxis(rig.shapes, 0, -1).astype(np.float32),
        "part_names": np.array(model.skeleton.names, dtype=str), "betas_unit": np.array("standard deviation"),
        "length_unit": np.array("metre")}
    if draws and J > 1:
        poses = sample_poses(model, draws, np.random.default_rng(0))
        arrays["posedirs"] = pose_directions(rig, poses, model.subject(mean).vertices(poses)).astype(np.float32)
    with writing(path) as beside, open(beside, "wb") as out:
        np.savez_compressed(out, allow_pickle=False, **arrays)  # type: ignore[arg-type]
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
