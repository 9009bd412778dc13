"""Pose, place and shape of a body from a scan: matches, robust weights, and a search that escapes wrong limbs."""
from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, replace

import numpy as np

from model.priors import LEAST_POSES, GaussianPrior, JointLimits, gaussian_prior
from scanprep.geometry.least_squares import Residual, levenberg_marquardt, normal_equations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints

from .. import energy
from ..bodies import FixedBody
from .free_space import Clothing, Contact, Outside, Violation, find_cameras, free_space_violation
from .masks import part_vertices
from .scan import ScanPoints, spread
from .settings import CompletionConfig
from .upright import TILT, Upright

Terms = dict[str, Residual]

LIKELY = 0.04                        # metres: matches closer than this are mostly right
SETTLED = 5e-4                       # metres, root mean square over the vertices from round to round
REACH, WIDE_REACH, FINAL_REACH = 0.2, 0.08, 0.03    # metres: limits on the distance of matches, from first to last
NARROWING, SETTLING = 3, 6           # rounds from the wide to the final reach; that a reach is held at most
CLEARLY = 0.93                       # of the narrow reach's misfit, below which the wide one's is clearly less
QUICK = 3000                         # vertices that a quick look takes
BEYOND = 0.2                         # radians that joints may rotate farther than in the training poses
MIN_COSINE = 0.6                     # between the normals of a match
# Independent measurements that a whole scan is worth: what the model cannot follow is alike at neighbouring points, so
# this is far fewer than there are points.
EVIDENCE = 400.0
STRANGE, ODD = np.radians(45), 0.05  # from the nearest known joint on: strange; and what that may vary, radians
UNDER_CLOTHES = 0.1                  # weight of a match of skin below what a depth camera saw, against skin above it


