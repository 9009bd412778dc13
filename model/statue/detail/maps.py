"""A displacement map as files: exact numbers, an image that can be edited, and what the grey values mean [Statues].

=====================  =========================================================================================
displacement.tif       heights in metres, single precision, one channel
displacement.png       heights in 16 bits of grey: `zero` is the value of height 0, `scale` is metres for a step
coverage.png           8 bits: 255 measured, 170 folded, 85 hole, 0 outside the chart; so a hole is never a height
displacement.json      size, zero, scale and these four grey values
=====================  =========================================================================================
"""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from scanprep.geometry.images import open_image
from scanprep.geometry.storage import StorageError, read_bytes, read_json, taking_apart, write_json, writing
from scanprep.pictures import png16

from ..control.model import FOLDED, HOLE, MEASURED, OUTSIDE, DisplacementMap

HEADER, HEIGHTS, IMAGE = "displacement.json", "displacement.tif", "displacement.png"
COVERAGE = "coverage.png"
ZERO, LARGEST = 32768, 65535         # grey values of 16 bits: height 0 in the middle, so that both signs have room


def write_map(folder: str | Path, map: DisplacementMap) -> None:
    """Write a displacement map into a folder, which is made if it is not there; each file whole or not at all."""
    folder = Path(folder)
    inside = np.abs(map.heights[map.coverage != OUTSIDE])
    scale = max(float(inside.max(initial=0)) / (LARGEST - ZERO), 1e-7)         # a flat map has no extent to divide by
    grey = np.clip(np.rint(map.heights.astype(float) / scale) + ZERO, 0, LARGEST).astype(np.uint16)
    _write_tiff(folder / HEIGHTS, map.heights)
    _write_png(folder / IMAGE, grey)
    _write_png(folder / COVERAGE, map.coverage)
    write_json(folder / HEADER, {"kind": "displacement map", "version": 1, "size": list(map.heights.shape),
                                 "zero": ZERO, "scale": scale, "coverage": {
                                     "measured": MEASURED, "folded": FOLDED, "hole": HOLE, "outside": OUTSIDE}})


def read_map(folder: str | Path, edited: str | Path | None = None) -> DisplacementMap:
    """Read a displacement map from a folder; StorageError for a file that is missing or damaged.

    `edited` is `displacement.png` after editing, 16 bits of grey and of the same size. Where a pixel has another value
    than the stored one, its height changes by the difference; all others keep theirs to the last digit.
    """
    folder = Path(folder)
    header = read_json(folder / HEADER, "a displacement map's header")
    with taking_apart(folder / HEADER, "size and scale of a displacement map"):
        size, scale = tuple(header["size"]), float(header["scale"])
        if not scale > 0:
            raise ValueError(f"scale: expected a length above 0, got {scale}")
    heights, coverage = _read(folder / HEIGHTS, size, np.float32), _read(folder / COVERAGE, size, np.uint8)
    if edited is None:
        return DisplacementMap(heights, coverage)
    stored, changed = _read(folder / IMAGE, size, np.uint16), read_edited(edited, size)
    change = np.where(changed != stored, scale * (changed.astype(float) - stored), 0)
    return DisplacementMap((heights + change).astype(np.float32), coverage)


def read_edited(path: str | Path, size: tuple[int, ...]) -> np.ndarray:
    """Read grey values (H, W) uint16 of an image that an editor saved: 16 bits of grey, or three equal channels."""
    expected = f"an image of {size[1]} x {size[0]} pixels with 16 bits of grey"
    with taking_apart(path, expected):
        image, depth = _decode_image(Path(path), expected)
    if image.ndim == 3:
        image = image[..., :3] if image.shape[2] > 2 else image[..., :1]        # without opacity
        if (image != image[..., :1]).any():
            raise StorageError(f"{path}: expected {expected}, got colours: its channels differ")
        image = image[..., 0]
    came = f"{image.shape[1]} x {image.shape[0]} pixels with {depth} bits"
    if depth != 16 or image.shape != tuple(size):
        raise StorageError(f"{path}: expected {expected}, got {came}")
    return image


def _write_png(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    with writing(path) as beside:
        Image.fromarray(image).save(beside, format="PNG", optimize=True)


def _write_tiff(path: Path, image: np.ndarray) -> None:
    from PIL import Image

    with writing(path) as beside:
        Image.fromarray(image.astype(np.float32)).save(beside, format="TIFF", compression="tiff_adobe_deflate")


def _read(path: Path, size: tuple[int, ...], kind: Any) -> np.ndarray:
    """Read a TIFF or PNG image of this shape and number type, else StorageError."""
    what = "a TIFF image of single-precision numbers" if path.suffix == ".tif" else "a PNG image"
    with taking_apart(path, what):
        image = _decode_image(path, what)[0]
    if image.shape != tuple(size) or image.dtype != kind or not np.isfinite(image).all():
        raise StorageError(f"{path}: expected {np.dtype(kind).name} numbers of shape {tuple(size)}, all finite, "
                           f"got {image.dtype} of shape {image.shape}")
    return image


def _decode_image(path: Path, what: str) -> tuple[np.ndarray, int]:
    """Decode an image file; return the pixels and the bits per channel."""
    data = read_bytes(path, what)
    if data[:8] == png16.SIGNATURE and png16.depth(data) in ((16, 2), (16, 3), (16, 4)):
        return png16.decode_png16(data), 16
    with open_image(path, what, data) as image:
        if image.mode.startswith("I;16") or (image.mode == "I" and image.format == "PNG"):
            return np.asarray(image).astype(np.uint16), 16
        return np.asarray(image), 32 if image.mode in ("I", "F") else 8
