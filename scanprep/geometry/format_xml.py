"""Read XML formats: COLLADA (`.dae`), and 3MF, a zip with XML. All triangles of the scene, in scene coordinates."""
from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from . import rotations, storage
from .format_common import Contents, MeshFileError, polygons, strip_triangles

_DEEPEST = 100               # deepest nesting of nodes or components; stops cycles


@dataclass
class _Scene:
    """Collects the meshes of a file; every instance is a copy, up to a limit."""

    path: Path
    most: int                                           # vertices and corners allowed for a file of this size
    vertices: list[np.ndarray] = field(default_factory=list)
    faces: list[np.ndarray] = field(default_factory=list)
    colors: list[np.ndarray | None] = field(default_factory=list)
    objects: list[tuple[str, int]] = field(default_factory=list)

    def add(self, name: str, vertices: np.ndarray, faces: np.ndarray, matrix: np.ndarray,
            colors: np.ndarray | None = None) -> None:
        """Add one instance of a mesh, transformed by a matrix (4, 4)."""
        start = sum(map(len, self.vertices))
        self.most -= len(vertices) + 3 * len(faces) + 1
        if self.most < 0:
            raise ValueError("it shows its meshes too often")
        if np.linalg.det(matrix[:3, :3]) < 0:
            faces = faces[:, ::-1]
        self.vertices.append(vertices @ matrix[:3, :3].T + matrix[:3, 3])
        self.faces.append(polygons(self.path, np.full(len(faces), 3), faces.ravel(), len(vertices)) + start)
        self.colors.append(colors)
        self.objects.append((name, len(faces)))

    def contents(self, metres: float) -> Contents:
        """Return all meshes as one; colours only if all have them."""
        if not sum(map(len, self.faces)):
            raise MeshFileError(f"{self.path}: expected a mesh, found no triangles")
        shades = [c for c in self.colors if c is not None]
        return Contents(np.concatenate(self.vertices), np.concatenate(self.faces), None,
                        np.concatenate(shades) if len(shades) == len(self.colors) else None, tuple(self.objects),
                        metres=metres)


def _parse(data: bytes) -> ElementTree.Element:
    """Parse a document; return its root, with names without namespaces."""
    if b"<!ENTITY" in data:
        raise ValueError("it declares entities of its own, which no mesh needs")
    root = ElementTree.fromstring(data)
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
        for name in [name for name in element.attrib if "}" in name]:
            element.attrib[name.rpartition("}")[2]] = element.attrib.pop(name)
    return root


def _numbers(text: str | None, kind: type = np.float64) -> np.ndarray:
    """Parse a list of numbers; some programs write decimal commas."""
    return np.array((text or "").replace(",", ".").split(), dtype=kind)


# ---- COLLADA

def read_dae(path: Path, data: bytes) -> Contents:
    """Read the meshes of the scene of a COLLADA file in its own unit; lines are left out.

    Skinned meshes are in their bind pose.
    """
    with storage.taking_apart(path, "a whole COLLADA file", MeshFileError), np.errstate(all="ignore"):
        root = _parse(data)
        if root.tag != "COLLADA":
            raise ValueError(f"it begins with {root.tag}")
        scene, ids = _Scene(path, 10**6 + 4 * len(data)), {e.attrib["id"]: e for e in root.iter() if "id" in e.attrib}
        shown = root.find("scene/instance_visual_scene")
        top = root.findall("library_visual_scenes/visual_scene") if shown is None else [_follow_link(ids, shown)]
        for mesh, name, matrix in (found for part in top for found in _instances(part, np.eye(4), ids, 0)):
            vertices, faces, colors = _geometry(path, mesh, ids)
            scene.add(name, vertices, faces, matrix, colors)
        unit = root.find("asset/unit")
        metres = 1.0 if unit is None else float(unit.get("meter", "1").replace(",", "."))
    return scene.contents(metres if np.isfinite(metres) and metres > 0 else 1.0)


