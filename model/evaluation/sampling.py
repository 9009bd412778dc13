"""Random bodies of a model."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.priors import sample_poses

from ..body import BodyModel
from ..shape_statistics import Sex, draw_betas


@dataclass(frozen=True, eq=False)
class Samples:
    """Random bodies: betas (n, k), k = 0 for a model without shape components, poses (n, J, 3), vertices (n, N, 3).

    `sexes` (n,) are "female" or "male", None where the model does not tell them apart.
    """

    betas: np.ndarray
    poses: np.ndarray
    vertices: np.ndarray
    sexes: tuple[Sex | None, ...]


def sample_bodies(model: BodyModel, count: int, rng: np.random.Generator, pose_too: bool = False,
                  sex: Sex | None = None) -> Samples:
    """Draw random bodies with betas of the model's people, see `draw_betas`.

    Parameters
    ----------
    model : BodyModel
        The model to sample.
    count : int
        Number of bodies.
    rng : numpy.random.Generator
        Source of the random numbers.
    pose_too : bool
        Draw poses from the Gaussian of the training poses; else all stand at rest.
    sex : {"female", "male"}, optional
        For a model that tells women from men; by default half of its bodies are women.

    Returns
    -------
    Samples
        Betas (n, k), poses (n, J, 3), vertices (n, N, 3) in metres, and sexes.

    Raises
    ------
    ValueError
        A count below 1, poses wanted of a model that lacks them, a model that can only vary in pose, a sex of a model
        that does not tell women from men.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> women = sample_bodies(load_built_in_model(), 3, np.random.default_rng(0), sex="female")
    >>> women.vertices.shape == (3, len(load_built_in_model().template.vertices), 3)
    True

    [SCAPE] Eq. 7
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    if not model.n_betas and not pose_too:
        raise ValueError("model: it has no shape components, so only poses can be random (pose_too)")
    betas, sexes = draw_betas(model, count, rng, sex)
    poses = np.zeros((count, len(model.skeleton.parents), 3))
    if pose_too:
        poses = sample_poses(model, count, rng)
    return Samples(betas, poses, model.vertices(poses, betas if model.n_betas else None), sexes)
