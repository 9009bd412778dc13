"""Betas and the poses of some frames together, from the markers in them."""
from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from model.bilinear import ShapedPoints
from model.body import BodyModel
from scanprep.geometry import rotations

from .. import energy
from ..bodies import FixedBody
from ..energy import MovingPoints, Residual
from ..markers.layout import MarkerLayout
from ..priors import GaussianPrior, gaussian_prior
from ..solve import MinimiseConfig, minimise, normal_equations
from ..starts import search
from .marked import MarkedBody, supports
from .shared import minimise_shared

if TYPE_CHECKING:
    from .shape import MarkerShapeConfig

STARTS = 3                           # of those in a frame that are followed to their end
LOST = 0.1                           # metres, median distance of a frame's markers above which it is searched anew
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
        self._place(layout)
        base = layout.vertices.reshape(len(layout.labels), -1)
        share = np.ones(base.shape) if layout.weights is None else layout.weights
        self._usual = np.take_along_axis(base, share.argmax(axis=1)[:, None], axis=1)[:, 0]
        self.found: dict[str, int] = {}
        self.unsure = np.isin(layout.labels, layout.loose) & (config.loose_reach > 0)
        mean = model.subject(np.zeros(self.n_betas))
        self.body, self.mean_person = FixedBody(mean), MarkedBody(mean, layout, config.prior_weight,
                                                                  config.prior_shrinkage)
        self.prior: GaussianPrior = gaussian_prior(model.pose_mean, model.pose_covariance, config.prior_shrinkage)

    def _place(self, layout: MarkerLayout) -> None:
        """Have the markers where a layout has them."""
        self.layout, self.distances = layout, np.asarray(layout.distances)
        ids, weights = supports(self.model.template, layout)
        self.points: ShapedPoints = self.model.points(ids, weights, self.n_betas)

    def find_loose(self, x: np.ndarray) -> None:
        """Put each loose marker on the vertex of its part that is nearest to where it was measured in all frames."""
        rows = np.flatnonzero(np.isin(self.layout.labels, self.layout.loose))
        if not len(rows) or not self.config.loose_reach:
            return
        pose, trans, betas = self.body.split(x)
        template = self.model.template
        meshes = [template.with_vertices(v) for v in self.model.subject(betas[0]).vertices(pose, trans)]
        tree, part = cKDTree(template.vertices), self.model.skeleton.part_of_vertex(template)
        for row in rows:
            usual = int(self._usual[row])
            near = np.array(tree.query_ball_point(template.vertices[usual], self.config.loose_reach))
            near = near[part[near] == part[usual]]
            off = np.stack([mesh.vertices[near] + self.distances[row] * mesh.vertex_normals[near] - target
                            for mesh, target in zip(meshes, self.targets[:, row], strict=True)
                            if np.isfinite(target[0])] or [np.zeros((len(near), 3))])
            squared = np.minimum((off**2).sum(axis=2), self.config.outlier**2)
            self.found[self.layout.labels[row]] = int(near[squared.mean(axis=0).argmin()])
        self._place(self.layout.moved(self.found))
        self.unsure[:] = False

    def markers(self, x: np.ndarray) -> MovingPoints:
        """The markers for unknowns (B, P)."""
        pose, trans, betas = self.body.split(x)
        positions, d_pose = self.points.operator(betas[0]).jacobian(pose, trans)
        d_betas = np.stack([self.points.shape_jacobian(p) for p in pose])
        return energy.above_skin(energy.moving_points(positions, d_pose, d_betas), self.distances)

    def starts(self, tell: Callable[[int], None]) -> np.ndarray:
        """Unknowns (B, P) of the mean person in every frame: one searched for from nothing, the others from those."""
        found: list[np.ndarray] = []
        order = np.argsort(np.isnan(self.targets[..., 0]).sum(axis=1), kind="stable")
        for i in order:
            targets = self.targets[i]
            x = self._settled(self._laid(found, targets), targets) if found else self._searched(targets)
            if found and np.nanmedian(np.linalg.norm(self.mean_person.positions(x) - targets, axis=1)) > LOST:
                x = self._searched(targets)
            found.append(x)
            tell(len(found))
        out = np.zeros((len(order), self.body.n_angles + 3 + self.n_betas))
        out[order, :-self.n_betas] = found
        return out

    def _laid(self, found: list[np.ndarray], targets: np.ndarray) -> np.ndarray:
        """The most fitting ones (n, 3J + 3) of poses that were found, laid on the markers (L, 3) of a frame."""
        x, there = np.array(found), ~np.isnan(targets[:, 0])
        positions = self.mean_person.positions(x)
        pose, _, _ = self.body.split(x)
        for i, at in enumerate(positions):
            R, _ = rotations.procrustes(at[there], targets[there])
            pose[i, 0] = rotations.log(R @ rotations.exp(pose[i, 0]))
        x[:, -3:] += (targets - self.mean_person.positions(x))[:, there].mean(axis=1)
        off = np.nanmean(np.linalg.norm(self.mean_person.positions(x) - targets, axis=2), axis=1)
        return x[np.argsort(off)[:STARTS]]

    def _searched(self, targets: np.ndarray) -> np.ndarray:
        """Pose and place (3J + 3,) of the mean person in a frame, from nothing."""
        sd = WIDE * self.config.marker_sd
        x, _ = search(self.body, self.mean_person.follow, targets, sd, self.prior, self.config.start_axes)
        return self._settled(x[:STARTS], targets)

    def _settled(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """The best (3J + 3,) that the mean person reaches from starts (n, 3J + 3)."""
        weights = np.full(len(targets), (WIDE * self.config.marker_sd)**-2)
        end = minimise(lambda x: [energy.point_to_point(self.mean_person.follow(x), targets, weights),
                                  energy.pose_prior(x, self.prior, self.config.prior_weight)],
                       x, MinimiseConfig(iterations=20, tolerance=1e-3))
        return end.x[np.argmin(end.energy)]

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

        return minimise_shared(lambda x: normal_equations(energies(x)), x, self.n_betas, self.config.iterations)


