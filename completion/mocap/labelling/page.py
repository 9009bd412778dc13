"""Report page of a labelled recording: its doubtful labels."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scanprep.cli import MM
from scanprep.console import Metric
from scanprep.pictures.page import Page

from ...motion_pictures import frame_panes, frames_apart
from .label import SURE, LabelledMarkers
from .recording import LabelledRecording

SHOWN = 30                           # most stretches in the list


def label_page(recording: LabelledRecording, metrics: Sequence[Metric], table: str, again: str) -> Page:
    """Make the page; `table` is the name of the table of labels, `again` says how to run with corrections."""
    several = len(recording.people) > 1
    page = Page(f"{recording.path.name}, labelled", "Which point is which marker, and how sure that is.")
    page.section("Where it is unsure", f"To correct: open `{table}`, find the track, change its label (empty: no "
                 f"marker), write `yes` into the column fixed, and {again}. Frames are counted from 0.")
    rows = unsure_stretches(recording)
    if rows:
        page.table(rows[:SHOWN], ("frames", "time (s)", "track", "label", "off (mm)", "next marker", "from it (mm)",
                                  "confidence"))
        if len(rows) > SHOWN:
            page.text(f"And {len(rows) - SHOWN} more; the table of labels has all, the least certain first.")
    else:
        page.text(f"Nowhere: all labels have a confidence of at least {SURE:g}.")
    for k, one in enumerate(recording.people, start=1):
        # three frames with the least confident labels, 0.3 seconds apart
        least = np.where(one.columns >= 0, one.confidence, 1.0).min(axis=1)
        worst = frames_apart(np.argsort(least, kind="stable"), 3, 0.3 * one.motion.rate)
        page.bodies(frame_panes(one.motion, one.subject, one.markers.positions, worst),
                    (f"person {k}: " if several else "") + "the body with its labelled points, in the frames that are "
                    "least sure", 320)
    return page.section("Figures").figures(metrics)


@dataclass(frozen=True)
class _Stretch:
    """Frames from `begin` to before `end` in which the label of a marker is doubtful, most in `frame`."""

    marker: int
    begin: int
    end: int
    frame: int
    confidence: float                    # mean


def unsure_stretches(recording: LabelledRecording) -> list[tuple[str, str, str, str, float, str, float, float]]:
    """Return the rows of the table of stretches with a doubtful label, the least confident first.

    Columns are frames, seconds, track, label, distance of the point from the simulated marker, the nearest other
    marker, its distance, and the mean confidence. Distances are those of the least confident frame.
    """
    rows, first = list[tuple[str, str, str, str, float, str, float, float]](), 0
    for one in recording.people:
        found, names = _unsure(one), recording.names[first:first + len(one.layout.labels)]
        bodies = one.motion.vertices(one.subject, np.array([each.frame for each in found[:SHOWN]], dtype=int))
        for i, each in enumerate(found):
            columns = one.columns[each.begin:each.end, each.marker]
            tracks = list(dict.fromkeys(one.tracks[np.arange(each.begin, each.end), columns].tolist()))
            # distances from all simulated markers, for the stretches in the list
            off, other = np.full(len(names), np.nan), each.marker
            if i < SHOWN:
                places = one.layout.place(one.subject.template.with_vertices(bodies[i]))
                point = recording.points.positions[each.frame, one.columns[each.frame, each.marker]]
                off = MM * np.linalg.norm(places - point, axis=1)
                other = int(np.where(np.arange(len(off)) == each.marker, np.inf, off).argmin())
            last = f"–{each.end - 1}" if each.end - 1 > each.begin else ""
            rows.append((f"{each.begin}{last}", f"{each.begin / one.motion.rate:.2f}",
                         f"{tracks[0]}" + (f" and {len(tracks) - 1} more" if len(tracks) > 1 else ""),
                         names[each.marker], float(off[each.marker]), names[other], float(off[other]),
                         each.confidence))
        first += len(names)
    return sorted(rows, key=lambda row: row[-1])


def _unsure(one: LabelledMarkers) -> list[_Stretch]:
    """Return the doubtful stretches of a person, the least confident first."""
    doubted, found = (one.columns >= 0) & (one.confidence < SURE), list[_Stretch]()
    for marker in np.flatnonzero(doubted.any(axis=0)).tolist():
        edges = np.flatnonzero(np.diff(np.r_[False, doubted[:, marker], False].astype(int))).reshape(-1, 2)
        for begin, end in edges.tolist():
            sure = one.confidence[begin:end, marker]
            found.append(_Stretch(marker, begin, end, begin + int(sure.argmin()), float(sure.mean())))
    return sorted(found, key=lambda each: (each.confidence, each.begin - each.end))
