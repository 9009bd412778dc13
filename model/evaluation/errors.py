"""How good a model is: held-out errors of pose and shape, compactness.

Every figure is made through the contract of `BodyModel` alone, so that kinds of model can be compared.
"""
from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from scanprep.judgement import HAND, extent, size, unit_problem

from ..body import BodyModel, Progress
from ..digests import check_bodies
from ..fitting.vertices import FitConfig, PoseFit, PoseFitter, ShapeFit, ShapeFitter
from ..linear import Subject


@dataclass(frozen=True, eq=False)
class Errors:
    """Distances of corresponding vertices, metres: of each body (M,) the mean, 95th percentile and worst, the mean at
    each vertex (N,), and the mean of each part of each body (M, J).
    """

    mean: np.ndarray
    p95: np.ndarray
    worst: np.ndarray
    by_vertex: np.ndarray
    by_part: np.ndarray

    @property
    def overall(self) -> float:
        """Mean over bodies and vertices, metres."""
        return float(self.mean.mean())


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """What is left of bodies after fitting pose and place: errors, poses (M, J, 3), trans (M, 3), which fits converged
    (M,).

    `betas` are those of the body that was posed; None is the template's own.
    """

    errors: Errors
    poses: np.ndarray
    trans: np.ndarray
    betas: np.ndarray | None
    converged: np.ndarray

    def vertices(self, model: BodyModel, i: int) -> np.ndarray:
        """(N, 3) what the model made of body i, metres."""
        return model.vertices(self.poses[i], self.betas, self.trans[i])


@dataclass(frozen=True, eq=False)
class ShapeErrors:
    """What is left of people after fitting shape, pose and place with several rising numbers of components, `counts`
    (C,).

    For each count the errors after `fit_shape`, those with the pose held at that of the parts' own best rotations, and
    those of plain principal components of the vertices of the training people, centred, None where none were given;
    then betas (C, S, K), poses (C, S, J, 3), trans (C, S, 3) and which fits converged (C, S).
    """

    counts: np.ndarray
    errors: tuple[Errors, ...]
    pose_held: tuple[Errors, ...]
    vertex_pca: tuple[Errors, ...] | None
    betas: np.ndarray
    poses: np.ndarray
    trans: np.ndarray
    converged: np.ndarray

    def vertices(self, model: BodyModel, c: int, i: int) -> np.ndarray:
        """(N, 3) what the model made of person i with the c-th number of components, metres."""
        return model.vertices(self.poses[c, i], self.betas[c, i], self.trans[c, i])


def errors_between(model: BodyModel, made: Sequence[np.ndarray], truth: np.ndarray) -> Errors:
    """The errors of bodies (N, 3) against what they should be (M, N, 3), metres."""
    far = np.array([np.linalg.norm(y - x, axis=1) for y, x in zip(made, truth, strict=True)])
    of_part = np.eye(len(model.skeleton.parents))[model.skeleton.part_of_vertex(model.template)]       # (N, J)
    return Errors(far.mean(axis=1), np.percentile(far, 95, axis=1), far.max(axis=1), far.mean(axis=0),
                  far @ of_part / np.maximum(of_part.sum(axis=0), 1))


def pose_errors(model: BodyModel, bodies: np.ndarray, subject: Subject | None = None,
                config: FitConfig | None = None, progress: Progress | None = None) -> PoseErrors:
    """Error of one person's bodies after fitting pose and place.

    Parameters
    ----------
    model : BodyModel
    bodies : (M, N, 3) float, metres
        Registered, of the subject, best those that the model was not trained on.
    subject : Subject, optional
        Whose bodies they are; the template's own body when not given.
    config : FitConfig, optional
    progress : callable, optional
        Called with the bodies done and their number.

    Raises
    ------
    ValueError
        Bodies of another count of vertices or not finite.
    """
    bodies = check_bodies(model.template, bodies, "bodies")
    subject = subject or model.subject()
    fitter, fits = PoseFitter(subject, config), list[PoseFit]()
    for body in bodies:
        fits.append(fitter.fit(body))
        if progress:
            progress(len(fits), len(bodies))
    return PoseErrors(errors_between(model, [f.vertices for f in fits], bodies), np.stack([f.pose for f in fits]),
                      np.stack([f.trans for f in fits]), subject.betas, np.array([f.converged for f in fits]))


