"""Decimate a whole registered set by the same collapses on every mesh, and write the smaller set."""
from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..dataset import RegisteredSet
from ..geometry import rotations, storage
from ..geometry.farthest_points import farthest_points
from ..geometry.landmarks import read_landmark_vertices, write_landmarks
from ..geometry.mesh import Mesh, check_template
from ..skeleton.tree import Skeleton
from .edge_collapse import Rounds, check_vertices

Progress = Callable[[int, int], None]
KIND, VERSION = "decimation", 1
_MAPS = ("vertex_map", "owner", "face_map")
MESHES = 8                      # over which costs are summed, as different as possible; 16 gained 1% in twice the time


@dataclass(frozen=True, eq=False)
class DecimatedSet:
    """A decimation that applies to all meshes of one topology."""

    template: Mesh
    vertex_map: np.ndarray          # (n,) the original vertex of every new one
    owner: np.ndarray               # (N,) the new vertex of each original one
    face_map: np.ndarray            # (f,) the original triangle of every new one
    skeleton: Skeleton | None
    source: Mesh                    # the template before

    def transfer(self, vertices: np.ndarray) -> np.ndarray:
        """Map vertices (..., N, 3) of large meshes to those (..., n, 3) of small ones, metres."""
        vertices = np.asarray(vertices, dtype=np.float64)
        if vertices.shape[-2:] != self.source.vertices.shape:
            raise ValueError(f"vertices: expected shape (..., {len(self.source.vertices)}, 3), got {vertices.shape}")
        return vertices[..., self.vertex_map, :]

    def landmarks(self, vertices: Mapping[str, int]) -> dict[str, int]:
        """Return the new numbers of named vertices; a vertex that was not kept gets its survivor."""
        return {name: int(self.owner[v]) for name, v in vertices.items()}

def decimate_set(template: Mesh, poses: np.ndarray | None, faces: int, keep: np.ndarray | None = None,
                 skeleton: Skeleton | None = None) -> DecimatedSet:
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
    keep : (k,) int, optional
        Vertices that stay, such as landmarks.
    skeleton : Skeleton, optional
        Parts whose borders are preserved.

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
    check_template(template)
    if faces < 4:
        raise ValueError(f"faces: expected at least 4, got {faces}")
    if skeleton is not None and len(skeleton.part_of_face) != len(template.faces):
        raise ValueError(f"skeleton: expected {len(template.faces)} faces as the template has, "
                         f"got {len(skeleton.part_of_face)}")
    keep = check_vertices(template, np.zeros(0) if keep is None else keep)
    labels = None if skeleton is None else skeleton.part_of_face
    # costs are summed over the template and meshes unlike it; all checks are those of `decimate`
    points = _different_meshes(template, poses)
    rounds = Rounds(template, points.swapaxes(0, 1), keep, labels, onto_vertices=True)
    rounds.run(faces)
    kept, owner = rounds.renumber()
    return _assemble(template, skeleton, kept, owner, rounds.face_rows)


def _different_meshes(template: Mesh, poses: np.ndarray | None) -> np.ndarray:
    """Choose the template and the most different meshes (m, N, 3), aligned rigidly to the template."""
    centred = template.vertices - template.vertices.mean(axis=0)
    if poses is None:
        return centred[None]
    if np.ndim(poses) != 3 or np.shape(poses)[1:] != template.vertices.shape:
        raise ValueError(f"poses: expected shape (M, {len(template.vertices)}, 3), got {np.shape(poses)}")
    R, t = rotations.procrustes(poses, np.broadcast_to(centred, poses.shape))
    placed = np.concatenate([centred[None], np.einsum("mij,mnj->mni", R, poses) + t[:, None]])
    return placed[farthest_points(
        placed, MESHES, 0, lambda i, _: np.sqrt(((placed - placed[i]) ** 2).sum(axis=2).mean(axis=1)), least=1e-9)]


def _assemble(source: Mesh, skeleton: Skeleton | None, vertex_map: np.ndarray, owner: np.ndarray,
              face_map: np.ndarray) -> DecimatedSet:
    """Build the result of `decimate_set` from its maps and the original template and skeleton."""
    small = Mesh(source.vertices[vertex_map], owner[source.faces[face_map]],
                 None if source.colors is None else source.colors[vertex_map])
    return DecimatedSet(small, vertex_map, owner, face_map,
                        None if skeleton is None else _smaller_skeleton(skeleton, face_map, small), source)


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
                        progress: Progress | None = None) -> RegisteredSet:
    """Write a registered set with fewer triangles: template, meshes, skeleton, landmarks and the map.

    Files are written atomically, the map first, so that an interrupted run resumes. Existing meshes are not written
    again. Landmarks in `landmarks.json` of the source keep their vertices. ValueError for the source's own folder, or a
    folder with something else.
    """
    source = source if isinstance(source, RegisteredSet) else RegisteredSet.load(source)
    folder = Path(folder)
    if folder.resolve() == source.folder.resolve():
        raise ValueError(f"folder: expected another one than that of the source, got {folder}")
    named = source.folder / "landmarks.json"
    landmarks = read_landmark_vertices(named, source.template) if named.exists() else {}
    settings = {"faces": faces, "source": _fingerprint(source, landmarks)}
    # resume from the stored map, or decimate and store it
    path = folder / "decimation.npz"
    if path.exists():
        done = _load_map(path, source, settings)
    elif (folder / "set.json").exists():
        raise ValueError(f"folder: {folder} holds a registered set that is no decimation")
    else:
        step = max(-(-len(source.names) // 200), 1)        # about 200 meshes are enough to choose from
        sample = source.names[::step]
        done = decimate_set(source.template, source.vertices(sample) if sample else None, faces,
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


def _load_map(path: Path, source: RegisteredSet, settings: dict[str, Any]) -> DecimatedSet:
    """Load the stored map of a folder; ValueError if it belongs to another set or other settings."""
    header, arrays = storage.load(path, KIND, (VERSION,))
    # older files hold settings that are constants now; with this one the vertices of meshes were placed otherwise
    older = header.get("config")
    solved = isinstance(older, dict) and older.get("placement") == "solved"
    if solved or {key: header.get(key) for key in settings} != storage.as_json(settings):
        raise ValueError(f"{path}: the folder holds a decimation of another set or with other settings")
    with storage.taking_apart(path, "the maps between two templates"):
        vertex_map, owner, face_map = (storage.numbers(arrays, name, None, kinds="biu") for name in _MAPS)
        for name, most in (("vertex_map", len(owner)), ("face_map", len(source.template.faces))):
            if len(arrays[name]) and not 0 <= arrays[name].min() <= arrays[name].max() < most:
                raise ValueError(f"{name}: expected numbers 0..{most - 1}")
        return _assemble(source.template, source.skeleton, vertex_map, owner, face_map)
