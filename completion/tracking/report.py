"""Pictures and the page of a tracked motion."""
from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.pictures.camera import look_around, upright
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, Solid, render, side_by_side
from scanprep.pictures.sheets import gif_bytes

from ..motion import Motion

POINTS, BODY, LOST = (0.16, 0.42, 0.72), (0.90, 0.78, 0.55), (0.78, 0.78, 0.78)
SIDES = (35.0, 215.0)                # degrees from the front
SHOWN = 2500                         # points of a frame in a picture

Cloud = Callable[[int], np.ndarray]


def picture_tracked(motion: Motion, subject: Subject, cloud: Cloud, count: int = 7, height: int = 340) -> np.ndarray:
    """Some frames: the points that were measured, and the body from two sides; a lost frame is grey.

    `cloud` frame -> (n, 3), metres.
    """
    frames = np.unique(np.linspace(0, len(motion.poses) - 1, count).round().astype(int))
    measured, bodies = [], []
    for t in frames:
        vertices = motion.vertices(subject, np.array([t]))[0].astype(float)
        body = Solid(subject.template.with_vertices(vertices), BODY if motion.converged[t] else LOST)
        cameras, points = look_around(subject.template, vertices, SIDES), cloud(int(t))
        dots: list[Shape] = [Dots(points[::max(1, len(points) // SHOWN)], POINTS, radius=0.006)] if len(points) else []
        measured.append(render(dots, cameras[0], int(0.6 * height), height))
        bodies.append([render(body, camera, int(0.6 * height), height) for camera in cameras])
    seconds = [f"{t / motion.rate:.2f} s" for t in frames]
    front, behind = (list(images) for images in zip(*bodies, strict=True))
    return side_by_side([side_by_side(measured), side_by_side(front), side_by_side(behind, seconds)], columns=1)


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
    high = 1000 * np.nanmax(motion.residuals, initial=0.001)
    axes.set(xlabel="time (s)", ylabel="distance of the points (mm)", ylim=(0, 1.15 * high),
             xlim=(-0.5 / motion.rate, (len(seconds) - 0.5) / motion.rate))
    return figure


def track_page(motion: Motion, subject: Subject, cloud: Cloud, name: str, numbers: list[int],
               rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape track`; numbers are those of the frames in their files."""
    page = Page(f"{name}, tracked", "Some frames: the points that were measured, then the body from the same side "
                "and from behind. Where it is grey the frame was lost.")
    page.picture(picture_tracked(motion, subject, cloud))
    page.picture(animated(motion, subject), "the first seconds")
    page.section("Distance of the points to the body").chart(
        chart_residuals(motion), "mean over the points of a frame, before smoothing")
    lost = np.array(numbers)[~motion.converged]
    if len(lost):
        page.text("Lost frames: " + _ranges(lost) + ". There the motion is what the frames around it suggest.")
    return page.section("Figures").table(rows, ("metric", "value", "unit"))


def _ranges(numbers: np.ndarray) -> str:
    """Numbers with runs as "first to last"."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return ", ".join(f"{run[0]}" if len(run) == 1 else f"{run[0]} to {run[-1]}" for run in runs)
