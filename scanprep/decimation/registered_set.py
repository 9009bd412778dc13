"""Decimate a whole registered set by the same collapses on every mesh, and write the smaller set."""
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
        Number of meshes, as different as possible, over which costs are summed; 1 for the template alone.
    placement : str
        "vertices": every vertex of the small meshes is one of the large ones, so the vertex map is exact. "solved":
        every mesh has its vertices where its own error is least. This is closer to the surface by a third, but vertices
        slide a little along the skin between meshes, and the map is approximate.
    anchor : float
        For "solved": weight of distances to the original vertices against distances to planes; larger means less
        sliding.
    """

    meshes: Count = 8
    placement: Literal["vertices", "solved"] = "vertices"
    anchor: float = 0.03


@dataclass(frozen=True, eq=False)
class DecimatedSet:
    """A decimation that applies to all meshes of one topology."""

    template: Mesh
    vertex_map: np.ndarray          # (n,) the original vertex of every new one
    owner: np.ndarray               # (N,) the new vertex of each original one
    face_map: np.ndarray            # (f,) the original triangle of every new one
    skeleton: Skeleton | None
    source: Mesh                    # the template before
    labels: np.ndarray | None       # (F,) parts of the triangles before
    fixed: np.ndarray               # (n,) bool: new vertices that stay on the original one with any placement
    config: DecimateSetConfig

    def transfer(self, vertices: np.ndarray) -> np.ndarray:
        """Map vertices (..., N, 3) of large meshes to those (..., n, 3) of small ones, metres."""
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
        """Return the new numbers of named vertices; a vertex that was not kept gets its survivor."""
        return {name: int(self.owner[v]) for name, v in vertices.items()}

    def _solve(self, vertices: np.ndarray, curves: np.ndarray) -> np.ndarray:
        """Place the vertices (n, 3) of one small mesh, each where the error of those it replaces is least."""
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

    A region that bends in any of them counts as curved. Borders, and borders of the skeleton's parts, are preserved.

    Parameters
    ----------
    template : Mesh
        The common topology.
    poses : (M, N, 3) float, metres, or None
        Other meshes in its topology; None for the template alone.
    faces : int
        Number of triangles to reach.
    config : DecimateSetConfig, optional
        Settings.
    keep : (k,) int, optional
        Vertices that stay, such as landmarks.
    skeleton : Skeleton, optional
        Parts whose borders are preserved.
    progress : callable, optional
        Called as progress(removed, total) with numbers of triangles.

    Returns
    -------
    DecimatedSet
        Its template may have one or two triangles less than asked for, or more if no further edge can collapse.

    Raises
    ------
    ValueError
        An invalid template, meshes of another topology, or vertices or a skeleton that do not belong to it.

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
    # costs are summed over the template and meshes unlike it; all checks are those of `decimate`
    points = _different_meshes(template, poses, config.meshes)
    rounds = Rounds(template, points.swapaxes(0, 1), keep, labels, onto_vertices=config.placement == "vertices")
    rounds.run(faces, progress)
    kept, owner = rounds.renumber()
    return _assemble(template, skeleton, kept, owner, rounds.face_rows, rounds.kinds[kept] == FIXED, config)


def _different_meshes(template: Mesh, poses: np.ndarray | None, count: int) -> np.ndarray:
    """Choose the template and the most different meshes (m, N, 3), aligned rigidly to the template."""
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
    """Build the result of `decimate_set` from its maps and the original template and skeleton."""
    labels = None if skeleton is None else skeleton.part_of_face
    small = Mesh(source.vertices[vertex_map], owner[source.faces[face_map]],
                 None if source.colors is None else source.colors[vertex_map])
    out = DecimatedSet(small, vertex_map, owner, face_map, None, source, labels, fixed, config)
    small = small.with_vertices(out.transfer(source.vertices))
    return replace(out, template=small,
                   skeleton=None if skeleton is None else _smaller_skeleton(skeleton, face_map, small))


def _smaller_skeleton(skeleton: Skeleton, face_map: np.ndarray, template: Mesh) -> Skeleton:
    """Transfer parts and joints to fewer triangles; ValueError for a part without triangles."""
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

    Files are written atomically, the map first, so that an interrupted run resumes. Existing meshes are not written
    again. Landmarks in `landmarks.json` of the source keep their vertices. ValueError for the source's own folder, or a
    folder with something else.
    """
    config = config or DecimateSetConfig()
    source = source if isinstance(source, RegisteredSet) else RegisteredSet.load(source)
    folder = Path(folder)
    if folder.resolve() == source.folder.resolve():
        raise ValueError(f"folder: expected another one than that of the source, got {folder}")
    named = source.folder / "landmarks.json"
    landmarks = read_landmark_vertices(named, source.template) if named.exists() else {}
    settings = {"faces": faces, "config": dataclasses.asdict(config), "source": _fingerprint(source, landmarks)}
    # resume from the stored map, or decimate and store it
    path = folder / "decimation.npz"
    if path.exists():
        done = _load_map(path, source, config, settings)
    elif (folder / "set.json").exists():
        raise ValueError(f"folder: {folder} holds a registered set that is no decimation")
    else:
        step = max(-(-len(source.names) // 200), 1)        # about 200 meshes are enough to choose from
        sample = source.names[::step] if config.meshes > 1 else ()
        done = decimate_set(source.template, source.vertices(sample) if sample else None, faces, config,
                            np.array(list(landmarks.values()), dtype=np.int64), source.skeleton)
        storage.save(path, KIND, VERSION, {name: getattr(done, name) for name in _MAPS}, settings)
    if landmarks:
        write_landmarks(folder / "landmarks.json", done.landmarks(landmarks))
    info = {**source.info, "decimated_from": {"vertices": len(source.template.vertices),
                                              "faces": len(source.template.faces)}}
    out = RegisteredSet.create(folder, done.template, info)
    if done.skeleton is not None:
        out = out.with_skeleton(done.skeleton)
    # write the meshes that are not there yet
    for number, entry in enumerate(source.entries, 1):
        if entry.name not in out.names:
            out = out.add(entry.name, done.transfer(source.vertices([entry.name])[0]), entry.subject, entry.pose,
                          entry.sex)
        if progress is not None:
            progress(number, len(source.entries))
    return out


def _fingerprint(source: RegisteredSet, landmarks: dict[str, int]) -> str:
    """Hash what a decimation depends on, apart from its settings and the poses used."""
    parts = np.zeros(0, dtype=np.int64) if source.skeleton is None else source.skeleton.part_of_face
    kept = np.array(list(landmarks.values()), dtype=np.int64)
    digest = hashlib.sha256()
    for array in (source.template.vertices, source.template.faces, kept, parts):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _load_map(path: Path, source: RegisteredSet, config: DecimateSetConfig, settings: dict[str, Any]) -> DecimatedSet:
    """Load the stored map of a folder; ValueError if it belongs to another set or other settings."""
    header, arrays = storage.load(path, KIND, (VERSION,))
    if isinstance(header.get("config"), dict):
        header["config"].pop("rounds", None)             # older files hold settings that are constants now
    if {key: header.get(key) for key in settings} != storage.as_json(settings):
        raise ValueError(f"{path}: the folder holds a decimation of another set or with other settings")
    with storage.taking_apart(path, "the maps between two templates"):
        vertex_map, owner, face_map, fixed = (storage.numbers(arrays, name, None, kinds="biu") for name in _MAPS)
        for name, most in (("vertex_map", len(owner)), ("face_map", len(source.template.faces))):
            if len(arrays[name]) and not 0 <= arrays[name].min() <= arrays[name].max() < most:
                raise ValueError(f"{name}: expected numbers 0..{most - 1}")
        return _assemble(source.template, source.skeleton, vertex_map, owner, face_map, fixed, config)
