"""Some points of a body as a function of one vector of unknowns: pose, place and betas."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..bilinear import ShapedPoints
from ..body import BodyModel
from ..linear import PointOperator, Subject


@dataclass(frozen=True, eq=False)
class PosedPoints:
    """Points of a body whose pose, place and perhaps shape are unknown: x = (pose (3J), trans (3), betas (K))."""

    source: PointOperator | ShapedPoints  # PointOperator or ShapedPoints
    n_betas: int            # K, zero where the shape is known
    parts: np.ndarray       # (L,) int, the part of each point
    rest_normals: np.ndarray  # (L, 3), on the template

    @property
    def J3(self) -> int:
        """Three times the number of parts."""
        return 3 * len(self.source.terms.skeleton.parents)

    def _operator(self, x: np.ndarray) -> PointOperator:
        return self.source if isinstance(self.source, PointOperator) else self.source.operator(x[self.J3 + 3:])

    def positions(self, x: np.ndarray) -> np.ndarray:
        """(L, 3) metres."""
        return self._operator(x).evaluate(x[:self.J3].reshape(-1, 3), x[self.J3:self.J3 + 3])

    def columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (L, 3) and their derivatives (P, L, 3)."""
        pose = x[:self.J3].reshape(-1, 3)
        y, by_pose = self._operator(x).columns(pose, x[self.J3:self.J3 + 3])
        blocks = [by_pose, np.broadcast_to(np.eye(3)[:, None], (3, *y.shape))]
        if isinstance(self.source, ShapedPoints):
            blocks.append(np.moveaxis(self.source.shape_jacobian(pose), -1, 0))
        return y, np.concatenate(blocks)

    def normals(self, x: np.ndarray) -> np.ndarray:
        """Normals (L, 3), turned as the parts are."""
        R = self.source.terms.skeleton.part_rotations(x[:self.J3].reshape(-1, 3))
        return np.einsum("lij,lj->li", R[self.parts], self.rest_normals)


def posed_points(body: BodyModel | Subject, vertex_ids: np.ndarray, n_betas: int) -> PosedPoints:
    """Vertices (L,) of a model, whose first `n_betas` are unknown, or of a subject, whose shape is known."""
    template = body.template
    parts = body.skeleton.part_of_vertex(template)[vertex_ids]
    normals = template.vertex_normals[vertex_ids]
    if isinstance(body, Subject):
        return PosedPoints(body.points(vertex_ids), 0, parts, normals)
    K = min(n_betas, body.n_betas)
    shaped = body.points(vertex_ids, n_betas=K)
    return PosedPoints(shaped if K else shaped.operator(None), K, parts, normals)
