"""Pictures and charts of a body in motion."""
from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera, look_around, upright
from scanprep.pictures.shading import Dots, Shape, Solid, render, side_by_side
from scanprep.pictures.sheets import gif_bytes

from .motion import Motion, spread_frames

MARKER = (0.85, 0.25, 0.2)
TURN = 35.0                          # degrees from the front of the body where the camera stands


def facing(subject: Subject, pose: np.ndarray, vertices: np.ndarray, turn: float = TURN) -> Camera:
    """A camera that sees a posed body (N, 3) from so many degrees beside its front, wherever it faces."""
    up, front = upright(subject.template)
    across = [(up + 1) % 3, (up + 2) % 3]
    ahead = np.zeros(3)
    ahead[across] = np.cos(np.radians(front)), np.sin(np.radians(front))
    now = (rotations.exp(pose[0]) @ ahead)[across]
    return Camera.around(vertices, azimuth=float(np.degrees(np.arctan2(now[1], now[0]))) + turn, up=up)


def worst_frames(motion: Motion, count: int) -> np.ndarray:
    """At most so many frames, in order: those with the largest mean residual, at least a quarter of a second apart."""
    off = np.where(np.isfinite(motion.residuals), motion.residuals, 0).sum(axis=1)
    off /= np.maximum(np.isfinite(motion.residuals).sum(axis=1), 1)
    return frames_apart(np.argsort(-off), count, motion.rate / 4)


def frames_apart(frames: np.ndarray, count: int, apart: float) -> np.ndarray:
    """In order the first frames of some, at most so many, that are no closer in time than `apart` frames."""
    found: list[int] = []
    for t in frames.tolist():
        if len(found) < count and all(abs(t - other) >= apart for other in found):
            found.append(t)
    return np.sort(found).astype(int)


def picture_frames(motion: Motion, subject: Subject, markers: np.ndarray | None,
                   frames: int | np.ndarray = 8, height: int = 360, turn: float = TURN) -> np.ndarray:
    """Some frames, or so many of them, side by side, the measured markers (T, L, 3), metres, as dots."""
    images = []
    frames = spread_frames(len(motion.poses), frames) if isinstance(frames, int) else frames
    for t, vertices in zip(frames, motion.vertices(subject, frames), strict=True):
        shapes: list[Shape] = [subject.template.with_vertices(vertices)]
        if markers is not None:
            shapes.append(Dots(markers[t], MARKER, radius=0.013))
        images.append(render(shapes, facing(subject, motion.poses[t], vertices, turn), int(0.62 * height), height))
    return side_by_side(images, seconds(motion, frames))


def seconds(motion: Motion, frames: np.ndarray) -> list[str]:
    """When frames are."""
    return [f"{t / motion.rate:.2f} s" for t in frames]


def bodies_in_a_row(subject: Subject, poses: np.ndarray, bodies: np.ndarray, colors: np.ndarray | None = None,
                    height: int = 360, turn: float = TURN) -> list[np.ndarray]:
    """Pictures of bodies (n, N, 3) in poses (n, J, 3), all of one scale; `colors` (n, N, 3) of their vertices."""
    size, up = 1.06 * np.ptp(bodies, axis=1).max(axis=0) / 2, upright(subject.template)[0]
    floor, images = bodies[..., up].min(), []
    for i, body in enumerate(bodies):
        middle = (body.min(axis=0) + body.max(axis=0)) / 2
        middle[up] = floor + size[up] / 1.06                        # all on one line
        camera = facing(subject, poses[i], np.stack([middle - size, middle + size]), turn)
        images.append(render(Solid(subject.template.with_vertices(body), None if colors is None else colors[i]), camera,
                             int(0.62 * height), height))
    return images


def picture_bodies(motion: Motion, subject: Subject, bodies: np.ndarray, frames: np.ndarray, count: int = 8
                   ) -> np.ndarray:
    """Some of the meshes (n, N, 3) of a body that changes side by side, at one scale; `frames` (n,) is when."""
    chosen = spread_frames(len(frames), count)
    return side_by_side(bodies_in_a_row(subject, motion.poses[frames[chosen]], bodies[chosen]),
                        seconds(motion, frames[chosen]))


