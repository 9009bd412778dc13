"""Holes closed by fair patches [Liepa], or along a surface diffused through a volume [Davis]."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np

from ..geometry.mesh import Mesh, template_problem
from ..geometry.surface import Rays, SeenSpace, Surface
from ..judgement import Judgement
from ..ranges import Count, Positive, Range, Settings
from .hole_patch import Patch
from .intersections import intersecting_faces
from .loops import group_loops, join_polygons
from .manifold import repair, split_vertices
from .volumetric_diffusion import EMPTY, diffuse_surface

Method = Literal["auto", "fair", "diffusion", "poisson-open3d", "poisson-pymeshlab"]
MOST_EMPTY = 0.02                    # share of a good patch that may lie in space that was seen to be empty


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
    join : bool
        Whether borders that face each other, as those of a limb that was cut through, are joined by one patch.
    poisson_depth : int
        Octree depth of the Poisson methods.
    """

    method: Method = "auto"
    max_edges: Count | None = None
    density: Positive = 2 ** 0.5
    join: bool = True
    poisson_depth: Annotated[int, Range(1, 16)] = 8


class FilledHole(NamedTuple):
    """What was done about one hole."""

    centre: np.ndarray          # (3,) metres
    borders: int                # closed borders that one patch joins
    edges: int                  # their length in edges
    method: str                 # "fair" or "diffusion"
    intersections: int          # pairs of triangles, one of them new, that run through each other in the end
    in_empty: float             # share of the new vertices in space that the views saw to be empty; 0 without views

    @property
    def faults(self) -> tuple[bool, int, float]:
        """What a patch is judged by, the lower the better: too much of it where nothing can be, and the rest."""
        return self.in_empty > MOST_EMPTY, self.intersections, self.in_empty

    @property
    def is_bad(self) -> bool:
        return bool(self.intersections) or self.in_empty > MOST_EMPTY


@dataclass(frozen=True, eq=False)
class FillReport:
    """A filled mesh, whose old vertices and triangles come first, untouched, and how each hole was filled."""

    mesh: Mesh
    holes: tuple[FilledHole, ...]           # longest border first


