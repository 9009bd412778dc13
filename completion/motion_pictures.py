"""Pictures and charts of a body in motion."""
from __future__ import annotations

import functools
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
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane, match_camera_scales, picture_pane
from scanprep.pictures.shading import Dots, Moving, Solid, contact_sheet

from .motion import Motion

# colours of markers, and of a body in frames that were lost
MARKER, LOST = (0.85, 0.25, 0.2), (0.78, 0.78, 0.78)
PLAYED, MOST_PLAYED = 30, 2000       # frames per second, and in total, that a page plays: smooth, not too large
TURN = 35.0                          # degrees of the camera from the body's front: shows steps and depth


def upwards(motion: Motion, subject: Subject) -> np.ndarray:
    """Find the direction (3,) that is up in a motion."""
    return stance(subject.template, rotations.exp(motion.poses[:, 0]))[0]


def facing(subject: Subject, pose: np.ndarray, vertices: np.ndarray, turn: float = TURN,
           vertical: np.ndarray | None = None) -> Camera:
    """Make a camera that sees a body (..., 3) from `turn` degrees beside its front, whichever way it faces.

    `pose` (..., J, 3) is the body's, or all of its motion. For a single frame pass the `vertical` of the whole motion.
    """
    return look_around(subject.template, vertices, (turn,), rotations.exp(pose[..., 0, :]), vertical)[0]


def worst_frames(motion: Motion, count: int) -> np.ndarray:
    """Return at most `count` frames with the largest mean residual, in order, a quarter of a second apart."""
    off = np.nan_to_num(mean_over(motion.residuals, 1))
    return frames_apart(np.argsort(-off), count, motion.rate / 4)


def frames_apart(frames: np.ndarray, count: int, apart: float) -> np.ndarray:
    """Choose the first `count` of some frames that are at least `apart` frames from each other; in order."""
    chosen: list[int] = []
    for t in frames.tolist():
        if len(chosen) < count and all(abs(t - other) >= apart for other in chosen):
            chosen.append(t)
    return np.sort(chosen).astype(int)


@dataclass(frozen=True, eq=False)
class LightMesh:
    """Some vertices (n,) of a body and triangles (f, 3) between them, for small pictures and motions."""

    vertex_ids: np.ndarray
    faces: np.ndarray

    @staticmethod
    @functools.lru_cache(maxsize=2)          # the same for all motions of a person
    def of(template: Mesh) -> LightMesh:
        """Simplify a template; one with few triangles is kept."""
        light = 7000  # triangles that suffice for small pictures and motions
        if len(template.faces) <= light:
            return LightMesh(np.arange(len(template.vertices)), template.faces)
        small = decimate_set(template, None, light)
        return LightMesh(small.vertex_map, small.template.faces)

    def mesh(self, vertices: np.ndarray) -> Mesh:
        """Return the small mesh of a full body's vertices (N, 3)."""
        return Mesh(vertices[self.vertex_ids], self.faces)


Bodies = Callable[[np.ndarray], np.ndarray]            # frames (n,) -> vertices (n, N, 3), metres


