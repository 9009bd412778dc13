"""Regressing Q on the joint twists: what it may depend on, and how strongly, is chosen inside the training set."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.ranges import Positive, Settings
from scanprep.skeleton.tree import Skeleton

from ..features import Lift, LinearLift, PoseFeatures, QuadraticLift, RadialLift, twists
from ..pose_space import PoseSpace, faces_of_part, kept_directions, nearest_joints

Judge = Callable[[np.ndarray], float]


@dataclass(frozen=True)
class RegressionConfig(Settings):
    """Settings of the regression of Q.

    Parameters
    ----------
    features : {"linear", "quadratic", "radial"}
        What Q is linear in: the twists, also their products, or also Gaussian bells around the seen twists.
    regressor : {"ridge", "svr"}
        Least squares with a penalty, or support-vector regression.
    prunings : floats, square radians
        Twist directions of smaller variance are not regressed on; the best is chosen by leaving poses out.
    ridges : floats, square radians
        Strengths of the penalty; the best is chosen by leaving poses out.
    radii : floats, radians
        Standard deviations of the bells; the best is chosen by leaving poses out.
    tube : float, metres
        Errors of an edge below this cost nothing to support-vector regression.
    """

    features: Literal["linear", "quadratic", "radial"] = "linear"
    regressor: Literal["ridge", "svr"] = "ridge"
    prunings: tuple[float, ...] = (0.003, 0.01, 0.03)
    ridges: tuple[Positive, ...] = (1e-4, 1e-3, 3e-3, 0.01, 0.03, 0.1)
    radii: tuple[Positive, ...] = (0.5, 0.7, 1.0)
    tube: float = 2e-4


@dataclass(frozen=True, eq=False)
class Design:
    """What each triangle regresses on, chosen once; fitting it again to other poses and Q is cheap.

    Parameters
    ----------
    template : Mesh
    features : PoseFeatures
        Before they are made few: every part has all the numbers of all its joints.
    groups : list of (part, features (n,), faces (f,))
        Triangles of one part that regress on the same two joints.
    ridge : float, square radians
    regressor : {"ridge", "svr"}
    tube : float, metres
    left_out_error : float, metres
        What predictions of left-out poses are off.
    pruning, radius : float
        What was chosen.
    """

    template: Mesh
    features: PoseFeatures
    groups: list[tuple[int, np.ndarray, np.ndarray]]
    ridge: float
    regressor: str
    tube: float
    left_out_error: float
    pruning: float
    radius: float

    def fit(self, poses: np.ndarray, Q: np.ndarray) -> PoseSpace:
        """Q as a function of the features.

        Parameters
        ----------
        poses : (M, J, 3) float, radians
        Q : (M, F, 3, 3) float

        [SCAPE] Eq. 4
        """
        features, delta = self.features, self.features.evaluate(poses)
        each = faces_of_part(features.skeleton)
        coefficients = tuple(np.zeros((features.of_part(p).stop - features.of_part(p).start, len(f), 3, 3),
                                      dtype=np.float32) for p, f in enumerate(each))
        place = np.empty(len(self.template.faces), dtype=np.int64)
        for faces in each:
            place[faces] = np.arange(len(faces))
        v_hat = self.template.corners[:, 1:] - self.template.corners[:, :1]
        for part, used, faces in self.groups:
            X, flat = delta[:, used], Q[:, faces].reshape(len(delta), -1)
            centre, mean = X.mean(axis=0), flat.mean(axis=0)
            if self.regressor == "svr":
                slope, mean = _support_vectors(X - centre, Q[:, faces], v_hat[faces], self.ridge, self.tube)
            else:
                slope = _ridge(X - centre, self.ridge) @ flat
            shape, rows = (len(faces), 3, 3), used - features.starts[part]
            coefficients[part][rows[:, None], place[faces]] = slope.reshape(len(used), *shape)
            coefficients[part][0, place[faces]] = (mean - centre @ slope).reshape(shape)
        return PoseSpace(features, coefficients)


def choose_design(template: Mesh, skeleton: Skeleton, poses: np.ndarray, Q: np.ndarray, config: RegressionConfig,
                  judge: Judge, start: Design | None = None) -> Design:
    """The features, pruning and penalty that predict left-out poses best, one sought after the other.

    Parameters
    ----------
    poses : (M, J, 3) float, radians
    Q : (M, F, 3, 3) float
    judge : callable
        The error in metres of predictions (M, F, 3, 3) of Q, each made without its own pose.
    start : Design, optional
        Whose choices to begin with; without it, the middle of what there is to choose from.

    [SCAPE] Eq. 4
    """
    radii = config.radii if config.features == "radial" else (float("nan"),)
    choices = {"pruning": config.prunings, "radius": radii, "ridge": config.ridges}
    at = {name: values[len(values) // 2] for name, values in choices.items()}
    if start is not None:
        at = {name: getattr(start, name) for name in choices}
    best: Design | None = None
    for name, values in choices.items():
        for value in sorted(values, key=lambda v: v != at[name]):              # what stands already comes first
            if best is not None and value == at[name]:
                continue
            tried = _design(template, skeleton, poses, Q, config, judge, **{**at, name: value})
            if best is None or tried.left_out_error < best.left_out_error:
                best = tried
        assert best is not None
        at[name] = getattr(best, name)
    assert best is not None
    return best


def _design(template: Mesh, skeleton: Skeleton, poses: np.ndarray, Q: np.ndarray, config: RegressionConfig,
            judge: Judge, pruning: float, radius: float, ridge: float) -> Design:
    """One design and its error on left-out poses."""
    features = _all_features(skeleton, poses, config.features, pruning, radius)
    groups = _groups(template, features)
    error = judge(_left_out(features.evaluate(poses), groups, Q, ridge))
    return Design(template, features, groups, ridge, config.regressor, config.tube, error, pruning, radius)


def _all_features(skeleton: Skeleton, poses: np.ndarray, kind: str, pruning: float, radius: float) -> PoseFeatures:
    """For every part a constant and the lifted twists of its joints, whitened joint by joint."""
    J = len(skeleton.parents)
    t = twists(poses)
    lift, axes = _make_lift(t, kind, pruning, radius)
    part, columns = [], []
    for p, joints in enumerate(skeleton.joints_of_part):
        part += [p] * (1 + sum(axes[j].shape[1] for j in joints))
        columns.append(np.zeros((J, lift.width, 1)))
        for j in joints:
            column = np.zeros((J, lift.width, axes[j].shape[1]))
            column[j] = axes[j]
            columns.append(column)
    return PoseFeatures(skeleton, lift, np.array(part), np.concatenate(columns, axis=-1))


def _make_lift(t: np.ndarray, kind: str, pruning: float, radius: float) -> tuple[Lift, list[np.ndarray]]:
    """The lift of twists (M, J, 3), and for every joint the mixtures (m, k_j) of its numbers to regress on."""
    J = t.shape[1]
    kept = kept_directions(t, pruning)
    if kind == "linear":
        return LinearLift(), list(kept)
    if kind == "quadratic":
        quadratic, axes = QuadraticLift(), []
        first, second = np.triu_indices(3)
        for j in range(J):
            directions = kept[j]
            k = directions.shape[1]
            mine = np.zeros((9, k + k * (k + 1) // 2))
            mine[:3, :k] = directions
            for c, (a, b) in enumerate(zip(*np.triu_indices(k), strict=True)):
                pair = np.outer(directions[:, a], directions[:, b])
                pair = pair + pair.T
                mine[3:, k + c] = np.where(first == second, 0.5, 1.0) * pair[first, second]
            axes.append(mine)
        return quadratic, axes
    radial = RadialLift(np.ascontiguousarray(t.transpose(1, 0, 2)), np.full(J, radius))
    bells = radial.evaluate(t)[..., 3:]
    axes = []
    for j in range(J):
        if not kept[j].shape[1]:
            axes.append(np.zeros((radial.width, 0)))
            continue
        # the penalty is that of the kernel: on K^-1/2 k(t) a plain ridge is kernel ridge regression
        values, vectors = np.linalg.eigh(bells[:, j])
        good = values > 1e-6 * values[-1]
        k = kept[j].shape[1]
        white = np.zeros((radial.width, k + int(good.sum())))
        white[:3, :k] = kept[j]
        white[3:, k:] = vectors[:, good] / np.sqrt(values[good])
        axes.append(white)
    return radial, axes


def _groups(template: Mesh, features: PoseFeatures) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Triangles of one part that regress on the same joints: (part, features without the constant, faces)."""
    near = nearest_joints(template, features.skeleton)
    groups = []
    for p, faces in enumerate(faces_of_part(features.skeleton)):
        kinds, which = np.unique(near[faces], axis=0, return_inverse=True)
        mine = np.arange(features.count)[features.of_part(p)][1:]
        for g, joints in enumerate(kinds):
            groups.append((p, mine[~(features.uses[mine] & ~joints).any(axis=1)], faces[which.ravel() == g]))
    return groups


