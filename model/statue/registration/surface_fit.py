"""Fit of a control mesh to a scan: a shape-constrained deformable surface under annealed soft assignment.

Beyond the paper, points of the scan attract the mesh as well, and at the end vertices are attracted to the surface
between the points. At the edge of a hole the data act only across the surface.

[Statues] section 4
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array, eye_array

from scanprep.geometry.mesh import Mesh, check_template
from scanprep.geometry.sparse import Factored, conjugate_gradients
from scanprep.geometry.surface import Surface, check_points
from scanprep.geometry.target import Target, target_of
from scanprep.registration.folds import find_inverted_triangles, unfold
from scanprep.threads import one_thread

from ..detail.subdivision import divide_long_edges
from .local_shape import local_shape
from .soft_assignment import DirectedPoints, assign_softly

NEIGHBOURS = 16                      # points of the scan that a vertex is assigned to: ten a vertex attract the mesh
# Factor of the temperature from one stage to the next, and steps at one temperature, ten times as many at the last. The
# paper names neither; the published Euler steps need the finer ones to converge.
COOLING, STEPS = 0.5, 5
PUBLISHED_COOLING, PUBLISHED_STEPS = 0.7, 100
# All points of the scan together weigh as much as this many times all vertices, so that the mesh covers tips of limbs.
COVER = 3.0
# Vertices farther from the scan, in multiples of the root of the mesh's area, have no data: an arm that was not scanned
# stays where it was posed. 8 cm on a person.
REACH = 0.06
POLISH = 6                           # rounds in which vertices are drawn to the surface between the points of the scan


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A control mesh on a scan."""

    vertices: np.ndarray      # (N, 3) metres
    seen: np.ndarray          # (N,), whether there were data here; the others are carried by the shape
    rms: float                # metres, distances of the vertices seen to the surface of the scan
    largest: float            # metres, the largest of them
    inverted: int             # triangles that face against their surroundings
    converged: bool           # the longest gradient of a vertex fell below √T at the last temperature, and there were
                              # data; at a higher one the fit goes on, for the next has another minimum anyway


@one_thread()
def fit_surface(rest: Mesh, start: np.ndarray, scan: Mesh, published: bool = False,
                progress: Callable[[int, int], None] | None = None, hidden: np.ndarray | None = None) -> SurfaceFit:
    """Deform a control mesh until it lies on a scan, keeping its local shape and parameterisation.

    Parameters
    ----------
    rest : Mesh
        The control mesh whose local shape is kept.
    start : (N, 3) float, metres
        Its vertices near the scan.
    scan : Mesh
        The scan, which may have holes.
    published : bool
        Take the paper's Euler steps under its slack, all vertices with data, in place of those that follow here.
    progress : callable, optional
        Called as progress(done, total).
    hidden : (N,) bool, optional
        Vertices that the scan does not show: nothing draws them but the shape.

    Raises
    ------
    ValueError
        A control mesh that is not one manifold component, vertices of another shape or not finite, an empty scan.

    [Statues] Eq. 6, 10, 11, 16, 18
    """
    check_template(rest, "rest")
    start = check_points(start, "start")
    if start.shape != rest.vertices.shape:
        raise ValueError(f"start: expected shape {rest.vertices.shape}, got {start.shape}")
    if not len(scan.faces):
        raise ValueError(f"scan: expected at least one triangle, got {scan}")
    report_progress = progress or (lambda done, total: None)
    fit, steps = _Fit(rest, start, scan, published, hidden), PUBLISHED_STEPS if published else STEPS
    rounds = 0 if published else POLISH
    x, temperatures = start, fit.schedule(start)
    total = len(temperatures) + rounds
    for k, T in enumerate(temperatures, 1):
        most = steps if k < len(temperatures) else 10 * steps
        x, converged = fit.anneal(x, T, most)                                                  # [Statues] Eq. 16-18
        report_progress(k, total)
    for k in range(rounds):
        x = fit.polish(x)
        report_progress(len(temperatures) + k + 1, total)
    if rounds:
        x = fit.onto_the_surface(x)
    seen, _ = fit.find_data(x)
    apart, inverted = fit.surface.closest(x).distances[seen], int(find_inverted_triangles(rest, x).sum())
    return SurfaceFit(x, seen, float(np.sqrt(np.mean(apart**2))) if seen.any() else np.nan,
                      float(apart.max(initial=0.0)), inverted, bool(converged and seen.any()))


