"""Fit betas, latent markers and the poses of some frames together: the terms of [MoSh] Eq. 23 and their minimum.

Frames share the unknowns `z = (betas (K), coefficients of the latent markers (3L))`; those of one frame are
`x = (pose (3J), trans (3))`. Distances are in centimetres inside the terms, so that weights compare with the paper's.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from model.bilinear import ShapedPoints
from model.body import BodyModel
from model.fitting import energy
from model.fitting.energy import MovingPoints
from model.linear import combination_weights
from model.priors import gaussian_prior
from scanprep.geometry.least_squares import Arrow, Residual, levenberg_marquardt, normal_equations
from scanprep.ranges import Count, Positive, Settings
from scanprep.skeleton.roles import find_numbered_roles

from ..marker_sets.layout import DISTANCE, MarkerLayout
from ..marker_sets.symmetry import label_pairs
from ..pose.marked_body import supports
from .attachment import Attachment, LatentMarkers, above_triangles, latent_markers, simulate_markers
from .frame_starts import find_loose

CENTIMETRES = 100.0                  # per metre; the paper's weights are for squared centimetres
ON_SKIN = 0.016                      # metres; a found distance this close to one of the marker set becomes that one


@dataclass(frozen=True)
class PersonConfig(Settings):
    """Settings of `find_person`: the shape of a person and where the markers really sit, from some frames.

    Weights are for squared distances in centimetres, squared standard deviations of betas and squared Mahalanobis
    distances of poses, as in the paper. They are inverse variances, relative to a shape prior of weight one. Errors of
    successive frames are correlated, so the terms of frames, data and pose, count a quarter: twelve frames are worth
    three. `PersonConfig.from_paper()` has the values of the paper. Ours differ in three, measured on recordings of four
    actors, along each axis: a marker is 4 mm off from frame to frame (a quarter of 1/0.4²), sits 10 mm from its usual
    place, and the model's skin is 5 mm off the true one. With a skin that is exact to a millimetre, betas explain the
    places of markers, and come out twice too large.

    Attributes
    ----------
    frames : int
        Number of frames, over all sequences.
    n_betas : int
        Largest number of betas; the others stay zero.
    data : float
        Weight of the markers against their simulation; the paper's is 0.75.
    surface : float
        Weight of the prescribed distance from the skin; the paper's is 100.
    initial : float
        Weight of the usual place of a marker; the paper's is 0.25, and 10000 fixes the layout's places.
    shape : float
        Weight of the shape prior; 1 is the distribution of people in the model.
    pose : float
        Weight of the pose prior.
    annealing : floats
        Factors on the last three weights, one stage each.
    published : bool
        As in the paper: random frames, markers of equal weight at the layout's distances, and no more bending than in
        the training poses. Else frames that differ most, robust weights, and a search for loose markers and wands.

    Examples
    --------
    >>> PersonConfig.from_paper().annealing
    (40.0, 20.0, 10.0, 4.0, 2.0, 1.0)

    [MoSh] Eq. 23
    """

    frames: Count = 12
    n_betas: int = 80
    data: float = 1.5
    surface: float = 4.0
    initial: float = 1.0
    shape: float = 1.0
    pose: float = 0.25
    annealing: tuple[Positive, ...] = (40.0, 20.0, 10.0, 4.0, 2.0, 1.0)
    published: bool = False

    @classmethod
    def from_paper(cls) -> PersonConfig:
        """Return the weights of [MoSh], with twelve random frames, six stages and equal markers."""
        return cls(data=0.75, surface=100.0, initial=0.25, published=True)

    @property
    def flexion(self) -> float:
        """How much further hips, knees and ankles bend than in the training poses, degrees.

        These are of people who stand and walk. A crouched person stood up otherwise, with markers moved along the skin.
        """
        return 0.0 if self.published else 60.0

    @property
    def outlier(self) -> float:
        """Residual at which a marker has lost three quarters of its weight, metres: beyond soft tissue."""
        return 1000.0 if self.published else 0.06

    @property
    def wand(self) -> float:
        """Largest extra distance from the skin of markers on wands or bars, metres: the usual length of a wand."""
        return 0.0 if self.published else 0.1


@dataclass(frozen=True, eq=False)
class LatentPoints:
    """Points of the skin in the latent pose, affine in betas: `mean` (..., 3), `by_betas` (..., 3, K), metres."""

    mean: np.ndarray
    by_betas: np.ndarray

    def at(self, betas: np.ndarray) -> np.ndarray:
        """Compute the places (..., 3) for betas (K,)."""
        return self.mean + self.by_betas @ betas

    def moving(self, z: np.ndarray) -> MovingPoints:
        """Compute the places for unknowns z (P,), with derivatives by all of them."""
        K = self.by_betas.shape[-1]
        rest = np.zeros((*self.mean.shape, len(z) - K))
        return MovingPoints(self.at(z[:K]), np.concatenate([self.by_betas, rest], axis=-1))

    def combine(self, ids: np.ndarray, weights: np.ndarray) -> LatentPoints:
        """Return weighted sums of some points, by ids and weights (n, k)."""
        return LatentPoints(np.einsum("lk,lkd->ld", weights, self.mean[ids]),
                            np.einsum("lk,lkdb->ldb", weights, self.by_betas[ids]))


def latent_places(kind: Attachment, points: LatentPoints, z: np.ndarray) -> MovingPoints:
    """Compute the latent markers (L) in the latent coordinate system, from their 3L supports. [MoSh] Eq. 16"""
    K = points.by_betas.shape[-1]
    found, frame = simulate_markers(kind, points.moving(z), z[K:].reshape(-1, 3))
    found.jacobian[..., K:] += each_own(frame)
    return found


def each_own(frame: np.ndarray) -> np.ndarray:
    """Expand derivatives (..., L, 3, 3) of each marker by its own coefficients to those by all, (..., L, 3, 3L)."""
    L = frame.shape[-3]
    out = np.zeros((*frame.shape[:-1], L, 3))
    i = np.arange(L)
    np.moveaxis(out, (-4, -2), (0, 1))[i, i] = np.moveaxis(frame, -3, 0)
    return out.reshape(*frame.shape[:-1], 3 * L)


def distance_reach(layout: MarkerLayout, wand: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest distance (L,) of every marker from the skin, metres.

    Both are the layout's, but for two kinds of markers: those that may be on wands, and those that the layout has away
    from the skin, on bars. These may be up to `wand` farther off, or on the skin.
    """
    distances = np.asarray(layout.distances)
    free = (np.isin(layout.labels, layout.wands) | (distances > DISTANCE + ON_SKIN)) & (wand > 0)
    return (np.where(free, np.minimum(distances, DISTANCE), distances),
            np.where(free, distances + wand, distances))


