"""The fit of a body to a scan: matches with robust weights, one Gauss-Newton step, and the misfit of a body."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np

from scanprep.geometry.least_squares import Deferred, Residual, levenberg_marquardt, normal_equations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints
from scanprep.skeleton.tree import Skeleton

from ..priors import GaussianPrior, gaussian_prior
from . import energy
from .bodies import FixedBody, ResizedBody
from .free_space import Clothing, Contact, Outside, Violation, find_cameras, free_space_violation
from .pull import MatchTargets
from .scan import ScanPoints, prepare_scan, spread_points
from .settings import ScanFitConfig
from .upright import TILT, Upright

Terms = dict[str, Residual]

REACH, FINAL_REACH = 0.2, 0.03       # metres: largest match distance in the first and the last round
MIN_COSINE = 0.6                     # smallest cosine between the normals of a match
# A whole scan counts as so many independent measurements. Errors of the model are alike at neighbouring points, so this
# is far below the number of points.
EVIDENCE = 400.0
CONTACT = 0.5                        # how much a vertex inside another part counts, against one that lies on the scan
STRANGE, ODD = np.radians(45), 0.05  # joints this far from every known pose are penalised; standard deviation, radians


@dataclass(frozen=True, eq=False)
class Skin:
    """Positions and normals (n, 3) of vertices of a body."""

    places: np.ndarray
    normals: np.ndarray

    @cached_property
    def tree(self) -> OrientedPoints:
        """Search tree for the vertex nearest to a point."""
        return OrientedPoints(self.places, self.normals)


class ScanData:
    """A scan with everything that is computed from it once for all bodies: search tree, cameras, clothing."""

    def __init__(self, cloud: ScanPoints, config: ScanFitConfig) -> None:
        self.cloud = cloud
        self.tree = OrientedPoints(cloud.points, cloud.normals)
        self.cameras = find_cameras(cloud) if config.free_space_weight > 0 else ()
        self.clothing = None if cloud.masked is None else Clothing(cloud.masked)
        self.thinned = lru_cache(maxsize=4)(cloud.thin)
        # clothing takes its share of the evidence of the scan with it
        covered = 0.0 if cloud.masked is None else float(cloud.masked.areas.sum())
        self.evidence = EVIDENCE * float(cloud.areas.sum()) / (float(cloud.areas.sum()) + covered)

    @cached_property
    def outside(self) -> Outside | None:
        """A table of the free space that the cameras saw; None without cameras."""
        return Outside(self.cameras) if self.cameras else None


@dataclass(frozen=True, eq=False)
class BodySample:
    """All or some vertices of a body, and which of these are matched; made by `sample_body`.

    Numbers are those within the sample.
    """

    body: FixedBody
    ids: np.ndarray                  # (n,) numbers of the vertices on the template
    spread: np.ndarray               # vertices spread evenly over the body
    matched: np.ndarray              # those of `spread` that are not on ignored parts
    ignored: np.ndarray              # (n,) bool, vertices of parts that are not to be matched
    part: np.ndarray                 # (n,) the part of each vertex
    contact: Contact
    gaps: float                      # metres between the vertices of a small sample; 0 for all vertices


def sample_body(body: FixedBody, ids: np.ndarray | None, count: int, ignored_parts: Sequence[str]) -> BodySample:
    """Sample a body at vertices `ids` (n,) of the template, or at all, of which about `count` are matched."""
    template, skeleton = body.template, body.skeleton
    gaps = 0.0 if ids is None else float(np.sqrt(template.face_areas.sum() / len(ids)))
    all_or_some = np.arange(len(template.vertices)) if ids is None else ids
    chosen = spread_points(template.vertices[all_or_some], count)
    ignored = part_vertices(template, skeleton, ignored_parts)[all_or_some]
    part = skeleton.part_of_vertex(template)[all_or_some]
    at_rest = all_or_some[chosen]
    contact = Contact(skeleton, part[chosen], template.vertices[at_rest], template.vertex_normals[at_rest])
    return BodySample(body if ids is None else body.some(ids), all_or_some, chosen, chosen[~ignored[chosen]], ignored,
                      part, contact, gaps)


@dataclass(frozen=True, eq=False)
class ScanFit:
    """One scan and one body, ready to be fitted; made by `scan_fit`.

    Attributes
    ----------
    sample : BodySample
    data : ScanData
    template_vertices : (L,) int
        The landmarks' vertices, by their numbers on the template.
    points : (L, 3) float, metres
        Where the landmarks are on the scan.
    scan_points : int
        Points of the scan that are matched.
    rng : numpy.random.Generator
    """

    sample: BodySample
    data: ScanData
    template_vertices: np.ndarray
    points: np.ndarray
    prior: GaussianPrior
    upright: Upright | None
    scan_points: int
    config: ScanFitConfig
    rng: np.random.Generator
    _last: list[tuple[np.ndarray, Skin]] = field(default_factory=list, init=False)      # the skin asked for last

    @property
    def body(self) -> FixedBody:
        return self.sample.body

    @property
    def ids(self) -> np.ndarray:
        """(n,) numbers of the vertices on the template."""
        return self.sample.ids

    @property
    def part(self) -> np.ndarray:
        """(n,) the part of each vertex."""
        return self.sample.part

    @property
    def cloud(self) -> ScanPoints:
        return self.data.cloud

    @cached_property
    def vertices(self) -> np.ndarray:
        """(L,) the landmarks' vertices, by their numbers in the sample."""
        return np.searchsorted(self.sample.ids, self.template_vertices)

    @property
    def thin(self) -> ScanPoints:
        """The points of the scan that are matched, spread evenly."""
        return self.data.thinned(self.scan_points)

    @property
    def coarse(self) -> ScanPoints:
        """Few points of the scan, for the first rounds of a search."""
        return self.data.thinned(self.config.scan_points // 4)

    def on(self, cloud: ScanPoints) -> ScanFit:
        """Return the same body with another scan, without landmarks."""
        return replace(self, data=ScanData(cloud, self.config), template_vertices=np.zeros(0, dtype=np.int64),
                       points=np.zeros((0, 3)))

    def fix_shape(self, x: np.ndarray) -> ScanFit:
        """Return the same scan with a body of known shape, that of unknowns (P,)."""
        return replace(self, sample=replace(self.sample, body=self.body.fix_shape(x)))

    def some(self, ids: np.ndarray, matched: int) -> ScanFit:
        """Return the same fit with some vertices of the body, of which `matched` are matched.

        Their normals rotate with their parts.
        """
        ids = np.union1d(ids, self.template_vertices)
        return replace(self, sample=sample_body(self.body, ids, matched, self.config.ignored_parts))

    def few(self) -> ScanFit:
        """Return the same fit with few vertices and scan points, for a search."""
        template, skeleton = self.body.template, self.body.skeleton
        rings = [skeleton.ring(template, j) for j in range(1, len(skeleton.parents))]
        # a search takes 3,000 vertices and the rings around the joints
        some = self.some(np.concatenate([spread_points(template.vertices, 3000), *rings]),
                         self.config.model_points // 2)
        return replace(some, scan_points=self.config.scan_points // 2)

    def mesh(self, x: np.ndarray) -> Mesh:
        """Compute the predicted mesh of unknowns (P,)."""
        return self.body.template.with_vertices(self.body.vertices(x))

    def skin(self, x: np.ndarray) -> Skin:
        """Compute vertices and normals at unknowns (P,); the last ones are kept."""
        if not self._last or not np.array_equal(x, self._last[0][0]):
            places = self.body.vertices(x)
            if len(places) == len(self.body.template.vertices):
                normals = self.body.template.with_vertices(places).vertex_normals
            else:
                normals = self._rotate_normals(np.arange(len(places)), self.body.split(x)[0])
            self._last[:] = [(x.copy(), Skin(places, normals))]
        return self._last[0][1]

    def find_unexplained(self, x: np.ndarray, scan: ScanPoints) -> np.ndarray:
        """Find the points of a scan with no part of the body within 5 cm, (n,) bool."""
        return ~self.skin(x).tree.match(scan.points, scan.normals, 0.05, MIN_COSINE).valid

    def beyond(self, x: np.ndarray) -> np.ndarray:
        """Find the vertices beyond the border of the depth picture, (N,) bool; none without a picture."""
        person = self.cloud.person
        return np.zeros(len(self.part), dtype=bool) if person is None else \
            ~person.picture.project(self.body.vertices(x))[2]

    def without_ignored(self, cloud: ScanPoints, predicted: Mesh) -> ScanPoints:
        """Remove scan points on parts of the body that are not to be matched."""
        if not self.sample.ignored.any():
            return cloud
        found = OrientedPoints(predicted.vertices, predicted.vertex_normals).match(cloud.points, cloud.normals)
        return cloud.some(~(self.sample.ignored[found.index] & found.valid))

    def misfit(self, x: np.ndarray, cap: float = 0.05) -> float:
        """Compute how badly a body explains scan and landmarks, to choose between starts."""
        # capped squared distances of scan points; between the vertices of a small sample the skin is nearer by `gaps`
        config, skin = self.config, self.skin(x)
        found = skin.tree.match(self.thin.points, self.thin.normals, cap, MIN_COSINE)
        off = self.thin.points - skin.places[found.index]
        along = np.einsum("nd,nd->n", off, skin.normals[found.index])
        beside = np.sqrt(np.maximum((off**2).sum(axis=1) - along**2, 0))
        squared = np.where(found.valid, along**2 + np.maximum(beside - self.sample.gaps, 0)**2, cap**2)
        apart = (np.minimum(squared, cap**2) * ~(found.valid & self.sample.ignored[found.index])).mean()
        # violations of space, landmarks, the prior, and unknown joint rotations
        for weight, ids, violation in self.free_space_violations(skin):
            apart += weight * (np.minimum(violation.excess, cap)**2).sum() / len(ids)
        marked = ((skin.places[self.vertices] - self.points)**2).sum() / config.landmark_sd**2
        return float(EVIDENCE * apart / config.scan_sd**2 + marked) + self.unlikely(x) + float(self.strange(x).sum())

    def strange(self, x: np.ndarray) -> np.ndarray:
        """Compute the energy (J,) of joint rotations far from all known poses; used to choose, not to step."""
        beyond = self.body.joints_from_known(self.body.split(x)[0]) - STRANGE
        return (np.maximum(beyond, 0) / ODD)**2

    def pose_points(self, ids: np.ndarray, poses: np.ndarray, trans: np.ndarray | None = None
                    ) -> tuple[np.ndarray, np.ndarray]:
        """Pose some vertices (B, L, 3) by poses (B, J, 3), with normals that rotate with their parts."""
        return self.body.subject.points(ids).evaluate(poses, trans), self._rotate_normals(ids, poses)

    def _rotate_normals(self, ids: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Rotate the template's normals of some vertices with their parts: (..., L, 3) for poses (..., J, 3)."""
        R = self.body.skeleton.part_rotations(poses)[..., self.part[ids], :, :]
        return (R @ self.body.template.vertex_normals[self.ids[ids], :, None])[..., 0]

    def unlikely(self, x: np.ndarray) -> float:
        """Compute the prior energy of the pose of unknowns (P,)."""
        return float(sum(term.energy[0] for term in self.prior_terms(x[None]).values()))

    def prior_terms(self, x: np.ndarray) -> Terms:
        """Compute the prior terms of poses (B, P): the Gaussian, and that people stand."""
        stands = {} if self.upright is None else {"upright": energy.upright_term(x, self.upright.of_body,
                                                                                 self.upright.nearest(x), TILT)}
        return {"pose_prior": energy.pose_prior_term(x, self.prior, self.config.prior_weight), **stands}

    def step(self, x: np.ndarray, scan: ScanPoints, reach: float, steps: int = 1) -> tuple[np.ndarray, Matched]:
        """Take a Gauss-Newton step for one matching; return the unknowns (P,) and the matching."""
        # w_T damps the joint angles; root, place and betas are free
        held = np.full(len(x), self.config.twist_weight)
        held[:3] = held[self.body.n_angles:] = 0
        matched, betas = self.match_at(x, scan, reach), self.body.n_angles + 3
        # matches beyond 4 cm are often wrong, and shape would give way before the pose: betas are held more
        stiff = max(1.0, reach / 0.04)

        def equations(at: np.ndarray) -> Deferred:
            return matched.equations(at, energy.shape_prior(at, betas, stiff), energy.stay_near(at, x, held))

        # the first damping, and a stronger one where that step lowers nothing
        for damping in 1e-3, 1e-1:
            ahead = levenberg_marquardt(equations, x[None], steps, 1e-3, damping).x[0]   # [SCAPE] Eq. 11
            if not np.array_equal(ahead, x):
                break
        return ahead, matched

    def precision(self, x: np.ndarray) -> np.ndarray:
        """Compute the Gauss-Newton matrix (P, P) of scan, landmarks and priors: the precision of unknowns (P,)."""
        shape = energy.shape_prior(x[None], self.body.n_angles + 3)
        return self.match_at(x, self.thin, FINAL_REACH).equations(x[None], shape).dense.hessian[0]

    def match_at(self, x: np.ndarray, scan: ScanPoints, reach: float) -> Matched:
        """Collect the data term near unknowns x (P,): landmarks, matches, and violations of space."""
        skin, free = self.skin(x), np.full(len(self.vertices), self.config.landmark_sd**-2)
        ids, target, normal, weights = self.matches(skin, scan, reach)
        out_ids, out_target, out_normal, out_weights = self.violations(skin)
        points, at = self.body.gather(np.concatenate([self.vertices, ids, out_ids]), x)
        # landmarks draw to points, matches mostly to planes (a tenth to points), violations to planes
        pull = MatchTargets(points, at, np.concatenate([self.points, target, out_target]),
                            np.concatenate([np.zeros_like(self.points), normal, out_normal]),
                            np.concatenate([free, 0.1 * weights, 0 * out_weights]),
                            np.concatenate([0 * free, weights, out_weights]))
        return Matched(pull, len(free), len(ids), self.prior_terms)

    def matches(self, skin: Skin, scan: ScanPoints, reach: float) -> tuple[np.ndarray, ...]:
        """Match by closest points both ways: vertices, scan points, their normals, and weights."""
        # from the scan to the body, and from the body to the scan; the latter not across the border of the scan
        config, vertices = self.config, self.sample.matched
        there = skin.tree.match(scan.points, scan.normals, reach, MIN_COSINE)
        back = self.data.tree.match(skin.places[vertices], skin.normals[vertices], reach, MIN_COSINE)
        hit = back.index
        off = skin.places[vertices] - self.cloud.points[hit]
        along = np.einsum("nd,nd->n", off, self.cloud.normals[hit])
        beside = np.sqrt(np.maximum((off**2).sum(axis=1) - along**2, 0))
        inner = back.valid & ~self.cloud.border[hit] & (beside < 2 * self.cloud.spacing + 0.3 * np.abs(along))
        # matches of both directions, weighted by their share and by Geman-McClure
        a, b = there.valid & ~self.sample.ignored[there.index], inner
        ids = np.concatenate([there.index[a], vertices[b]])
        target = np.concatenate([scan.points[a], self.cloud.points[hit[b]]])
        normal = np.concatenate([scan.normals[a], self.cloud.normals[hit[b]]])
        distance = np.concatenate([there.distances[a], back.distances[b]])
        share = np.concatenate([np.full(a.sum(), 1 / len(scan.points)), np.full(b.sum(), 0.5 / len(vertices))])
        weights = self.data.evidence / config.scan_sd**2 * share * energy.geman_mcclure(distance, max(reach / 2, 0.015))
        if self.cloud.person is not None:
            under = np.einsum("nd,nd->n", normal, skin.places[ids] - target) < 0
            # a depth camera sees clothes: skin below what it saw is likely, skin above it is not
            weights = np.where(under, 0.1, 1.0) * weights
        return ids, target, normal, weights

    def violations(self, skin: Skin) -> tuple[np.ndarray, ...]:
        """List vertices that violate space, with points and normals of the planes they should reach, and weights.

        A camera would have seen them, they stick out of clothing, or they are inside another part of the body.
        """
        share = EVIDENCE / self.config.scan_sd**2
        ids, targets, normals, weights = [], [], [], []
        for weight, mine, found in self.free_space_violations(skin):
            out = found.excess > 0
            ids.append(mine[out])
            targets.append(found.target[out])
            normals.append(found.normal[out])
            weights.append(weight * share / len(mine) * energy.geman_mcclure(found.excess[out], 0.1))
        return tuple(np.concatenate(part) for part in (ids, targets, normals, weights))

    def free_space_violations(self, skin: Skin) -> list[tuple[float, np.ndarray, Violation]]:
        """List the violations of space, each with its weight and its vertices."""
        config, places, normals = self.config, skin.places, skin.normals
        mine = self.sample.matched
        spread = self.sample.spread
        out = [(CONTACT, spread, self.sample.contact.violation(places[spread], normals[spread]))]
        if self.data.cameras:
            out.append((config.free_space_weight, mine, free_space_violation(self.data.cameras, places[mine])))
        if self.data.clothing is not None:
            out.append((1.0, mine, self.data.clothing.violation(places[mine], normals[mine])))
        return out


def scan_fit(body: FixedBody, cloud: ScanPoints, vertices: np.ndarray, points: np.ndarray, config: ScanFitConfig
             ) -> ScanFit:
    """Prepare the fit of a body to a scan.

    `vertices` (L,) int and `points` (L, 3), metres, are landmarks on the template and on the scan, none or more.
    """
    sample = sample_body(body, None, config.model_points, config.ignored_parts)
    prior = gaussian_prior(body.pose_mean, body.pose_covariance)
    upright = Upright.of(body.template, body.skeleton, config.up, cloud.person is not None)
    return ScanFit(sample, ScanData(cloud, config), vertices, points, prior, upright, config.scan_points, config,
                   np.random.default_rng(0))


def resize_to_person(body: FixedBody) -> tuple[FixedBody, float]:
    """Scale a hand or a horse to the size of a person, which the lengths of the search suit; also return the factor."""
    size = float(np.sqrt(body.template.face_areas.sum()))
    person = 1.36  # metres: root of the surface area of a person; bodies from half to twice that size are not scaled
    factor = 1.0 if 0.5 < size / person < 2 else person / size
    return body if factor == 1 else ResizedBody(body, factor), factor


def prepare_scan_fit(body: FixedBody, scan: Mesh | np.ndarray, vertices: np.ndarray, points: np.ndarray,
                     config: ScanFitConfig, masked: np.ndarray | None = None) -> tuple[ScanFit, float]:
    """Prepare the fit of a body of any size to a scan; also return the factor by which both were scaled.

    The lengths of the search suit a person, so a hand or a horse is scaled to that size. `vertices` (L,) int and
    `points` (L, 3), metres, are landmarks, none or more; `masked` (n,) bool points of hair and clothes.
    """
    sized, factor = resize_to_person(body)
    return scan_fit(sized, prepare_scan(scan, masked=masked, metres=factor), vertices, factor * points, config), factor


@dataclass(frozen=True, eq=False)
class Matched:
    """The data term near some unknowns: landmarks first, then matches of the scan, then violations of space.

    `landmarks` and `free` are the numbers of landmarks and of matches. `known` computes the prior terms of unknowns
    (B, P).
    """

    pull: MatchTargets
    landmarks: int
    free: int
    known: Callable[[np.ndarray], Terms]

    def equations(self, x: np.ndarray, *more: Residual) -> Deferred:
        """Build the normal equations at unknowns (1, P), with priors and further residuals."""
        return self.pull.equations(x, normal_equations([*self.known(x).values(), *more]))

    def energies(self, x: np.ndarray) -> dict[str, float]:
        """Compute the energy of each term at unknowns (P,)."""
        to_point, to_plane = self.pull.energies(x)
        end = self.landmarks + self.free
        return {"landmarks": float(to_point[:self.landmarks].sum()),
                "scan_planes": float(to_plane[self.landmarks:end].sum()),
                "scan_points": float(to_point[self.landmarks:end].sum()), "violations": float(to_plane[end:].sum()),
                **{name: float(term.energy[0]) for name, term in self.known(x[None]).items()}}


def part_vertices(template: Mesh, skeleton: Skeleton, names: Sequence[str]) -> np.ndarray:
    """Find the vertices of named parts, (N,) bool."""
    unknown = [name for name in names if name not in skeleton.names]
    if unknown:
        raise ValueError(f"ignored_parts: expected names of {', '.join(skeleton.names)}; got {', '.join(unknown)}")
    if names and set(names) == set(skeleton.names):
        raise ValueError("ignored_parts: expected to leave some parts of the body to match, got all of them")
    numbers = [skeleton.names.index(name) for name in names]
    return np.isin(skeleton.part_of_vertex(template), numbers)
