"""The displacement map of a scan over a control model, and where the scan is not one-to-one with it [Statues].

The height of a pixel is where the interpolated normal crosses the scan: Eq. 19 at the pixel itself. The paper solves it
at the scan's vertices and interpolates, which is the same where the scan's triangles are small.
"""
from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csc_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from scanprep.geometry import sparse
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import OrientedPoints, Rays, Surface
from scanprep.threads import search_threads

from ...body import Progress
from ..control.model import FOLDED, HOLE, MEASURED, OUTSIDE, ControlModel, DisplacementMap
from .normal_volume import Crossings, find_crossings, interpolate, limits, not_inverted, outer_layers
from .texels import Lattice, Texels, find_texels

UNFOLDINGS = 2                       # rounds of opening folds, each of which takes as long as a small map
SPACING = 0.002                      # metres between the scan points that attract the surface over folds
# Metres that an island of less than 1 cm² in a hole may be off the surface around it: right ones in ragged holes are
# 1.4 off by the median, 4 in nine of ten; wrong ones 10 to 96 (in mm).
ISLAND = 0.005
SIZE = 1024                          # pixels of the image, each way: 2 mm on a person
REACH = 0.1                          # metres: largest height, up or down; what is farther off is another part


def bake_displacement(control: ControlModel, scan: Mesh, size: int = SIZE, progress: Progress | None = None
                      ) -> DisplacementMap:
    """Compute the displacement map, `size` pixels each way, of a scan over a control model that was fitted to it.

    ValueError for a scan without triangles, or a chart that covers no pixel.

    [Statues] Eq. 19, 20, 21
    """
    report_progress = progress or (lambda done, total: None)
    result = find_heights(control, ReadyScan(scan), size)
    report_progress(1, 2)
    texels = result.texels
    coverage = np.where(result.folded, FOLDED, np.where(result.known, MEASURED, HOLE)).astype(np.uint8)
    coverage[~texels.inside] = OUTSIDE
    heights = texels.image(result.heights.astype(np.float32))
    report_progress(2, 2)
    return DisplacementMap(heights, texels.image(coverage, OUTSIDE))


