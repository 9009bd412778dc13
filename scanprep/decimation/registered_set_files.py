"""The folder of a registered set in fewer triangles."""
from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from ..dataset import RegisteredSet
from ..geometry import storage
from ..geometry.landmarks import read_landmark_vertices, write_landmarks
from .registered_set import DecimatedSet, DecimateSetConfig, Progress, assembled, decimate_set

KIND, VERSION = "decimation", 1
MOST_READ = 200                      # meshes among which the different ones are looked for
_ARRAYS = ("vertex_map", "owner", "face_map", "fixed")


def write_decimated_set(source: Path | str | RegisteredSet, folder: Path | str, faces: int,
                        config: DecimateSetConfig | None = None, progress: Progress | None = None) -> RegisteredSet:
    """Write a registered set with fewer triangles: template, meshes, skeleton, landmarks and the map.

    Every file is written whole or not at all and the map first, so that a run that was interrupted goes on where
    it was; meshes that are there are not written again.

    Parameters
    ----------
    source : path or RegisteredSet
        Landmarks in `landmarks.json` of its folder stay on their vertices.
    folder : path
        New, or that of an earlier run with the same source and settings.
    faces : int
    config : DecimateSetConfig, optional
    progress : callback(done, total), optional
        Called after every mesh.

    Returns
    -------
    RegisteredSet

    Raises
    ------
    ValueError
        The folder is that of the source, or holds something else.
    """
    config = config or DecimateSetConfig()
    source = source if isinstance(source, RegisteredSet) else RegisteredSet.load(source)
    folder = Path(folder)
    if folder.resolve() == source.folder.resolve():
        raise ValueError(f"folder: expected another one than that of the source, got {folder}")
    named = source.folder / "landmarks.json"
    landmarks = read_landmark_vertices(named, source.template) if named.exists() else {}
    settings = {"faces": faces, "config": dataclasses.asdict(config), "source": fingerprint(source, landmarks)}
    path = folder / "decimation.npz"
    if path.exists():
        done = _load_map(path, source, config, settings)
    elif (folder / "set.json").exists():
        raise ValueError(f"folder: {folder} holds a registered set that is no decimation")
    else:
        done = decimate_set(source.template, _sample(source, config), faces, config,
                            np.array(list(landmarks.values()), dtype=np.int64), source.skeleton)
        storage.save(path, KIND, VERSION, {name: getattr(done, name) for name in _ARRAYS}, settings)
    if landmarks:
        write_landmarks(folder / "landmarks.json", done.landmarks(landmarks))
    info = {**source.info, "decimated_from": {"vertices": len(source.template.vertices),
                                              "faces": len(source.template.faces)}}
    out = RegisteredSet.create(folder, done.template, info)
    if done.skeleton is not None:
        out = out.with_skeleton(done.skeleton)
    for number, entry in enumerate(source.entries, 1):
        if entry.name not in out.names:
            out = out.add(entry.name, done.carry(source.vertices([entry.name])[0]), entry.subject, entry.pose,
                          entry.sex)
        if progress is not None:
            progress(number, len(source.entries))
    return out


def fingerprint(source: RegisteredSet, landmarks: dict[str, int]) -> str:
    """What a decimation depends on, apart from its settings and the meshes there were when it was made."""
    parts = np.zeros(0, dtype=np.int64) if source.skeleton is None else source.skeleton.part_of_face
    kept = np.array(list(landmarks.values()), dtype=np.int64)
    digest = hashlib.sha256()
    for array in (source.template.vertices, source.template.faces, kept, parts):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _sample(source: RegisteredSet, config: DecimateSetConfig) -> np.ndarray | None:
    if config.meshes == 1 or not source.names:
        return None
    step = -(-len(source.names) // MOST_READ)
    return source.vertices(source.names[::step])


def _load_map(path: Path, source: RegisteredSet, config: DecimateSetConfig, settings: dict[str, Any]) -> DecimatedSet:
    header, arrays = storage.load(path, KIND, (VERSION,))
    if {key: header.get(key) for key in settings} != storage.as_json(settings):
        raise ValueError(f"{path}: the folder holds a decimation of another set or with other settings")
    missing = set(_ARRAYS) - set(arrays)
    if missing:
        raise storage.StorageError(f"{path}: expected {', '.join(sorted(missing))}, found {', '.join(arrays)}")
    with storage.taking_apart(path, "the maps between two templates"):
        vertex_map, owner, face_map, fixed = (storage.numbers(arrays, name, None, kinds="biu") for name in _ARRAYS)
        for name, most in (("vertex_map", len(owner)), ("face_map", len(source.template.faces))):
            if len(arrays[name]) and not 0 <= arrays[name].min() <= arrays[name].max() < most:
                raise ValueError(f"{name}: expected numbers 0..{most - 1}")
        return assembled(source.template, source.skeleton, vertex_map, owner, face_map, fixed, config)
