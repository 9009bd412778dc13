"""Charts of a sequence: how far the markers are from the body, over time and one by one."""
from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ...motion_pictures import chart_states
from .takes import Take

POINTS = 900                         # most points of a line, and columns of a map
FIXED, SOFT, HELD = "#7a8794", "#c8452f", "#2f8f4e"
MM = 1000.0
STATES = ("believed", "not believed", "missing", "exchanged", "slipped", "noisy", "stray")
STATE_COLORS = ("#e3eaf0", "#f0c46c", "#9aa3ab", "#2f6db3", "#8557a8", "#b3592f", "#c02a3c")


def mean_over(values: np.ndarray, axis: int) -> np.ndarray:
    """The mean of what is not NaN, NaN where there is nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(values, axis=axis)


def thinned(values: np.ndarray, most: int = POINTS) -> np.ndarray:
    """Means (n, ...) of stretches of the rows (T, ...), at most so many."""
    return np.stack([mean_over(part, 0) for part in np.array_split(values, min(most, len(values)))])


def chart_frames(take: Take) -> Any:
    """The mean distance of the markers in every frame, with fixed shape, soft tissue, and of held-out ones."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.8, 2.7))
    axes = figure.add_subplot()
    lines = [("fixed shape", mean_over(take.motion.residuals, 1), FIXED)]
    if take.soft is not None:
        lines.append(("with soft tissue", mean_over(take.soft.motion.residuals, 1), SOFT))
    if take.held is not None:
        off = take.held.fixed if take.held.soft is None else take.held.soft
        lines.append(("held-out markers", mean_over(off, 1), HELD))
    for label, values, color in lines:
        shown = thinned(MM * values)
        axes.plot(np.linspace(0, take.motion.times[-1], len(shown)), shown, color=color, linewidth=1.1,
                  label=f"{label}: {MM * np.nanmean(values):.1f} mm")
    axes.set(xlabel="time (s)", ylabel="distance (mm)", ylim=(0, None), xlim=(0, max(take.motion.times[-1], 1e-9)))
    axes.legend(frameon=False, fontsize=8, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.16))
    return figure


def chart_map(take: Take) -> Any:
    """The distance of every marker in every frame, the worst marker first; white where it was not seen."""
    from matplotlib.figure import Figure

    off = take.shown.residuals
    used = np.flatnonzero(np.isfinite(off).any(axis=0))
    used = used[np.argsort(-mean_over(off[:, used], 0))]
    shown = MM * thinned(off[:, used])
    figure = Figure(figsize=(7.8, 0.7 + 0.13 * len(used)))
    axes = figure.add_subplot()
    end = float(np.nanpercentile(MM * off, 99))
    drawn = axes.imshow(shown.T, aspect="auto", interpolation="nearest", cmap="magma_r", vmin=0, vmax=end,
                        extent=(0, max(take.motion.times[-1], 1e-9), len(used) - 0.5, -0.5))
    axes.set_yticks(range(len(used)), [take.motion.labels[i] for i in used], fontsize=6)
    axes.set_xlabel("time (s)")
    figure.colorbar(drawn, ax=axes, label="distance (mm)", pad=0.015, aspect=40, extend="max")
    return figure


def chart_timeline(take: Take) -> Any:
    """When which marker was missing, not believed, exchanged with another, or elsewhere than the body says."""
    markers, faults = take.markers, take.faults
    touched = {label for e in faults.exchanges for label in (e.first, e.second)} | {b.label for b in faults.bad}
    labels = [label for label in markers.labels if label in touched or label in faults.labels]
    columns = [markers.labels.index(label) for label in labels]
    doubted = np.isfinite(take.motion.residuals[:, columns]) & ~take.motion.trusted[:, columns]
    state = np.where(markers.seen[:, columns], doubted.astype(int), STATES.index("missing"))
    for e in faults.exchanges:
        for label in (e.first, e.second):
            state[e.begin:e.end + 1, labels.index(label)] = STATES.index("exchanged")
    for b in faults.bad:
        state[b.begin:b.end + 1, labels.index(b.label)] = STATES.index(b.kind)
    return chart_states(state, labels, markers.rate, STATE_COLORS, STATES)
