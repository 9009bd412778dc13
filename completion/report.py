"""Pictures and pages of what completion and animation found."""
from __future__ import annotations

from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.animation import gif_bytes
from scanprep.pictures.camera import Camera
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, Solid, color_bar, heat, render, side_by_side
from scanprep.pictures.views import look_around, upright

from .markers.files import MarkerSequence
from .motion import Motion
from .partial import Completion

MEASURED, COMPLETED, MARKER = (0.55, 0.67, 0.80), (0.93, 0.75, 0.42), (0.85, 0.25, 0.2)
HEIGHT = 520


def picture_completion(scan: Mesh | np.ndarray, completion: Completion, template: Mesh, height: int = HEIGHT
                       ) -> np.ndarray:
    """The scan, and the completed body in two colours from the side that was seen and from behind.

    Parameters
    ----------
    template : Mesh
        At rest: says which axis is up.
    """
    body = completion.completed
    up, _ = upright(template)
    weights = body.vertex_areas * completion.seen
    towards = np.roll((weights @ body.vertex_normals), -up)[1:]
    azimuth = float(np.degrees(np.arctan2(towards[1], towards[0])))
    views = [Camera.around(body, azimuth + turn, up=up) for turn in (0, 180)]
    colors = np.where(completion.seen[:, None], MEASURED, COMPLETED)
    given: Shape = Solid(scan, MEASURED) if isinstance(scan, Mesh) else Dots(scan, MEASURED, radius=0.003)
    shown: list[tuple[Shape, Camera, str]] = [
        (given, views[0], "scan, from the camera"), (given, views[1], "scan, from behind"),
        (Solid(body, colors), views[0], "completed"), (Solid(body, colors), views[1], "completed, from behind"),
        (Solid(completion.predicted), views[1], "predicted, from behind")]
    width = int(height * max(v.width / v.height for v in views)) + 10
    return side_by_side([render(shape, view, width, height) for shape, view, _ in shown],
                        [label for _, _, label in shown])


def picture_distance(mesh: Mesh, distance: np.ndarray, views: list[Camera], high: float = 0.01,
                     height: int = HEIGHT, title: str = "distance") -> np.ndarray:
    """A mesh coloured by a distance (N,) in metres from several sides, with its colour bar."""
    width = int(height * max(v.width / v.height for v in views)) + 10
    colored = Solid(mesh, heat(distance, 0.0, high))
    images = [render(colored, view, width, height) for view in views]
    return side_by_side([side_by_side(images), color_bar(0.0, high, title)], columns=1)


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


def completion_page(scan: Mesh | np.ndarray, completion: Completion, template: Mesh, name: str,
                    rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape complete`."""
    page = Page(f"{name}, completed", "Blue was measured, yellow was filled in by the body model.")
    page.picture(picture_completion(scan, completion, template))
    return page.table(rows, ("metric", "value", "unit"))


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
