"""Bodies of one person share their betas."""
from __future__ import annotations

import numpy as np

from .linear import LinearBodies


def shared_shape(linear: LinearBodies, x: np.ndarray, people: np.ndarray, n_betas: int) -> LinearBodies:
    """The same bodies with betas common to those of a person: one problem a person.

    Unknowns of a person are pose and place of the bodies one after the other, and the betas, a step from the mean
    of those that the bodies have by themselves. Rows of a candidate are those in all the bodies.

    Parameters
    ----------
    linear : LinearBodies
        One problem a body.
    x : (Z, P) float
        Unknowns around which it was linearised; betas come last.
    people : (Z,) int
        Whose body each is.
    n_betas : int

    Raises
    ------
    ValueError
        People with different numbers of bodies.
    """
    names, each = np.unique(people, return_counts=True)
    if len(people) != len(x) or len(set(each.tolist())) > 1:
        raise ValueError(f"people: expected one of each of {len(x)} bodies, and as many bodies of every person, got "
                         f"{len(people)} with {each.tolist()}")
    bodies, F, K = np.argsort(people, kind="stable"), int(each[0]), n_betas
    Z, P = x.shape
    n, own = P - K, slice(P - K, P)
    shift = np.zeros((len(names), F, P))
    betas = x[bodies][:, own].reshape(len(names), F, K)
    shift[..., own] = betas.mean(axis=1, keepdims=True) - betas
    at = _moved(linear.of(bodies), shift.reshape(Z, P))
    C, r = at.gaps.shape[1:]
    rows, gaps = np.zeros((len(names), C, F * r, F * n + K)), at.gaps.reshape(len(names), F, C, r)
    gram, pull = np.zeros((len(names), F * n + K, F * n + K)), np.zeros((len(names), F * n + K))
    precision, lean = np.zeros(gram.shape[1:]), np.zeros_like(pull)
    alone = (at.rows.reshape(len(names), F, C, r, P), at.gram.reshape(len(names), F, P, P),
             at.pull.reshape(len(names), F, P), at.lean.reshape(len(names), F, P))
    for f in range(F):
        B, G, p, lean_f = (a[:, f] for a in alone)
        mine = np.r_[f * n:(f + 1) * n, F * n:F * n + K]
        rows[:, :, f * r:(f + 1) * r, mine] = B
        gram[:, mine[:, None], mine] += G / F
        pull[:, mine] += p / F
        lean[:, mine[:n]] = lean_f[:, :n]
        precision[mine[:n, None], mine[:n]] = linear.precision[:n, :n]
    precision[F * n:, F * n:] = linear.precision[own, own]
    lean[:, F * n:] = alone[3][:, 0, own]                            # all bodies are at the same betas now
    return LinearBodies(rows, gaps.transpose(0, 2, 1, 3).reshape(len(names), C, F * r), gram, pull,
                        at.rest.reshape(len(names), F).mean(axis=1), precision, lean)


def _moved(linear: LinearBodies, shift: np.ndarray) -> LinearBodies:
    """The same affine bodies, with steps counted from where `shift` (Z, P) leads."""
    gaps = linear.gaps - (linear.rows @ shift[:, None, :, None])[..., 0]
    pull = linear.pull - (linear.gram @ shift[..., None])[..., 0]
    return LinearBodies(linear.rows, gaps, linear.gram, pull, linear.left(shift), linear.precision,
                        linear.lean - shift @ linear.precision)
