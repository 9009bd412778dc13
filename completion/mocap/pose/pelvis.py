"""The pelvis from its bony landmarks: the skin of a body goes with thighs that swing, but ASIS and PSIS do not."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.linear import Subject
from scanprep.geometry import rotations

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from .marked_body import MarkedBody

LANDMARKS = "LASI", "RASI", "LPSI", "RPSI", "SACR"           # SACR is worn midway between both PSIS, instead of them


def find_worn(layout: MarkerLayout, landmarks: Sequence[str]) -> dict[str, str]:
    """Find the labels of a layout for landmarks by their names in Plug-in Gait, {landmark: label}.

    Examples
    --------
    >>> find_worn(MarkerLayout(("LASIS", "C7"), [4, 9]), LANDMARKS)
    {'LASI': 'LASIS'}
    """
    return {landmark: label for landmark in landmarks for label in (landmark, f"{landmark}S")
            if label in layout.labels or label in layout.aliases}


def follow_pelvis(motion: Motion, subject: Subject, layout: MarkerLayout, measured: MarkerSequence
                  ) -> np.ndarray | None:
    """Compute how the pelvis is turned against the resting body, from measured ASIS and PSIS, or SACR.

    Three that were seen are enough. Where fewer were, the body fills in, with the offset of the frames around.

    Parameters
    ----------
    motion : Motion
        Of T frames, found from the markers.
    subject : Subject
        The person.
    layout : MarkerLayout
        Where the markers sit on this person.
    measured : MarkerSequence
        The markers (T, L, 3), metres, with the labels of `motion`.

    Returns
    -------
    (T, 3, 3) float, or None without both ASIS and a landmark behind them

    Wu et al. 2002
    """
    columns, known = layout.match_columns(motion.labels, 0)
    # labels of the motion by landmark
    worn = {layout.aliases.get(label, label): landmark for landmark, label in find_worn(layout, LANDMARKS).items()}
    label_of = {worn.get(layout.aliases.get(label, label)): label for label in known.labels}
    trusted = {label: motion.trusted[:, column] & measured.seen[:, measured.labels.index(label)]
               for label, column in zip(known.labels, columns, strict=True) if label not in motion.distrusted}
    seen = {landmark: label_of[landmark] for landmark in LANDMARKS
            if label_of.get(landmark) in trusted and trusted[label_of[landmark]].any()}
    if not ({"LASI", "RASI"} <= seen.keys() and len(seen) > 2):
        return None
    landmarks = known.select([*seen.values()])
    body = MarkedBody(subject, landmarks, 0.0, 0.0)
    places = body.positions(body.body.join(motion.poses, motion.trans))
    there, frames = np.stack([trusted[label] for label in landmarks.labels], axis=1), np.arange(len(places))
    for i, label in enumerate(landmarks.labels):
        known_at = np.flatnonzero(there[:, i])
        off = measured.positions[known_at, measured.labels.index(label)] - places[known_at, i]
        places[:, i] += np.stack([np.interp(frames, known_at, column) for column in off.T], axis=1)
    rest = landmarks.place(subject.template.with_vertices(subject.vertices(np.zeros_like(motion.poses[0]))))
    turns = np.array(rotations.procrustes(rest, places)[0])
    for pattern in np.unique(there, axis=0):
        if 3 <= pattern.sum() < len(rest):
            rows = (there == pattern).all(axis=1)
            turns[rows] = rotations.procrustes(rest[pattern], places[rows][:, pattern])[0]
    return turns
