"""Completion of a partial scan: a start from landmarks, the pose and shape, then the free surface."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import csr_array

from model.linear import Subject
from model.scape import ScapeModel
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints, Surface

from . import energy
from .bodies import FixedBody, as_body
from .priors import GaussianPrior, gaussian_prior, typical_poses
from .scan import ScanPoints, prepare_scan, spread
from .solve import FreeSurface, MinimiseConfig, minimise

Progress = Callable[[int, int], None]


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
    viewpoint : (3,) floats, metres, optional
        Where a bare point cloud was seen from, to turn its normals; found by itself when not given.
    """

    surface_weight: float = 1.0
    twist_weight: float = 1.0
    landmark_sd: float = 0.01
    scan_sd: float = 0.008
    evidence: float = 400.0
    prior_weight: float = 1.0
    prior_shrinkage: float = 0.3
    start_axes: int = 6
    candidates: int = 3
    reach: float = 0.2
    final_reach: float = 0.03
    rounds: int = 12
    min_cosine: float = 0.6
    scan_points: int = 2500
    model_points: int = 1200
    surface_reach: float = 0.03
    surface_rounds: int = 4
    viewpoint: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Completion:
    """A whole body from a partial scan.

    Attributes
    ----------
    completed : Mesh
        Follows the scan where there are data, the model elsewhere; it may leave the model's space.
    predicted : Mesh
        The model's own mesh.
    pose : (J, 3) float, radians
    betas : (K,) float, or None for the template's own body
    trans : (3,) float, metres
    seen : (N,) bool
        Vertices that had data.
    rms : float, metres
        Distance of the scan points that were used to the completed mesh.
    explained : float
        Share of the scan points that were used.
    landmark_rms : float, metres
        Distance of the landmarks to their vertices on the predicted mesh.
    converged : bool
    iterations : int
        Rounds of matching.
    energies : dict
        Each term of the energy at the end.
    """

    completed: Mesh
    predicted: Mesh
    pose: np.ndarray
    betas: np.ndarray | None
    trans: np.ndarray
    seen: np.ndarray
    rms: float
    explained: float
    landmark_rms: float
    converged: bool
    iterations: int
    energies: dict[str, float] = field(default_factory=dict)


def complete(body: ScapeModel | Subject, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray],
             config: CompletionConfig = CompletionConfig(), progress: Progress | None = None) -> Completion:
    """The whole body from a scan of some of it.

    Parameters
    ----------
    body : ScapeModel or Subject
        A model when the person's shape is unknown, a subject when it is known.
    scan : Mesh, or (n, 3) float, metres
    landmarks : ((L,) int, (L, 3) float)
        Vertices of the template and where they are on the scan; 4 to 10, at least 3.
    progress : callable, optional
        Called with (done, total).

    Raises
    ------
    ValueError
        Fewer than 3 landmarks, landmarks or a scan that cannot be used.

    [SCAPE] Eq. 10
    """
    marked = check_landmarks(landmarks, len(body.template.vertices))
    cloud = prepare_scan(scan, None if config.viewpoint is None else np.array(config.viewpoint))
    posed = as_body(body)
    task = _Task(posed, cloud, *marked, config)
    total = config.rounds + 3
    tell = progress or (lambda done, total: None)
    starts = task.from_landmarks()
    tell(1, total)
    x = task.best_start(starts)
    tell(2, total)
    x, converged, rounds, energies = task.follow_scan(x, lambda done: tell(2 + done, total))
    predicted = posed.template.with_vertices(posed.vertices(x))
    completed, seen, used, rms = free_surface(predicted, cloud, config)
    tell(total, total)
    pose, trans, betas = posed.split(x)
    shape = body.betas if isinstance(body, Subject) else betas if posed.n_betas else None
    off = predicted.vertices[marked[0]] - marked[1]
    return Completion(completed, predicted, pose, shape, trans, seen, rms, float(used.mean()),
                      float(np.sqrt((off**2).sum(axis=1).mean())), converged, rounds, energies)


