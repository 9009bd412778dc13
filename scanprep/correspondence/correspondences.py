"""Pairs of places on a template and a scan, however they were found, and their JSON file.

    {"kind": "correspondences", "version": 1, "method": "...", "converged": true, "energies": {...},
     "pairs": [{"vertex": 8120, "point": [x, y, z], "confidence": 0.93}, ...]}
"""
from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..geometry import storage
from ..geometry.format_common import FARTHEST
from ..geometry.mesh import Mesh

KIND, VERSION = "correspondences", 1


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Which vertex of the template lies where on the scan."""

    template_vertices: np.ndarray    # (C,) int
    scan_points: np.ndarray          # (C, 3) metres
    confidence: np.ndarray           # (C,) from 0, a guess, to 1, certain
    method: str = ""                 # how they were found
    energies: dict[str, float] = field(default_factory=dict)     # what was minimised, and other figures of the search
    converged: bool = True

    def __len__(self) -> int:
        return len(self.template_vertices)


def check_pairs(template: Mesh, vertices: np.ndarray, points: np.ndarray, name: str, least: int = 3
                ) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (L,) of a template and their places (L, 3), or ValueError that names the argument they came by."""
    vertices, points = np.asarray(vertices), np.asarray(points, dtype=np.float64)
    if vertices.ndim != 1 or not np.issubdtype(vertices.dtype, np.integer):
        raise ValueError(f"{name}: expected vertex numbers of shape (L,), got {vertices.dtype} "
                         f"of shape {vertices.shape}")
    if points.shape != (len(vertices), 3):
        raise ValueError(f"{name}: expected points of shape ({len(vertices)}, 3), got {points.shape}")
    if len(np.unique(vertices)) < least:
        raise ValueError(f"{name}: expected at least {least} different ones, got {len(np.unique(vertices))}")
    outside = (vertices < 0) | (vertices >= len(template.vertices))
    if outside.any():
        raise ValueError(f"{name}: expected vertices of 0..{len(template.vertices) - 1}, got {vertices[outside][0]}")
    if not np.isfinite(points).all():
        raise ValueError(f"{name}: expected finite points, {(~np.isfinite(points).all(axis=1)).sum()} are not finite")
    return vertices.astype(np.int64), points


def correspondences_doubts(found: Correspondences) -> list[str]:
    """Why correspondences are to be looked at: limbs may have been mistaken for each other."""
    sure = float(np.median(found.confidence)) if len(found) else 0.0
    # Median confidence of correspondences, below which they mean nothing, and from which they are right. Right ones
    # have 0.81 to 0.87 on five real scans of the template's kind, 0.79 and 0.81 on two others, 0.72 on a person with
    # long hair. Of mistaken limbs two scans have 0.66 and 0.73, three of a depth camera 0.31 to 0.43; a ball has 0.25
    # to 0.37.
    return [f"the median confidence is {sure:.2f}: limbs may be mistaken for each other"] if sure < 0.77 else []


def correspondences_problem(found: Correspondences) -> str | None:
    """Why correspondences mean nothing, with the likely cause; None where they mean something."""
    sure = float(np.median(found.confidence)) if len(found) else 0.0
    if sure >= 0.55:
        return None
    return (f"{len(found)} pairs were found with a median confidence of {sure:.2f}; a scan of something else, too "
            "little of the body, or landmarks of other places?")


def write_correspondences(path: str | Path, found: Correspondences) -> None:
    """Write correspondences, whole or not at all; points are in metres."""
    rows = zip(found.template_vertices.tolist(), np.asarray(found.scan_points).tolist(), found.confidence.tolist(),
               strict=True)
    storage.write_json(path, {
        "kind": KIND, "version": VERSION, "method": found.method, "converged": bool(found.converged),
        "energies": {name: float(value) for name, value in found.energies.items()},
        "pairs": [{"vertex": v, "point": p, "confidence": c} for v, p, c in rows]})


def read_correspondences(path: str | Path) -> Correspondences:
    """Read correspondences; StorageError where they are missing, damaged, or something else."""
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
        if (found.template_vertices < 0).any() or not (np.abs(found.scan_points) <= FARTHEST).all() \
                or not np.isfinite(found.confidence).all():
            raise ValueError("a vertex below 0, a point without end, or a confidence that is no number")
        return found