@dataclass(frozen=True, eq=False)
class ReadyScan:
    """A scan with its ray caster and its search tree, each built once."""

    mesh: Mesh

    @cached_property
    def rays(self) -> Rays:
        return Rays(self.mesh)

    @cached_property
    def surface(self) -> Surface:
        return Surface(self.mesh)


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights of the pixels of a chart: `heights` (n,) metres, `known` (n,) bool, not filled; `folded` (n,) bool."""

    texels: Texels
    heights: np.ndarray
    known: np.ndarray
    folded: np.ndarray


def find_heights(control: ControlModel, scan: ReadyScan, size: int) -> Heights:
    """Measure, classify and fill the heights; arguments and errors as of `bake_displacement`."""
    import igl

    if not len(scan.mesh.faces):
        raise ValueError(f"scan: expected at least one triangle, got {scan.mesh}")
    mesh, texels = control.mesh, find_texels(control.mesh, control.chart, size)
    if not texels.inside.any():
        raise ValueError(f"size: {size} pixels are too few, no pixel's centre lies in the chart")
    # 1. crossings of each pixel's normal with the scan, without other body parts and inverted triangles
    points, normals = interpolate(mesh, texels.faces, texels.bary)
    met = outer_layers(find_crossings(scan.mesh, scan.rays, points, normals, REACH))
    low, high = limits(mesh, points, normals, REACH)
    owner = met.normal
    far = met.heights * np.linalg.norm(normals[owner], axis=1)
    met = met.pick((met.cosines > 0.1) & (far >= low[owner]) & (far <= high[owner])
                   & not_inverted(mesh, texels.faces[owner], texels.bary[owner], met.heights))
    several = np.bincount(met.normal, minlength=len(points)) > 1
    heights = _choose(met, several, texels.neighbours())
    known, folded, alone = _sort(control, texels, heights, several)
    # 2. pixels without a height: inside the scan they are folds; outside they are holes, unless the surface is near.
    # They are holes too where the nearest surface is a border of the scan or out of reach.
    empty = np.flatnonzero(~known & ~folded)
    if len(empty):
        nearest = scan.surface.closest(points[empty])
        ends = np.isin(scan.mesh.faces[nearest.faces], scan.mesh.boundary_vertices).any(axis=1)
        inside = np.asarray(igl.fast_winding_number(scan.mesh.vertices, scan.mesh.faces, points[empty])).ravel() > 0.5
        folded[empty] = ~((nearest.distances > REACH) | ends | (~inside & (nearest.distances > 0.01)))
    # 3. fill from around: harmonic on the control surface, so across seams too. Islands in holes that stand off what is
    # around the hole are crossings with another side of the scan, and would be thorns.
    lattice, filled = Lattice(control), heights.copy()
    values, sure = lattice.gather(texels, heights, known & ~alone)
    values = sparse.harmonic(lattice.fine.vertex_adjacency, values[:, None], sure)[:, 0]
    rest = np.flatnonzero(~known | alone)
    filled[rest] = lattice.sample(values, texels.faces[rest], texels.bary[rest])
    thorns = alone & (np.abs(heights - filled) > ISLAND)
    known, folded = known & ~thorns, folded & ~thorns
    filled[known] = heights[known]
    return Heights(texels, filled, known, folded)


def unfold_control(control: ControlModel, scan: Mesh, size: int = SIZE) -> ControlModel:
    """Open the folds of a fitted control model: move vertices in folds onto the scan.

    Where the fit left the control mesh inside the scan, as in an armpit that is too high, no height reaches the
    surface. A round is kept only if less of the control mesh than before is folded or a hole.
    """
    best, before, ready = control, np.inf, ReadyScan(scan)
    for number in range(UNFOLDINGS + 1):
        found = find_heights(control, ready, min(size, 512))
        bad = (found.folded | ~found.known) & found.texels.inside
        without = float(texel_areas(control, found.texels)[bad].sum() / control.mesh.face_areas.sum())
        if without >= before:
            break
        best, before = control, without
        if number < UNFOLDINGS and without > 0:
            drawn, u = bend_over_folds(Lattice(control), ready, found)
            count = len(control.mesh.vertices)                   # the first of the lattice
            moved = np.where(drawn[:count, None], u[:count], 0)
            control = replace(control, mesh=control.mesh.with_vertices(control.mesh.vertices + moved))
    return best


def _choose(found: Crossings, several: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Choose among several crossings the one that continues the neighbouring pixels, from single crossings inwards."""
    heights = np.full(len(several), np.nan)
    single = ~several[found.normal]
    heights[found.normal[single]] = found.heights[single]
    rest = found.pick(~single)
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    pairs = pairs[several[pairs[:, 0]]]
    while len(rest.normal):
        usable = np.isnan(heights[pairs[:, 0]]) & ~np.isnan(heights[pairs[:, 1]])
        a, b = pairs[usable].T
        count = np.bincount(a, minlength=len(several))
        if not count.any():
            wanted, ready = np.zeros(len(several)), np.isnan(heights)           # a patch without single crossings
        else:
            wanted = np.bincount(a, heights[b], len(several)) / np.maximum(count, 1)
            ready = count > 0
        now = rest.pick(ready[rest.normal])
        order = np.argsort(-np.abs(now.heights - wanted[now.normal]), kind="stable")        # the best written last
        heights[now.normal[order]] = now.heights[order]
        rest = rest.pick(~ready[rest.normal])
        pairs = pairs[np.isnan(heights[pairs[:, 0]])]
    return heights


