"""The model brought to a scan by its pose, place and betas alone, from as many starts as it takes."""
from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial import cKDTree

from model.priors import typical_poses, whitening
from scanprep.correspondence.correspondences import checked_pairs
from scanprep.geometry import rotations
from scanprep.geometry.least_squares import Dense, levenberg_marquardt
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.target import Target, orient

from ..bilinear import PosedPoints, ShapedPoints
from ..body import BodyModel
from ..features import twists
from ..fitting.vertices import share_of_vertices, spread_vertices
from ..linear import PointOperator, Subject
from .attraction import Attraction, apart, attraction, towards
from .config import ModelFitConfig, PoseStage

STEPS = 2                            # of Levenberg-Marquardt between matchings
ALIKE = 0.005                        # share of √area: searches that end nearer to each other have found the same


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose, place and betas in one vector, and how badly scan and body explain each other, in metres."""

    x: np.ndarray
    score: float


class ModelFit:
    """One body and one scan: searches for the pose, place and betas.

    `landmarks` (L,) int and (L, 3), metres.
    """

    def __init__(self, body: BodyModel | Subject, target: Target, landmarks: tuple[np.ndarray, np.ndarray] | None,
                 config: ModelFitConfig) -> None:
        template = body.template
        self.body, self.target, self.config = body, target, config
        self.size = float(np.sqrt(template.face_areas.sum()))
        given: tuple[np.ndarray, np.ndarray] = landmarks or (np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
        self.marks, self.marked = checked_pairs(template, *given, "landmarks", 0)
        if body.pose_mean is None or body.pose_covariance is None:
            raise ValueError("body: expected one with a mean and covariance of the pose, got a subject without")
        self.pose_mean, self.covariance = body.pose_mean, body.pose_covariance
        self.whitening = whitening(self.covariance)
        self.part = body.skeleton.part_of_vertex(template)
        self.points = lru_cache(maxsize=4)(self._points)
        self.thinned = lru_cache(maxsize=4)(lambda detail: target.thinned(detail * self.size))
        self._tree = cKDTree(target.thinned(0.01 * self.size).points)

    def _points(self, sample: int) -> tuple[PosedPoints, np.ndarray, np.ndarray]:
        """Spread vertices with the landmarks behind them; the former's numbers (L,) and shares (L,) of all."""
        ids = spread_vertices(self.body.template.vertices, sample)
        share = share_of_vertices(self.body.template.vertices, ids) / len(self.body.template.vertices)
        return PosedPoints(self._vertices(np.r_[ids, self.marks])), ids, share

    def _vertices(self, ids: np.ndarray) -> PointOperator | ShapedPoints:
        """Vertices (L,) of a model, whose first betas are unknown, or of a subject, whose shape is known."""
        if isinstance(self.body, Subject):
            return self.body.points(ids)
        K = min(self.config.n_betas, self.body.n_betas)
        shaped = self.body.points(ids, n_betas=K)
        return shaped if K else shaped.operator(None)

    def refine(self, x: np.ndarray, points: PosedPoints, wanted: Attraction, prior: float, steps: int) -> np.ndarray:
        """Least squares over x of what is wanted of the points, the pose prior and that of the betas."""
        J3, W = points.J3, prior * self.size * self.whitening
        mean, b = self.pose_mean.ravel(), self.config.shape_prior * self.size
        by_prior = block_diag(W.T, np.zeros((3, 0)), b * np.eye(len(x) - J3 - 3))

        def priors(x: np.ndarray) -> np.ndarray:
            return np.r_[W @ (x[:J3] - mean), b * x[J3 + 3:]]

        def equations(at: np.ndarray) -> Dense:
            y, columns = points.columns(at[0])
            by_data = np.einsum("lij,plj->pli", wanted.root, columns, optimize=True).reshape(len(x), -1)
            r, A = np.r_[wanted.residual(y), priors(at[0])], np.concatenate([by_data, by_prior], axis=1)
            return Dense(np.array([r @ r]), (A @ r)[None], (A @ A.T)[None])

        out = levenberg_marquardt(equations, x[None], steps, 1e-5).x[0]
        out[:J3] = twists(out[:J3].reshape(-1, 3)).ravel()
        return out

    def follow(self, x: np.ndarray, stage: PoseStage) -> np.ndarray:
        """One stage: match, refine, and again."""
        points, ids, share = self.points(stage.sample)
        scale = self.config.normal_weight * self.size
        L = len(share)
        marks = towards(self.marked, np.full(len(self.marks), stage.landmarks))
        for _ in range(stage.rounds):
            y, n = points.positions(x)[:L], self.normals(x, ids)
            target = self.thinned(stage.detail)
            if not target.oriented:
                target = orient(target, self.predicted(x), scale)
            wanted = attraction(y, n, share, target, stage.reach * self.size, stage.slide, scale)
            x = self.refine(x, points, wanted.joined(marks), stage.prior, STEPS)
        return x

    def normals(self, x: np.ndarray, ids: np.ndarray) -> np.ndarray:
        """Normals (L, 3) of some vertices, which rotate with their parts."""
        R = self.body.skeleton.part_rotations(self.split(x)[0])[self.part[ids]]
        return np.einsum("lij,lj->li", R, self.body.template.vertex_normals[ids])

    def scored(self, x: np.ndarray, stage: PoseStage) -> Candidate:
        """How far scan and body are apart, both ways and at most the stage's reach, as a root mean square."""
        points, _, share = self.points(stage.sample)
        mesh, limit = self.predicted(x), stage.reach * self.size
        back = apart(mesh, self.oriented(mesh, stage.detail), limit)
        y = points.positions(x)
        forward = np.minimum(self._tree.query(y[:len(share)])[0], limit)
        off = np.minimum(np.linalg.norm(y[len(share):] - self.marked, axis=1), limit)
        bent = self.whitening @ (x[:points.J3] - self.pose_mean.ravel())
        energy = (back**2).mean() + share @ forward**2 + stage.landmarks * off @ off \
            + (stage.prior * self.size)**2 * float(bent @ bent)
        return Candidate(x, float(np.sqrt(energy)))

    def oriented(self, mesh: Mesh, detail: float) -> Target:
        """The scan, thinned, with normals that point outward."""
        return orient(self.thinned(detail), mesh, self.config.normal_weight * self.size)

    def best_of(self, starts: Iterable[np.ndarray]) -> tuple[Candidate, int]:
        """The best end of starts (one at least), tried until one explains enough or some agree; and how many."""
        config, tried, enough, which = self.config, 0, False, 0
        best: Candidate | None = None
        ends: list[np.ndarray] = []
        met: list[int] = []
        points, _, _ = self.points(config.refine[-1].sample)
        for x in starts:
            tried += 1
            for stage in config.search:
                x = self.follow(x, stage)
            y = points.positions(x)
            alike = [k for k, end in enumerate(ends) if np.linalg.norm(y - end, axis=1).mean() < ALIKE * self.size]
            if alike:
                met[alike[0]] += 1
            else:
                for stage in config.refine:
                    x = self.follow(x, stage)
                found = self.scored(x, config.refine[-1])
                if best is None or found.score < best.score:
                    best, which = found, len(ends)
                ends.append(y)
                met.append(1)
                enough |= self.explained(self.predicted(x), config.refine[-1].detail, config.near) >= config.enough
            if (enough and tried >= config.least) or (met[which] >= config.agreed and tried > config.turns):
                break
        assert best is not None, "no start"
        return best, tried

    def explained(self, mesh: Mesh, detail: float, limit: float) -> float:
        """Share of the points of the scan, thinned to a detail, that lie nearer to the mesh than a share of √area."""
        return float((apart(mesh, self.oriented(mesh, detail), limit * self.size) < limit * self.size).mean())

    def taken_from(self, vertices: np.ndarray, weights: np.ndarray, x: np.ndarray, prior: float, steps: int = 10
                   ) -> np.ndarray:
        """Pose, place and betas from an alignment's vertices (N, 3), metres, weighted (N,), from x on."""
        stage = self.config.refine[-1]
        points, ids, share = self.points(stage.sample)
        wanted = towards(np.r_[vertices[ids], self.marked],
                         np.r_[share * weights[ids], np.full(len(self.marks), stage.landmarks)])
        return self.refine(x, points, wanted, prior, steps)

    def start_from(self, vertices: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Unknowns near an alignment that may be wrong here and there."""
        skeleton, template = self.body.skeleton, self.body.template
        pose = skeleton.pose_of(skeleton.fit_rotations(template, vertices))
        return self.taken_from(vertices, weights, self.placed(pose, vertices),
                               (self.config.search + self.config.refine)[0].prior)

    def placed(self, pose: np.ndarray, onto: np.ndarray) -> np.ndarray:
        """Unknowns of a pose (J, 3), mean betas, with the body's middle in that of points (n, 3), metres."""
        x = np.zeros(self.points(self.config.refine[-1].sample)[0].n_unknowns)
        x[:pose.size] = twists(pose).ravel()
        points, _, _ = self.points(self.config.refine[-1].sample)
        x[pose.size:pose.size + 3] = onto.mean(axis=0) - points.positions(x).mean(axis=0)
        return x

    def starts(self) -> Iterator[np.ndarray]:
        """Typical poses where landmarks place them, or without landmarks turned about the vertical."""
        poses = typical_poses(self.pose_mean, self.covariance, self.config.axes)
        if len(self.marks) >= 3:
            yield from map(self._on_landmarks, poses)
            return
        up = np.zeros(3)
        up[np.ptp(self.body.template.vertices, axis=0).argmax()] = 1
        if self.config.up is not None:
            up = np.asarray(self.config.up) / np.linalg.norm(self.config.up)
        turns = rotations.exp(2 * np.pi * np.arange(self.config.turns)[:, None] / self.config.turns * up)
        for pose in poses:
            for R in turns:                              # all ways round first: what faces backwards may explain much
                turned = pose.copy()
                turned[0] = rotations.log(R @ rotations.exp(pose[0]))
                yield self.placed(turned, self.target.points)

    def _on_landmarks(self, pose: np.ndarray) -> np.ndarray:
        """A pose turned as a whole, then bent, towards the landmarks."""
        stage = (self.config.search + self.config.refine)[0]
        points, _, share = self.points(stage.sample)
        x = self.placed(pose, self.marked)
        here = points.positions(x)[len(share):]
        R, _ = rotations.procrustes(here, self.marked)
        turned = pose.copy()
        turned[0] = rotations.log(R @ rotations.exp(pose[0]))
        x = self.placed(turned, self.marked)
        x[points.J3:points.J3 + 3] += (self.marked - points.positions(x)[len(share):]).mean(axis=0)
        nothing = Attraction(np.zeros((len(share), 3, 3)), np.zeros((len(share), 3)))
        marks = towards(self.marked, np.full(len(self.marks), 1 / len(self.marks)))
        return self.refine(x, points, nothing.joined(marks), stage.prior, 15)

    def predicted(self, x: np.ndarray) -> Mesh:
        """The body's mesh."""
        pose, trans, betas = self.split(x)
        body = self.body
        vertices = body.vertices(pose, trans) if isinstance(body, Subject) else body.vertices(pose, betas, trans)
        return body.template.with_vertices(np.asarray(vertices, dtype=np.float64))

    def split(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Pose (J, 3), trans (3,), and betas (K,) or None where the shape is known."""
        J3 = self.pose_mean.size
        return x[:J3].reshape(-1, 3), x[J3:J3 + 3], x[J3 + 3:] if len(x) > J3 + 3 else None
