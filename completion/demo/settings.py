"""How much of everything the demonstration makes."""
from __future__ import annotations

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path

from model import LearnConfig
from scanprep.geometry import storage
from scanprep.pipeline.scans import TABLE
from scanprep.ranges import Cell, Count, Faces, Positive, Seed, Settings

PARTS = 16                               # left to itself, the search finds rings at the shoulders, moved by the skin
TEMPLATE_VIEWS = 12                      # sides from which the careful scan is taken that the template is made of
LANDMARKS = 7                            # that are marked on the half view
MARKER_NOISE = 0.001                     # metres


@dataclass(frozen=True)
class DemoConfig(Settings):
    """How much of everything.

    Attributes
    ----------
    poses, subjects : int
        Scans of one subject in many poses, and of other people.
    faces : int
        Triangles of the template.
    resolution, template_resolution : float, metres
        Spacing of the scanner's rays, for the scans and for the careful one that the template is made of.
    held_out : int
        Poses of the subject that the model never saw.
    frames, rate : int, frames per second
        Of the walk.
    seed : int
    learn : LearnConfig
        How the model is learned.
    """

    poses: Count = 9
    subjects: Count = 4
    faces: Faces = 8000
    resolution: Cell = 0.01
    template_resolution: Cell = 0.0055
    held_out: int = 3
    frames: Count = 66
    rate: Positive = 60.0
    seed: Seed = 0
    learn: LearnConfig = field(default_factory=LearnConfig)


FULL = DemoConfig(poses=20, subjects=12, faces=14000, resolution=0.0068, template_resolution=0.004, held_out=5,
                  frames=132)
QUICK = DemoConfig(poses=8, subjects=3, faces=7000, resolution=0.011, template_resolution=0.006, held_out=2, rate=30.0)


def write_settings(config: DemoConfig, rows: list[tuple[str, str, str, str]], folder: Path) -> None:
    """What the folder holds, and who is in the scans."""
    storage.write_json(folder / "demo.json", storage.as_json(config))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "subject", "pose", "sex"])
    table.writerows(rows)
    (folder / "scans").mkdir()
    (folder / "scans" / TABLE).write_text(text.getvalue(), encoding="utf-8")
