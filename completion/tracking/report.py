"""Pictures and the page of a tracked motion."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.pictures.camera import look_around
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, Solid, render, side_by_side

from ..motion import Motion, spread_frames
from ..motion_pictures import animated_picture, chart_residuals, seconds

POINTS, BODY, LOST = (0.16, 0.42, 0.72), (0.90, 0.78, 0.55), (0.78, 0.78, 0.78)
SIDES = (35.0, 215.0)                # degrees from the front

Cloud = Callable[[int], np.ndarray]


def picture_tracked(motion: Motion, subject: Subject, cloud: Cloud, count: int = 7, height: int = 340) -> np.ndarray:
    """Some frames: the points that were measured, and the body from two sides; a lost frame is grey.

    `cloud` frame -> (n, 3), metres.
    """
    frames = spread_frames(len(motion.poses), count)
    measured, bodies = [], []
    for t in frames:
        vertices = motion.vertices(subject, np.array([t]))[0].astype(float)
        body = Solid(subject.template.with_vertices(vertices), BODY if motion.converged[t] else LOST)
        cameras, points = look_around(subject.template, vertices, SIDES), cloud(int(t))
        # points of a frame in a picture
        dots: list[Shape] = [Dots(points[::max(1, len(points) // 2500)], POINTS, radius=0.006)] if len(points) else []
        measured.append(render(dots, cameras[0], int(0.6 * height), height))
        bodies.append([render(body, camera, int(0.6 * height), height) for camera in cameras])
    front, behind = (list(images) for images in zip(*bodies, strict=True))
    last = side_by_side(behind, seconds(motion, frames))
    return side_by_side([side_by_side(measured), side_by_side(front), last], columns=1)


def track_page(motion: Motion, subject: Subject, cloud: Cloud, name: str, numbers: list[int],
               rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape track`; numbers are those of the frames in their files."""
    page = Page(f"{name}, tracked", "Some frames: the points that were measured, then the body from the same side "
                "and from behind. Where it is grey the frame was lost.")
    page.picture(picture_tracked(motion, subject, cloud))
    page.picture(animated_picture(motion, subject, most=4.0), "the first seconds")
    page.section("Distance of the points to the body").chart(
        chart_residuals(motion, "points", lost=True), "mean over the points of a frame, before smoothing")
    lost = np.array(numbers)[~motion.converged]
    if len(lost):
        page.text("Lost frames: " + _ranges(lost) + ". There the motion is what the frames around it suggest.")
    return page.section("Figures").table(rows, ("metric", "value", "unit"))


def _ranges(numbers: np.ndarray) -> str:
    """Numbers with runs as "first to last"."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
