"""Non-rigid registration of a template to a scan, from stiff to soft.

1. The template is placed by its landmarks and bent towards them, with no data yet.
2. A graph of nodes that turn and grow is drawn to the scan by matches in both directions, in stages of
   falling stiffness and rising detail; turns are unknowns, so limbs keep their volume where there are no data.
3. The surface follows the scan as a thin shell.

[Hahnel], [Allen], [Amberg]
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..geometry.mesh import Mesh, check_template
from .descent import Stiffness, minimise
from .energies import NodePattern, Pull, pull
from .graph import build_graph, carry_over, deform, start, vertex_linear
from .matches import Matching, Target, match_both_ways, target_of, thin
from .rigid import align_landmarks, align_rigid
from .schedule import GraphStage, RegistrationConfig, ShellStage
from .shell import Shell, flipped, unfold


@dataclass(frozen=True, eq=False)
class Registration:
    """The template on the scan.

    Attributes
    ----------
    mesh : Mesh
        The template's triangles on their new vertices.
    distances : (N,) float, metres
        From each vertex that was seen to the surface of the scan; NaN for the others.
    seen : (N,) bool
        Whether there were data here.
    rms : float, metres
        Of the distances of the vertices seen.
    landmark_rms : float, metres
        NaN without landmarks.
    converged : bool
    iterations : int
        Steps over all stages.
    energies : dict
        Value of each term at the end of the coarse registration, and of the data at the very end.
    flipped : int
        Triangles that face against their surroundings.
    """

    mesh: Mesh
    distances: np.ndarray
    seen: np.ndarray
    rms: float
    landmark_rms: float
    converged: bool
    iterations: int
    energies: dict[str, float]
    flipped: int


def register(template: Mesh, scan: Mesh | np.ndarray, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
             config: RegistrationConfig | None = None, progress: Callable[[int, int], None] | None = None
             ) -> Registration:
    """Bring a template onto a scan.

    Parameters
    ----------
    template : Mesh
        One connected manifold component.
    scan : Mesh or (n, 3) float, metres
        May have holes, borders, several overlapping sheets, noise.
    landmarks : (L,) int and (L, 3) float, metres, optional
        Vertices of the template and where they are on the scan. Needed wherever the pose differs much.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Registration

    Raises
    ------
    ValueError
        A template that is not one manifold component, an empty scan, values that are not finite, fewer than
        three landmarks or landmarks that do not exist.
    """
    config = config or RegistrationConfig()
    check_template(template)
    target = target_of(scan, config.neighbours)
    if landmarks is not None:
        landmarks = _checked(template, landmarks)
    fit = _Fit(template, target, landmarks, config, progress or (lambda done, total: None))
    for stage in config.graph:
        fit.bend_graph(stage)
    for round_ in config.shell:
        fit.follow(round_)
    fit.x = unfold(template, fit.x, vertex_linear(fit.graph, fit.motion))
    return fit.result()


class _Fit:
    """A registration under way: where the template lies, its graph, what has been counted."""

    def __init__(self, template: Mesh, target: Target, landmarks: tuple[np.ndarray, np.ndarray] | None,
                 config: RegistrationConfig, progress: Callable[[int, int], None]) -> None:
        self.template, self.target, self.landmarks, self.config = template, target, landmarks, config
        self.size = float(np.sqrt(template.face_areas.sum()))
        self.all = np.arange(len(template.vertices))
        self.progress, self.done, self.iterations = progress, 0, 0
        self.total = sum(stage.rounds for stage in config.graph) + len(config.shell)
        self.energies: dict[str, float] = {}
        self.converged = False
        if landmarks is not None:
            self.T = align_landmarks(template.vertices[landmarks[0]], landmarks[1]).T_target_source
        else:
            self.T = align_rigid(template, target.points).T_target_source
        self.x = template.vertices @ self.T[:3, :3].T + self.T[:3, 3]
        self.nodes = config.graph[0].nodes
        self.graph = build_graph(template, self.nodes)
        self.pattern = NodePattern(self.graph)
        self.motion = start(self.graph, self.T)
        self.shell: Shell | None = None

    def landmark_pull(self, share: float) -> Pull:
        """Each landmark weighs as much as this share of the surface."""
        N = len(self.x)
        if self.landmarks is None:
            return Pull(np.zeros((N, 3, 3)), np.zeros((N, 3)), 0.0)
        vertices, points = self.landmarks
        return pull(N, vertices, points, np.full(len(vertices), share * self.size**2))

    def bend_graph(self, stage: GraphStage) -> None:
        """One stage of the coarse registration."""
        self.refine(stage.nodes)
        graph, size = self.graph, self.size
        stiffness = Stiffness(stage.stretch * size, stage.bend * size, stage.growth * size)
        held = self.landmark_pull(stage.landmarks)
        target = self.target.thinned(stage.detail * size)
        sample = thin(self.template.vertices, stage.detail * size)
        for _ in range(stage.rounds if stage.reach else 1):
            wanted, steps = held, stage.rounds
            if stage.reach:
                wanted, steps = held + self.matches(target, sample, stage.reach, stage.slide).wanted, 1
            if wanted.A.any():
                found = minimise(graph, self.pattern, self.motion, wanted, stiffness, steps, 1e-3)
                self.motion, self.energies = found.motion, found.energies
                self.iterations += found.iterations
            self.advance(deform(graph, self.motion), steps)

    def refine(self, nodes: int) -> None:
        """Go on with a graph of so many nodes."""
        if nodes == self.nodes:
            return
        old, motion = self.graph, self.motion
        self.graph, self.nodes = build_graph(self.template, nodes), nodes
        self.pattern = NodePattern(self.graph)
        self.motion = carry_over(old, motion, self.graph)

    def follow(self, stage: ShellStage) -> None:
        """One round of the last pass."""
        self.shell = self.shell or Shell(self.template)
        matching = self.matches(self.target, self.all, stage.reach, stage.slide)
        wanted = matching.wanted + self.landmark_pull(stage.landmarks)
        x = self.shell.displaced(self.x, wanted, stage.smoothing * self.size, stage.tension * self.size)
        self.energies["shell"] = wanted.energy(x)
        self.iterations += 1
        self.advance(x, 1)

    def matches(self, target: Target, sample: np.ndarray, reach: float, slide: float) -> Matching:
        """Matches with the template as it lies now; `reach` as a multiple of its size."""
        return match_both_ways(self.template.with_vertices(self.x), sample, self.size**2, target,
                               reach * self.size, slide, self.config.normal_weight * self.size)

    def result(self) -> Registration:
        """What was found, measured against the whole scan."""
        folded = flipped(self.template, self.x, vertex_linear(self.graph, self.motion))
        last = (self.config.shell or self.config.graph)[-1]
        matching = self.matches(self.target, self.all, last.reach, last.slide)
        seen = matching.distances[matching.seen]
        landmark_rms = np.nan
        if self.landmarks is not None:
            apart = np.linalg.norm(self.x[self.landmarks[0]] - self.landmarks[1], axis=1)
            landmark_rms = float(np.sqrt(np.mean(apart**2)))
        return Registration(self.template.with_vertices(self.x), matching.distances, matching.seen,
                            float(np.sqrt(np.mean(seen**2))) if len(seen) else np.nan, landmark_rms,
                            self.converged, self.iterations, self.energies, int(folded.sum()))

    def advance(self, x: np.ndarray, steps: int) -> None:
        """Take new vertices and tell of the progress."""
        self.converged = bool(np.linalg.norm(x - self.x, axis=1).mean() <= self.config.settled * self.size)
        self.x = x
        self.done += steps
        self.progress(self.done, self.total)

def _checked(template: Mesh, landmarks: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Landmarks as arrays, or ValueError with what is wrong with them."""
    vertices, points = np.asarray(landmarks[0]), np.asarray(landmarks[1], dtype=np.float64)
    if vertices.ndim != 1 or not np.issubdtype(vertices.dtype, np.integer):
        raise ValueError(f"landmarks: expected vertex numbers of shape (L,), got {vertices.dtype} "
                         f"of shape {vertices.shape}")
    if points.shape != (len(vertices), 3):
        raise ValueError(f"landmarks: expected points of shape ({len(vertices)}, 3), got {points.shape}")
    if len(vertices) < 3:
        raise ValueError(f"landmarks: expected at least 3, got {len(vertices)}")
    outside = (vertices < 0) | (vertices >= len(template.vertices))
    if outside.any():
        raise ValueError(f"landmarks: vertex {vertices[outside][0]} is outside 0..{len(template.vertices) - 1}")
    if not np.isfinite(points).all():
        raise ValueError(f"landmarks: {(~np.isfinite(points).all(axis=1)).sum()} points are not finite")
    return vertices, points
