"""Pictures of a person with markers and of its soft tissue; charts of the distance of markers from the body."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from model.body import BodyModel
from scanprep.cli import MM
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import look_around, stance
from scanprep.pictures.scene import Pane, picture_pane, picture_panes
from scanprep.pictures.shading import Bones, Dots, Heat, Shape, Solid, contact_sheet
from scanprep.words import number_of

from ...motion_pictures import (
    MARKER,
    chart,
    chart_states,
    facing,
    frames_apart,
    frames_to_play,
    mean_over,
    moving_pane,
    upwards,
)
from ..artefacts.results import MarkerArtefacts
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from .takes import Take

USUAL, UNCERTAIN = (0.30, 0.50, 0.72), (0.93, 0.62, 0.16)
LITTLE = 0.005                       # metres: least end of a colour scale, so that tiny changes stay pale


def person_in_mean_pose(model: BodyModel, betas: np.ndarray) -> Mesh:
    """Return the person in the mean pose of the training set."""
    return model.template.with_vertices(model.vertices(model.pose_mean, betas))


def picture_sides(body: Mesh, found: np.ndarray, height: int = 360) -> np.ndarray:
    """Render a body with its markers (L, 3) from four sides."""
    shapes: list[Shape] = [Solid(body), Dots(found, MARKER, 0.011)]
    sides = zip(look_around(body), ("front", "left", "back", "right"), strict=True)
    return picture_panes([Pane(shapes, camera, side) for camera, side in sides], height)


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


def take_marker_dots(take: Take, t: int, radius: float = 0.014) -> list[Dots]:
    """Return the measured markers of a frame as dots: trusted and distrusted ones."""
    return [Dots(at[t], color, radius, name=name) for name, (color, at) in kinds_of_markers(take).items()]


def take_pane(take: Take) -> Pane:
    """Return the whole sequence with its markers."""
    frames, _ = frames_to_play(take.shown)
    dots = [(Dots(at[0], color, 0.013, name=name, labels=take.markers.labels), at[frames])
            for name, (color, at) in kinds_of_markers(take).items()]
    return moving_pane(take.shown, take.subject, dots, take.make, take.light)


def take_frame_panes(take: Take, frames: np.ndarray, looks: Sequence[Sequence[Shape]] | None = None,
                     radius: float = 0.014) -> list[Pane]:
    """Return some frames with their markers; `looks` replaces the plain body in each."""
    vertical, bodies = upwards(take.shown, take.subject), take.bodies(frames)
    looks = looks or [[take.light.mesh(body)] for body in bodies]
    return [Pane([*look, *take_marker_dots(take, int(t), radius)],
                 facing(take.subject, take.shown.poses[t], body, vertical=vertical),
                 f"{t} · {t / take.shown.rate:.2f} s")
            for t, body, look in zip(frames, bodies, looks, strict=True)]


def picture_large(take: Take, frames: np.ndarray, height: int = 340) -> np.ndarray:
    """Render some frames in a row."""
    panes = take_frame_panes(take, frames)
    return contact_sheet([picture_pane(pane, round(0.62 * height), height) for pane in panes],
                         [pane.label for pane in panes])


def soft_change(take: Take, frames: np.ndarray) -> np.ndarray:
    """Compute the displacement (n, N), metres, of the skin by soft tissue along the normal; inwards is negative."""
    rigid, soft = take.rigid(frames), take.bodies(frames)
    template = take.subject.template
    normals = np.stack([template.with_vertices(v).vertex_normals for v in rigid])
    return np.einsum("tnd,tnd->tn", soft - rigid, normals)


def soft_pane(take: Take, frames: np.ndarray) -> Pane:
    """Return a body coloured by the root mean square displacement of soft tissue over some frames."""
    change = np.sqrt(((take.bodies(frames) - take.rigid(frames))**2).sum(axis=2).mean(axis=0))
    body = take.subject.template.with_vertices(
        take.subject.vertices(take.model.pose_mean).astype(float))
    end = max(float(np.percentile(change, 99.5)), LITTLE)
    shown = Heat(change, 0, end, "change of the skin, root mean square over time")
    return Pane([Solid(body, shown)], look_around(body, turns=(20,))[0])


def soft_tissue_panes(take: Take, frames: np.ndarray) -> list[Pane]:
    """Return frames coloured by the displacement of the skin, with the fixed shape as a hidden layer."""
    change, light, looks = soft_change(take, frames), take.light, list[list[Shape]]()
    end = max(float(np.percentile(np.abs(change), 99.5)), LITTLE)
    for rigid, soft, out in zip(take.rigid(frames), take.bodies(frames), change, strict=True):
        shown = Heat(out[light.vertex_ids], -end, end, "skin moved inwards (-) and outwards", colormap="coolwarm")
        looks.append([Solid(light.mesh(soft), shown, name="with soft tissue"),
                      Solid(light.mesh(rigid), name="fixed shape", visible=False)])
    return take_frame_panes(take, frames, looks, 0.010)


def most_changed(take: Take, frames: np.ndarray, count: int) -> np.ndarray:
    """Return the frames, in order, in which soft tissue moves the body most, no two close in time."""
    size = np.sqrt((soft_change(take, frames)**2).mean(axis=1))
    return frames_apart(frames[np.argsort(-size)], count, len(take.motion.poses) / (3 * count))


def change_of_place(body: Mesh, layout: MarkerLayout, found: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Compute places (L, 3), metres, of markers on a body, and the way from usual places: up, forward, left (L, 3)."""
    # axes of the body: up, forward, left
    vertical, ahead = stance(body)
    axes = np.stack([vertical, ahead, np.cross(vertical, ahead)])
    places = found.place(body)
    return places, (places - layout.place(body)) @ axes.T


