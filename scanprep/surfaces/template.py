"""Make the template of all registrations from one scan of a subject, or from range views."""
from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from ..alignment.views import AlignViewsConfig, align_views
from ..cleaning.clean_scan import clean_scan
from ..decimation.decimate import DecimateConfig, decimate
from ..fusion.tsdf import MergeConfig, merge_views
from ..geometry.files import PointCloud
from ..geometry.mesh import Mesh, check_template, take_any_mesh, template_problem
from ..geometry.remeshing import improve_triangles, smooth_taubin
from ..geometry.surface import Surface
from ..judgement import Judgement
from ..registration.lead import find_scanned_person
from ..registration.nonrigid import share_uncovered
from ..repair.graft import graft
from ..repair.handles import count_handles, cut_handles
from ..repair.hole_filling import close
from ..repair.manifold import drop_thin, repair
from ..skeleton.symmetry import find_symmetry
from ..words import describe_result, number_of
from .cloud import AWAY, mesh_of_cloud, mesh_of_view

# A view of a scanner is merged with a shorter truncation than by default, as fingers are thin, and without the surface
# that it saw at a grazing angle.
MERGE = MergeConfig(voxel=0.004, truncation=2.0, min_cosine=0.15)
DECIMATE = DecimateConfig(method="quadric", improve=True)
SMOOTHING = 6                        # rounds, before and again after holes are filled: smooth borders give fair patches
THINNEST = 0.007                     # metres: thinner parts are poorly seen fingers, and are removed
LOST = 0.008                         # metres: what is farther off a template was lost, half the thickness of a finger


def template_of_views(views: Sequence[Any], faces: int = 14000,
                      progress: Callable[[int, int], None] | None = None, voxel: float = MERGE.voxel) -> Mesh:
    """Make a closed manifold mesh from range views of one subject: merge, repair, smooth, fill, decimate.

    Views are RangeViews or pairs of a Mesh and a camera position (3,). They are merged in voxels of an edge length,
    metres. ValueError if the result cannot serve as a
    template.
    """
    merged = merge_views(views, replace(MERGE, voxel=voxel))
    return _finish(merged, faces, progress, "the merged views", voxel=voxel).mesh


@dataclass(frozen=True, eq=False)
class MadeTemplate:
    """A template, with a report of how it was made."""

    mesh: Mesh
    notes: tuple[str, ...]              # one sentence each
    filled: float                       # share of the surface without scan data
    handles: int                        # topological handles, as between thighs that touch
    balance: float | None               # share of the triangles on the left side; None without symmetry
    lost: float = 0.0                   # share of the scanned surface that is more than 8 mm off the template
    landmarks: dict[str, int] = field(default_factory=dict)         # name -> vertex, where a person was found
    __repr__ = describe_result

    @property
    def judgement(self) -> Judgement:
        """Whether scans can be registered with it."""
        return Judgement.of(check=self.doubts)

    @property
    def doubts(self) -> list[str]:
        """What needs a look before scans are registered with it: much filled or lost, or handles."""
        return [*([f"{100 * self.filled:.0f}% of the surface is filled, nothing was scanned there"]
                  if self.filled > 0.05 else []),
                # a finger has 0.4% of a person's surface
                *([f"{100 * self.lost:.1f}% of the scan is more than 8 mm off the template: thin parts, as fingers, "
                   "were lost, so ask for more --faces"] if self.lost > 0.004 else []),
                *([f"the surface is joined to itself in {number_of(self.handles, 'place')}: thighs, armpits or "
                   "fingers that touch"]
                  if self.handles else [])]


@take_any_mesh
def make_template(scans: Mesh | PointCloud | Sequence[Mesh | PointCloud], faces: int = 14000,
                  progress: Callable[[int, int], None] | None = None) -> MadeTemplate:
    """Make the template of all registrations from your best scan, as `scape prep template` does.

    The body is taken alone, repaired, its holes filled, and decimated. Where the built-in people come to lie on it, it
    gets their landmarks, and what the scan lacks, such as finger tips.

    Parameters
    ----------
    scans : Mesh or PointCloud, metres, or a sequence of these
        One scan of the whole body; or views of one moment, which are aligned and merged.
    faces : int
        Triangles of the template.
    progress : callable, optional
        Called as progress(done, total).

    Returns
    -------
    MadeTemplate
        The `mesh`, its `landmarks`, `notes` on how it was made, and a `judgement`.

    Raises
    ------
    ValueError
        The result cannot serve as a template, or views do not overlap.

    Examples
    --------
    >>> from scanprep import Mesh
    >>> t, p = np.meshgrid(np.linspace(0, np.pi, 30), np.linspace(0, 2 * np.pi, 61)[:-1], indexing="ij")
    >>> ball = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1).reshape(-1, 3)
    >>> a = (np.arange(29)[:, None] * 60 + np.arange(60)).ravel()
    >>> b = (np.arange(29)[:, None] * 60 + (np.arange(60) + 1) % 60).ravel()
    >>> scan = Mesh(ball, np.concatenate([np.stack([a, a + 60, b], 1), np.stack([b, a + 60, b + 60], 1)]))
    >>> made = make_template(scan, 500)
    >>> made.mesh.is_closed, len(made.mesh.faces)
    (True, 500)

    [Liepa], [QEM]
    """
    scan = scans if isinstance(scans, Mesh | PointCloud) else views_without_cameras(scans)
    person = find_scanned_person(scan.vertices if isinstance(scan, Mesh) else scan.points)
    if person is None:
        return template_of_scan(scan, faces, progress=progress)
    body, named = person
    made = template_of_scan(scan, faces, progress=progress, person=body)
    return replace(made, landmarks=carry_landmarks({name: body.vertices[v] for name, v in named.items()}, made.mesh)[0])


