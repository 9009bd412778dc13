"""Fit of a control mesh to a scan: a shape-constrained deformable surface under annealed soft assignment.

Beyond the paper: points of the scan draw the mesh as well (`cover`), without which it leaves tips of limbs empty; at
the end vertices are drawn to the surface between the points (`polish`); at the edge of a hole the data draw only across
the surface, and beyond it not at all. `SurfaceFitConfig(step="explicit", polish=0)` has nothing of the first two.

[Statues] section 4
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from scipy.sparse import csc_array, diags_array, eye_array

from scanprep.geometry.mesh import Mesh, check_template
from scanprep.geometry.sparse import Factored, conjugate_gradients
from scanprep.geometry.surface import Surface, checked_points
from scanprep.geometry.target import Target, target_of
from scanprep.ranges import Count, Positive, Range, Settings
from scanprep.registration.inverted_triangles import inverted_triangles, unfold
from scanprep.threads import one_thread

from .local_shape import LocalShape, local_shape
from .soft_assignment import ScanPoints, Slack, SoftAssignment, assign

AGREE = 0.3              # least cosine between normals of the scan and the mesh, for points that draw the mesh
BACK = 10                # times that vertices go back from the surface because a triangle turned over
LAST = 10                # times as many steps at the last temperature
SAMPLE = 10              # such points of the scan for each vertex


@dataclass(frozen=True)
class SurfaceFitConfig(Settings):
    """Settings of `fit_surface`.

    Attributes
    ----------
    step : "implicit" or "explicit"
        Minimise the energy at a fixed assignment, or the published Euler steps.
    shape : float
        Weight of the local shape against the data; the paper has none, which is 1.
    neighbours : int
        Points of the scan that a vertex is assigned to.
    slack : "rest" or "published"
    cooling : float
        Factor of the temperature from one stage to the next.
    rate : float
        Length of an Euler step.
    tolerance : float, metres
        Root of the final temperature.
    most : int
        Steps at one temperature at most; ten times as many at the last.
    cover : float
        Weight of the other direction, in which points of the scan draw the nearest point of the control mesh, so that
        it covers tips of limbs; all of them together weigh as much as this many times all vertices. The paper has none.
    reach : float
        Vertices farther from the scan have no data and are carried by the shape: an arm that was not scanned stays
        where it was posed. A multiple of the root of the mesh's area; the paper has none.
    polish : int
        Rounds at the end in which vertices are drawn to the surface between the points of the scan; 0 leaves them out.
    tight : float
        Weight of the data in these rounds, across the surface.
    slide : float
        Weight along it, as a share.
    """

    step: Literal["implicit", "explicit"] = "implicit"
    shape: Positive = 1.0
    neighbours: Count = 16
    slack: Slack = "rest"
    cooling: Annotated[float, Range(0.01, 0.99)] = 0.5
    rate: Annotated[float, Range(1e-6, 1)] = 0.5
    tolerance: Positive = 0.001
    most: Count = 5
    cover: float = 3.0
    reach: Positive = 0.06
    polish: int = 6
    tight: Positive = 100.0
    slide: float = 0.05


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A control mesh on a scan."""

    vertices: np.ndarray        # (N, 3) metres
    seen: np.ndarray            # (N,), whether there were data here; the others are carried by the shape
    rms: float                  # metres, distances of the vertices seen to the surface of the scan
    largest: float              # metres, distances of the vertices seen to the surface of the scan
    inverted: int               # triangles that face against their surroundings
    distortion: float           # root mean square over the area of the logarithm of the stretches against the rest
                                # shape
    energies: dict[str, float]  # {"shape", "data", "entropy", "cover": }, terms of Eq. 16, and our own, after the last
                                # step at the last temperature, square metres
    temperatures: np.ndarray    # (K,) square metres
    steps: np.ndarray           # (K,), steps at each of them
    converged: bool             # the longest gradient of a vertex fell below √T at the last temperature, and there were
                                # data. At a higher one the fit goes on after `most` steps, for the next has another
                                # minimum anyway


