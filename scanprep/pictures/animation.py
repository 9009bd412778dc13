"""Moving bodies as files: animated GLB and GIF."""
from __future__ import annotations

import io
import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.mesh import Mesh
from ..geometry.storage import writing
from .colors import decode

# Turns of a node that bring each axis to +y, the upward axis of glTF: quaternions x, y, z, w.
_HALF = 0.5 ** 0.5
_UPRIGHT = {0: [0.0, 0.0, _HALF, _HALF], 1: [0.0, 0.0, 0.0, 1.0], 2: [-_HALF, 0.0, 0.0, _HALF]}
_FLOAT, _UINT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963


def write_animated_glb(path: str | Path, faces: np.ndarray, frames: np.ndarray, rate: float,
                       colors: np.ndarray | None = None, up: int = 2, keys: int = 60) -> None:
    """Write a moving mesh that any glTF 2.0 viewer plays.

    Every key frame is a morph target with its own normals; the animation blends from one to the next. Nothing
    but the core of glTF is used.

    Parameters
    ----------
    path : str or Path
    faces : (F, 3) int
    frames : (T, N, 3) float, metres
    rate : float, frames a second
    colors : (N, 3) float in [0, 1], optional
    up : int
        0, 1 or 2: the axis that points up.
    keys : int
        Largest number of key frames; of a longer motion evenly spaced frames are kept.

    Raises
    ------
    ValueError
        Arrays of a wrong shape, no frames, frames that are not finite, a rate that is not positive.
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
    glb = _Glb()
    base, normals = meshes[0].vertices, _some_normal(meshes[0])
    attributes = {"POSITION": glb.add(base, "VEC3", _VERTICES, bounds=True),
                  "NORMAL": glb.add(normals, "VEC3", _VERTICES)}
    if colors is not None:
        rgba = np.concatenate([decode(np.asarray(colors)), np.ones((len(base), 1))], axis=1)
        attributes["COLOR_0"] = glb.add(rgba, "VEC4", _VERTICES)
    primitive: dict[str, Any] = {"attributes": attributes, "indices": glb.add_indices(faces), "material": 0}
    primitive["targets"] = [{"POSITION": glb.add(m.vertices - base, "VEC3", _VERTICES, bounds=True),
                             "NORMAL": glb.add(_some_normal(m) - normals, "VEC3", _VERTICES)} for m in meshes[1:]]
    count = len(meshes) - 1
    mesh: dict[str, Any] = {"name": "body", "primitives": [primitive]}
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "scapekit"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "body", "mesh": 0, "rotation": _UPRIGHT[up]}], "meshes": [mesh],
        "materials": [{"name": "skin", "pbrMetallicRoughness": {
            "baseColorFactor": [1, 1, 1, 1] if colors is not None else [0.60, 0.57, 0.53, 1],
            "metallicFactor": 0, "roughnessFactor": 0.75}}]}
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


def gif_bytes(images: Sequence[np.ndarray], rate: float) -> bytes:
    """Pictures (H, W, 3) uint8 as an endless animated GIF of `rate` pictures a second.

    All share one palette, so that nothing flickers.
    """
    from PIL import Image

    if not len(images):
        raise ValueError("images: expected at least one, got none")
    step = max(1, len(images) // 6)
    palette = Image.fromarray(np.concatenate([i[::2, ::2] for i in images[::step]])).quantize(
        255, method=Image.Quantize.MEDIANCUT)
    colors = np.array(palette.getpalette()).reshape(-1, 3)
    colors[colors.sum(axis=1).argmax()] = 255                 # the background of most pictures
    palette.putpalette(colors.ravel().tolist())
    drawn = [Image.fromarray(i).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for i in images]
    out = io.BytesIO()
    drawn[0].save(out, format="GIF", save_all=True, append_images=drawn[1:], loop=0,
                  duration=max(20, round(1000 / rate / 10) * 10), optimize=False)
    return out.getvalue()


def write_gif(path: str | Path, images: Sequence[np.ndarray], rate: float) -> None:
    """Write `gif_bytes`, whole or not at all."""
    data = gif_bytes(images, rate)
    with writing(path) as beside:
        beside.write_bytes(data)


def _check(frames: np.ndarray, rate: float, up: int, keys: int) -> None:
    if frames.ndim != 3 or frames.shape[2] != 3 or not len(frames):
        raise ValueError(f"frames: expected shape (T, N, 3) with at least one frame, got {frames.shape}")
    bad = np.flatnonzero(~np.isfinite(frames).all(axis=(1, 2)))
    if len(bad):
        raise ValueError(f"frames: {len(bad)} are not finite, the first is frame {bad[0]}")
    if not rate > 0:
        raise ValueError(f"rate: expected a positive number of frames a second, got {rate}")
    if up not in _UPRIGHT:
        raise ValueError(f"up: expected 0, 1 or 2, got {up}")
    if keys < 1:
        raise ValueError(f"keys: expected at least 1, got {keys}")


def _some_normal(mesh: Mesh) -> np.ndarray:
    """Unit normals at all vertices: glTF allows no zero normal, not even where there are no triangles."""
    normals = np.array(mesh.vertex_normals)
    normals[~normals.any(axis=1)] = (0, 0, 1)
    return normals


class _Glb:
    """Arrays gathered into the one buffer of a binary glTF file."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, kind: str, target: int | None, bounds: bool = False) -> int:
        """An accessor of float32 numbers; its index."""
        values = np.ascontiguousarray(array, dtype="<f4")
        extra: dict[str, Any] = {}
        if bounds:
            rows = values.reshape(len(values), -1).astype(float)
            extra = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self._append(values.tobytes(), len(values), kind, _FLOAT, target, extra)

    def add_indices(self, faces: np.ndarray) -> int:
        """An accessor of the corners of triangles; its index."""
        data = np.ascontiguousarray(faces, dtype="<u4").tobytes()
        return self._append(data, faces.size, "SCALAR", _UINT, _INDICES, {})

    def _append(self, data: bytes, count: int, kind: str, component: int, target: int | None,
                extra: dict[str, Any]) -> int:
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self._data += data
        self._views.append(view)
        self._accessors.append({"bufferView": len(self._views) - 1, "componentType": component, "count": count,
                                "type": kind, **extra})
        return len(self._accessors) - 1

    def pack(self, document: dict[str, Any]) -> bytes:
        """The file: header, JSON, buffer."""
        document = {**document, "buffers": [{"byteLength": len(self._data)}], "bufferViews": self._views,
                    "accessors": self._accessors}
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        data = bytes(self._data) + b"\0" * (-len(self._data) % 4)
        size = 12 + 8 + len(text) + 8 + len(data)
        return (struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
                + struct.pack("<I4s", len(data), b"BIN\0") + data)
