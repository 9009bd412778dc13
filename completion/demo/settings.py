"""How much of everything the demonstration makes."""
from __future__ import annotations

import csv
import io
from dataclasses import asdict, dataclass, field
from pathlib import Path

from model import LearnConfig
from scanprep.geometry import storage
from scanprep.pipeline.scans import TABLE
from scanprep.ranges import Cell, Count, Faces, Positive, Seed, Settings


@dataclass(frozen=True)
class DemoConfig(Settings):
    """How much of everything.

    Attributes
    ----------
    poses, subjects : int
        Scans of one subject in many poses, and of other people.
    faces : int
        Triangles of the template.
    parts : int
        Of the skeleton. Left to itself, the search finds rings at the shoulders too, which move with the skin.
    resolution, template_resolution : float, metres
        Spacing of the scanner's rays, for the scans and for the careful one that the template is made of.
    template_views : int
        Sides from which the careful scan is taken.
    held_out : int
        Poses of the subject that the model never saw.
    landmarks : int
        That are marked on the half view.
    frames, rate : int, frames per second
        Of the walk.
    marker_noise : float, metres
    seed : int
    """

    poses: Count = 20
    subjects: Count = 12
    faces: Faces = 14000
    parts: Count = 16
    resolution: Cell = 0.0068
    template_resolution: Cell = 0.004
    template_views: Count = 12
    held_out: int = 5
    landmarks: Count = 7
    frames: Count = 132
    rate: Positive = 60.0
    marker_noise: float = 0.001
    seed: Seed = 0
    learn: LearnConfig = field(default_factory=LearnConfig)


QUICK = DemoConfig(poses=8, subjects=3, faces=7000, resolution=0.011, template_resolution=0.006, held_out=2, frames=66,
                   rate=30.0)


def write_settings(config: DemoConfig, rows: list[tuple[str, str, str, str]], folder: Path) -> None:
    """What the folder holds, and who is in the scans."""
    storage.write_json(folder / "demo.json", storage.as_json(asdict(config)))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["name", "subject", "pose", "sex"])
    table.writerows(rows)
    (folder / "scans").mkdir()
    (folder / "scans" / TABLE).write_text(text.getvalue(), encoding="utf-8")
