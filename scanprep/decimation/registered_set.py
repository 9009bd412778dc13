"""One decimation for a whole registered set: the same collapses on every mesh."""
from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from ..geometry import rotations
from ..geometry.farthest_points import farthest_points
from ..geometry.mesh import Mesh, check_template
from ..ranges import Count, Settings
from ..skeleton.tree import Skeleton
from .edge_collapse import FIXED, RoundsConfig
from .quadrics import lowest, sum_at, surface_quadrics
from .start import begin, checked_vertices, held_curves, kept_curves

Progress = Callable[[int, int], None]
PLACEMENTS = ("vertices", "solved")


@dataclass(frozen=True)
class DecimateSetConfig(Settings):
    """Settings of `decimate_set`.

    Attributes
    ----------
    meshes : int
        How many meshes, as different as possible, the cost of a collapse is summed over; 1 for the template alone.
    placement : str
        "vertices": every vertex of the small meshes is one of the large ones, so that the map of vertices is exact.
        "solved": every mesh has its vertices where its own error is least, which is nearer to the surface by a third,
        but a vertex slides a little along the skin from mesh to mesh, and the map only says which ones it stands for.
    anchor : float
        For "solved": weight of the distance to the vertices it stands for beside that to their planes; large lets
        it slide less.
    rounds : RoundsConfig
        Settings of the collapses.
    """

    meshes: Count = 8
    placement: Literal["vertices", "solved"] = "vertices"
    anchor: float = 0.03
    rounds: RoundsConfig = field(default_factory=RoundsConfig)


