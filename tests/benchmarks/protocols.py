"""The standard protocols on the real scans, so that figures can be compared.

The scans lie in `$SCAPEKIT_DATA` (scape_poses, spring_shapes, landmarks.json). Run the benchmarks by hand
from the checkout; nothing here is a test.
"""
from __future__ import annotations

import importlib.metadata
import json
import os
import platform
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays


def data_folder() -> Path:
    """The folder of real scans, or SystemExit with the reason."""
    folder = os.environ.get("SCAPEKIT_DATA")
    if not folder or not Path(folder, "scape_poses").is_dir():
        raise SystemExit("set SCAPEKIT_DATA to the folder of scape_poses, spring_shapes and landmarks.json")
    return Path(folder)


@dataclass(frozen=True)
class RealData:
    """All real bodies in one topology: template, poses (71, N, 3), shapes (227, N, 3), landmark vertices."""

    template: Mesh
    poses: np.ndarray
    shapes: np.ndarray
    landmarks: dict[str, int]


def load_real(folder: Path | None = None) -> RealData:
    """Read every body, sorted by file name; pose 0 is the template."""
    import igl

    folder = folder or data_folder()
    poses, shapes = ([igl.read_triangle_mesh(str(p)) for p in sorted((folder / name).glob("*.ply"))]
                     for name in ("scape_poses", "spring_shapes"))
    return RealData(Mesh(*poses[0]), np.stack([v for v, _ in poses]).astype(float),
                    np.stack([v for v, _ in shapes]).astype(float),
                    json.loads((folder / "landmarks.json").read_text()))


def scape_fold(fold: int, count: int = 71) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the training and held-out poses of SCAPE-5fold; the template, pose 0, always trains."""
    held = np.array([i for i in range(count) if i % 5 == fold and i != 0])
    return np.setdiff1d(np.arange(count), held), held


def spring_split(count: int = 227) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the 182 training and the 45 held-out bodies of SPRING-182/45."""
    held = np.arange(2, count, 5)
    return np.setdiff1d(np.arange(count), held), held


@dataclass(frozen=True)
class HalfView:
    """What one camera sees of a body.

    Attributes
    ----------
    points : (20000, 3) float, metres, with noise along the ray
    seen : (N,) bool, the vertices that were seen
    landmarks : (7,) int vertices, (7, 3) points
    camera : (3,) float, metres
    """

    points: np.ndarray
    seen: np.ndarray
    landmarks: tuple[np.ndarray, np.ndarray]
    camera: np.ndarray


def half_view(body: Mesh, k: int, landmarks: dict[str, int], rng: np.random.Generator, up: int = 2) -> HalfView:
    """The half view of the k-th body of a list, as the protocol says."""
    azimuth = np.deg2rad(137.5 * k)
    offset = np.zeros(3)
    offset[[(up + 1) % 3, (up + 2) % 3]] = 2.5 * np.cos(azimuth), 2.5 * np.sin(azimuth)
    offset[up] = 0.25
    camera = body.vertices.mean(axis=0) + offset
    rays = Rays(body)

    def visible(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        to_camera = camera - points
        far = np.linalg.norm(to_camera, axis=1, keepdims=True)
        facing = np.einsum("nd,nd->n", normals, to_camera / far) > 0.15
        return facing & ~rays.test_occlusion(points + 1e-3 * normals, to_camera / far, 10.0)

    seen = visible(body.vertices, body.vertex_normals)
    points = np.zeros((0, 3))
    while len(points) < 20000:
        sample, face, _ = body.sample(60000, rng)
        points = np.vstack([points, sample[visible(sample, body.face_normals[face])]])
    points = points[:20000]
    along = (points - camera) / np.linalg.norm(points - camera, axis=1, keepdims=True)
    points = points + along * rng.normal(0, 0.002, (len(points), 1))
    named = [v for v in landmarks.values() if seen[v]]
    chosen = np.array(named)[np.round(np.linspace(0, len(named) - 1, 7)).astype(int)]
    return HalfView(points, seen, (chosen, body.vertices[chosen]), camera)


def machine() -> dict[str, object]:
    """What the figures were measured on: processor count, Python, and the versions that matter."""
    packages = ("scapekit", "numpy", "scipy", "cholespy")
    versions = {}
    for name in packages:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {"cores": os.cpu_count(), "threads": os.environ.get("OMP_NUM_THREADS", "all"),
            "platform": f"{platform.system()} {platform.machine()}", "python": platform.python_version(), **versions}


def write_report(path: str | Path, report: dict[str, object]) -> None:
    """Write the figures of a benchmark as JSON; numpy numbers become plain ones."""
    Path(path).write_text(json.dumps(report, indent=1, default=float) + "\n")
