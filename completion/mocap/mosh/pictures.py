"""Pictures of a person with markers and of its soft tissue; charts of the distance of markers from the body."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from model.body import BodyModel
from scanprep.cli import MM
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import look_around, stance
from scanprep.pictures.scene import Pane, picture_panes
from scanprep.pictures.shading import Bones, Dots, Heat, Shape, Solid

from ...motion_pictures import (
    MARKER,
    chart,
    chart_states,
    facing,
    frames_to_play,
    mean_over,
    moving_pane,
    upwards,
)
from ..marker_sets.layout import MarkerLayout
from .takes import Take

USUAL, UNCERTAIN = (0.30, 0.50, 0.72), (0.93, 0.62, 0.16)


def person_in_mean_pose(model: BodyModel, betas: np.ndarray) -> Mesh:
    """Return the person in the mean pose of the training set."""
    return model.template.with_vertices(model.vertices(model.pose_mean, betas))


def picture_sides(body: Mesh, found: np.ndarray) -> np.ndarray:
    """Render a body with its markers (L, 3) from four sides."""
    shapes: list[Shape] = [Solid(body), Dots(found, MARKER, 0.011)]
    sides = zip(look_around(body), ("front", "left", "back", "right"), strict=True)
    return picture_panes([Pane(shapes, camera, side) for camera, side in sides], 360)


def person_pane(body: Mesh, found: np.ndarray, usual: np.ndarray, labels: Sequence[str]) -> Pane:
    """Return a body with its markers (L, 3), and their usual places (L, 3) with a rod between the two."""
    return Pane([Solid(body, name="body"), Dots(found, MARKER, 0.011, name="markers as found", labels=labels),
                 Dots(usual, USUAL, 0.009, name="in the layout"),
                 Bones(usual, found, USUAL, 0.004, name="from one to the other")], look_around(body, turns=(20,))[0])


def kinds_of_markers(take: Take) -> dict[str, tuple[Sequence[float], np.ndarray]]:
    """Return kind -> colour and positions (T, L, 3) of the measured markers of that kind, NaN elsewhere."""
    used = np.isfinite(take.motion.residuals).any(axis=0)
    kinds = {"believed markers": (MARKER, take.motion.trusted & used),
             "not believed": (UNCERTAIN, ~take.motion.trusted & used)}
    found = {name: (color, np.where(np.broadcast_to(which, take.motion.trusted.shape)[..., None],
                                    take.markers.positions, np.nan)) for name, (color, which) in kinds.items()}
    return {name: (color, at) for name, (color, at) in found.items() if np.isfinite(at).any()}


def take_pane(take: Take) -> Pane:
    """Return the whole sequence with its markers."""
    frames, _ = frames_to_play(take.shown)
    dots = [(Dots(at[0], color, 0.013, name=name, labels=take.markers.labels), at[frames])
            for name, (color, at) in kinds_of_markers(take).items()]
    return moving_pane(take.shown, take.subject, dots, take.make, take.light)


def take_frame_panes(take: Take, frames: np.ndarray) -> list[Pane]:
    """Return some frames with their markers."""
    vertical, panes = upwards(take.shown, take.subject), []
    for t, body in zip(frames.tolist(), take.bodies(frames), strict=True):
        dots = [Dots(at[t], color, 0.014, name=name) for name, (color, at) in kinds_of_markers(take).items()]
        panes.append(Pane([take.light.mesh(body), *dots],
                          facing(take.subject, take.shown.poses[t], body, vertical=vertical),
                          f"{t} · {t / take.shown.rate:.2f} s"))
    return panes


def soft_pane(take: Take, frames: np.ndarray) -> Pane:
    """Return a body coloured by the root mean square displacement of soft tissue over some frames."""
    change = np.sqrt(((take.bodies(frames) - take.rigid(frames))**2).sum(axis=2).mean(axis=0))
    body = take.subject.template.with_vertices(
        take.subject.vertices(take.model.pose_mean).astype(float))
    # 0.005 metres at least, so that tiny changes stay pale
    end = max(float(np.percentile(change, 99.5)), 0.005)
    shown = Heat(change, 0, end, "change of the skin, root mean square over time")
    return Pane([Solid(body, shown)], look_around(body, turns=(20,))[0])


def change_of_place(body: Mesh, layout: MarkerLayout, found: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Compute places (L, 3), metres, of markers on a body, and the way from usual places: up, forward, left (L, 3)."""
    # axes of the body: up, forward, left
    vertical, ahead = stance(body)
    axes = np.stack([vertical, ahead, np.cross(vertical, ahead)])
    places = found.place(body)
    return places, (places - layout.place(body)) @ axes.T


STATES = {"believed": "#e3eaf0", "not believed": "#f0c46c", "missing": "#9aa3ab", "swapped": "#2f6db3",
          "slipped": "#8557a8", "noisy": "#b3592f", "stray": "#c02a3c"}


def chart_frames(take: Take) -> Any:
    """Plot the mean distance of the markers over time: fixed shape, soft tissue."""
    # one line each, averaged to a readable number of points
    figure, axes = chart(7.8, 2.7)
    lines = [("fixed shape", take.motion.residuals, "#7a8794")]
    if take.soft is not None:
        lines.append(("with soft tissue", take.soft.motion.residuals, "#c8452f"))
    for label, residuals, color in lines:
        values = mean_over(residuals, 1)
        # at most 900 stretches of equal length, as a chart has no more pixels
        parts = np.array_split(MM * values, min(900, len(values)))
        shown = np.stack([mean_over(part, 0) for part in parts])
        axes.plot(np.linspace(0, take.motion.times[-1], len(shown)), shown, color=color, linewidth=1.1,
                  label=f"{label}: {MM * np.nanmean(values):.1f} mm")
    axes.set(xlabel="time (s)", ylabel="distance (mm)", ylim=(0, None), xlim=(0, max(take.motion.times[-1], 1e-9)))
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    return figure


def chart_timeline(take: Take) -> Any:
    """Plot the state of every marker over time: seen, distrusted, missing, swapped, or a bad span."""
    markers, found, names = take.markers, take.artefacts, list(STATES)
    labels = [label for label in markers.labels if label in found.labels_touched or label in found.labels]
    columns = [markers.labels.index(label) for label in labels]
    # 0 trusted, 1 distrusted, 2 missing, then the kinds of artefacts
    uncertain = np.isfinite(take.motion.residuals[:, columns]) & ~take.motion.trusted[:, columns]
    state = np.where(markers.seen[:, columns], uncertain.astype(int), names.index("missing"))
    for swap in found.swaps:
        for label in (swap.first, swap.second):
            state[swap.begin:swap.end + 1, labels.index(label)] = names.index("swapped")
    for span in found.bad:
        state[span.begin:span.end + 1, labels.index(span.label)] = names.index(span.kind)
    return chart_states(state, labels, markers.rate, tuple(STATES.values()), tuple(names))
