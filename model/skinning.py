"""Linear blend skinning with pose-corrective shapes, learned or imported, with the interface of `BodyModel`."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.spatial import cKDTree

from scanprep.geometry import storage
from scanprep.geometry.carrier import mount
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton, affine_weights

from .blended import Blended, ShapedBlended
from .body import BodyModel, Progress, restore_variances
from .features import PoseFeatures, RotationLift
from .linear import Subject, combination_weights
from .products import Products, Terms


@dataclass(frozen=True, eq=False, repr=False)
class SkinningModel(BodyModel):
    """Linear blend skinning with pose correctives: vertices follow weighted means of the motions of the parts.

    With rest vertices x, joints j, weights w and correctives c, all in the frames of the template,

        y_n = Σ_p w_np (R_p (x_n + c_n(pose) - j_p) + y_jp),    y_jp = y_jparent(p) + R_parent(p) (j_p - j_parent(p))

    and the body is then placed like every other. Rest vertices are affine in betas, and joints follow them. A model
    with a regressor of its own is placed as in its published formula: trans moves the root's joint of these betas.

    Parameters
    ----------
    template : Mesh
    skeleton : Skeleton
    rest : (N, 3) float, metres
        The template's own body at zero pose: the template's vertices, or those that learning adapted.
    weights : (N, J) float
        Blend weights, not negative; rows sum to 1.
    features : PoseFeatures
        Functions of the pose in which the correctives are linear.
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
    pose_mean, pose_covariance, pose_examples, info, regressor
        As for `BodyModel`.
    joint_components : (K, J, 3) float, metres, optional
        Change of the joints for one standard deviation of each beta, where they do not follow the rest vertices.

    Raises
    ------
    ValueError
        Arrays of another shape; weights that are negative or do not sum to 1.

    Examples
    --------
    >>> from model import load_model
    >>> model = load_model("people-fingers")
    >>> model.kind, len(model.skeleton.parents), model.blend_rotations(np.zeros((46, 3))).shape
    ('skinning', 46, (12500, 3, 3))

    Loper et al., SMPL, 2015.
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
    regressor: csr_array | None = field(default=None, kw_only=True)
    joint_components: np.ndarray | None = field(default=None, kw_only=True)

    kind: ClassVar[str] = "skinning"

    def __post_init__(self) -> None:
        N, J, K = len(self.template.vertices), len(self.skeleton.parents), len(self.shape_variances)
        C = self.features.count - J
        # every array has the sizes of the template, the skeleton, the features and the betas
        for name, shape in (("rest", (N, 3)), ("weights", (N, J)), ("correctives", (C, N, 3)),
                            ("shape_mean", (N, 3)), ("shape_components", (K, N, 3))):
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name}: expected shape {shape}, got {getattr(self, name).shape}")
        for name, shape in (("regressor", (J, N)), ("joint_components", (K, J, 3))):
            if getattr(self, name) is not None and getattr(self, name).shape != shape:
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
    def below(self) -> np.ndarray:
        """(N, J) sum of the weights of each part and of all that hangs below it."""
        return self.weights @ self.skeleton.descends

    @cached_property
    def _root(self) -> tuple[np.ndarray, np.ndarray]:
        """The vertices whose weighted mean is the root's joint, and their weights."""
        return self.skeleton.joint_weights(self.template, 0)

    def rest_vertices(self, betas: np.ndarray | None) -> np.ndarray:
        """Compute the vertices (N, 3), metres, at zero pose for betas (k,), k ≤ K; None is the template's own body."""
        if betas is None:
            return self.rest.astype(np.float64)
        betas = np.asarray(betas, dtype=np.float64)
        if betas.ndim != 1 or len(betas) > self.n_betas:
            raise ValueError(f"betas: expected at most {self.n_betas} numbers, got shape {betas.shape}")
        if not np.isfinite(betas).all():
            raise ValueError("betas: expected finite numbers")
        return self.shape_mean + np.tensordot(betas, self.shape_components[:len(betas)].astype(np.float64), axes=1)

    def rest_joints(self, betas: np.ndarray | None) -> np.ndarray:
        """Compute the joints (J, 3), metres, at zero pose for betas (k,), k ≤ K; None is the template's own body."""
        x = self.rest_vertices(betas)
        if betas is None or self.joint_components is None:
            return np.asarray(self.joint_regressor @ x)
        return self.joint_regressor @ self.shape_mean + np.tensordot(betas, self.joint_components[:len(betas)], axes=1)

    def corrections(self, pose: np.ndarray) -> np.ndarray:
        """Compute the pose correctives (..., N, 3), metres: shifts of the rest vertices at poses (..., J, 3)."""
        delta = self.features.evaluate(pose)[..., self.features.constant == 0]
        return np.tensordot(delta, self.correctives.astype(np.float64), axes=1)

    def vertices_of(self, pose: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
        x, joints, R = self.rest_vertices(betas), self.rest_joints(betas), self.skeleton.part_rotations(pose)
        # joints in the posed body, parents first
        posed = joints.copy()
        for j in range(1, len(joints)):
            parent = self.skeleton.parents[j]
            posed[j] = posed[parent] + R[parent] @ (joints[j] - joints[parent])
        # correctives at rest, then the weighted mean of all rigid motions
        x = x + self.corrections(pose)
        y = sum(self.weights[:, p, None] * ((x - joints[p]) @ R[p].T + posed[p]) for p in range(len(joints)))
        # placed by the root's joint at rest, or by the centroid of the root's vertices
        if self.regressor is not None:
            return np.asarray(y - self.skeleton.joints[0])
        ids, share = self._root
        return np.asarray(y - share @ y[ids])

    def blend_rotations(self, pose: np.ndarray) -> np.ndarray:
        """Compute the weighted mean of part rotations (N, 3, 3) of each vertex, at a pose (J, 3)."""
        return np.tensordot(self.weights, self.skeleton.part_rotations(pose), axes=1)

    def joint_turns(self, pose: np.ndarray) -> np.ndarray:
        """Compute `R_parent - R` (J, 3, 3) of every joint: with `below`, how a joint's position moves a vertex.

        Written out, skinning is `y = Σ_p w_p R_p x + Σ_j below_j (R_parent(j) - R_j) j_j`.
        """
        R = self.skeleton.part_rotations(pose)
        turns = R[self.skeleton.parents] - R
        turns[0] = 0                                                          # trans places the root
        return turns

    @cached_property
    def _terms(self) -> Terms:
        """The products whose sum is the centroid of the root's vertices: constants, then parts times features."""
        J, (ring, _) = len(self.skeleton.parents), self._root
        part, feature = np.meshgrid(np.flatnonzero((self.weights[ring] != 0).any(axis=0)),
                                    np.flatnonzero(self.features.constant == 0), indexing="ij")
        return Terms(self.features, np.r_[np.arange(J), part.ravel()], np.r_[self.features.starts, feature.ravel()])

    def _middle(self, x: np.ndarray, joints: np.ndarray, bends: bool) -> np.ndarray:
        """Compute T (M, 3, 1) of the centroid of the root's vertices, which is held, for rest vertices x (N, 3)."""
        (ring, share), J, terms = self._root, len(joints), self._terms
        T, weights, below = np.zeros((terms.count, 3)), share[:, None] * self.weights[ring], share @ self.below[ring]
        # constant terms: each part's rotation times its vertices and joints
        T[:J] = weights.T @ x[ring] - below[:, None] * joints
        np.add.at(T, self.skeleton.parents[1:], below[1:, None] * joints[1:])
        # correctives: each part's rotation times each feature
        if bends:
            each = np.einsum("rj,crd->jcd", weights, self.correctives[:, ring].astype(np.float64))
            T[J:] = each[(self.weights[ring] != 0).any(axis=0)].reshape(-1, 3)
        return T[..., None]

    @cached_property
    def everywhere(self) -> ShapedBlended:
        J, origin = len(self.skeleton.parents), self.skeleton.joints[0]
        # correctives by the lifted twists of the joints, instead of by their mixtures
        mix = self.features.mix[1:, :, self.features.constant == 0]
        bends = np.tensordot(mix, self.correctives.astype(np.float64), axes=1).swapaxes(-1, -2)
        held, U = self.regressor is None, self.shape_components.astype(np.float64)

        def body(betas: np.ndarray | None) -> Blended:
            x, joints = self.rest_vertices(betas), self.rest_joints(betas)
            middle = Products(self._terms, self._middle(x, joints, True), np.zeros(3)) if held else None
            return Blended(self.features, self.weights, x, joints, np.ascontiguousarray(bends),
                           origin if held else joints[0], middle=middle)

        # derivatives by the betas: of joints, and of the centroid that is held
        joints = self.joint_components
        if joints is None:
            joints = np.stack([self.joint_regressor @ u for u in U]) if len(U) else np.zeros((0, J, 3))
        middles = [self._middle(u, j, False) for u, j in zip(U, joints, strict=True)] if held else []
        own = body(None)
        mean = replace(body(np.zeros(0)), bends=own.bends)
        return ShapedBlended(own, mean, U, joints, np.zeros((len(U), 3)) if held else joints[:, 0],
                             np.array(middles).reshape(len(U), self._terms.count if held else 0, 3, 1))

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None, n_betas: int | None = None
               ) -> ShapedBlended:
        whole = self.everywhere if n_betas is None else self.everywhere.first(n_betas)
        return whole.combine(combination_weights(len(self.rest), vertex_ids, weights))

    def unpose(self, vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """Find the rest vertices (N, 3) that the model carries onto a body (N, 3) exactly, with joints of their own.

        The root's joint is that of the template. `x = B⁻¹ (y - Σ_j below_j turn_j j_j) - c` with joints j = A x is
        first solved for the joints alone.
        """
        back, A, J = invert_blended(self.blend_rotations(pose)), self.joint_regressor, len(pose)
        bare = np.einsum("nij,nj->ni", back, vertices) - self.corrections(pose)
        pull = np.einsum("nj,nik,jkl->nijl", self.below, back, self.joint_turns(pose)).reshape(len(vertices), -1)
        coupling = (A @ pull).reshape(3 * J, 3 * J)
        joints = np.linalg.solve(np.eye(3 * J) + coupling, (A @ bare).ravel())
        x = bare - (pull.reshape(-1, 3 * J) @ joints).reshape(-1, 3)
        return np.asarray(x + self.skeleton.joints[0] - (A @ x)[0])

    def recentre(self, vertices: np.ndarray, pose: np.ndarray) -> SkinningModel:
        return replace(self, shape_mean=self.unpose(vertices, pose))

    def exact_subject(self, vertices: np.ndarray, pose: np.ndarray, betas: np.ndarray | None) -> Subject:
        return replace(self, rest=self.unpose(vertices, pose)).subject(None)

    @property
    def skin_weights(self) -> np.ndarray:
        return self.weights

    @property
    def pose_directions(self) -> np.ndarray | None:
        rotations_alone = self.features.lift.kind == RotationLift.kind and len(self.correctives)
        return np.moveaxis(self.correctives, 0, -1) if rotations_alone else None

    def resample(self, template: Mesh, skeleton: Skeleton, rounds: int, progress: Progress) -> SkinningModel:
        # all fields are carried along the surface; weights stay positive
        follow = mount(self.template, template)

        def displaced(field: np.ndarray) -> np.ndarray:
            return follow.displacements(field.astype(np.float64)).astype(field.dtype)

        weights = np.maximum(follow.values(self.weights), 0)
        rest, shape_mean = (follow.positions(x.astype(np.float64)).astype(x.dtype)
                            for x in (self.rest, self.shape_mean))
        # variances are sums over vertices, whose number changes
        per_vertex = len(template.vertices) / len(self.template.vertices)
        regressor = None
        if self.regressor is not None:
            # own joints: combinations of the new vertices nearest to the old ones and to the joint
            near, places, old = cKDTree(template.vertices), self.regressor @ self.template.vertices, self.regressor
            rows = np.zeros((len(places), len(template.vertices)))
            for j, place in enumerate(places):
                old_vertices = self.template.vertices[old.indices[old.indptr[j]:old.indptr[j + 1]]]
                chosen = np.union1d(near.query(old_vertices)[1], near.query(place, 8)[1])
                rows[j, chosen] = affine_weights(template.vertices[chosen], place)
            regressor = csr_array(rows)
        return replace(
            self, template=template, skeleton=skeleton, rest=rest, weights=weights / weights.sum(axis=1, keepdims=True),
            features=replace(self.features, skeleton=skeleton), correctives=displaced(self.correctives),
            shape_mean=shape_mean, shape_components=displaced(self.shape_components),
            shape_variances=self.shape_variances * per_vertex, shape_total=self.shape_total * per_vertex,
            regressor=regressor)

    def arrays(self) -> dict[str, np.ndarray]:
        out = {**{name: getattr(self, name) for name in _STORED}, "shape_variances": self.shape_variances,
               "shape_total": np.asarray(self.shape_total)}
        if self.regressor is not None:
            sparse = self.regressor.tocoo()
            out |= {"regressor_joint": sparse.coords[0], "regressor_vertex": sparse.coords[1],
                    "regressor_weight": sparse.data, "joint_components": self.everywhere.joints}
        return out

    def notes(self) -> dict[str, Any]:
        return {"own_joints": self.regressor is not None}

    @classmethod
    def restore(cls, parts: dict[str, Any], features: PoseFeatures, header: Mapping[str, Any],
                arrays: Mapping[str, np.ndarray]) -> SkinningModel:
        stored: dict[str, Any] = {name: storage.numbers(arrays, name, *(None,) * axes)
                                  for name, axes in _STORED.items()}
        stored["shape_variances"], stored["shape_total"] = restore_variances(arrays, "shape_total")
        if header.get("own_joints"):
            J, data = len(parts["skeleton"].parents), storage.numbers(arrays, "regressor_weight", None)
            at = tuple(storage.numbers(arrays, f"regressor_{name}", len(data), kinds="iu")
                       for name in ("joint", "vertex"))
            stored["regressor"] = csr_array(coo_array((data, at), shape=(J, len(arrays["vertices"]))))
            stored["joint_components"] = storage.numbers(arrays, "joint_components", None, J, 3)
        return cls(features=features, **parts, **stored)


# arrays in files and their numbers of axes
_STORED = {"rest": 2, "weights": 2, "correctives": 3, "shape_mean": 2, "shape_components": 3}


def invert_blended(B: np.ndarray) -> np.ndarray:
    """Invert blended rotations (N, 3, 3); where they have nearly collapsed, singular values are limited from below."""
    softest = 0.2  # rotations that blend to less than a fifth cancel each other: their inverse would blow up noise
    flat = np.linalg.det(B) < softest
    if flat.any():
        U, s, Vt = np.linalg.svd(B[flat])
        B = B.copy()
        B[flat] = (U * np.maximum(s, softest)[:, None]) @ Vt
    return np.linalg.inv(B)
