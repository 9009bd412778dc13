"""Pictures and the page of a motion."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera, look_around, upright
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, render, side_by_side
from scanprep.pictures.sheets import gif_bytes

from ...motion import Motion
from ..files.markers import MarkerSequence

MARKER = (0.85, 0.25, 0.2)


def picture_frames(motion: Motion, subject: Subject, markers: MarkerSequence | None, count: int = 8,
                   height: int = 360, turn: float = 35.0) -> np.ndarray:
    """Some frames side by side, the measured markers as dots.

    Parameters
    ----------
    turn : float, degrees
        Where the camera stands, from the front of the body.
    """
    frames = np.unique(np.linspace(0, len(motion.poses) - 1, count).round().astype(int))
    return _frames_in_a_row(motion, subject, markers, frames, height, turn)


def picture_worst(motion: Motion, subject: Subject, markers: MarkerSequence, count: int = 8, height: int = 360
                  ) -> np.ndarray:
    """The frames with the largest mean residual, at least a quarter of a second apart."""
    return _frames_in_a_row(motion, subject, markers, worst_frames(motion, count), height, 35.0)


def worst_frames(motion: Motion, count: int) -> np.ndarray:
    """At most so many frames, in order: those with the largest mean residual, at least a quarter of a second apart."""
    off = np.where(np.isfinite(motion.residuals), motion.residuals, 0).sum(axis=1)
    off /= np.maximum(np.isfinite(motion.residuals).sum(axis=1), 1)
    frames: list[int] = []
    for t in np.argsort(-off):
        if len(frames) < count and all(abs(int(t) - other) >= motion.rate / 4 for other in frames):
            frames.append(int(t))
    return np.sort(frames).astype(int)


def _frames_in_a_row(motion: Motion, subject: Subject, markers: MarkerSequence | None, frames: np.ndarray,
                     height: int, turn: float) -> np.ndarray:
    images = []
    for t, vertices in zip(frames, motion.vertices(subject, frames), strict=True):
        camera = facing(subject, motion.poses[t], vertices, turn)
        shapes: list[Shape] = [subject.template.with_vertices(vertices)]
        if markers is not None:
            shapes.append(Dots(markers.positions[t], MARKER, radius=0.013))
        images.append(render(shapes, camera, int(0.62 * height), height))
    return side_by_side(images, [f"{t / motion.rate:.2f} s" for t in frames])


def morph_frames(motion: Motion, subject: Subject, bodies: np.ndarray, frames: np.ndarray, count: int = 8,
                 height: int = 360) -> np.ndarray:
    """Some of the meshes (n, N, 3) of a body that changes side by side, at one scale; `frames` (n,) is when."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
    size = 1.06 * np.ptp(bodies[chosen], axis=1).max(axis=0) / 2
    up, images = upright(subject.template)[0], []
    floor = bodies[chosen][..., up].min()
    for i in chosen:
        middle = (bodies[i].min(axis=0) + bodies[i].max(axis=0)) / 2
        middle[up] = floor + size[up] / 1.06                        # all on one line
        camera = facing(subject, motion.poses[frames[i]], np.stack([middle - size, middle + size]), 35.0)
        images.append(render(subject.template.with_vertices(bodies[i]), camera, int(0.62 * height), height))
    return side_by_side(images, [f"{frames[i] / motion.rate:.2f} s" for i in chosen])


def facing(subject: Subject, pose: np.ndarray, vertices: np.ndarray, turn: float) -> Camera:
    """A camera that sees a posed body (N, 3) from so many degrees beside its front, wherever it has turned."""
    up, front = upright(subject.template)
    across = [(up + 1) % 3, (up + 2) % 3]
    ahead = np.zeros(3)
    ahead[across] = np.cos(np.radians(front)), np.sin(np.radians(front))
    now = (rotations.exp(pose[0]) @ ahead)[across]
    return Camera.around(vertices, azimuth=float(np.degrees(np.arctan2(now[1], now[0]))) + turn, up=up)


def animated_picture(motion: Motion, subject: Subject, frames_per_second: float = 15.0, seconds: float = 2.4,
                     width: int = 300, height: int = 400) -> bytes:
    """The motion as an endless GIF, at most so many seconds of it, the camera following the body."""
    frames = _shown(motion, frames_per_second, seconds)
    return moving_picture(motion.vertices(subject, frames), subject, motion.rate * len(frames) / _span(motion, seconds),
                          width, height)


