"""Correspondences in a JSON file.

    {"kind": "correspondences", "version": 1, "method": "...", "converged": true, "energies": {...},
     "pairs": [{"vertex": 8120, "point": [x, y, z], "confidence": 0.93}, ...]}
"""
from __future__ import annotations

from pathlib import Path

import numpy as np

from ..geometry import storage
from ..geometry.format_common import FARTHEST
from .correspondences import Correspondences

KIND, VERSION = "correspondences", 1


def write_correspondences(path: str | Path, found: Correspondences) -> None:
    """Write correspondences, whole or not at all; points are in metres."""
    rows = zip(found.template_vertices.tolist(), np.asarray(found.scan_points).tolist(), found.confidence.tolist(),
               strict=True)
    storage.write_json(path, {
        "kind": KIND, "version": VERSION, "method": found.method, "converged": bool(found.converged),
        "energies": {name: float(value) for name, value in found.energies.items()},
        "pairs": [{"vertex": v, "point": p, "confidence": c} for v, p, c in rows]})


def read_correspondences(path: str | Path) -> Correspondences:
    """Read correspondences.

    Raises
    ------
    StorageError
        Missing, damaged, or something else.
    """
    expected = "expected correspondences in JSON"
    stored = storage.read_json(path, "correspondences")
    if not isinstance(stored, dict) or stored.get("kind") != KIND:
        raise storage.StorageError(f"{path}: {expected}, found something else")
    if stored.get("version") != VERSION:
        raise storage.StorageError(f"{path}: version {stored.get('version')} of correspondences is not known here "
                                   f"(known: {VERSION})")
    with storage.taking_apart(path, "correspondences in JSON with vertex, point and confidence"):
        pairs = stored["pairs"]
        found = Correspondences(np.array([pair["vertex"] for pair in pairs], dtype=np.int64),
                                np.array([pair["point"] for pair in pairs], dtype=np.float64).reshape(len(pairs), 3),
                                np.array([pair.get("confidence", 1.0) for pair in pairs], dtype=np.float64),
                                str(stored.get("method", "")),
                                {name: np.nan if value is None else float(value)
                                 for name, value in stored.get("energies", {}).items()},
                                bool(stored.get("converged", True)))
        if (found.template_vertices < 0).any() or not (np.abs(found.scan_points) <= FARTHEST).all():
            raise ValueError("a vertex below 0, or a point without end")
        return found
