"""GLB, the binary form of glTF 2.0: all triangles of the scene, each mesh where its node puts it.

glTF has y up and no body here has an axis that is up, so what is written is turned: by `tallest`, or by the axis that
the caller knows. The file names that axis in `asset.extras`, and the reader turns it back. A file that names none comes
from elsewhere, or was written before there was a name: it is read as it stands.
"""
from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from . import storage
from .format_common import Contents, MeshFileError, as_colors, as_light, as_seen, polygons, quote
from .mesh import Mesh

_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
VERTICES, _INDICES = 34962, 34963     # what a graphics card will use the numbers for
_NUMBERS = {np.dtype(kind).str: number for number, kind in _COMPONENTS.items()}
GENERATOR = "scapekit"
_TURNS = {"x": 0, "y": 1, "z": 2}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


def read(path: Path, data: bytes) -> Contents:
    """The meshes of the scene one after the other, in scene coordinates; points and lines are left out.

    The axes are those of the body where the file tells which of them was turned to y. A mesh that hangs on joints is
    taken as it is stored, in its bind pose.
    """
    tree, binary = chunks_of(path, data)
    with storage.taking_apart(path, "a whole GLB file", MeshFileError), np.errstate(all="ignore"):
        return _scene(path, tree, binary)


def _scene(path: Path, tree: dict[str, Any], binary: bytes) -> Contents:
    needed = tree.get("extensionsRequired", [])
    if any("draco" in name.lower() or "meshopt" in name.lower() for name in needed):
        raise MeshFileError(f"{path}: expected a GLB file that is not compressed, it needs {', '.join(needed)}")
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    colors: list[np.ndarray | None] = []
    objects: list[tuple[str, int]] = []
    start, most = 0, 10**6 + 4 * len(binary)    # many nodes may show one mesh, but not without end
    for number, node, matrix in nodes_of(tree):
        if "mesh" not in node:
            continue
        before = len(faces)
        matrix = np.eye(4) if "skin" in node else matrix
        placed: dict[int, int] = {}                      # primitives may share their vertices
        for primitive in item(tree["meshes"], node["mesh"])["primitives"]:
            if primitive.get("mode", 4) not in (4, 5, 6):         # triangles, a strip, a fan
                continue
            points = primitive["attributes"]["POSITION"]
            if points not in placed:
                local = accessor(tree, binary, points, "VEC3").astype(np.float64)
                placed[points] = start
                vertices.append(local @ matrix[:3, :3].T + matrix[:3, 3])      # what is not finite is refused later
                colors.append(_colors(tree, binary, primitive, len(local)))
                start += len(local)
            count = tree["accessors"][points]["count"]
            corners = triangles_of(tree, binary, primitive, count)
            if np.linalg.det(matrix[:3, :3]) < 0:
                corners = corners[:, ::-1]
            faces.append(polygons(path, np.full(len(corners), 3), corners.ravel(), count) + placed[points])
            most -= count + 3 * len(corners) + 1
            if most < 0:
                raise ValueError("it shows its meshes too often")
        if len(faces) > before:
            name = node.get("name") or tree["meshes"][node["mesh"]].get("name") or f"node {number}"
            objects.append((str(name), sum(map(len, faces[before:]))))
    if not faces:
        raise MeshFileError(f"{path}: expected a mesh, found a GLB file without triangles")
    shades = [c for c in colors if c is not None]
    return Contents(np.concatenate(vertices) @ turn_up(up_of(tree)), np.concatenate(faces), None,
                    np.concatenate(shades) if len(shades) == len(colors) else None, tuple(objects))


def turn_up(up: int) -> np.ndarray:
    """The rotation (3, 3) that brings an axis to +y; points, poses and trans turn as `x @ turn_up(up).T`.

    A rotation vector turns like a point because the axes of all parts are those of the world at rest.
    """
    if up not in (0, 1, 2):
        raise ValueError(f"up: expected 0, 1 or 2, got {up}")
    return np.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], np.eye(3), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]][up])


