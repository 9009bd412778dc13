"""The page of `scape animate`."""
from __future__ import annotations

from typing import Any

import numpy as np

from model.linear import Subject
from scanprep.pictures.page import Page

from ...motion import Motion
from ...motion_pictures import animated_picture, chart_residuals, chart_states, picture_frames, worst_frames
from ..files.markers import MarkerSequence


def motion_page(motion: Motion, subject: Subject, markers: MarkerSequence, name: str,
                rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape animate`."""
    page = Page(f"{name}, animated", "The body in some frames, with the markers that were measured as dots.")
    page.picture(picture_frames(motion, subject, markers.positions), "from the front and the person's left")
    page.picture(picture_frames(motion, subject, markers.positions, turn=215.0), "the same frames from behind")
    page.picture(animated_picture(motion, subject, 10.0, 4.0), "first seconds")
    page.section("Markers").chart(chart_residuals(motion), "distance of the markers to where the body puts them")
    page.picture(picture_frames(motion, subject, markers.positions, worst_frames(motion, 8)),
                 "where the markers are farthest off")
    used = np.isfinite(motion.residuals).any(axis=0)
    labels = [label for label, is_used in zip(motion.labels, used, strict=True) if is_used]
    missing = ~np.isfinite(motion.residuals[:, used])
    state = np.where(missing, 2, np.where(motion.trusted[:, used], 0, 1))
    page.chart(chart_states(state, labels, motion.rate, ("#dfe7ee", "#e39b3b", "#8c2f39")),
               "light: seen; orange: seen, but not believed; red: missing")
    page.table(_marker_rows(motion, used), ("marker", "mean distance (mm)", "95th percentile (mm)", "seen (%)",
                                            "believed (%)"))
    unused = [label for label in motion.labels if label not in labels]
    if unused:
        page.text(f"Not used, because the layout does not know them or they were never seen: {', '.join(unused)}.")
    return page.section("Figures").table(rows, ("metric", "value", "unit"))


def _marker_rows(motion: Motion, used: np.ndarray) -> list[tuple[str, float, float, float, float]]:
    """The markers, that with the largest mean distance first."""
    found = []
    for i in np.flatnonzero(used):
        seen = np.isfinite(motion.residuals[:, i])
        off = 1000 * motion.residuals[seen, i]
        found.append((motion.labels[i], float(off.mean()), float(np.percentile(off, 95)), 100 * float(seen.mean()),
                      100 * float(motion.trusted[seen, i].mean())))
    return sorted(found, key=lambda row: -row[1])