def _follow_link(ids: dict[str, ElementTree.Element], element: ElementTree.Element, key: str = "url"
                 ) -> ElementTree.Element:
    """Return the element that another one refers to."""
    return ids[element.attrib[key].removeprefix("#")]


def _instances(node: ElementTree.Element, matrix: np.ndarray, ids: dict[str, ElementTree.Element], depth: int
               ) -> Iterator[tuple[ElementTree.Element, str, np.ndarray]]:
    """Yield the geometries below a node, with name and matrix (4, 4) to the scene."""
    if depth > _DEEPEST:
        raise ValueError("its nodes hang below each other without end")
    for child in node:
        matrix = matrix @ _matrix(child)
        if child.tag == "node":
            yield from _instances(child, matrix, ids, depth + 1)
        elif child.tag == "instance_node":
            yield from _instances(_follow_link(ids, child), matrix, ids, depth + 1)
        elif child.tag in ("instance_geometry", "instance_controller"):
            shown, place = _follow_link(ids, child), matrix
            while shown.tag == "controller":             # a skin, or a morph of a geometry
                inner = shown[0] if shown[0].tag in ("skin", "morph") else shown[1]
                bound = inner.find("bind_shape_matrix")
                place = np.eye(4) if bound is None else _numbers(bound.text).reshape(4, 4)
                shown = _follow_link(ids, inner, "source")
            yield shown, str(node.get("name") or shown.get("name") or shown.get("id")), place


def _matrix(element: ElementTree.Element) -> np.ndarray:
    """Return the matrix (4, 4) of one transform element of a node; the identity for any other element."""
    M = np.eye(4)
    if element.tag == "matrix":
        return _numbers(element.text).reshape(4, 4)
    if element.tag == "translate":
        M[:3, 3] = _numbers(element.text)
    elif element.tag == "scale":
        M[:3, :3] = np.diag(_numbers(element.text))
    elif element.tag == "rotate":
        *axis, degrees = _numbers(element.text)
        M[:3, :3] = rotations.exp(np.radians(degrees) * np.array(axis) / max(float(np.linalg.norm(axis)), 1e-12))
    elif element.tag in ("lookat", "skew"):
        raise ValueError(f"it places its meshes by {element.tag}, which is not read here")
    return M


