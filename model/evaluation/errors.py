"""How good a model is: held-out errors of pose and shape.

All figures use only the common interface of `BodyModel`, so that kinds of model can be compared.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scanprep.judgement import HAND, extent, size
from scanprep.plausible import unit_problem
from scanprep.words import describe_result

from ..body import BodyModel, Progress
from ..digests import check_bodies
from ..fitting.vertices import FitConfig, PoseFit, PoseFitter, ShapeFit, ShapeFitter
from ..linear import Subject


@dataclass(frozen=True, eq=False)
class Errors:
    """Distances of corresponding vertices, metres.

    For each body (M,) `mean`, 95th percentile `p95` and `worst`; the mean at each vertex, `by_vertex` (N,); and the
    mean of each part of each body, `by_part` (M, J).
    """

    mean: np.ndarray
    p95: np.ndarray
    worst: np.ndarray
    by_vertex: np.ndarray
    by_part: np.ndarray

    def __repr__(self) -> str:
        return f"Errors({1000 * self.overall:.2f} mm on average, {1000 * self.worst.max():.1f} at most)"

    @property
    def overall(self) -> float:
        """Mean over bodies and vertices, metres."""
        return float(self.mean.mean())


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Result of `pose_errors`: errors, fitted poses (M, J, 3), trans (M, 3), and which fits converged (M,).

    `betas` are those of the body that was posed; None is the template's own body.
    """

    errors: Errors
    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray | None
    converged: np.ndarray
    __repr__ = describe_result

    def vertices(self, model: BodyModel, i: int) -> np.ndarray:
        """Compute the fitted vertices (N, 3) of body i, metres."""
        return model.vertices(self.poses[i], self.betas, self.trans[i])


@dataclass(frozen=True, eq=False)
class ShapeErrors:
    """Result of `shape_errors`, for several rising numbers of components, `counts` (C,).

    For each count it holds the `errors` after `fit_shape`, and those of plain PCA of centred vertices (`vertex_pca`;
    None without training people). Then betas (C, S, K), poses (C, S, J, 3), trans (C, S, 3) and which fits converged
    (C, S).
    """

    counts: np.ndarray
    errors: tuple[Errors, ...]
    vertex_pca: tuple[Errors, ...] | None
    betas: np.ndarray
    poses: np.ndarray
    trans: np.ndarray
    converged: np.ndarray
    __repr__ = describe_result

    def vertices(self, model: BodyModel, c: int, i: int) -> np.ndarray:
        """Compute the fitted vertices (N, 3) of person i with the c-th number of components, metres."""
        return model.vertices(self.poses[c, i], self.betas[c, i], self.trans[c, i])


def errors_between(model: BodyModel, made: Sequence[np.ndarray], truth: np.ndarray) -> Errors:
    """Compute the errors of M fitted bodies (N, 3) against the true ones (M, N, 3), metres."""
    far = np.array([np.linalg.norm(y - x, axis=1) for y, x in zip(made, truth, strict=True)])
    of_part = np.eye(len(model.skeleton.parents))[model.skeleton.part_of_vertex(model.template)]       # (N, J)
    return Errors(far.mean(axis=1), np.percentile(far, 95, axis=1), far.max(axis=1), far.mean(axis=0),
                  far @ of_part / np.maximum(of_part.sum(axis=0), 1))


def pose_errors(model: BodyModel, bodies: np.ndarray, subject: Subject | None = None,
                progress: Progress | None = None) -> PoseErrors:
    """Compute the errors of one person's bodies after fitting pose and place.

    Parameters
    ----------
    model : BodyModel
        The model to evaluate.
    bodies : (M, N, 3) float, metres
        Registered bodies of the subject, preferably not those that the model was trained on.
    subject : Subject, optional
        Whose bodies they are; by default the template's own body.
    progress : callable, optional
        Called as progress(done, total), counting bodies.

    Returns
    -------
    PoseErrors
        Errors by body, vertex and part, and the fitted poses.

    Raises
    ------
    ValueError
        Bodies with another number of vertices or not finite.

    Examples
    --------
    >>> from model import load_built_in_model, sample_poses
    >>> model = load_built_in_model()
    >>> bodies = model.subject(None).vertices(sample_poses(model, 2, np.random.default_rng(0)))
    >>> pose_errors(model, bodies).errors.overall < 1e-3            # its own bodies, to a millimetre
    True
    """
    bodies = check_bodies(model.template, bodies, "bodies")
    subject = subject or model.subject()
    fitter, fits = PoseFitter(subject), list[PoseFit]()
    for body in bodies:
        fits.append(fitter.fit(body))
        if progress:
            progress(len(fits), len(bodies))
    return PoseErrors(errors_between(model, [f.vertices for f in fits], bodies), np.stack([f.pose for f in fits]),
                      np.stack([f.trans for f in fits]), subject.betas, np.array([f.converged for f in fits]))


