"""Shapes as compact bytes for the browser; `viewer/source/unpack.js` unpacks them.

A packed scene is compressed (zlib) and holds the length of its header, the header in JSON, and columns of numbers.
Positions are in steps of 1/65535 of a shape's extent, 0.03 mm for a person. A motion is stored as a few columns times
coefficients per frame, so that a long motion takes little more than a short one.
"""
from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..geometry.mesh import Mesh
from .camera import Camera
from .colors import Heat, heat
from .low_rank import low_rank
from .shading import Bones, Dots, Moving, Shape, Solid, own_color, render
from .sheets import contact_sheet
from .thinning import of_vertices, thin_solid

SCENE = "picture.scene"              # file beside a picture, for the page of many results
SMALL = 8000                         # triangles of a shape in it: 20 of them fit on a page
MOST_TURN, MOST_BYTES = 20, 4_000_000        # figures that turn on a page of many, and their bytes
NO_INDEX = 255                       # palette index of vertices without a value; indices below are colours


@dataclass(frozen=True, eq=False)
class Pane:
    """Shapes that are seen together, and the camera that sees them first."""

    shapes: Sequence[Shape | Moving]
    camera: Camera
    label: str = ""


def match_camera_scales(panes: Sequence[Pane]) -> list[Pane]:
    """Give all panes cameras of one scale, so that bodies beside each other can be compared."""
    sizes = {side: max(getattr(pane.camera, side) for pane in panes) for side in ("width", "height", "distance")}
    return [replace(pane, camera=replace(pane.camera, **sizes)) for pane in panes]


def picture_pane(pane: Pane, width: int, height: int) -> np.ndarray:
    """Render what the camera of a pane sees first, (height, width, 3) uint8."""
    shapes = [shape.shape if isinstance(shape, Moving) else shape for shape in pane.shapes
              if not isinstance(shape, Moving) or np.isfinite(shape.frames[0]).any()]
    return render([shape for shape in shapes if isinstance(shape, Mesh) or shape.visible], pane.camera, width, height)


def picture_panes(panes: Sequence[Pane], height: int, columns: int | None = None) -> np.ndarray:
    """Render what the cameras see first, side by side, (H, W, 3) uint8."""
    images = [picture_pane(pane, max(110, int(height * pane.camera.width / pane.camera.height) + 10), height)
              for pane in panes]
    labels = [pane.label for pane in panes]
    return contact_sheet(images, labels if any(labels) else None, columns=columns)


def pack_scene(panes: Sequence[Pane], whole: bool = False) -> bytes:
    """Pack panes into bytes; `whole` keeps all triangles, for bodies whose vertices will be moved."""
    columns = _Columns()
    # version that the viewer checks
    header = {"format": 1, "panes": [
        {"label": pane.label, "camera": _camera(pane.camera), "origin": pane.camera.target.tolist(),
         "layers": [_layer(shape, pane.camera.target, columns, whole) for shape in pane.shapes]} for pane in panes]}
    text = json.dumps({**header, "columns": columns.described}, allow_nan=False).encode()
    text += b" " * (-len(text) % 4)        # numbers begin at a multiple of 4 bytes, as JavaScript needs it
    # level 9 takes ten times as long for 3% less
    return zlib.compress(len(text).to_bytes(4, "little") + text + columns.data, 6)


def small_scene(panes: Sequence[Pane]) -> bytes:
    """Pack a scene with fewer triangles, for a page of many results."""
    thinned = [replace(pane, shapes=[thin_solid(shape if isinstance(shape, Solid) else Solid(shape), SMALL)
                                     if isinstance(shape, Solid | Mesh) else shape for shape in pane.shapes])
               for pane in match_camera_scales(panes)]
    return pack_scene(thinned)


def worst_that_turn(paths: Sequence[Path]) -> list[bytes | None]:
    """Read the packed scenes of files, worst first, as many as a page can carry; None for the others."""
    return [*embed_files(paths[:MOST_TURN], MOST_BYTES), *(None for _ in paths[MOST_TURN:])]


