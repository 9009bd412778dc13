"""Pictures and charts of a body in motion."""
from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.decimation.registered_set import decimate_set
from scanprep.geometry import rotations
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera, look_around, stance
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import Dots, Moving, Solid, contact_sheet, render

from .motion import Motion

MARKER, LOST = (0.85, 0.25, 0.2), (0.78, 0.78, 0.78)
PLAYED, MOST_PLAYED = 30, 2000       # frames a second, and in all, that a page plays
TURN = 35.0                          # degrees from the front of the body where the camera stands


def upwards(motion: Motion, subject: Subject) -> np.ndarray:
    """(3,) what is up in a motion."""
    return stance(subject.template, rotations.exp(motion.poses[:, 0]))[0]


def facing(subject: Subject, pose: np.ndarray, vertices: np.ndarray, turn: float = TURN,
           vertical: np.ndarray | None = None) -> Camera:
    """A camera that sees a body (..., 3) from so many degrees beside its front, wherever it faces and whatever is up.

    `pose` (..., J, 3) is the body's, or all of its motion; for one frame of a motion `vertical` is what is up in it.
    """
    return look_around(subject.template, vertices, (turn,), rotations.exp(pose[..., 0, :]), vertical)[0]


def worst_frames(motion: Motion, count: int) -> np.ndarray:
    """At most so many frames, in order: those with the largest mean residual, at least a quarter of a second apart."""
    off = np.nan_to_num(mean_over(motion.residuals, 1))
    return frames_apart(np.argsort(-off), count, motion.rate / 4)


def frames_apart(frames: np.ndarray, count: int, apart: float) -> np.ndarray:
    """In order the first frames of some, at most so many, that are no closer in time than `apart` frames."""
    found: list[int] = []
    for t in frames.tolist():
        if len(found) < count and all(abs(t - other) >= apart for other in found):
            found.append(t)
    return np.sort(found).astype(int)


@dataclass(frozen=True, eq=False)
class LightMesh:
    """Some of the vertices (n,) of a body and triangles (f, 3) between them, for small pictures and for motions."""

    vertex_ids: np.ndarray
    faces: np.ndarray

    @staticmethod
    def of(template: Mesh) -> LightMesh:
        """At most `LIGHT` triangles; of a body that has no more its own."""
        light = 7000  # triangles of a body in small pictures and in motion
        if len(template.faces) <= light:
            return LightMesh(np.arange(len(template.vertices)), template.faces)
        small = decimate_set(template, None, light)
        return LightMesh(small.vertex_map, small.template.faces)

    def mesh(self, vertices: np.ndarray) -> Mesh:
        """The small mesh of a large one's vertices (N, 3)."""
        return Mesh(vertices[self.vertex_ids], self.faces)


Bodies = Callable[[np.ndarray], np.ndarray]            # frames (n,) -> vertices (n, N, 3), metres


