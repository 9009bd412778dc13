"""Charts of a sequence: how far the markers are from the body, over time and one by one."""
from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ...motion_pictures import chart_states
from ..artefacts.results import MarkerArtefacts
from ..files.markers import MarkerSequence
from .takes import Take

MM = 1000.0
STATES = {"believed": "#e3eaf0", "not believed": "#f0c46c", "missing": "#9aa3ab", "swapped": "#2f6db3",
          "slipped": "#8557a8", "noisy": "#b3592f", "stray": "#c02a3c"}


def mean_over(values: np.ndarray, axis: int) -> np.ndarray:
    """The mean of what is not NaN, NaN where there is nothing."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.nanmean(values, axis=axis)


def _thinned(values: np.ndarray, most: int = 900) -> np.ndarray:
    """Means (n, ...) of stretches of the rows (T, ...), at most so many."""
    return np.stack([mean_over(part, 0) for part in np.array_split(values, min(most, len(values)))])


def chart_frames(take: Take) -> Any:
    """The mean distance of the markers in every frame, with fixed shape, soft tissue, and of held-out ones."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.8, 2.7))
    axes = figure.add_subplot()
    lines = [("fixed shape", take.motion.residuals, "#7a8794")]
    if take.soft is not None:
        lines.append(("with soft tissue", take.soft.motion.residuals, "#c8452f"))
    if take.held is not None:
        lines.append(("held-out markers", take.held.shown, "#2f8f4e"))
    for label, residuals, color in lines:
        values = mean_over(residuals, 1)
        shown = _thinned(MM * values)
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
    figure = Figure(figsize=(7.8, 0.7 + 0.13 * len(used)))
    axes = figure.add_subplot()
    drawn = axes.imshow(MM * _thinned(off[:, used]).T, aspect="auto", interpolation="nearest", cmap="magma_r", vmin=0,
                        vmax=float(np.nanpercentile(MM * off, 99)),
                        extent=(0, max(take.motion.times[-1], 1e-9), len(used) - 0.5, -0.5))
    axes.set_yticks(range(len(used)), [take.motion.labels[i] for i in used], fontsize=6)
    axes.set_xlabel("time (s)")
    figure.colorbar(drawn, ax=axes, label="distance (mm)", pad=0.015, aspect=40, extend="max")
    return figure


def chart_timeline(take: Take) -> Any:
    """When which marker was missing, not believed, swapped with another, or elsewhere than the body says."""
    markers, found, names = take.markers, take.artefacts, list(STATES)
    labels = [label for label in markers.labels if label in found.labels_touched or label in found.labels]
    columns = [markers.labels.index(label) for label in labels]
    doubted = np.isfinite(take.motion.residuals[:, columns]) & ~take.motion.trusted[:, columns]
    state = np.where(markers.seen[:, columns], doubted.astype(int), names.index("missing"))
    for label, spans in _spans(found).items():
        for kind, begin, end, _ in spans:
            state[begin:end + 1, labels.index(label)] = names.index(kind)
    return chart_states(state, labels, markers.rate, tuple(STATES.values()), tuple(names))


def _spans(found: MarkerArtefacts) -> dict[str, list[tuple[str, int, int, str]]]:
    """For every label with an artefact: kind, first and last frame, and the other label of a swap."""
    out: dict[str, list[tuple[str, int, int, str]]] = {}
    for s in found.swaps:
        for label, other in ((s.first, s.second), (s.second, s.first)):
            out.setdefault(label, []).append(("swapped", s.begin, s.end, other))
    for b in found.bad:
        out.setdefault(b.label, []).append((b.kind, b.begin, b.end, ""))
    return out


def chart_artefacts(found: MarkerArtefacts, markers: MarkerSequence, rows: int = 16) -> Any:
    """Distances from the simulated markers over time, logarithmic, of those with the most frames of artefacts.

    One row a marker: the distance as it came in `markers` in grey, what is left of it in black.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    spans = _spans(found)
    length = {label: sum(end - begin + 1 for _, begin, end, _ in some) for label, some in spans.items()}
    shown = sorted((label for label in spans if label in found.labels), key=lambda label: -length[label])[:rows]
    figure = Figure(figsize=(7.8, 0.8 + 0.55 * max(1, len(shown))))
    if not shown:
        figure.text(0.5, 0.5, "None was found.", ha="center", va="center")
        return figure
    axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axis, label in zip(axes, shown, strict=True):
        _row(axis, found, markers, label, spans[label])
    axes[-1].set_xlabel("time (s)")
    used = [kind for kind in STATES if any(kind == some[0] for label in shown for some in spans[label])]
    hidden = len(spans) - len(shown)
    figure.legend(handles=[Patch(color=STATES[kind], alpha=0.45, label=kind) for kind in used], frameon=False,
                  fontsize=8, ncols=len(used), loc="upper right")
    figure.text(0.01, 0.99, "millimetres from the simulated marker; grey: as it came, black: repaired"
                + (f"; {hidden} more markers" if hidden else ""), fontsize=8, va="top")
    figure.subplots_adjust(left=0.11, right=0.985, top=1 - 0.32 / figure.get_figheight(),
                           bottom=0.42 / figure.get_figheight(), hspace=0.25)
    return figure


def _row(axis: Any, found: MarkerArtefacts, markers: MarkerSequence, label: str,
         spans: list[tuple[str, int, int, str]]) -> None:
    """One marker."""
    row, times, most, step = found.labels.index(label), markers.times, 400.0, 1 / markers.rate
    for kind, begin, end, other in spans:
        axis.axvspan(times[begin] - step / 2, times[end] + step / 2, color=STATES[kind], alpha=0.45, linewidth=0)
        if other and (end - begin) > 0.06 * len(times):
            axis.text(0.5 * (times[begin] + times[end]), 2.0, other, fontsize=5.5, ha="center", color=STATES[kind])
    for sequence, color, width in ((markers, "#9aa3ab", 1.3), (found.repaired, "black", 0.7)):
        off = np.linalg.norm(sequence.positions[:, sequence.labels.index(label)] - found.simulated[:, row], axis=1)
        axis.plot(times, np.clip(MM * off, 1.0, most), color=color, linewidth=width)
    axis.set(yscale="log", ylim=(1.0, most), xlim=(0, times[-1] + step), yticks=[10, 100], yticklabels=["10", "100"])
    axis.minorticks_off()
    axis.tick_params(labelsize=7)
    axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
