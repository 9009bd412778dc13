"""One registered body, with all its detail, in other poses."""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..body import BodyModel
from ..fitting.vertices import FitConfig, PoseFit, ShapeFit, fit_pose, fit_shape
from ..linear import Subject, check_pose

QUICK = FitConfig(polish=0)          # a rough fit of pose and betas is enough: the body's own shape absorbs the rest


@dataclass(frozen=True, eq=False)
class OwnBody:
    """A registered body as a subject of its own, with its registered pose (J, 3) and place (3,).

    `vertices` (N, 3) are those of the subject in that pose; `mean` and `largest`, metres, their distance from the
    registered ones.
    """

    subject: Subject
    pose: np.ndarray
    trans: np.ndarray
    vertices: np.ndarray
    mean: float
    largest: float


def subject_from_body(model: BodyModel, vertices: np.ndarray) -> Subject:
    """Build the subject whose shape is that of one registered body, including detail beyond the betas.

    In the body's own pose it is that body, to the millimetre or two that smoothing takes. In other poses the model's
    deformation by pose is added. Its `betas` are the fitted ones and describe it only roughly.

    Parameters
    ----------
    model : BodyModel
        A model of any kind.
    vertices : (N, 3) float, metres
        The body, in the topology of the model's template.

    Returns
    -------
    Subject
        The body, ready to be posed.

    Raises
    ------
    ValueError
        Another number of vertices, or vertices that are not finite.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> model = load_built_in_model()
    >>> person = model.vertices(np.zeros((16, 3)), np.array([1.0, -1.0]))
    >>> subject_from_body(model, person).vertices(np.zeros((3, 16, 3))).shape
    (3, 5002, 3)

    [SCAPE] Eq. 8, 9
    """
    return own_body(model, vertices).subject


def own_body(model: BodyModel, vertices: np.ndarray, fit: PoseFit | None = None) -> OwnBody:
    """Build the subject of `subject_from_body` together with the body's pose and place, fitted unless given."""
    if fit is None:
        fit = fit_shape(model, vertices, QUICK) if model.n_betas else fit_pose(model.subject(None), vertices, QUICK)
    pose, _ = check_pose(model.skeleton, fit.pose, None)
    vertices = np.asarray(vertices, dtype=np.float64)
    if vertices.shape != model.template.vertices.shape or not np.isfinite(vertices).all():
        raise ValueError(f"vertices: expected finite numbers of shape {model.template.vertices.shape}, "
                         f"got shape {vertices.shape}")
    betas = fit.betas if isinstance(fit, ShapeFit) else None
    subject = replace(model.exact_subject(vertices, pose, betas), betas=betas)
    # place the subject's root joint where the body has it
    trans = (model.joint_regressor[[0]] @ (vertices - subject.vertices(pose)))[0]
    placed = subject.vertices(pose, trans)
    far = np.linalg.norm(placed - vertices, axis=1)
    return OwnBody(subject, pose, trans, placed, float(far.mean()), float(far.max()))
