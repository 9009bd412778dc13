"""The page of a labelled recording: what is unsure first, then every marker over time."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scanprep.console import Metric
from scanprep.pictures.page import Page

from ...motion_pictures import chart, frame_panes, frames_apart
from .label import SURE
from .recording import LabelledRecording

SHOWN = 30                           # stretches that are listed
STEPS = 700                          # columns of the chart, at most
GAP = 0.97                           # brightness of a gap


def label_page(recording: LabelledRecording, metrics: Sequence[Metric], table: str) -> Page:
    """The page; `table` is the name of the table of labels."""
    several = len(recording.people) > 1
    page = Page(f"{recording.path.name}, labelled", "Which point is which marker, and how sure that is.")
    page.verdict(recording.judgement)
    page.section("Where it is unsure", f"To correct: open `{table}`, change the label (empty: no marker), write `yes` "
                 f"into the column fixed, and run again with `--labels {table}`. Or correct the written recording in "
                 "any program for C3D.")
    rows = unsure_stretches(recording)
    if rows:
        page.table(rows[:SHOWN], ("from (s)", "to (s)", "frames", "label", "point", "confidence"))
        if len(rows) > SHOWN:
            page.text(f"And {len(rows) - SHOWN} more; the table of labels has all, the least certain first.")
    else:
        page.text(f"Nowhere: all labels have a confidence of {SURE:g} at least.")
    for k, one in enumerate(recording.people, start=1):
        worst = frames_apart(_least_sure(one.confidence, one.columns), 3, 0.3 * one.motion.rate)
        page.bodies(frame_panes(one.motion, one.subject, one.markers.positions, worst),
                    (f"person {k}: " if several else "") + "the body with its labelled points, in the frames that are "
                    "least sure", 320)
    page.section("Markers over time", "A row for each marker: dark where its label is sure, pale where it is not, "
                 "white where it has no point. The colour changes where another track goes on. Below: how many points "
                 "have no label.")
    for k, one in enumerate(recording.people, start=1):
        page.chart(chart_labels(one.columns, one.confidence, one.tracks, one.unlabelled, one.markers.labels,
                                one.markers.rate), f"person {k}" if several else "")
    return page.section("Figures").figures(metrics)


def unsure_stretches(recording: LabelledRecording) -> list[tuple[str, str, int, str, str, float]]:
    """Begin and end, frames, label, point and mean confidence of stretches that are unsure, the least sure first."""
    columns, confidence, rate = recording.columns, recording.confidence, recording.points.rate
    doubted = (columns >= 0) & (confidence < SURE)
    rows = []
    for marker in np.flatnonzero(doubted.any(axis=0)):
        edges = np.flatnonzero(np.diff(np.r_[False, doubted[:, marker], False].astype(int))).reshape(-1, 2)
        for begin, end in edges:
            point = recording.points.labels[columns[begin, marker]]
            rows.append((f"{begin / rate:.2f}", f"{(end - 1) / rate:.2f}", int(end - begin), recording.names[marker],
                         point, float(confidence[begin:end, marker].mean())))
    return sorted(rows, key=lambda row: (row[5], -row[2]))


def _least_sure(confidence: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Frames, those with the least sure labels first."""
    return np.argsort(np.where(columns >= 0, confidence, 1.0).min(axis=1), kind="stable")


def chart_labels(columns: np.ndarray, confidence: np.ndarray, tracks: np.ndarray, unlabelled: np.ndarray,
                 labels: Sequence[str], rate: float) -> Any:
    """A matplotlib figure: every marker over time, by track and confidence, and how many points have no label."""
    from matplotlib import colormaps

    T, L = columns.shape
    number = np.where(columns >= 0, np.take_along_axis(tracks, np.maximum(columns, 0), axis=1), -1)
    steps = np.array_split(np.arange(T), min(T, STEPS))
    # of the frames that fall together the least sure one is shown
    least = np.where(columns >= 0, confidence, 2.0)
    image = np.full((L, len(steps), 3), GAP)
    palette = colormaps["tab20"](np.arange(20))[:, :3]
    for i, part in enumerate(steps):
        frame = part[least[part].argmin(axis=0)]
        for row in range(L):
            if number[frame[row], row] >= 0:
                color = palette[2 * (number[frame[row], row] % 10)]
                share = np.clip((confidence[frame[row], row] - 0.5) / 0.5, 0.0, 1.0)
                image[row, i] = color + (1 - share) * 0.7 * (1 - color)
    figure, axes = chart(7.5, 1.5 + 0.13 * L)
    axes.imshow(image, aspect="auto", interpolation="nearest", extent=(0, T / rate, L - 0.5, -0.5))
    axes.set_yticks(range(L), labels, fontsize=6)
    axes.tick_params(labelbottom=False)
    below = axes.inset_axes((0, -1.0 / (1.5 + 0.13 * L), 1, 0.8 / (1.5 + 0.13 * L)))
    counts = np.array([unlabelled[part].sum(axis=1).max() for part in steps])
    below.fill_between(np.array([part[0] for part in steps]) / rate, counts, step="post", color="#8c2f39", linewidth=0)
    below.set(xlim=(0, T / rate), ylim=(0, max(1, counts.max(initial=0))), xlabel="time (s)", ylabel="no label")
    below.yaxis.label.set_fontsize(7)
    below.tick_params(labelsize=7)
    return figure
