"""Betas, latent markers and the poses of some frames, all together."""
from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from model.bilinear import ShapedPoints
from model.body import BodyModel
from model.priors import gaussian_prior
from scanprep.geometry.least_squares import Arrow, Minimum, Residual, levenberg_marquardt, normal_equations

from ... import energy
from ...bodies import FixedBody
from ...energy import MovingPoints
from ..marker_sets.layout import MarkerLayout
from ..pose.marked_body import supports
from ..settings import PersonConfig
from . import terms
from .attachment import LatentMarkers, latent_markers, simulated
from .frame_starts import find_loose
from .terms import LatentPoints

UNSURE = 5.0                         # how much farther off a loose marker may be before it was looked for
TOLERANCE = 1e-3                     # fraction of the energy, in all stages but the last
FINAL = 1e-4                         # the same in the last
LONGER = 3                           # times as many steps in the last


@dataclass(frozen=True, eq=False)
class State:
    """Where the solution stands.

    Attributes
    ----------
    x : (B, 3J + 3) float
        Pose and place in every frame.
    betas : (K,) float
    coefficients : (L, 3) float
        Of the latent markers.
    """

    x: np.ndarray
    betas: np.ndarray
    coefficients: np.ndarray

    @property
    def z(self) -> np.ndarray:
        """(K + 3L,) what the frames share."""
        return np.concatenate([self.betas, self.coefficients.ravel()])