@one_thread()
def fit_surface(rest: Mesh, start: np.ndarray, scan: Mesh, config: SurfaceFitConfig | None = None,
                progress: Callable[[int, int], None] | None = None, hidden: np.ndarray | None = None) -> SurfaceFit:
    """Deform a control mesh until it lies on a scan, keeping its local shape and parameterisation.

    Parameters
    ----------
    rest : Mesh
        The control mesh whose local shape is kept.
    start : (N, 3) float, metres
        Its vertices near the scan.
    scan : Mesh
        May have holes.
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
    config = config or SurfaceFitConfig()
    check_template(rest, "rest")
    start = checked_points(start, "start")
    if start.shape != rest.vertices.shape:
        raise ValueError(f"start: expected shape {rest.vertices.shape}, got {start.shape}")
    if not len(scan.faces):
        raise ValueError(f"scan: expected at least one triangle, got {scan}")
    fit = _Fit(rest, start, scan_target(scan), float(scan.face_areas.sum()), config, hidden)
    temperatures = fit.schedule()
    total = len(temperatures) + config.polish
    for k, T in enumerate(temperatures):
        fit.anneal(T, config.most * (LAST if k == len(temperatures) - 1 else 1))
        if progress:
            progress(k + 1, total)
    surface = Surface(scan)
    for k in range(config.polish):
        fit.polish(surface)
        if progress:
            progress(len(temperatures) + k + 1, total)
    if config.polish:
        fit.settle_down(surface)
    return fit.result(surface, temperatures)


class _Fit:
    """A control mesh on its way."""

    def __init__(self, rest: Mesh, start: np.ndarray, target: Target, area: float, config: SurfaceFitConfig,
                 hidden: np.ndarray | None) -> None:
        self.rest, self.x, self.target, self.config = rest, start, target, config
        self.shape: LocalShape = local_shape(rest)
        self.points = ScanPoints(target.points, target.normals, target.border)
        self.stiffness = csc_array(self.shape.plane.T @ diags_array(self.shape.weights) @ self.shape.plane)
        self.sample = target.thinned(max(float(np.sqrt(area / (SAMPLE * len(start)))), 1e-4))
        self.nothing = csc_array((0, len(start))), np.zeros((0, 3)), 0.0
        self.shown = np.ones(len(start), dtype=bool) if hidden is None else ~np.asarray(hidden)
        self.reach = config.reach * float(np.sqrt(rest.with_vertices(start).face_areas.sum()))
        self.steps: list[int] = []
        self.converged = False
        self.energies: dict[str, float] = {}

    @property
    def mesh(self) -> Mesh:
        """As it lies now."""
        return self.rest.with_vertices(self.x)

    def schedule(self) -> np.ndarray:
        """Temperatures from the largest squared distance of a vertex to its nearest point down to the tolerance."""
        final = self.config.tolerance**2
        near, squared = self.points.nearest(self.x, self.mesh.vertex_normals, 1)
        first = max(float(squared[self.beside_data(near[:, 0]), 0].max(initial=0.0)), final)
        stages = int(np.ceil(np.log(final / first) / np.log(self.config.cooling))) + 1
        return np.geomspace(first, final, stages)

    def anneal(self, T: float, most: int) -> None:
        """Steps at one temperature until the gradient lies within the region of matching."""
        explicit = self.config.step == "explicit"
        for count in range(most + 1):
            matches, A = self.assignment(T)
            wanted = matches.matches @ self.points.points
            if explicit:
                data = SurfaceData(A, wanted, *self.nothing)
                force = data.force(self.x) + self.config.shape * self.shape.published_force(self.x)
            else:
                data = self.drawn(A, wanted)
                force = self.force(data)
            self.converged = bool(np.linalg.norm(force, axis=1).max() <= np.sqrt(T))
            if (self.converged and count) or count == most:
                break
            self.x = self.x + self.config.rate * force if explicit else self.stepped(data, force)     # Eq. 18
        misfit, entropy = matches.energy(self.x, self.points.points, T)
        self.energies = {"shape": self.config.shape * self.shape.energy(self.x), "data": misfit, "entropy": entropy,
                         "cover": data.cover(self.x)}
        self.steps.append(count)

    def assignment(self, T: float) -> tuple[SoftAssignment, np.ndarray]:
        """The balanced assignment, and (N, 3, 3) what it weighs: nothing without data, at borders only across them.

        At the edge of a hole all points lie to one side: their mean would draw the mesh off the hole.
        """
        near, squared = self.points.nearest(self.x, self.mesh.vertex_normals, self.config.neighbours)
        near[~self.beside_data(near[:, 0])] = -1
        found = assign(near, squared, len(self.points.points), T, self.config.slack)
        n = self.points.normals[near[:, 0]]
        edge = (self.points.border[near] & (near >= 0)).any(axis=1)
        A = np.where(edge[:, None, None], np.einsum("ni,nj->nij", n, n), np.eye(3))
        return found, found.seen[:, None, None] * A

    def beside_data(self, nearest: np.ndarray) -> np.ndarray:
        """(N,) bool: shown, within reach of the nearest point, not past the edge of a hole where it says nothing."""
        near = np.linalg.norm(self.points.points[nearest] - self.x, axis=1) <= self.reach
        return self.shown & near & self.points.beside(self.x, nearest)

    def seen(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices with data, and the nearest point of the whole scan."""
        nearest = self.points.nearest(self.x, self.mesh.vertex_normals, 1)[0][:, 0]
        return self.beside_data(nearest), nearest

    def drawn(self, A: np.ndarray, wanted: np.ndarray) -> SurfaceData:
        """The data term that draws vertices to `wanted` (N, 3) by A (N, 3, 3), and the mesh to points of the scan."""
        mesh = self.mesh
        if not self.config.cover:
            return SurfaceData(A, wanted, *self.nothing)
        found = Surface(mesh).closest(self.sample.points)
        corners = mesh.faces[found.faces]
        normals = found.transferred(mesh.vertex_normals, mesh.faces)
        facing = np.einsum("pd,pd->p", normals, self.sample.normals) > AGREE
        good = np.flatnonzero(facing & self.shown[corners].all(axis=1))
        rows = np.repeat(np.arange(len(good)), 3)
        C = csc_array((found.bary[good].ravel(), (rows, corners[good].ravel())), shape=(len(good), len(self.x)))
        return SurfaceData(A, wanted, C, self.sample.points[good], self.config.cover * len(self.x) / len(found.faces))

    def force(self, data: SurfaceData) -> np.ndarray:
        """(N, 3) minus half the exact gradient."""
        return data.force(self.x) - 0.5 * self.config.shape * self.shape.gradient(self.x)

    def stepped(self, data: SurfaceData, force: np.ndarray) -> np.ndarray:
        """Vertices after a Gauss-Newton step on local shape and data."""
        shape, w, lam, x = self.shape, self.shape.weights[:, None], self.config.shape, self.x
        nearly = Factored(csc_array(lam * self.stiffness + data.bound + 1e-6 * lam * eye_array(len(x))))
        d = conjugate_gradients(lambda d: lam * shape.transposed(x, w * shape.derivative(x, d)) + data.applied(d),
                                force, nearly.solve, 30, 1e-2)

        def energy(x: np.ndarray) -> float:
            return lam * shape.energy(x) + data.energy(x)

        length = 1.0
        while energy(x + length * d) > energy(x) and length > 1e-3:
            length /= 2
        return x + length * d

    def polish(self, surface: Surface) -> None:
        """One round in which the vertices are drawn to the tangent planes of the surface itself."""
        normals = self.mesh.vertex_normals
        seen, near = self.seen()
        found = surface.closest(self.x)
        n = self.target.normals[near]
        wrong = np.einsum("nd,nd->n", surface.mesh.face_normals[found.faces], normals) <= 0
        y = np.where(wrong[:, None], self.target.points[near], found.points)
        A = np.einsum("ni,nj->nij", n, n) + self.config.slide * np.eye(3)
        data = self.drawn(self.config.tight * seen[:, None, None] * A, y)
        self.x = self.stepped(data, self.force(data))

    def settle_down(self, surface: Surface) -> None:
        """Vertices with data onto the surface, where that turns no triangle over."""
        self.x = unfold(self.rest, self.x)
        normals, (free, _) = self.mesh.vertex_normals, self.seen()
        found = surface.closest(self.x)
        free &= np.einsum("nd,nd->n", surface.mesh.face_normals[found.faces], normals) > 0
        already = inverted_triangles(self.rest, self.x)
        for _ in range(BACK):
            y = np.where(free[:, None], found.points, self.x)
            turned = inverted_triangles(self.rest, y) & ~already
            if not turned.any():
                break
            free[self.rest.faces[turned]] = False
        self.x = y

    def result(self, surface: Surface, temperatures: np.ndarray) -> SurfaceFit:
        """What was reached."""
        seen, _ = self.seen()
        apart = surface.closest(self.x).distances[seen]
        inverted = inverted_triangles(self.rest, self.x)
        return SurfaceFit(self.x, seen, float(np.sqrt(np.mean(apart**2))) if seen.any() else np.nan,
                          float(apart.max(initial=0.0)), int(inverted.sum()), distortion(self.rest, self.x),
                          self.energies, temperatures, np.array(self.steps), bool(self.converged and seen.any()))


