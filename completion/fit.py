"""Pose, place and shape of a body from a scan: matches, robust weights, and a search that escapes wrong limbs."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints

from . import energy
from .bodies import FixedBody
from .contact import Contact
from .draws import around, limbs, near_points, quick_misfits, redrawn
from .priors import GaussianPrior, gaussian_prior
from .scan import ScanPoints, spread
from .sight import find_sight
from .solve import MinimiseConfig, minimise
from .starts import distinct, search

SETTLED = 5e-4                       # metres, root mean square over the vertices from round to round
DOUBT = 0.012                        # share of scan or body that may be in the wrong place for no reason
MANY = 6                             # times as many draws of a limb are compared with what is unexplained
PROMISING = 30.0                     # a limb drawn at random may be this much worse before it is fitted


@dataclass(frozen=True)
class CompletionConfig:
    """Settings of `complete`.

    Attributes
    ----------
    surface_weight : float
        w_Z of Eq. 10: how strongly each measured point draws the completed surface.
    twist_weight : float
        w_T of Eq. 11: how strongly one round holds the joint angles of the round before.
    landmark_sd : float, metres
        How far a landmark may lie from its vertex.
    scan_sd : float, metres
        How far the scan lies from the predicted mesh, as the model is not exact.
    evidence : float
        How many independent measurements the whole scan is worth; what the model cannot follow is alike
        at neighbouring points, so this is far fewer than there are points.
    prior_weight : float
        Factor on the pose prior once the scan is used.
    prior_shrinkage : float in [0, 1]
        See `gaussian_prior`.
    start_axes : int
        Directions of the training poses along which the search starts.
    candidates : int
        Starts that are carried on from the landmarks to the scan.
    reach : float, metres
        First limit on the distance of matches; it shrinks to `final_reach`.
    final_reach : float, metres
    rounds : int
        Matchings from `reach` to `final_reach`.
    min_cosine : float
        Least cosine between the normals of a match.
    scan_points : int
        Points of the scan that are matched to the model.
    model_points : int
        Vertices of the model that are matched to the scan.
    surface_reach : float, metres
        Limit on the distance of scan points to the free surface.
    surface_rounds : int
        Matchings of the free surface.
    draws : int
        Poses drawn at random around each start, and for each limb that may be wrong.
    seed : int
        Of the random draws.
    silhouette_weight : float
        How much a vertex counts that stands where a single camera saw nothing, against one that lies on the
        scan; 0 when the scan has parts cut away by hand.
    silhouette_tolerance : float, metres
    contact_weight : float
        The same for a vertex that stands inside another part of the body.
    viewpoint : (3,) floats, metres, optional
        Where the scan was seen from; found by itself when not given.
    """

    surface_weight: float = 1.0
    twist_weight: float = 1.0
    landmark_sd: float = 0.01
    scan_sd: float = 0.008
    evidence: float = 400.0
    prior_weight: float = 1.0
    prior_shrinkage: float = 0.3
    start_axes: int = 4
    candidates: int = 3
    reach: float = 0.2
    final_reach: float = 0.03
    rounds: int = 8
    min_cosine: float = 0.6
    scan_points: int = 2500
    model_points: int = 1200
    surface_reach: float = 0.03
    surface_rounds: int = 4
    draws: int = 60
    seed: int = 0
    silhouette_weight: float = 0.5
    silhouette_tolerance: float = 0.03
    contact_weight: float = 0.5
    viewpoint: tuple[float, float, float] | None = None


class ScanFit:
    """One scan and one body, with what stays the same between the stages.

    Parameters
    ----------
    body : FixedBody
    cloud : ScanPoints
    vertices : (L,) int
    points : (L, 3) float, metres
        The landmarks.
    config : CompletionConfig
    """

    def __init__(self, body: FixedBody, cloud: ScanPoints, vertices: np.ndarray, points: np.ndarray,
                 config: CompletionConfig) -> None:
        self.body, self.config = body, config
        self.vertices, self.points = vertices, points
        self.prior: GaussianPrior = gaussian_prior(body.pose_mean, body.pose_covariance, config.prior_shrinkage)
        self.cloud = cloud
        self.thin = cloud.thinned(config.scan_points)
        self.coarse = cloud.thinned(config.scan_points // 4)
        self.tree = OrientedPoints(cloud.points, cloud.normals)
        given = None if config.viewpoint is None else np.array(config.viewpoint)
        self.sight = find_sight(cloud, given) if config.silhouette_weight > 0 else None
        self.spread = spread(body.template.vertices, config.model_points)
        self.part = body.skeleton.part_of_vertex(body.template)
        self.contact = Contact(body.skeleton, self.part[self.spread])
        self.rng = np.random.default_rng(config.seed)

    def mesh(self, x: np.ndarray) -> Mesh:
        """The predicted mesh of unknowns (P,)."""
        return self.body.template.with_vertices(self.body.vertices(x))

    def from_landmarks(self) -> np.ndarray:
        """The likeliest bodies (n, P) that meet the landmarks, distinct and best first."""
        body, config = self.body, self.config
        follow = body.follow(self.vertices, np.zeros(body.n_angles + 3 + body.n_betas))
        x, _ = search(body, follow, self.points, config.landmark_sd, self.prior, config.start_axes)
        places = body.subject.points(self.spread).evaluate(*body.split(x)[:2])
        x = x[distinct(places, config.candidates)]
        drawn = np.concatenate([x, *(around(body, follow, start, self.points, config.landmark_sd, self.prior,
                                            config.draws, self.rng) for start in x)])
        drawn = drawn[np.argsort(quick_misfits(self, drawn))]
        places = body.subject.points(self.spread).evaluate(*body.split(drawn)[:2])
        return drawn[distinct(places, config.candidates)]

    def best_start(self, starts: np.ndarray) -> np.ndarray:
        """The start (P,) that explains the scan best after a few rounds on few points."""
        ends = [self.approach(x) for x in starts]
        return ends[int(np.argmin([self.misfit(x) for x in ends]))]

    def approach(self, x: np.ndarray, reaches: tuple[float, ...] = (0.25, 0.2, 0.15, 0.12, 0.1)) -> np.ndarray:
        """Unknowns (P,) after a few rounds on few points."""
        for reach in reaches:
            x = self.step(x, self.coarse, reach)[0]
        return x

    def redraw_limbs(self, x: np.ndarray) -> np.ndarray:
        """Unknowns (P,) with limbs moved elsewhere where that explains the scan better; the shape is held."""
        if not self.doubtful(x):
            return x
        whole, self.body = self.body, self.body.held(x)
        free = whole.n_angles + 3
        moved = self._redrawn(x[:free])
        self.body = whole
        return np.concatenate([moved[:free], x[free:]])

    def _redrawn(self, x: np.ndarray) -> np.ndarray:
        best = self.misfit(x)
        for root in limbs(self.body.skeleton):
            moved = np.flatnonzero(self.body.skeleton.descends[:, root])
            drawn = redrawn(self.body, x, root, self.prior, MANY * self.config.draws, self.rng)
            wanted = self.coarse.points[self.unexplained(x, self.coarse)]
            drawn = np.vstack([near_points(self, drawn, moved, wanted, self.config.draws // 3),
                               drawn[:self.config.draws]])
            quick = quick_misfits(self, np.vstack([x, drawn]), moved)
            for i in np.argsort(quick[1:])[:2]:
                if quick[i + 1] > quick[0] + PROMISING:
                    continue
                tried = self.approach(drawn[i], (0.2, 0.15, 0.1))
                if (misfit := self.misfit(tried)) < best - 5:
                    x, best = tried, misfit
        return x

    def unexplained(self, x: np.ndarray, scan: ScanPoints) -> np.ndarray:
        """(n,) bool: points of the scan with nothing of the body near."""
        mesh = self.mesh(x)
        return ~OrientedPoints(mesh.vertices, mesh.vertex_normals).match(scan.points, scan.normals, 0.05,
                                                                         self.config.min_cosine).valid

    def doubtful(self, x: np.ndarray) -> bool:
        """Whether more than a little of the scan is unexplained, or of the body where nothing can be."""
        return bool(self.unexplained(x, self.thin).mean() > DOUBT
                    or len(self.trespasses(self.mesh(x))[0]) > DOUBT * len(self.spread))

    def misfit(self, x: np.ndarray, cap: float = 0.05) -> float:
        """How badly a body explains scan and landmarks, for the choice between starts."""
        config = self.config
        mesh = self.mesh(x)
        found = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(self.thin.points, self.thin.normals, cap,
                                                                         config.min_cosine)
        apart = (np.minimum(found.distances, cap)**2).mean()
        if self.sight is not None:
            excess = self.sight.trespass(mesh.vertices[self.spread], config.silhouette_tolerance)[0]
            apart += config.silhouette_weight * (np.minimum(excess, cap)**2).mean()
        depth = self.contact.intrusions(mesh.vertices[self.spread], mesh.vertex_normals[self.spread])[0]
        apart += config.contact_weight * (np.minimum(depth, cap)**2).mean()
        off = ((mesh.vertices[self.vertices] - self.points)**2).sum() / config.landmark_sd**2
        prior = energy.pose_prior(x, self.prior, config.prior_weight).energy
        return float(config.evidence * apart / config.scan_sd**2 + off + prior)

    def follow_scan(self, x: np.ndarray, tell: Callable[[int], None]
                    ) -> tuple[np.ndarray, bool, int, dict[str, float]]:
        """Unknowns after rounds of matching with shrinking reach, whether they settled, rounds, energies."""
        config = self.config
        shift, place = np.inf, self.mesh(x).vertices
        energies: dict[str, float] = {}
        reaches = np.geomspace(config.reach, config.final_reach, config.rounds)
        for i, reach in enumerate([*reaches, *[config.final_reach] * 6]):
            x, energies = self.step(x, self.thin, reach)
            before, place = place, self.mesh(x).vertices
            shift = float(np.sqrt(((place - before)**2).sum(axis=1).mean()))
            tell(min(i + 1, config.rounds))
            if i >= config.rounds and shift < SETTLED:
                break
        return x, bool(shift < 2 * SETTLED), i + 1, energies

    def step(self, x: np.ndarray, scan: ScanPoints, reach: float) -> tuple[np.ndarray, dict[str, float]]:
        """One matching and the best unknowns (P,) for it, and the energies there."""
        body, config = self.body, self.config
        mesh = self.mesh(x)
        ids, target, normal, weights = self.matches(mesh, scan, reach)
        out_ids, out_target, out_normal, out_weights = self.trespasses(mesh)
        follow = body.follow(np.concatenate([self.vertices, ids, out_ids]), x)
        count, end = len(self.vertices), len(self.vertices) + len(ids)
        held = np.full(len(x), config.twist_weight)
        held[:3] = held[body.n_angles:] = 0
        landmark_weights = np.full(count, config.landmark_sd**-2)

        def energies(at: np.ndarray) -> list[energy.Residual]:
            points = follow(at)
            marked, free, denied = points[:count], points[count:end], points[end:]
            return [energy.point_to_point(marked, self.points, landmark_weights),
                    energy.pose_prior(at, self.prior, config.prior_weight),
                    energy.shape_prior(at, body.n_angles + 3),
                    energy.point_to_plane(free, target, normal, weights),
                    energy.point_to_point(free, target, 0.1 * weights),
                    energy.point_to_plane(denied, out_target, out_normal, out_weights),
                    energy.stay_near(at, x, held)]

        best = minimise(energies, x[None], MinimiseConfig(iterations=2, tolerance=1e-3)).x
        names = ("landmarks", "pose_prior", "shape_prior", "scan_planes", "scan_points", "trespass", "twists")
        return best[0], {n: float(r.energy[0]) for n, r in zip(names, energies(best), strict=True)}

    def matches(self, mesh: Mesh, scan: ScanPoints, reach: float) -> tuple[np.ndarray, ...]:
        """Vertices, scan points, their normals and weights, by closest points both ways."""
        config = self.config
        there = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(scan.points, scan.normals, reach,
                                                                         config.min_cosine)
        mine = self.spread
        back = self.tree.match(mesh.vertices[mine], mesh.vertex_normals[mine], reach, config.min_cosine)
        hit = back.index
        off = mesh.vertices[mine] - self.cloud.points[hit]
        along = np.einsum("nd,nd->n", off, self.cloud.normals[hit])
        beside = np.sqrt(np.maximum((off**2).sum(axis=1) - along**2, 0))
        inner = back.valid & ~self.cloud.border[hit] & (beside < 2 * self.cloud.spacing + 0.3 * np.abs(along))
        a, b = there.valid, inner
        ids = np.concatenate([there.index[a], mine[b]])
        target = np.concatenate([scan.points[a], self.cloud.points[hit[b]]])
        normal = np.concatenate([scan.normals[a], self.cloud.normals[hit[b]]])
        distance = np.concatenate([there.distances[a], back.distances[b]])
        share = np.concatenate([np.full(a.sum(), 1 / len(scan.points)), np.full(b.sum(), 0.5 / len(mine))])
        weights = config.evidence / config.scan_sd**2 * share * energy.geman_mcclure(distance, max(reach / 2, 0.015))
        return ids, target, normal, weights

    def trespasses(self, mesh: Mesh) -> tuple[np.ndarray, ...]:
        """Vertices that are where nothing can be, points and normals of the planes they should reach, weights.

        The camera would have seen them, or another part of the body is there.
        """
        config, mine = self.config, self.spread
        places = mesh.vertices[mine]
        found = [(config.contact_weight, self.contact.intrusions(places, mesh.vertex_normals[mine]))]
        if self.sight is not None:
            found.append((config.silhouette_weight, self.sight.trespass(places, config.silhouette_tolerance)))
        share = config.evidence / config.scan_sd**2 / len(mine)
        ids, targets, normals, weights = [], [], [], []
        for weight, (excess, normal, target) in found:
            out = excess > 0
            ids.append(mine[out])
            targets.append(target[out])
            normals.append(normal[out])
            weights.append(weight * share * energy.geman_mcclure(excess[out], 0.1))
        return tuple(np.concatenate(part) for part in (ids, targets, normals, weights))