def shape_errors(model: BodyModel, people: np.ndarray, counts: Sequence[int] = (10, 20, 40),
                 train: np.ndarray | None = None, config: FitConfig | None = None,
                 progress: Progress | None = None) -> ShapeErrors:
    """Compute the errors of people after fitting shape, pose and place: the generalisation of the model.

    Parameters
    ----------
    model : BodyModel
        A model with shape components.
    people : (S, N, 3) float, metres
        Registered people, preferably not those that the model was trained on.
    counts : sequence of int
        Numbers of components; more than the model has means all of them.
    train : (P, N, 3) float, metres, optional
        The training people, for plain PCA of vertices to compare with.
    config : FitConfig, optional
        Settings of the fit.
    progress : callable, optional
        Called as progress(done, total), counting fits.

    Returns
    -------
    ShapeErrors
        Errors for every number of components, and the fitted betas and poses.

    Raises
    ------
    ValueError
        People with another number of vertices or not finite, a count below 1, a model without shape components.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> person = model.vertices(np.zeros((16, 3)), np.array([1.0, -1.0, 0.5]))
    >>> few, more = shape_errors(model, person[None], (1, 3), config=FitConfig(sample=200, polish=0)).errors
    >>> more.overall < few.overall
    True
    """
    people, wanted = check_bodies(model.template, people, "people"), check_counts(model, counts)
    # one fitter for all counts; each count begins where the smaller one ended
    largest = ShapeFitter(model, replace(config or FitConfig(), n_betas=wanted[-1]))
    fitters = [largest.first(count) for count in wanted]
    fits = list[list[ShapeFit]]()
    for done, person in enumerate(people):
        fits.append([])
        for fitter in fitters:
            fits[-1].append(fitter.fit(person, fits[-1][-1] if fits[-1] else None))
            if progress:
                progress(done * len(wanted) + len(fits[-1]), len(people) * len(wanted))
    by_count = list(zip(*fits, strict=True))

    def errors(made: Iterable[Sequence[np.ndarray]]) -> tuple[Errors, ...]:
        return tuple(errors_between(model, bodies, people) for bodies in made)

    return ShapeErrors(
        np.array(wanted), errors([f.vertices for f in row] for row in by_count),
        None if train is None else errors(_by_components(check_bodies(model.template, train, "train"), people,
                                                         wanted)),
        *(np.array([[getattr(f, name) for f in row] for row in by_count])
          for name in ("betas", "pose", "trans", "converged")))


def vertex_components(train: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the mean (3N,) and at most `count` orthonormal principal components (k, 3N) of bodies (P, N, 3), centred.
    """
    flat = (train - train.mean(axis=1, keepdims=True)).reshape(len(train), -1)
    mean = flat.mean(axis=0)
    flat -= mean
    variances, modes = np.linalg.eigh(flat @ flat.T)
    keep = np.flatnonzero(variances[::-1] > 1e-10 * max(variances[-1], 1e-30))[:count]
    directions = modes[:, ::-1][:, keep].T @ flat
    return mean, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _by_components(train: np.ndarray, people: np.ndarray, counts: Sequence[int]) -> list[list[np.ndarray]]:
    """Reconstruct people (S, N, 3) from plain principal components of the training people, for each count."""
    mean, components = vertex_components(train, max(counts))
    middles = people.mean(axis=1, keepdims=True)
    weights = ((people - middles).reshape(len(people), -1) - mean) @ components.T
    return [[(mean + w[:count] @ components[:count]).reshape(-1, 3) + middle
             for w, middle in zip(weights, middles, strict=True)] for count in counts]


def check_counts(model: BodyModel, counts: Sequence[int]) -> list[int]:
    """Check numbers of components and return them in rising order, at most those of the model; else ValueError."""
    if not len(counts) or min(counts) < 1:
        raise ValueError(f"counts: expected numbers from 1 on, got {', '.join(map(str, counts)) or 'none'}")
    if not model.n_betas:
        raise ValueError("model: expected one with shape components, this one has none")
    return sorted({min(int(count), model.n_betas) for count in counts})


def errors_problem(errors: Errors, bodies: np.ndarray, model: BodyModel) -> str | None:
    """Explain why the errors of bodies (M, N, 3) mean nothing, with the likely cause; None where they are plausible."""
    if errors.overall <= HAND * size(model.template):
        return None
    spans = [extent(body) for body in bodies]
    cause = unit_problem(float(np.median(spans)), extent(model.template.vertices), "the bodies are")
    return (f"the model is {1000 * errors.overall:.0f} mm from the bodies on average; "
            f"{cause or 'bodies whose vertices have another order, or another model?'}")