def shape_errors(model: BodyModel, people: np.ndarray, counts: Sequence[int] = (10, 20, 40),
                 train: np.ndarray | None = None, config: FitConfig | None = None,
                 progress: Progress | None = None) -> ShapeErrors:
    """Error of people after fitting shape, pose and place: the curve of generalisation.

    Parameters
    ----------
    model : BodyModel
        With shape components.
    people : (S, N, 3) float, metres
        Registered, best people that the model was not trained on.
    counts : ints
        Numbers of components; more than the model has means all of them.
    train : (P, N, 3) float, metres, optional
        The training people, for plain principal components of vertices as a yardstick.
    config : FitConfig, optional
    progress : callable, optional
        Called with the fits done and their number.

    Raises
    ------
    ValueError
        People of another count of vertices or not finite, a count below 1, a model without shape components.
    """
    people, wanted = check_bodies(model.template, people, "people"), check_counts(model, counts)
    largest = ShapeFitter(model, replace(config or FitConfig(), n_betas=wanted[-1]))
    fitters = [largest.first(count) for count in wanted]
    held, fits = [], list[list[ShapeFit]]()
    for done, person in enumerate(people):
        held.append(fit_with_held_pose(model, person, wanted))
        fits.append([])
        for fitter in fitters:
            fits[-1].append(fitter.fit(person, fits[-1][-1] if fits[-1] else None))
            if progress:
                progress(done * len(wanted) + len(fits[-1]), len(people) * len(wanted))
    by_count = list(zip(*fits, strict=True))

    def errors(made: Iterable[Sequence[np.ndarray]]) -> tuple[Errors, ...]:
        return tuple(errors_between(model, bodies, people) for bodies in made)

    return ShapeErrors(
        np.array(wanted), errors([f.vertices for f in row] for row in by_count), errors(zip(*held, strict=True)),
        None if train is None else errors(_by_components(check_bodies(model.template, train, "train"), people,
                                                         wanted)),
        *(np.array([[getattr(f, name) for f in row] for row in by_count])
          for name in ("betas", "pose", "trans", "converged")))


def fit_with_held_pose(model: BodyModel, person: np.ndarray, counts: Sequence[int]) -> list[np.ndarray]:
    """Bodies (N, 3), metres, with betas and place fitted and the pose that of the parts' own best rotations.

    Vertices are affine in betas, so this is linear least squares, and one normal matrix serves all counts.
    """
    J, K = len(model.skeleton.parents), max(counts)
    pose = model.skeleton.pose_of(model.skeleton.fit_rotations(model.template, person))
    by_shape = model.shape_jacobian(pose)[..., :K]
    mean = model.vertices(pose, np.zeros(K), np.zeros(3))
    assert by_shape.shape == (len(mean), 3, K) and pose.shape == (J, 3)
    centred, left = by_shape - by_shape.mean(axis=0), (person - mean) - (person - mean).mean(axis=0)
    columns = centred.reshape(-1, K)
    normal, slope = columns.T @ columns, columns.T @ left.ravel()
    made = []
    for count in counts:
        betas = np.linalg.solve(normal[:count, :count], slope[:count])
        moved = mean + by_shape[..., :count] @ betas
        made.append(moved + (person - moved).mean(axis=0))
    return made


def vertex_components(train: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (3N,) and at most `count` plain principal components (k, 3N), orthonormal, of centred bodies (P, N, 3)."""
    flat = (train - train.mean(axis=1, keepdims=True)).reshape(len(train), -1)
    mean = flat.mean(axis=0)
    flat -= mean
    variances, modes = np.linalg.eigh(flat @ flat.T)
    keep = np.flatnonzero(variances[::-1] > 1e-10 * max(variances[-1], 1e-30))[:count]
    directions = modes[:, ::-1][:, keep].T @ flat
    return mean, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _by_components(train: np.ndarray, people: np.ndarray, counts: Sequence[int]) -> list[list[np.ndarray]]:
    """For each count the people (S, N, 3) as plain principal components of the training people have them, centred."""
    mean, components = vertex_components(train, max(counts))
    middles = people.mean(axis=1, keepdims=True)
    weights = ((people - middles).reshape(len(people), -1) - mean) @ components.T
    return [[(mean + w[:count] @ components[:count]).reshape(-1, 3) + middle
             for w, middle in zip(weights, middles, strict=True)] for count in counts]


def compactness(model: BodyModel) -> np.ndarray:
    """(K,) share of the training people's variance of shape that the first 1..K components explain."""
    return np.asarray(model.explained, dtype=np.float64)


def check_counts(model: BodyModel, counts: Sequence[int]) -> list[int]:
    """Numbers of components, rising, those beyond what the model has cut down to it, or ValueError."""
    if not len(counts) or min(counts) < 1:
        raise ValueError(f"counts: expected numbers from 1 on, got {', '.join(map(str, counts)) or 'none'}")
    if not model.n_betas:
        raise ValueError("model: expected one with shape components, this one has none")
    return sorted({min(int(count), model.n_betas) for count in counts})


def errors_problem(errors: Errors, bodies: np.ndarray, model: BodyModel) -> str | None:
    """Why the errors of bodies (M, N, 3) mean nothing, with the likely cause; None where they mean something."""
    if errors.overall <= HAND * size(model.template):
        return None
    spans = [extent(body) for body in bodies]
    cause = unit_problem(float(np.median(spans)), extent(model.template.vertices), "the bodies are")
    return (f"the model is {1000 * errors.overall:.0f} mm from the bodies on average; "
            f"{cause or 'bodies whose vertices have another order, or another model?'}")
