"""Where the frames of a person of unknown shape begin: the poses of the mean person in them."""
from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from model.body import BodyModel
from model.linear import Subject
from model.priors import GaussianPrior
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Residual, levenberg_marquardt, normal_equations

from ... import energy
from ...bodies import FixedBody
from ...starts import search
from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import MarkedBody

STARTS = 3                           # of those in a frame that are followed to their end
LOST = 0.1                           # metres, median distance of a frame's markers above which it is searched anew


class FrameStarts:
    """The mean person in some frames.

    Parameters
    ----------
    mean : Subject
    layout : MarkerLayout
        Of the markers in the frames.
    sd : float, metres
        How far a marker lies from where the mean person would put it.
    prior_weight, prior_shrinkage : float
        See `AnimateConfig`.
    axes : int
        Directions of the training poses along which a frame is searched.
    """

    def __init__(self, mean: Subject, layout: MarkerLayout, sd: float, prior_weight: float, prior_shrinkage: float,
                 axes: int) -> None:
        self.body, self.person = FixedBody(mean), MarkedBody(mean, layout, prior_weight, prior_shrinkage)
        self.prior: GaussianPrior = self.person.prior
        self.sd, self.prior_weight, self.axes = sd, prior_weight, axes

    def find(self, targets: np.ndarray, tell: Callable[[int], None]) -> np.ndarray:
        """Unknowns (B, 3J + 3) in every frame (B, L, 3): one searched for from nothing, the others from those."""
        found: list[np.ndarray] = []
        order = np.argsort(np.isnan(targets[..., 0]).sum(axis=1), kind="stable")
        for i in order:
            seen = targets[i]
            x = self._settled(self._laid(found, seen), seen) if found else self._searched(seen)
            if found and np.nanmedian(np.linalg.norm(self.person.positions(x) - seen, axis=1)) > LOST:
                x = self._searched(seen)
            found.append(x)
            tell(len(found))
        out = np.empty((len(order), self.body.n_angles + 3))
        out[order] = found
        return out

    def _laid(self, found: list[np.ndarray], targets: np.ndarray) -> np.ndarray:
        """The most fitting ones (n, 3J + 3) of poses that were found, laid on the markers (L, 3) of a frame."""
        x, there = np.array(found), ~np.isnan(targets[:, 0])
        positions = self.person.positions(x)
        pose, _, _ = self.body.split(x)
        for i, at in enumerate(positions):
            R, _ = rotations.procrustes(at[there], targets[there])
            pose[i, 0] = rotations.log(R @ rotations.exp(pose[i, 0]))
        x[:, -3:] += (targets - self.person.positions(x))[:, there].mean(axis=1)
        off = np.nanmean(np.linalg.norm(self.person.positions(x) - targets, axis=2), axis=1)
        return x[np.argsort(off)[:STARTS]]

    def _searched(self, targets: np.ndarray) -> np.ndarray:
        """Pose and place (3J + 3,) of the mean person in a frame, from nothing."""
        x, _ = search(self.body, self.person.follow, targets, self.sd, self.prior, self.axes)
        return self._settled(x[:STARTS], targets)

    def _settled(self, x: np.ndarray, targets: np.ndarray) -> np.ndarray:
        """The best (3J + 3,) that the mean person reaches from starts (n, 3J + 3)."""
        weights = np.full(len(targets), self.sd**-2)

        def energies(x: np.ndarray) -> list[Residual]:
            return [energy.point_to_point(self.person.follow(x), targets, weights),
                    energy.pose_prior(x, self.prior, self.prior_weight)]

        end = levenberg_marquardt(lambda x: normal_equations(energies(x)), x, iterations=20, tolerance=1e-3)
        return end.x[np.argmin(end.energy)]


def find_loose(model: BodyModel, vertices: np.ndarray, layout: MarkerLayout, targets: np.ndarray, reach: float,
               outlier: float) -> dict[str, int]:
    """The vertex of its part on which each loose marker is nearest to where it was measured in all frames.

    Parameters
    ----------
    model : BodyModel
    vertices : (B, N, 3) float, metres
        The body in every frame.
    layout : MarkerLayout
        Where the markers usually are.
    targets : (B, L, 3) float, metres
        NaN where a marker was not seen.
    reach : float, metres
        How far from its usual place a marker is looked for.
    outlier : float, metres
        Distance beyond which it does not matter how far a marker is.
    """
    template, distances, usual = model.template, np.asarray(layout.distances), layout.nearest
    meshes, found = [template.with_vertices(v) for v in vertices], {}
    tree, part = cKDTree(template.vertices), model.skeleton.part_of_vertex(template)
    for row in np.flatnonzero(np.isin(layout.labels, layout.loose)):
        near = np.array(tree.query_ball_point(template.vertices[usual[row]], reach))
        near = near[part[near] == part[usual[row]]]
        off = np.stack([mesh.vertices[near] + distances[row] * mesh.vertex_normals[near] - target
                        for mesh, target in zip(meshes, targets[:, row], strict=True)
                        if np.isfinite(target[0])] or [np.zeros((len(near), 3))])
        squared = np.minimum((off**2).sum(axis=2), outlier**2)
        found[layout.labels[row]] = int(near[squared.mean(axis=0).argmin()])
    return found