class ScanFit:
    """One scan and one body, with what stays the same between the stages.

    `vertices` (L,) int; `points` (L, 3), metres, the landmarks.
    """

    def __init__(self, body: FixedBody, cloud: ScanPoints, vertices: np.ndarray, points: np.ndarray,
                 config: CompletionConfig) -> None:
        self.body, self.config = body, config
        self.vertices, self.points = vertices, points
        self.prior: GaussianPrior = gaussian_prior(body.pose_mean, body.pose_covariance)
        known = config.joint_limits and len(body.pose_examples) >= LEAST_POSES
        self.limits = JointLimits.from_poses(body.pose_examples, 1.0, BEYOND) if known else None
        self.spread = spread(body.template.vertices, config.model_points)
        self.ignored = part_vertices(body.template, body.skeleton, config.ignored_parts)
        self.matched = self.spread[~self.ignored[self.spread]]
        self.part = body.skeleton.part_of_vertex(body.template)
        self.upright = Upright.of(body.template, body.skeleton, config.up, cloud.person is not None)
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
        self.cameras = find_cameras(cloud) if config.free_space_weight > 0 else ()
        self.clothing = None if cloud.masked is None else Clothing(cloud.masked)
        self._outside: Outside | None = None

    def on(self, cloud: ScanPoints) -> ScanFit:
        """The same body with another scan, without landmarks; all that belongs to the body is shared."""
        out = copy(self)
        out.vertices, out.points = np.zeros(0, dtype=np.int64), np.zeros((0, 3))
        out._take(cloud)
        return out

    def held(self, x: np.ndarray) -> ScanFit:
        """The same scan with the body that has the shape of unknowns (P,), as one of known shape."""
        out = copy(self)
        out.body = self.body.held(x)
        return out

    @property
    def outside(self) -> Outside | None:
        """A table of where the cameras saw that nothing is; None without cameras."""
        if self._outside is None and self.cameras:
            self._outside = Outside(self.cameras)
        return self._outside

    def mesh(self, x: np.ndarray) -> Mesh:
        """The predicted mesh of unknowns (P,)."""
        return self.body.template.with_vertices(self.body.vertices(x))

    def unexplained(self, x: np.ndarray, scan: ScanPoints) -> np.ndarray:
        """(n,) bool: points of the scan with nothing of the body near."""
        mesh = self.mesh(x)
        found = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(scan.points, scan.normals, 0.05,
                                                                         MIN_COSINE)
        return ~found.valid

    def beyond(self, x: np.ndarray) -> np.ndarray:
        """(N,) bool: vertices beyond the border of the picture, of which nothing can be known; none without one."""
        person = self.cloud.person
        return np.zeros(len(self.part), dtype=bool) if person is None else \
            ~person.picture.project(self.mesh(x).vertices)[2]

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
                                                                         MIN_COSINE)
        counted = np.minimum(found.distances, cap)**2 * ~(found.valid & self.ignored[found.index])
        apart = counted.mean()
        for weight, ids, found_out in self.objections(mesh):
            apart += weight * (np.minimum(found_out.excess, cap)**2).sum() / len(ids)
        off = ((mesh.vertices[self.vertices] - self.points)**2).sum() / config.landmark_sd**2
        return float(EVIDENCE * apart / config.scan_sd**2 + off) + self.unlikely(x) + float(self.strange(x).sum())

    def strange(self, x: np.ndarray) -> np.ndarray:
        """Energy (J,) of joints of unknowns (P,) that are held as in no known pose; for choices, not for steps."""
        beyond = self.body.joints_from_known(self.body.split(x)[0]) - STRANGE
        return (np.maximum(beyond, 0) / ODD)**2

    def quick_misfits(self, x: np.ndarray, cap: float = 0.1) -> np.ndarray:
        """How badly bodies (n, P) explain the scan, on few vertices whose normals rotate with their parts."""
        ids, few = spread(self.body.template.vertices, QUICK), slice(None, None, 3)
        contact = Contact(self.body.skeleton, self.part[ids[few]])
        pose, trans, _ = self.body.split(x)
        places, normals = self.posed_points(ids, pose, trans)
        out = np.empty(len(x))
        for i, (y, n) in enumerate(zip(places, normals, strict=True)):
            found = OrientedPoints(y, n).match(self.coarse.points, self.coarse.normals, cap, MIN_COSINE)
            apart = (np.minimum(found.distances, cap)**2).mean()
            depth = contact.violation(y[few], n[few]).excess
            apart += self.config.contact_weight * (np.minimum(depth, cap)**2).mean()
            if self.cameras:
                excess = free_space_violation(self.cameras, y[few]).excess
                apart += self.config.free_space_weight * (np.minimum(excess, cap)**2).mean()
            out[i] = EVIDENCE * apart / self.config.scan_sd**2 + self.unlikely(x[i])
        return out

    def posed_points(self, ids: np.ndarray, poses: np.ndarray, trans: np.ndarray | None = None
                     ) -> tuple[np.ndarray, np.ndarray]:
        """Some vertices (B, L, 3) in poses (B, J, 3), and normals that rotate with their parts."""
        R = self.body.skeleton.part_rotations(poses)[:, self.part[ids]]
        normals = (R @ self.body.template.vertex_normals[ids][:, :, None])[..., 0]
        return self.body.subject.points(ids).evaluate(poses, trans), normals

    def unlikely(self, x: np.ndarray) -> float:
        """Energy of the pose of unknowns (P,) before anything is measured."""
        return float(sum(term.energy[0] for term in self.prior_terms(x[None]).values()))

    def prior_terms(self, x: np.ndarray) -> Terms:
        """What is known of poses (B, P) beforehand: the Gaussian, joint limits where asked for, and that people stand.

        [SCAPE-patent] §0090
        """
        weight = self.config.prior_weight
        limits = {} if self.limits is None else {"joint_limits": energy.joint_limits(x, self.limits, weight)}
        stands = {} if self.upright is None else {"upright": energy.upright(x, self.upright.of_body,
                                                                            self.upright.nearest(x), TILT)}
        return {"pose_prior": energy.pose_prior(x, self.prior, weight), **limits, **stands}

    def step(self, x: np.ndarray, scan: ScanPoints, reach: float) -> tuple[np.ndarray, dict[str, float]]:
        """One matching and the best unknowns (P,) for it, and the energies there."""
        held = np.full(len(x), self.config.twist_weight)
        held[:3] = held[self.body.n_angles:] = 0
        data, betas = self.terms(x, scan, reach), self.body.n_angles + 3
        stiff = max(1.0, reach / LIKELY)             # far matches are often wrong, and shape gives way before pose does

        def terms(at: np.ndarray) -> Terms:
            return {**data(at), "shape_prior": energy.shape_prior(at, betas, stiff),
                    "twists": energy.stay_near(at, x, held)}                                      # [SCAPE] Eq. 11

        best = levenberg_marquardt(lambda at: normal_equations([*terms(at).values()]), x[None], 2, 1e-3).x
        return best[0], {name: float(term.energy[0]) for name, term in terms(best).items()}

    def precision(self, x: np.ndarray) -> np.ndarray:
        """(P, P) how sharply scan, landmarks and priors together determine unknowns (P,): the Gauss-Newton matrix."""
        terms = self.terms(x, self.thin, FINAL_REACH)(x[None])
        return normal_equations([*terms.values(), energy.shape_prior(x[None], self.body.n_angles + 3)]).hessian[0]

    def terms(self, x: np.ndarray, scan: ScanPoints, reach: float) -> Callable[[np.ndarray], Terms]:
        """The energies of unknowns (B, P) near x (P,) for the matches at x, without what is known of shapes."""
        mesh = self.mesh(x)
        ids, target, normal, weights = self.matches(mesh, scan, reach)
        out_ids, out_target, out_normal, out_weights = self.violations(mesh)
        follow = self.body.follow(np.concatenate([self.vertices, ids, out_ids]), x)
        count, end = len(self.vertices), len(self.vertices) + len(ids)
        landmark_weights = np.full(count, self.config.landmark_sd**-2)

        def terms(at: np.ndarray) -> Terms:
            points = follow(at)
            marked, free, out = points[:count], points[count:end], points[end:]
            return {"landmarks": energy.point_to_point(marked, self.points, landmark_weights),
                    **self.prior_terms(at),
                    "scan_planes": energy.point_to_plane(free, target, normal, weights),
                    "scan_points": energy.point_to_point(free, target, 0.1 * weights),
                    "violations": energy.point_to_plane(out, out_target, out_normal, out_weights)}

        return terms

    def matches(self, mesh: Mesh, scan: ScanPoints, reach: float) -> tuple[np.ndarray, ...]:
        """Vertices, scan points, their normals and weights, by closest points both ways."""
        config = self.config
        there = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(scan.points, scan.normals, reach,
                                                                         MIN_COSINE)
        mine = self.matched
        back = self.tree.match(mesh.vertices[mine], mesh.vertex_normals[mine], reach, MIN_COSINE)
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
        weights = EVIDENCE / config.scan_sd**2 * share * energy.geman_mcclure(distance, max(reach / 2, 0.015))
        if self.cloud.person is not None:
            under = np.einsum("nd,nd->n", normal, mesh.vertices[ids] - target) < 0
            weights = np.where(under, UNDER_CLOTHES, 1.0) * weights
        if self.clothing is None:
            return ids, target, normal, weights
        under, over, away = self.clothing.below(mesh.vertices[mine], mesh.vertex_normals[mine])
        loose = np.full(under.sum(), EVIDENCE / config.clothing_sd**2 / len(mine))
        return (np.concatenate([ids, mine[under]]), np.concatenate([target, over[under]]),
                np.concatenate([normal, away[under]]), np.concatenate([weights, loose]))

    def violations(self, mesh: Mesh) -> tuple[np.ndarray, ...]:
        """Vertices that are where nothing can be, points and normals of the planes they should reach, weights.

        A camera would have seen them, they stick out of clothing, or another part of the body is there.
        """
        share = EVIDENCE / self.config.scan_sd**2
        ids, targets, normals, weights = [], [], [], []
        for weight, mine, found in self.objections(mesh):
            out = found.excess > 0
            ids.append(mine[out])
            targets.append(found.target[out])
            normals.append(found.normal[out])
            weights.append(weight * share / len(mine) * energy.geman_mcclure(found.excess[out], 0.1))
        return tuple(np.concatenate(part) for part in (ids, targets, normals, weights))

    def objections(self, mesh: Mesh) -> list[tuple[float, np.ndarray, Violation]]:
        """What says that vertices cannot be where they are: its weight, and the vertices."""
        config, places, normals = self.config, mesh.vertices, mesh.vertex_normals
        mine = self.matched
        found = [(config.contact_weight, self.spread, self.contact.violation(places[self.spread],
                                                                             normals[self.spread]))]
        if self.cameras:
            found.append((config.free_space_weight, mine, free_space_violation(self.cameras, places[mine])))
        if self.clothing is not None:
            found.append((1.0, mine, self.clothing.violation(places[mine], normals[mine])))
        return found


