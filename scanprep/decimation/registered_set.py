"""One decimation for a whole registered set: the same collapses on every mesh; and the folder of the smaller set."""
from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..dataset import RegisteredSet
from ..geometry import rotations, storage
from ..geometry.farthest_points import farthest_points
from ..geometry.landmarks import read_landmark_vertices, write_landmarks
from ..geometry.mesh import Mesh, check_template
from ..ranges import Count, Settings
from ..skeleton.tree import Skeleton
from .edge_collapse import FIXED, Rounds, check_vertices, curves_to_keep, wall_quadrics
from .quadrics import minimise_quadrics, sum_at, surface_quadrics

Progress = Callable[[int, int], None]
KIND, VERSION = "decimation", 1
_MAPS = ("vertex_map", "owner", "face_map", "fixed")


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
    """

    meshes: Count = 8
    placement: Literal["vertices", "solved"] = "vertices"
    anchor: float = 0.03


@dataclass(frozen=True, eq=False)
class DecimatedSet:
    """How meshes of one topology get fewer triangles."""

    template: Mesh
    vertex_map: np.ndarray          # (n,) the original vertex of every one that was kept
    owner: np.ndarray               # (N,) the new vertex that stands for each original one
    face_map: np.ndarray            # (f,) the original triangle of every one that was kept
    skeleton: Skeleton | None
    source: Mesh                    # the template before
    labels: np.ndarray | None       # (F,) parts of the triangles before
    fixed: np.ndarray               # (n,) bool, new vertices that stay on the original one in any case
    config: DecimateSetConfig

    def transfer(self, vertices: np.ndarray) -> np.ndarray:
        """Vertices (..., n, 3) of small meshes for those (..., N, 3) of large ones, metres."""
        vertices = np.asarray(vertices, dtype=np.float64)
        if vertices.shape[-2:] != self.source.vertices.shape:
            raise ValueError(f"vertices: expected shape (..., {len(self.source.vertices)}, 3), got {vertices.shape}")
        kept = vertices[..., self.vertex_map, :]
        if self.config.placement == "vertices":
            return kept
        curves = curves_to_keep(self.source, self.labels)
        for place in np.ndindex(vertices.shape[:-2]):
            kept[place] = self._solve(vertices[place], curves)
        return kept

    def landmarks(self, vertices: Mapping[str, int]) -> dict[str, int]:
        """New numbers of named vertices; of the vertex that stands for it where one was not kept."""
        return {name: int(self.owner[v]) for name, v in vertices.items()}

    def _solve(self, vertices: np.ndarray, curves: np.ndarray) -> np.ndarray:
        """Vertices (n, 3) of one small mesh, each where the error of those it stands for is least."""
        centre = vertices.mean(axis=0)
        points = (vertices - centre)[:, None]
        quadrics, areas = surface_quadrics(points, self.source.faces, self.config.anchor)
        quadrics += wall_quadrics(self.source, points, areas, curves)
        solved = minimise_quadrics(sum_at(self.owner[:, None], quadrics, len(self.vertex_map)))[:, 0] + centre
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
    if config.placement not in ("vertices", "solved"):
        raise ValueError(f"config.placement: expected 'vertices' or 'solved', got {config.placement!r}")
    if skeleton is not None and len(skeleton.part_of_face) != len(template.faces):
        raise ValueError(f"skeleton: expected {len(template.faces)} faces as the template has, "
                         f"got {len(skeleton.part_of_face)}")
    keep = check_vertices(template, np.zeros(0) if keep is None else keep)
    labels = None if skeleton is None else skeleton.part_of_face
    points = _different_meshes(template, poses, config.meshes)
    rounds = Rounds(template, points.swapaxes(0, 1), keep, labels, onto_vertices=config.placement == "vertices")
    rounds.run(faces, progress)
    kept, owner = rounds.renumber()
    return _assemble(template, skeleton, kept, owner, rounds.face_rows, rounds.kinds[kept] == FIXED, config)


def _different_meshes(template: Mesh, poses: np.ndarray | None, count: int) -> np.ndarray:
    """(m, N, 3) the template and those meshes that are least like the ones before, placed as the template is."""
    centred = template.vertices - template.vertices.mean(axis=0)
    if poses is None or count == 1:
        return centred[None]
    if np.ndim(poses) != 3 or np.shape(poses)[1:] != template.vertices.shape:
        raise ValueError(f"poses: expected shape (M, {len(template.vertices)}, 3), got {np.shape(poses)}")
    R, t = rotations.procrustes(poses, np.broadcast_to(centred, poses.shape))
    placed = np.concatenate([centred[None], np.einsum("mij,mnj->mni", R, poses) + t[:, None]])
    return placed[farthest_points(
        placed, count, 0, lambda i, _: np.sqrt(((placed - placed[i]) ** 2).sum(axis=2).mean(axis=1)), least=1e-9)]


def _assemble(source: Mesh, skeleton: Skeleton | None, vertex_map: np.ndarray, owner: np.ndarray,
               face_map: np.ndarray, fixed: np.ndarray, config: DecimateSetConfig) -> DecimatedSet:
    """The result of `decimate_set` from its maps and the original template and skeleton."""
    labels = None if skeleton is None else skeleton.part_of_face
    small = Mesh(source.vertices[vertex_map], owner[source.faces[face_map]],
                 None if source.colors is None else source.colors[vertex_map])
    out = DecimatedSet(small, vertex_map, owner, face_map, None, source, labels, fixed, config)
    small = small.with_vertices(out.transfer(source.vertices))
    return replace(out, template=small,
                   skeleton=None if skeleton is None else _smaller_skeleton(skeleton, face_map, small))


def _smaller_skeleton(skeleton: Skeleton, face_map: np.ndarray, template: Mesh) -> Skeleton:
    """The same parts and joints on fewer triangles; ValueError where a part lost all of its own."""
    parts = skeleton.part_of_face[face_map]
    lost = np.setdiff1d(np.arange(len(skeleton.parents)), parts)
    if len(lost):
        raise ValueError(f"faces: {len(template.faces)} are too few, no triangle is left of part "
                         f"{skeleton.names[lost[0]]}")
    small = Skeleton(parts, skeleton.parents, skeleton.joints, skeleton.names)
    joints = np.array(skeleton.joints)
    joints[0] = template.vertices[small.part_of_vertex(template) == 0].mean(axis=0)
    return replace(small, joints=joints)


def write_decimated_set(source: Path | str | RegisteredSet, folder: Path | str, faces: int,
                        config: DecimateSetConfig | None = None, progress: Progress | None = None) -> RegisteredSet:
    """Write a registered set with fewer triangles: template, meshes, skeleton, landmarks and the map.

    Every file is written whole or not at all and the map first, so that a run that was interrupted goes on where
    it was; meshes that are there are not written again. Landmarks in `landmarks.json` of the source stay on their
    vertices. ValueError for a folder that is that of the source, or holds something else.
    """
    config = config or DecimateSetConfig()
    source = source if isinstance(source, RegisteredSet) else RegisteredSet.load(source)
    folder = Path(folder)
    if folder.resolve() == source.folder.resolve():
        raise ValueError(f"folder: expected another one than that of the source, got {folder}")
    named = source.folder / "landmarks.json"
    landmarks = read_landmark_vertices(named, source.template) if named.exists() else {}
    settings = {"faces": faces, "config": dataclasses.asdict(config), "source": _fingerprint(source, landmarks)}
    path = folder / "decimation.npz"
    if path.exists():
        done = _load_map(path, source, config, settings)
    elif (folder / "set.json").exists():
        raise ValueError(f"folder: {folder} holds a registered set that is no decimation")
    else:
        step = max(-(-len(source.names) // 200), 1)        # among so many meshes the different ones are looked for
        some = source.names[::step] if config.meshes > 1 else ()
        done = decimate_set(source.template, source.vertices(some) if some else None, faces, config,
                            np.array(list(landmarks.values()), dtype=np.int64), source.skeleton)
        storage.save(path, KIND, VERSION, {name: getattr(done, name) for name in _MAPS}, settings)
    if landmarks:
        write_landmarks(folder / "landmarks.json", done.landmarks(landmarks))
    info = {**source.info, "decimated_from": {"vertices": len(source.template.vertices),
                                              "faces": len(source.template.faces)}}
    out = RegisteredSet.create(folder, done.template, info)
    if done.skeleton is not None:
        out = out.with_skeleton(done.skeleton)
    for number, entry in enumerate(source.entries, 1):
        if entry.name not in out.names:
            out = out.add(entry.name, done.transfer(source.vertices([entry.name])[0]), entry.subject, entry.pose,
                          entry.sex)
        if progress is not None:
            progress(number, len(source.entries))
    return out


def _fingerprint(source: RegisteredSet, landmarks: dict[str, int]) -> str:
    """What a decimation depends on, apart from its settings and the meshes there were when it was made."""
    parts = np.zeros(0, dtype=np.int64) if source.skeleton is None else source.skeleton.part_of_face
    kept = np.array(list(landmarks.values()), dtype=np.int64)
    digest = hashlib.sha256()
    for array in (source.template.vertices, source.template.faces, kept, parts):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _load_map(path: Path, source: RegisteredSet, config: DecimateSetConfig, settings: dict[str, Any]) -> DecimatedSet:
    header, arrays = storage.load(path, KIND, (VERSION,))
    if isinstance(header.get("config"), dict):
        header["config"].pop("rounds", None)             # settings that older files hold and that are constants now
    if {key: header.get(key) for key in settings} != storage.as_json(settings):
        raise ValueError(f"{path}: the folder holds a decimation of another set or with other settings")
    with storage.taking_apart(path, "the maps between two templates"):
        vertex_map, owner, face_map, fixed = (storage.numbers(arrays, name, None, kinds="biu") for name in _MAPS)
        for name, most in (("vertex_map", len(owner)), ("face_map", len(source.template.faces))):
            if len(arrays[name]) and not 0 <= arrays[name].min() <= arrays[name].max() < most:
                raise ValueError(f"{name}: expected numbers 0..{most - 1}")
        return _assemble(source.template, source.skeleton, vertex_map, owner, face_map, fixed, config)
