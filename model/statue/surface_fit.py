"""Fit of a control mesh to a scan: a shape-constrained deformable surface under annealed soft assignment.

[Statues] section 4
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from scipy.sparse import csc_array, diags_array

from scanprep.geometry.mesh import Mesh, check_template
from scanprep.geometry.sparse import Factored
from scanprep.geometry.surface import Surface
from scanprep.matching.matches import Target, target_of
from scanprep.matching.shell import conjugate_gradients, flipped, unfold
from scanprep.matching.turns import turns
from scanprep.ranges import Count, Positive, Range, Settings
from scanprep.threads import one_thread

from .local_shape import LocalShape, local_shape
from .soft_assignment import ScanPoints, Slack, SoftAssignment, assign


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
    detail : float
        The scan is thinned to this multiple of √T, so that the neighbours fill the region of matching.
    slack : "rest" or "published"
    cooling : float
        Factor of the temperature from one stage to the next.
    rate : float
        Length of an Euler step.
    tolerance : float, metres
        Root of the final temperature.
    most : int
        Steps at one temperature at most.
    cover : float
        Weight of the other direction, in which points of the scan draw the nearest point of the control mesh, so that
        it covers tips of limbs; all of them together weigh as much as this many times all vertices. The paper has none.
    polish : int
        Rounds at the end in which vertices are drawn to the surface between the points of the scan; 0 leaves them out.
    tight : float
        Weight of the data in these rounds, across the surface.
    slide : float
        Weight along it, as a share.
    """

    step: Literal["implicit", "explicit"] = "implicit"
    shape: Positive = 1.0
    neighbours: Count = 32
    detail: float = 0.3
    slack: Slack = "rest"
    cooling: Annotated[float, Range(0.01, 0.99)] = 0.7
    rate: Annotated[float, Range(1e-6, 1)] = 0.5
    tolerance: Positive = 0.001
    most: Count = 100
    cover: float = 1.0
    polish: int = 6
    tight: Positive = 100.0
    slide: float = 0.05


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A control mesh on a scan.

    Attributes
    ----------
    vertices : (N, 3) float, metres
    seen : (N,) bool
        Whether there were data here; the others are carried by the shape.
    rms, largest : float, metres
        Distances of the vertices seen to the surface of the scan.
    inverted : int
        Triangles that face against their surroundings.
    distortion : float
        Root mean square over the area of the logarithm of the stretches against the rest shape.
    energies : {"shape", "data", "entropy": float}
        Terms of Eq. 16 after the last step at the last temperature, square metres.
    temperatures : (K,) float, square metres
    steps : (K,) int
        Steps at each of them.
    converged : bool
        The largest component of the gradient fell below √T at every temperature, and there were data.
    """

    vertices: np.ndarray
    seen: np.ndarray
    rms: float
    largest: float
    inverted: int
    distortion: float
    energies: dict[str, float]
    temperatures: np.ndarray
    steps: np.ndarray
    converged: bool


@one_thread()
def fit_surface(rest: Mesh, start: np.ndarray, scan: Mesh, config: SurfaceFitConfig | None = None,
                progress: Callable[[int, int], None] | None = None) -> SurfaceFit:
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

    Raises
    ------
    ValueError
        A control mesh that is not one manifold component, vertices of another shape or not finite, an empty scan.

    [Statues] Eq. 6, 10, 11, 16, 18
    """
    config = config or SurfaceFitConfig()
    check_template(rest, "rest")
    start = np.array(start, dtype=np.float64)
    if start.shape != rest.vertices.shape or not np.isfinite(start).all():
        raise ValueError(f"start: expected finite vertices of shape {rest.vertices.shape}, got {start.shape} with "
                         f"{int((~np.isfinite(start)).sum())} that are not")
    if not len(scan.faces):
        raise ValueError(f"scan: expected at least one triangle, got {scan}")
    fit = _Fit(rest, start, _target(scan), config)
    temperatures = fit.schedule()
    total = len(temperatures) + config.polish
    for k, T in enumerate(temperatures):
        fit.anneal(T)
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

    def __init__(self, rest: Mesh, start: np.ndarray, target: Target, config: SurfaceFitConfig) -> None:
        self.rest, self.x, self.target, self.config = rest, start, target, config
        self.shape: LocalShape = local_shape(rest)
        self.everything = ScanPoints(target.points, target.normals)
        self.spacing = float(np.median(np.sqrt(self.everything.nearest(target.points[::50], target.normals[::50], 5)[1][:, -1])))
        self.W = diags_array(self.shape.weights)
        self.stiffness = csc_array(self.shape.plane.T @ self.W @ self.shape.plane)
        self.finest = float(np.quantile(rest.edge_lengths, 0.05))
        self.points, self.cell = self.everything, 0.0
        self.steps: list[int] = []
        self.converged = True
        self.energies: dict[str, float] = {}

    @property
    def mesh(self) -> Mesh:
        """As it lies now."""
        return self.rest.with_vertices(self.x)

    def schedule(self) -> np.ndarray:
        """Temperatures from the largest squared distance of a vertex to its nearest point down to the tolerance."""
        final = self.config.tolerance**2
        squared = self.everything.nearest(self.x, self.mesh.vertex_normals, 1)[1]
        first = max(float(squared[np.isfinite(squared)].max(initial=0.0)), final)
        stages = int(np.ceil(np.log(final / first) / np.log(self.config.cooling))) + 1
        return np.geomspace(first, final, stages)

    def anneal(self, T: float) -> None:
        """Steps at one temperature until the gradient lies within the region of matching."""
        self._thin(self.config.detail * np.sqrt(T))
        for count in range(self.config.most + 1):
            matches, seen = self.assignment(T)
            wanted = matches.matches @ self.points.points
            force = self.force(wanted, seen)
            if np.abs(force).max() <= np.sqrt(T) and count:
                break
            if count < self.config.most:
                if self.config.step == "explicit":
                    self.x = self.x + self.config.rate * force                            # Eq. 18
                else:
                    self.x = self.minimised(seen[:, None, None] * np.eye(3), wanted)
        else:
            self.converged = False
        data, entropy = matches.energy(self.x, self.points.points, T)
        self.energies = {"shape": self.config.shape * self.shape.energy(self.x), "data": data, "entropy": entropy}
        self.steps.append(count)

    def assignment(self, T: float) -> tuple[SoftAssignment, np.ndarray]:
        """The balanced assignment, and which vertices have data."""
        normals = self.mesh.vertex_normals
        near, squared = self.points.nearest(self.x, normals, self.config.neighbours)
        seen = self.beside_data(normals)
        near[~seen] = -1
        found = assign(near, squared, len(self.points.points), T, self.config.slack)
        return found, found.seen

    def beside_data(self, normals: np.ndarray) -> np.ndarray:
        """(N,) bool: not beyond the edge of a hole, where the nearest points say nothing."""
        nearest = self.everything.nearest(self.x, normals, 1)[0][:, 0]
        offset = self.x - self.target.points[nearest]
        beside = np.linalg.norm(np.cross(self.target.normals[nearest], offset), axis=1)
        return (nearest >= 0) & (~self.target.border[nearest] | (beside <= 2 * self.spacing))

    def force(self, wanted: np.ndarray, seen: np.ndarray) -> np.ndarray:
        """(N, 3) minus half the gradient of Eq. 16 at a fixed assignment: as published, or exact."""
        data = seen[:, None] * (wanted - self.x)
        if self.config.step == "explicit":
            return data + self.config.shape * self.shape.published_force(self.x)
        C, y = self.covering()
        cover = self.config.cover * len(self.x) / max(len(y), 1) * (C.T @ (y - C @ self.x))
        return data + cover - 0.5 * self.config.shape * self.shape.gradient(self.x)

    def covering(self) -> tuple[csc_array, np.ndarray]:
        """Points of the scan (P, 3) and where the control mesh is nearest to them, as sparse (P, N) of its vertices."""
        mesh, points = self.mesh, self.points
        found = Surface(mesh).closest(points.points)
        corners = mesh.faces[found.faces]
        normals = np.einsum("pc,pcd->pd", found.bary, mesh.vertex_normals[corners])
        good = np.flatnonzero(np.einsum("pd,pd->p", normals, points.normals) > 0.3)
        rows = np.repeat(np.arange(len(good)), 3)
        C = csc_array((found.bary[good].ravel(), (rows, corners[good].ravel())), shape=(len(good), len(self.x)))
        return C, points.points[good]

    def minimised(self, A: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        """Vertices after a Gauss-Newton step on the local shape, Σ (x - y)ᵀ A (x - y), A (N, 3, 3), and the cover."""
        shape, w, lam, x = self.shape, self.shape.weights[:, None], self.config.shape, self.x
        C, y = self.covering()
        share = self.config.cover * len(x) / max(len(y), 1)
        CC = share * (C.T @ C)
        nearly = Factored(csc_array(lam * self.stiffness + CC + diags_array(np.linalg.eigvalsh(A)[:, 2] + 1e-6 * lam)))

        def energy(x: np.ndarray) -> float:
            return (lam * shape.energy(x) + float(np.einsum("ni,nij,nj->", x - wanted, A, x - wanted))
                    + share * float(((C @ x - y) ** 2).sum()))

        force = np.einsum("nij,nj->ni", A, wanted - x) - 0.5 * lam * shape.gradient(x) + share * (C.T @ (y - C @ x))
        d = conjugate_gradients(
            lambda d: lam * shape.transposed(x, w * shape.derivative(x, d)) + np.einsum("nij,nj->ni", A, d) + CC @ d,
            force, nearly.solve, 30, 1e-2)
        before, length = energy(x), 1.0
        while energy(x + length * d) > before and length > 1e-3:
            length /= 2
        return x + length * d

    def polish(self, surface: Surface) -> None:
        """One round in which the vertices are drawn to the tangent planes of the surface itself."""
        normals = self.mesh.vertex_normals
        seen = self.beside_data(normals)
        near = self.everything.nearest(self.x, normals, 1)[0][:, 0]
        found = surface.closest(self.x)
        n = self.target.normals[near]
        wrong = np.einsum("nd,nd->n", surface.mesh.face_normals[found.faces], normals) <= 0
        y = np.where(wrong[:, None], self.target.points[near], found.points)
        A = np.einsum("ni,nj->nij", n, n) + self.config.slide * np.eye(3)
        self.x = self.minimised(self.config.tight * seen[:, None, None] * A, y)

    def settle_down(self, surface: Surface) -> None:
        """Vertices with data onto the surface, where that turns no triangle over."""
        normals = self.mesh.vertex_normals
        seen = self.beside_data(normals)
        found = surface.closest(self.x)
        agrees = np.einsum("nd,nd->n", surface.mesh.face_normals[found.faces], normals) > 0
        y = np.where((seen & agrees)[:, None], found.points, self.x)
        self.x = unfold(self.rest, y, turns(self.rest, y))

    def result(self, surface: Surface, temperatures: np.ndarray) -> SurfaceFit:
        """What was reached."""
        seen = self.beside_data(self.mesh.vertex_normals)
        apart = surface.closest(self.x).distances[seen]
        inverted = flipped(self.rest, self.x, turns(self.rest, self.x))
        return SurfaceFit(self.x, seen, float(np.sqrt(np.mean(apart**2))) if seen.any() else np.nan,
                          float(apart.max(initial=0.0)), int(inverted.sum()), distortion(self.rest, self.x),
                          self.energies, temperatures, np.array(self.steps), bool(self.converged and seen.any()))

    def _thin(self, cell: float) -> None:
        """Points of the scan for one temperature: never fewer than the finest triangles of the mesh need."""
        cell = min(cell, self.finest / 2)
        if cell < self.spacing:
            self.points = self.everything
        elif abs(cell - self.cell) > 0.1 * self.cell or self.points is self.everything:
            thinned = self.target.thinned(cell)
            self.points, self.cell = ScanPoints(thinned.points, thinned.normals), cell


def _target(scan: Mesh) -> Target:
    """Points with smooth normals; the borders are those of the mesh, for tips of limbs look one-sided as well."""
    border = np.zeros(len(scan.vertices), dtype=bool)
    border[scan.boundary_vertices] = True
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
