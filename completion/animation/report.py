"""Pictures and the page of a motion."""
from __future__ import annotations

from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.pictures.animation import gif_bytes
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, render, side_by_side
from scanprep.pictures.views import look_around, upright

from ..markers.files import MarkerSequence
from ..motion import Motion

MARKER = (0.85, 0.25, 0.2)


def picture_frames(motion: Motion, subject: Subject, markers: MarkerSequence | None, count: int = 8,
                   height: int = 360) -> np.ndarray:
    """Some frames side by side, the measured markers as dots."""
    frames = np.unique(np.linspace(0, len(motion.poses) - 1, count).round().astype(int))
    bodies = motion.vertices(subject, frames)
    images = []
    for t, vertices in zip(frames, bodies, strict=True):
        mesh = subject.template.with_vertices(vertices)
        camera = look_around(subject.template, vertices, (35,))[0]
        shapes: list[Shape] = [mesh]
        if markers is not None:
            shapes.append(Dots(markers.positions[t], MARKER, radius=0.013))
        images.append(render(shapes, camera, int(0.62 * height), height))
    return side_by_side(images, [f"{t / motion.rate:.2f} s" for t in frames])


def animated_picture(motion: Motion, subject: Subject, frames_per_second: float = 15.0, seconds: float = 2.4,
                     width: int = 300, height: int = 400) -> bytes:
    """The motion as an endless GIF, at most so many seconds of it, the camera following the body."""
    step = max(1, round(motion.rate / frames_per_second))
    frames = np.arange(0, min(len(motion.poses), round(seconds * motion.rate)), step)
    bodies = motion.vertices(subject, frames)
    centred = bodies - bodies.mean(axis=1, keepdims=True)
    up, _ = upright(subject.template)
    centred[..., up] = bodies[..., up]
    camera = look_around(subject.template, centred, (35,))[0]
    images = [render(subject.template.with_vertices(v), camera, width, height, ground=True) for v in centred]
    return gif_bytes(images, motion.rate / step)


def chart_residuals(motion: Motion) -> Any:
    """A matplotlib figure: the distance of the markers to where the body puts them, over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 2.6))
    axes = figure.add_subplot()
    seconds = np.arange(len(motion.poses)) / motion.rate
    shown = np.isfinite(motion.residuals).any(axis=1)
    millimetres = 1000 * motion.residuals[shown]
    axes.fill_between(seconds[shown], *np.nanpercentile(millimetres, [10, 90], axis=1), alpha=0.25,
                      label="10th to 90th percentile", linewidth=0)
    axes.plot(seconds[shown], np.nanmean(millimetres, axis=1), linewidth=1.2, label="mean")
    axes.set(xlabel="time (s)", ylabel="distance of the markers (mm)", ylim=(0, None))
    axes.legend(frameon=False)
    return figure


def motion_page(motion: Motion, subject: Subject, markers: MarkerSequence, name: str,
                rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape animate`."""
    page = Page(f"{name}, animated", "The body in some frames, with the markers that were measured.")
    page.picture(picture_frames(motion, subject, markers)).picture(animated_picture(motion, subject), "first seconds")
    page.section("Markers").chart(chart_residuals(motion), "distance of the markers to where the body puts them")
    mean = np.array([np.nanmean(r) if np.isfinite(r).any() else np.nan for r in motion.residuals.T])
    worst = np.argsort(-np.nan_to_num(mean))
    page.table([(motion.labels[i], 1000 * float(mean[i]), 100 * float(np.isfinite(motion.residuals[:, i]).mean()))
                for i in worst], ("marker", "mean distance (mm)", "seen (%)"))
    return page.section("Figures").table(rows, ("metric", "value", "unit"))
