"""Regression of Q on the joint twists; features and penalty are chosen by left-out poses of the training set."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from ..features import PoseFeatures, QuadraticLift, linear_features, part_features
from ..pose_space import PoseSpace, faces_of_part, nearest_joints, principal_directions
from .config import LearnConfig


@dataclass(frozen=True, eq=False)
class Design:
    """The features and penalty of the regression, chosen once; fitting them again to other poses and Q is cheap.

    The features are those before `compress`: every part has all features of all its joints. A group is a part, its
    features (n,), and the triangles (f,) that depend on the same two joints. `left_out_error`, metres, is that of left-
    out poses. With a `prior` the penalty draws Q towards the prior instead of towards a constant.
    """

    template: Mesh
    features: PoseFeatures
    groups: list[tuple[int, np.ndarray, np.ndarray]]
    regressor: str
    pruning: float
    ridge: float
    left_out_error: float = float("nan")
    prior: PoseSpace | None = None

    def fit(self, poses: np.ndarray, Q: np.ndarray) -> PoseSpace:
        """Fit Q (M, F, 3, 3), observed at poses (M, J, 3), as a function of the features. [SCAPE] Eq. 4"""
        seen = self.prepare(poses)
        return seen.fit(seen.sums(Q))

    def prepare(self, poses: np.ndarray) -> SeenPoses:
        """Prepare least squares for poses (M, J, 3); support vectors keep every pose by itself."""
        delta, features = self.features.evaluate(poses), self.features
        bases = [np.eye(len(delta)) if self.regressor == "svr" else np.linalg.qr(delta[:, features.of_part(p)])[0]
                 for p in range(len(features.starts))]
        return SeenPoses(self, poses, delta, bases)

    def space(self, solve: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> PoseSpace:
        """Build the pose space from the coefficients (n, 9f) that `solve` returns for each group.

        `solve` gets the features (n,) of the group, the constant of the part first, and its faces (f,).
        """
        features, each = self.features, faces_of_part(self.features.skeleton)
        coefficients = tuple(np.zeros((features.of_part(p).stop - features.of_part(p).start, len(f), 3, 3),
                                      dtype=np.float32) for p, f in enumerate(each))
        place = np.empty(len(self.template.faces), dtype=np.int64)
        for faces in each:
            place[faces] = np.arange(len(faces))
        for part, used, faces in self.groups:
            rows = np.r_[features.starts[part], used]
            coefficients[part][(rows - features.starts[part])[:, None], place[faces]] = \
                solve(rows, faces).reshape(len(rows), len(faces), 3, 3)
        return PoseSpace(features, coefficients)


@dataclass(frozen=True, eq=False)
class SeenPoses:
    """Poses (M, J, 3), their features (M, A), and for every part an orthonormal basis (M, r) of its features' values.

    Least squares needs only the sums of Q over the poses along that basis, which are far fewer than the poses. Where Q
    is itself linear in edges, the sums of the edges are enough.
    """

    design: Design
    poses: np.ndarray
    delta: np.ndarray
    bases: list[np.ndarray]

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Project values (M, F, ...) onto the basis of each triangle's part: sums (r, F, ...)."""
        out = np.zeros((max(basis.shape[1] for basis in self.bases), *values.shape[1:]))
        for basis, faces in zip(self.bases, faces_of_part(self.design.features.skeleton), strict=True):
            along = basis.T @ values[:, faces].reshape(len(values), -1)
            out[:basis.shape[1], faces] = along.reshape(-1, len(faces), *values.shape[2:])
        return out

    def of_space(self, space: PoseSpace) -> np.ndarray:
        """Project the Q of a pose space at the poses: sums (r, F, 3, 3)."""
        delta = space.features.evaluate(self.poses)
        out = np.zeros((max(basis.shape[1] for basis in self.bases), len(self.design.template.faces), 3, 3))
        for p, (basis, faces) in enumerate(zip(self.bases, space.faces_of_part, strict=True)):
            along = basis.T @ delta[:, space.features.of_part(p)]
            out[:basis.shape[1], faces] = np.tensordot(along, space.coefficients[p].astype(np.float64), axes=1)
        return out

    def fit(self, sums: np.ndarray) -> PoseSpace:
        """Fit Q as a function of the features, from its sums (r, F, 3, 3). [SCAPE] Eq. 4"""
        design, M = self.design, len(self.poses)
        if design.prior is not None:            # the residual of the prior is regressed, then the prior is added
            sums = sums - self.of_space(design.prior)
        v_hat = design.template.corners[:, 1:] - design.template.corners[:, :1]

        def solve(used: np.ndarray, faces: np.ndarray) -> np.ndarray:
            # centred features and mean of Q, both in terms of the basis; then slopes, and the constant from the mean
            basis = self.bases[design.features.part[used[0]]]
            ones, X, Q = basis.sum(axis=0), basis.T @ self.delta[:, used[1:]], sums[:basis.shape[1], faces]
            centre, flat = ones @ X / M, Q.reshape(len(Q), -1)
            X, mean = X - np.outer(ones, centre), ones @ flat / M
            if design.regressor == "svr":
                slope, mean = _support_vectors(X, Q, v_hat[faces], design.ridge)
            else:
                slope = ridge_operator(X, M * design.ridge) @ flat
            return np.concatenate([(mean - centre @ slope)[None], slope])

        space = design.space(solve)
        return space if design.prior is None else design.prior.add(space)