class _Fit:
    """The data of a surface fit of vertices x (N, 3), and its steps."""

    def __init__(self, rest: Mesh, start: np.ndarray, scan: Mesh, published: bool, hidden: np.ndarray | None) -> None:
        # ten points of the scan for each vertex attract the mesh; long triangles would do so by their corners only
        spacing = max(float(np.sqrt(float(scan.face_areas.sum()) / (10 * len(start)))), 1e-4)
        scan = divide_long_edges(scan, 2 * spacing)
        target = scan_target(scan)
        self.rest, self.target, self.surface, self.published = rest, target, Surface(scan), published
        self.shape = local_shape(rest)
        self.points = DirectedPoints(target.points, target.normals, target.border)
        self.stiffness = csc_array(self.shape.plane.T @ diags_array(self.shape.weights) @ self.shape.plane)
        self.sample = target.thin(spacing)
        self.shown = np.ones(len(start), dtype=bool) if hidden is None else ~np.asarray(hidden)
        self.reach = np.inf if published else REACH * float(np.sqrt(rest.with_vertices(start).face_areas.sum()))

    def normals(self, x: np.ndarray) -> np.ndarray:
        """Compute the normals (N, 3) of the vertices."""
        return self.rest.with_vertices(x).vertex_normals

    def schedule(self, x: np.ndarray) -> np.ndarray:
        """Compute temperatures (K,), from the largest squared distance of a vertex to its point down to (1 mm)²."""
        final = 0.001**2
        near, squared = self.points.nearest(x, self.normals(x), 1)
        first = max(float(squared[self.beside_data(x, near[:, 0]), 0].max(initial=0.0)), final)
        stages = int(np.ceil(np.log(final / first) / np.log(PUBLISHED_COOLING if self.published else COOLING))) + 1
        return np.geomspace(first, final, stages)

    def anneal(self, x: np.ndarray, T: float, most: int) -> tuple[np.ndarray, bool]:
        """Take steps at one temperature until the gradient is below √T; return vertices and whether it converged."""
        for count in range(most + 1):
            matches, A = self.assignment(x, T)                                             # [Statues] Eq. 14, 15, 17
            wanted = matches @ self.points.points
            data = self.find_matches(x, A, wanted)                                          # [Statues] Eq. 13
            force = data.force(x) + (self.shape.paper_force(x) if self.published else -0.5 * self.shape.gradient(x))
            converged = bool(np.linalg.norm(force, axis=1).max() <= np.sqrt(T))
            if (converged and count) or count == most:
                break
            x = x + 0.5 * force if self.published else self.step(x, data, force)                  # [Statues] Eq. 18
        return x, converged

    def assignment(self, x: np.ndarray, T: float) -> tuple[csr_array, np.ndarray]:
        """Assign vertices to points; return the balanced matches and their weights (N, 3, 3).

        The weight is zero without data. At the edge of a hole all points lie to one side, and their mean would pull the
        mesh off the hole; so there it acts only along the normal.
        """
        near, squared = self.points.nearest(x, self.normals(x), NEIGHBOURS)
        near[~self.beside_data(x, near[:, 0])] = -1
        matches = assign_softly(near, squared, len(self.points.points), T, self.published)
        n = self.points.normals[near[:, 0]]
        edge = (self.points.border[near] & (near >= 0)).any(axis=1)
        A = np.where(edge[:, None, None], np.einsum("ni,nj->nij", n, n), np.eye(3))
        return matches, (np.diff(matches.indptr) > 0)[:, None, None] * A

    def beside_data(self, x: np.ndarray, nearest: np.ndarray) -> np.ndarray:
        """Find vertices with data, (N,) bool: shown, near their nearest point, not past the edge of a hole."""
        near = np.linalg.norm(self.points.points[nearest] - x, axis=1) <= self.reach
        return self.shown & near & self.points.beside(x, nearest)

    def find_data(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find vertices with data (N,), and the nearest point (N,) of the whole scan."""
        nearest = self.points.nearest(x, self.normals(x), 1)[0][:, 0]
        return self.beside_data(x, nearest), nearest

    def find_matches(self, x: np.ndarray, A: np.ndarray, wanted: np.ndarray) -> SurfaceData:
        """Build the data term that attracts vertices to `wanted` (N, 3) with weights A (N, 3, 3).

        Unless as published, scan points also attract the mesh, where both face the same way.
        """
        if self.published:
            return SurfaceData(A, wanted, csc_array((0, len(wanted))), np.zeros((0, 3)), 0.0)
        mesh = self.rest.with_vertices(x)
        found = Surface(mesh).closest(self.sample.points)
        corners = mesh.faces[found.faces]
        normals = found.transfer(mesh.vertex_normals, mesh.faces)
        facing = np.einsum("pd,pd->p", normals, self.sample.normals) > 0.3
        good = np.flatnonzero(facing & self.shown[corners].all(axis=1))
        rows = np.repeat(np.arange(len(good)), 3)
        C = csc_array((found.bary[good].ravel(), (rows, corners[good].ravel())), shape=(len(good), len(x)))
        return SurfaceData(A, wanted, C, self.sample.points[good], COVER * len(x) / len(found.faces))

    def step(self, x: np.ndarray, data: SurfaceData, force: np.ndarray) -> np.ndarray:
        """Take a Gauss-Newton step on local shape and data; `force` is minus half the gradient."""
        # conjugate gradients on the exact matrix, preconditioned by one that is the same for all coordinates
        shape, w = self.shape, self.shape.weights[:, None]
        nearly = Factored(csc_array(self.stiffness + data.bound + 1e-6 * eye_array(len(x))))
        d = conjugate_gradients(lambda d: shape.apply_transpose(x, w * shape.derivative(x, d)) + data.apply(d),
                                force, nearly.solve, 30, 1e-2)

        def energy(x: np.ndarray) -> float:
            return shape.energy(x) + data.energy(x)

        length = 1.0
        while energy(x + length * d) > energy(x) and length > 1e-3:
            length /= 2
        return x + length * d

    def polish(self, x: np.ndarray) -> np.ndarray:
        """Take a step in which vertices are attracted to the tangent planes of the surface itself."""
        seen, near = self.find_data(x)
        found, n = self.surface.closest(x), self.target.normals[near]
        wrong = np.einsum("nd,nd->n", self.surface.mesh.face_normals[found.faces], self.normals(x)) <= 0
        y = np.where(wrong[:, None], self.target.points[near], found.points)
        A = np.einsum("ni,nj->nij", n, n) + 0.05 * np.eye(3)                # little force along the surface
        data = self.find_matches(x, 100.0 * seen[:, None, None] * A, y)
        return self.step(x, data, data.force(x) - 0.5 * self.shape.gradient(x))

    def onto_the_surface(self, x: np.ndarray) -> np.ndarray:
        """Move vertices with data onto the surface, where that inverts no triangle."""
        x = unfold(self.rest, x)
        free, _ = self.find_data(x)
        found = self.surface.closest(x)
        free &= np.einsum("nd,nd->n", self.surface.mesh.face_normals[found.faces], self.normals(x)) > 0
        already = find_inverted_triangles(self.rest, x)
        for _ in range(10):
            y = np.where(free[:, None], found.points, x)
            inverted = find_inverted_triangles(self.rest, y) & ~already
            if not inverted.any():
                break
            free[self.rest.faces[inverted]] = False
        return y


@dataclass(frozen=True, eq=False)
class SurfaceData:
    """A data term Σ (x - y)ᵀ A (x - y) + share · |C x - z|²: targets of vertices, and scan points that attract them.

    [Statues] Eq. 13
    """

    A: np.ndarray  # (N, 3, 3), weight of each vertex: nothing without data, at the edge of a hole across the surface
    y: np.ndarray  # (N, 3) metres, where it is drawn
    C: csc_array   # (P, N), points of the mesh, as barycentric coordinates
    z: np.ndarray  # (P, 3) metres, the points of the scan that draw them
    share: float   # weight of each of these

    def energy(self, x: np.ndarray) -> float:
        """Compute the energy at vertices x (N, 3), square metres."""
        return float(np.einsum("ni,nij,nj->", x - self.y, self.A, x - self.y)
                     + self.share * ((self.C @ x - self.z) ** 2).sum())

    def force(self, x: np.ndarray) -> np.ndarray:
        """Compute minus half the gradient (N, 3)."""
        return np.einsum("nij,nj->ni", self.A, self.y - x) + self.share * (self.C.T @ (self.z - self.C @ x))

    def apply(self, d: np.ndarray) -> np.ndarray:
        """Apply half the second derivative to d (N, 3)."""
        return np.einsum("nij,nj->ni", self.A, d) + self.share * (self.C.T @ (self.C @ d))

    @property
    def bound(self) -> csc_array:
        """(N, N) an upper bound of half the second derivative, the same for each coordinate."""
        return csc_array(diags_array(np.linalg.eigvalsh(self.A)[:, 2]) + self.share * (self.C.T @ self.C))


def scan_target(scan: Mesh) -> Target:
    """Prepare scan points with smooth normals; borders are those of the mesh, as tips of limbs look one-sided too."""
    border = np.zeros(len(scan.vertices), dtype=bool)
    border[scan.boundary_vertices] = True
    border |= scan.vertex_adjacency @ border.astype(float) > 0       # the nearest point may lie one step farther in
    target = target_of(scan, name="scan")
    return replace(target, border=border[target.index])
