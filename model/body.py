"""`BodyModel`: what every kind of body model offers."""
from __future__ import annotations

import importlib.metadata
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
from scipy.sparse import csr_array

from scanprep.geometry import storage
from scanprep.geometry.attached import Attached
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.upright import find_up
from scanprep.skeleton.tree import Skeleton

from .bilinear import ShapedPoints
from .blend_weights import skin_weights
from .features import PoseFeatures, restore_features
from .linear import PointOperator, Subject, check_pose

Progress = Callable[[int, int], None]
Up = Literal["x", "y", "z"]          # axis of a template that points up
Model = TypeVar("Model", bound="BodyModel")
VERSION = 3                          # of model files: 1 and 2 had fewer kinds of features, or no pose examples


def share_progress(progress: Progress | None, begin: int, end: int) -> Progress | None:
    """Make the callback of a stage that takes a bar from `begin` to `end` percent, and move the bar to its begin.

    Examples
    --------
    >>> half = share_progress(lambda done, total: print(f"{done} of {total}"), 50, 100)
    50 of 100
    >>> half(1, 2)
    75 of 100
    """
    if progress is None:
        return None
    progress(begin, 100)
    return lambda done, total: progress(begin + (end - begin) * done // max(total, 1), 100)


@dataclass(frozen=True, eq=False)
class Derivatives:
    """Vertices (L, 3), metres, with derivatives by the pose (L, 3, 3J), metres per radian, and the betas (L, 3, k).

    k = 0 for the template's own body, which has no betas. The derivative by trans is the identity for every vertex.
    """

    vertices: np.ndarray
    pose: np.ndarray
    betas: np.ndarray


class BodyModel(ABC):
    """A body as a function of pose, shape and place, with derivatives.

    This is the common interface of `ScapeModel`, `BlendScapeModel` and `SkinningModel`. A new kind of model defines its
    features, betas and surface points (`points`), and what its file adds (`arrays`, `restore`). It also gets a line in
    the table `KINDS` of `model.files`. All else follows; a kind may override methods to make them faster. `resample`,
    `recentre` and `exact_subject` raise ValueError for kinds that do not define them.

    Attributes
    ----------
    kind : str
        The name of the kind of model in files.
    template : Mesh
        N vertices, F triangles.
    skeleton : Skeleton
        J parts and their joints.
    pose_mean : (J, 3) float, radians
        Mean of the training poses.
    pose_covariance : (3J, 3J) float, square radians
        Of the training poses, zero in the root's rows. With the mean it is a Gaussian pose prior.
    pose_examples : (M, J, 3) float, radians
        The training poses, and the poses in which the people of the training set stand; the root is not turned.
        M = 0 in files of earlier versions.
    info : dict
        How the model was made: settings, sizes and a digest of the training set.
    features : PoseFeatures
        The functions of the pose that the deformation by pose is linear in.
    regressor : (J, N) sparse or None
        Joints as combinations of vertices, where a model has its own; else those of the skeleton's rings.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> model.vertices(np.zeros((16, 3)), betas=np.zeros(10)).shape
    (5002, 3)

    [SCAPE] Eq. 6
    """

    kind: ClassVar[str]
    template: Mesh
    skeleton: Skeleton
    pose_mean: np.ndarray
    pose_covariance: np.ndarray
    pose_examples: np.ndarray
    info: dict[str, Any]
    features: PoseFeatures
    regressor: csr_array | None = None

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.template!r}, {len(self.skeleton.parents)} parts, {self.n_betas} betas)"

    @property
    @abstractmethod
    def n_betas(self) -> int:
        """K, the number of shape components."""

    @property
    @abstractmethod
    def explained(self) -> np.ndarray:
        """(K,) share of the shape variance of the training people that the first 1..K components explain."""

    @cached_property
    def joint_regressor(self) -> csr_array:
        """(J, N) weights: `joint_regressor @ vertices` are the joints of a body."""
        return self.skeleton.joint_regressor(self.template) if self.regressor is None else self.regressor

    @abstractmethod
    def points(self, vertex_ids: np.ndarray, weights: np.ndarray | None = None, n_betas: int | None = None
               ) -> ShapedPoints:
        """Build the fast path of chosen surface points as a function of pose, betas and place.

        Parameters
        ----------
        vertex_ids, weights
            As for `Subject.points`.
        n_betas : int, optional
            Of the first components only.
        """

    @cached_property
    def everywhere(self) -> ShapedPoints:
        """All vertices as a function of pose, betas and place."""
        return self.points(np.arange(len(self.template.vertices)))

    def operator(self, betas: np.ndarray | None = None) -> PointOperator:
        """Build the fast path of all vertices with betas (k,), k ≤ K, held; None is the template's own body."""
        return self.everywhere.operator(betas)

    def vertices_of(self, pose: np.ndarray, betas: np.ndarray | None) -> np.ndarray:
        """Compute the vertices (N, 3), metres, at one checked pose (J, 3) and betas (k,).

        The template's root joint is in the origin.
        """
        return self.operator(betas).evaluate(pose) - self.skeleton.joints[0]

    def bodies_of(self, poses: np.ndarray, betas: np.ndarray) -> np.ndarray:
        """Compute the vertices (B, N, 3), metres, at checked poses (B, J, 3) and betas (B, k).

        The result is that of `vertices_of` one by one, up to rounding. Batches of a few dozen are fastest.
        """
        return np.array([self.vertices_of(*each) for each in zip(poses, betas, strict=True)])

    def shape_jacobian(self, pose: np.ndarray, vertex_ids: np.ndarray | None = None) -> np.ndarray:
        """Compute the derivative of the vertices by the betas.

        Vertices are affine in betas, so it depends on the pose alone.

        Parameters
        ----------
        pose : (J, 3) float, radians
            One pose.
        vertex_ids : (L,) int, optional
            Of these vertices only.

        Returns
        -------
        (L, 3, K) float, metres per standard deviation
        """
        pose, _ = check_pose(self.skeleton, pose, None)
        return (self.everywhere if vertex_ids is None else self.points(vertex_ids)).shape_jacobian(pose)

    def pull_back(self, force: np.ndarray, pose: np.ndarray, betas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the gradient by pose (3J,) and betas (k,) of a function with gradient `force` (N, 3) by the vertices.

        Kinds with reverse-mode differentiation of their own need about the time of one evaluation of the vertices.
        """
        derivatives = self.jacobian(pose, betas)
        return np.einsum("nd,ndp->p", force, derivatives.pose), np.einsum("nd,ndk->k", force, derivatives.betas)

    @cached_property
    def skin_weights(self) -> np.ndarray:
        """(N, J) blend weights of the vertices for linear blend skinning; rows sum to 1."""
        return skin_weights(self.template, self.skeleton)

    def rest_joints(self, betas: np.ndarray | None) -> np.ndarray:
        """Compute the joints (J, 3), metres, at zero pose for betas (k,), k ≤ K; None is the template's own body."""
        return np.asarray(self.joint_regressor @ self.vertices(np.zeros(self.skeleton.joints.shape), betas))

    @property
    def pose_directions(self) -> np.ndarray | None:
        """(N, 3, 9 (J - 1)) metres: pose-corrective shapes, the change of the rest vertices by `R - I` of the joints.

        None for a kind of model that is not linear in these.
        """
        return None

    def resample(self: Model, template: Mesh, skeleton: Skeleton, rounds: int, progress: Progress) -> Model:
        """Transfer the model to other triangles of its template's surface; see `change_resolution`."""
        raise ValueError(f"model: the resolution of the kind '{self.kind}' cannot be changed")

    def recentre(self: Model, vertices: np.ndarray, pose: np.ndarray) -> Model:
        """Replace the mean person by a character, given by its vertices (N, 3), metres, in a pose (J, 3)."""
        raise ValueError(f"model: the kind '{self.kind}' cannot take a character")

    def exact_subject(self, vertices: np.ndarray, pose: np.ndarray, betas: np.ndarray | None) -> Subject:
        """Build the subject that reproduces a registered body (N, 3), metres, at a pose (J, 3).

        `betas` (k,) are those whose body comes nearest; what they leave over is added.
        """
        raise ValueError(f"model: the kind '{self.kind}' cannot take the shape of a registered body")

    def with_up(self: Model, up: Up | None) -> Model:
        """Return the model with this axis of its template up, "x", "y" or "z"; None leaves it as it is."""
        return self if up is None else replace(                                  # type: ignore[type-var, return-value]
            self, template=replace(self.template, up="xyz".index(up)))

    def save(self, path: str | Path) -> None:
        """Write the model into one `.npz` file with a JSON header."""
        # arrays that every kind of model has; the kind adds its own
        features, skeleton = self.features, self.skeleton
        arrays = {
            "vertices": self.template.vertices, "faces": self.template.faces.astype(np.int32),
            "part_of_face": skeleton.part_of_face.astype(np.int32), "parents": skeleton.parents,
            "joints": skeleton.joints, "feature_part": features.part, "feature_mix": features.mix,
            "pose_mean": self.pose_mean, "pose_covariance": self.pose_covariance, "pose_examples": self.pose_examples,
            **self.arrays()}
        if (attached := self.template.attached) is not None:
            arrays |= {"whole_vertices": attached.whole.vertices, "whole_faces": attached.whole.faces.astype(np.int32),
                       "whole_body": attached.body.astype(np.int32)}
        header = {"units": {"length": "metre", "angle": "radian", "betas": "standard deviation"},
                  "versions": writer_versions(), "names": list(skeleton.names), "lift": features.lift.kind,
                  "info": self.info, "up": find_up(self.template).up}
        storage.save(path, self.kind, VERSION, arrays, {**header, **self.notes()})

    @classmethod
    def load(cls: type[Model], path: str | Path) -> Model:
        """Read a file of `save`; see `load_model`."""
        header, arrays = storage.load(path, cls.kind, (1, 2, VERSION))
        with storage.taking_apart(path, "a whole model"):
            parts = restore_parts(header, arrays)
            model = cls.restore(parts, restore_features(parts["skeleton"], header, arrays), header, arrays)
            # parts that do not meet have no joint, and fail only when the body is posed
            if not np.isfinite(model.joint_regressor.data).all():
                raise ValueError("joints: expected finite weights of the vertices around each joint")
            return model

    @abstractmethod
    def arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that files of this kind hold besides the common ones."""

    def notes(self) -> dict[str, Any]:
        """Return the entries that file headers of this kind hold besides the common ones."""
        return {}

    @classmethod
    @abstractmethod
    def restore(cls: type[Model], parts: dict[str, Any], features: PoseFeatures, header: Mapping[str, Any],
                arrays: Mapping[str, np.ndarray]) -> Model:
        """Build the model from the contents of its file: common fields (`restore_parts`), features, header, arrays.

        Raises KeyError, TypeError or ValueError for what is missing or does not fit the rest.
        """

    def vertices(self, pose: np.ndarray, betas: np.ndarray | None = None, trans: np.ndarray | None = None
                 ) -> np.ndarray:
        """Compute the vertices for one pose or a batch.

        For many poses of one body, `subject(betas).vertices` gives the same result far faster.

        Parameters
        ----------
        pose : (J, 3) or (B, J, 3) float, radians
            One pose or a batch.
        betas : (k,) or (B, k) float, k ≤ K, optional
            None is the template's own body.
        trans : (3,) or (B, 3) float, metres, optional
            Travel of the root's joint.

        Returns
        -------
        (N, 3) or (B, N, 3) float, metres

        Raises
        ------
        ValueError
            A pose, betas or trans of the wrong shape or not finite.
        """
        # one pose with several betas: the pose is repeated
        if betas is not None and np.ndim(betas) == 2 and np.ndim(pose) == 2:
            pose = np.repeat(np.asarray(pose)[None], len(betas), axis=0)
        pose, trans = check_pose(self.skeleton, pose, trans)
        if betas is not None and np.ndim(betas) == 2 and np.shape(betas)[:1] != pose.shape[:-2]:
            raise ValueError(f"betas: expected as many rows as poses, {pose.shape[:-2]}, got shape {np.shape(betas)}")
        # one exact evaluation a pose, then all are placed
        out = np.empty((*pose.shape[:-2], *self.template.vertices.shape))
        for b in np.ndindex(*pose.shape[:-2]):
            own_betas = None if betas is None else np.asarray(betas)[b] if np.ndim(betas) == 2 else betas
            out[b] = self.vertices_of(pose[b], own_betas)
        return out + (self.skeleton.joints[0] + trans)[..., None, :]

    def subject(self, betas: np.ndarray | None = None, dtype: Any = np.float64) -> Subject:
        """Build the body of one person, ready to be posed fast.

        Parameters
        ----------
        betas : (k,) float, k ≤ K, optional
            None is the template's own body.
        dtype
            float64, or float32 for speed.

        Raises
        ------
        ValueError
            Another type, whose rounding would be visible.
        """
        if np.dtype(dtype) not in (np.float32, np.float64):
            raise ValueError(f"dtype: expected float32 or float64, got {np.dtype(dtype)}")
        return self.subject_of(self.operator(betas).astype(dtype),
                               None if betas is None else np.array(betas, dtype=np.float64))

    def subject_of(self, operator: PointOperator, betas: np.ndarray | None) -> Subject:
        """Build a subject from an operator of all vertices, with the model's pose prior."""
        return Subject(self.template, self.skeleton, betas, operator, self.pose_mean, self.pose_covariance,
                       self.pose_examples, self.info.get("left_out_error"), self.regressor)

    @cached_property
    def mean_subject(self) -> Subject:
        """The mean person, where every search for a shape begins."""
        return self.subject(np.zeros(self.n_betas))

    @cached_property
    def rest_shape_jacobian(self) -> np.ndarray:
        """(N, 3, K) metres, the derivative of the vertices by betas in the pose of the template."""
        return self.shape_jacobian(np.zeros(self.skeleton.joints.shape))

    def jacobian(self, pose: np.ndarray, betas: np.ndarray | None = None, trans: np.ndarray | None = None,
                 vertex_ids: np.ndarray | None = None) -> Derivatives:
        """Compute the vertices at one pose with their derivatives by the pose parameters and the betas.

        Parameters
        ----------
        pose : (J, 3) float, radians
            One pose.
        betas : (k,) float, k ≤ K, optional
            None is the template's own body.
        trans : (3,) float, metres, optional
            Travel of the root's joint.
        vertex_ids : (L,) int, optional
            Of these vertices only.
        """
        N, K = len(self.template.vertices), 0 if betas is None else len(betas)
        # up to a quarter of the vertices, the fast path of those alone is cheaper than tables of all
        by_points = vertex_ids is not None and len(vertex_ids) < 0.25 * N
        ids = np.arange(N) if vertex_ids is None else np.asarray(vertex_ids)
        if by_points:
            shaped = self.points(ids, n_betas=K)
            y, by_pose = shaped.operator(betas).jacobian(pose, trans)
            return Derivatives(y, by_pose, shaped.shape_jacobian(pose))
        y, by_pose = self.subject(betas).points(ids).jacobian(pose, trans)
        by_shape = self.shape_jacobian(pose, ids)[..., :K] if K else np.zeros((len(ids), 3, 0))
        return Derivatives(y, by_pose, by_shape)


def restore_parts(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Read the fields that every kind of model has; files of earlier versions may have no pose examples.

    Raises KeyError, TypeError or ValueError for what is missing or does not fit the rest.
    """
    J = len(np.atleast_1d(arrays["parents"]))
    skeleton = Skeleton(storage.numbers(arrays, "part_of_face", None, kinds="iu"),
                        storage.numbers(arrays, "parents", J, kinds="iu"),
                        storage.numbers(arrays, "joints", J, 3, kinds="f"), tuple(header["names"]))
    # the template, and whether the parts belong to its triangles
    template = Mesh(storage.numbers(arrays, "vertices", None, 3, kinds="f"),
                    storage.numbers(arrays, "faces", None, 3, kinds="iu"), up=header.get("up"))
    if "whole_faces" in arrays:
        template = replace(template, attached=_restore_attached(arrays, template))
    if len(skeleton.part_of_face) != len(template.faces):
        raise ValueError(f"part_of_face: expected one of {len(template.faces)} faces, "
                         f"found {len(skeleton.part_of_face)}")
    # what commands use of the training is of its kind; landmarks are vertex numbers of the template
    info, N = header["info"], len(template.vertices)
    for name, kinds in _INFO.items():
        if info.get(name) is not None and not isinstance(info[name], kinds):
            raise ValueError(f"info: expected {name} as {' or '.join(kind.__name__ for kind in kinds)}, "
                             f"found {str(info[name])[:60]}")
    marks = info.get("landmarks") or {}
    if not all(isinstance(v, int) and 0 <= v < N for v in marks.values()):
        raise ValueError(f"info: expected landmarks on vertices 0..{N - 1}, found {str(marks)[:60]}")
    examples = np.zeros((0, J, 3))
    if header["version"] == VERSION or "pose_examples" in arrays:
        examples = storage.numbers(arrays, "pose_examples", None, J, 3) if len(arrays["pose_examples"]) else examples
    return {"template": find_up(template), "skeleton": skeleton,
            "pose_mean": storage.numbers(arrays, "pose_mean", J, 3),
            "pose_covariance": storage.numbers(arrays, "pose_covariance", 3 * J, 3 * J), "info": info,
            "pose_examples": examples}


_INFO: dict[str, tuple[type, ...]] = {
    "landmarks": (dict,), "sexes": (dict,), "poses": (int,), "shapes": (int,), "left_out_error": (float, int),
    "pose_distance": (float, int), "spikes": (list,), "joint_gaps": (list,), "digests": (list,),
    "people_vertices": (list,)}


def _restore_attached(arrays: Mapping[str, np.ndarray], template: Mesh) -> Attached:
    """Read the whole mesh that the template is the body of; ValueError where they do not belong together."""
    whole = Mesh(storage.numbers(arrays, "whole_vertices", None, 3, kinds="f"),
                 storage.numbers(arrays, "whole_faces", None, 3, kinds="iu"))
    body = storage.numbers(arrays, "whole_body", len(template.vertices), kinds="iu")
    if len(np.unique(body)) < len(body) or body.min() < 0 or body.max() >= len(whole.vertices):
        raise ValueError(f"whole_body: expected different vertices of 0..{len(whole.vertices) - 1}")
    return Attached(whole, body, template)


def restore_variances(arrays: Mapping[str, np.ndarray], total: str) -> tuple[np.ndarray, float]:
    """Read the variances (K,) of the shape components and the total variance from a model file."""
    variances = storage.numbers(arrays, "shape_variances", None)
    whole = float(storage.numbers(arrays, total))
    # components cannot explain more than the total variance, up to 1% of rounding
    if not (variances >= 0).all() or variances.sum() > 1.01 * whole:
        raise ValueError(f"{total}: expected the sum of shape_variances or more, found {whole:g}")
    return variances, whole


def writer_versions() -> dict[str, str]:
    """Return the versions of the programs that write a file."""
    try:
        ours = importlib.metadata.version("scapekit")
    except importlib.metadata.PackageNotFoundError:
        ours = "not installed"
    return {"scapekit": ours, "numpy": np.__version__}