def animated_picture(motion: Motion, subject: Subject, rate: float = 15.0, most: float = 2.4) -> bytes:
    """The motion as an endless GIF, at most so many seconds of it, the camera following the body."""
    span = max(1, min(len(motion.poses), round(most * motion.rate)))
    frames = np.arange(0, span, max(1, round(motion.rate / rate)))
    return moving_picture(motion.vertices(subject, frames), subject, motion.rate * len(frames) / span)


def moving_picture(bodies: np.ndarray, subject: Subject, rate: float, width: int = 300, height: int = 400,
                   faces: np.ndarray | None = None, pose: np.ndarray | None = None) -> bytes:
    """Meshes (n, N, 3) as an endless GIF of `rate` pictures a second, the camera following them over the ground.

    `faces` are theirs, if not the subject's; a body in `pose` (J, 3) is seen from its front, else as at rest.
    """
    centred = bodies - bodies.mean(axis=1, keepdims=True)
    up, _ = upright(subject.template)
    centred[..., up] = bodies[..., up]
    camera = look_around(subject.template, centred, (int(TURN),))[0] if pose is None else \
        facing(subject, pose, centred.reshape(-1, 3))
    faces = subject.template.faces if faces is None else faces
    return gif_bytes([render(Mesh(v, faces), camera, width, height, ground=True) for v in centred], rate)


def mean_over(values: np.ndarray, axis: int) -> np.ndarray:
    """The mean of what is not NaN, NaN where there is nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(values, axis=axis)


def marker_rows(labels: Sequence[str], residuals: np.ndarray, soft: np.ndarray | None, trusted: np.ndarray | None
                ) -> list[tuple[Any, ...]]:
    """A table of markers, the worst first: label, mean distances (mm), 95th percentile, seen and believed (%).

    Distances (T, L) are of the fixed shape and, if there is one, of the changing one, which then is that of the
    percentile. Markers that were never seen are left out, unless nothing is told of trust in them.
    """
    out = []
    for i, label in enumerate(labels):
        seen = np.isfinite(residuals[:, i])
        if seen.any() or trusted is None:
            shown = 1000 * (residuals if soft is None else soft)[seen, i]
            out.append((label, 1000 * float(mean_over(residuals[:, i], 0)),
                        np.nan if soft is None else 1000 * float(mean_over(soft[:, i], 0)),
                        float(np.nanpercentile(shown, 95)) if len(shown) else np.nan, 100 * float(seen.mean()),
                        np.nan if trusted is None else 100 * float(trusted[seen, i].mean())))
    return sorted(out, key=lambda row: -row[1])


def chart_residuals(motion: Motion, what: str = "markers", lost: bool = False) -> Any:
    """A matplotlib figure: the distance of the markers from the body over time; `lost` frames shaded where wanted."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 2.6))
    axes = figure.add_subplot()
    shown = np.isfinite(motion.residuals).any(axis=1)
    millimetres = 1000 * motion.residuals[shown]
    axes.fill_between(motion.times[shown], *np.nanpercentile(millimetres, [10, 90], axis=1), alpha=0.25,
                      label="10th to 90th percentile", linewidth=0)
    axes.plot(motion.times[shown], np.nanmean(millimetres, axis=1), linewidth=1.2, label="mean")
    edges = np.flatnonzero(np.diff(np.r_[True, motion.converged, True])) if lost else np.zeros(0, dtype=int)
    for i, span in enumerate((edges.reshape(-1, 2) - 0.5) / motion.rate):
        axes.axvspan(*span, color="0.85", label="lost" if i == 0 else None)
    axes.set(xlabel="time (s)", ylabel=f"distance of the {what} (mm)", ylim=(0, None))
    axes.legend(frameon=False)
    return figure


def chart_states(state: np.ndarray, labels: Sequence[str], rate: float, colors: Sequence[str],
                 names: Sequence[str] = ()) -> Any:
    """A matplotlib figure: the state (T, L) int of every marker over time, the highest where frames fall together.

    Each state has a colour; of the names those that occur are shown below.
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
