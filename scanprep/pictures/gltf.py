"""The writing half of glTF 2.0: one buffer, its accessors, the container `.glb`, and moving bodies in it."""
from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.storage import writing
from .colors import decode
from .sheets import png_bytes

# Turns that bring each axis to +y, the upward axis of glTF: quaternions x, y, z, w.
UPRIGHT = {0: [0.0, 0.0, 0.5**0.5, 0.5**0.5], 1: [0.0, 0.0, 0.0, 1.0], 2: [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]}
VERTICES, _INDICES = 34962, 34963                                  # what a graphics card will use the numbers for
_COMPONENTS = {"<f4": 5126, "<u4": 5125, "<u2": 5123, "|u1": 5121}


class Glb:
    """Arrays gathered into the one buffer of a binary glTF file."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, kind: str, target: int | None, bounds: bool = False) -> int:
        """An accessor of float32 numbers, one of `kind` a row (a MAT4 column after column); its index.

        `target` is `VERTICES` for what vertices have; `bounds` says the least and the greatest row, which glTF wants
        of positions and times.
        """
        values = np.ascontiguousarray(array, dtype="<f4")
        extra: dict[str, Any] = {}
        if bounds:
            rows = values.reshape(len(values), -1).astype(float)
            extra = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self._append(values, len(values), kind, target, extra)

    def add_indices(self, faces: np.ndarray) -> int:
        """An accessor of the corners of triangles; its index."""
        return self._append(np.ascontiguousarray(faces, dtype="<u4"), faces.size, "SCALAR", _INDICES, {})

    def add_joints(self, joints: np.ndarray) -> int:
        """An accessor of the four joints (n, 4) of every vertex, in one or two bytes; its index."""
        kind = "|u1" if joints.max(initial=0) < 256 else "<u2"
        return self._append(np.ascontiguousarray(joints, dtype=kind), len(joints), "VEC4", VERTICES, {})

    def add_image(self, image: np.ndarray, name: str) -> dict[str, Any]:
        """An entry of `images`: a picture (H, W), (H, W, 3) or (H, W, 4) of one or two bytes a value, as PNG inside."""
        data = png_bytes(image)
        self._views.append({"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)})
        self._data += data + b"\0" * (-len(data) % 4)
        return {"name": name, "mimeType": "image/png", "bufferView": len(self._views) - 1}

    def _append(self, values: np.ndarray, count: int, kind: str, target: int | None, extra: dict[str, Any]) -> int:
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._data), "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        self._data += values.tobytes()
        self._views.append(view)
        self._accessors.append({"bufferView": len(self._views) - 1, "count": count, "type": kind,
                                "componentType": _COMPONENTS[values.dtype.str], **extra})
        return len(self._accessors) - 1

    def pack(self, document: dict[str, Any]) -> bytes:
        """The file: header, JSON, buffer."""
        document = {"asset": {"version": "2.0", "generator": "scapekit"}, **document,
                    "buffers": [{"byteLength": len(self._data)}], "bufferViews": self._views,
                    "accessors": self._accessors}
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self._data) + b"\0" * (-len(self._data) % 4)
        size = 12 + 8 + len(text) + 8 + len(data)
        return (struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
                + struct.pack("<I4s", len(data), b"BIN\0") + data)


def some_normal(mesh: Mesh) -> np.ndarray:
    """Unit normals at all vertices: glTF allows no zero normal, not even where there are no triangles."""
    normals = np.array(mesh.vertex_normals)
    normals[~normals.any(axis=1)] = (0, 0, 1)
    return normals


def skin_material(color: Sequence[float] = (0.60, 0.57, 0.53)) -> dict[str, Any]:
    """A material of one colour (linear light) that is dull all over."""
    return {"name": "skin", "pbrMetallicRoughness": {
        "baseColorFactor": [*color, 1], "metallicFactor": 0, "roughnessFactor": 0.75}}


def write_animated_glb(path: str | Path, faces: np.ndarray, frames: np.ndarray, rate: float,
                       colors: np.ndarray | None = None, up: int = 2, keys: int = 60) -> None:
    """Write a moving mesh, frames (T, N, 3) at `rate` a second, that any glTF 2.0 viewer plays.

    Every key frame is a morph target with its own normals; the animation blends from one to the next. Nothing but the
    core of glTF is used. Of a longer motion `keys` evenly spaced frames are kept; the axis `up` points up.
    """
    data = animated_glb(faces, frames, rate, colors, up, keys)
    with writing(path) as beside:
        beside.write_bytes(data)


def animated_glb(faces: np.ndarray, frames: np.ndarray, rate: float, colors: np.ndarray | None = None, up: int = 2,
                 keys: int = 60) -> bytes:
    """The bytes of `write_animated_glb`."""
    frames, faces = np.asarray(frames, dtype=float), np.asarray(faces)
    _check(frames, rate, up, keys)
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(keys, len(frames))).round().astype(int))
    meshes = [Mesh(frames[t], faces) for t in chosen]
    glb = Glb()
    base, normals = meshes[0].vertices, some_normal(meshes[0])
    attributes = {"POSITION": glb.add(base, "VEC3", VERTICES, bounds=True),
                  "NORMAL": glb.add(normals, "VEC3", VERTICES)}
    if colors is not None:
        rgba = np.concatenate([decode(np.asarray(colors)), np.ones((len(base), 1))], axis=1)
        attributes["COLOR_0"] = glb.add(rgba, "VEC4", VERTICES)
    primitive: dict[str, Any] = {"attributes": attributes, "indices": glb.add_indices(faces), "material": 0}
    primitive["targets"] = [{"POSITION": glb.add(m.vertices - base, "VEC3", VERTICES, bounds=True),
                             "NORMAL": glb.add(some_normal(m) - normals, "VEC3", VERTICES)} for m in meshes[1:]]
    count = len(meshes) - 1
    mesh: dict[str, Any] = {"name": "body", "primitives": [primitive]}
    document: dict[str, Any] = {
        "scene": 0, "scenes": [{"nodes": [0]}], "meshes": [mesh],
        "nodes": [{"name": "body", "mesh": 0, "rotation": UPRIGHT[up]}],
        "materials": [skin_material((1, 1, 1)) if colors is not None else skin_material()]}
    if count:
        mesh["weights"] = [0] * count
        mesh["extras"] = {"targetNames": [f"frame {t}" for t in chosen[1:]]}
        times = glb.add(chosen / rate, "SCALAR", None, bounds=True)
        weights = glb.add(np.eye(count + 1)[:, 1:].ravel(), "SCALAR", None)
        document["animations"] = [{
            "name": "motion", "samplers": [{"input": times, "output": weights, "interpolation": "LINEAR"}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}]}]
    else:
        del primitive["targets"]
    return glb.pack(document)


def _check(frames: np.ndarray, rate: float, up: int, keys: int) -> None:
    if frames.ndim != 3 or frames.shape[2] != 3 or not len(frames):
        raise ValueError(f"frames: expected shape (T, N, 3) with at least one frame, got {frames.shape}")
    bad = np.flatnonzero(~np.isfinite(frames).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"frames: {len(bad)} are not finite, the first is frame {bad[0]}")
    if not rate > 0:
        raise ValueError(f"rate: expected a positive number of frames a second, got {rate}")
    if up not in UPRIGHT:
        raise ValueError(f"up: expected 0, 1 or 2, got {up}")
    if keys < 1:
        raise ValueError(f"keys: expected at least 1, got {keys}")
