"""One registered body, with all its detail, in other poses."""
from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import singledispatch

import numpy as np

from scanprep.ranges import Settings

from ..body import BodyModel
from ..carriers import build_basis
from ..features import Terms
from ..fitting import FitConfig, PoseFit, ShapeFit, fit_pose, fit_shape
from ..gradients import GradientSystem, edges, shape_gradients
from ..linear import Subject, check_pose
from ..scape import ScapeModel
from ..skinning import SkinningModel


@dataclass(frozen=True)
class TransferConfig(Settings):
    """Settings of `subject_from_body` and `repose`.

    Parameters
    ----------
    smoothness : float
        Times the mean edge length it is w_s of Eq. 8: how far neighbouring triangles share a shape (SCAPE models).
    rounds : int
        How often what is left of the body is added to its shape (SCAPE models).
    fit : FitConfig
        How pose and betas of the body are found; its own shape takes up what a rough fit leaves.
    """

    smoothness: float = 0.001
    rounds: int = 2
    fit: FitConfig = field(default_factory=lambda: FitConfig(polish=0))


@dataclass(frozen=True, eq=False)
class OwnBody:
    """A registered body as a subject of its own.

    Attributes
    ----------
    subject : Subject
    pose : (J, 3) float, radians
        In which the body was registered.
    trans : (3,) float, metres
    vertices : (N, 3) float, metres
        The subject in that pose and place.
    mean, largest : float, metres
        Distances of its vertices from the registered ones.
    """

    subject: Subject
    pose: np.ndarray
    trans: np.ndarray
    vertices: np.ndarray
    mean: float
    largest: float


def subject_from_body(model: BodyModel, vertices: np.ndarray, config: TransferConfig | None = None) -> Subject:
    """The subject whose shape is that of one registered body, detail that betas do not reach included.

    In the body's own pose it is that body, to the millimetre or two that smoothing takes. Its `betas` are the
    fitted ones and describe it only roughly.

    Parameters
    ----------
    model : BodyModel
    vertices : (N, 3) float, metres
        In the topology of the model's template.
    config : TransferConfig, optional

    Raises
    ------
    ValueError
        Vertices of another count or not finite.

    [SCAPE] Eq. 8
    """
    return own_body(model, vertices, config=config).subject


def own_body(model: BodyModel, vertices: np.ndarray, fit: PoseFit | None = None,
             config: TransferConfig | None = None) -> OwnBody:
    """As `subject_from_body`, with the pose and the place of the body.

    Parameters
    ----------
    model : BodyModel
    vertices : (N, 3) float, metres
    fit : PoseFit or ShapeFit, optional
        Of this body; found when not given.
    config : TransferConfig, optional
    """
    config = config or TransferConfig()
    if fit is None:
        fit = fit_shape(model, vertices, config.fit) if model.n_betas else \
            fit_pose(model.subject(None), vertices, config.fit)
    pose, _ = check_pose(model.skeleton, fit.pose, None)
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != model.template.vertices.shape or not np.isfinite(vertices).all():
        raise ValueError(f"vertices: expected finite numbers of shape {model.template.vertices.shape}, "
                         f"got shape {vertices.shape}")
    subject = replace(exact_subject(model, vertices, fit, config),
                      betas=fit.betas if isinstance(fit, ShapeFit) else None)
    ring, share = model.skeleton.joint_weights(model.template, 0)
    trans = share @ vertices[ring] - model.skeleton.joints[0]
    found = subject.vertices(pose, trans)
    far = np.linalg.norm(found - vertices, axis=1)
    return OwnBody(subject, pose, trans, found, float(far.mean()), float(far.max()))


