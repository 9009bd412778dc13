"""Witnesses: markers that were seen but not used. Where they lie off the body, the pose there may be wrong."""
from __future__ import annotations

from collections.abc import Collection

import numpy as np

from model.linear import Subject
from scanprep.geometry.farthest_points import spread_indices
from scanprep.geometry.surface import Surface

from ...motion import Motion
from ..files.markers import MarkerSequence
from .coverage import marker_labels

FRAMES = 12                          # frames in which distances are measured
FAR, SEVERAL = 0.08, 3               # metres, beyond soft tissue and wands; so many markers that far off are a doubt


def ask_witnesses(motion: Motion, subject: Subject, markers: MarkerSequence, used: Collection[str]) -> dict[str, float]:
    """Compute how far unused markers are from the skin, metres, the median over some frames, the farthest first.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> body = load_built_in_model().subject()
    >>> still = Motion(np.zeros((2, 16, 3)), np.zeros((2, 3)), None, 9.0, np.zeros((2, 0)))
    >>> nose = MarkerSequence(np.tile(body.vertices(np.zeros((16, 3)))[:1], (2, 1, 1)), ("nose",), 9.0)
    >>> {label: round(off, 3) for label, off in ask_witnesses(still, body, nose, ()).items()}
    {'nose': 0.0}
    """
    asked = [i for i, label in enumerate(markers.labels) if label in marker_labels(markers.labels) - set(used)]
    frames = spread_indices(len(motion.poses), FRAMES)
    off = np.full((len(frames), len(asked)), np.nan)
    for row, frame, vertices in zip(off, frames, motion.vertices(subject, frames), strict=True):
        points = markers.positions[frame, asked]
        seen = np.isfinite(points[:, 0])
        if seen.any():
            row[seen] = Surface(subject.template.with_vertices(vertices)).closest(points[seen]).distances
    often = np.isfinite(off).sum(axis=0) >= 0.5 * len(frames)
    medians = {markers.labels[asked[k]]: float(np.nanmedian(off[:, k])) for k in np.flatnonzero(often)}
    return dict(sorted(medians.items(), key=lambda item: -item[1]))


def witness_doubts(witnesses: dict[str, float]) -> tuple[str, ...]:
    """Return the doubt of unused markers that lie far off the body, if there are several."""
    far = [f"{label} {1000 * off:.0f} mm" for label, off in witnesses.items() if off > FAR]
    return (f"{len(far)} markers that were not used lie off the body ({', '.join(far[:3])}): look at the limbs there",
            ) if len(far) >= SEVERAL else ()