STATES = {"believed": "#e3eaf0", "not believed": "#f0c46c", "missing": "#9aa3ab", "swapped": "#2f6db3",
          "slipped": "#8557a8", "noisy": "#b3592f", "stray": "#c02a3c"}


def _average_stretches(values: np.ndarray, most: int = 900) -> np.ndarray:
    """Average rows (T, ...) over at most `most` stretches of equal length."""
    return np.stack([mean_over(part, 0) for part in np.array_split(values, min(most, len(values)))])


def chart_frames(take: Take) -> Any:
    """Plot the mean distance of the markers over time: fixed shape, soft tissue."""
    # one line each, averaged to a readable number of points
    figure, axes = chart(7.8, 2.7)
    lines = [("fixed shape", take.motion.residuals, "#7a8794")]
    if take.soft is not None:
        lines.append(("with soft tissue", take.soft.motion.residuals, "#c8452f"))
    for label, residuals, color in lines:
        values = mean_over(residuals, 1)
        shown = _average_stretches(MM * values)
        axes.plot(np.linspace(0, take.motion.times[-1], len(shown)), shown, color=color, linewidth=1.1,
                  label=f"{label}: {MM * np.nanmean(values):.1f} mm")
    axes.set(xlabel="time (s)", ylabel="distance (mm)", ylim=(0, None), xlim=(0, max(take.motion.times[-1], 1e-9)))
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    return figure


def chart_map(take: Take) -> Any:
    """Plot the distance of every marker over time, the worst marker first; white where it was not seen."""
    # used markers only, the worst first
    off = take.shown.residuals
    used = np.flatnonzero(np.isfinite(off).any(axis=0))
    used = used[np.argsort(-mean_over(off[:, used], 0))]
    figure, axes = chart(7.8, 0.7 + 0.13 * len(used))
    drawn = axes.imshow(MM * _average_stretches(off[:, used]).T, aspect="auto", interpolation="nearest", cmap="magma_r",
                        vmin=0,
                        vmax=float(np.nanpercentile(MM * off, 99)),
                        extent=(0, max(take.motion.times[-1], 1e-9), len(used) - 0.5, -0.5))
    axes.set_yticks(range(len(used)), [take.motion.labels[i] for i in used], fontsize=6)
    axes.set_xlabel("time (s)")
    figure.colorbar(drawn, ax=axes, label="distance (mm)", pad=0.015, aspect=40, extend="max")
    return figure


