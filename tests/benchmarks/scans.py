"""The virtual scans that registration, correspondences and their peers are measured on.

Held out: every pose and man below is of the third fold (number ≡ 2 mod 5); settings are chosen on others.
"""
from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from protocols import RealData

from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.scanner import RangeView, ScannerConfig, scan

HELD_POSES = (2, 7, 17, 22, 32, 37, 47, 52, 62, 67)
HELD_MEN = (2, 27, 52, 77, 97, 122, 147, 172, 197, 222)
TUNING_POSES = (3, 8, 14, 24, 29, 43, 48, 59, 63, 69)
TUNING_MEN = (3, 44, 88, 134, 178, 214)

TEN = ("toe in right leg", "toe in left leg", "knee in right leg", "knee in left leg", "middle finger right hand",
       "middle finger left hand", "elbow (outside) right arm", "elbow (outside) left arm", "top of head", "cornea")
SEVEN = ("toe in right leg", "toe in left leg", "knee in right leg", "middle finger right hand",
         "middle finger left hand", "top of head", "cornea")
FOUR = ("toe in right leg", "toe in left leg", "middle finger right hand", "middle finger left hand")
MARKS = {"10": TEN, "7": SEVEN, "4": FOUR, "0": ()}


@dataclass(frozen=True, eq=False)
class TestScan:
    """A virtual scan of a body whose every vertex is known.

    Attributes
    ----------
    name : str
    scan : Mesh
        The triangulated views side by side.
    truth : Mesh
    seen : (N,) bool
        True vertices with a point of the scan within 12 mm.
    views : tuple of RangeView
    """

    name: str
    scan: Mesh
    truth: Mesh
    seen: np.ndarray
    views: tuple[RangeView, ...]

    def merged(self) -> Mesh:
        """One closed surface of even triangles, for tools that need one: merged, largest piece, holes filled."""
        from scanprep import decimate, fill_holes, merge_views
        from scanprep.decimation.decimate import DecimateConfig
        from scanprep.fusion.tsdf import MergeConfig
        from scanprep.repair.manifold import repair

        closed = fill_holes(repair(merge_views(self.views, MergeConfig(voxel=0.006))))
        return decimate(closed, 30_000, DecimateConfig("even"))

    def landmarks(self, data: RealData, which: str) -> tuple[np.ndarray, np.ndarray] | None:
        """Template vertices and their places on the scan: a set of `MARKS`."""
        if not MARKS[which]:
            return None
        vertices = np.array([data.landmarks[name] for name in MARKS[which]])
        return vertices, self.truth.vertices[vertices]


def test_scan(data: RealData, kind: str, index: int, front: bool = False) -> TestScan:
    """The scan of a pose ("pose") or a man ("man"): four views all around, or one from the front."""
    from scipy.spatial import cKDTree

    truth = data.template.with_vertices((data.poses if kind == "pose" else data.shapes)[index])
    config = ScannerConfig()
    if front:
        chest = truth.vertex_normals[data.landmarks["cornea"]]
        config = replace(config, views=1, azimuth=float(np.degrees(np.arctan2(chest[0], -chest[1]))))
    scanned = scan(truth, config, np.random.default_rng(index))
    seen = cKDTree(scanned.merged.vertices).query(truth.vertices)[0] < 0.012
    return TestScan(f"{kind}{index:03d}{'front' if front else ''}", scanned.merged, truth, seen, scanned.views)


test_scan.__test__ = False        # type: ignore[attr-defined]


def errors(found: np.ndarray, item: TestScan) -> dict[str, float]:
    """Millimetres between found (N, 3) and true vertices, and to the true surface; shares of all vertices."""
    from scanprep.geometry.surface import Surface

    apart = 1e3 * np.linalg.norm(found - item.truth.vertices, axis=1)
    surface = 1e3 * Surface(item.truth).closest(found).distances
    return {"all_mm": float(apart.mean()), "seen_mm": float(apart[item.seen].mean()),
            "unseen_mm": float(apart[~item.seen].mean()), "beyond_50mm": float((apart > 50).mean()),
            "surface_seen_mm": float(surface[item.seen].mean()), "max_mm": float(apart.max())}