class LatentFit:
    """Markers of some frames on a body of unknown shape, which sit about where a layout has them.

    Parameters
    ----------
    model : BodyModel
    body : FixedBody
        Of the model, of any shape: it splits the unknowns.
    layout : MarkerLayout
        Of these markers.
    targets : (B, L, 3) float, metres
        NaN where a marker was not seen.
    config : PersonConfig
    """

    def __init__(self, model: BodyModel, body: FixedBody, layout: MarkerLayout, targets: np.ndarray,
                 config: PersonConfig) -> None:
        self.model, self.body, self.targets, self.config = model, body, targets, config
        self.n_betas = min(config.n_betas, model.n_betas)
        rest = np.zeros((len(model.skeleton.parents), 3))
        self.latent = LatentPoints(model.vertices(rest, np.zeros(self.n_betas)),
                                   model.shape_jacobian(rest)[..., :self.n_betas])
        self.prior = gaussian_prior(model.pose_mean, model.pose_covariance, config.prior_shrinkage)
        self.layout = self.usual_layout = layout
        self.unsure = np.isin(layout.labels, layout.loose) & (config.loose_reach > 0)
        self.place_weight = np.where(np.isin(layout.labels, layout.loose), config.loose, config.initial)
        self._pool = PointPool(model, self.n_betas)
        self._set_usual(layout)

    def start(self, x: np.ndarray) -> State:
        """The mean person with the markers in their usual places, at poses that were found for it."""
        return self.attached(x, np.zeros(self.n_betas), self.usual(np.zeros(self.n_betas)).positions)

    def attached(self, x: np.ndarray, betas: np.ndarray, points: np.ndarray) -> State:
        """The state with markers at points (L, 3) of the latent coordinate system, each on its nearest triangle."""
        vertices = self.latent.at(betas)
        self.markers = latent_markers(self.model.template.with_vertices(vertices), points, self.config.attachment)
        self.points = self._pool.points(self.markers)
        self._supports = self.latent.combined(self.markers.ids, self.markers.weights)
        self._corners = self.latent.combined(self.markers.corners.reshape(-1, 1), np.ones((3 * len(points), 1)))
        return State(x, betas, self.markers.coefficients(vertices, points))

    def reattached(self, state: State) -> State:
        """The same places on the triangles that are nearest now.

        [MoSh] Eq. 16
        """
        return self.attached(state.x, state.betas, self.places(state))

    def places(self, state: State) -> np.ndarray:
        """The latent markers (L, 3) in the latent coordinate system, metres."""
        return terms.latent_places(self.markers.kind, self._supports, state.z).positions

    def usual(self, betas: np.ndarray) -> MovingPoints:
        """The usual places of the markers in the latent coordinate system, derivatives by betas.

        [MoSh] Eq. 15
        """
        return energy.above_skin(self._usual_supports.moving(betas), np.asarray(self.layout.distances))

    def usual_places(self, betas: np.ndarray) -> np.ndarray:
        """Where the given layout has the markers (L, 3) on this body, metres: loose ones not where they were found."""
        points = self.latent.combined(*supports(self.model.template, self.usual_layout))
        return energy.lifted(points.at(betas), np.asarray(self.usual_layout.distances))

    def _set_usual(self, layout: MarkerLayout) -> None:
        self.layout = layout
        self._usual_supports = self.latent.combined(*supports(self.model.template, layout))

    def with_loose_found(self, state: State) -> State:
        """Each loose marker where on its limb it is nearest to what was measured; the others stay."""
        if not self.usual_layout.loose or not self.config.loose_reach:
            return self.reattached(state)
        pose, trans, _ = self.body.split(state.x)
        vertices = self.model.subject(state.betas).vertices(pose, trans)
        found = find_loose(self.model, vertices, self.usual_layout, self.targets, self.config.loose_reach,
                           self.config.outlier)
        self._set_usual(self.usual_layout.moved(found))
        self.unsure[:] = False
        loose = np.isin(self.layout.labels, self.layout.loose)[:, None]
        return self.attached(state.x, state.betas,
                             np.where(loose, self.usual(state.betas).positions, self.places(state)))

    def simulated(self, x: np.ndarray, z: np.ndarray) -> MovingPoints:
        """The markers in every frame for x (B, n) and z (K + 3L,), derivatives by both.

        [MoSh] Eq. 16
        """
        K = self.n_betas
        pose, trans, _ = self.body.split(x)
        positions, d_pose = self.points.operator(z[:K]).jacobian(pose, trans)
        moving = energy.moving_points(positions, d_pose, self.points.shape_jacobian(pose))
        found, frame = simulated(self.markers.kind, moving, z[K:].reshape(-1, 3))
        return MovingPoints(found.positions, np.concatenate([found.jacobian, terms.each_own(frame)], axis=-1))

    def residuals(self, state: State) -> np.ndarray:
        """(B, L) distances of simulated from observed markers, metres; NaN where one was not seen."""
        return np.linalg.norm(self.simulated(state.x, state.z).positions - self.targets, axis=2)

    def weights(self, state: State) -> np.ndarray:
        """(B, L) weights of the data, per square centimetre; outliers have less, as loose markers not yet found."""
        off = self.residuals(state)
        usual = np.nanmedian(off, axis=1, keepdims=True)
        share = energy.geman_mcclure(np.nan_to_num(off), np.maximum(self.config.outlier, 3 * usual))
        return self.config.data * share / np.where(self.unsure, UNSURE, 1.0)**2

    def common(self, z: np.ndarray, factor: float) -> dict[str, Residual]:
        """The terms of what frames share; the last two are `factor` times their weight.

        [MoSh] Eq. 18, Eq. 19, Eq. 20
        """
        c, L = self.config, len(self.layout.labels)
        markers = terms.latent_places(self.markers.kind, self._supports, z)
        usual = self.usual(z)
        distances = np.asarray(self.layout.distances)
        return {"surface": terms.surface(markers, self._corners.moving(z), distances, np.full(L, c.surface)),
                "initial": terms.usual_place(markers, usual, factor * self.place_weight),
                "shape": terms.shape(z, self.n_betas, factor * c.shape)}

    def frames(self, x: np.ndarray, z: np.ndarray, weights: np.ndarray, factor: float) -> dict[str, Residual]:
        """The terms of the frames, derivatives by (x, z).

        [MoSh] Eq. 17, Eq. 21
        """
        whole = np.concatenate([x, np.tile(z, (len(x), 1))], axis=1)
        return {"data": terms.data(self.simulated(x, z), self.targets, weights),
                "pose": terms.pose(whole, self.prior, factor * self.config.pose)}

    def solve(self, state: State, factor: float, last: bool) -> tuple[State, Minimum[np.ndarray]]:
        """One stage: everything together by Levenberg-Marquardt.

        [MoSh] Eq. 23
        """
        weights, K = self.weights(state), self.n_betas
        n, shared = state.x.shape[1], len(state.z)

        def equations(rows: np.ndarray) -> Arrow:
            x, z = rows[:, :n], rows[0, n:]
            common = [Residual(r.values[None], r.jacobian[None]) for r in self.common(z, factor).values()]
            return Arrow(normal_equations(list(self.frames(x, z, weights, factor).values())), shared,
                         normal_equations(common))

        steps, tolerance = (LONGER * self.config.iterations, FINAL) if last else (self.config.iterations, TOLERANCE)
        rows = np.concatenate([state.x, np.tile(state.z, (len(state.x), 1))], axis=1)
        end = levenberg_marquardt(equations, rows, steps, tolerance)
        return State(end.x[:, :n], end.x[0, n:n + K], end.x[0, n + K:].reshape(-1, 3)), end

    def energies(self, state: State) -> dict[str, float]:
        """What each term is, weights included."""
        both = self.frames(state.x, state.z, self.weights(state), 1.0) | self.common(state.z, 1.0)
        return {name: float(np.sum(term.energy)) for name, term in both.items()}

    def placed_layout(self, state: State) -> MarkerLayout:
        """The layout with every marker on the triangle it hangs on at its own distance, exact in the latent pose."""
        vertices, points = self.latent.at(state.betas), self.places(state)
        hung = self.markers
        if hung.kind != "triangle":
            hung = latent_markers(self.model.template.with_vertices(vertices), points)
        p = vertices[hung.corners]
        c = hung.coefficients(vertices, points)
        along, across = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        length = np.linalg.norm(along, axis=1)
        first = np.einsum("ld,ld->l", across, along) / length
        height = np.sqrt(np.einsum("ld,ld->l", across, across) - first**2)
        third = c[:, 1] / height
        second = (c[:, 0] - third * first) / length
        return MarkerLayout(self.layout.labels, hung.corners, c[:, 2],
                            np.stack([1 - second - third, second, third], axis=1), self.layout.aliases)