def tallest(vertices: np.ndarray) -> int:
    """The axis that is probably up: that of the largest extent.

    Where the next one is nearly as large, as of somebody with the arms spread, it is the next one if the body is alike
    on both sides of the first, and not of that.
    """
    extent = np.ptp(vertices, axis=0)
    first, second = np.argsort(-extent, kind="stable")[:2]
    sided = [np.histogram(vertices[:, axis], 10)[0] for axis in (first, second)]
    here, there = (np.abs(count - count[::-1]).sum() / len(vertices) for count in sided)
    spread = extent[second] > 0.85 * extent[first] and here < 0.25 and here < 0.5 * there
    return int(second if spread else first)


def up_of(tree: dict[str, Any]) -> int:
    """The axis of the body that was turned to y, as the file says; 1, none was turned, where it does not."""
    asset = tree.get("asset")
    if not isinstance(asset, dict) or asset.get("generator") != GENERATOR or not isinstance(asset.get("extras"), dict):
        return 1
    return _TURNS.get(str(asset["extras"].get("up")), 1)


def item(values: list[Any], number: Any) -> Any:
    """The entry of this number, which JSON may have as anything."""
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(values):
        raise ValueError(f"it refers to number {number!r} of {len(values)}")
    return values[number]


def chunks_of(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """The tree of JSON and the binary buffer of a GLB file."""
    if data[:4] != b"glTF" or len(data) < 20:
        raise MeshFileError(f"{path}: expected a GLB file that begins with 'glTF', found {quote(data[:20])}")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise MeshFileError(f"{path}: expected glTF version 2, found version {version}")
    if len(data) < length:
        raise MeshFileError(f"{path}: truncated: expected {length} bytes of GLB, found {len(data)}")
    chunks: dict[bytes, bytes] = {}
    place = 12
    while place + 8 <= length:
        size, kind = struct.unpack_from("<I4s", data, place)
        chunks.setdefault(kind, data[place + 8:place + 8 + size])
        place += 8 + size
    tree = storage.parse_json(path, chunks.get(b"JSON", b""), "a GLB file with a header", MeshFileError)
    if not isinstance(tree, dict):
        raise MeshFileError(f"{path}: damaged GLB file, its JSON is not a table")
    return tree, chunks.get(b"BIN\0", b"")


def nodes_of(tree: dict[str, Any]) -> Iterator[tuple[int, dict[str, Any], np.ndarray]]:
    """Every node of the scene (or below all roots without one), its number and matrix (4, 4), parents first."""
    nodes = tree.get("nodes", [])
    if tree.get("scenes"):
        roots = item(tree["scenes"], tree.get("scene", 0)).get("nodes", [])
    else:
        inner = {child for node in nodes for child in node.get("children", [])}
        roots = [i for i in range(len(nodes)) if i not in inner]
    open_nodes = [(i, np.eye(4)) for i in reversed(roots)]
    seen: set[int] = set()
    while open_nodes:
        i, above = open_nodes.pop()
        node = item(nodes, i)
        if i in seen:
            raise ValueError(f"node {i} hangs below two nodes")
        seen.add(i)
        matrix = above @ _matrix(node)
        yield i, node, matrix
        open_nodes += [(child, matrix) for child in reversed(node.get("children", []))]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    R = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                  [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                  [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])
    out = np.eye(4)
    out[:3, :3] = R * np.array(node.get("scale", (1, 1, 1)), dtype=np.float64)
    out[:3, 3] = node.get("translation", (0, 0, 0))
    return out


def accessor(tree: dict[str, Any], binary: bytes, number: int, *types: str) -> np.ndarray:
    """(count, width) the values of an accessor of one of these types."""
    entry = item(tree["accessors"], number)
    kind, count = np.dtype(_COMPONENTS[entry["componentType"]]), entry["count"]
    if entry["type"] not in types:
        raise ValueError(f"accessor {number} is of type {entry['type']!r}, expected {' or '.join(types)}")
    if "sparse" in entry:
        raise ValueError("sparse accessors are not read here")
    view, size = item(tree["bufferViews"], entry["bufferView"]), kind.itemsize * _WIDTHS[entry["type"]]
    start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
    stride = view.get("byteStride", size)
    if start < 0 or count < 0 or stride < size:
        raise ValueError(f"accessor {number}: {count} elements of {size} bytes from byte {start}, one every {stride}")
    if count and start + stride * (count - 1) + size > len(binary):
        raise ValueError(f"truncated: accessor {number} needs {start + stride * count} bytes, found {len(binary)}")
    return np.ndarray((count, _WIDTHS[entry["type"]]), kind, binary, start, (stride, kind.itemsize)).copy()


def triangles_of(tree: dict[str, Any], binary: bytes, primitive: dict[str, Any], count: int) -> np.ndarray:
    """(F, 3) the corners of the triangles, strips or fans of a primitive of `count` vertices."""
    line = (accessor(tree, binary, primitive["indices"], "SCALAR")[:, 0].astype(np.int64) if "indices" in primitive
            else np.arange(count))
    mode = primitive.get("mode", 4)
    if mode == 4:
        return line[:len(line) // 3 * 3].reshape(-1, 3)
    if mode == 6:
        return np.stack([np.full(max(len(line) - 2, 0), line[0]), line[1:-1], line[2:]], axis=1)
    strip = np.stack([line[:-2], line[1:-1], line[2:]], axis=1)
    strip[1::2] = strip[1::2, [1, 0, 2]]
    return strip[(strip != np.roll(strip, 1, axis=1)).all(axis=1)]


def _colors(tree: dict[str, Any], binary: bytes, primitive: dict[str, Any], count: int) -> np.ndarray | None:
    """The vertex colours as they are seen on a screen: glTF stores them linear in light."""
    if "COLOR_0" not in primitive["attributes"]:
        return None
    values = accessor(tree, binary, primitive["attributes"]["COLOR_0"], "VEC3", "VEC4")
    if len(values) != count:
        raise ValueError(f"{len(values)} colours of {count} vertices")
    return as_seen(as_colors(values[:, :3], values.dtype))


def encode(contents: Contents, double: bool) -> bytes:
    """A GLB file of one mesh with normals, in single precision whatever `double` says."""
    assert contents.faces is not None, "a GLB file is written for meshes"
    up = tallest(contents.vertices)
    vertices = contents.vertices @ turn_up(up).T
    glb, normals = Glb(), some_normal(Mesh(vertices, contents.faces))
    indices = glb.add_indices(contents.faces)
    attributes = {"POSITION": glb.add(vertices, "VEC3", VERTICES, bounds=True),
                  "NORMAL": glb.add(normals, "VEC3", VERTICES)}
    if contents.colors is not None:
        attributes["COLOR_0"] = glb.add(as_light(contents.colors), "VEC3", VERTICES)
    return glb.pack({
        "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}]}, up)


class Glb:
    """Arrays gathered into the one buffer of a binary glTF file."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []

    def add(self, array: np.ndarray, kind: str, target: int | None, bounds: bool = False) -> int:
        """An accessor of float32 numbers, one of `kind` a row (a MAT4 column after column); its index.

        `target` is `VERTICES` for what vertices have; glTF wants `bounds` of positions and times.
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

    def add_png(self, data: bytes, name: str) -> dict[str, Any]:
        """An entry of `images`."""
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
                                "componentType": _NUMBERS[values.dtype.str], **extra})
        return len(self._accessors) - 1

    def pack(self, document: dict[str, Any], up: int) -> bytes:
        """The file: header, JSON, buffer; its vertices have been turned by `turn_up(up)`."""
        asset = {"version": "2.0", "generator": GENERATOR, "extras": {"up": "xyz"[up]}}
        document = {"asset": asset, **document,
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
