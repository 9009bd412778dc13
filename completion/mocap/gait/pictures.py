"""Charts of a walk: joint angles over the gait cycle, and forces of the ground over time."""
from __future__ import annotations

from typing import Any

import numpy as np

from ...motion_pictures import chart
from ..files.force_plates import GroundReactions
from .cycles import PERCENT, SIDES, GaitCycles

# the angles that a gait report begins with, and what a positive one means
CHARTS = {"hip_flexion": "hip flexion", "knee_angle": "knee flexion", "ankle_angle": "ankle dorsiflexion",
          "hip_adduction": "hip adduction", "pelvis_tilt": "pelvis tilt, backward",
          "pelvis_list": "pelvis list, right down", "pelvis_rotation": "pelvis rotation, to the left",
          "hip_rotation": "hip rotation, inward"}
COLORS = {"l": "#c8452f", "r": "#2f6db3"}


def chart_cycles(gait: GaitCycles) -> Any:
    """Plot mean and one standard deviation of the main joint angles over the gait cycle, left and right."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.4, 4.6))
    for axis, (name, title) in zip(figure.subplots(2, 4, sharex=True).flat, CHARTS.items(), strict=True):
        for side, i in gait.columns(name):
            mean, sd = gait.mean[:, i], np.nan_to_num(gait.sd[:, i])
            axis.fill_between(PERCENT, mean - sd, mean + sd, color=COLORS[side], alpha=0.2, linewidth=0)
            axis.plot(PERCENT, mean, color=COLORS[side], linewidth=1.4,
                      label=f"{SIDES[side]}, mean and SD of {gait.counts[i]}")
        axis.axhline(0, color="0.8", linewidth=0.7, zorder=0)
        axis.set_title(f"{title} (°)", fontsize=9)
        axis.set(xlim=(0, 100), xticks=(0, 50, 100))
        axis.tick_params(labelsize=8)
        axis.spines[["top", "right"]].set_visible(False)
    figure.supxlabel("gait cycle (%)", fontsize=9)
    handles = {label: handle for axis in figure.axes
               for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    figure.legend(handles.values(), handles.keys(), frameon=False, fontsize=9, ncols=len(handles), loc="upper center")
    figure.subplots_adjust(left=0.05, right=0.99, top=0.86, bottom=0.12, hspace=0.3, wspace=0.25)
    return figure


def chart_forces(reactions: GroundReactions) -> Any:
    """Plot the vertical force of every loaded plate over time."""
    figure, axes = chart(7.8, 2.4)
    # at most 2,000 places, the largest force of each, as a chart has no more pixels
    steps = np.array_split(np.arange(len(reactions.times)), min(len(reactions.times), 2000))
    for p, number in enumerate(reactions.plates):
        vertical = np.array([reactions.forces[step, p, 1].max() for step in steps])
        if vertical.any():
            axes.plot([reactions.times[step[0]] for step in steps], vertical, linewidth=1.2, label=f"plate {number}")
    axes.set(xlabel="time (s)", ylabel="vertical force (N)", ylim=(0, None), xlim=(0, reactions.times[-1]))
    if axes.lines:
        axes.legend(frameon=False, fontsize=8)
    return figure