def _sort(control: ControlModel, texels: Texels, heights: np.ndarray, several: np.ndarray
          ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Classify pixels (n,): which keep their height, which lie in folds, and which are islands in a hole.

    Neighbours whose heights differ by more than three times their distance are torn apart. Patches of less than 1 cm²
    between such tears are dropped and filled; those in a hole are islands.
    """
    points, _ = interpolate(control.mesh, texels.faces, texels.bary)
    a, b = texels.neighbours().T
    both = ~np.isnan(heights[a]) & ~np.isnan(heights[b])
    a, b = a[both], b[both]
    apart = np.linalg.norm(points[a] - points[b], axis=1)
    # steps of less than 3 mm are noise, or views that differ
    jump = np.abs(heights[a] - heights[b]) > np.maximum(3.0 * apart, 0.003)
    patch = sparse.label_components(a[~jump], b[~jump], len(heights))
    beside = np.zeros(len(heights), dtype=bool)
    beside[a[jump]] = beside[b[jump]] = True
    area = np.bincount(patch, texel_areas(control, texels))
    torn = np.bincount(patch, beside) > 0
    dropped = (torn & (area < 1e-4))[patch] & ~np.isnan(heights)
    alone = (~torn & (area < min(1e-4, area.max())))[patch] & ~np.isnan(heights)
    known = ~np.isnan(heights) & ~dropped
    return known, dropped | (known & (beside | several)), alone


def texel_areas(control: ControlModel, texels: Texels) -> np.ndarray:
    """Compute the area (n,), square metres, of the control mesh that each pixel covers."""
    pixel = control.chart.flat.face_areas * texels.size**2
    return (control.mesh.face_areas / np.maximum(pixel, 1e-12))[texels.faces]


def bend_over_folds(lattice: Lattice, scan: ReadyScan, found: Heights) -> tuple[np.ndarray, np.ndarray]:
    """Bend the surface over folds onto the scan: which fine vertices (n,) moved, and displacements (n, 3), metres.

    Each vertex is attracted to the closest scan point with a compatible normal, and held by a thin-plate energy. That
    is solved by implicit steps and made softer from step to step. Around folds the surface stays where the heights say.
    """
    fine = lattice.fine
    near = fine.vertex_adjacency
    # from heights that are smooth across folds
    values, sure = lattice.gather(found.texels, found.heights, found.known)
    heights = sparse.harmonic(near, values[:, None], sure)[:, 0]
    p, n = interpolate(lattice.control.mesh, lattice.subdivision.parent, lattice.subdivision.bary)
    start = p + heights[:, None] * n
    drawn = ~lattice.gather(found.texels, found.heights, ~found.folded)[1]
    for _ in range(5):    # vertices around a fold that are drawn with it
        drawn = drawn | (near @ drawn.astype(float) > 0)
    free = np.flatnonzero(drawn)
    if not len(free):
        return drawn, start - p
    places, facing = _places(scan.mesh, start[free])
    if not len(places):
        return drawn, start - p
    # thin-plate energy of the free vertices, and the pull of the fixed ones around them
    used = np.flatnonzero(drawn[fine.faces].any(axis=1))
    L = csr_array(diags_array(1 / near.sum(axis=1)) @ near - diags_array(np.ones(len(p))))
    held = start.copy()
    held[free] = 0
    of_free = csc_array(L)[:, free]
    bending, pull = csc_array(of_free.T @ of_free), -of_free.T @ (L @ held)
    target = OrientedPoints(places, facing, 0.01)    # metres that a change of the normal by 60 degrees is worth
    surface = start.copy()
    for stiffness in (100.0, 30.0, 10.0, 3.0, 1.0, 0.3, 0.1, 0.03):    # of the thin plate
        for _ in range(3):
            normals = Mesh(surface, fine.faces[used]).vertex_normals[free]
            match = target.match(surface[free], normals, REACH, 0.3)
            # into the planes through the matches, and no farther than SPACING from these
            q, m = places[match.index], facing[match.index]
            slip = surface[free] - q
            slip = slip - np.einsum("nd,nd->n", slip, m)[:, None] * m
            onto = q + slip * np.minimum(1, SPACING / np.maximum(np.linalg.norm(slip, axis=1), 1e-12))[:, None]
            w = np.where(match.valid, 1.0, 0.001)[:, None]    # lightly held where nothing matches
            wanted = np.where(match.valid[:, None], onto, surface[free])
            solver = sparse.Factored(csc_array(stiffness * bending + diags_array(w[:, 0])))
            surface[free] = solver.solve(w * wanted + stiffness * pull)
    # keep only patches that came nearer to the scan, in the mean square
    only = diags_array(drawn.astype(float))
    _, patch = connected_components(only @ near @ only, directed=False)
    faces = fine.faces[drawn[fine.faces].all(axis=1)]
    of, error = patch[faces[:, 0]], []
    for vertices in (start, surface):
        there = Mesh(vertices, faces)
        far = scan.surface.closest(there.corners.mean(axis=1)).distances
        area = np.bincount(of, there.face_areas, len(patch))
        error.append(np.bincount(of, there.face_areas * far**2, len(patch)) / np.maximum(area, 1e-30))
    better = (error[1] < error[0])[patch]
    return drawn & better, np.where(better[:, None], surface, start) - p


def _places(scan: Mesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample the scan within reach of points, one point (m, 3) for a square of SPACING, with normals (m, 3)."""
    middle = scan.corners.mean(axis=1)
    far = REACH + np.sqrt(((scan.corners[:, 0] - middle)**2).sum(axis=1).max())
    apart, _ = cKDTree(points).query(middle, distance_upper_bound=far, workers=search_threads(len(middle)))
    around = scan.submesh(np.flatnonzero(np.isfinite(apart)))[0]
    if not len(around.faces) or not around.face_areas.sum():
        return np.zeros((0, 3)), np.zeros((0, 3))
    count = int(np.ceil(around.face_areas.sum() / SPACING**2))
    places, faces, _ = around.sample(count, np.random.default_rng(0))
    return places, around.face_normals[faces]


def coverage_shares(control: ControlModel, map: DisplacementMap) -> dict[str, float]:
    """Compute the shares of the control mesh's area that are measured, folded and holes."""
    texels = find_texels(control.mesh, control.chart, len(map.coverage))
    kind, area = map.coverage.ravel()[texels.pixels[texels.inside]], texel_areas(control, texels)[texels.inside]
    return {name: float(area[kind == value].sum() / area.sum())
            for name, value in (("measured", MEASURED), ("folded", FOLDED), ("hole", HOLE))}
