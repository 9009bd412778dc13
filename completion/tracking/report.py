"""Pictures and the page of a tracked motion."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.pictures.animation import gif_bytes
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, Solid, render, side_by_side
from scanprep.pictures.views import look_around, upright

from ..motion import Motion

POINTS, BODY, LOST = (0.16, 0.42, 0.72), (0.90, 0.78, 0.55), (0.78, 0.78, 0.78)
SIDES = (35.0, 215.0)                # degrees from the front
SHOWN = 2500                         # points of a frame in a picture

Cloud = Callable[[int], np.ndarray]


def picture_tracked(motion: Motion, subject: Subject, cloud: Cloud, count: int = 7, height: int = 340) -> np.ndarray:
    """Some frames from two sides, the body with the points that were measured; a lost frame is grey.

    Parameters
    ----------
    cloud : frame -> (n, 3) float, metres
    """
    frames = np.unique(np.linspace(0, len(motion.poses) - 1, count).round().astype(int))
    rows = []
    for side in SIDES:
        images = []
        for t in frames:
            vertices = motion.vertices(subject, np.array([t]))[0].astype(float)
            camera = look_around(subject.template, vertices, (side,))[0]
            body = Solid(subject.template.with_vertices(vertices), BODY if motion.converged[t] else LOST)
            shapes: list[Shape] = [body]
            points = cloud(int(t))
            if len(points):
                shapes.append(Dots(points[::max(1, len(points) // SHOWN)], POINTS, radius=0.005))
            images.append(render(shapes, camera, int(0.6 * height), height))
        rows.append(side_by_side(images, [f"{t / motion.rate:.2f} s" for t in frames]))
    return side_by_side(rows, ["from the front", "from behind"], columns=1)


def animated(motion: Motion, subject: Subject, frames_per_second: float = 15.0, seconds: float = 4.0) -> bytes:
    """The motion as an endless GIF, the camera going along."""
    step = max(1, round(motion.rate / frames_per_second))
    frames = np.arange(0, min(len(motion.poses), round(seconds * motion.rate)), step)
    bodies = motion.vertices(subject, frames).astype(float)
    up, _ = upright(subject.template)
    centred = bodies - bodies.mean(axis=1, keepdims=True)
    centred[..., up] = bodies[..., up]
    camera = look_around(subject.template, centred, (35,))[0]
    images = [render(Solid(subject.template.with_vertices(v), BODY), camera, 280, 380, ground=True) for v in centred]
    return gif_bytes(images, motion.rate / step)


def chart_residuals(motion: Motion) -> Any:
    """A matplotlib figure: distance of the points to the body over time, lost frames shaded."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 2.6))
    axes = figure.add_subplot()
    seconds = np.arange(len(motion.poses)) / motion.rate
    axes.plot(seconds, 1000 * motion.residuals[:, 0], linewidth=1.3)
    edges = np.diff(np.concatenate([[0], (~motion.converged).astype(int), [0]]))
    for i, (first, end) in enumerate(zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)):
        axes.axvspan((first - 0.5) / motion.rate, (end - 0.5) / motion.rate, color="0.85",
                     label="lost" if i == 0 else None)
    if (edges > 0).any():
        axes.legend(frameon=False)
    axes.set(xlabel="time (s)", ylabel="distance of the points (mm)", ylim=(0, None),
             xlim=(-0.5 / motion.rate, (len(seconds) - 0.5) / motion.rate))
    return figure


def track_page(motion: Motion, subject: Subject, cloud: Cloud, name: str, rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape track`."""
    page = Page(f"{name}, tracked", "The body in some frames, with the points that were measured.")
    page.picture(picture_tracked(motion, subject, cloud))
    page.picture(animated(motion, subject), "the first seconds")
    page.section("Distance of the points to the body").chart(
        chart_residuals(motion), "mean over the points of a frame, before smoothing")
    lost = np.flatnonzero(~motion.converged)
    if len(lost):
        page.text("Lost frames: " + _ranges(lost) + ". There the motion is what the frames around it suggest.")
    return page.section("Figures").table(rows, ("metric", "value", "unit"))


def _ranges(numbers: np.ndarray) -> str:
    """Numbers with runs as "first to last"."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
