"""Linear blend skinning with pose-corrective shapes: the baseline beside SCAPE, under the same contract."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import csr_array

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .body import BodyModel, restored_parts, restored_variances
from .features import PoseFeatures, Terms, restored_features
from .linear import check_points, check_pose

VERSION = 2                          # 1 had no pose examples
SOFTEST = 0.2                        # a mean of rotations that shrinks further is not undone


@dataclass(frozen=True, eq=False, repr=False)
class SkinningModel(BodyModel):
    """A body whose vertices follow weighted means of the motions of its parts.

    With rest vertices x, joints j, weights w and correctives c, all in the frames of the template,

        y_n = Σ_p w_np (R_p (x_n + c_n(pose) - j_p) + y_jp),    y_jp = y_jparent(p) + R_parent(p) (j_p - j_parent(p))

    and the body is then placed like every other. Rest vertices are affine in betas, and joints follow them.

    Parameters
    ----------
    template : Mesh
    skeleton : Skeleton
    rest : (N, 3) float, metres
        The template's own body at zero pose: its vertices, or what learning made of them.
    weights : (N, J) float
        Not negative, rows that sum to 1.
    features : PoseFeatures
    correctives : (C, N, 3) float, metres
        Displacement of the rest vertices by every feature that is not a constant.
    shape_mean : (N, 3) float, metres
        Rest vertices of the mean person.
    shape_components : (K, N, 3) float, metres
        Their change for one standard deviation of each beta.
    shape_variances : (K,) float, square metres
        Variance over the training people along each component, summed over vertices, largest first.
    shape_total : float, square metres
        The same in all directions.
    pose_mean, pose_covariance, pose_examples, info
        As for `BodyModel`.
    """

    template: Mesh
    skeleton: Skeleton
    rest: np.ndarray
    weights: np.ndarray
    features: PoseFeatures
    correctives: np.ndarray
    shape_mean: np.ndarray
    shape_components: np.ndarray
    shape_variances: np.ndarray
    shape_total: float
    pose_mean: np.ndarray
    pose_covariance: np.ndarray
    info: dict[str, Any] = field(default_factory=dict)
    pose_examples: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)), kw_only=True)

    kind: ClassVar[str] = "skinning"

    def __post_init__(self) -> None:
        N, J, K = len(self.template.vertices), len(self.skeleton.parents), len(self.shape_variances)
        C = self.features.count - J
        for name, shape in (("rest", (N, 3)), ("weights", (N, J)), ("correctives", (C, N, 3)),
                            ("shape_mean", (N, 3)), ("shape_components", (K, N, 3))):
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {getattr(self, name).shape}")
        if not np.allclose(self.weights.sum(axis=1), 1, rtol=0, atol=1e-9) or self.weights.min() < 0:
            raise ValueError("weights: expected rows that are not negative and sum to 1")

    @property
    def n_betas(self) -> int:
        return len(self.shape_components)

    @property
    def explained(self) -> np.ndarray:
        return np.cumsum(self.shape_variances) / max(self.shape_total, np.finfo(float).tiny)

    @cached_property
    def joint_regressor(self) -> csr_array:
        """(J, N) weights: `joint_regressor @ rest vertices` are the joints of a body."""
        return self.skeleton.joint_regressor(self.template)

    @cached_property
    def below(self) -> np.ndarray:
        """(N, J) how much of each vertex follows each part or what hangs below it."""
        return self.weights @ self.skeleton.descends

    @cached_property
    def terms(self) -> Terms:
        """A constant for every part, then each part with the features that correct vertices it carries."""
        bent = np.any(self.correctives != 0, axis=2).astype(np.float32)
        feature, part = np.nonzero(bent @ (self.weights != 0).astype(np.float32))
        free = np.flatnonzero(self.features.constant == 0)
        return Terms(self.features, np.r_[np.arange(len(self.skeleton.parents)), part],
                     np.r_[self.features.starts, free[feature]])

    @cached_property
    def _root(self) -> tuple[np.ndarray, np.ndarray]:
        """The vertices whose weighted mean is the root's joint, and their weights."""
        return self.skeleton.joint_weights(self.template, 0)

    def rest_vertices(self, betas: np.ndarray | None) -> np.ndarray:
        """Vertices (N, 3), metres, at zero pose of the body with betas (k,), k ≤ K; None is the template's own."""
        if betas is None:
            return self.rest.astype(np.float64)
        betas = np.asarray(betas, dtype=np.float64)
        if betas.ndim != 1 or len(betas) > self.n_betas:
            raise ValueError(f"betas: expected at most {self.n_betas} numbers, got shape {betas.shape}")
        if not np.isfinite(betas).all():
            raise ValueError("betas: expected finite numbers")
        return self.shape_mean + np.tensordot(betas, self.shape_components[:len(betas)].astype(np.float64), axes=1)

    def corrections(self, pose: np.ndarray) -> np.ndarray:
        """Displacements (..., N, 3), metres, of the rest vertices at poses (..., J, 3)."""
        delta = self.features.evaluate(pose)[..., self.features.constant == 0]
        return np.tensordot(delta, self.correctives.astype(np.float64), axes=1)

    def vertices_of(self, pose: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
        x = self.rest_vertices(betas)
        joints, R = self.joint_regressor @ x, self.skeleton.part_rotations(pose)
        posed = joints.copy()
        for j in range(1, len(joints)):
            parent = self.skeleton.parents[j]
            posed[j] = posed[parent] + R[parent] @ (joints[j] - joints[parent])
        x = x + self.corrections(pose)
        y = sum(self.weights[:, p, None] * ((x - joints[p]) @ R[p].T + posed[p]) for p in range(len(joints)))
        ids, share = self._root
        return np.asarray(y - share @ y[ids])

    def blended(self, pose: np.ndarray) -> np.ndarray:
        """(N, 3, 3) the weighted mean of the rotations that carry each vertex, at a pose (J, 3)."""
        return np.tensordot(self.weights, self.skeleton.part_rotations(pose), axes=1)

    def joint_turns(self, pose: np.ndarray) -> np.ndarray:
        """(J, 3, 3) `R_parent - R` of every joint: with `below`, how the place of a joint moves a vertex.

        Written out, the chain of joints leaves `y = Σ_p w_p R_p x + Σ_j below_j (R_parent(j) - R_j) j_j`.
        """
        R = self.skeleton.part_rotations(pose)
        turns = R[self.skeleton.parents] - R
        turns[0] = 0                                                          # the root's place is trans
        return turns

    def _products(self, ids: np.ndarray, x: np.ndarray, joints: np.ndarray, bends: bool = True) -> np.ndarray:
        """T (M, n, 3) of every term at some vertices with rest places x (n, 3), wherever the body stands."""
        terms, J = self.terms, len(joints)
        w, below = self.weights[ids].T, self.below[ids].T
        T = np.zeros((terms.count, len(ids), 3))
        T[:J] = w[..., None] * x - below[..., None] * joints[:, None]
        for j in range(1, J):
            T[self.skeleton.parents[j]] += below[j, :, None] * joints[j]
        if bends:
            free = np.cumsum(self.features.constant == 0) - 1
            for m in range(J, terms.count):
                T[m] = w[terms.part[m], :, None] * self.correctives[free[terms.feature[m]], ids]
        return T

    def _placed_products(self, ids: np.ndarray, x: np.ndarray, bends: bool = True) -> np.ndarray:
        """T (M, n, 3) of every term at some vertices of the body with rest vertices x (N, 3)."""
        joints, (ring, share) = self.joint_regressor @ x, self._root
        middle = np.einsum("n,mnd->md", share, self._products(ring, x[ring], joints, bends))
        return self._products(ids, x[ids], joints, bends) - middle[:, None]

    def basis(self, betas: np.ndarray | None = None) -> np.ndarray:
        return self._placed_products(np.arange(len(self.rest)), self.rest_vertices(betas))

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None, n_betas: int | None = None
               ) -> ShapedPoints:
        ids, weights = check_points(len(self.rest), vertex_ids, weights)
        some, place = np.unique(ids, return_inverse=True)
        place = place.reshape(ids.shape)

        def basis(x: np.ndarray, bends: bool) -> np.ndarray:
            T = self._placed_products(some, x, bends)[:, place]
            return T if weights is None else np.einsum("mlkd,lk->mld", T, weights)

        components = self.shape_components[:n_betas].astype(np.float64)
        by_beta = np.zeros((len(components), self.terms.count, len(ids), 3))
        for k, U in enumerate(components):
            by_beta[k] = basis(U, False)
        return ShapedPoints(self.terms, basis(self.rest_vertices(None), True),
                            basis(self.shape_mean.astype(np.float64), True), by_beta, self.skeleton.joints[0])

    def shape_jacobian(self, pose: np.ndarray, vertex_ids: np.ndarray | None = None) -> np.ndarray:
        pose, _ = check_pose(self.skeleton, pose, None)
        (ring, share), U = self._root, self.shape_components.astype(np.float64)
        joints = np.stack([self.joint_regressor @ u for u in U]) if len(U) else np.zeros((0, len(pose), 3))
        moved, B = np.einsum("jde,kje->jkd", self.joint_turns(pose), joints), self.blended(pose)

        def slope(ids: np.ndarray) -> np.ndarray:
            own = B[ids] @ U[:, ids].transpose(1, 2, 0)                       # (n, 3, K)
            return np.asarray(own + np.tensordot(self.below[ids], moved, axes=1).transpose(0, 2, 1))

        ids = np.arange(len(self.rest)) if vertex_ids is None else np.asarray(vertex_ids)
        return slope(ids) - np.tensordot(share, slope(ring), axes=1)

    def unposed(self, vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """(N, 3) rest vertices that the model carries onto a body (N, 3) exactly, joints of their own included.

        The root's joint is where the template has it. `x = B⁻¹ (y - Σ_j below_j turn_j j_j) - c` with joints j = A x is
        first solved for the joints alone.
        """
        back, A, J = unblended(self.blended(pose)), self.joint_regressor, len(pose)
        bare = np.einsum("nij,nj->ni", back, vertices) - self.corrections(pose)
        pull = np.einsum("nj,nik,jkl->nijl", self.below, back, self.joint_turns(pose)).reshape(len(vertices), -1)
        coupling = (A @ pull).reshape(3 * J, 3 * J)
        joints = np.linalg.solve(np.eye(3 * J) + coupling, (A @ bare).ravel())
        x = bare - (pull.reshape(-1, 3 * J) @ joints).reshape(-1, 3)
        return np.asarray(x + self.skeleton.joints[0] - (A @ x)[0])

    def save(self, path: str | Path) -> None:
        arrays = {**self._common_arrays(self.features), **{name: getattr(self, name) for name in _STORED},
                  "shape_variances": self.shape_variances, "shape_total": np.asarray(self.shape_total)}
        storage.save(path, self.kind, VERSION, arrays, self._header(self.features))

    @classmethod
    def load(cls, path: str | Path) -> SkinningModel:
        """Read a file of `save`; see `load_model`."""
        header, a = storage.load(path, cls.kind, (1, VERSION))
        with storage.taking_apart(path, "a whole model"):
            parts = restored_parts(header, a, VERSION)
            stored: dict[str, Any] = {name: storage.numbers(a, name, *(None,) * axes) for name, axes in _STORED.items()}
            stored["shape_variances"], stored["shape_total"] = restored_variances(a, "shape_total")
            return cls(features=restored_features(parts["skeleton"], header, a), **parts, **stored)


_STORED = {"rest": 2, "weights": 2, "correctives": 3, "shape_mean": 2, "shape_components": 3}


def unblended(B: np.ndarray) -> np.ndarray:
    """Inverses (N, 3, 3) of means of rotations, gently where they have collapsed."""
    flat = np.linalg.det(B) < SOFTEST
    if flat.any():
        U, s, Vt = np.linalg.svd(B[flat])
        B = B.copy()
        B[flat] = (U * np.maximum(s, SOFTEST)[:, None]) @ Vt
    return np.linalg.inv(B)
