"""SCAPE and BlendSCAPE: rotations of parts, deformation by pose and by person, stitched into a surface."""
from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from scanprep.geometry import rotations, storage
from scanprep.geometry.carrier import SurfaceCarrier, mount
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
from .resolution.transfer import Piece, gradients_of
from .shape_space import ShapeSpace
from .stitching import StitchingSystem

NORMAL = 0.3                         # weight of normals beside edges when a character is fitted (`recentre`)
SHRINK = 1e-3                        # ridge, as a share of the mean square: decides only what the poses do not show


@dataclass(frozen=True, eq=False, repr=False)
class ScapeModel(BodyModel):
    """SCAPE: each part rotates rigidly, and pose and shape deform each triangle; learned with `learn_scape`.

    The edges of triangle k are `v_k = R_ℓ[k] S_k Q_k v̂_k`: template edges v̂, deformation by pose Q, by shape S, and
    the rotation R of the triangle's part.

    Parameters
    ----------
    template : Mesh
        N vertices, F triangles.
    skeleton : Skeleton
        J parts.
    pose_space : PoseSpace
        Q as a function of the pose.
    shape_space : ShapeSpace
        S as a function of the betas; without components for a model of the template's own body alone.
    pose_mean : (J, 3) float, radians
        Mean of the training poses.
    pose_covariance : (3J, 3J) float, square radians
        Covariance of the training poses, zero in the root's rows.
    info : dict, optional
        How the model was made.
    pose_examples : (M, J, 3) float, radians, optional
        Training poses.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> model.jacobian(np.zeros((16, 3)), np.zeros(2), vertex_ids=[10, 20]).betas.shape
    (2, 3, 2)

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
        """(F, J) weight of each part's rotation for each triangle: 1 for its own part."""
        return rigid_weights(self.skeleton)

    @cached_property
    def parts(self) -> BlendedTemplate:
        """The template with the weights of the rotations that its triangles follow."""
        return BlendedTemplate(self.template, self.skeleton, self.blend_weights)

    @property
    def stitching(self) -> StitchingSystem:
        """The stitching system of the template, factored once."""
        return self.parts.stitching

    @cached_property
    def terms(self) -> Terms:
        """The products of features and rotations in which a fixed body is linear."""
        return self.parts.terms(self.pose_space.features)

    def deform_edges(self, pose: np.ndarray) -> np.ndarray:
        """Compute the edges `Q v̂` (F, 2, 3) of every triangle at one pose (J, 3), metres."""
        return self.parts.deform_edges(self.pose_space.gradients(pose))

    def vertices_of(self, pose: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
        """Compute the vertices (N, 3) by the sparse solve of the whole body.

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
        # the template's own body needs no tables of betas, which are large: they are made only when betas are asked for
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
        # 1. the force on vertices becomes a force z on edges: backwards through the stitching
        R, v_hat, Q = skeleton.part_rotations(pose), self.parts.v_hat, space.gradients(pose)
        pulled = (self.stitching.edge_operator @ self.stitching.solve_adjoint(force)).reshape(-1, 2, 3)
        S, posed = self.shape_space.gradients(betas), v_hat @ np.swapaxes(Q, -1, -2)                 # rows (Q v̂)ᵀ
        local = pulled @ np.tensordot(weights, R, axes=1)                                            # rows (Rᵀ z)ᵀ
        # 2. edges are R S Q v̂: the gradient by each factor, for every triangle (by_R for every part)
        by_S = np.swapaxes(local, -1, -2) @ posed                                                    # Σ_j Rᵀ z (Q v̂)ᵀ
        by_Q = np.swapaxes(S, -1, -2) @ (np.swapaxes(local, -1, -2) @ v_hat)
        by_R = np.tensordot(weights, np.swapaxes(pulled, -1, -2) @ (posed @ np.swapaxes(S, -1, -2)), axes=(0, 0))
        # 3. S is linear in the betas, Q in the features
        components = self.shape_space.components[:len(betas)]
        by_betas = components.reshape(len(components), by_S.size) @ by_S.ravel().astype(components.dtype)
        delta = np.concatenate([a.reshape(len(a), -1) @ by_Q[faces].ravel() for faces, a in
                                zip(space.faces_of_part, space.coefficients, strict=True)])
        # 4. a turn ω of part p changes R_p by hat(ω) R_p, and turns all that hangs below it
        M = by_R @ np.swapaxes(R, -1, -2)
        turn = np.stack([M[:, 2, 1] - M[:, 1, 2], M[:, 0, 2] - M[:, 2, 0], M[:, 1, 0] - M[:, 0, 1]], axis=-1)
        below = skeleton.descends.T.astype(float) @ turn
        by_pose = np.einsum("pd,pdc->pc", below, R @ rotations.right_jacobian(pose))
        by_pose += np.tensordot(delta, space.features.derivative(pose), axes=1)
        return by_pose.ravel(), by_betas.astype(np.float64)

    def recentre(self, vertices: np.ndarray, pose: np.ndarray) -> ScapeModel:
        """Fit the mean S to a character by Eq. 8, then again to what the stitched character lacks.

        Two edges do not determine how a triangle changes along its normal. For people, smoothness decides it well
        enough. A character is squeezed and stretched much more, and bending would invert its triangles. So scaled
        normals are fitted too.

        [SCAPE] Eq. 8
        """
        def with_normals(pairs: np.ndarray) -> np.ndarray:
            """Add a third edge (F, 1, 3): the normal, with the square root of the area as its length. [Sumner]"""
            cross = np.cross(pairs[:, 0], pairs[:, 1])
            length = np.sqrt(np.linalg.norm(cross, axis=1, keepdims=True))
            normal = cross / np.maximum(length, np.finfo(float).tiny)
            return np.concatenate([pairs, NORMAL * normal[:, None]], axis=1)

        posed, target = with_normals(self.deform_edges(pose)), with_normals(self.parts.local_edges(vertices, pose))
        # a tenth of the paper's smoothness: neighbouring triangles of a character differ more than those of people
        solver, S = ShapeSolver(GradientSystem(self.template, 0.0001), posed), np.zeros((len(posed), 3, 3))
        for _ in range(3):                      # the first fit, and twice the rest that it leaves
            S += solver(target - posed @ np.swapaxes(S, -1, -2))
        return replace(self, shape_space=replace(self.shape_space, mean=S.astype(np.float32)))

    def exact_subject(self, vertices: np.ndarray, pose: np.ndarray, betas: np.ndarray | None) -> Subject:
        """Fit S to a registered body: S of the betas, and Eq. 8 for what the stitched body then lacks.

        Eq. 8 for the whole body would mistake effects of stitching near the borders of parts, in this one pose, for
        shape.

        [SCAPE] Eq. 8
        """
        parts, Q, posed = self.parts, self.pose_space.gradients(pose), self.deform_edges(pose)
        system, S = GradientSystem(self.template), self.shape_space.gradients(betas)
        for _ in range(2):                      # the rest is added to the shape twice: stitching spreads some of it
            left = vertices - parts.stitch(S @ Q, pose)
            S += shape_gradients(system, posed, posed + parts.local_edges(left, pose)) - np.eye(3)
        return self.subject_of(parts.operator(self.pose_space, S), None)

    def resample(self, template: Mesh, skeleton: Skeleton, rounds: int, progress: Progress) -> ScapeModel:
        """Carry Q and S over part by part; then, in rounds, regress what is left in many poses and add it.

        [SCAPE] Eq. 4, Eq. 8
        """
        pieces = [Piece(self.template, template, old, new) for old, new in
                  zip(faces_of_part(self.skeleton), faces_of_part(skeleton), strict=True)]
        # Q of every feature: the new triangles deform as the old surface below them does
        coefficients = []
        for piece, a in zip(pieces, self.pose_space.coefficients, strict=True):
            action = a.astype(np.float64)
            average = np.stack([piece.average(each) for each in action])
            coefficients.append(gradients_of(piece.v_hat, piece.edges(action), average).astype(a.dtype))
        # S of mean and components: in the mean pose the new parts have the shapes that the old ones had
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
        # three poses for each feature of the part with the most features determine the regression
        poses = sample_poses(self, max(40, 3 * int(np.bincount(self.features.part).max())), np.random.default_rng(0))
        poses[0], follow = self.pose_mean, mount(self.template, template)
        moved = _with_pose_space(moved, poses, follow.positions(self.subject(None).vertices(poses)), rounds)
        return _with_shape_space(moved, self, follow, poses[:8], rounds, progress) if self.n_betas else moved

    def _resample_fields(self, pieces: list[Piece]) -> dict[str, Any]:
        """Resample the fields that a derived kind adds."""
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
        # coefficients are stored flat, part after part: n features times the triangles of the part
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
        """Read the fields that a derived kind adds."""
        return {}


def _with_pose_space(model: ScapeModel, poses: np.ndarray, wanted: np.ndarray, rounds: int) -> ScapeModel:
    """Correct the pose space so that the template's own body comes to `wanted` (M, N, 3) in poses (M, J, 3).

    [SCAPE] Eq. 4
    """
    for _ in range(rounds):
        space, v_hat = model.pose_space, model.parts.v_hat
        local = model.parts.local_edges(wanted - model.subject(None).vertices(poses), poses)
        # per part, ridge regression of the missing edges on the features, then Q with which v̂ makes these edges
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
    """Correct mean person and shape components so that they agree with those of `teacher` in poses (M, J, 3).

    [SCAPE] Eq. 8
    """
    def people(of: ScapeModel, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the mean person (N, 3) in a pose, and the change (K, N, 3) by each beta."""
        return of.vertices(pose, np.zeros(of.n_betas)), np.moveaxis(of.shape_jacobian(pose), -1, 0)

    # the teacher's bodies in every pose, carried to the vertices of the model
    wanted, total = [], (rounds + 1) * len(poses)
    for pose in poses:
        mean, slope = people(teacher, pose)
        wanted.append((follow.positions(mean), follow.displacements(slope).astype(np.float32)))
        progress(len(wanted), total)
    for number in range(1, rounds + 1):
        # least squares for S of every triangle over all poses: S Q v̂ should be the missing edges
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
    """BlendSCAPE: a SCAPE model in which triangles near borders of parts follow a blend of rotations.

    An edge is `Σ_p w_kp R_p S_k Q_k v̂`; all else is as in SCAPE. Learned with `learn_blendscape`.

    Parameters
    ----------
    blend : (F, J) float
        Weights of the rotations; rows sum to 1, and each triangle has a share of its own part.
    template, skeleton, pose_space, shape_space, pose_mean, pose_covariance, info, pose_examples
        As for `ScapeModel`.

    Raises
    ------
    ValueError
        Weights of another shape, or rows that do not sum to 1.

    Examples
    --------
    >>> from dataclasses import fields
    >>> from model import load_built_in_model
    >>> scape = load_built_in_model()
    >>> same = BlendScapeModel(**{field.name: getattr(scape, field.name) for field in fields(scape)},
    ...                        blend=scape.blend_weights)
    >>> pose = np.full((16, 3), 0.1)
    >>> np.allclose(same.vertices(pose), scape.vertices(pose))
    True

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