def repose(model: BodyModel, vertices: np.ndarray, poses: np.ndarray, trans: np.ndarray | None = None,
           fit: PoseFit | None = None, config: TransferConfig | None = None) -> np.ndarray:
    """Put one registered body into other poses: its own shape, the pose-dependent deformation of the model.

    Parameters
    ----------
    model : BodyModel
    vertices : (N, 3) float, metres
        The body, in the topology of the model's template.
    poses : (J, 3) or (B, J, 3) float, radians
    trans : (3,) or (B, 3) float, metres, optional
    fit : PoseFit or ShapeFit, optional
        Of this body; found when not given.
    config : TransferConfig, optional

    Returns
    -------
    (N, 3) or (B, N, 3) float, metres

    Raises
    ------
    ValueError
        Vertices of another count or not finite, poses or trans of the wrong shape.

    [SCAPE] Eq. 9
    """
    check_pose(model.skeleton, poses, trans)
    return own_body(model, vertices, fit, config).subject.vertices(poses, trans)


@singledispatch
def exact_subject(model: BodyModel, vertices: np.ndarray, fit: PoseFit, config: TransferConfig) -> Subject:
    """The subject that in the fitted pose is the body with vertices (N, 3), for one kind of model."""
    raise ValueError(f"model: the kind '{model.kind}' cannot take the shape of a registered body")


@exact_subject.register
def _of_triangles(model: ScapeModel, vertices: np.ndarray, fit: PoseFit, config: TransferConfig) -> Subject:
    """S of the betas, and Eq. 8 for what the stitched body then still lacks.

    Eq. 8 for the whole body would take what stitching did to it near the borders of parts, in this one pose, for
    its shape.
    """
    R = np.tensordot(model.rotation_weights, model.skeleton.part_rotations(fit.pose), axes=1)
    v_hat, faces = edges(model.template.vertices, model.template.faces), model.template.faces
    posed = v_hat @ np.swapaxes(model.pose_space.gradients(fit.pose), -1, -2)
    back = np.swapaxes(np.linalg.inv(R), -1, -2)
    system = GradientSystem(model.template, config.smoothness)
    S = model.shape_space.gradients(fit.betas if isinstance(fit, ShapeFit) else None)
    for _ in range(config.rounds):
        left = vertices - model.stitching.stitch(posed @ np.swapaxes(R @ S, -1, -2))
        S += shape_gradients(system, posed, posed + edges(left, faces) @ back) - np.eye(3)
    basis = build_basis(model.stitching, model.template, model.pose_space, S, model.carriers)
    return _subject(model, model.terms, basis)


@exact_subject.register
def _of_vertices(model: SkinningModel, vertices: np.ndarray, fit: PoseFit, config: TransferConfig) -> Subject:
    unposed = replace(model, rest=unpose(model, vertices, fit.pose))
    return _subject(model, unposed.terms, unposed.basis(None))


def _subject(model: BodyModel, terms: Terms, basis: np.ndarray) -> Subject:
    return Subject(model.template, model.skeleton, None, terms, basis, model.skeleton.joints[0], model.pose_mean,
                   model.pose_covariance, model.pose_examples)


def unpose(model: SkinningModel, vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Rest vertices x (N, 3) that skinning carries to the given ones, the root's joint where the template has it.

    With its joints known a vertex is `x = B⁻¹ (y + t - Σ_j below_j T_j joint_j) - c`, and the joints are averages
    of the x again: J equations for the place t and all joints but the root's.
    """
    J, regressor = len(pose), model.joint_regressor
    inverse, turns = np.linalg.inv(model.blended(pose)), model.joint_turns(pose)
    free = np.einsum("nij,nj->ni", inverse, vertices) - model.corrections(pose)
    carry = np.empty((J, len(vertices), 3, 3))                                # of t, then of joints 1.. J-1
    carry[0] = inverse
    for j in range(1, J):
        carry[j] = -model.below[:, j, None, None] * (inverse @ turns[j])
    average = np.stack([(regressor @ each.reshape(-1, 9)).reshape(J, 3, 3) for each in carry], axis=1)
    system = np.zeros((J, J, 3, 3))
    system[np.arange(1, J), np.arange(1, J)] = np.eye(3)                      # the root's joint is not sought
    system -= average
    right = regressor @ free
    right[0] -= model.skeleton.joints[0]
    found = np.linalg.solve(system.transpose(0, 2, 1, 3).reshape(3 * J, 3 * J), right.ravel()).reshape(J, 3)
    return np.asarray(free + np.einsum("jnik,jk->ni", carry, found))