@dataclass(frozen=True, eq=False)
class SurfaceData:
    """A data term Σ (x - y)ᵀ A (x - y) + share · |C x - z|²: vertices are drawn, and points of the scan draw the mesh.
    [Statues] Eq. 13
    """

    A: np.ndarray  # (N, 3, 3), weight of each vertex: nothing without data, only across the surface at the edge of a
                   # hole
    y: np.ndarray  # (N, 3) metres, where it is drawn
    C: csc_array   # (P, N), points of the mesh, as barycentric coordinates
    z: np.ndarray  # (P, 3) metres, the points of the scan that draw them
    share: float   # weight of each of these

    def energy(self, x: np.ndarray) -> float:
        """At vertices x (N, 3), square metres."""
        return (float(np.einsum("ni,nij,nj->", x - self.y, self.A, x - self.y))
                + self.cover(x))

    def cover(self, x: np.ndarray) -> float:
        """The part of the points that draw the mesh."""
        return self.share * float(((self.C @ x - self.z) ** 2).sum())

    def force(self, x: np.ndarray) -> np.ndarray:
        """(N, 3) minus half the gradient."""
        return np.einsum("nij,nj->ni", self.A, self.y - x) + self.share * (self.C.T @ (self.z - self.C @ x))

    def applied(self, d: np.ndarray) -> np.ndarray:
        """(N, 3) half the second derivative, applied to d (N, 3)."""
        return np.einsum("nij,nj->ni", self.A, d) + self.share * (self.C.T @ (self.C @ d))

    @property
    def bound(self) -> csc_array:
        """(N, N) the same for each coordinate, at least as stiff."""
        return csc_array(diags_array(np.linalg.eigvalsh(self.A)[:, 2]) + self.share * (self.C.T @ self.C))