def check_landmarks(landmarks: tuple[np.ndarray, np.ndarray], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Landmark vertices (L,) and points (L, 3) as arrays.

    Raises
    ------
    ValueError
        Fewer than 3, lists of different length, vertices that do not exist, points that are not finite.
    """
    vertices, points = (np.asarray(part) for part in landmarks)
    if vertices.ndim != 1 or points.shape != (len(vertices), 3):
        raise ValueError(f"landmarks: expected (L,) vertices and (L, 3) points, got {vertices.shape} "
                         f"and {points.shape}")
    if len(vertices) < 3:
        raise ValueError(f"landmarks: expected at least 3, got {len(vertices)}")
    if not np.issubdtype(vertices.dtype, np.integer) or len(np.unique(vertices)) < len(vertices):
        raise ValueError("landmarks: expected different vertex numbers")
    if vertices.min() < 0 or vertices.max() >= count:
        raise ValueError(f"landmarks: expected vertices of 0..{count - 1}, "
                         f"got {vertices.min()}..{vertices.max()}")
    if not np.isfinite(points).all():
        raise ValueError("landmarks: expected finite points")
    return vertices.astype(np.int64), points.astype(np.float64)


class _Task:
    """One scan and one body, with what stays the same between the stages."""

    def __init__(self, body: FixedBody, cloud: ScanPoints, vertices: np.ndarray, points: np.ndarray,
                 config: CompletionConfig) -> None:
        self.body, self.config = body, config
        self.vertices, self.points = vertices, points
        self.prior: GaussianPrior = gaussian_prior(body.pose_mean, body.pose_covariance, config.prior_shrinkage)
        self.thin = cloud.thinned(config.scan_points)
        self.coarse = cloud.thinned(config.scan_points // 4)
        self.tree = OrientedPoints(cloud.points, cloud.normals)
        self.cloud = cloud
        self.spread = spread(body.template.vertices, config.model_points)

    def landmark_terms(self, x: np.ndarray, follow: Callable, prior_weight: float) -> list[energy.Residual]:
        """Landmarks and priors, the energies of every stage."""
        weights = np.full(len(self.vertices), self.config.landmark_sd**-2)
        return [energy.point_to_point(follow(x), self.points, weights),
                energy.pose_prior(x, self.prior, prior_weight),
                energy.shape_prior(x, self.body.n_angles + 3)]

    def from_landmarks(self) -> np.ndarray:
        """The likeliest bodies (n, P) that meet the landmarks, distinct and best first."""
        body, config = self.body, self.config
        poses = typical_poses(body.pose_mean, body.pose_covariance, config.start_axes)
        x = self._turned_to_landmarks(poses)
        follow = body.follow(self.vertices, x[0])
        still = np.zeros(x.shape[1])
        still[body.n_angles + 3:] = 1e6             # the shape waits until there is a pose
        for weight in (10.0, 3.0, 1.0):
            ends = minimise(lambda x, w=weight: [*self.landmark_terms(x, follow, w),
                                                 energy.stay_near(x, 0 * x, still)],
                            x, MinimiseConfig(iterations=8))
            x = ends.x
        kept: list[int] = []
        places = body.subject.points(self.spread).evaluate(*body.split(x)[:2])
        for i in np.argsort(ends.energy):
            if all(np.linalg.norm(places[i] - places[k], axis=1).mean() > 0.02 for k in kept):
                kept.append(int(i))
        return x[kept[:config.candidates]]

    def _turned_to_landmarks(self, poses: np.ndarray) -> np.ndarray:
        """Unknowns of poses (n, J, 3), each placed on the landmarks and turned about their long axis."""
        operator = self.body.subject.points(self.vertices)
        out = []
        centre = self.points.mean(axis=0)
        axis = np.linalg.svd(self.points - centre)[2][0]
        for pose in poses:
            for quarter in range(4):
                placed = pose.copy()
                R, _ = rotations.procrustes(operator.evaluate(pose), self.points)
                placed[0] = rotations.log(rotations.exp(quarter * np.pi / 2 * axis) @ R @ rotations.exp(pose[0]))
                trans = (self.points - operator.evaluate(placed)).mean(axis=0)
                out.append(self.body.join(placed, trans))
        return np.array(out)

    def best_start(self, starts: np.ndarray) -> np.ndarray:
        """The start (P,) that explains the scan best after a few rounds on few points."""
        ends = []
        for x in starts:
            for reach in (0.25, 0.2, 0.15, 0.12, 0.1):
                x = self.step(x, self.coarse, reach)[0]
            ends.append(x)
        return ends[int(np.argmin([self.misfit(x) for x in ends]))]

    def misfit(self, x: np.ndarray, cap: float = 0.05) -> float:
        """How badly a body explains scan and landmarks, for the choice between starts."""
        mesh = self.body.template.with_vertices(self.body.vertices(x))
        found = OrientedPoints(mesh.vertices, mesh.vertex_normals).match(self.thin.points, self.thin.normals, cap,
                                                                         self.config.min_cosine)
        scan = np.minimum(found.distances, cap)**2 / self.config.scan_sd**2
        off = ((mesh.vertices[self.vertices] - self.points)**2).sum() / self.config.landmark_sd**2
        prior = energy.pose_prior(x, self.prior, self.config.prior_weight).energy
        return float(self.config.evidence * scan.mean() + off + prior)

    def follow_scan(self, x: np.ndarray, tell: Callable[[int], None]
                    ) -> tuple[np.ndarray, bool, int, dict[str, float]]:
        """Unknowns after rounds of matching with shrinking reach, whether they settled, rounds, energies."""
        config = self.config
        shift = np.inf
        energies: dict[str, float] = {}
        reaches = np.geomspace(config.reach, config.final_reach, config.rounds)
        for i, reach in enumerate([*reaches, *[config.final_reach] * 5]):
            before = x
            x, energies = self.step(x, self.thin, reach)
            shift = np.abs(x[:-3] - before[:-3]).max()
            tell(min(i + 1, config.rounds))
            if i >= config.rounds and shift < 2e-3:
                break
        return x, bool(shift < 1e-2), i + 1, energies

    def step(self, x: np.ndarray, scan: ScanPoints, reach: float) -> tuple[np.ndarray, dict[str, float]]:
        """One matching and the best unknowns (P,) for it, and the energies there."""
        body, config = self.body, self.config
        ids, target, normal, weights = self.matches(x, scan, reach)
        follow = body.follow(np.concatenate([self.vertices, ids]), x)
        count = len(self.vertices)
        held = np.full(len(x), config.twist_weight)
        held[:3] = held[body.n_angles:] = 0

        def energies(at: np.ndarray) -> list[energy.Residual]:
            points = follow(at)
            marked = energy.MovingPoints(points.positions[:, :count], points.jacobian[:, :count])
            free = energy.MovingPoints(points.positions[:, count:], points.jacobian[:, count:])
            return [*self.landmark_terms(at, lambda _: marked, config.prior_weight),
                    energy.point_to_plane(free, target, normal, weights),
                    energy.point_to_point(free, target, 0.1 * weights),
                    energy.stay_near(at, x, held)]

        end = minimise(energies, x[None], MinimiseConfig(iterations=4, tolerance=1e-3))
        names = ("landmarks", "pose_prior", "shape_prior", "scan_planes", "scan_points", "twists")
        return end.x[0], {n: float(r.energy[0]) for n, r in zip(names, energies(end.x), strict=True)}

    def matches(self, x: np.ndarray, scan: ScanPoints, reach: float) -> tuple[np.ndarray, ...]:
        """Vertices, scan points, their normals and weights, by closest points both ways."""
        config = self.config
        mesh = self.body.template.with_vertices(self.body.vertices(x))
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
        weights = config.evidence / config.scan_sd**2 * share * geman_mcclure(distance, max(reach / 2, 0.015))
        return ids, target, normal, weights


def geman_mcclure(distance: np.ndarray, scale: float) -> np.ndarray:
    """Weight in (0, 1] of residuals that may be outliers, half a quarter of it at `scale`."""
    return (scale**2 / (scale**2 + distance**2))**2


def free_surface(predicted: Mesh, cloud: ScanPoints, config: CompletionConfig
                 ) -> tuple[Mesh, np.ndarray, np.ndarray, float]:
    """The completed mesh, its seen vertices (N,), the scan points used (n,) and their RMS distance to it.

    [SCAPE] Eq. 10
    """
    solver = FreeSurface(predicted)
    mesh = predicted
    for _ in range(config.surface_rounds):
        found = Surface(mesh).closest(cloud.points)
        agree = np.einsum("nd,nd->n", mesh.face_normals[found.faces], cloud.normals) > config.min_cosine
        used = agree & (found.distances < config.surface_reach)
        weights = _rows(predicted, found.faces[used], found.bary[used])
        mesh = predicted.with_vertices(solver.solve(predicted.vertices, weights, cloud.points[used],
                                                    np.full(used.sum(), config.surface_weight)))
    seen = np.zeros(len(predicted.vertices), dtype=bool)
    seen[predicted.faces[found.faces[used]]] = True
    distance = Surface(mesh).closest(cloud.points[used]).distances if used.any() else np.array([np.nan])
    return mesh, seen, used, float(np.sqrt((distance**2).mean()))


def _rows(mesh: Mesh, faces: np.ndarray, bary: np.ndarray) -> csr_array:
    """(L, N) sparse weights of points on triangles."""
    rows = np.repeat(np.arange(len(faces)), 3)
    return csr_array((bary.ravel(), (rows, mesh.faces[faces].ravel())), shape=(len(faces), len(mesh.vertices)))
