"""Pose, place and shape of a body from a scan: matches, robust weights, and a search that escapes wrong limbs."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy

import numpy as np

from scanprep.geometry.least_squares import Residual, levenberg_marquardt, normal_equations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints

from .. import energy
from ..bodies import FixedBody
from ..priors import GaussianPrior, choose_prior, gaussian_prior, joint_limits
from .free_space import find_sights
from .masks import Cover, part_vertices
from .scan import ScanPoints, spread
from .self_intersection import Contact
from .settings import CompletionConfig

Energy = Callable[[np.ndarray], Sequence[Residual]]
Denial = tuple[np.ndarray, np.ndarray, np.ndarray]

TERMS = ("landmarks", "pose_prior", "joint_limits", "shape_prior", "scan_planes", "scan_points", "trespass")
LIKELY = 0.04                        # metres: matches closer than this are mostly right
SETTLED = 5e-4                       # metres, root mean square over the vertices from round to round


class ScanFit:
    """One scan and one body, with what stays the same between the stages.

    `vertices` (L,) int; `points` (L, 3), metres, the landmarks.
    """

    def __init__(self, body: FixedBody, cloud: ScanPoints, vertices: np.ndarray, points: np.ndarray,
                 config: CompletionConfig) -> None:
        self.body, self.config = body, config
        self.vertices, self.points = vertices, points
        self.prior: GaussianPrior = gaussian_prior(body.pose_mean, body.pose_covariance, config.prior_shrinkage)
        self.habit = choose_prior(config.pose_prior, body.pose_mean, body.pose_covariance, body.pose_examples,
                                  body.skeleton.parents, config.prior_shrinkage)
        self.limits = joint_limits(body.pose_examples)
        self.spread = spread(body.template.vertices, config.model_points)
        self.ignored = part_vertices(body.template, body.skeleton, config.ignored_parts)
        self.matched = self.spread[~self.ignored[self.spread]]
        self.part = body.skeleton.part_of_vertex(body.template)
        self.contact = Contact(body.skeleton, self.part[self.spread])
        self.rng = np.random.default_rng(config.seed)
        self._take(cloud)

    def _take(self, cloud: ScanPoints) -> None:
        """All that belongs to the scan."""
        config = self.config
        self.cloud = cloud
        self.thin = cloud.thinned(config.scan_points)
        self.coarse = cloud.thinned(config.scan_points // 4)
        self.tree = OrientedPoints(cloud.points, cloud.normals)
        self.sight = find_sights(cloud) if config.silhouette_weight > 0 else None
        self.cover = None if cloud.masked is None else Cover(cloud.masked)

    def on(self, cloud: ScanPoints) -> ScanFit:
        """The same body with another scan, without landmarks; all that belongs to the body is shared."""
        out = copy(self)
        out.vertices, out.points = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        out._take(cloud)
        return out

    def mesh(self, x: np.ndarray) -> Mesh:
        """The predicted mesh of unknowns (P,)."""
        return self.body.template.with_vertices(self.body.vertices(x))

    def unexplained(self, x: np.ndarray, scan: ScanPoints) -> np.ndarray:
        """(n,) bool: points of the scan with nothing of the body near."""
        mesh = self.mesh(x)
        found = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(scan.points, scan.normals, 0.05,
                                                                         self.config.min_cosine)
        return ~found.valid

    def without_ignored(self, cloud: ScanPoints, predicted: Mesh) -> ScanPoints:
        """A scan without its points on parts of the body that are not to be matched."""
        if not self.ignored.any():
            return cloud
        found = OrientedPoints(predicted.vertices, predicted.vertex_normals).match(cloud.points, cloud.normals)
        return cloud.some(~(self.ignored[found.index] & found.valid))

    def misfit(self, x: np.ndarray, cap: float = 0.05) -> float:
        """How badly a body explains scan and landmarks, for the choice between starts."""
        config = self.config
        mesh = self.mesh(x)
        found = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(self.thin.points, self.thin.normals, cap,
                                                                         config.min_cosine)
        counted = np.minimum(found.distances, cap)**2 * ~(found.valid & self.ignored[found.index])
        apart = counted.mean()
        for weight, ids, (excess, _, _) in self._denials(mesh):
            apart += weight * (np.minimum(excess, cap)**2).sum() / len(ids)
        off = ((mesh.vertices[self.vertices] - self.points)**2).sum() / config.landmark_sd**2
        return float(config.evidence * apart / config.scan_sd**2 + off) + self.unlikely(x)

    def unlikely(self, x: np.ndarray) -> float:
        """Energy of the pose of unknowns (P,) before anything is measured."""
        over = energy.joint_limits(x, self.limits).energy if self.config.joint_limits else 0.0
        return float(self.config.prior_weight * (self.habit.energy(self.body.split(x)[0]) + over))

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
        held = np.full(len(x), self.config.twist_weight)
        held[:3] = held[self.body.n_angles:] = 0
        terms = self.terms(x, scan, reach)

        def energies(at: np.ndarray) -> list[Residual]:
            return [*terms(at), energy.stay_near(at, x, held)]

        best = levenberg_marquardt(lambda at: normal_equations(energies(at)), x[None], 2, 1e-3).x
        return best[0], {n: float(r.energy[0]) for n, r in zip((*TERMS, "twists"), energies(best), strict=True)}

    def precision(self, x: np.ndarray) -> np.ndarray:
        """(P, P) how sharply scan, landmarks and priors together determine unknowns (P,): the Gauss-Newton matrix."""
        terms = self.terms(x, self.thin, self.config.final_reach)
        return normal_equations(terms(x[None])).hessian[0]

    def terms(self, x: np.ndarray, scan: ScanPoints, reach: float) -> Energy:
        """The energies `TERMS` of unknowns (B, P) near x (P,), for the matches at x."""
        body, config = self.body, self.config
        mesh = self.mesh(x)
        ids, target, normal, weights = self.matches(mesh, scan, reach)
        out_ids, out_target, out_normal, out_weights = self.trespasses(mesh)
        follow = body.follow(np.concatenate([self.vertices, ids, out_ids]), x)
        count, end = len(self.vertices), len(self.vertices) + len(ids)
        landmark_weights = np.full(count, config.landmark_sd**-2)
        prior, limit = self.habit.near(body.split(x)[0]), config.prior_weight * config.joint_limits
        stiff = max(1.0, reach / LIKELY)             # far matches are often wrong, and shape gives way before pose does

        def energies(at: np.ndarray) -> list[Residual]:
            points = follow(at)
            marked, free, denied = points[:count], points[count:end], points[end:]
            return [energy.point_to_point(marked, self.points, landmark_weights),
                    energy.pose_prior(at, prior, config.prior_weight),
                    energy.joint_limits(at, self.limits, limit),
                    energy.shape_prior(at, body.n_angles + 3, stiff),
                    energy.point_to_plane(free, target, normal, weights),
                    energy.point_to_point(free, target, 0.1 * weights),
                    energy.point_to_plane(denied, out_target, out_normal, out_weights)]

        return energies

    def matches(self, mesh: Mesh, scan: ScanPoints, reach: float) -> tuple[np.ndarray, ...]:
        """Vertices, scan points, their normals and weights, by closest points both ways."""
        config = self.config
        there = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(scan.points, scan.normals, reach,
                                                                         config.min_cosine)
        mine = self.matched
        back = self.tree.match(mesh.vertices[mine], mesh.vertex_normals[mine], reach, config.min_cosine)
        hit = back.index
        off = mesh.vertices[mine] - self.cloud.points[hit]
        along = np.einsum("nd,nd->n", off, self.cloud.normals[hit])
        beside = np.sqrt(np.maximum((off**2).sum(axis=1) - along**2, 0))
        inner = back.valid & ~self.cloud.border[hit] & (beside < 2 * self.cloud.spacing + 0.3 * np.abs(along))
        a, b = there.valid & ~self.ignored[there.index], inner
        ids = np.concatenate([there.index[a], mine[b]])
        target = np.concatenate([scan.points[a], self.cloud.points[hit[b]]])
        normal = np.concatenate([scan.normals[a], self.cloud.normals[hit[b]]])
        distance = np.concatenate([there.distances[a], back.distances[b]])
        share = np.concatenate([np.full(a.sum(), 1 / len(scan.points)), np.full(b.sum(), 0.5 / len(mine))])
        weights = config.evidence / config.scan_sd**2 * share * energy.geman_mcclure(distance, max(reach / 2, 0.015))
        if self.cover is None:
            return ids, target, normal, weights
        under, over, away = self.cover.below(mesh.vertices[mine], mesh.vertex_normals[mine])
        loose = np.full(under.sum(), config.evidence / config.cover_sd**2 / len(mine))
        return (np.concatenate([ids, mine[under]]), np.concatenate([target, over[under]]),
                np.concatenate([normal, away[under]]), np.concatenate([weights, loose]))

    def trespasses(self, mesh: Mesh) -> tuple[np.ndarray, ...]:
        """Vertices that are where nothing can be, points and normals of the planes they should reach, weights.

        The camera would have seen them, they stick out of clothing, or another part of the body is there.
        """
        share = self.config.evidence / self.config.scan_sd**2
        ids, targets, normals, weights = [], [], [], []
        for weight, mine, (excess, normal, target) in self._denials(mesh):
            out = excess > 0
            ids.append(mine[out])
            targets.append(target[out])
            normals.append(normal[out])
            weights.append(weight * share / len(mine) * energy.geman_mcclure(excess[out], 0.1))
        return tuple(np.concatenate(part) for part in (ids, targets, normals, weights))

    def _denials(self, mesh: Mesh) -> list[tuple[float, np.ndarray, Denial]]:
        """What says that vertices cannot be where they are: its weight, the vertices, and what `trespass` gives."""
        config, places, normals = self.config, mesh.vertices, mesh.vertex_normals
        found = [(config.contact_weight, self.spread, self.contact.intrusions(places[self.spread],
                                                                              normals[self.spread]))]
        if self.sight is not None:
            found.append((config.silhouette_weight, self.matched,
                          self.sight.trespass(places[self.matched], config.silhouette_tolerance)))
        if self.cover is not None:
            found.append((config.cover_weight, self.matched,
                          self.cover.trespass(places[self.matched], normals[self.matched])))
        return found