def template_of_scan(scan: Mesh | PointCloud, faces: int = 14000, landmarks: np.ndarray | None = None,
                     progress: Callable[[int, int], None] | None = None, person: Mesh | None = None) -> MadeTemplate:
    """Make a closed manifold mesh from one scan of a whole body: clean, repair, fill, decimate.

    Parameters
    ----------
    scan : Mesh or PointCloud, metres
        Points, and meshes with overlapping views, are meshed anew.
    faces : int
        Triangles of the template.
    landmarks : (L, 3) float, metres, optional
        Points on the body, if it is not the largest piece of the scan.
    progress : callable, optional
        Called as progress(done, total).
    person : Mesh, metres, optional
        A body that lies on the scan. What the scan lacks of it, such as a finger tip, is taken from it.

    Returns
    -------
    MadeTemplate

    Raises
    ------
    ValueError
        The result cannot serve as a template.

    [Liepa] hole filling; [QEM] pair contraction
    """
    points = scan.vertices if isinstance(scan, Mesh) else scan.points
    kept = clean_scan(scan if isinstance(scan, Mesh) else points, landmarks=landmarks).kept
    notes = [] if kept.all() else [f"{(~kept).sum()} of {len(kept)} points were no part of the body"]
    if isinstance(scan, Mesh):
        body = scan.submesh(kept[scan.faces].all(axis=1))[0]
        mesh = repair(body)
        # in a single mesh at least 0.9 of the surface is connected; overlapping views are meshed anew
        if mesh.face_areas.sum() < 0.9 * body.face_areas.sum():
            notes.append("its pieces lie side by side or over each other: their points were meshed anew")
            mesh = mesh_of_cloud(PointCloud(body.vertices, body.vertex_normals))
        elif template_problem(body):
            notes.append(f"repaired: {template_problem(body)}")
    else:
        normals = None if scan.normals is None else scan.normals[kept]
        mesh = mesh_of_cloud(PointCloud(points[kept], normals))
        notes.append("points without triangles were meshed")
    made = _finish(mesh, faces, progress, "the scan", landmarks, person)
    return replace(made, notes=(*notes, *made.notes), lost=share_lost(mesh, made.mesh))


def share_lost(scanned: Mesh, template: Mesh) -> float:
    """Compute the share of a scanned surface that its template lost: that lies too far off it.

    A coarse template was asked for coarse: what lies within half an edge of it could not be nearer.
    """
    return share_uncovered(scanned, template, max(LOST, 0.5 * template.mean_edge))


def views_without_cameras(views: Sequence[Mesh | PointCloud]) -> PointCloud:
    """Align range views without known cameras; return their points and normals as one cloud.

    They must lie within a few centimetres and degrees of their true poses. ValueError for a view that overlaps too
    little with the others.
    """
    placed = []
    for view in views:
        if isinstance(view, Mesh):
            ahead = view.vertex_normals.mean(axis=0)
            placed.append((view, view.vertices.mean(axis=0) + AWAY * ahead / max(np.linalg.norm(ahead), 1e-12)))
        else:
            placed.append(mesh_of_view(view))
    aligned = align_views(placed)
    apart = aligned.overlap < AlignViewsConfig().min_overlap
    if len(views) > 1 and apart.any():
        raise ValueError(f"view {int(apart.argmax()) + 1} shares {100 * aligned.overlap.min():.0f}% of its surface "
                         "with the others; views need about a fifth in common: leave it out, or align the views first "
                         "(scape prep views, with landmarks)")
    meshes = [mesh for mesh, _ in aligned.views]
    return PointCloud(np.concatenate([mesh.vertices for mesh in meshes]),
                      np.concatenate([mesh.vertex_normals for mesh in meshes]))