def marker_term(points: MovingPoints, targets: np.ndarray, weights: np.ndarray) -> Residual:
    """Residual of simulated against observed markers (..., L, 3), NaN without weight. [MoSh] Eq. 17, E_D"""
    return energy.point_to_point(points, targets, CENTIMETRES**2 * weights)


def surface_term(markers: MovingPoints, corners: MovingPoints, least: np.ndarray, greatest: np.ndarray, weight: float
                 ) -> Residual:
    """Residual of the distance of latent markers from the nearest triangles, of 3L corners. [MoSh] Eq. 18, E_S

    The distance is an unknown with a uniform prior between the least and the greatest (L,), metres, at its best value.
    Where both are the same, it is the paper's prescribed distance.
    """
    L, P = len(least), markers.jacobian.shape[-1]
    r, by_point, by_corners = above_triangles(markers.positions, corners.positions.reshape(L, 3, 3))
    J = (by_point[:, None] @ markers.jacobian)[:, 0] + \
        (by_corners.reshape(L, 1, 9) @ corners.jacobian.reshape(L, 9, P))[:, 0]
    off = r - np.clip(r, least, greatest)
    held = (off != 0) | (least == greatest)
    root = CENTIMETRES * np.sqrt(weight)
    return Residual(root * off, root * held[:, None] * J)


