"""Bodies that stand, put into poses."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np

from model.body import BodyModel
from model.fitting import FitConfig, ShapeFitter
from model.linear import check_pose
from model.posing.transfer import own_body
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import farthest_points

from .linear import check_bodies


def example_poses(model: BodyModel, count: int) -> np.ndarray:
    """Poses (count, J, 3) that the model was learned from, as different as can be; the first is the most usual one.

    Raises
    ------
    ValueError
        Fewer examples than poses are asked for.
    """
    examples = model.pose_examples
    if not 1 <= count <= len(examples):
        raise ValueError(f"count: expected 1..{len(examples)} poses, those that the model keeps, got {count}")
    turned = rotations.exp(examples).reshape(len(examples), -1)
    usual = ((turned - turned.mean(axis=0))**2).sum(axis=1).argmin()
    return examples[farthest_points(turned, count, usual, least=-0.5)]


def in_poses(model: BodyModel, bodies: np.ndarray, poses: np.ndarray,
             progress: Callable[[int, int], None] | None = None) -> np.ndarray:
    """Each registered body, with its own full shape, in some poses.

    Parameters
    ----------
    model : BodyModel
        With betas.
    bodies : (Z, N, 3) float, metres
    poses : (F, J, 3) float, radians
    progress : callable, optional
        Called with (done, total).

    Returns
    -------
    (Z, F, N, 3) float32, metres

    Raises
    ------
    ValueError
        Bodies or poses of another shape, a model without betas.
    """
    bodies = check_bodies(model, bodies)
    poses, _ = check_pose(model.skeleton, poses, None)
    fitter = ShapeFitter(model, FitConfig(polish=0))
    out = np.empty((len(bodies), len(poses), *bodies.shape[1:]), dtype=np.float32)
    for i, body in enumerate(np.asarray(bodies, dtype=np.float64)):
        out[i] = own_body(model, body, fitter.fit(body)).subject.vertices(poses)
        if progress is not None:
            progress(i + 1, len(bodies))
    return out
