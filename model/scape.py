"""SCAPE and BlendSCAPE: rotations of parts, deformation by pose and by person, stitched into a surface."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from scanprep.geometry import rotations, storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .blending import BlendedTemplate, rigid_weights
from .body import BodyModel, restored_parts, restored_variances
from .features import PoseFeatures, linear_features, restored_features
from .linear import check_pose
from .pose_space import PoseSpace
from .products import Products, Terms
from .shape_space import ShapeSpace
from .stitching import StitchingSystem

VERSION = 3                          # 1 had linear features only, 2 no pose examples
AT_ONCE = 1000                       # triangles whose components are near the processor together


@dataclass(frozen=True, eq=False, repr=False)
class ScapeModel(BodyModel):
    """A body learned from registered meshes, every part of which turns stiffly and is deformed triangle by triangle.

    Parameters
    ----------
    template : Mesh
    skeleton : Skeleton
    pose_space : PoseSpace
    shape_space : ShapeSpace
        Without components for a model of the template's own body alone.
    pose_mean, pose_covariance, pose_examples, info
        As for `BodyModel`.

    [SCAPE] Eq. 6
    """

    template: Mesh
    skeleton: Skeleton
    pose_space: PoseSpace
    shape_space: ShapeSpace
    pose_mean: np.ndarray
    pose_covariance: np.ndarray
    info: dict[str, Any] = field(default_factory=dict)
    pose_examples: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 3)), kw_only=True)

    kind: ClassVar[str] = "scape"

    @property
    def n_betas(self) -> int:
        return self.shape_space.count

    @property
    def explained(self) -> np.ndarray:
        return self.shape_space.explained

    @property
    def blend_weights(self) -> np.ndarray:
        """(F, J) how much each rotation counts for each triangle: only the one of its own part does."""
        return rigid_weights(self.skeleton)

    @cached_property
    def parts(self) -> BlendedTemplate:
        """The template with the rotations that its triangles follow."""
        return BlendedTemplate(self.template, self.skeleton, self.blend_weights)

    @property
    def stitching(self) -> StitchingSystem:
        """The stitching system of the template, factored once."""
        return self.parts.stitching

    @cached_property
    def terms(self) -> Terms:
        """The products of features and rotations that a fixed body is linear in."""
        return self.parts.terms(self.pose_space.features)

    def posed_edges(self, pose: np.ndarray) -> np.ndarray:
        """`Q v̂` (F, 2, 3) of every triangle at one pose (J, 3)."""
        return self.parts.posed(self.pose_space.gradients(pose))

    def vertices_of(self, pose: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
        """By the sparse solve.

        [SCAPE] Eq. 6, Eq. 9
        """
        RS = self.parts.rotations(pose) @ self.shape_space.gradients(betas)
        return self.stitching.stitch(self.posed_edges(pose) @ np.swapaxes(RS, -1, -2))

    @cached_property
    def _posed_coefficients(self) -> list[np.ndarray]:
        """For each part (n_p, F_p * 6): `Q v̂` of its triangles, one row a feature."""
        return [(self.parts.v_hat[faces] @ np.swapaxes(a.astype(np.float64), -1, -2)).reshape(len(a), -1)
                for a, faces in zip(self.pose_space.coefficients, self.pose_space.faces_of_part, strict=True)]

    def bodies_of(self, poses: np.ndarray, betas: np.ndarray) -> np.ndarray:
        """All together, part by part.

        [SCAPE] Eq. 6, Eq. 9
        """
        B, R = len(poses), self.skeleton.part_rotations(poses)
        delta = self.pose_space.features.evaluate(poses)
        edges = np.zeros((B, len(self.template.faces), 2, 3))
        shaped = np.empty_like(edges)
        for p, faces in enumerate(self.pose_space.faces_of_part):
            posed = delta[:, self.pose_space.features.of_part(p)] @ self._posed_coefficients[p]
            S = self.shape_space.some_gradients(betas, faces)
            shaped[:, faces] = posed.reshape(B, -1, 2, 3) @ np.swapaxes(S, -1, -2)
        for block in self.parts.blocks:
            faces = self.pose_space.faces_of_part[block.part][block.chosen]
            rotated = shaped[:, faces].reshape(B, -1, 3) @ np.swapaxes(R[:, block.rotation], -1, -2)
            edges[:, faces] += block.weights[:, None, None] * rotated.reshape(B, -1, 2, 3)
        return self.stitching.stitch(edges)

    @property
    def n_features(self) -> int:
        return self.pose_space.features.count

    def operator(self, betas: np.ndarray | None = None) -> Products:
        return self.parts.operator(self.pose_space, self.shape_space.gradients(betas))

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None, n_betas: int | None = None
               ) -> ShapedPoints:
        return self.parts.points(self.pose_space, self.shape_space.first(n_betas), vertex_ids, weights)

    def shape_jacobian(self, pose: np.ndarray, vertex_ids: np.ndarray | None = None) -> np.ndarray:
        pose, _ = check_pose(self.skeleton, pose, None)
        R, posed = self.parts.rotations(pose), self.posed_edges(pose)
        K, F = self.n_betas, len(R)
        if not K:
            return np.zeros((self.template.vertices.shape[0] if vertex_ids is None else len(vertex_ids), 3, 0))
        by_entry = (R[:, None, :, :, None] * posed[:, :, None, None, :]).reshape(F, 6, 9)
        U, e = self.shape_space.components.reshape(K, F, 9), np.empty((F, 6, K))
        for start in range(0, F, AT_ONCE):                                                  # R U_k Q v̂_j
            some = slice(start, start + AT_ONCE)
            e[some] = by_entry[some] @ np.ascontiguousarray(U[:, some].transpose(1, 2, 0), dtype=np.float64)
        rhs = self.stitching.edge_operator.T @ e.reshape(2 * F, 3 * K)
        y = self.stitching.solve(rhs).reshape(-1, 3, K)
        return y if vertex_ids is None else y[vertex_ids]

    def pull_back(self, force: np.ndarray, pose: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        skeleton, space, weights = self.skeleton, self.pose_space, self.blend_weights
        R, v_hat, Q = skeleton.part_rotations(pose), self.parts.v_hat, space.gradients(pose)
        pulled = (self.stitching.edge_operator @ self.stitching.solve_adjoint(force)).reshape(-1, 2, 3)
        S, posed = self.shape_space.gradients(betas), v_hat @ np.swapaxes(Q, -1, -2)                 # rows (Q v̂)ᵀ
        local = pulled @ np.tensordot(weights, R, axes=1)                                            # rows (Rᵀ z)ᵀ
        by_S = np.swapaxes(local, -1, -2) @ posed                                                    # Σ_j Rᵀ z (Q v̂)ᵀ
        by_Q = np.swapaxes(S, -1, -2) @ (np.swapaxes(local, -1, -2) @ v_hat)
        by_R = np.tensordot(weights, np.swapaxes(pulled, -1, -2) @ (posed @ np.swapaxes(S, -1, -2)), axes=(0, 0))
        components = self.shape_space.components[:len(betas)]
        by_betas = components.reshape(len(components), -1) @ by_S.ravel().astype(components.dtype)
        delta = np.concatenate([a.reshape(len(a), -1) @ by_Q[faces].ravel() for faces, a in
                                zip(space.faces_of_part, space.coefficients, strict=True)])
        # a turn ω of part p changes R_p by hat(ω) R_p, and turns all that hangs below it
        M = by_R @ np.swapaxes(R, -1, -2)
        turn = np.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], axis=-1)
        below = skeleton.descends.T.astype(float) @ turn
        by_pose = np.einsum("pd,pdc->pc", below, R @ rotations.right_jacobian(pose))
        by_pose += np.tensordot(delta, space.features.derivative(pose), axes=1)
        return by_pose.ravel(), by_betas.astype(np.float64)

    def _arrays(self) -> dict[str, np.ndarray]:
        return {
            **self._common_arrays(self.pose_space.features),
            "pose_coefficients": np.concatenate([a.ravel() for a in self.pose_space.coefficients]),
            "shape_mean": self.shape_space.mean, "shape_components": self.shape_space.components,
            "shape_variances": self.shape_space.variances,
            "shape_total_variance": np.array(self.shape_space.total_variance)}

    def save(self, path: str | Path) -> None:
        storage.save(path, self.kind, VERSION, self._arrays(), self._header(self.pose_space.features))

    @classmethod
    def load(cls, path: str | Path) -> ScapeModel:
        """Read a file of `save`; see `load_model`."""
        header, a = storage.load(path, cls.kind, (1, 2, VERSION))
        with storage.taking_apart(path, "a whole model"):
            return cls._restored(header, a)

    @classmethod
    def _restored(cls, header: dict[str, Any], a: dict[str, np.ndarray]) -> ScapeModel:
        """The model of a header and the arrays of a file."""
        parts = restored_parts(header, a, VERSION)
        F, skeleton = len(parts["template"].faces), parts["skeleton"]
        if parts["template"].vertex_component.any():
            raise ValueError("vertices: expected one connected surface, which alone can be stitched")
        features = _restored_features(skeleton, header, a)
        sizes, n = np.bincount(skeleton.part_of_face), np.bincount(features.part)
        flat = storage.numbers(a, "pose_coefficients", 9 * int(n @ sizes))
        blocks = np.split(flat, np.cumsum(9 * n * sizes)[:-1])
        coefficients = tuple(b.reshape(k, f, 3, 3) for b, k, f in zip(blocks, n, sizes, strict=True))
        variances, total = restored_variances(a, "shape_total_variance")
        shapes = ShapeSpace(storage.numbers(a, "shape_mean", F, 3, 3),
                            storage.numbers(a, "shape_components", len(variances), F, 3, 3), variances,
                            total)
        return cls(pose_space=PoseSpace(features, coefficients), shape_space=shapes, **parts, **cls._extra(a))

    @classmethod
    def _extra(cls, a: dict[str, np.ndarray]) -> dict[str, Any]:
        """What a kind built on this one keeps besides."""
        return {}


def _restored_features(skeleton: Skeleton, header: dict[str, Any], a: dict[str, np.ndarray]) -> PoseFeatures:
    if header["version"] == 1:
        count = storage.numbers(a, "direction_count", len(skeleton.parents))
        directions = storage.numbers(a, "directions", int(count.sum()), 3)
        return linear_features(skeleton, tuple(np.split(directions.T, np.cumsum(count)[:-1], axis=1)))
    return restored_features(skeleton, header, a)


@dataclass(frozen=True, eq=False, repr=False)
class BlendScapeModel(ScapeModel):
    """A SCAPE model in which triangles near a border follow a mixture of rotations.

    An edge is `Σ_p w_kp R_p S_k Q_k v̂`; all else is as in SCAPE.

    Parameters
    ----------
    blend : (F, J) float
        Weights of the rotations, rows sum to 1; each triangle has a share of its own part.

    [BlendSCAPE]
    """

    blend: np.ndarray = field(kw_only=True)

    kind: ClassVar[str] = "blendscape"

    def __post_init__(self) -> None:
        shape = (len(self.template.faces), len(self.skeleton.parents))
        if self.blend.shape != shape or not np.allclose(self.blend.sum(axis=1), 1, atol=1e-6):
            raise ValueError(f"blend: expected shape {shape} with rows that sum to 1, got {self.blend.shape}")

    @property
    def blend_weights(self) -> np.ndarray:
        return self.blend

    def _arrays(self) -> dict[str, np.ndarray]:
        return {**super()._arrays(), "blend": self.blend}

    @classmethod
    def _extra(cls, a: dict[str, np.ndarray]) -> dict[str, Any]:
        return {"blend": storage.numbers(a, "blend", None, None)}
