"""The writing half of glTF 2.0: one buffer, its accessors, and the container `.glb`."""
from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..geometry.mesh import Mesh
from .sheets import png_bytes

# Turns that bring each axis to +y, the upward axis of glTF: quaternions x, y, z, w.
_HALF = 0.5 ** 0.5
UPRIGHT = {0: [0.0, 0.0, _HALF, _HALF], 1: [0.0, 0.0, 0.0, 1.0], 2: [-_HALF, 0.0, 0.0, _HALF]}
VERTICES, _INDICES = 34962, 34963                                  # what a graphics card will use the numbers for
_COMPONENTS = {"<f4": 5126, "<u4": 5125, "<u2": 5123, "|u1": 5121}


class Glb:
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