def fill_holes(mesh: Mesh, config: FillConfig | None = None,
               progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Close the holes of a mesh.

    Each hole gets the triangulation that bends least, is refined to the size of the triangles around it, and
    faired so that it continues the surface. `fill_report` tells what was done about each.

    Parameters
    ----------
    mesh : Mesh
        Edge-manifold; borders may touch in a vertex (see `repair`).
    config : FillConfig, optional
    progress : callback(done, total), optional

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
    if config.method.startswith("poisson"):
        _check(mesh, config)
        if config.method == "poisson-open3d":
            pass
        else:
            from ..adapters.pymeshlab_filters import meshlab_poisson
        return close(meshlab_poisson(mesh, config.poisson_depth))
    return fill_report(mesh, config, progress).mesh


def fill_report(mesh: Mesh, config: FillConfig | None = None, progress: Callable[[int, int], None] | None = None,
                views: Sequence[Any] = ()) -> FillReport:
    """Close the holes of a mesh and tell how; as `fill_holes`, for the methods that keep the mesh.

    Fair patches for all holes together; then those that are not good enough one by one in a volume. The mesh was merged
    from the views, RangeView or pairs (Mesh, camera position (3,)): space they look through is left empty.

    [Liepa] triangulation, refinement, fairing
    [Davis] volumetric diffusion
    """
    config = config or FillConfig()
    _check(mesh, config)
    if config.method.startswith("poisson"):
        raise ValueError(f"config.method: {config.method} remeshes everything; there are no single holes to report")
    if not mesh.is_edge_manifold:
        raise ValueError("mesh: expected at most two triangles at an edge, facing the same way; repair it first")
    # the holes: borders, and which of them one patch joins
    mesh = split_vertices(mesh, across_holes=True)
    loops = [loop for loop in mesh.boundary_loops if len(loop) <= (config.max_edges or len(mesh.vertices))]
    if not loops:
        return FillReport(split_vertices(mesh), ())
    groups = group_loops(mesh, loops) if config.join else [[loop] for loop in loops]
    work = _Filling(mesh, config, SeenSpace(views) if len(views) else None, Rays(mesh))
    # fair patches for all of them; holes with a bad one, or all where only diffusion is wanted, are left open
    fair = list[FilledHole | None]([None] * len(groups))
    filled = mesh
    if config.method != "diffusion":
        filled = work.fair_patches(mesh, groups, progress=progress)
        fair = [*work.rate(filled, mesh, groups, "fair")]
    seen_in = config.method == "auto" and len(views) > 0
    made = {g: hole for g, hole in enumerate(fair) if hole is not None and not (seen_in and hole.is_bad)}
    if 0 < len(made) < len(groups):
        filled = work.fair_patches(mesh, [groups[g] for g in made])
    elif not made:
        filled = mesh
    # volumetric diffusion, one hole after the other
    for g, group in enumerate(groups):
        if g not in made:
            filled, made[g] = work.diffuse(filled, group, fair[g])
            if progress:
                progress(len(made), len(groups))
    return FillReport(split_vertices(filled), tuple(made[g] for g in range(len(groups))))


def filling_judgement(holes: Sequence[FilledHole], triangles: int) -> Judgement:
    """What patches of so many triangles are worth: those of views that lie over each other run through the others."""
    crossing = sum(hole.intersections for hole in holes)
    reason = (f"the patches have {triangles} triangles and run through others {crossing} times: views that overlap "
              "are to be made one surface first (scape prep merge, scape prep template)")
    # pairs that run through each other, for each new triangle: merged views of people have 0.001 and 0.003, four
    # views that lie over each other 2.5, where patches are a cape from hand to hand
    if crossing > 0.5 * triangles:
        return Judgement.of(reason)
    return Judgement.of(check=[reason] if crossing > 0.05 * triangles else [])


def close(mesh: Mesh, config: FillConfig | None = None) -> Mesh:
    """One closed manifold component: repair and fill in turns, until nothing is open or defective.

    What repair opens after the first filling is filled with fair patches.
    """
    mesh = fill_holes(repair(mesh), config)
    for _ in range(4):
        if mesh.is_closed and template_problem(mesh) is None:
            break
        mesh = fill_holes(repair(mesh))
    return mesh


def _check(mesh: Mesh, config: FillConfig) -> None:
    if not len(mesh.faces):
        raise ValueError("mesh: expected a surface with holes, got one without triangles")
    if config.method not in get_args(Method):
        raise ValueError(f"config.method: expected one of {', '.join(get_args(Method))}, got {config.method!r}")


@dataclass(frozen=True, eq=False)
class _Filling:
    """Patches for the holes of one mesh."""

    mesh: Mesh
    config: FillConfig
    seen: SeenSpace | None
    rays: Rays

    def fair_patches(self, mesh: Mesh, groups: list[list[np.ndarray]], guide: Mesh | None = None,
                     progress: Callable[[int, int], None] | None = None) -> Mesh:
        """The mesh with fair patches across some holes, drawn to a guide if there is one.

        [Liepa] triangulation, refinement, fairing
        """
        rim = np.zeros(len(mesh.vertices), dtype=bool)
        rim[np.concatenate([loop for group in groups for loop in group])] = True
        around, used = mesh.submesh(rim[mesh.faces].any(axis=1))      # all that the patches have to know
        local = np.full(len(mesh.vertices), -1)
        local[used] = np.arange(len(used))
        patch = Patch(around, rim[used])
        polygons = [join_polygons(around.vertices, [local[loop] for loop in group]) for group in groups]
        patch.triangulate(polygons, self.rays, progress)
        patch.refine(self.config.density)
        start = patch.mesh.vertices
        patch.fair()
        patch.untangle(start)
        if guide is not None and len(guide.faces):
            surface, start = Surface(guide), patch.mesh.vertices
            for _ in range(4):
                new = patch.mesh.vertices[patch.old_vertices:]
                patch.fair(surface.closest(new).points if len(new) else new, 3e3)
            patch.untangle(start)
        return patch.onto(mesh, used)

    def diffuse(self, mesh: Mesh, group: list[np.ndarray], fair: FilledHole | None
                ) -> tuple[Mesh, FilledHole]:
        """The mesh with one hole filled by diffusion, unless the fair patch was better.

        [Davis] volumetric diffusion
        """
        # the part of the mesh within four radii of the hole, and the vertices of its border there
        rim = np.concatenate(group)
        middle = mesh.vertices[rim].mean(axis=0)
        reach = 4 * np.linalg.norm(mesh.vertices[rim] - middle, axis=1).max()
        near = np.linalg.norm(mesh.corners.mean(axis=1) - middle, axis=1) < reach
        part, used = mesh.submesh(near | np.isin(mesh.faces, rim).any(axis=1))
        guide = diffuse_surface(part, np.searchsorted(used, np.unique(rim)), self.seen)
        filled = self.fair_patches(mesh, [group], guide)
        made = self.rate(filled, mesh, [group], "diffusion")[0]
        if fair is None or made.faults < fair.faults:
            return filled, made
        return self.fair_patches(mesh, [group]), fair

    def rate(self, filled: Mesh, before: Mesh, groups: list[list[np.ndarray]], method: str) -> list[FilledHole]:
        """What was done about every hole, and what is wrong with its patch."""
        old = len(before.faces)
        label = Mesh(filled.vertices, filled.faces[old:]).vertex_component
        pairs = intersecting_faces(filled, np.arange(old, len(filled.faces)))
        crossing = np.bincount(label[filled.faces[pairs.max(axis=1), 0]], minlength=label.max() + 1)
        empty = np.zeros(label.max() + 1)
        fresh = np.arange(len(self.mesh.vertices), len(filled.vertices))
        if self.seen is not None and len(fresh):
            inside = self.seen.ahead(filled.vertices[fresh]) > EMPTY
            count = np.bincount(label[fresh], minlength=len(empty))
            empty = np.bincount(label[fresh], inside, len(empty)) / np.maximum(count, 1)
        pieces = [(np.concatenate(group), len(group), label[group[0][0]]) for group in groups]
        return [FilledHole(before.vertices[rim].mean(axis=0), borders, len(rim), method, int(crossing[p]),
                           float(empty[p])) for rim, borders, p in pieces]