@dataclass(frozen=True, eq=False)
class Solved:
    """Unknowns (P,) at the end of the rounds, whether they settled, the rounds, and each term of the energy."""

    x: np.ndarray
    converged: bool
    rounds: int
    energies: dict[str, float]


def solve_jointly(fit: ScanFit, x: np.ndarray, tell: Callable[[int], None]) -> Solved:
    """All unknowns at once from x (P,) on, in rounds of matching with shrinking reach.

    A model of many scans follows a scan closely, and matches that are farther off than it ever is are wrong. One of
    few scans does not, and drops the limbs that it follows badly. So the rounds settle at a wide reach first, then at
    a narrow one, and the former is kept where it explains clearly more.

    [SCAPE] Eq. 10
    """
    rounds = fit.config.rounds
    wide = _in_rounds(fit, x, np.geomspace(REACH, WIDE_REACH, rounds), lambda i: tell(min(i, rounds)))
    narrow = _in_rounds(fit, wide.x, np.geomspace(WIDE_REACH, FINAL_REACH, NARROWING), lambda i: None)
    best = wide if fit.misfit(wide.x) < CLEARLY * fit.misfit(narrow.x) else narrow
    return replace(best, rounds=wide.rounds + narrow.rounds)


def _in_rounds(fit: ScanFit, x: np.ndarray, reaches: np.ndarray, tell: Callable[[int], None]) -> Solved:
    """Unknowns from x (P,) on when matches reach so far, metres, round by round, and the last until they settle."""
    shift, place = np.inf, fit.mesh(x).vertices
    energies: dict[str, float] = {}
    for i, reach in enumerate([*reaches, *reaches[-1:].repeat(SETTLING)]):
        x, energies = fit.step(x, fit.thin, reach)
        before, place = place, fit.mesh(x).vertices
        shift = float(np.sqrt(((place - before)**2).sum(axis=1).mean()))
        tell(i + 1)
        if i >= len(reaches) and shift < SETTLED:
            break
    return Solved(x, bool(shift < 2 * SETTLED), i + 1, energies)