Judge = Callable[[Design], float]


def choose_design(template: Mesh, skeleton: Skeleton, poses: np.ndarray, config: LearnConfig, judge: Judge,
                  start: Design | None = None, prior: PoseSpace | None = None) -> Design:
    """Choose pruning and penalty, one after the other, that predict left-out poses of (M, J, 3) best.

    `judge` returns the error of a design in metres. The search begins with the choices of `start`, or with the middle
    ones. All designs have the `prior`.

    [SCAPE] Eq. 4
    """
    choices = {"pruning": config.prunings, "ridge": config.ridges}
    at = {name: values[len(values) // 2] for name, values in choices.items()}
    if start is not None:
        at = {name: getattr(start, name) for name in choices}
    def tried(**chosen: float) -> Design:
        design = replace(make_design(template, skeleton, poses, config, **{**at, **chosen}), prior=prior)
        return replace(design, left_out_error=judge(design))

    best = tried()
    for name, values in choices.items():
        others = [tried(**{name: value}) for value in values if value != at[name]]
        best = min([best, *others], key=attrgetter("left_out_error"))          # among equals the present one stays
        at[name] = getattr(best, name)
    return best


def make_design(template: Mesh, skeleton: Skeleton, poses: np.ndarray, config: LearnConfig, pruning: float,
                ridge: float) -> Design:
    """Build a design: for every part a constant, the varying twist directions of its joints, and maybe products."""
    kept = principal_directions(poses, pruning)
    features = linear_features(skeleton, kept) if config.features == "linear" else part_features(
        skeleton, QuadraticLift(), [QuadraticLift.of_directions(each) for each in kept])
    return Design(template, features, _groups(template, features), config.regressor, pruning, ridge)


def _groups(template: Mesh, features: PoseFeatures) -> list[tuple[int, np.ndarray, np.ndarray]]:
    """Group the triangles of each part that depend on the same joints: (part, features without constant, faces)."""
    near = nearest_joints(template, features.skeleton)
    groups = []
    for p, faces in enumerate(faces_of_part(features.skeleton)):
        kinds, which = np.unique(near[faces], axis=0, return_inverse=True)
        of_part = np.arange(features.count)[features.of_part(p)][1:]
        for g, joints in enumerate(kinds):
            groups.append((p, of_part[~(features.uses[of_part] & ~joints).any(axis=1)], faces[which.ravel() == g]))
    return groups


def ridge_operator(centred: np.ndarray, penalty: float) -> np.ndarray:
    """Compute the matrix (n, M) that gives the slopes of a ridge regression on centred features (M, n)."""
    M, n = centred.shape
    if n <= M:
        return np.linalg.solve(centred.T @ centred + (penalty + 1e-12) * np.eye(n), centred.T)
    return centred.T @ np.linalg.inv(centred @ centred.T + (penalty + 1e-12) * np.eye(M))


def _leave_out_operator(design: Design, delta: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Compute the matrix (M, M) that maps targets to their leave-one-out residuals in ridge regression, in closed form.

    The regression is on the features `used` of `delta` (M, A).
    """
    X = delta[:, used] - delta[:, used].mean(axis=0)
    hat = X @ ridge_operator(X, len(X) * design.ridge) + 1 / len(X)
    return (np.eye(len(X)) - hat) / np.maximum(1 - np.diag(hat), 1e-6)[:, None]


def predict_left_out(design: Design, poses: np.ndarray, Q: np.ndarray) -> np.ndarray:
    """Predict Q (M, F, 3, 3) of every pose by ridge regression on the other poses."""
    delta, out = design.features.evaluate(poses), np.empty_like(Q)
    known = 0.0 if design.prior is None else design.prior.gradients(poses)
    Q = Q - known
    for _, used, faces in design.groups:
        target = Q[:, faces].reshape(len(Q), -1)
        predicted = target - _leave_out_operator(design, delta, used) @ target
        out[:, faces] = predicted.reshape(len(Q), len(faces), 3, 3)
    return out + known


def by_edges(template: Mesh, poses: np.ndarray, Q: np.ndarray) -> Judge:
    """Make a judge of designs: the RMS error, metres, of the edges of left-out poses (M, J, 3) with Q (M, F, 3, 3).

    For designs with a prior, Q is the residual of the prior. The edges T (M, 6f) of a group of triangles have residuals
    L T, so the squared error is trace(L T Tᵀ Lᵀ): the products T Tᵀ are computed once.
    """
    v_hat, products = np.swapaxes(template.corners[:, 1:] - template.corners[:, :1], -1, -2), list[np.ndarray]()

    def error(design: Design) -> float:
        if not products:                                            # groups are the same in all designs of a skeleton
            for _, _, faces in design.groups:
                edges = (Q[:, faces] @ v_hat[faces]).reshape(len(Q), -1)
                products.append(edges @ edges.T)
        delta, total = design.features.evaluate(poses), 0.0
        for (_, used, _), product in zip(design.groups, products, strict=True):
            off = _leave_out_operator(design, delta, used)
            total += float(((off @ product) * off).sum())
        return float(np.sqrt(max(total, 0.0) / (len(Q) * 2 * len(template.faces))))

    return error


def _support_vectors(X: np.ndarray, Q: np.ndarray, v_hat: np.ndarray, ridge: float
                     ) -> tuple[np.ndarray, np.ndarray]:
    """Compute slopes (n, 9f) and means (9f,) of a support-vector regression of Q (M, f, 3, 3) on features (M, n).

    The features are centred. Q is first expressed in its principal components, weighted by edge length, since few
    components carry all variation.

    [SCAPE-patent] §0047
    """
    from sklearn.svm import SVR

    M = len(X)
    mean = Q.mean(axis=0)
    weight = np.sqrt((v_hat**2).sum(axis=(-1, -2)) / 2)[:, None, None]
    # principal components of Q, each scaled to unit variance
    scores, values, modes = np.linalg.svd(((Q - mean) * weight).reshape(M, -1), full_matrices=False)
    good = values > 1e-3 * max(values[0], 1e-30)
    unit = values[good] / np.sqrt(M)
    normal = scores[:, good] * np.sqrt(M)                            # unit variance a component
    size = np.sqrt(modes.shape[1])
    slopes, offsets = np.zeros((X.shape[1], len(unit))), np.zeros(len(unit))
    for c in range(len(unit)):
        # errors of an edge below 0.2 mm cost nothing
        machine = SVR(kernel="linear", C=1 / max(M * ridge, 1e-12), epsilon=min(2e-4 * size / unit[c], 0.5))
        machine.fit(X, normal[:, c])
        slopes[:, c], offsets[c] = machine.coef_[0], machine.intercept_[0]
    back = (unit[:, None] * modes[good]).reshape(len(unit), *mean.shape) / weight
    flat = back.reshape(len(unit), -1)
    return slopes @ flat, mean.ravel() + offsets @ flat


def compress(space: PoseSpace, poses: np.ndarray, template: Mesh, tolerance: float) -> PoseSpace:
    """Combine the features of a pose space into the few mixtures that matter for the edges in poses (M, J, 3).

    The time of the fast path grows with the number of features. In each part edges may change by `tolerance`, metres
    RMS.
    """
    features, delta = space.features, space.features.evaluate(poses)
    v_hat = np.swapaxes(template.corners[:, 1:] - template.corners[:, :1], -1, -2)
    part, mixes, coefficients = [], [], []
    for p, faces in enumerate(space.faces_of_part):
        of_part = features.of_part(p)
        a = space.coefficients[p].astype(np.float64)
        X = delta[:, of_part][:, 1:]
        centre = X.mean(axis=0)
        scale, axes = _principal(X - centre)                        # X - centre = U diag(scale) axesᵀ
        moved = (a[1:] @ v_hat[faces]).reshape(len(a) - 1, 6 * len(faces))
        # r mixtures of the features keep all but `tolerance` of the motion of the edges
        U, s, _ = np.linalg.svd((scale[:, None] * (axes.T @ moved)), full_matrices=False)
        left = np.sqrt(np.maximum(np.cumsum((s**2)[::-1])[::-1], 0) / (len(poses) * 2 * len(faces)))
        r = int((left > tolerance).sum())
        W = axes @ (U[:, :r] / scale[:, None])                      # features -> r numbers of unit scatter
        back = (U[:, :r] * scale[:, None]).T @ axes.T               # r numbers -> features
        kept = np.tensordot(back, a[1:], axes=1)
        constant = a[0] + np.tensordot(centre, a[1:], axes=1) - np.tensordot(centre @ W, kept, axes=1)
        part += [p] * (1 + r)
        mixes.append(np.concatenate([np.zeros((*features.mix.shape[:2], 1)), features.mix[..., of_part][..., 1:] @ W],
                                    axis=-1))
        coefficients.append(np.concatenate([constant[None], kept]).astype(np.float32))
    fewer = PoseFeatures(features.skeleton, features.lift, np.array(part), np.concatenate(mixes, axis=-1))
    return PoseSpace(fewer, tuple(coefficients))


def _principal(X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute scales (k,) and principal axes (n, k) of centred features (M, n), without directions of no variance."""
    _, s, Vt = np.linalg.svd(X, full_matrices=False)
    good = s > 1e-9 * max(s.max(initial=0.0), 1e-9)
    return s[good], Vt[good].T
