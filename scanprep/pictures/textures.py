"""Textures: read them with a scan, bake them onto a body, write them as GLB."""
from __future__ import annotations

import base64
import contextlib
import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..geometry.budget import reading, spend
from ..geometry.format_common import MeshFileError, check_extent, load_bytes, metres_per_unit
from ..geometry.format_glb import (
    WIDTHS,
    Glb,
    chunks_of,
    file_beside,
    one_mesh,
    some_normal,
    tallest,
    turn_up,
    up_of,
)
from ..geometry.images import check_pixels, open_image
from ..geometry.mesh import Mesh
from ..geometry.storage import check_regular, taking_apart, write_file
from ..geometry.surface import Rays, barycentric
from .gltf import skin_material
from .sheets import png_bytes

# function of places (n, 3) and their normals (n, 3) that returns colours (n, 3) and weights (n,)
Look = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture laid on a mesh."""

    mesh: Mesh  # vertices are repeated along the seams between charts
    # (N, 2) float: place of each vertex in the picture, (0, 0) at its lower left corner, (1, 1) at its upper right one
    uv: np.ndarray
    image: np.ndarray  # (H, W, 3) float in [0, 1]: rows from the top

    def scale_by(self, factor: float) -> Texture:
        """Return the texture with all lengths of the mesh multiplied by a factor."""
        return self if factor == 1 else replace(self, mesh=self.mesh.with_vertices(factor * self.mesh.vertices))

    def sample(self, faces: np.ndarray, bary: np.ndarray) -> np.ndarray:
        """Interpolate colours (n, 3) at points on triangles, given by barycentric coordinates."""
        # places repeat outside 0 to 1; exactly 1 must stay 1 and not wrap to 0
        return bilinear(self.image, np.einsum("nc,ncd->nd", bary, self.uv[self.mesh.faces[faces]]) % 1.0000001)


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Interpolate values of an image (H, W) or (H, W, C) at places (n, 2): (n,) or (n, C).

    (0, 0) is the lower left corner of the image, (1, 1) its upper right one; rows from the top.
    """
    from scipy.ndimage import map_coordinates

    height, width = image.shape[:2]
    # centres of pixels are at half numbers
    place = (1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5
    channels = np.moveaxis(np.asarray(image, dtype=float).reshape(height, width, -1), 2, 0)
    values = np.stack([map_coordinates(channel, place, order=1, mode="nearest") for channel in channels], axis=1)
    return values.reshape(len(uv), *image.shape[2:])


def read_texture(path: str | Path, unit: str | None = None) -> Texture | None:
    """Read the texture of an OBJ with its MTL, or of a GLB; None where the file has none.

    Warns where the file names a material whose picture cannot be found.

    Parameters
    ----------
    path : str or Path
        File of the mesh.
    unit : str, optional
        Unit of the mesh, where the file does not say.

    Returns
    -------
    Texture or None

    Raises
    ------
    ValueError
        The mesh cannot be read.
    """
    path = Path(path)
    # a quick look at the bytes: most meshes refer to no picture, and need not be read twice
    word = {".obj": b"mtllib", ".glb": b'"images"'}.get(path.suffix.lower())
    if word is None or word not in load_bytes(path):
        return None
    with taking_apart(path, "a mesh with a texture", MeshFileError):
        return _texture_of(path, unit)


def _texture_of(path: Path, unit: str | None) -> Texture | None:
    """Read the texture of a file that names pictures; see `read_texture`."""
    loaded, found = load_with_materials(path, "load_mesh")
    problems = "; ".join(found.values())
    visual = loaded.visual
    # the picture is in one of two attributes, by kind of material
    pictures = (getattr(getattr(visual, "material", None), name, None) for name in ("image", "baseColorTexture"))
    image = next((image for image in pictures if image is not None), None)
    if image is not None:
        image = np.asarray(image.convert("RGB"), dtype=np.float64)
        image /= 255
    uv = getattr(visual, "uv", None)
    if image is None or uv is None or len(uv) != len(loaded.vertices):
        warnings.warn(f"{path}: it names a texture, but its material file or picture cannot be read; "
                      f"its colours are left out{f' ({problems})' if problems else ''}", stacklevel=2)
        return None
    if problems:
        warnings.warn(f"{path}: some of its pictures cannot be read, what they show is grey ({problems})", stacklevel=2)
    mesh = Mesh(np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces))
    check_extent(path, mesh.vertices)
    with warnings.catch_warnings():          # the reader of the mesh warns about the unit already
        warnings.simplefilter("ignore", UserWarning)
        vertices = metres_per_unit(path, mesh.vertices, unit) * mesh.vertices
    if path.suffix.lower() == ".glb":
        vertices = vertices @ turn_up(up_of(chunks_of(path, load_bytes(path))[0]))
    return Texture(mesh.with_vertices(vertices), np.asarray(uv, dtype=np.float64), image)


def load_with_materials(path: Path, function: Literal["load_mesh", "load_scene"]) -> tuple[Any, dict[str, str]]:
    """Read an OBJ or GLB with a function of trimesh; also say why pictures beside it cannot be read, by name.

    MeshFileError where the file cannot be read.
    """
    import trimesh
    from PIL import Image

    resolver, ending = _beside(path), path.suffix[1:].lower()
    check_regular(path, MeshFileError)
    with reading(path, MeshFileError), taking_apart(path, "a mesh with a texture", MeshFileError), \
            warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)          # of pictures that trimesh opens
        data = load_bytes(path)
        if ending == "glb":
            _check_glb(path, data)
        loaded = getattr(trimesh, function)(io.BytesIO(data), file_type=ending, resolver=resolver, process=False)
    return loaded, resolver.problems


