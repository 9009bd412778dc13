"""Random bodies of a model, and how far they are from real people."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from model.priors import sample_poses

from ..body import BodyModel, Progress
from ..digests import check_bodies
from ..fitting.vertices import FitConfig, ShapeFitter
from ..shape_statistics import Sex, draw_betas
from .errors import check_counts


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
                  n_betas: int | None = None, sex: Sex | None = None) -> Samples:
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
    n_betas : int, optional
        Vary only so many first components.
    sex : {"female", "male"}, optional
        For a model that tells women from men; by default half of its bodies are women.

    Returns
    -------
    Samples
        Betas (n, k), poses (n, J, 3), vertices (n, N, 3) in metres, and sexes.

    Raises
    ------
    ValueError
        A count below 1, more components than the model has, poses wanted of a model that lacks them, a sex of a model
        that does not tell women from men.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> women = sample_bodies(load_built_in_model(), 3, np.random.default_rng(0), sex="female")
    >>> women.vertices.shape == (3, len(load_built_in_model().template.vertices), 3)
    True

    [SCAPE] Eq. 7
    """
    K, J = model.n_betas if n_betas is None else n_betas, len(model.skeleton.parents)
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    if not 0 <= K <= model.n_betas:
        raise ValueError(f"n_betas: expected 0..{model.n_betas}, the components of the model, got {K}")
    if not K and not pose_too:
        raise ValueError("n_betas: the model has no shape components, so only poses can be random (pose_too)")
    betas, sexes = draw_betas(model, count, rng, sex)
    betas, poses = betas[:, :K], np.zeros((count, J, 3))
    if pose_too:
        poses = sample_poses(model, count, rng)
    return Samples(betas, poses, model.vertices(poses, betas if model.n_betas else None), sexes)


@dataclass(frozen=True, eq=False)
class Specificity:
    """Result of `specificity`: how far random bodies are from the nearest real person, for C numbers of components.

    `distances` (C, n) are mean vertex distances, metres, of every random body to the nearest training person, `nearest`
    (C, n) that person. `between_people` is the mean distance of training people to their nearest other, to compare
    with.
    """

    counts: np.ndarray
    distances: np.ndarray
    nearest: np.ndarray
    between_people: float


def specificity(model: BodyModel, people: np.ndarray, count: int = 100, rng: np.random.Generator | None = None,
                counts: Sequence[int] = (10, 20, 40), config: FitConfig | None = None,
                progress: Progress | None = None) -> Specificity:
    """Measure the distance of random bodies of the model to the nearest training person.

    Random bodies are drawn as `sample_bodies` does, and stand at rest. People are brought to rest by `unpose_people`,
    and all bodies are centred, before vertices are compared.

    Parameters
    ----------
    model : BodyModel
        A model with shape components.
    people : (S, N, 3) float, metres
        Registered people that the model was trained on.
    count : int
        Random bodies for each number of components.
    rng : numpy.random.Generator, optional
        By default one with seed 0.
    counts : sequence of int
        Numbers of components; more than the model has means all of them.
    config : FitConfig, optional
        Settings of the fits.
    progress : callable, optional
        Called as progress(done, total), counting people.

    Raises
    ------
    ValueError
        Fewer than two people, a count below 1, a model without shape components.
    """
    rng = rng or np.random.default_rng(0)
    people, wanted = check_bodies(model.template, people, "people"), check_counts(model, counts)
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    if len(people) < 2:
        raise ValueError(f"people: expected at least 2, got {len(people)}")
    # people at rest, the mean person and its change by the betas, all centred
    real = _centre(unpose_people(model, people, config, progress)).astype(np.float32)
    rest = np.zeros((len(model.skeleton.parents), 3))
    mean = _centre(model.vertices(rest, np.zeros(wanted[-1]))[None])[0]
    change = np.moveaxis(_centre(np.moveaxis(model.shape_jacobian(rest), -1, 0)), 0, -1)
    betas = draw_betas(model, count, rng)[0]
    distances, nearest = np.empty((len(wanted), count)), np.empty((len(wanted), count), dtype=np.int64)
    for c, k in enumerate(wanted):
        for i, b in enumerate(betas):
            far = _distances_to(real, (mean + change[..., :k] @ b[:k]).astype(np.float32))
            nearest[c, i] = far.argmin()
            distances[c, i] = far.min()
    others = [np.delete(_distances_to(real, person), i).min() for i, person in enumerate(real)]
    return Specificity(np.array(wanted), distances, nearest, float(np.mean(others)))


def unpose_people(model: BodyModel, people: np.ndarray, config: FitConfig | None = None,
                  progress: Progress | None = None
                  ) -> np.ndarray:
    """Bring people (S, N, 3) to the rest pose: `fit_shape` with all components, then the fitted body at zero pose.

    The residual of the fit at every vertex is rotated back with its part and added. So the result is the person and not
    the model's approximation.
    """
    fitter, part = ShapeFitter(model, config), model.skeleton.part_of_vertex(model.template)
    rest = np.zeros((len(model.skeleton.parents), 3))
    out = np.empty_like(people)
    for i, person in enumerate(people):
        fit = fitter.fit(person)
        R = model.skeleton.part_rotations(fit.pose)[part]
        left = np.squeeze((person - fit.vertices)[:, None] @ R, axis=1)          # Rᵀ r of every vertex
        out[i] = model.vertices(rest, fit.betas) + left
        if progress:
            progress(i + 1, len(people))
    return out


def _centre(bodies: np.ndarray) -> np.ndarray:
    return bodies - bodies.mean(axis=1, keepdims=True)


def _distances_to(real: np.ndarray, body: np.ndarray) -> np.ndarray:
    """Compute the mean vertex distance (S,) of a body (N, 3) to each of S bodies (S, N, 3)."""
    return np.array([np.sqrt(((person - body) ** 2).sum(axis=1)).mean(dtype=np.float64) for person in real])
