"""Regressing Q over the bodies of many people, each of whom has something of their own that no pose explains."""
from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from operator import attrgetter

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from ..pose_space import PoseSpace
from .config import LearnConfig
from .regression import RADII, Design, make_design


@dataclass(frozen=True, eq=False)
class Within:
    """The transform that makes a regression with a random effect a person an ordinary one; `who` (M,) says whose each
    body is, 0..P-1. From every body a share of the mean over its person's bodies is taken, the larger the more there
    are. What people have of their own weighs little then; where each has one body only, all are weighed alike.
    """

    who: np.ndarray

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """Values (M, ...) without that share."""
        out = np.array(values, dtype=np.float64)
        for person in range(int(self.who.max()) + 1):
            mine = self.who == person
            # 30: variance between people over that within, of what regression does not explain
            out[mine] -= (1 - 1 / np.sqrt(1 + 30.0 * mine.sum())) * out[mine].mean(axis=0)
        return out

    def without_the_person(self, X: np.ndarray, operator: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Residuals (M, n) of transformed targets, every person predicted from the others, in closed form, with
        transformed features X (M, k) and the operator (k, M) from targets to coefficients.
        """
        hat = X @ operator
        left = target - hat @ target
        for person in range(int(self.who.max()) + 1):
            mine = np.flatnonzero(self.who == person)
            left[mine] = np.linalg.solve(np.eye(len(mine)) * (1 + 1e-9) - hat[np.ix_(mine, mine)], left[mine])
        return left


def choose_within(template: Mesh, skeleton: Skeleton, poses: np.ndarray, Q: np.ndarray, who: np.ndarray,
                  config: LearnConfig) -> Design:
    """The pruning and penalty that predict the edges of left-out people best, of poses (M, J, 3), Q (M, F, 3, 3), and
    whose body each is (M,). [SCAPE] Eq. 4
    """
    designs = (make_design(template, skeleton, poses, config, pruning, RADII[0], ridge)
               for pruning, ridge in product(config.prunings, config.ridges))
    return min((replace(design, left_out_error=_left_out_error(design, poses, Q, who)) for design in designs),
               key=attrgetter("left_out_error"))


def fit_within(design: Design, poses: np.ndarray, Q: np.ndarray, who: np.ndarray) -> PoseSpace:
    """Q as a function of the features, as `Design.fit`, were it not for what each person has of their own.
    [SCAPE] Eq. 4
    """
    within = Within(who)
    delta = within(design.features.evaluate(poses))
    return design.space(lambda used, faces: _operator(delta[:, used], design.ridge) @ within(Q[:, faces]).reshape(
        len(poses), -1))


def _operator(X: np.ndarray, ridge: float) -> np.ndarray:
    """(k, M) from targets to coefficients of features (M, k), the first of which is the constant and free."""
    penalty = np.full(X.shape[1], len(X) * ridge + 1e-12)
    penalty[0] = 1e-12
    return np.linalg.solve(X.T @ X + np.diag(penalty), X.T)


def _left_out_error(design: Design, poses: np.ndarray, Q: np.ndarray, who: np.ndarray) -> float:
    """Root mean square error in metres of the edges of left-out people, apart from what is their own."""
    within = Within(who)
    delta, total = within(design.features.evaluate(poses)), 0.0
    v_hat = np.swapaxes(design.template.corners[:, 1:] - design.template.corners[:, :1], -1, -2)
    for part, used, faces in design.groups:
        X = delta[:, np.r_[design.features.starts[part], used]]
        target = within(Q[:, faces] @ v_hat[faces]).reshape(len(poses), -1)
        total += float((within.without_the_person(X, _operator(X, design.ridge), target) ** 2).sum())
    return float(np.sqrt(total / (Q.shape[0] * Q.shape[1] * 2)))


def held_out_bodies(who: np.ndarray, share: float) -> np.ndarray:
    """Bodies to hold out, evenly from the whole: all of some people, or where there are few people any bodies."""
    # from here on whole people are held out, otherwise bodies of any
    groups = who if who.max() + 1 >= 5 else np.arange(len(who))
    count = int(groups.max()) + 1
    chosen = np.linspace(0, count - 1, max(1, round(share * count)) + 2).round().astype(int)[1:-1]
    return np.flatnonzero(np.isin(groups, chosen))


def number_people(subjects: Sequence[Hashable], count: int) -> np.ndarray:
    """(M,) numbers of the people in order of appearance, or ValueError."""
    if len(subjects) != count:
        raise ValueError(f"subjects: expected {count} labels, one a body, got {len(subjects)}")
    order = {label: i for i, label in enumerate(dict.fromkeys(subjects))}
    if len(order) < 2 or count < 4:
        raise ValueError(f"subjects: expected at least 2 people and 4 bodies, got {len(order)} people and "
                         f"{count} bodies; learn_scape learns from the poses of one person")
    return np.array([order[label] for label in subjects])
