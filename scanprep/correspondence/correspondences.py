"""Corresponding points of a template and a scan, and their JSON file.

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
from ..judgement import Judgement

KIND, VERSION = "correspondences", 1


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Corresponding points: vertices of the template and points of the scan.

    Attributes
    ----------
    template_vertices : (C,) int
        Vertices of the template.
    scan_points : (C, 3) float, metres
        Their positions on the scan.
    confidence : (C,) float
        From 0, a guess, to 1, certain.
    method : str
        How they were found.
    energies : dict of str to float
        What was minimised, and other figures of the search.
    converged : bool
        Belief propagation converged, and the matching of limb ends was clear.

    Examples
    --------
    >>> pairs = Correspondences(np.array([3, 8]), np.zeros((2, 3)), np.array([1.0, 0.4]))
    >>> len(pairs), pairs.template_vertices[pairs.confidence > 0.5].tolist()
    (2, [3])
    """

    template_vertices: np.ndarray
    scan_points: np.ndarray
    confidence: np.ndarray
    method: str = ""
    energies: dict[str, float] = field(default_factory=dict)
    converged: bool = True

    def __len__(self) -> int:
        return len(self.template_vertices)

    @property
    def judgement(self) -> Judgement:
        """Whether they can be used: whether they mean nothing, and whether limbs may have been confused."""
        return Judgement.of(correspondences_problem(self), correspondences_doubts(self))


def check_pairs(template: Mesh, vertices: np.ndarray, points: np.ndarray, name: str, least: int = 3
                ) -> tuple[np.ndarray, np.ndarray]:
    """Check vertices (L,) of a template and their points (L, 3); ValueError names the argument `name`."""
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
    """Explain why correspondences need a look: limbs may have been confused."""
    sure = float(np.median(found.confidence)) if len(found) else 0.0
    # A median confidence from 0.77 on is right; below 0.55 it is meaningless (`correspondences_problem`). Right ones
    # have 0.81 to 0.87 on five real scans of the template's kind, 0.79 and 0.81 on two others, 0.72 on a person with
    # long hair. With confused limbs two scans have 0.66 and 0.73, three of a depth camera 0.31 to 0.43. A ball has
    # 0.25 to 0.37.
    return [f"the median confidence is {sure:.2f}: limbs may be mistaken for each other"] if sure < 0.77 else []


def correspondences_problem(found: Correspondences) -> str | None:
    """Explain why correspondences are meaningless, with the likely cause; None where they are not."""
    sure = float(np.median(found.confidence)) if len(found) else 0.0
    if sure >= 0.55:                     # see `correspondences_doubts`
        return None
    return (f"{len(found)} pairs were found with a median confidence of {sure:.2f}; a scan of something else, too "
            "little of the body, or landmarks of other places?")


def write_correspondences(path: str | Path, found: Correspondences) -> None:
    """Write correspondences to a JSON file, atomically; points are in metres."""
    rows = zip(found.template_vertices.tolist(), np.asarray(found.scan_points).tolist(), found.confidence.tolist(),
               strict=True)
    storage.write_json(path, {
        "kind": KIND, "version": VERSION, "method": found.method, "converged": bool(found.converged),
        "energies": {name: float(value) for name, value in found.energies.items()},
        "pairs": [{"vertex": v, "point": p, "confidence": c} for v, p, c in rows]})


def read_correspondences(path: str | Path) -> Correspondences:
    """Read correspondences from a JSON file; StorageError where it is missing, damaged, or something else."""
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