def place_term(markers: MovingPoints, usual: MovingPoints, weights: np.ndarray) -> Residual:
    """Residual of latent markers against their usual places on this body, weights (L,). [MoSh] Eq. 19, E_I"""
    root = CENTIMETRES * np.sqrt(weights)[:, None]
    r = root * (markers.positions - usual.positions)
    J = root[..., None] * (markers.jacobian - usual.jacobian)
    return Residual(r.ravel(), J.reshape(-1, J.shape[-1]))


def shape_term(z: np.ndarray, n_betas: int, weight: float) -> Residual:
    """Residual of the betas: their squared Mahalanobis distance from the mean person. [MoSh] Eq. 20, E_β"""
    prior = energy.shape_prior(z[..., :n_betas], 0, weight)
    J = np.zeros((*prior.values.shape, z.shape[-1]))
    J[..., :n_betas] = prior.jacobian
    return Residual(prior.values, J)


def free_flexion(model: BodyModel, degrees: float) -> np.ndarray:
    """Return the covariance (3J, 3J) of a model's poses, with that much more bending of hips, knees and ankles."""
    covariance, joints = np.array(model.pose_covariance, dtype=np.float64), model.skeleton.joints
    roles = find_numbered_roles(model.skeleton.names, joints)
    if {"l_hip", "r_hip"} <= roles.keys():
        # legs bend about the line through the hips
        line = joints[roles["r_hip"]] - joints[roles["l_hip"]]
        line = line / np.linalg.norm(line)
        for role in ("l_hip", "r_hip", "l_knee", "r_knee", "l_ankle", "r_ankle"):
            if role in roles:
                block = slice(3 * roles[role], 3 * roles[role] + 3)
                covariance[block, block] += np.radians(degrees)**2 * np.outer(line, line)
    return covariance


@dataclass(frozen=True, eq=False)
class LatentState:
    """The unknowns, and how the markers are attached at present."""

    x: np.ndarray                        # (B, 3J + 3) pose and place of every frame
    betas: np.ndarray                    # (K,)
    coefficients: np.ndarray             # (L, 3) of the latent markers
    markers: LatentMarkers               # the supports that these coefficients are of
    points: ShapedPoints                 # the supports on the body, in any pose and shape
    supports: LatentPoints               # the same in the latent pose
    corners: LatentPoints                # corners of the nearest triangles in the latent pose
    layout: MarkerLayout                 # usual places; loose markers where they were found
    least: np.ndarray                    # (L,) metres, least distance from the skin
    greatest: np.ndarray                 # (L,) metres, greatest; both the layout's where the distance is known
    looked: bool = False                 # loose markers were searched

    @property
    def z(self) -> np.ndarray:
        """Unknowns (K + 3L,) that the frames share."""
        return np.concatenate([self.betas, self.coefficients.ravel()])

    @property
    def places(self) -> np.ndarray:
        """Latent markers (L, 3) in the latent coordinate system, metres."""
        return latent_places(self.markers.kind, self.supports, self.z).positions

    @property
    def rows(self) -> np.ndarray:
        """All unknowns (B, 3J + 3 + K + 3L), with the shared ones in every row."""
        return np.concatenate([self.x, np.tile(self.z, (len(self.x), 1))], axis=1)

    def with_unknowns(self, rows: np.ndarray) -> LatentState:
        """Return the state with other unknowns."""
        n, K = self.x.shape[1], len(self.betas)
        return replace(self, x=rows[:, :n], betas=rows[0, n:n + K], coefficients=rows[0, n + K:].reshape(-1, 3))