def _check_glb(path: Path, data: bytes) -> None:
    """Spend what trimesh makes of a GLB: all its arrays and pictures, shown or not."""
    from PIL import Image

    tree, binary = chunks_of(path, data)
    for entry in tree.get("accessors", []):
        spend(memory=8 * entry["count"] * WIDTHS.get(entry["type"], 9))
    for entry in tree.get("images", []):
        if "bufferView" in entry:
            view = tree["bufferViews"][entry["bufferView"]]
            start = view.get("byteOffset", 0)
            picture = binary[start:start + view["byteLength"]]
        elif entry["uri"].startswith("data:"):
            picture = base64.b64decode(entry["uri"].partition(",")[2])
        else:
            continue                     # beside the file, see `_beside`
        with contextlib.suppress(OSError):           # one that trimesh cannot open either, and leaves out
            check_pixels(Image.open(io.BytesIO(picture)).size)


def _beside(path: Path) -> Any:
    """Make the object through which trimesh reads files named by a mesh; it keeps why one cannot be read.

    Only files beside the mesh or below are read.
    """
    from trimesh.resolvers import Resolver

    class Beside(Resolver):
        def __init__(self) -> None:
            self.problems: dict[str, str] = {}

        def get(self, name: str) -> bytes:
            try:
                data = load_bytes(file_beside(path, name.strip()))
                if not name.lower().endswith((".mtl", ".bin")):
                    with open_image(name.strip(), "a picture", data) as image:
                        image.load()
                return data
            except (OSError, ValueError) as problem:
                self.problems[name.strip()] = " ".join(str(problem).split())
                raise FileNotFoundError(name) from problem

        def write(self, name: str, data: bytes) -> None:
            raise NotImplementedError

        def keys(self) -> list[str]:
            return []

        def namespaced(self, namespace: str) -> Any:
            return self

    return Beside()


def bake_body_texture(body: Mesh, look: Look, unseen: np.ndarray, size: int = 1024) -> Texture:
    """Bake a texture of a body.

    Parameters
    ----------
    body : Mesh
        The body.
    look : callable
        Returns colours (n, 3) and weights (n,) of places (n, 3) with normals (n, 3).
    unseen : (N, 3) float in [0, 1]
        Colours of vertices, used where the weight is zero.
    size : int, pixels
        Width and height of the picture.

    Returns
    -------
    Texture
    """
    old_vertex, faces, uv = unwrap(body)
    # lay the charts flat, and find the triangle under each pixel by a ray
    flat = Mesh(np.column_stack([uv, np.zeros(len(uv))]), faces)
    centres = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(centres, centres[::-1])
    pixels = np.column_stack([x.ravel(), y.ravel(), np.ones(size**2)])
    face, _ = Rays(flat).cast(pixels, np.array([0.0, 0.0, -1.0]))    # straight down; charts may face either way
    covered = np.flatnonzero(face >= 0)
    # place, normal and colour of the body at each covered pixel
    corners = old_vertex[faces[face[covered]]]
    bary = barycentric(pixels[covered] * (1, 1, 0), flat.corners[face[covered]])
    places, normals, plain = (np.einsum("nc,ncd->nd", bary, values[corners])
                              for values in (body.vertices, body.vertex_normals, unseen))
    colors, weight = look(places, normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None])
    image = np.full((size * size, 3), unseen.mean())
    image[covered] = np.where(weight[:, None] > 0, colors, plain)
    return Texture(Mesh(body.vertices[old_vertex], faces), uv, pad_charts(image.reshape(size, size, 3),
                                                                          (face >= 0).reshape(size, size)))


def unwrap(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a mesh into flat charts: the old vertex of each new one (n,), triangles in the old order, uv (n, 2)."""
    try:
        import xatlas
    except ModuleNotFoundError:
        raise ModuleNotFoundError("a texture needs the body unwrapped by xatlas: "
                                  "pip install 'scapekit[textures]'") from None
    old_vertex, faces, uv = xatlas.parametrize(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    return old_vertex.astype(np.int64), faces.astype(np.int64), uv.astype(np.float64)


def pad_charts(image: np.ndarray, covered: np.ndarray) -> np.ndarray:
    """Continue the colours of charts eight pixels beyond their edges, so that seams do not show."""
    from scipy.ndimage import distance_transform_edt

    far, nearest = distance_transform_edt(~covered, return_indices=True)
    return np.where((far <= 8)[:, :, None], image[nearest[0], nearest[1]], image)


def write_textured(path: str | Path, texture: Texture) -> None:
    """Write a textured mesh as GLB with its picture inside, completely or not at all."""
    glb, up = Glb(), tallest(texture.mesh.vertices)
    turn, mesh = turn_up(up).T, texture.mesh
    surface = glb.add_surface(Mesh(mesh.vertices @ turn, mesh.faces), _normals(mesh) @ turn, texture.uv)
    material = skin_material((1, 1, 1))
    material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    image = glb.add_png(png_bytes((255 * np.clip(texture.image, 0, 1) + 0.5).astype(np.uint8)), "texture")
    document = one_mesh({"primitives": [surface]}, material, {"name": "body"})
    write_file(path, glb.pack({**document, "images": [image], "textures": [{"source": 0}]}, up))


def _normals(mesh: Mesh) -> np.ndarray:
    """Compute unit normals (N, 3), equal for vertices at the same place, which are repeated along seams."""
    _, first, place = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    place = place.reshape(-1)
    return some_normal(Mesh(mesh.vertices[first], place[mesh.faces]))[place]
