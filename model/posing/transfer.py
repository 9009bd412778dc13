"""One registered body, with all its detail, in other poses."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..body import BodyModel
from ..fitting.vertices import FitConfig, PoseFit, ShapeFit, fit_pose, fit_shape
from ..linear import Subject, check_pose

QUICK = FitConfig(polish=0)          # of pose and betas: the body's own shape takes up what a rough fit leaves


@dataclass(frozen=True, eq=False)
class OwnBody:
    """A registered body as a subject of its own, the pose (J, 3) and place (3,) in which it was registered, the subject
    there (N, 3), and how far its vertices are from the registered ones, metres.
    """

    subject: Subject
    pose: np.ndarray
    trans: np.ndarray
    vertices: np.ndarray
    mean: float
    largest: float


def subject_from_body(model: BodyModel, vertices: np.ndarray) -> Subject:
    """The subject whose shape is that of one registered body, detail that betas do not reach included.

    In the body's own pose it is that body, to the millimetre or two that smoothing takes; in others the pose-dependent
    deformation of the model is added. Its `betas` are the fitted ones and describe it only roughly.

    Parameters
    ----------
    model : BodyModel
    vertices : (N, 3) float, metres
        In the topology of the model's template.

    Raises
    ------
    ValueError
        Vertices of another count or not finite.

    [SCAPE] Eq. 8, 9
    """
    return own_body(model, vertices).subject


def own_body(model: BodyModel, vertices: np.ndarray, fit: PoseFit | None = None) -> OwnBody:
    """As `subject_from_body`, with the pose and the place of the body, which are found unless a fit is given."""
    if fit is None:
        fit = fit_shape(model, vertices, QUICK) if model.n_betas else fit_pose(model.subject(None), vertices, QUICK)
    pose, _ = check_pose(model.skeleton, fit.pose, None)
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != model.template.vertices.shape or not np.isfinite(vertices).all():
        raise ValueError(f"vertices: expected finite numbers of shape {model.template.vertices.shape}, "
                         f"got shape {vertices.shape}")
    betas = fit.betas if isinstance(fit, ShapeFit) else None
    subject = replace(model.exact_subject(vertices, pose, betas), betas=betas)
    trans = (model.joint_regressor[[0]] @ (vertices - subject.vertices(pose)))[0]
    found = subject.vertices(pose, trans)
    far = np.linalg.norm(found - vertices, axis=1)
    return OwnBody(subject, pose, trans, found, float(far.mean()), float(far.max()))
