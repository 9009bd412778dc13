"""Holes closed by fair patches [Liepa], or along a surface diffused through a volume [Davis]."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np

from ..geometry.mesh import Mesh, template_problem
from ..geometry.seen_space import SeenSpace
from ..geometry.surface import Rays, Surface
from ..ranges import Count, Positive, Range, Settings
from .boundary_loops import group_loops, joined_polygon
from .hole_patch import Patch
from .intersections import intersecting_faces
from .manifold import repair, split_vertices
from .volumetric_diffusion import DiffusionConfig, diffused_surface

METHODS = ("auto", "fair", "diffusion", "poisson-open3d", "poisson-pymeshlab")
PULL, PULL_ROUNDS = 3e3, 4           # of the diffused surface on a patch, for a hole of radius 1


@dataclass(frozen=True)
class FillConfig(Settings):
    """Settings of `fill_holes`.

    Attributes
    ----------
    method : "auto", "fair", "diffusion", "poisson-open3d" or "poisson-pymeshlab"
        Fair patches, or patches drawn to a surface diffused through a volume; "auto" makes fair patches and, where
        lines of sight are known, tries diffusion for one that fills space seen to be empty or runs through
        something. Without them diffusion did not win a single hole that we measured, and takes long.
        Screened Poisson reconstruction remeshes everything and needs the named library.
    max_edges : int, optional
        Longer borders stay open.
    density : float
        Size of the new triangles relative to those around the hole: larger means finer.
    fair_rounds : int
        Alternations of turning edges and solving for the fair shape before the last.
    exact_edges : int
        Longest loop whose triangulation is found by dynamic programming as a whole.
    join : bool
        Whether borders that face each other, as those of a limb that was cut through, are joined by one patch.
    diffusion : DiffusionConfig
    poisson_depth : int
        Octree depth of the Poisson methods.
    """

    method: Literal["auto", "fair", "diffusion", "poisson-open3d", "poisson-pymeshlab"] = "auto"
    max_edges: Count | None = None
    density: Positive = 2 ** 0.5
    fair_rounds: int = 0
    exact_edges: int = 120
    join: bool = True
    diffusion: DiffusionConfig = field(default_factory=DiffusionConfig)
    poisson_depth: Annotated[int, Range(1, 16)] = 8


@dataclass(frozen=True, eq=False)
class FilledHole:
    """What was done about one hole.

    Attributes
    ----------
    centre : (3,) float, metres
    borders : int
        Closed borders that one patch joins.
    edges : int
        Their length in edges.
    method : "fair" or "diffusion"
    intersections : int
        Pairs of triangles, one of them new, that run through each other in the end.
    in_empty : float
        Share of the new vertices in space that the views saw to be empty; 0 without views.
    """

    centre: np.ndarray
    borders: int
    edges: int
    method: str
    intersections: int
    in_empty: float


@dataclass(frozen=True, eq=False)
class FillReport:
    """A filled mesh and how each hole was filled.

    Attributes
    ----------
    mesh : Mesh
        The vertices and triangles of the mesh with holes come first, untouched.
    holes : tuple of FilledHole
        Longest border first.
    """

    mesh: Mesh
    holes: tuple[FilledHole, ...]


def fill_holes(mesh: Mesh, config: FillConfig | None = None,
               progress: Callable[[int, int], None] | None = None, views: Sequence[Any] = ()) -> Mesh:
    """Close the holes of a mesh.

    Each hole gets the triangulation that bends least, is refined to the size of the triangles around it, and
    faired so that it continues the surface. `fill_report` tells what was done about each.

    Parameters
    ----------
    mesh : Mesh
        Edge-manifold; borders may touch in a vertex (see `repair`).
    config : FillConfig, optional
    progress : callback(done, total), optional
    views : sequence of RangeView, or of (Mesh, camera position (3,)) pairs, optional
        What the mesh was merged from; space they look through is left empty.

    Returns
    -------
    Mesh
        Except with the Poisson methods, the vertices and triangles of `mesh` come first, untouched. Vertices
        where separate sheets touch are doubled.

    Raises
    ------
    ValueError
        The mesh is empty or not manifold along its edges, or the method is unknown.

    [Liepa] triangulation, refinement, fairing
    [Davis] volumetric diffusion
    """
    config = config or FillConfig()
    if config.method == "poisson-open3d":
        from ..adapters.open3d_filters import poisson

        return close(poisson(_checked(mesh, config), config.poisson_depth))
    if config.method == "poisson-pymeshlab":
        from ..adapters.pymeshlab_filters import poisson

        return close(poisson(_checked(mesh, config), config.poisson_depth))
    return fill_report(mesh, config, progress, views).mesh


def fill_report(mesh: Mesh, config: FillConfig | None = None, progress: Callable[[int, int], None] | None = None,
                views: Sequence[Any] = ()) -> FillReport:
    """Close the holes of a mesh and tell how; as `fill_holes`, for the methods that keep the mesh.

    Returns
    -------
    FillReport

    Raises
    ------
    ValueError
        As `fill_holes`; also for the Poisson methods, which keep no holes to report on.
    """
    config = config or FillConfig()
    _checked(mesh, config)
    if config.method.startswith("poisson"):
        raise ValueError(f"config.method: {config.method} remeshes everything; there are no single holes to report")
    if not mesh.is_edge_manifold:
        raise ValueError("mesh: expected at most two triangles at an edge, facing the same way; repair it first")
    mesh = split_vertices(mesh, across_holes=True)
    loops = [loop for loop in mesh.boundary_loops if len(loop) <= (config.max_edges or len(mesh.vertices))]
    if not loops:
        return FillReport(split_vertices(mesh), ())
    groups = group_loops(mesh, loops) if config.join else [[loop] for loop in loops]
    seen = SeenSpace(views) if len(views) else None
    made = _Filling(mesh, groups, config, seen, progress)
    return FillReport(split_vertices(made.mesh), made.holes)


def close(mesh: Mesh, config: FillConfig | None = None, rounds: int = 4) -> Mesh:
    """Repair and fill in turns, until nothing is open or defective.

    Parameters
    ----------
    mesh : Mesh
    config : FillConfig, optional
        Of the first filling; what repair opens afterwards is filled with fair patches.
    rounds : int

    Returns
    -------
    Mesh
        One closed manifold component, unless `rounds` do not suffice.
    """
    mesh = fill_holes(repair(mesh), config)
    for _ in range(rounds):
        if mesh.is_closed and template_problem(mesh) is None:
            break
        mesh = fill_holes(repair(mesh))
    return mesh


def _checked(mesh: Mesh, config: FillConfig) -> Mesh:
    if not len(mesh.faces):
        raise ValueError("mesh: expected a surface with holes, got one without triangles")
    if config.method not in METHODS:
        raise ValueError(f"config.method: expected one of {', '.join(METHODS)}, got {config.method!r}")
    return mesh


class _Filling:
    """All holes filled by fair patches together; then those that are not good enough one by one in a volume."""

    def __init__(self, mesh: Mesh, groups: list[list[np.ndarray]], config: FillConfig, seen: SeenSpace | None,
                 progress: Callable[[int, int], None] | None) -> None:
        self.config, self.seen, self.rays = config, seen, Rays(mesh)
        self.mesh = mesh
        method = "diffusion" if config.method == "diffusion" else "fair"
        if method == "fair":
            filled = self._patched(mesh, groups, None, progress)
            faults = self._faults(filled, len(mesh.faces), groups)
        else:
            filled, faults = mesh, [(1, 1.0)] * len(groups)
        bad = [g for g, (crossing, empty) in enumerate(faults)
               if config.method == "diffusion" or (seen is not None and (crossing or empty > 0.02))]
        bad = bad if config.method != "fair" else []
        methods = [method] * len(groups)
        if bad:
            good = [group for g, group in enumerate(groups) if g not in bad]
            filled = self._patched(mesh, good, None, None) if good and method == "fair" else mesh
            for done, g in enumerate(bad):
                filled, faults[g], methods[g] = self._best(filled, groups[g], faults[g], method)
                if progress:
                    progress(len(good) + done + 1, len(groups))
        self.mesh = filled
        self.holes = tuple(FilledHole(mesh.vertices[np.concatenate(group)].mean(axis=0), len(group),
                                      sum(map(len, group)), way, crossing, empty)
                           for group, way, (crossing, empty) in zip(groups, methods, faults, strict=True))

    def _best(self, mesh: Mesh, group: list[np.ndarray], fair_faults: tuple[int, float], method: str
              ) -> tuple[Mesh, tuple[int, float], str]:
        """The mesh with one hole filled by diffusion, unless the fair patch was better."""
        rim = np.concatenate(group)
        guide = diffused_surface(*_around(mesh, rim, 4.0), self.config.diffusion, self.seen)
        filled = self._patched(mesh, [group], guide, None)
        faults = self._faults(filled, len(mesh.faces), [group])[0]
        if method == "diffusion" or (faults[1] > 0.02, faults[0], faults[1]) < (
                fair_faults[1] > 0.02, fair_faults[0], fair_faults[1]):
            return filled, faults, "diffusion"
        return self._patched(mesh, [group], None, None), fair_faults, "fair"

    def _patched(self, mesh: Mesh, groups: list[list[np.ndarray]], guide: Mesh | None,
                 progress: Callable[[int, int], None] | None) -> Mesh:
        """The mesh with patches across some holes."""
        rim = np.zeros(len(mesh.vertices), dtype=bool)
        rim[np.concatenate([loop for group in groups for loop in group])] = True
        around, used = mesh.submesh(rim[mesh.faces].any(axis=1))      # all that the patches have to know
        local = np.full(len(mesh.vertices), -1)
        local[used] = np.arange(len(used))
        patch = Patch(around, rim[used])
        polygons = [joined_polygon(around.vertices, [local[loop] for loop in group]) for group in groups]
        patch.triangulate(polygons, self.config.exact_edges, self.rays, progress)
        patch.refine(self.config.density)
        start = patch.mesh.vertices
        for _ in range(self.config.fair_rounds):
            patch.fair()
            patch.flip(min_cosine=0.3)
        patch.fair()
        patch.untangle(start)
        if guide is not None and len(guide.faces):
            surface, start = Surface(guide), patch.mesh.vertices
            for _ in range(PULL_ROUNDS):
                new = patch.mesh.vertices[patch.old_vertices:]
                patch.fair(surface.closest(new).points if len(new) else new, PULL)
            patch.untangle(start)
        return patch.onto(mesh, used)

    def _faults(self, filled: Mesh, old: int, groups: list[list[np.ndarray]]) -> list[tuple[int, float]]:
        """For every hole: pairs of triangles that cross, share of new vertices where nothing can be."""
        new = np.arange(old, len(filled.faces))
        label = Mesh(filled.vertices, filled.faces[old:]).vertex_component
        pairs = intersecting_faces(filled, new)
        crossing = np.bincount(label[filled.faces[pairs.max(axis=1), 0]], minlength=label.max() + 1)
        empty = np.zeros(label.max() + 1)
        fresh = np.arange(len(self.mesh.vertices), len(filled.vertices))
        if self.seen is not None and len(fresh):
            inside = self.seen.ahead(filled.vertices[fresh]) > self.config.diffusion.empty
            count = np.bincount(label[fresh], minlength=len(empty))
            empty = np.bincount(label[fresh], inside, len(empty)) / np.maximum(count, 1)
        return [(int(crossing[label[group[0][0]]]), float(empty[label[group[0][0]]])) for group in groups]


def _around(mesh: Mesh, rim: np.ndarray, radii: float) -> tuple[Mesh, np.ndarray]:
    """The part of a mesh near a hole, and the vertices of its border there."""
    middle = mesh.vertices[rim].mean(axis=0)
    reach = radii * np.linalg.norm(mesh.vertices[rim] - middle, axis=1).max()
    near = np.linalg.norm(mesh.corners.mean(axis=1) - middle, axis=1) < reach
    part, used = mesh.submesh(near | np.isin(mesh.faces, rim).any(axis=1))
    return part, np.searchsorted(used, np.unique(rim))
