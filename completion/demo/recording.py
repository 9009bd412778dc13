"""What is measured of the synthetic people: range scans, and the markers of a walk."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from scanprep.batch.room import Room
from scanprep.geometry.mesh import Mesh
from scanprep.synthetic.data_set import GroundTruth, SyntheticScan, synthetic_scan
from scanprep.synthetic.people import MARKERS
from scanprep.synthetic.scanner import ScannerConfig

from ..mocap.files.markers import MarkerSequence, write_markers
from ..mocap.marker_sets.layout import DISTANCE, MarkerLayout
from .settings import MARKER_NOISE, DemoConfig


@dataclass(frozen=True)
class ScanPerson:
    """The work on each scan: a synthetic person made and scanned."""

    seed: int
    scanner: ScannerConfig

    def __call__(self, which: tuple[int, bool], room: Room) -> SyntheticScan:
        found = synthetic_scan(room.folder / "scans", self.seed, *which, self.scanner)
        return replace(found, folder=Path("scans"))


def record_walk(folder: Path, bodies: np.ndarray, rest: GroundTruth, template: Mesh, config: DemoConfig,
                tell: Callable[[int, int], None]) -> None:
    """Write the markers of a walking person (T, N, 3), and where they sit on the template."""
    rng = np.random.default_rng([config.seed, 9])
    labels, places = tuple(MARKERS), np.array(list(MARKERS.values()))
    out = []
    for i, body in enumerate(bodies):
        out.append(body[places] + DISTANCE * Mesh(body, rest.faces).vertex_normals[places])
        tell(i + 1, len(bodies))
    positions = np.stack(out) + rng.normal(0, MARKER_NOISE, (len(bodies), len(labels), 3))
    positions[rng.random(positions.shape[:2]) < 0.03] = np.nan
    # as on a real subject: the layout is read off the scan at rest, on which the markers can be seen
    _, vertices = cKDTree(template.vertices).query(rest.vertices[places])
    MarkerLayout(labels, vertices, DISTANCE).save(folder / "layout.json")
    sequence = MarkerSequence(positions, labels, config.rate)
    write_markers(folder / "walk.csv", sequence)
    write_markers(folder / "walk.c3d", sequence)
