"""A chart of what is wrong with the markers of a sequence."""
from __future__ import annotations

from typing import Any

import numpy as np

from ..files.markers import MarkerSequence
from ..results import MarkerFaults

COLORS = {"exchanged": "#2f6db3", "slipped": "#8557a8", "noisy": "#b3592f", "stray": "#c02a3c"}
MOST = 400.0                         # millimetres, beyond which a distance is drawn as this


def spans_of(faults: MarkerFaults) -> dict[str, list[tuple[str, int, int, str]]]:
    """For every label that has a fault: kind, first and last frame, and the other label of an exchange."""
    out: dict[str, list[tuple[str, int, int, str]]] = {}
    for e in faults.exchanges:
        for label, other in ((e.first, e.second), (e.second, e.first)):
            out.setdefault(label, []).append(("exchanged", e.begin, e.end, other))
    for b in faults.bad:
        out.setdefault(b.label, []).append((b.kind, b.begin, b.end, ""))
    return out


def chart_faults(faults: MarkerFaults, markers: MarkerSequence, rows: int = 16) -> Any:
    """Distances of the faulty markers from the simulated ones over time, before and after, with the spans found.

    Parameters
    ----------
    faults : MarkerFaults
    markers : MarkerSequence
        In which they were found, as it came.
    rows : int
        Most markers shown: those with the most faulty frames.

    Returns
    -------
    matplotlib.figure.Figure
        One row a marker: the distance as it came in grey, what is left of it in black, logarithmic.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    spans = spans_of(faults)
    length = {label: sum(end - begin + 1 for _, begin, end, _ in some) for label, some in spans.items()}
    shown = sorted((label for label in spans if label in faults.labels), key=lambda label: -length[label])[:rows]
    figure = Figure(figsize=(7.8, 0.8 + 0.55 * max(1, len(shown))))
    if not shown:
        figure.text(0.5, 0.5, "No faults were found.", ha="center", va="center")
        return figure
    axes = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axis, label in zip(axes, shown, strict=True):
        _row(axis, faults, markers, label, spans[label])
    axes[-1].set_xlabel("time (s)")
    used = [kind for kind in COLORS if any(kind == some[0] for label in shown for some in spans[label])]
    hidden = len(spans) - len(shown)
    figure.legend(handles=[Patch(color=COLORS[kind], alpha=0.45, label=kind) for kind in used], frameon=False,
                  fontsize=8, ncols=len(used), loc="upper right")
    figure.text(0.01, 0.99, "millimetres from the simulated marker; grey: as it came, black: repaired"
                + (f"; {hidden} more markers" if hidden else ""), fontsize=8, va="top")
    figure.subplots_adjust(left=0.11, right=0.985, top=1 - 0.32 / figure.get_figheight(),
                           bottom=0.42 / figure.get_figheight(), hspace=0.25)
    return figure


def _row(axis: Any, faults: MarkerFaults, markers: MarkerSequence, label: str,
         spans: list[tuple[str, int, int, str]]) -> None:
    """One marker."""
    row, times = faults.labels.index(label), markers.times
    step = 1 / markers.rate
    for kind, begin, end, other in spans:
        axis.axvspan(times[begin] - step / 2, times[end] + step / 2, color=COLORS[kind], alpha=0.45, linewidth=0)
        if other and (end - begin) > 0.06 * len(times):
            axis.text(0.5 * (times[begin] + times[end]), 2.0, other, fontsize=5.5, ha="center", color=COLORS[kind])
    for sequence, color, width in ((markers, "#9aa3ab", 1.3), (faults.repaired, "black", 0.7)):
        off = np.linalg.norm(sequence.positions[:, sequence.labels.index(label)] - faults.simulated[:, row], axis=1)
        axis.plot(times, np.clip(1000 * off, 1.0, MOST), color=color, linewidth=width)
    axis.set(yscale="log", ylim=(1.0, MOST), xlim=(0, times[-1] + step), yticks=[10, 100], yticklabels=["10", "100"])
    axis.minorticks_off()
    axis.tick_params(labelsize=7)
    axis.set_ylabel(label, rotation=0, ha="right", va="center", fontsize=8)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
