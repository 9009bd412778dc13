"""Fill holes with fair patches [Liepa], or along a surface diffused through a volume [Davis]."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..geometry.mesh import Mesh, take_any_mesh, template_problem
from ..geometry.surface import Rays, SeenSpace, Surface
from ..judgement import Judgement
from ..ranges import Count, Settings
from .hole_patch import Patch
from .intersections import intersecting_faces
from .loops import group_loops, join_polygons
from .manifold import repair, split_vertices
from .volumetric_diffusion import EMPTY, diffuse_surface

MOST_EMPTY = 0.02                    # largest share of a good patch in free space; a worse one is tried again


@dataclass(frozen=True)
class FillConfig(Settings):
    """Settings of `fill_holes`.

    Attributes
    ----------
    max_edges : int, optional
        Holes with longer borders stay open.
    join : bool
        Whether borders that face each other, as at a limb that was cut through, are joined by one patch.

    Examples
    --------
    >>> FillConfig(max_edges=200).join
    True
    """

    max_edges: Count | None = None
    join: bool = True


class FilledHole(NamedTuple):
    """How one hole was filled."""

    centre: np.ndarray          # (3,) metres
    edges: int                  # their length in edges
    method: str                 # "fair" or "diffusion"
    intersections: int          # pairs of intersecting triangles, one of them new
    in_empty: float             # share of the new vertices that violate free space; 0 without views

    @property
    def faults(self) -> tuple[bool, int, float]:
        """Faults of a patch, lower is better: too much in free space, intersections, share in free space."""
        return self.in_empty > MOST_EMPTY, self.intersections, self.in_empty

    @property
    def is_bad(self) -> bool:
        """Whether the patch intersects something or violates free space."""
        return bool(self.intersections) or self.in_empty > MOST_EMPTY


@dataclass(frozen=True, eq=False)
class FillReport:
    """A filled mesh, with the old vertices and triangles first and unchanged, and how each hole was filled."""

    mesh: Mesh
    holes: tuple[FilledHole, ...]           # longest border first


@take_any_mesh
def fill_holes(mesh: Mesh, config: FillConfig | None = None,
               progress: Callable[[int, int], None] | None = None) -> Mesh:
    """Close the holes of a mesh.

    Each hole gets the triangulation that bends least. It is refined to the size of the triangles around it, and faired
    so that it continues the surface. `fill_report` also reports how each hole was filled.

    Parameters
    ----------
    mesh : Mesh
        Edge-manifold; borders may touch in a vertex (see `repair`).
    config : FillConfig, optional
        Settings.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    Mesh
        Vertices in metres. The vertices and triangles of `mesh` come first, unchanged. Vertices where separate sheets
        touch are duplicated.

    Raises
    ------
    ValueError
        The mesh is empty or not manifold along its edges.

    Examples
    --------
    >>> open_box = Mesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], [
    ...     [0, 2, 1], [0, 3, 2], [0, 1, 5], [0, 5, 4], [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4],
    ...     [3, 4, 7]])
    >>> open_box.is_closed, fill_holes(open_box).is_closed
    (False, True)

    [Liepa] triangulation, refinement, fairing
    [Davis] volumetric diffusion
    """
    return fill_report(mesh, config, progress).mesh


def fill_report(mesh: Mesh, config: FillConfig | None = None, progress: Callable[[int, int], None] | None = None,
                views: Sequence[Any] = ()) -> FillReport:
    """Close the holes of a mesh and report how; like `fill_holes`.

    Fair patches fill all holes together. `views` are those that the mesh was merged from, RangeView or pairs (Mesh,
    camera position (3,)): their free space stays empty. With them, holes with bad patches are filled one by one in a
    volume. Without lines of sight diffusion was never better on the holes that we measured, and it is slow.

    [Liepa] triangulation, refinement, fairing
    [Davis] volumetric diffusion
    """
    config = config or FillConfig()
    if not len(mesh.faces):
        raise ValueError("mesh: expected a surface with holes, got one without triangles")
    if not mesh.is_edge_manifold:
        raise ValueError("mesh: expected at most two triangles at an edge, facing the same way; repair it first")
    # find the borders, and group those that one patch joins
    mesh = split_vertices(mesh, across_holes=True)
    loops = [loop for loop in mesh.boundary_loops if len(loop) <= (config.max_edges or len(mesh.vertices))]
    if not loops:
        return FillReport(split_vertices(mesh), ())
    groups = group_loops(mesh, loops) if config.join else [[loop] for loop in loops]
    work = _Filling(mesh, SeenSpace(views) if len(views) else None, Rays(mesh))
    # fair patches for all holes; with lines of sight, those with a bad patch are left open
    filled = work.fair_patches(mesh, groups, progress=progress)
    fair = work.rate(filled, mesh, groups, "fair")
    done = {g: hole for g, hole in enumerate(fair) if not len(views) or not hole.is_bad}
    if 0 < len(done) < len(groups):
        filled = work.fair_patches(mesh, [groups[g] for g in done])
    elif not done:
        filled = mesh
    # volumetric diffusion for the others, one by one
    for g, group in enumerate(groups):
        if g not in done:
            filled, done[g] = work.diffuse(filled, group, fair[g])
            if progress:
                progress(len(done), len(groups))
    return FillReport(split_vertices(filled), tuple(done[g] for g in range(len(groups))))


def filling_judgement(holes: Sequence[FilledHole], triangles: int) -> Judgement:
    """Judge patches with `triangles` triangles; patches across overlapping views intersect other triangles."""
    crossing = sum(hole.intersections for hole in holes)
    reason = (f"the patches have {triangles} triangles and run through others {crossing} times: views that overlap "
              "are to be made one surface first (scape prep merge, scape prep template)")
    # intersections per new triangle: merged views of people have 0.001 and 0.003. Four overlapping views have 2.5, with
    # patches like a cape from hand to hand.
    if crossing > 0.5 * triangles:
        return Judgement.of(reason)
    return Judgement.of(check=[reason] if crossing > 0.05 * triangles else [])


def close(mesh: Mesh, config: FillConfig | None = None) -> Mesh:
    """Make one closed manifold component: repair and fill in turns until nothing is open or defective.

    Holes that repair opens after the first filling get fair patches.
    """
    mesh = fill_holes(repair(mesh), config)
    for _ in range(4):
        if mesh.is_closed and template_problem(mesh) is None:
            break
        mesh = fill_holes(repair(mesh))
    return mesh


@dataclass(frozen=True, eq=False)
class _Filling:
    """Makes patches for the holes of one mesh, and rates them."""

    mesh: Mesh
    seen: SeenSpace | None
    rays: Rays

    def fair_patches(self, mesh: Mesh, groups: list[list[np.ndarray]], guide: Mesh | None = None,
                     progress: Callable[[int, int], None] | None = None) -> Mesh:
        """Fill some holes with fair patches, pulled to a guide surface if there is one.

        [Liepa] triangulation, refinement, fairing
        """
        rim = np.zeros(len(mesh.vertices), dtype=bool)
        rim[np.concatenate([loop for group in groups for loop in group])] = True
        around, used = mesh.submesh(rim[mesh.faces].any(axis=1))      # a patch depends on these triangles only
        local = np.full(len(mesh.vertices), -1)
        local[used] = np.arange(len(used))
        patch = Patch(around, rim[used])
        polygons = [join_polygons(around.vertices, [local[loop] for loop in group]) for group in groups]
        # triangulate, refine, fair, and undo fairing where it makes intersections
        patch.triangulate(polygons, self.rays, progress)
        patch.refine()
        start = patch.mesh.vertices
        patch.fair()
        patch.untangle(start)
        if guide is not None and len(guide.faces):
            surface, start = Surface(guide), patch.mesh.vertices
            for _ in range(4):                     # alternate closest points on the guide and fairing with a pull
                new = patch.mesh.vertices[patch.old_vertices:]
                patch.fair(surface.closest(new).points if len(new) else new, 3e3)
            patch.untangle(start)
        return patch.onto(mesh, used)

    def diffuse(self, mesh: Mesh, group: list[np.ndarray], fair: FilledHole) -> tuple[Mesh, FilledHole]:
        """Fill one hole by diffusion, unless the fair patch is better.

        [Davis] volumetric diffusion
        """
        # the guide depends on the mesh within four radii of the hole
        rim = np.concatenate(group)
        middle = mesh.vertices[rim].mean(axis=0)
        reach = 4 * np.linalg.norm(mesh.vertices[rim] - middle, axis=1).max()
        near = np.linalg.norm(mesh.corners.mean(axis=1) - middle, axis=1) < reach
        part, used = mesh.submesh(near | np.isin(mesh.faces, rim).any(axis=1))
        guide = diffuse_surface(part, np.searchsorted(used, np.unique(rim)), self.seen)
        filled = self.fair_patches(mesh, [group], guide)
        diffused = self.rate(filled, mesh, [group], "diffusion")[0]
        if diffused.faults < fair.faults:
            return filled, diffused
        return self.fair_patches(mesh, [group]), fair

    def rate(self, filled: Mesh, before: Mesh, groups: list[list[np.ndarray]], method: str) -> list[FilledHole]:
        """Report how every hole was filled, with the faults of its patch."""
        old = len(before.faces)
        # every patch is one component of the new triangles
        label = Mesh(filled.vertices, filled.faces[old:]).vertex_component
        pairs = intersecting_faces(filled, np.arange(old, len(filled.faces)))
        crossing = np.bincount(label[filled.faces[pairs.max(axis=1), 0]], minlength=label.max() + 1)
        empty = np.zeros(label.max() + 1)
        fresh = np.arange(len(self.mesh.vertices), len(filled.vertices))
        if self.seen is not None and len(fresh):
            inside = self.seen.ahead(filled.vertices[fresh]) > EMPTY
            count = np.bincount(label[fresh], minlength=len(empty))
            empty = np.bincount(label[fresh], inside, len(empty)) / np.maximum(count, 1)
        pieces = [(np.concatenate(group), label[group[0][0]]) for group in groups]
        return [FilledHole(before.vertices[rim].mean(axis=0), len(rim), method, int(crossing[p]), float(empty[p]))
                for rim, p in pieces]
