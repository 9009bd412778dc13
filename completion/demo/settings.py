"""How much of everything the demonstration makes."""
from __future__ import annotations

import csv
import io
from dataclasses import asdict, dataclass, field
from pathlib import Path

from model import LearnConfig
from scanprep.geometry import storage
from scanprep.pipeline.scans import TABLE


@dataclass(frozen=True)
class DemoConfig:
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

    Raises
    ------
    ValueError
        A seed below 0.
    """

    poses: int = 20
    subjects: int = 12
    faces: int = 14000
    parts: int = 16
    resolution: float = 0.0068
    template_resolution: float = 0.004
    template_views: int = 12
    held_out: int = 5
    landmarks: int = 7
    frames: int = 132
    rate: float = 60.0
    marker_noise: float = 0.001
    seed: int = 0
    learn: LearnConfig = field(default_factory=LearnConfig)

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise ValueError(f"seed: expected 0 or more, got {self.seed}")


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
