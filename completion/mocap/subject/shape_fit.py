"""Betas and the poses of some frames together, from the markers in them."""
from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from model.bilinear import ShapedPoints
from model.body import BodyModel
from model.priors import GaussianPrior, gaussian_prior
from scanprep.geometry.least_squares import Arrow, Residual, levenberg_marquardt, normal_equations

from ... import energy
from ...bodies import FixedBody
from ...energy import MovingPoints
from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import supports
from .frame_starts import FrameStarts, find_loose

if TYPE_CHECKING:
    from .marker_shape import MarkerShapeConfig

WIDE = 3.0                           # times the markers' deviation: the mean person cannot do better
LOOSE = 5.0                          # times the markers' deviation, of a loose marker that has not been found


class ShapeFit:
    """Markers (B, L, 3) of some frames on a body of unknown shape; unknowns are (B, P), betas alike in every row.

    Parameters
    ----------
    model : BodyModel
    layout : MarkerLayout
        Of these markers.
    targets : (B, L, 3) float, metres
        NaN where a marker was not seen.
    config : MarkerShapeConfig
    """

    def __init__(self, model: BodyModel, layout: MarkerLayout, targets: np.ndarray, config: MarkerShapeConfig) -> None:
        self.model, self.config, self.targets = model, config, targets
        self.n_betas = min(config.n_betas, model.n_betas)
        self.usual = layout
        self._place(layout)
        self.found: dict[str, int] = {}
        self.unsure = np.isin(layout.labels, layout.loose) & (config.loose_reach > 0)
        self.body = FixedBody(model.subject(np.zeros(self.n_betas)))
        self.prior: GaussianPrior = gaussian_prior(model.pose_mean, model.pose_covariance, config.prior_shrinkage)

    def _place(self, layout: MarkerLayout) -> None:
        """Have the markers where a layout has them."""
        self.layout, self.distances = layout, np.asarray(layout.distances)
        ids, weights = supports(self.model.template, layout)
        self.points: ShapedPoints = self.model.points(ids, weights, self.n_betas)

    def find_loose(self, x: np.ndarray) -> None:
        """Put each loose marker on the vertex of its part that is nearest to where it was measured in all frames."""
        if not (self.layout.loose and self.config.loose_reach):
            return
        pose, trans, betas = self.body.split(x)
        vertices = self.model.subject(betas[0]).vertices(pose, trans)
        self.found = find_loose(self.model, vertices, self.usual, self.targets, self.config.loose_reach,
                                self.config.outlier)
        self._place(self.usual.moved(self.found))
        self.unsure[:] = False

    def markers(self, x: np.ndarray) -> MovingPoints:
        """The markers for unknowns (B, P)."""
        pose, trans, betas = self.body.split(x)
        positions, d_pose = self.points.operator(betas[0]).jacobian(pose, trans)
        moving = energy.moving_points(positions, d_pose, self.points.shape_jacobian(pose))
        return energy.above_skin(moving, self.distances)

    def starts(self, tell: Callable[[int], None]) -> np.ndarray:
        """Unknowns (B, P) of the mean person in every frame."""
        c = self.config
        mean = FrameStarts(self.body.subject, self.usual, WIDE * c.marker_sd, c.prior_weight, c.prior_shrinkage,
                           c.start_axes)
        found = mean.find(self.targets, tell)
        return np.concatenate([found, np.zeros((len(found), self.n_betas))], axis=1)

    def joint(self, x: np.ndarray) -> tuple[np.ndarray, bool, int]:
        """All frames together from x (B, P), outliers weighed as they are there."""
        off = np.linalg.norm(self.markers(x).positions - self.targets, axis=2)
        usual = np.nanmedian(off, axis=1, keepdims=True)
        weights = energy.geman_mcclure(np.nan_to_num(off), np.maximum(self.config.outlier, 3 * usual))
        weights /= (self.config.marker_sd * np.where(self.unsure, LOOSE, 1.0))**2

        def energies(x: np.ndarray) -> list[Residual]:
            return [energy.point_to_point(self.markers(x), self.targets, weights),
                    energy.pose_prior(x, self.prior, self.config.prior_weight),
                    energy.shape_prior(x, x.shape[1] - self.n_betas, self.config.shape_weight)]

        end = levenberg_marquardt(lambda x: Arrow(normal_equations(energies(x)), self.n_betas), x,
                                  self.config.iterations)
        return end.x, bool(end.converged[0]), end.iterations
