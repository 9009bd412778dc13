"""Read and write glTF 2.0 (GLB, or glTF with separate files): all triangles of the scene, placed by their nodes.

glTF has y up, but no axis is assumed to be up here. So written bodies are rotated by the axis from `tallest`, or one
that the caller knows. The file stores that axis in `asset.extras`, and the reader rotates back. Other files are read as
they are.
"""
from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from . import storage
from .budget import spend
from .format_common import Contents, MeshFileError, as_light, as_seen, load_bytes, polygons, quote, strip_triangles
from .mesh import Mesh

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
VERTICES, _INDICES = 34962, 34963     # glTF buffer targets: vertex attributes, indices
_NUMBERS = {np.dtype(kind).str: number for number, kind in _COMPONENTS.items()}
GENERATOR = "scapekit"


_DRACO, _INSTANCES = "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing"
# required extensions that are supported, and prefixes of those that do not change triangles
_KNOWN = ("KHR_mesh_quantization",)
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "MSFT_texture_", "KHR_lights_", "EXT_lights_",
             "KHR_animation_", "KHR_xmp", "KHR_technique")


def read(path: Path, data: bytes) -> Contents:
    """Read all meshes of the scene of a GLB file as one, in scene coordinates.

    Lines are left out, and points if there are triangles. Axes are rotated back if the file says which axis was turned
    to y. Skinned meshes are posed by their joints, as every program shows them.
    """
    tree, binary = chunks_of(path, data)
    with storage.taking_apart(path, "a whole GLB file", MeshFileError), np.errstate(all="ignore"):
        return _scene(path, tree, binary)


def read_gltf(path: Path, data: bytes) -> Contents:
    """Read a `.gltf` file as `read` does: JSON, with buffers inside or in files beside it."""
    tree, binary = read_tree(path, data)
    with storage.taking_apart(path, "a whole glTF file", MeshFileError), np.errstate(all="ignore"):
        return _scene(path, tree, binary)


