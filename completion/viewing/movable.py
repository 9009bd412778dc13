"""A body whose shape and pose follow sliders: every move is one product of matrices."""
from __future__ import annotations

import numpy as np

from model.body import BodyModel
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.roles import in_words


class MovableBody:
    """A model with betas and pose.

    Parameters
    ----------
    model : BodyModel
        The model.
    """

    def __init__(self, model: BodyModel) -> None:
        self.model = model
        self.parts = tuple(map(in_words, model.skeleton.names))

    def vertices(self, betas: np.ndarray | None, pose: np.ndarray) -> np.ndarray:
        """Compute the vertices (N, 3) float32, metres, relative to the root's joint.

        Shape betas (K,) or None, and pose (J, 3) radians. Positions are relative to `origin`, so that single precision
        keeps a few micrometres wherever the body is.
        """
        operator = self.model.operator(betas)
        shift = (operator.origin - self.origin).astype(np.float32)
        return operator.astype(np.float32).relative_positions(pose).T + shift

    @property
    def origin(self) -> np.ndarray:
        """(3,) float, metres: where the root's joint is."""
        return self.model.skeleton.joints[0]

    def joint(self, part: str, y: np.ndarray) -> np.ndarray:
        """Compute the joint of a part, (1, 3), from the latest vertices `y`."""
        return np.asarray(self.model.joint_regressor[[self.parts.index(part)]] @ y)

    def mesh(self, betas: np.ndarray | None, pose: np.ndarray) -> Mesh:
        """Compute the body with the exact model."""
        return self.model.template.with_vertices(self.model.vertices(pose, betas))
