"""The page of a tracked motion."""
from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from model.linear import Subject
from scanprep.console import Metric
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots

from ..motion import Motion
from ..motion_pictures import chart_residuals, frames_to_play, moving_pane


def track_page(motion: Motion, subject: Subject, cloud: Callable[[int], np.ndarray], name: str, numbers: list[int],
               metrics: Sequence[Metric]) -> Page:
    """Make the page of `scape track`; `cloud` gives the points (n, 3) of a frame, `numbers` are of the files."""
    page = Page(f"{name}, tracked", "The body, and some of the points that were measured in each frame. Where it is "
                "grey the frame was lost.")
    # at most 300,000 points in all, so that the page stays small; 100 to 1000 of each frame
    frames, _ = frames_to_play(motion)
    count = int(np.clip(300_000 // len(frames), 100, 1000))
    points = np.full((len(frames), count, 3), np.nan)
    for row, t in enumerate(frames):
        measured = cloud(int(t))
        chosen = measured[np.linspace(0, len(measured) - 1, min(count, len(measured))).astype(int)]
        points[row, :len(chosen)] = chosen
    dots = Dots(points[0], (0.16, 0.42, 0.72), radius=0.006, name="measured points")
    page.bodies([moving_pane(motion, subject, [(dots, points)], color=(0.90, 0.78, 0.55))],
                "Press the triangle to play, drag the body to turn it.", 520)
    page.section("Distance of the points to the body").chart(
        chart_residuals(motion, "points"), "mean over the points of a frame, before smoothing")
    lost = np.array(numbers)[~motion.converged]
    if len(lost):
        page.text("Lost frames: " + _ranges(lost) + ". There the motion is what the frames around it suggest.")
    return page.section("Figures").figures(metrics)


def _ranges(numbers: np.ndarray) -> str:
    """Write numbers as text, with runs as "first to last"."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