def frames_to_play(motion: Motion) -> tuple[np.ndarray, float]:
    """Return the frames that a page plays, and how many per second."""
    step = max(1, round(motion.rate / PLAYED), -(-len(motion.poses) // MOST_PLAYED))
    return np.arange(0, len(motion.poses), step), motion.rate / step


def moving_pane(motion: Motion, subject: Subject, dots: Sequence[tuple[Dots, np.ndarray]] = (),
                bodies: Bodies | None = None, color: Sequence[float] | None = None) -> Pane:
    """Make a pane of a body in motion, with dots; the body stays in the middle of the picture.

    Parameters
    ----------
    motion : Motion
        The motion; frames that did not converge are grey.
    subject : Subject
        The body that moves.
    dots : sequence of (Dots, (n, L, 3) float in metres)
        Dots, and their places in the frames of `frames_to_play`.
    bodies : callable, optional
        Returns vertices (n, N, 3), metres, of frames (n,), if not those of the subject.
    color : (3,) float, optional
        Colour of the body.

    Returns
    -------
    Pane
    """
    frames, rate = frames_to_play(motion)
    light = LightMesh.of(subject.template)
    make = bodies or (lambda chosen: motion.vertices(subject, chosen))
    # 128 full bodies in memory at a time
    shown = np.concatenate([make(frames[i:i + 128])[:, light.vertex_ids].astype(np.float32)
                            for i in range(0, len(frames), 128)])
    vertical = upwards(motion, subject)
    # follow the body horizontally, not up and down
    middle = shown.mean(axis=1, keepdims=True) * (1 - np.abs(vertical)).astype(np.float32)
    shown -= middle
    first, lost = Mesh(shown[0].astype(float), light.faces), ~motion.converged[frames]
    shapes: list[Moving] = []
    # two shapes, of which each frame shows one: the body, or the grey body where it was lost
    for mask, name, look in ((~lost, "body", color), (lost, "lost frames", LOST)):
        if mask.any():
            seen = shown if mask.all() else np.where(mask[:, None, None], shown, np.float32(np.nan))
            shapes.append(Moving(Solid(first, look, name=name), seen, rate))
    shapes += [Moving(replace(one, points=(place - middle)[0]), place - middle, rate) for one, place in dots]
    camera = facing(subject, motion.poses, shown[:: max(1, len(shown) // 50)].reshape(-1, 3))
    return Pane(shapes, camera)


def pane_with_dots(motion: Motion, subject: Subject, places: np.ndarray, name: str, labels: Sequence[str],
                   on_top: bool = False) -> Pane:
    """Make a pane of a body in motion with the places (T, L, 3), metres, that it follows."""
    at = places[frames_to_play(motion)[0]]
    return moving_pane(motion, subject, [(Dots(at[0], MARKER, 0.013, on_top, name=name, labels=labels), at)])


def frame_panes(motion: Motion, subject: Subject, markers: np.ndarray, frames: np.ndarray, turn: float = TURN
                ) -> list[Pane]:
    """Make a pane for each of some frames, with measured markers (T, L, 3), metres, as dots."""
    panes, light, vertical = [], LightMesh.of(subject.template), upwards(motion, subject)
    for t, vertices, time in zip(frames, motion.vertices(subject, frames), seconds(motion, frames), strict=True):
        camera = facing(subject, motion.poses[t], vertices, turn, vertical)
        panes.append(Pane([light.mesh(vertices), Dots(markers[t], MARKER, radius=0.013)], camera, time))
    return panes


def seconds(motion: Motion, frames: np.ndarray) -> list[str]:
    """Return the times of frames as text."""
    return [f"{t / motion.rate:.2f} s" for t in frames]


def bodies_in_a_row(subject: Subject, poses: np.ndarray, bodies: np.ndarray, colors: np.ndarray | None = None,
                    height: int = 360) -> list[np.ndarray]:
    """Render bodies (n, N, 3) in poses (n, J, 3) at one scale; `colors` (n, N, 3) are of their vertices."""
    vertical = stance(subject.template, rotations.exp(poses[:, 0]))[0]
    panes = [Pane([Solid(subject.template.with_vertices(body), None if colors is None else colors[i])],
                  facing(subject, poses[i], body, vertical=vertical)) for i, body in enumerate(bodies)]
    return [picture_pane(pane, int(0.62 * height), height) for pane in match_camera_scales(panes)]


def picture_bodies(motion: Motion, subject: Subject, bodies: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """Render some meshes (n, N, 3) of a changing body side by side, at one scale; `frames` (n,) is when."""
    chosen = spread_indices(len(frames), 8)              # so many fit side by side
    return contact_sheet(bodies_in_a_row(subject, motion.poses[frames[chosen]], bodies[chosen]),
                         seconds(motion, frames[chosen]))


def mean_over(values: np.ndarray, axis: int) -> np.ndarray:
    """Compute the mean of all values that are not NaN; NaN where there are none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(values, axis=axis)


def show_markers(page: Page, motion: Motion, soft: Motion | None = None) -> None:
    """Add a table of the markers, the worst first, and the names of those that were never used.

    Distances are from the body of fixed shape, and if given from the one with `soft` tissue, to which the 95th
    percentile refers.
    """
    motions = {"mean distance (mm)": motion} if soft is None else {"fixed shape (mm)": motion, "soft tissue (mm)": soft}
    shown, rows, unused = motion if soft is None else soft, [], []
    for i, label in enumerate(motion.labels):
        seen = np.isfinite(motion.residuals[:, i])
        if not seen.any():
            unused.append(label)
            continue
        rows.append((label, *(1000 * float(mean_over(each.residuals[:, i], 0)) for each in motions.values()),
                     float(np.nanpercentile(1000 * shown.residuals[seen, i], 95)), 100 * float(seen.mean()),
                     100 * float(motion.trusted[seen, i].mean())))
    page.table(sorted(rows, key=lambda row: -row[1]),
               ("marker", *motions, "95th percentile (mm)", "seen (%)", "believed (%)"))
    if unused:
        page.text(f"Not used, because the layout does not know them or they were never seen: {', '.join(unused)}.")


def chart(width: float, height: float) -> tuple[Any, Any]:
    """Make a matplotlib figure of this size, inches, and its axes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, figure.add_subplot()


def chart_residuals(motion: Motion, what: str = "markers") -> Any:
    """Draw the distance of the markers from the body over time."""
    figure, axes = chart(7.5, 2.6)
    shown = np.isfinite(motion.residuals).any(axis=1)
    millimetres = 1000 * motion.residuals[shown]
    axes.fill_between(motion.times[shown], *np.nanpercentile(millimetres, [10, 90], axis=1), alpha=0.25,
                      label="10th to 90th percentile", linewidth=0)
    axes.plot(motion.times[shown], np.nanmean(millimetres, axis=1), linewidth=1.2, label="mean")
    axes.set(xlabel="time (s)", ylabel=f"distance of the {what} (mm)", ylim=(0, None))
    axes.legend(frameon=False)
    return figure
