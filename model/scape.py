"""The body model: pose and shape to vertices."""
from __future__ import annotations

import importlib.metadata
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints, build_shaped_points
from .gradients import edges
from .linear import Subject, build_basis, check_pose
from .pose_space import JointFeatures, PoseSpace
from .shape_space import ShapeSpace
from .stitching import StitchingSystem

VERSION = 1


@dataclass(frozen=True, eq=False)
class ScapeModel:
    """A body learned from registered meshes, as a function of pose and shape.

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

    kind = "scape"

    def __repr__(self) -> str:
        return f"ScapeModel({self.template!r}, {len(self.skeleton.parents)} parts, {self.n_betas} betas)"

    @property
    def n_betas(self) -> int:
        """K, the number of shape components."""
        return self.shape_space.count

    @cached_property
    def stitching(self) -> StitchingSystem:
        """The stitching system of the template, factored once."""
        return StitchingSystem(self.template, self.skeleton)

    @cached_property
    def _v_hat(self) -> np.ndarray:
        return edges(self.template.vertices, self.template.faces)

    def _posed(self, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """R (F, 3, 3) and `Q v̂` (F, 2, 3) of every triangle at one pose."""
        R = self.skeleton.part_rotations(pose)[self.skeleton.part_of_face]
        return R, self._v_hat @ np.swapaxes(self.pose_space.gradients(pose), -1, -2)

    def vertices(self, pose: np.ndarray, betas: np.ndarray | None = None, trans: np.ndarray | None = None
                 ) -> np.ndarray:
        """Vertices for one pose or a batch, by the sparse solve.

        For many poses of one body, `subject(betas).vertices` is far faster and agrees.

        Parameters
        ----------
        pose : (J, 3) or (B, J, 3) float, radians
        betas : (k,) float, k ≤ K, optional
            None is the template's own body.
        trans : (3,) or (B, 3) float, metres

        Returns
        -------
        (N, 3) or (B, N, 3) float, metres

        Raises
        ------
        ValueError
            A pose, betas or trans of the wrong shape or not finite.

        [SCAPE] Eq. 6, Eq. 9
        """
        pose, trans = check_pose(self.skeleton, pose, trans)
        S = self.shape_space.gradients(betas)
        out = np.empty((*pose.shape[:-2], *self.template.vertices.shape))
        for b in np.ndindex(*pose.shape[:-2]):
            R, posed = self._posed(pose[b])
            out[b] = self.stitching.stitch(posed @ np.swapaxes(R @ S, -1, -2))
        return out + (self.skeleton.joints[0] + trans)[..., None, :]

    def subject(self, betas: np.ndarray | None = None, dtype: Any = np.float64) -> Subject:
        """The body of one person, ready to be posed fast.

        Parameters
        ----------
        betas : (k,) float, k ≤ K, optional
            None is the template's own body.
        dtype
            float64, or float32 for speed.
        """
        basis = build_basis(self.stitching, self.template, self.pose_space, self.shape_space.gradients(betas))
        kept = None if betas is None else np.array(betas, dtype=np.float64)
        return Subject(self.template, self.skeleton, kept, self.pose_space.features,
                       basis.astype(dtype, copy=False), self.skeleton.joints[0], self.pose_mean,
                       self.pose_covariance)

    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None, n_betas: int | None = None
               ) -> ShapedPoints:
        """Some surface points as a function of pose, betas and place, without touching the mesh again.

        Parameters
        ----------
        vertex_ids, weights
            As for `Subject.points`.
        n_betas : int, optional
            Of the first components only.
        """
        return build_shaped_points(self.stitching, self.template, self.pose_space, self.shape_space.first(n_betas),
                                   self.skeleton.joints[0], vertex_ids, weights)

    def shape_jacobian(self, pose: np.ndarray, betas: np.ndarray | None = None, trans: np.ndarray | None = None,
                       vertex_ids: np.ndarray | None = None) -> np.ndarray:
        """Derivative of the vertices with respect to betas.

        Vertices are affine in betas, so it depends on the pose alone.

        Parameters
        ----------
        pose : (J, 3) float, radians
        betas, trans
            Not needed; taken so that the call matches `vertices`.
        vertex_ids : (L,) int, optional
            Of these vertices only.

        Returns
        -------
        (L, 3, K) float, metres per standard deviation
        """
        pose, _ = check_pose(self.skeleton, pose, trans)
        R, posed = self._posed(pose)
        U = self.shape_space.components.astype(np.float64)
        if not len(U):
            return np.zeros((self.template.vertices.shape[0] if vertex_ids is None else len(vertex_ids), 3, 0))
        y = self.stitching.stitch(posed @ np.swapaxes(R @ U, -1, -2))
        return np.moveaxis(y if vertex_ids is None else y[:, vertex_ids], 0, -1)

    def save(self, path: str | Path) -> None:
        """Write the model into one `.npz` file with a JSON header."""
        directions = self.pose_space.features.directions
        arrays = {
            "vertices": self.template.vertices, "faces": self.template.faces.astype(np.int32),
            "part_of_face": self.skeleton.part_of_face.astype(np.int32), "parents": self.skeleton.parents,
            "joints": self.skeleton.joints, "directions": np.concatenate(directions, axis=1).T,
            "direction_count": np.array([d.shape[1] for d in directions]),
            "pose_coefficients": np.concatenate([a.ravel() for a in self.pose_space.coefficients]),
            "shape_mean": self.shape_space.mean, "shape_components": self.shape_space.components,
            "shape_variances": self.shape_space.variances,
            "shape_total_variance": np.array(self.shape_space.total_variance),
            "pose_mean": self.pose_mean, "pose_covariance": self.pose_covariance}
        header = {"units": {"length": "metre", "angle": "radian", "betas": "standard deviation"},
                  "versions": _versions(), "names": list(self.skeleton.names), "info": self.info}
        storage.save(path, self.kind, VERSION, arrays, header)

    @staticmethod
    def load(path: str | Path) -> ScapeModel:
        """Read a file of `save`; see `load_model`."""
        header, a = storage.load(path, ScapeModel.kind, (VERSION,))
        try:
            template = Mesh(a["vertices"], a["faces"])
            skeleton = Skeleton(a["part_of_face"], a["parents"], a["joints"], tuple(header["names"]))
            cuts = np.cumsum(a["direction_count"])[:-1]
            features = JointFeatures(skeleton, tuple(np.split(a["directions"].T, cuts, axis=1)))
            sizes = np.bincount(skeleton.part_of_face)
            n = np.bincount(features.part)
            blocks = np.split(a["pose_coefficients"], np.cumsum(9 * n * sizes)[:-1])
            coefficients = tuple(b.reshape(k, f, 3, 3) for b, k, f in zip(blocks, n, sizes, strict=True))
            shapes = ShapeSpace(a["shape_mean"], a["shape_components"], a["shape_variances"],
                                float(a["shape_total_variance"]))
            return ScapeModel(template, skeleton, PoseSpace(features, coefficients), shapes,
                              a["pose_mean"], a["pose_covariance"], header["info"])
        except (KeyError, ValueError, IndexError) as error:
            raise storage.StorageError(f"{path}: the model lacks or has a damaged part ({error})") from None


def _versions() -> dict[str, str]:
    """What wrote the file."""
    try:
        ours = importlib.metadata.version("scapekit")
    except importlib.metadata.PackageNotFoundError:
        ours = "not installed"
    return {"scapekit": ours, "numpy": np.__version__}


def load_model(path: str | Path) -> ScapeModel:
    """Read a model file of any kind.

    Raises
    ------
    StorageError
        Missing, damaged, or of a kind or version that is not known.
    """
    return ScapeModel.load(path)