@dataclass(frozen=True, eq=False)
class DecimatedSet:
    """How meshes of one topology get fewer triangles.

    Attributes
    ----------
    template : Mesh
    vertex_map : (n,) int
        The original vertex of every one that was kept.
    owner : (N,) int
        The new vertex that stands for each original one.
    face_map : (f,) int
        The original triangle of every one that was kept: what labels of triangles are carried with.
    skeleton : Skeleton or None
    source : Mesh
        The template before.
    labels : (F,) int or None
        Parts of the triangles before.
    fixed : (n,) bool
        New vertices that stay on the original one in any case.
    config : DecimateSetConfig
    """

    template: Mesh
    vertex_map: np.ndarray
    owner: np.ndarray
    face_map: np.ndarray
    skeleton: Skeleton | None
    source: Mesh
    labels: np.ndarray | None
    fixed: np.ndarray
    config: DecimateSetConfig

    def carry(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices (..., n, 3) of small meshes for those (..., N, 3) of large ones, metres."""
        vertices = np.asarray(vertices, dtype=np.float64)
        if vertices.shape[-2:] != self.source.vertices.shape:
            raise ValueError(f"vertices: expected shape (..., {len(self.source.vertices)}, 3), got {vertices.shape}")
        kept = vertices[..., self.vertex_map, :]
        if self.config.placement == "vertices":
            return kept
        curves = kept_curves(self.source, self.labels)
        for place in np.ndindex(vertices.shape[:-2]):
            kept[place] = self._solved(vertices[place], curves)
        return kept

    def landmarks(self, vertices: Mapping[str, int]) -> dict[str, int]:
        """New numbers of named vertices; of the vertex that stands for it where one was not kept."""
        return {name: int(self.owner[v]) for name, v in vertices.items()}

    def _solved(self, vertices: np.ndarray, curves: np.ndarray) -> np.ndarray:
        centre = vertices.mean(axis=0)
        points = (vertices - centre)[:, None]
        quadrics, areas = surface_quadrics(points, self.source.faces, self.config.anchor)
        quadrics += held_curves(self.source, points, areas, curves, self.config.rounds)
        solved = lowest(sum_at(self.owner[:, None], quadrics, len(self.vertex_map)))[:, 0] + centre
        solved[self.fixed] = vertices[self.vertex_map[self.fixed]]
        return solved


def decimate_set(template: Mesh, poses: np.ndarray | None, faces: int, config: DecimateSetConfig | None = None,
                 keep: np.ndarray | None = None, skeleton: Skeleton | None = None,
                 progress: Progress | None = None) -> DecimatedSet:
    """Collapse edges of a template so that all meshes registered with it keep their shape.

    What bends in any of them counts as curved. Borders, and borders of the skeleton's parts, stay curves.

    Parameters
    ----------
    template : Mesh
    poses : (M, N, 3) float, metres, or None
        Other meshes in its topology; None for the template alone.
    faces : int
        How many triangles are wanted.
    config : DecimateSetConfig, optional
    keep : (k,) int, optional
        Vertices that stay, such as landmarks.
    skeleton : Skeleton, optional
    progress : callback(done, total), optional

    Returns
    -------
    DecimatedSet
        With a template that has a triangle or two less than wanted, or more when no further edge can go without
        harm.

    Raises
    ------
    ValueError
        Not a template, meshes of other topology, vertices or a skeleton that are not of it.

    [QEM] pair contraction
    """
    config = config or DecimateSetConfig()
    check_template(template)
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    if config.placement not in PLACEMENTS:
        raise ValueError(f"config.placement: expected one of {', '.join(PLACEMENTS)}, got {config.placement!r}")
    if skeleton is not None and len(skeleton.part_of_face) != len(template.faces):
        raise ValueError(f"skeleton: expected {len(template.faces)} faces as the template has, "
                         f"got {len(skeleton.part_of_face)}")
    keep = checked_vertices(template, np.zeros(0) if keep is None else keep)
    labels = None if skeleton is None else skeleton.part_of_face
    points = different_meshes(template, poses, config.meshes)
    settings = replace(config.rounds, onto_vertices=config.placement == "vertices")
    rounds = begin(template, points.swapaxes(0, 1), settings, keep, labels)
    rounds.run(faces, progress)
    kept, owner = rounds.numbered()
    return assembled(template, skeleton, kept, owner, rounds.face_rows, rounds.kinds[kept] == FIXED, config)


def assembled(source: Mesh, skeleton: Skeleton | None, vertex_map: np.ndarray, owner: np.ndarray,
              face_map: np.ndarray, fixed: np.ndarray, config: DecimateSetConfig) -> DecimatedSet:
    """The result of `decimate_set` from its maps and the original template and skeleton."""
    labels = None if skeleton is None else skeleton.part_of_face
    small = Mesh(source.vertices[vertex_map], owner[source.faces[face_map]],
                 None if source.colors is None else source.colors[vertex_map])
    out = DecimatedSet(small, vertex_map, owner, face_map, None, source, labels, fixed, config)
    small = small.with_vertices(out.carry(source.vertices))
    return replace(out, template=small, skeleton=None if skeleton is None else carried_skeleton(skeleton, out, small))


def carried_skeleton(skeleton: Skeleton, decimated: DecimatedSet, template: Mesh) -> Skeleton:
    """The same parts and joints on fewer triangles.

    Raises
    ------
    ValueError
        A part lost all its triangles.
    """
    parts = skeleton.part_of_face[decimated.face_map]
    lost = np.setdiff1d(np.arange(len(skeleton.parents)), parts)
    if len(lost):
        raise ValueError(f"faces: {len(template.faces)} are too few, no triangle is left of part "
                         f"{skeleton.names[lost[0]]}")
    joints = np.array(skeleton.joints)
    carried = Skeleton(parts, skeleton.parents, joints, skeleton.names)
    joints[0] = template.vertices[carried.part_of_vertex(template) == 0].mean(axis=0)
    return replace(carried, joints=joints)


def different_meshes(template: Mesh, poses: np.ndarray | None, count: int) -> np.ndarray:
    """(m, N, 3) the template and those meshes that are least like the ones before, placed as the template is.

    Raises
    ------
    ValueError
        Meshes of another topology, or fewer than one wanted.
    """
    if count < 1:
        raise ValueError(f"config.meshes: expected at least 1, got {count}")
    centred = template.vertices - template.vertices.mean(axis=0)
    if poses is None or count == 1:
        return centred[None]
    if np.ndim(poses) != 3 or np.shape(poses)[1:] != template.vertices.shape:
        raise ValueError(f"poses: expected shape (M, {len(template.vertices)}, 3), got {np.shape(poses)}")
    R, t = rotations.procrustes(poses, np.broadcast_to(centred, poses.shape))[:2]
    placed = np.concatenate([centred[None], np.einsum("mij,mnj->mni", R, poses) + t[:, None]])
    return placed[farthest_points(
        placed, count, 0, lambda i, _: np.sqrt(((placed - placed[i]) ** 2).sum(axis=2).mean(axis=1)), least=1e-9)]