def embed_files(paths: Iterable[Path], bytes_left: int) -> list[bytes | None]:
    """Read files as long as they fit into so many bytes; None where there is no file, or no room."""
    out = list[bytes | None]()
    for path in paths:
        contents = path.read_bytes() if path.is_file() and bytes_left > 0 else None
        bytes_left -= len(contents or b"")
        out.append(contents if bytes_left >= 0 else None)
    return out


@dataclass
class _Columns:
    """Arrays that go into one file, equal ones only once."""

    described: list[dict[str, Any]] = field(default_factory=list)
    data: bytes = b""
    _known: dict[bytes, int] = field(default_factory=dict)

    def add(self, values: np.ndarray, differences: bool = False) -> int:
        """Add values (n, width) and return their number; differences of consecutive rows may compress better."""
        values = np.ascontiguousarray(values.reshape(len(values), int(np.prod(values.shape[1:]))))     # may be empty
        rows, width = values.shape
        if differences:
            # zigzag code: differences 0, -1, 1, -2, ... become 0, 1, 2, 3, ..., small numbers that compress well
            steps = np.diff(values, axis=0, prepend=np.zeros_like(values[:1]))
            signed = steps.view(steps.dtype.str.replace("u", "i"))
            values = ((signed << 1) ^ (signed >> (8 * signed.itemsize - 1))).view(steps.dtype)
        kind = values.dtype.str[1:]
        # all lowest bytes first, then the next ones: neighbouring bytes are alike and compress well
        planes = values.astype(values.dtype.newbyteorder("<")).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
        key = kind.encode() + planes
        if key not in self._known:
            self._known[key] = len(self.described)
            self.described.append({"at": len(self.data), "type": kind, "rows": rows, "width": width,
                                   "differences": differences})
            self.data += planes
        return self._known[key]


def _camera(camera: Camera) -> dict[str, Any]:
    """Describe a camera that looks at the origin."""
    return {"target": [0, 0, 0], "back": camera.axes[2].tolist(), "distance": camera.distance,
            "up": camera.vertical.tolist(), "width": camera.width, "height": camera.height}


def _layer(shape: Shape | Moving, origin: np.ndarray, columns: _Columns, whole: bool) -> dict[str, Any]:
    """Describe one shape of a pane, and add its numbers to the columns."""
    if isinstance(shape, Moving):
        return {**_layer(shape.shape, origin, columns, True), "motion": _motion(shape, origin, columns)}
    if isinstance(shape, Mesh):
        shape = Solid(shape)
    if isinstance(shape, Solid):
        shape = shape if whole else thin_solid(shape)
        points = shape.mesh.vertices
        first = shape.color if isinstance(shape.color, Heat) else own_color(shape)
        shades = [_shade(name, shade, shape.mesh, columns) for name, shade in {"": first, **shape.shades}.items()]
        appearance = {"kind": "mesh", "opacity": shape.opacity, "smooth": shape.smooth, "shades": shades,
                      "faces": columns.add(shape.mesh.faces.astype(np.uint32), True)}
    else:
        rods = isinstance(shape, Bones)
        points = np.stack([shape.starts, shape.ends], axis=1) if isinstance(shape, Bones) else shape.points
        color = shape.color if isinstance(shape.color, Heat) else np.asarray(shape.color, dtype=float)
        color = np.repeat(color, 2, axis=0) if rods and not isinstance(color, Heat) and color.ndim == 2 else color
        appearance = {"kind": "bones" if rods else "dots", "radius": shape.radius, "on_top": shape.on_top,
                      "shades": [_shade("", color, None, columns)],
                      "labels": list(shape.labels) if isinstance(shape, Dots) else []}
    # points that are not finite cannot be stored: they are listed as hidden
    points = np.asarray(points, dtype=float).reshape(-1, 3) - origin
    known = np.isfinite(points).all(axis=1)
    return {"name": shape.name, "visible": shape.visible, **appearance, "hidden": np.flatnonzero(~known).tolist(),
            "positions": _positions(np.where(known[:, None], points, 0.0), columns)}


def _positions(points: np.ndarray, columns: _Columns) -> dict[str, Any]:
    """Store points in steps of 1/65535 of their extent."""
    if not len(points):
        return {"column": columns.add(np.zeros((0, 3), dtype=np.uint16)), "low": [0, 0, 0], "step": 1}
    low = points.min(axis=0)
    step = max(float(np.ptp(points, axis=0).max()), 1e-9) / 65535
    return {"column": columns.add(np.round((points - low) / step).astype(np.uint16), True), "low": low.tolist(),
            "step": step}