def _finish(mesh: Mesh, faces: int, progress: Callable[[int, int], None] | None, what: str,
            landmarks: np.ndarray | None = None, person: Mesh | None = None, voxel: float = MERGE.voxel
            ) -> MadeTemplate:
    """Smooth, fill and decimate an open surface; vertices at landmarks (L, 3), such as fingertips, stay.

    What the surface lacks of a `person` is taken from there.
    """
    report_progress, notes = progress or (lambda done, total: None), list[str]()
    report_progress(1, 4)
    mesh = repair(mesh)
    # the same smoothing length as on merged views: on coarse scans as many rounds would round off fingers
    rounds = min(SMOOTHING, round(SMOOTHING * (voxel / mesh.mean_edge)**2))
    scanned = mesh = smooth_taubin(mesh, rounds)                        # smooth borders give fair patches
    if person is not None:
        import igl

        # triangles of a sixteenth, as fine as those of a scan
        fine = Mesh(*igl.upsample(np.array(person.vertices), np.array(person.faces), 2))
        mesh, pieces = graft(mesh, close(mesh), fine)
        if pieces:
            notes.append(f"{number_of(pieces, 'piece')} that the scan lacks, such as finger tips or toes, "
                         f"{'is' if pieces == 1 else 'are'} of the built-in people's body")
    holes = len(mesh.boundary_loops)
    if holes:
        notes.append(f"{number_of(holes, 'hole was', 'holes were')} filled")
    report_progress(2, 4)
    mesh = close(mesh)
    if person is None:                                   # a body that was joined has no other thin parts than people
        mesh = close(drop_thin(mesh, THINNEST))
    joined, mesh = count_handles(mesh), cut_handles(mesh)
    apart = joined - count_handles(mesh)
    if apart:
        notes.append(f"{number_of(apart, 'bridge was', 'bridges were')} cut, or the opening beside it closed, where "
                     "thin parts such as fingers touch")
    mesh = smooth_taubin(mesh, rounds)
    report_progress(3, 4)
    surface = Surface(mesh)
    if mesh.volume < 0:
        mesh = Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), mesh.colors)
    keep = None if landmarks is None else np.unique(cKDTree(mesh.vertices).query(landmarks)[1])
    small = _improve(decimate(mesh, faces, DECIMATE, keep), surface, keep)
    balance = share_on_left(small)
    # one side may have at most 3% more of the triangles than its area suggests
    if balance is not None and abs(balance - 0.5) > 0.03:
        # least-error collapses may spend triangles on the noise of one side; shortest-edge collapses do not, but are
        # taken only where they cut off no hand: 0.001 of the surface are the tips of three fingers
        even = _improve(decimate(mesh, faces, replace(DECIMATE, method="even")), surface, keep)
        evened = share_on_left(even) or 0.5
        if abs(evened - 0.5) < abs(balance - 0.5) and share_lost(mesh, even) < share_lost(mesh, small) + 0.001:
            notes.append(f"{100 * balance:.0f}% of the triangles were on the left side; made even, {100 * evened:.0f}% "
                         "are")
            small, balance = even, evened
    if template_problem(small):                                  # decimation left a degenerate triangle
        small = close(small)
    check_template(small, what)
    far = Surface(scanned).closest(small.corners.mean(axis=1)).distances > scanned.mean_edge
    report_progress(4, 4)
    # triangles farther from the scan than its mean edge are filled
    return MadeTemplate(small, tuple(notes), float(small.face_areas[far].sum() / small.face_areas.sum()),
                        count_handles(small), balance)


def _improve(mesh: Mesh, surface: Surface, keep: np.ndarray | None) -> Mesh:
    """Improve the shape of triangles; vertices `keep` (L,) of the surface stay vertices of the mesh."""
    if keep is None:
        return improve_triangles(mesh, surface)
    nearest, which = np.unique(cKDTree(mesh.vertices).query(surface.mesh.vertices[keep])[1], return_index=True)
    vertices = mesh.vertices.copy()
    vertices[nearest] = surface.mesh.vertices[keep[which]]
    return improve_triangles(mesh.with_vertices(vertices), surface, nearest)


def carry_landmarks(places: Mapping[str, np.ndarray], mesh: Mesh) -> tuple[dict[str, int], dict[str, float]]:
    """Find the vertices nearest to landmarks (3,), and the distances, metres, of landmarks off the surface."""
    if not places:
        return {}, {}
    points = np.array(list(places.values()))
    away, vertices = Surface(mesh).closest(points).distances, cKDTree(mesh.vertices).query(points)[1]
    # a landmark more than 1 cm off was clicked on something else
    return (dict(zip(places, vertices.tolist(), strict=True)),
            {name: float(d) for name, d in zip(places, away, strict=True) if d > 0.01})


def share_on_left(mesh: Mesh) -> float | None:
    """Compute the share of triangles on one side of the symmetry plane, corrected for area; None without symmetry."""
    symmetry = find_symmetry(mesh)
    if not symmetry.holds or not symmetry.two_sided:
        return None
    by_area = float(mesh.face_areas[symmetry.left].sum() / mesh.face_areas.sum())
    return float(symmetry.left.mean()) - by_area + 0.5              # by area, as poses are not symmetric
