"""C3D, the file of motion-capture systems, through ezc3d."""
from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .common import MarkerFileError, RawMarkers

_MAGIC = 0x50
_BLOCK = 512
_BIG_ENDIAN, _DEC = 86, 85
_COMPUTED = ("ANGLES", "FORCES", "MOMENTS", "POWERS", "SCALARS")     # stored among the points, but no positions


def read_c3d(path: Path, data: bytes) -> RawMarkers:
    """The points of a C3D file, of any processor type.

    Missing are points with NaN or a negative residual.

    Raises
    ------
    MarkerFileError
        Not a C3D file, truncated, or without points.
    """
    _check(path, data)
    try:
        import ezc3d
    except ImportError:
        raise ImportError("C3D files need ezc3d: pip install ezc3d") from None
    try:
        tree = ezc3d.c3d(str(path))
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise MarkerFileError(f"{path}: expected a C3D file, cannot read it ({str(error).strip()})") from None
    parameters = tree["parameters"]["POINT"]
    points = tree["data"]["points"]                                  # (4, L, T)
    residuals = tree["data"]["meta_points"]["residuals"][0]          # (L, T)
    positions = points[:3].transpose(2, 1, 0).copy()
    if not positions.size:
        raise MarkerFileError(f"{path}: expected points, the C3D file holds {positions.shape[1]} points "
                              f"in {positions.shape[0]} frames")
    if residuals.shape == points.shape[1:]:
        positions[residuals.T < 0] = np.nan
    labels = _labels(parameters, points.shape[1])
    computed = {label for key in _COMPUTED for label in _value(parameters, key)}
    kept = [i for i, label in enumerate(labels) if label not in computed]
    rate = float(np.ravel(_value(parameters, "RATE") or [0])[0]) or float(tree["header"]["points"]["frame_rate"])
    unit = str((list(_value(parameters, "UNITS")) or ["mm"])[0]).strip().lower() or "mm"
    return RawMarkers(positions[:, kept], tuple(labels[i] for i in kept), rate or None, unit)


def _value(parameters: Any, key: str) -> list[Any]:
    return list(parameters[key]["value"]) if key in parameters else []


def _labels(parameters: Any, count: int) -> list[str]:
    """The labels of all points; beyond 255 they go on in LABELS2, LABELS3, ..."""
    labels: list[str] = []
    part = 1
    while len(labels) < count and (more := _value(parameters, "LABELS" if part == 1 else f"LABELS{part}")):
        labels += [str(label).strip() for label in more]
        part += 1
    labels = (labels + [""] * count)[:count]
    return [label or f"point{i}" for i, label in enumerate(labels)]


def _check(path: Path, data: bytes) -> None:
    """Refuse what is not a C3D file, and one that ends before its header says: ezc3d would read on."""
    parameters = (data[0] - 1) * _BLOCK if data else -1
    if len(data) < _BLOCK or data[1] != _MAGIC:
        raise MarkerFileError(f"{path}: expected a C3D file, with byte 2 = 80 and a header of {_BLOCK} bytes; "
                              f"found {len(data)} bytes that begin {data[:8]!r}")
    if not 0 < parameters < len(data) - 4:
        raise MarkerFileError(f"{path}: truncated: expected C3D parameters at byte {parameters}, "
                              f"found {len(data)} bytes")
    processor = data[parameters + 3]
    words = np.frombuffer(data, ">u2" if processor == _BIG_ENDIAN else "<u2", 10).astype(np.int64)
    points, analog, first, last, start = words[1], words[2], words[3], words[4], words[8]
    sign = data[{_BIG_ENDIAN: 12, _DEC: 13}.get(processor, 15)]      # of the scale: negative for real numbers
    size = 4 if sign & 0x80 else 2
    frames = max(last - first + 1, 0)
    expected = (start - 1) * _BLOCK + frames * (4 * points + analog) * size
    if start > 0 and len(data) < expected:
        raise MarkerFileError(f"{path}: truncated: expected {frames} frames in {expected} bytes, "
                              f"found {len(data)} bytes")


def write_c3d(path: Path, positions: np.ndarray, labels: tuple[str, ...], rate: float) -> None:
    """Write positions (T, L, 3), metres, as a C3D file in millimetres; missing points have residual -1."""
    import ezc3d

    tree = ezc3d.c3d()
    parameters = tree["parameters"]["POINT"]
    parameters["UNITS"]["value"] = ["mm"]
    parameters["RATE"]["value"] = [float(rate)]
    parameters["LABELS"]["value"] = tuple(labels)
    T, L = positions.shape[:2]
    points = np.ones((4, L, T))
    points[:3] = 1000 * positions.transpose(2, 1, 0)
    tree["data"]["points"] = points
    missing = np.isnan(positions[..., 0]).T
    tree["data"]["meta_points"] = {"residuals": np.where(missing, -1.0, 0.0)[None],
                                   "camera_masks": np.zeros((7, L, T), dtype=bool)}
    tree.write(str(path))