class PointPool:
    """Points of the skin with free shape, each made once.

    Parameters
    ----------
    model : BodyModel
    n_betas : int
    """

    def __init__(self, model: BodyModel, n_betas: int) -> None:
        self.model, self.n_betas = model, n_betas
        self._column: dict[bytes, int] = {}
        self._made: ShapedPoints | None = None

    def points(self, markers: LatentMarkers) -> ShapedPoints:
        """The supports of some markers."""
        keys = [ids.tobytes() + weights.tobytes() for ids, weights in zip(markers.ids, markers.weights, strict=True)]
        new = {key: row for row, key in enumerate(keys) if key not in self._column}
        if new:
            rows = np.array(list(new.values()))
            made = self.model.points(markers.ids[rows], markers.weights[rows], self.n_betas)
            self._column |= {key: len(self._column) + i for i, key in enumerate(new)}
            self._made = made if self._made is None else ShapedPoints(
                made.terms, np.concatenate([self._made.template_basis, made.template_basis], axis=1),
                np.concatenate([self._made.mean_basis, made.mean_basis], axis=1),
                np.concatenate([self._made.shape_basis, made.shape_basis], axis=2), made.origin)
        assert self._made is not None, "at least one marker"
        some, all_ = [self._column[key] for key in keys], self._made
        return ShapedPoints(all_.terms, all_.template_basis[:, some], all_.mean_basis[:, some],
                            all_.shape_basis[:, :, some], all_.origin)