def frames_to_play(motion: Motion) -> tuple[np.ndarray, float]:
    """The frames that a page plays, and how many a second."""
    step = max(1, round(motion.rate / PLAYED), -(-len(motion.poses) // MOST_PLAYED))
    return np.arange(0, len(motion.poses), step), motion.rate / step


def moving_pane(motion: Motion, subject: Subject, dots: Sequence[tuple[Dots, np.ndarray]] = (),
                bodies: Bodies | None = None, light: LightMesh | None = None, label: str = "",
                color: Sequence[float] | None = None) -> Pane:
    """A body in motion with dots at places (n, L, 3) in the frames `played`; it stays in the middle of the picture.

    Lost frames are grey. `bodies` says what it looks like, if not as the subject.
    """
    frames, rate = frames_to_play(motion)
    light = light or LightMesh.of(subject.template)
    make = bodies or (lambda some: motion.vertices(subject, some))
    # 128 bodies are held at a time
    shown = np.concatenate([make(frames[i:i + 128])[:, light.vertex_ids].astype(np.float32)
                            for i in range(0, len(frames), 128)])
    vertical = upwards(motion, subject)
    middle = shown.mean(axis=1, keepdims=True) * (1 - np.abs(vertical)).astype(np.float32)
    shown -= middle
    first, lost = Mesh(shown[0].astype(float), light.faces), ~motion.converged[frames]
    shapes: list[Moving] = []
    for mask, name, look in ((~lost, "body", color), (lost, "lost frames", LOST)):
        if mask.any():
            seen = shown if mask.all() else np.where(mask[:, None, None], shown, np.float32(np.nan))
            shapes.append(Moving(Solid(first, look, name=name), seen, rate))
    shapes += [Moving(replace(these, points=(at - middle)[0]), at - middle, rate) for these, at in dots]
    camera = facing(subject, motion.poses, shown[:: max(1, len(shown) // 50)].reshape(-1, 3))
    return Pane(shapes, camera, label)


def pane_with_dots(motion: Motion, subject: Subject, places: np.ndarray, name: str, labels: Sequence[str],
                   on_top: bool = False) -> Pane:
    """A body in motion with the places (T, L, 3), metres, that it follows."""
    at = places[frames_to_play(motion)[0]]
    return moving_pane(motion, subject, [(Dots(at[0], MARKER, 0.013, on_top, name=name, labels=labels), at)])


def frame_panes(motion: Motion, subject: Subject, markers: np.ndarray | None, frames: np.ndarray, turn: float = TURN
                ) -> list[Pane]:
    """Some frames, the measured markers (T, L, 3), metres, as dots."""
    panes, light, vertical = [], LightMesh.of(subject.template), upwards(motion, subject)
    for t, vertices, told in zip(frames, motion.vertices(subject, frames), seconds(motion, frames), strict=True):
        dots = [] if markers is None else [Dots(markers[t], MARKER, radius=0.013)]
        camera = facing(subject, motion.poses[t], vertices, turn, vertical)
        panes.append(Pane([light.mesh(vertices), *dots], camera, told))
    return panes


def seconds(motion: Motion, frames: np.ndarray) -> list[str]:
    """When frames are."""
    return [f"{t / motion.rate:.2f} s" for t in frames]


def bodies_in_a_row(subject: Subject, poses: np.ndarray, bodies: np.ndarray, colors: np.ndarray | None = None,
                    height: int = 360, turn: float = TURN) -> list[np.ndarray]:
    """Pictures of bodies (n, N, 3) in poses (n, J, 3), all of one scale; `colors` (n, N, 3) of their vertices."""
    size, images = 1.06 * np.ptp(bodies, axis=1).max(axis=0) / 2, []
    vertical = stance(subject.template, rotations.exp(poses[:, 0]))[0]
    up, sign = int(np.abs(vertical).argmax()), vertical.sum()
    floor = sign * (sign * bodies[..., up]).min()
    for i, body in enumerate(bodies):
        middle = (body.min(axis=0) + body.max(axis=0)) / 2
        middle[up] = floor + sign * size[up] / 1.06                        # all on one line
        camera = facing(subject, poses[i], np.stack([middle - size, middle + size]), turn, vertical)
        images.append(render(Solid(subject.template.with_vertices(body), None if colors is None else colors[i]), camera,
                             int(0.62 * height), height))
    return images


def picture_bodies(motion: Motion, subject: Subject, bodies: np.ndarray, frames: np.ndarray, count: int = 8
                   ) -> np.ndarray:
    """Some of the meshes (n, N, 3) of a body that changes side by side, at one scale; `frames` (n,) is when."""
    chosen = spread_indices(len(frames), count)
    return contact_sheet(bodies_in_a_row(subject, motion.poses[frames[chosen]], bodies[chosen]),
                         seconds(motion, frames[chosen]))


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


def chart(width: float, height: float) -> tuple[Any, Any]:
    """A matplotlib figure of this size, inches, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, figure.add_subplot()


def chart_residuals(motion: Motion, what: str = "markers", lost: bool = False) -> Any:
    """A matplotlib figure: the distance of the markers from the body over time; `lost` frames shaded where wanted."""
    figure, axes = chart(7.5, 2.6)
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
    from matplotlib.patches import Patch

    steps = np.array_split(np.arange(len(state)), min(len(state), 600))
    shown = np.array([state[part].max(axis=0) for part in steps])
    figure, axes = chart(7.5, 0.6 + 0.13 * len(labels))
    axes.imshow(shown.T, aspect="auto", interpolation="nearest", vmin=0, vmax=len(colors) - 1,
                cmap=ListedColormap(list(colors)), extent=(0, len(state) / rate, len(labels) - 0.5, -0.5))
    axes.set_yticks(range(len(labels)), labels, fontsize=6)
    axes.set_xlabel("time (s)")
    if names:
        patches = [Patch(color=colors[i], label=names[i]) for i in np.unique(state)]
        axes.legend(handles=patches, frameon=False, fontsize=8, ncols=len(names), loc="upper center",
                    bbox_to_anchor=(0.5, -0.52 / figure.get_figheight()))
    return figure