def moving_picture(bodies: np.ndarray, subject: Subject, rate: float, width: int = 300, height: int = 400,
                   faces: np.ndarray | None = None, pose: np.ndarray | None = None) -> bytes:
    """Meshes (n, N, 3) as an endless GIF of `rate` pictures a second, the camera following them over the ground.

    Parameters
    ----------
    faces : (f, 3) int, optional
        Triangles of the meshes, where they are not the subject's.
    pose : (J, 3) float, radians, optional
        Of a body that the camera sees from its front; else that at rest.
    """
    centred = bodies - bodies.mean(axis=1, keepdims=True)
    up, _ = upright(subject.template)
    centred[..., up] = bodies[..., up]
    camera = look_around(subject.template, centred, (35,))[0] if pose is None else \
        facing(subject, pose, centred.reshape(-1, 3), 35.0)
    faces = subject.template.faces if faces is None else faces
    images = [render(Mesh(v, faces), camera, width, height, ground=True) for v in centred]
    return gif_bytes(images, rate)


def _span(motion: Motion, seconds: float) -> int:
    return max(1, min(len(motion.poses), round(seconds * motion.rate)))


def _shown(motion: Motion, frames_per_second: float, seconds: float) -> np.ndarray:
    return np.arange(0, _span(motion, seconds), max(1, round(motion.rate / frames_per_second)))


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


def chart_missing(motion: Motion, seen_columns: np.ndarray) -> Any:
    """A matplotlib figure: when which marker was missing or not believed.

    Parameters
    ----------
    seen_columns : (L,) bool
        Markers to show.
    """
    labels = [label for label, shown in zip(motion.labels, seen_columns, strict=True) if shown]
    missing = ~np.isfinite(motion.residuals[:, seen_columns])
    state = np.where(missing, 2, np.where(motion.trusted[:, seen_columns], 0, 1))
    return chart_states(state, labels, motion.rate, ("#dfe7ee", "#e39b3b", "#8c2f39"))


def chart_states(state: np.ndarray, labels: Sequence[str], rate: float, colors: Sequence[str],
                 names: Sequence[str] = ()) -> Any:
    """A matplotlib figure: the state of every marker over time, the highest where there are more frames than room.

    Parameters
    ----------
    state : (T, L) int
    rate : float, frames per second
    colors : of the states
    names : of the states, optional
        Those that occur are shown below.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    steps = np.array_split(np.arange(len(state)), min(len(state), 600))
    shown = np.array([state[part].max(axis=0) for part in steps])
    figure = Figure(figsize=(7.5, 0.6 + 0.13 * len(labels)))
    axes = figure.add_subplot()
    axes.imshow(shown.T, aspect="auto", interpolation="nearest", vmin=0, vmax=len(colors) - 1,
                cmap=ListedColormap(list(colors)), extent=(0, len(state) / rate, len(labels) - 0.5, -0.5))
    axes.set_yticks(range(len(labels)), labels, fontsize=6)
    axes.set_xlabel("time (s)")
    if names:
        patches = [Patch(color=colors[i], label=names[i]) for i in np.unique(state)]
        axes.legend(handles=patches, frameon=False, fontsize=8, ncols=len(names), loc="upper center",
                    bbox_to_anchor=(0.5, -0.52 / figure.get_figheight()))
    return figure


def motion_page(motion: Motion, subject: Subject, markers: MarkerSequence, name: str,
                rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape animate`."""
    page = Page(f"{name}, animated", "The body in some frames, with the markers that were measured as dots.")
    page.picture(picture_frames(motion, subject, markers), "from the front and the person's left")
    page.picture(picture_frames(motion, subject, markers, turn=215.0), "the same frames from behind")
    page.picture(animated_picture(motion, subject, 10.0, 4.0), "first seconds")
    page.section("Markers").chart(chart_residuals(motion), "distance of the markers to where the body puts them")
    page.picture(picture_worst(motion, subject, markers), "where the markers are farthest off")
    used = np.isfinite(motion.residuals).any(axis=0)
    page.chart(chart_missing(motion, used), "light: seen; orange: seen, but not believed; red: missing")
    page.table(_marker_rows(motion, used), ("marker", "mean distance (mm)", "95th percentile (mm)", "seen (%)",
                                            "believed (%)"))
    unused = [label for label, is_used in zip(motion.labels, used, strict=True) if not is_used]
    if unused:
        page.text(f"Not used, because the layout does not know them or they were never seen: {', '.join(unused)}.")
    return page.section("Figures").table(rows, ("metric", "value", "unit"))


def _marker_rows(motion: Motion, used: np.ndarray) -> list[tuple[str, float, float, float, float]]:
    """The markers, that with the largest mean distance first."""
    found = []
    for i in np.flatnonzero(used):
        seen = np.isfinite(motion.residuals[:, i])
        off = 1000 * motion.residuals[seen, i]
        found.append((motion.labels[i], float(off.mean()), float(np.percentile(off, 95)), 100 * float(seen.mean()),
                      100 * float(motion.trusted[seen, i].mean())))
    return sorted(found, key=lambda row: -row[1])
