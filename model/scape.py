"""SCAPE and BlendSCAPE: rotations of parts, deformation by pose and by person, stitched into a surface."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from scanprep.geometry import rotations, storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .blending import BlendedTemplate, rigid_weights
from .body import BodyModel, Progress, restore_variances
from .condensed import Condensed, ShapedCondensed
from .features import PoseFeatures
from .gradients import GradientSystem, ShapeSolver, shape_gradients
from .linear import Subject, check_pose, combination_weights
from .pose_space import PoseSpace, faces_of_part
from .priors import sample_poses
from .products import Terms
from .resolution.transfer import Piece, SurfaceCarrier, gradients_of
from .shape_space import ShapeSpace
from .stitching import StitchingSystem

NORMAL = 0.3                         # how much normals count beside edges: triangles thicken as they grow
SHRINK = 1e-3                        # of the mean square: holds what the poses do not show


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

    def deform_edges(self, pose: np.ndarray) -> np.ndarray:
        """`Q v̂` (F, 2, 3) of every triangle at one pose (J, 3)."""
        return self.parts.deform_edges(self.pose_space.gradients(pose))

    def vertices_of(self, pose: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
        """By the sparse solve.

        [SCAPE] Eq. 6, Eq. 9
        """
        RS = self.parts.rotations(pose) @ self.shape_space.gradients(betas)
        return self.stitching.stitch(self.deform_edges(pose) @ np.swapaxes(RS, -1, -2))

    def bodies_of(self, poses: np.ndarray, betas: np.ndarray) -> np.ndarray:
        return self.everywhere.bodies(poses, betas)

    @property
    def features(self) -> PoseFeatures:                                                     # type: ignore[override]
        return self.pose_space.features

    @cached_property
    def everywhere(self) -> ShapedCondensed:
        return self.parts.as_shaped(self.pose_space, self.shape_space)

    def operator(self, betas: np.ndarray | None = None) -> Condensed:
        # the tables of all betas are made when they are first asked for
        return self.parts.operator(self.pose_space, self.shape_space.gradients(None)) if betas is None else \
            self.everywhere.operator(betas)

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None, n_betas: int | None = None
               ) -> ShapedPoints:
        whole = self.everywhere if n_betas is None else self.everywhere.first(n_betas)
        return whole.combine(combination_weights(len(self.template.vertices), vertex_ids, weights))

    def shape_jacobian(self, pose: np.ndarray, vertex_ids: np.ndarray | None = None) -> np.ndarray:
        pose, _ = check_pose(self.skeleton, pose, None)
        y = self.everywhere.shape_jacobian(pose)
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

    def recentre(self, vertices: np.ndarray, pose: np.ndarray) -> ScapeModel:
        """S by Eq. 8, and again for what the stitched character then lacks.

        Two edges leave open how a triangle thickens. People are smooth enough to share it with their neighbours; where
        a character is squeezed and stretched, poses that turn triangles out of their plane would then turn them over.
        """
        def with_normals(pairs: np.ndarray) -> np.ndarray:
            """A third edge: square to both, as long as the triangle is wide. [Sumner]"""
            cross = np.cross(pairs[:, 0], pairs[:, 1])
            length = np.sqrt(np.linalg.norm(cross, axis=1, keepdims=True))
            normal = cross / np.maximum(length, np.finfo(float).tiny)
            return np.concatenate([pairs, NORMAL * normal[:, None]], axis=1)

        posed, target = with_normals(self.deform_edges(pose)), with_normals(self.parts.local_edges(vertices, pose))
        # a tenth of the paper's smoothness: a character's triangles share less of their shape than people's
        solver, S = ShapeSolver(GradientSystem(self.template, 0.0001), posed), np.zeros((len(posed), 3, 3))
        for _ in range(3):                      # twice what is left of the character is added to its shape
            S += solver(target - posed @ np.swapaxes(S, -1, -2))
        return replace(self, shape_space=replace(self.shape_space, mean=S.astype(np.float32)))

    def exact_subject(self, vertices: np.ndarray, pose: np.ndarray, betas: np.ndarray | None) -> Subject:
        """S of the betas, and Eq. 8 for what the stitched body then still lacks.

        Eq. 8 for the whole body would take what stitching did to it near the borders of parts, in this one pose, for
        its shape.
        """
        parts, Q, posed = self.parts, self.pose_space.gradients(pose), self.deform_edges(pose)
        system, S = GradientSystem(self.template), self.shape_space.gradients(betas)
        for _ in range(2):                      # twice what is left of the body is added to its shape
            left = vertices - parts.stitch(S @ Q, pose)
            S += shape_gradients(system, posed, posed + parts.local_edges(left, pose)) - np.eye(3)
        return self.subject_of(parts.operator(self.pose_space, S), None)

    def resample(self, template: Mesh, skeleton: Skeleton, rounds: int, progress: Progress) -> ScapeModel:
        """Q and S carried part by part; then, in rounds, what is left in many poses is regressed and added, as in
        learning.

        [SCAPE] Eq. 4, Eq. 8
        """
        pieces = [Piece(self.template, template, old, new) for old, new in
                  zip(faces_of_part(self.skeleton), faces_of_part(skeleton), strict=True)]
        coefficients = []
        for piece, a in zip(pieces, self.pose_space.coefficients, strict=True):
            action = a.astype(np.float64)
            average = np.stack([piece.average(each) for each in action])
            coefficients.append(gradients_of(piece.v_hat, piece.edges(action), average).astype(a.dtype))
        # S with which the parts, in the mean pose, have the shapes they had
        old, F, Q = self.shape_space, len(template.faces), self.pose_space.gradients(self.pose_mean)
        shapes = replace(old, mean=np.empty((F, 3, 3), dtype=old.mean.dtype),
                         components=np.empty((old.count, F, 3, 3), dtype=old.components.dtype))
        for piece in pieces:
            S = np.concatenate([old.mean[None, piece.old_faces], old.components[:, piece.old_faces]]).astype(np.float64)
            bent, average = Q[piece.old_faces], np.stack([piece.average(each) for each in S])
            S = gradients_of(piece.edges(bent[None])[0], piece.edges(S @ bent), average)
            shapes.mean[piece.new_faces], shapes.components[:, piece.new_faces] = S[0], S[1:]
        space = PoseSpace(replace(self.features, skeleton=skeleton), tuple(coefficients))
        moved = replace(self, template=template, skeleton=skeleton, pose_space=space, shape_space=shapes,
                        **self._resample_fields(pieces))
        if not rounds:
            return moved
        # three poses for each feature of the part that has most
        poses = sample_poses(self, max(40, 3 * int(np.bincount(self.features.part).max())), np.random.default_rng(0))
        poses[0], follow = self.pose_mean, SurfaceCarrier(self.template, template)
        moved = _with_pose_space(moved, poses, follow.positions(self.subject(None).vertices(poses)), rounds)
        return _with_shape_space(moved, self, follow, poses[:8], rounds, progress) if self.n_betas else moved

    def _resample_fields(self, pieces: list[Piece]) -> dict[str, Any]:
        """What a kind built on this one keeps besides, on other triangles."""
        return {}

    def arrays(self) -> dict[str, np.ndarray]:
        return {"pose_coefficients": np.concatenate([a.ravel() for a in self.pose_space.coefficients]),
                "shape_mean": self.shape_space.mean, "shape_components": self.shape_space.components,
                "shape_variances": self.shape_space.variances,
                "shape_total_variance": np.array(self.shape_space.total_variance)}

    @classmethod
    def restore(cls, parts: dict[str, Any], features: PoseFeatures, header: Mapping[str, Any],
                arrays: Mapping[str, np.ndarray]) -> ScapeModel:
        F, skeleton = len(parts["template"].faces), parts["skeleton"]
        if parts["template"].vertex_component.any():
            raise ValueError("vertices: expected one connected surface, which alone can be stitched")
        sizes, n = np.bincount(skeleton.part_of_face), np.bincount(features.part)
        flat = storage.numbers(arrays, "pose_coefficients", 9 * int(n @ sizes))
        blocks = np.split(flat, np.cumsum(9 * n * sizes)[:-1])
        coefficients = tuple(b.reshape(k, f, 3, 3) for b, k, f in zip(blocks, n, sizes, strict=True))
        variances, total = restore_variances(arrays, "shape_total_variance")
        shapes = ShapeSpace(storage.numbers(arrays, "shape_mean", F, 3, 3),
                            storage.numbers(arrays, "shape_components", len(variances), F, 3, 3), variances, total)
        return cls(pose_space=PoseSpace(features, coefficients), shape_space=shapes, **parts, **cls._extra(arrays))

    @classmethod
    def _extra(cls, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """What a kind built on this one keeps besides."""
        return {}


def _with_pose_space(model: ScapeModel, poses: np.ndarray, wanted: np.ndarray, rounds: int) -> ScapeModel:
    """The model with a pose space corrected on the template's own body, which is wanted (M, N, 3) in poses (M, J, 3).

    [SCAPE] Eq. 4
    """
    for _ in range(rounds):
        space, v_hat = model.pose_space, model.parts.v_hat
        local = model.parts.local_edges(wanted - model.subject(None).vertices(poses), poses)
        delta, coefficients = space.features.evaluate(poses), []
        for p, faces in enumerate(space.faces_of_part):
            X = delta[:, space.features.of_part(p)]
            shrink = SHRINK * np.diag(np.maximum((X**2).sum(axis=0), 1e-12))
            slope = np.linalg.solve(X.T @ X + shrink, X.T @ local[:, faces].reshape(len(X), -1))
            more = gradients_of(v_hat[faces], slope.reshape(-1, len(faces), 2, 3))
            coefficients.append((space.coefficients[p] + more).astype(space.coefficients[p].dtype))
        model = replace(model, pose_space=PoseSpace(space.features, tuple(coefficients)))
    return model


def _with_shape_space(model: ScapeModel, teacher: ScapeModel, follow: SurfaceCarrier, poses: np.ndarray, rounds: int,
                      progress: Progress) -> ScapeModel:
    """The model with a mean person and shape components corrected in poses (M, J, 3), where those of the teacher are.

    [SCAPE] Eq. 8
    """
    def people(of: ScapeModel, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mean person (N, 3) in a pose, and the change (K, N, 3) by each beta."""
        return of.vertices(pose, np.zeros(of.n_betas)), np.moveaxis(of.shape_jacobian(pose), -1, 0)

    wanted, total = [], (rounds + 1) * len(poses)
    for pose in poses:
        mean, slope = people(teacher, pose)
        wanted.append((follow.positions(mean), follow.displacements(slope).astype(np.float32)))
        progress(len(wanted), total)
    for number in range(1, rounds + 1):
        square, product = np.zeros((3, 3)), np.zeros((3, 3))
        for i, (pose, (y, dy)) in enumerate(zip(poses, wanted, strict=True), start=1):
            mean, slope = people(model, pose)
            local = model.parts.local_edges(np.concatenate([(y - mean)[None], dy - slope]), pose)
            posed = model.deform_edges(pose)
            square = square + np.swapaxes(posed, -1, -2) @ posed
            product = product + np.swapaxes(local, -1, -2) @ posed
            progress(number * len(poses) + i, total)
        shrink = SHRINK * np.trace(square, axis1=-2, axis2=-1)[:, None, None] * np.eye(3)
        more, space = product @ np.linalg.inv(square + shrink), model.shape_space
        model = replace(model, shape_space=replace(
            space, mean=(space.mean + more[0]).astype(space.mean.dtype),
            components=(space.components + more[1:]).astype(space.components.dtype)))
    return model


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

    def arrays(self) -> dict[str, np.ndarray]:
        return {**super().arrays(), "blend": self.blend}

    def _resample_fields(self, pieces: list[Piece]) -> dict[str, Any]:
        blend = np.empty((sum(len(piece.new_faces) for piece in pieces), self.blend.shape[1]))
        for piece in pieces:
            blend[piece.new_faces] = piece.average(self.blend[piece.old_faces])
        return {"blend": blend}

    @classmethod
    def _extra(cls, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
        return {"blend": storage.numbers(arrays, "blend", None, None)}