def chart_timeline(take: Take) -> Any:
    """Plot the state of every marker over time: seen, distrusted, missing, swapped, or a bad span."""
    markers, found, names = take.markers, take.artefacts, list(STATES)
    labels = [label for label in markers.labels if label in found.labels_touched or label in found.labels]
    columns = [markers.labels.index(label) for label in labels]
    # 0 trusted, 1 distrusted, 2 missing, then the kinds of artefacts
    uncertain = np.isfinite(take.motion.residuals[:, columns]) & ~take.motion.trusted[:, columns]
    state = np.where(markers.seen[:, columns], uncertain.astype(int), names.index("missing"))
    for label, spans in _spans(found).items():
        for kind, begin, end, _ in spans:
            state[begin:end + 1, labels.index(label)] = names.index(kind)
    return chart_states(state, labels, markers.rate, tuple(STATES.values()), tuple(names))


def _spans(found: MarkerArtefacts) -> dict[str, list[tuple[str, int, int, str]]]:
    """Return label -> spans of artefacts: kind, first and last frame, and the other label of a swap."""
    out: dict[str, list[tuple[str, int, int, str]]] = {}
    for s in found.swaps:
        for label, other in ((s.first, s.second), (s.second, s.first)):
            out.setdefault(label, []).append(("swapped", s.begin, s.end, other))
    for b in found.bad:
        out.setdefault(b.label, []).append((b.kind, b.begin, b.end, ""))
    return out


def chart_artefacts(found: MarkerArtefacts, markers: MarkerSequence, rows: int = 16) -> Any:
    """Plot distances from the simulated markers over time, for the markers with the most frames of artefacts.

    There is one row for each marker, on a logarithmic scale: raw distance in grey, repaired distance in black.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    spans, times, most, step = _spans(found), markers.times, 400.0, 1 / markers.rate
    # the markers with the longest artefacts in all
    length = {label: sum(end - begin + 1 for _, begin, end, _ in some) for label, some in spans.items()}
    shown = sorted((label for label in spans if label in found.labels), key=lambda label: -length[label])[:rows]
    figure = Figure(figsize=(7.8, 0.8 + 0.55 * max(1, len(shown))))
    if not shown:
        figure.text(0.5, 0.5, "None was found.", ha="center", va="center")
        return figure
    axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axis, label in zip(axes, shown, strict=True):
        row = found.labels.index(label)
        # spans as coloured bands, with the other label of a longer swap
        for kind, begin, end, other in spans[label]:
            axis.axvspan(times[begin] - step / 2, times[end] + step / 2, color=STATES[kind], alpha=0.45, linewidth=0)
            if other and (end - begin) > 0.06 * len(times):
                axis.text(0.5 * (times[begin] + times[end]), 2.0, other, fontsize=5.5, ha="center", color=STATES[kind])
        for sequence, color, width in ((markers, "#9aa3ab", 1.3), (found.repaired, "black", 0.7)):
            off = np.linalg.norm(sequence.positions[:, sequence.labels.index(label)] - found.simulated[:, row], axis=1)
            axis.plot(times, np.clip(MM * off, 1.0, most), color=color, linewidth=width)
        axis.set(yscale="log", ylim=(1.0, most), xlim=(0, times[-1] + step), yticks=[10, 100],
                 yticklabels=["10", "100"])
        axis.minorticks_off()
        axis.tick_params(labelsize=7)
        axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    axes[-1].set_xlabel("time (s)")
    # a legend of the kinds that occur, and how many markers are not shown
    used = [kind for kind in STATES if any(kind == some[0] for label in shown for some in spans[label])]
    hidden = len(spans) - len(shown)
    figure.legend(handles=[Patch(color=STATES[kind], alpha=0.45, label=kind) for kind in used], frameon=False,
                  fontsize=8, ncols=len(used), loc="upper right")
    figure.text(0.01, 0.99, "millimetres from the simulated marker; grey: as it came, black: repaired"
                + (f"; {number_of(hidden, 'more marker')}" if hidden else ""), fontsize=8, va="top")
    figure.subplots_adjust(left=0.11, right=0.985, top=1 - 0.32 / figure.get_figheight(),
                           bottom=0.42 / figure.get_figheight(), hspace=0.25)
    return figure