def read_tree(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON tree of a `.glb` or `.gltf` file and its one buffer, with what lies in files beside it."""
    if path.suffix.lower() != ".gltf":
        return chunks_of(path, data)
    tree = storage.parse_json(path, data, "a glTF file", MeshFileError)
    with storage.taking_apart(path, "a whole glTF file", MeshFileError):
        if not str(tree["asset"]["version"]).startswith("2"):
            raise MeshFileError(f"{path}: expected glTF version 2, found version {tree['asset']['version']}")
        _check_extensions(path, tree)
        return tree, _one_buffer(path, tree, b"")


def _check_extensions(path: Path, tree: dict[str, Any]) -> None:
    """Raise MeshFileError where the triangles need an extension that is not read here."""
    needed = {str(name) for name in tree.get("extensionsRequired", [])}
    needed |= {_INSTANCES} & {str(name) for name in tree.get("extensionsUsed", [])}       # or a part would be missing
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            packed = _DRACO in primitive.get("extensions", {})
            if packed and "bufferView" not in item(tree["accessors"], primitive["attributes"]["POSITION"]):
                needed.add(_DRACO)           # without a copy that is not packed
    unknown = sorted(name for name in needed if name not in _KNOWN and not name.startswith(_HARMLESS))
    if unknown:
        raise MeshFileError(f"{path}: it needs {', '.join(unknown)}, which is not read here; Blender (File > Import, "
                            "then Export, without compression) makes a GLB that is")


def _one_buffer(path: Path, tree: dict[str, Any], binary: bytes) -> bytes:
    """Concatenate all buffers of a file, `binary` being the internal one, and move the buffer views accordingly."""
    buffers, starts, end = list[bytes](), list[int](), 0
    for entry in tree.get("buffers") or [{}]:          # without a list there is only the internal one
        uri = entry.get("uri")
        if uri is None:
            data = binary
        elif uri.startswith("data:"):
            try:
                data = base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as problem:
                raise ValueError(f"a buffer inside is damaged ({problem})") from None
        else:
            try:
                data = load_bytes(file_beside(path, uri))
            except MeshFileError as problem:
                raise MeshFileError(f"{path}: its numbers cannot be read ({problem})") from None
        spend(memory=len(data), visits=1)            # many may be the same file, or the internal one
        buffers.append(data + b"\0" * (-len(data) % 4))
        starts.append(end)
        end += len(buffers[-1])
    for view in tree.get("bufferViews", []):
        view["byteOffset"] = view.get("byteOffset", 0) + item(starts, view["buffer"])
    return b"".join(buffers)


def file_beside(path: Path, name: str) -> Path:
    """Return the path of a file that another one names; MeshFileError if it is outside that one's folder."""
    try:
        return storage.path_inside(path.parent, unquote(name), path)
    except storage.StorageError as problem:
        raise MeshFileError(str(problem)) from None


def _scene(path: Path, tree: dict[str, Any], binary: bytes) -> Contents:
    """Collect vertices, triangles and colours of all nodes of the scene."""
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    colors: list[np.ndarray | None] = []
    objects: list[tuple[str, int]] = []
    start = 0
    nodes = list(nodes_of(tree))
    places = {number: matrix for number, _, matrix in nodes}
    kinds = {p.get("mode", 4) for mesh in tree.get("meshes", []) for p in mesh["primitives"]}
    shown = {4, 5, 6} if kinds & {4, 5, 6} else {0}             # triangles, strips, fans; or a cloud of points
    for number, node, matrix in nodes:
        if "mesh" not in node:
            continue
        name = node.get("name") or item(tree["meshes"], node["mesh"]).get("name") or f"node {number}"
        joints = joint_matrices(tree, binary, item(tree["skins"], node["skin"]), places) if "skin" in node else None
        # every primitive of the node's mesh; skinned vertices by their joints, others by the matrix
        before = len(faces)
        placed: dict[tuple[int, Any], int] = {}                # primitives may share their vertices
        for primitive in tree["meshes"][node["mesh"]]["primitives"]:
            spend(visits=1)
            if primitive.get("mode", 4) not in shown:
                continue
            points = primitive["attributes"]["POSITION"], primitive["attributes"].get("JOINTS_0")
            local = accessor(tree, binary, points[0], "VEC3").astype(np.float64)
            if points not in placed:
                placed[points] = start
                if joints is not None and points[1] is not None:
                    vertices.append(apply_skin(local, weights_of(tree, binary, primitive, len(joints)), joints))
                else:
                    vertices.append(local @ matrix[:3, :3].T + matrix[:3, 3])
                colors.append(_colors(tree, binary, primitive, len(local)))
                start += len(local)
            corners = np.zeros((0, 3), int)
            if 0 not in shown:
                corners = primitive_triangles(tree, binary, primitive, len(local))
            # a mirroring matrix inverts triangles
            if np.linalg.det((matrix if joints is None else joints[0])[:3, :3]) < 0:
                corners = corners[:, ::-1]
            faces.append(polygons(path, np.full(len(corners), 3), corners.ravel(), len(local)) + placed[points])
        if len(faces) > before:
            objects.append((str(name), sum(map(len, faces[before:]))))
    if not vertices:
        raise MeshFileError(f"{path}: expected a mesh, found a glTF file without triangles and points")
    shades = [c for c in colors if c is not None]
    return Contents(np.concatenate(vertices) @ turn_up(up_of(tree)), np.concatenate(faces), None,
                    np.concatenate(shades) if len(shades) == len(colors) else None, tuple(objects), up=up_of(tree))


def joint_matrices(tree: dict[str, Any], binary: bytes, skin: dict[str, Any], places: dict[int, np.ndarray]
                   ) -> np.ndarray:
    """Compute the skinning matrices (J, 4, 4): joint matrix times inverse bind matrix."""
    missing = [number for number in skin["joints"] if number not in places]
    if missing:
        raise ValueError(f"joint {missing[0]} does not stand in the scene")
    motion = np.stack([places[number] for number in skin["joints"]])
    if "inverseBindMatrices" in skin:
        inverse = accessor(tree, binary, skin["inverseBindMatrices"], "MAT4").astype(np.float64)
        motion = motion @ inverse[:len(motion)].reshape(len(motion), 4, 4).swapaxes(1, 2)
    return motion


def weights_of(tree: dict[str, Any], binary: bytes, primitive: dict[str, Any], joints: int) -> np.ndarray:
    """Read the blend weights (n, J) of a primitive; rows sum to one."""
    attributes = primitive["attributes"]
    count = item(tree["accessors"], attributes["POSITION"])["count"]
    sets = sorted(name for name in attributes if name.startswith("WEIGHTS_"))
    if not sets:
        raise ValueError("it has no weights (WEIGHTS_0): nothing says how the joints move its vertices")
    spend(memory=16 * count * joints)
    weights = np.zeros((count, joints))
    for name in sets:
        shares = accessor(tree, binary, attributes[name], "VEC4").astype(np.float64)
        carriers = accessor(tree, binary, attributes[name.replace("WEIGHTS", "JOINTS")], "VEC4").astype(np.int64)
        if len(carriers) != count or len(shares) != count or carriers.max(initial=0) >= joints:
            raise ValueError(f"{name}: expected four of {joints} joints for each of {count} vertices")
        if not (np.isfinite(shares).all() and (shares >= 0).all()):
            raise ValueError(f"{name}: expected numbers of at least 0")
        np.add.at(weights, (np.arange(count)[:, None], carriers), shares)
    total = weights.sum(axis=1, keepdims=True)
    bare = np.flatnonzero(total[:, 0] < 1e-3)
    if len(bare):
        raise ValueError(f"{len(bare)} vertices have no weights, the first is vertex {bare[0]}")
    return np.asarray(weights / total)


def apply_skin(points: np.ndarray, weights: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Apply linear blend skinning to points (n, 3): weights (n, J), matrices (J, 4, 4)."""
    if np.allclose(joints, np.eye(4), atol=1e-6):            # bind pose: keep the exact numbers
        return points
    one = np.column_stack([points, np.ones(len(points))])
    return np.asarray(np.einsum("nj,jab,nb->na", weights, joints, one, optimize=True)[:, :3])


def turn_up(up: int) -> np.ndarray:
    """Return the rotation (3, 3) that takes an axis to +y; points, poses and trans transform as `x @ turn_up(up).T`.

    Rotation vectors transform like points, because all part frames are parallel to the world at rest.
    """
    if up not in (0, 1, 2):
        raise ValueError(f"up: expected 0, 1 or 2, got {up}")
    return np.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], np.eye(3), [[1, 0, 0], [0, 0, 1], [0, -1, 0]]][up])


def tallest(vertices: np.ndarray) -> int:
    """Guess the axis that is up: that of the largest extent.

    With spread arms the second extent is nearly as large. Then the second axis is up if the body is symmetric along the
    first one, and not along the second.
    """
    extent = np.ptp(vertices, axis=0)
    first, second = np.argsort(-extent, kind="stable")[:2]
    # asymmetry of the histograms along both axes; limits separate people with spread arms
    sided = [np.histogram(vertices[:, axis], 10)[0] for axis in (first, second)]
    here, there = (np.abs(count - count[::-1]).sum() / len(vertices) for count in sided)
    spread = extent[second] > 0.85 * extent[first] and here < 0.25 and here < 0.5 * there
    return int(second if spread else first)


def up_of(tree: dict[str, Any]) -> int:
    """Return the axis of the body that was rotated to y, as the file says; 1 (no rotation) if it does not."""
    asset = tree.get("asset")
    if not isinstance(asset, dict) or asset.get("generator") != GENERATOR or not isinstance(asset.get("extras"), dict):
        return 1
    turns = {"x": 0, "y": 1, "z": 2}
    return turns.get(str(asset["extras"].get("up")), 1)


def item(values: list[Any], number: Any) -> Any:
    """Return the entry of this number; ValueError for anything that is no valid index."""
    if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < len(values):
        raise ValueError(f"it refers to number {number!r} of {len(values)}")
    return values[number]


def chunks_of(path: Path, data: bytes) -> tuple[dict[str, Any], bytes]:
    """Split a GLB file into its JSON tree and its binary buffer."""
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
    with storage.taking_apart(path, "a whole GLB file", MeshFileError):
        _check_extensions(path, tree)
        return tree, _one_buffer(path, tree, chunks.get(b"BIN\0", b""))


def nodes_of(tree: dict[str, Any]) -> Iterator[tuple[int, dict[str, Any], np.ndarray]]:
    """Yield every node of the scene (or all nodes without one): number, node and world matrix (4, 4), parents first."""
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
        spend(visits=1)
        matrix = above @ _matrix(node)
        yield i, node, matrix
        open_nodes += [(child, matrix) for child in reversed(node.get("children", []))]


def _matrix(node: dict[str, Any]) -> np.ndarray:
    """Return the local matrix (4, 4) of a node: given, or from translation, rotation and scale."""
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
    """Read an accessor (count, width) of one of these types; normalised integers become floats."""
    entry = item(tree["accessors"], number)
    kind, count = np.dtype(_COMPONENTS[entry["componentType"]]), entry["count"]
    if entry["type"] not in types:
        raise ValueError(f"accessor {number} is of type {entry['type']!r}, expected {' or '.join(types)}")
    width = WIDTHS[entry["type"]]
    if not isinstance(count, int) or count < 0:
        raise ValueError(f"accessor {number}: {count!r} elements")
    if "bufferView" in entry:
        values = _values(tree, binary, f"accessor {number}", entry, kind, count, width)
    else:
        spend(memory=8 * count * width)
        values = np.zeros((count, width), kind)
    if "sparse" in entry:                # some values are replaced
        sparse = entry["sparse"]
        which = _values(tree, binary, f"accessor {number}", sparse["indices"],
                        np.dtype(_COMPONENTS[sparse["indices"]["componentType"]]), sparse["count"], 1)
        values[which[:, 0]] = _values(tree, binary, f"accessor {number}", sparse["values"], kind, sparse["count"],
                                      width)
    if entry.get("normalized") and kind.kind in "iu":
        return np.maximum(values / np.iinfo(kind).max, -1.0)
    return values


def _values(tree: dict[str, Any], binary: bytes, what: str, entry: dict[str, Any], kind: np.dtype, count: int,
            width: int) -> np.ndarray:
    """Copy numbers (count, width) from the buffer, with bounds checked."""
    view, size = item(tree["bufferViews"], entry["bufferView"]), kind.itemsize * width
    start = view.get("byteOffset", 0) + entry.get("byteOffset", 0)
    stride = view.get("byteStride", size)
    if start < 0 or count < 0 or stride < size:
        raise ValueError(f"{what}: {count} elements of {size} bytes from byte {start}, one every {stride}")
    if count and start + stride * (count - 1) + size > len(binary):
        raise ValueError(f"truncated: {what} needs {start + stride * count} bytes, found {len(binary)}")
    spend(memory=8 * count * width)
    return np.ndarray((count, width), kind, binary, start, (stride, kind.itemsize)).copy()


def primitive_triangles(tree: dict[str, Any], binary: bytes, primitive: dict[str, Any], count: int) -> np.ndarray:
    """Return the triangles (F, 3) of a primitive of `count` vertices, from triangles, strips or fans."""
    line = (accessor(tree, binary, primitive["indices"], "SCALAR")[:, 0].astype(np.int64) if "indices" in primitive
            else np.arange(count))
    mode = primitive.get("mode", 4)
    if mode == 4:
        return line[:len(line) // 3 * 3].reshape(-1, 3)
    if mode == 6:
        return np.stack([np.full(max(len(line) - 2, 0), line[0]), line[1:-1], line[2:]], axis=1)
    return strip_triangles(line, np.array([len(line)]))


def _colors(tree: dict[str, Any], binary: bytes, primitive: dict[str, Any], count: int) -> np.ndarray | None:
    """Read vertex colours as sRGB; glTF stores linear light."""
    if "COLOR_0" not in primitive["attributes"]:
        return None
    values = accessor(tree, binary, primitive["attributes"]["COLOR_0"], "VEC3", "VEC4")
    if len(values) != count:
        raise ValueError(f"{len(values)} colours of {count} vertices")
    return as_seen(values[:, :3].astype(np.float64))


def encode(contents: Contents, double: bool) -> bytes:
    """Encode one mesh with normals as GLB, always in single precision."""
    assert contents.faces is not None, "a GLB file is written for meshes"
    up = tallest(contents.vertices) if contents.up is None else contents.up
    glb, mesh = Glb(), Mesh(contents.vertices @ turn_up(up).T, contents.faces, contents.colors)
    material = {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}
    return glb.pack(one_mesh({"primitives": [glb.add_surface(mesh)]}, material, {}), up)


def one_mesh(mesh: dict[str, Any], material: dict[str, Any], node: dict[str, Any]) -> dict[str, Any]:
    """Build the document of a scene with one mesh in one node, for `Glb.pack`."""
    return {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{**node, "mesh": 0}], "meshes": [mesh],
            "materials": [material]}


class Glb:
    """Collects arrays into the one buffer of a binary glTF file."""

    def __init__(self, tree: dict[str, Any] | None = None, binary: bytes = b"") -> None:
        """Begin empty, or with all arrays of a file: its tree and the one buffer of `read_tree`."""
        self._data = bytearray(binary + b"\0" * (-len(binary) % 4))
        self._views: list[dict[str, Any]] = list((tree or {}).get("bufferViews", []))
        self._accessors: list[dict[str, Any]] = list((tree or {}).get("accessors", []))

    def add(self, array: np.ndarray, kind: str, target: int | None, bounds: bool = False) -> int:
        """Add float32 numbers, one `kind` per row (a MAT4 by columns); return the index of the accessor.

        `target` is `VERTICES` for vertex attributes. glTF requires `bounds` for positions and times.
        """
        values = np.ascontiguousarray(array, dtype="<f4")
        extra: dict[str, Any] = {}
        if bounds:
            rows = values.reshape(len(values), -1).astype(float)
            extra = {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self._append(values, len(values), kind, target, extra)

    def add_indices(self, faces: np.ndarray) -> int:
        """Add the corners of triangles; return the index of the accessor."""
        return self._append(np.ascontiguousarray(faces, dtype="<u4"), faces.size, "SCALAR", _INDICES, {})

    def add_surface(self, mesh: Mesh, normals: np.ndarray | None = None, uv: np.ndarray | None = None,
                    targets: Iterable[np.ndarray] = ()) -> dict[str, Any]:
        """Add a surface with its colours and the first material; return a primitive of `meshes`.

        Unit normals (N, 3) are computed unless given. `uv` (N, 2) are image coordinates, (0, 0) at the lower left.
        `targets` are morph targets: vertex displacements (N, 3), metres; those of normals are added.
        """
        normals = some_normal(mesh) if normals is None else normals
        out: dict[str, Any] = {"attributes": {"POSITION": self.add(mesh.vertices, "VEC3", VERTICES, bounds=True),
                                              "NORMAL": self.add(normals, "VEC3", VERTICES)},
                               "indices": self.add_indices(mesh.faces), "material": 0}
        if mesh.colors is not None:
            out["attributes"]["COLOR_0"] = self.add(as_light(mesh.colors), "VEC3", VERTICES)
        if uv is not None:
            out["attributes"]["TEXCOORD_0"] = self.add(uv * [1, -1] + [0, 1], "VEC2", VERTICES)
        for change in targets:
            turn = some_normal(Mesh(mesh.vertices + change, mesh.faces)) - normals
            out.setdefault("targets", []).append({"POSITION": self.add(change, "VEC3", VERTICES, bounds=True),
                                                  "NORMAL": self.add(turn, "VEC3", VERTICES)})
        return out

    def parts(self) -> tuple[dict[str, Any], bytes]:
        """Return the tree and buffer that `accessor` reads, without a file."""
        return {"bufferViews": self._views, "accessors": self._accessors}, bytes(self._data)

    def add_joints(self, joints: np.ndarray) -> int:
        """Add the four joints (n, 4) of every vertex, in one or two bytes; return the index of the accessor."""
        kind = "|u1" if joints.max(initial=0) < 256 else "<u2"
        return self._append(np.ascontiguousarray(joints, dtype=kind), len(joints), "VEC4", VERTICES, {})

    def add_png(self, data: bytes, name: str) -> dict[str, Any]:
        """Add a PNG image; return its entry of `images`."""
        self._views.append({"buffer": 0, "byteOffset": len(self._data), "byteLength": len(data)})
        self._data += data + b"\0" * (-len(data) % 4)
        return {"name": name, "mimeType": "image/png", "bufferView": len(self._views) - 1}

    def _append(self, values: np.ndarray, count: int, kind: str, target: int | None, extra: dict[str, Any]) -> int:
        """Append values as a new buffer view and accessor; return the index of the accessor."""
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._data), "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        self._data += values.tobytes()
        self._views.append(view)
        self._accessors.append({"bufferView": len(self._views) - 1, "count": count, "type": kind,
                                "componentType": _NUMBERS[values.dtype.str], **extra})
        return len(self._accessors) - 1

    def pack(self, document: dict[str, Any], up: int) -> bytes:
        """Encode the file: header, JSON, buffer. Its vertices have been rotated by `turn_up(up)`."""
        asset = {**document.get("asset", {}), "version": "2.0", "generator": GENERATOR, "extras": {"up": "xyz"[up]}}
        document = {"asset": {}, **document} | {
            "asset": asset, "buffers": [{"byteLength": len(self._data)}], "bufferViews": self._views,
            "accessors": self._accessors}
        text = json.dumps(document, separators=(",", ":")).encode()
        # both chunks are padded to multiples of four bytes
        text += b" " * (-len(text) % 4)
        data = bytes(self._data) + b"\0" * (-len(self._data) % 4)
        size = 12 + 8 + len(text) + 8 + len(data)
        return (struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
                + struct.pack("<I4s", len(data), b"BIN\0") + data)


def some_normal(mesh: Mesh) -> np.ndarray:
    """Return unit normals (N, 3) at all vertices; z without triangles, as glTF allows no zero normal."""
    normals = np.array(mesh.vertex_normals)
    normals[~normals.any(axis=1)] = (0, 0, 1)
    return normals
