"""SCAPE: rotations of parts, deformation by pose and by person, stitched into a surface."""
from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .body import BodyModel, restored_parts, restored_variances, versions
from .carriers import Carrier, build_basis, build_shaped_points, carried_terms, make_carriers, rigid_weights
from .features import PoseFeatures, Terms, linear_features, restored_features
from .gradients import edges
from .linear import check_pose
from .pose_space import PoseSpace
from .shape_space import ShapeSpace
from .stitching import StitchingSystem

VERSION = 3                          # 1 had linear features only, 2 no pose examples


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
    pose_mean : (J, 3) float, radians
    pose_covariance : (3J, 3J) float, square radians
        Of the training poses, zero in the root's rows: a Gaussian prior of the pose.
    pose_examples : (M, J, 3) float, radians
        The training poses themselves, and those in which the people of the training set stand, the root not turned;
        M = 0 in files of earlier versions.
    info : dict
        How the model was made: settings, sizes and a digest of the training set.

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
    def rotation_weights(self) -> np.ndarray:
        """(F, J) how much each rotation carries of each triangle: all of it the one of its own part."""
        return rigid_weights(self.skeleton)

    @cached_property
    def carriers(self) -> list[Carrier]:
        """Which rotations carry which triangles."""
        return make_carriers(self.skeleton, self.rotation_weights)

    @cached_property
    def terms(self) -> Terms:
        return carried_terms(self.pose_space.features, self.carriers)

    @cached_property
    def stitching(self) -> StitchingSystem:
        """The stitching system of the template, factored once."""
        return StitchingSystem(self.template, self.skeleton)

    @cached_property
    def _v_hat(self) -> np.ndarray:
        return edges(self.template.vertices, self.template.faces)

    @cached_property
    def _components_by_face(self) -> np.ndarray:
        """(F, 3 K, 3) the components, row by row of each triangle."""
        U = self.shape_space.components
        return np.ascontiguousarray(U.transpose(1, 2, 0, 3)).reshape(U.shape[1], -1, 3)

    def _posed(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (F, 3, 3), or mixture of rotations, and `Q v̂` (F, 2, 3) of every triangle at one pose."""
        R = np.tensordot(self.rotation_weights, self.skeleton.part_rotations(pose), axes=1)
        return R, self._v_hat @ np.swapaxes(self.pose_space.gradients(pose), -1, -2)

    def vertices_of(self, pose: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
        """By the sparse solve.

        [SCAPE] Eq. 6, Eq. 9
        """
        R, posed = self._posed(pose)
        return self.stitching.stitch(posed @ np.swapaxes(R @ self.shape_space.gradients(betas), -1, -2))

    @cached_property
    def _posed_coefficients(self) -> list[np.ndarray]:
        """For each part (n_p, F_p * 6): `Q v̂` of its triangles, one row a feature."""
        return [(self._v_hat[faces] @ np.swapaxes(a.astype(np.float64), -1, -2)).reshape(len(a), -1)
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
        for carrier in self.carriers:
            faces = self.pose_space.faces_of_part[carrier.part][carrier.chosen]
            turned = shaped[:, faces].reshape(B, -1, 3) @ np.swapaxes(R[:, carrier.turned_by], -1, -2)
            edges[:, faces] += carrier.weights[:, None, None] * turned.reshape(B, -1, 2, 3)
        return self.stitching.stitch(edges)

    def basis(self, betas: np.ndarray | None = None) -> np.ndarray:
        return build_basis(self.stitching, self.template, self.pose_space, self.shape_space.gradients(betas),
                           self.carriers)

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None, n_betas: int | None = None
               ) -> ShapedPoints:
        return build_shaped_points(self.stitching, self.template, self.pose_space, self.shape_space.first(n_betas),
                                   self.carriers, self.skeleton.joints[0], vertex_ids, weights)

    def shape_jacobian(self, pose: np.ndarray, vertex_ids: np.ndarray | None = None) -> np.ndarray:
        pose, _ = check_pose(self.skeleton, pose, None)
        R, posed = self._posed(pose)
        K, F = self.n_betas, len(R)
        if not K:
            return np.zeros((self.template.vertices.shape[0] if vertex_ids is None else len(vertex_ids), 3, 0))
        bent = self._components_by_face.astype(np.float64) @ np.swapaxes(posed, -1, -2)      # F products, not K F
        e = (R @ bent.reshape(F, 3, 2 * K)).reshape(F, 3, K, 2)                             # R U_k Q v̂_j
        rhs = self.stitching.edge_operator.T @ e.transpose(0, 3, 1, 2).reshape(2 * F, 3 * K)
        y = self.stitching.solve(rhs).reshape(-1, 3, K)
        return y if vertex_ids is None else y[vertex_ids]

    def _arrays(self) -> dict[str, np.ndarray]:
        """What the file holds."""
        features = self.pose_space.features
        return {
            "vertices": self.template.vertices, "faces": self.template.faces.astype(np.int32),
            "part_of_face": self.skeleton.part_of_face.astype(np.int32), "parents": self.skeleton.parents,
            "joints": self.skeleton.joints, "feature_part": features.part, "feature_mix": features.mix,
            **{f"lift_{name}": array for name, array in features.lift.arrays().items()},
            "pose_coefficients": np.concatenate([a.ravel() for a in self.pose_space.coefficients]),
            "shape_mean": self.shape_space.mean, "shape_components": self.shape_space.components,
            "shape_variances": self.shape_space.variances,
            "shape_total_variance": np.array(self.shape_space.total_variance),
            "pose_mean": self.pose_mean, "pose_covariance": self.pose_covariance,
            "pose_examples": self.pose_examples}

    def save(self, path: str | Path) -> None:
        header = {"units": {"length": "metre", "angle": "radian", "betas": "standard deviation"},
                  "versions": versions(), "names": list(self.skeleton.names),
                  "lift": self.pose_space.features.lift.kind, "info": self.info}
        storage.save(path, self.kind, VERSION, self._arrays(), header)

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