def _shade(name: str, shade: Any, mesh: Mesh | None, columns: _Columns) -> dict[str, Any]:
    """Describe one colouring of a shape: values with a legend, a colour per vertex, or one for all."""
    if isinstance(shade, Heat):
        # values: an index into 255 colours, the last entry for vertices without a value
        share = (shade.values - shade.low) / max(shade.high - shade.low, 1e-30)
        index = np.where(np.isnan(share), NO_INDEX, np.round((NO_INDEX - 1) * np.clip(np.nan_to_num(share), 0, 1)))
        ramp = heat(np.append(np.linspace(0, 1, NO_INDEX), np.nan), 0, 1)
        return {"name": name or shade.title, "index": columns.add(index.astype(np.uint8)),
                "palette": _hex(np.round(255 * ramp)),
                "legend": {"title": shade.title, "low": shade.low, "high": shade.high, "unit": shade.unit,
                           "more": bool((shade.values > shade.high).any())}}
    colors = np.round(255 * np.asarray(shade, dtype=float)).clip(0, 255).astype(np.uint8)
    if colors.ndim == 1:
        return {"name": name, "palette": _hex(colors)}
    if mesh is not None:
        colors = of_vertices(colors, mesh)
    # few different colours are stored as a palette, many as they are
    palette, index = np.unique(colors, axis=0, return_inverse=True)
    if len(palette) <= NO_INDEX:
        return {"name": name, "palette": _hex(palette), "index": columns.add(index.reshape(-1).astype(np.uint8))}
    return {"name": name, "colors": columns.add(colors, True)}


def _hex(colors: np.ndarray) -> str:
    """Return colours as hexadecimal text."""
    return np.asarray(colors, dtype=np.uint8).tobytes().hex()


def _steps(values: np.ndarray, axes: int | tuple[int, ...], factor: np.ndarray | float) -> np.ndarray:
    """Compute the step for storing values in 16 bits, no finer than can be seen when multiplied by `factor`."""
    # 2e-5 metres: finest step of what one column adds to a motion
    return np.maximum(np.abs(values).max(axis=axes, initial=1e-12) / 32767, 2e-5 / np.maximum(factor, 1e-9))


def _motion(moving: Moving, origin: np.ndarray, columns: _Columns) -> dict[str, Any]:
    """Describe frames (T, n, 3) as columns (n, r) times coefficients (T, r, 3), in whole steps; dots as they are."""
    hidden: Mapping[str, Any] = {}
    basis_columns: np.ndarray | None = None
    if moving.columns is not None:                     # moving all points to `origin` lies in the span of the columns
        basis_columns, coefficients = moving.columns
        coefficients = coefficients - np.linalg.lstsq(basis_columns, np.ones(len(basis_columns)))[0][:, None] * origin
    else:
        frames = np.asarray(moving.frames) - origin.astype(moving.frames.dtype)
        known = np.isfinite(frames).all(axis=2)
        hidden = {} if known.all() else {"seen": columns.add(known.astype(np.uint8))}
        coefficients = np.where(known[..., None], frames, np.float32(0))
        if not isinstance(moving.shape, Dots):         # dots move independently, so columns would not help
            basis_columns, coefficients = low_rank(coefficients)
    # round columns and coefficients to 16 bits, with a step of its own per column
    basis, steps, sizes = None, np.ones(coefficients.shape[1]), _steps(coefficients, (0, 2), 1.0)
    if basis_columns is not None:
        steps = _steps(basis_columns, 0, np.abs(coefficients).max(axis=(0, 2)))
        sizes = _steps(coefficients, (0, 2), np.abs(basis_columns).max(axis=0))
        basis = columns.add(np.round(basis_columns / steps).astype(np.int16))
    return {"rate": moving.rate, "frames": len(coefficients), "rank": len(steps), **hidden, "basis": basis,
            "coefficients": columns.add(np.round(coefficients / sizes[:, None]).astype(np.int16).reshape(
                len(coefficients), -1).view(np.uint16), True),
            "scale": (steps * sizes).tolist()}