def _geometry(path: Path, geometry: ElementTree.Element, ids: dict[str, ElementTree.Element]
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read vertices (N, 3), triangles (F, 3) and, if all vertices have them, colours (N, 3) of a geometry."""
    mesh = geometry.find("mesh")
    if mesh is None:
        raise ValueError(f"geometry {geometry.get('id')!r} is no mesh")
    vertices = _source(ids, next(i for i in mesh.iterfind("vertices/input") if i.get("semantic") == "POSITION"))
    colors = np.full((len(vertices), 3), np.nan)
    faces = [np.zeros((0, 3), dtype=np.int64)]
    for primitive in mesh:
        if primitive.tag not in ("triangles", "polylist", "polygons", "tristrips", "trifans"):
            continue
        # corners of a primitive interleave the indices of several inputs: pick those of vertices and colours
        inputs = {str(i.get("semantic")): (int(i.get("offset", 0)), i) for i in primitive.iterfind("input")}
        first, width = inputs["VERTEX"][0], max(offset for offset, _ in inputs.values()) + 1
        rows = [_numbers(p.text, np.int64) for p in primitive.iter("p")]
        lists = [row[first::width] for row in rows]
        corners, sizes = np.concatenate([np.zeros(0, np.int64), *lists]), np.array([len(p) for p in lists], np.int64)
        if "COLOR" in inputs:
            offset, source = inputs["COLOR"]
            colors[corners] = _source(ids, source)[np.concatenate([row[offset::width] for row in rows])]
        if primitive.tag == "tristrips":
            faces.append(strip_triangles(corners, sizes))
        elif primitive.tag == "trifans":
            faces += [np.stack([np.full(len(p) - 2, p[0]), p[1:-1], p[2:]], axis=1) for p in lists if len(p) > 2]
        else:
            if primitive.tag == "triangles":
                sizes = np.full(len(corners) // 3, 3)
            elif primitive.tag == "polylist":
                sizes = _numbers(primitive.findtext("vcount"), np.int64)
            elif primitive.find("ph") is not None:
                raise ValueError("it has polygons with holes, which are not read here")
            faces.append(polygons(path, sizes, corners, len(vertices), vertices=vertices))
    return vertices, np.concatenate(faces), np.clip(colors, 0, 1) if np.isfinite(colors).all() else None


def _source(ids: dict[str, ElementTree.Element], element: ElementTree.Element) -> np.ndarray:
    """Read the first three numbers (n, 3) of every row of the source of an input."""
    accessor = _follow_link(ids, element, "source").find("technique_common/accessor")
    if accessor is None:
        raise ValueError("a source without accessor")
    stride, first = int(accessor.get("stride", 1)), int(accessor.get("offset", 0))
    values = _numbers(_follow_link(ids, accessor, "source").text)[first:]
    return np.asarray(values[:len(values) // stride * stride].reshape(-1, stride)[:, :3])


# ---- 3MF

def read_3mf(path: Path, data: bytes) -> Contents:
    """Read the meshes that a 3MF file builds, in its own unit; supports are left out."""
    unpacked = 100  # largest packing ratio; meshes have about ten, more is a decompression bomb
    factors = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}
    with (storage.taking_apart(path, "a whole 3MF file", MeshFileError), np.errstate(all="ignore"),
          zipfile.ZipFile(io.BytesIO(data)) as archive):
        if sum(info.file_size for info in archive.infolist()) > 2**24 + unpacked * len(data):
            raise ValueError("it would unpack to far more than a mesh has")
        names = {"/" + name.lower().lstrip("/"): name for name in archive.namelist()}
        links = _parse(archive.read(names["/_rels/.rels"]))
        start = next(e.attrib["Target"] for e in links.iter("Relationship") if e.attrib["Type"].endswith("3dmodel"))
        scene, parts = _Scene(path, 10**6 + 4 * unpacked * len(data)), dict[str, ElementTree.Element]()

        def part(name: str) -> ElementTree.Element:
            """Parse a part of the archive once."""
            key = "/" + name.lower().lstrip("/")
            if key not in parts:
                parts[key] = _parse(archive.read(names[key]))
            return parts[key]

        def show(name: str, number: str, matrix: np.ndarray, depth: int) -> None:
            """Add an object and its components to the scene."""
            if depth > _DEEPEST:
                raise ValueError("its components hang below each other without end")
            thing = next(e for e in part(name).iterfind("resources/object") if e.get("id") == number)
            if thing.get("type") == "support":
                return
            for component in thing.iterfind("components/component"):
                show(component.get("path", name), component.attrib["objectid"], matrix @ _transform(component),
                     depth + 1)
            if thing.find("mesh") is not None:
                vertices = _table(thing.iterfind("mesh/vertices/vertex"), ("x", "y", "z"), np.float64)
                faces = _table(thing.iterfind("mesh/triangles/triangle"), ("v1", "v2", "v3"), np.int64)
                scene.add(thing.get("name") or f"object {number}", vertices, faces, matrix)

        for item in part(start).iterfind("build/item"):
            show(item.get("path", start), item.attrib["objectid"], _transform(item), 0)
        metres = factors[part(start).get("unit", "millimeter")]
    return scene.contents(metres)


def _transform(element: ElementTree.Element) -> np.ndarray:
    """Return the matrix (4, 4) of an element; its twelve numbers act on row vectors."""
    M = np.eye(4)
    if "transform" in element.attrib:
        M[:3] = _numbers(element.attrib["transform"]).reshape(4, 3).T
    return M


def _table(elements: Iterator[ElementTree.Element], names: tuple[str, ...], kind: type) -> np.ndarray:
    """Read attributes of elements as a table (n, k)."""
    rows = [[element.attrib[name] for name in names] for element in elements]
    return np.array(rows, dtype=kind).reshape(-1, len(names))