def _ridge(centred: np.ndarray, ridge: float) -> np.ndarray:
    """(n, M) matrix that gives the slopes of a ridge regression on centred features (M, n)."""
    M, n = centred.shape
    if n <= M:
        return np.linalg.solve(centred.T @ centred + (M * ridge + 1e-12) * np.eye(n), centred.T)
    return centred.T @ np.linalg.inv(centred @ centred.T + (M * ridge + 1e-12) * np.eye(M))


def _left_out(delta: np.ndarray, groups: list[tuple[int, np.ndarray, np.ndarray]], Q: np.ndarray, ridge: float
              ) -> np.ndarray:
    """Q (M, F, 3, 3) of every pose as ridge regression on the other poses predicts it, in closed form."""
    out = np.empty_like(Q)
    for _, used, faces in groups:
        X = delta[:, used] - delta[:, used].mean(axis=0)
        hat = X @ _ridge(X, ridge) + 1 / len(X)
        target = Q[:, faces].reshape(len(X), -1)
        off = (target - hat @ target) / np.maximum(1 - np.diag(hat), 1e-6)[:, None]
        out[:, faces] = (target - off).reshape(len(X), len(faces), 3, 3)
    return out


def _support_vectors(X: np.ndarray, Q: np.ndarray, v_hat: np.ndarray, ridge: float, tube: float
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (n, 9f) and means (9f,) of support-vector regression of Q (M, f, 3, 3) on centred features (M, n).

    Q of the group is first written in its principal components, weighted as the edges see them: few numbers carry
    all that varies between M poses.

    [SCAPE-patent] §0047
    """
    from sklearn.svm import SVR

    M = len(X)
    mean = Q.mean(axis=0)
    weight = np.sqrt((v_hat**2).sum(axis=(-1, -2)) / 2)[:, None, None]
    scores, values, modes = np.linalg.svd(((Q - mean) * weight).reshape(M, -1), full_matrices=False)
    good = values > 1e-3 * max(values[0], 1e-30)
    unit = values[good] / np.sqrt(M)
    normal = scores[:, good] * np.sqrt(M)                            # unit variance a component
    size = np.sqrt(modes.shape[1])
    slopes, offsets = np.zeros((X.shape[1], len(unit))), np.zeros(len(unit))
    for c in range(len(unit)):
        machine = SVR(kernel="linear", C=1 / max(M * ridge, 1e-12), epsilon=min(tube * size / unit[c], 0.5))
        machine.fit(X, normal[:, c])
        slopes[:, c], offsets[c] = machine.coef_[0], machine.intercept_[0]
    back = (unit[:, None] * modes[good]).reshape(len(unit), *mean.shape) / weight
    flat = back.reshape(len(unit), -1)
    return slopes @ flat, mean.ravel() + offsets @ flat