def scan_target(scan: Mesh) -> Target:
    """Points with smooth normals; the borders are those of the mesh, for tips of limbs look one-sided as well."""
    border = np.zeros(len(scan.vertices), dtype=bool)
    border[scan.boundary_vertices] = True
    border |= scan.vertex_adjacency @ border.astype(float) > 0       # the nearest point may lie one step farther in
    return replace(target_of(scan, name="scan"), border=border[np.unique(scan.faces)])


def distortion(rest: Mesh, x: np.ndarray) -> float:
    """Root mean square over the area at rest of the logarithm of the stretches of the triangles."""
    def flat(c: np.ndarray) -> np.ndarray:
        e, f = c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]
        length = np.maximum(np.linalg.norm(e, axis=1), 1e-12)
        along = np.einsum("fd,fd->f", e, f) / length
        height = np.linalg.norm(np.cross(e, f), axis=1) / length
        return np.stack([np.stack([length, along], axis=1), np.stack([np.zeros_like(length), height], axis=1)], axis=1)

    s = np.linalg.svd(flat(x[rest.faces]) @ np.linalg.inv(flat(rest.corners)), compute_uv=False)
    stretch = (np.log(np.maximum(s, 1e-6)) ** 2).mean(axis=1)
    return float(np.sqrt(np.average(stretch, weights=rest.face_areas)))