class LatentFit:
    """Fit of markers (B, L, 3), metres, of some frames on a body of unknown shape, near the places of a layout."""

    def __init__(self, model: BodyModel, layout: MarkerLayout, targets: np.ndarray, config: PersonConfig,
                 attachment: Attachment = "triangle") -> None:
        self.model, self.layout, self.targets, self.config = model, layout, targets, config
        self.attachment = attachment
        self.n_betas = min(config.n_betas, model.n_betas)
        self.n_angles = 3 * len(model.skeleton.parents)
        rest = np.zeros((len(model.skeleton.parents), 3))
        self.latent = LatentPoints(model.vertices(rest, np.zeros(self.n_betas)),
                                   model.shape_jacobian(rest)[..., :self.n_betas])
        self.prior = gaussian_prior(model.pose_mean, free_flexion(model, config.flexion))
        self.loose = np.isin(layout.labels, layout.loose) & (not config.published)
        self.reach = distance_reach(layout, config.wand)
        # usual place of a loose marker: 0.0025 is a standard deviation of 20 cm
        self.place_weight = np.where(self.loose, min(0.0025, config.initial), config.initial)
        self._column: dict[bytes, int] = {}
        self._made: ShapedPoints | None = None

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split unknowns (B, 3J + 3) into poses (B, J, 3) and places (B, 3)."""
        return x[:, :self.n_angles].reshape(len(x), -1, 3), x[:, self.n_angles:]

    def start(self, x: np.ndarray) -> LatentState:
        """Start from the mean person, markers in their usual places, and poses (B, 3J + 3) that were found for it."""
        betas = np.zeros(self.n_betas)
        return self._attach(x, betas, self.usual_places(self.layout, betas), self.layout, self.reach, False)

    def reattach(self, state: LatentState, look: bool, last: bool) -> LatentState:
        """Attach the markers at their present places to the nearest triangles; `look` searches loose markers first.

        The `last` time, distances close to one of the marker set become that one.
        """
        layout, places, looked = state.layout, state.places, state.looked
        if look and self.loose.any():
            # loose markers along their limbs, on the bodies of all frames
            vertices = self.model.subject(state.betas).vertices(*self.split(state.x))
            vertex_of, distances = find_loose(self.model, vertices, self.layout, self.targets, self.reach)
            layout, looked = replace(self.layout.with_places(vertex_of), distances=distances), True
            places = np.where(self.loose[:, None], self.usual_places(layout, state.betas), places)
        state = self._attach(state.x, state.betas, places, layout, (state.least, state.greatest), looked)
        return self._measure_distances(state, last)

    def _measure_distances(self, state: LatentState, last: bool) -> LatentState:
        """Return the state with unknown distances from the skin set to their present values."""
        free = state.least < state.greatest
        if not free.any():
            return state
        corners = state.corners.at(state.betas).reshape(-1, 3, 3)
        r = np.clip(above_triangles(state.places, corners)[0], state.least, state.greatest)
        distances, usual = np.where(free, r, np.asarray(state.layout.distances)), np.asarray(self.layout.distances)
        if last:
            # left and right markers are mounted alike, and their mean has less error than one alone
            pairs = label_pairs(self.layout.labels)
            paired = (pairs >= 0) & free[pairs]
            both, limit = np.where(paired, (r + r[pairs]) / 2, r), np.where(paired, ON_SKIN, np.sqrt(2) * ON_SKIN)
            # close to the common distance, or to the layout's own: it is that one, and known from now on
            for named in (np.full(len(r), DISTANCE), usual):
                near = free & (np.abs(both - named) < limit)
                distances, free = np.where(near, named, distances), free & ~near
        return replace(state, layout=replace(state.layout, distances=distances),
                       least=np.where(free, state.least, distances), greatest=np.where(free, state.greatest, distances))

    def _attach(self, x: np.ndarray, betas: np.ndarray, points: np.ndarray, layout: MarkerLayout,
                reach: tuple[np.ndarray, np.ndarray], looked: bool) -> LatentState:
        """Return the state with markers at points (L, 3) of the latent pose, each attached to its nearest triangle."""
        vertices = self.latent.at(betas)
        markers = latent_markers(self.model.template.with_vertices(vertices), points, self.attachment)
        corners = self.latent.combine(markers.corners.reshape(-1, 1), np.ones((3 * len(points), 1)))
        return LatentState(x, betas, markers.coefficients(vertices, points), markers, self._supports(markers),
                           self.latent.combine(markers.ids, markers.weights), corners, layout, *reach, looked)

    def _supports(self, markers: LatentMarkers) -> ShapedPoints:
        """Return the supports with free shape; each is made once, as stitching them is the cost of attaching again."""
        keys = [ids.tobytes() + weights.tobytes() for ids, weights in zip(markers.ids, markers.weights, strict=True)]
        new = {key: row for row, key in enumerate(keys) if key not in self._column}
        if new:
            rows = np.array(list(new.values()))
            made = self.model.points(markers.ids[rows], markers.weights[rows], self.n_betas)
            self._column |= {key: len(self._column) + i for i, key in enumerate(new)}
            self._made = made if self._made is None else self._made.concatenate(made)
        assert self._made is not None, "at least one marker"
        return self._made.combine(combination_weights(self._made.count, np.array([self._column[key] for key in keys]),
                                                      None))

    def usual_places(self, layout: MarkerLayout, betas: np.ndarray) -> np.ndarray:
        """Compute usual places (L, 3), metres, on a body of these betas in the latent pose. [MoSh] Eq. 15"""
        return energy.rise_above_skin(self._usual(layout).at(betas), np.asarray(layout.distances))

    def _usual(self, layout: MarkerLayout) -> LatentPoints:
        """Return the supports of a layout's places in the latent pose."""
        return self.latent.combine(*supports(self.model.template, layout))

    def simulate(self, state: LatentState, x: np.ndarray, z: np.ndarray) -> MovingPoints:
        """Simulate the markers in every frame for x (B, n) and z (K + 3L,), with derivatives by both. [MoSh] Eq. 16"""
        K, (pose, trans) = self.n_betas, self.split(x)
        positions, d_pose = state.points.operator(z[:K]).jacobian(pose, trans)
        moving = energy.moving_points(positions, d_pose, state.points.shape_jacobian(pose))
        found, frame = simulate_markers(state.markers.kind, moving, z[K:].reshape(-1, 3))
        return MovingPoints(found.positions, np.concatenate([found.jacobian, each_own(frame)], axis=-1))

    def residuals(self, state: LatentState) -> np.ndarray:
        """Compute distances (B, L) of simulated from observed markers, metres; NaN where one was not seen."""
        return np.linalg.norm(self.simulate(state, state.x, state.z).positions - self.targets, axis=2)

    def weights(self, state: LatentState) -> np.ndarray:
        """Compute the weights (B, L) of the data, per square centimetre, low for outliers and unfound loose markers."""
        off = self.residuals(state)
        usual = np.nanmedian(off, axis=1, keepdims=True)
        share = energy.geman_mcclure(np.nan_to_num(off), np.maximum(self.config.outlier, 3 * usual))
        # 5: a loose marker may be that many times farther off before it was searched
        return self.config.data * share / np.where(self.loose & (not state.looked), 5.0, 1.0)**2

    def solve(self, state: LatentState, factor: float, last: bool) -> tuple[np.ndarray, bool, int]:
        """Minimise [MoSh] Eq. 23 in one stage; return unknowns as `LatentState.rows`, convergence and steps."""
        weights, usual, n = self.weights(state), self._usual(state.layout), state.x.shape[1]

        def equations(rows: np.ndarray) -> Arrow:
            x, z = rows[:, :n], rows[0, n:]
            # an arrow matrix: a block for each frame, and a border for what frames share
            shared = self.shared_terms(state, usual, z, factor).values()
            frames = self.of_frames(state, x, z, weights, factor).values()
            return Arrow(normal_equations(list(frames)), len(z),
                         normal_equations([Residual(r.values[None], r.jacobian[None]) for r in shared]))

        # tolerance 1e-4: with 1e-3 before the last stage, the triangles depended on the orientation of the world
        end = levenberg_marquardt(equations, state.rows, 24 if last else 8, 1e-4, angles=self.n_angles)
        return end.x, bool(end.converged[0]), end.iterations

    def of_frames(self, state: LatentState, x: np.ndarray, z: np.ndarray, weights: np.ndarray, factor: float
                  ) -> dict[str, Residual]:
        """Return the terms of the frames, E_D and E_θ, with derivatives by (x, z)."""
        whole = np.concatenate([x, np.tile(z, (len(x), 1))], axis=1)
        return {"data": marker_term(self.simulate(state, x, z), self.targets, weights),
                "pose": energy.pose_prior_term(whole, self.prior, factor * self.config.pose)}            # [MoSh] Eq. 21

    def shared_terms(self, state: LatentState, usual: LatentPoints, z: np.ndarray, factor: float
                     ) -> dict[str, Residual]:
        """Return the terms that frames share, E_S, E_I and E_β, with derivatives by z."""
        c, markers = self.config, latent_places(state.markers.kind, state.supports, z)
        distances = np.asarray(state.layout.distances)
        return {"surface": surface_term(markers, state.corners.moving(z), state.least, state.greatest, c.surface),
                "initial": place_term(markers, energy.above_skin(usual.moving(z), distances),
                                      factor * self.place_weight),
                "shape": shape_term(z, self.n_betas, factor * c.shape)}

    def energies(self, state: LatentState) -> dict[str, float]:
        """Compute the value of each term, weights included."""
        both = self.of_frames(state, state.x, state.z, self.weights(state), 1.0) | self.shared_terms(
            state, self._usual(state.layout), state.z, 1.0)
        return {name: float(np.sum(term.energy)) for name, term in both.items()}

    def measure_stretch(self, state: LatentState) -> float:
        """Estimate how many times longer the observed markers would be along their longest axis to fit a body best.

        It is the Gauss-Newton step at the minimum for two more unknowns: a factor on all axes, which the prior of size
        shifts, and one on the longest axis, relative to it.
        """
        z, usual = state.z, self._usual(state.layout)
        spans = np.nanmax(self.targets, axis=1) - np.nanmin(self.targets, axis=1)
        longest = np.eye(3)[spans.mean(axis=0).argmax()]
        centred = np.nan_to_num(self.targets - np.nanmean(self.targets, axis=1, keepdims=True))
        by_scales = -np.stack([centred, centred * longest], axis=-1)

        def widen(term: Residual) -> Residual:
            return Residual(term.values, np.concatenate(
                [term.jacobian, np.zeros((*term.jacobian.shape[:-1], 2))], axis=-1))

        found, weights = self.simulate(state, state.x, z), self.weights(state)
        data = marker_term(MovingPoints(found.positions, np.concatenate([found.jacobian, by_scales], axis=-1)),
                           self.targets, weights)
        pose = widen(self.of_frames(state, state.x, z, weights, 1.0)["pose"])
        shared = [widen(Residual(r.values[None], r.jacobian[None])) for r in
                  self.shared_terms(state, usual, z, 1.0).values()]
        equations = Arrow(normal_equations([data, pose]), len(z) + 2, normal_equations(shared))
        size, stretch = equations.step(np.zeros(1))[0][0, -2:]
        return float(1 + stretch / (1 + size))

    def export_layout(self, state: LatentState) -> MarkerLayout:
        """Return the layout with each marker on its triangle, at its own distance, exact in the latent pose."""
        vertices, points, attached = self.latent.at(state.betas), state.places, state.markers
        if attached.kind != "triangle":
            attached = latent_markers(self.model.template.with_vertices(vertices), points)
        p = vertices[attached.corners]
        c = attached.coefficients(vertices, points)
        # barycentric weights from the coefficients along the first edge, across it, and along the normal
        along, across = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        length = np.linalg.norm(along, axis=1)
        first = np.einsum("ld,ld->l", across, along) / length
        height = np.sqrt(np.einsum("ld,ld->l", across, across) - first**2)
        third = c[:, 1] / height
        second = (c[:, 0] - third * first) / length
        return MarkerLayout(self.layout.labels, attached.corners, c[:, 2],
                            np.stack([1 - second - third, second, third], axis=1), self.layout.aliases)
