"""Coverage: how many markers of a recording were used, and which parts of the body they determine."""
from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from model.linear import Subject
from scanprep.console import Metric
from scanprep.judgement import Judgement
from scanprep.skeleton.roles import above
from scanprep.skeleton.tree import Skeleton

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.keypoints import USE, find_keypoints, measure_hips
from ..marker_sets.layout import MarkerLayout

# points that Plug-in Gait computes: centres of mass, and for every segment its origin and the ends of three axes
COMPUTED, AXES = r"CentreOfMass(Floor)?", "OALP"             # PELO, PELA, PELL, PELP of the pelvis


@dataclass(frozen=True, eq=False)
class Coverage:
    """The markers that were used for a body, and the parts of the body that they determine.

    Attributes
    ----------
    used : tuple of str
        Markers that were used.
    count : int
        Markers of the recordings: their `marker_labels`, without those that are hardly ever seen.
    told : (J,) bool
        Parts that carry a marker or lie between two that do; the poses of the others are guesses.
    parts : tuple of str
        Names of the parts that carry a marker.
    unseen : tuple of str
        Names of the parts whose poses are guesses.
    skin : float
        Share of the skin on the unseen parts.
    keypoints : tuple of str
        Labels that tell that the points are joint centres of a video; none where they are markers on skin.
    """

    used: tuple[str, ...]
    count: int
    told: np.ndarray
    parts: tuple[str, ...]
    unseen: tuple[str, ...]
    skin: float
    keypoints: tuple[str, ...] = ()

    def metrics(self) -> list[Metric]:
        """Return the rows of the table: markers used, and parts without markers."""
        rows = [Metric("markers used", f"{len(self.used)} of {self.count}")]
        return rows + ([Metric("seen by no marker, their angles are left out", ", ".join(self.unseen))]
                       if self.unseen else [])

    def judgement(self) -> Judgement:
        """Judge whether the markers determine a body."""
        failed, check = [], [f"{', '.join(self.keypoints)}: {USE}"] if self.keypoints else []
        used = f"{len(self.used)} of {self.count} markers used"
        fewest = 8  # least markers for a body; six determine a pelvis and a head, but no limb
        if len(self.used) < fewest:
            failed.append(f"{used}, a body needs {fewest}: other labels than the marker set's? (scape layout show)")
        elif len(self.parts) < 2:
            failed.append(f"all markers used are on one part of the body, the {self.parts[0]}")
        elif len(self.used) < 0.5 * self.count and not self.keypoints:
            check.append(f"{used}: other labels than the marker set's? (scape layout show)")
        # 0.25 of the skin: both hands have 5%, a head 7%, all above the waist 60%
        if self.skin > 0.25:
            check.append(f"no marker saw {', '.join(self.unseen)}: a guess, and their angles are left out")
        return Judgement.of(failed, check)


def find_coverage(subject: Subject, layout: MarkerLayout, motions: Sequence[Motion],
                  markers: Sequence[MarkerSequence]) -> Coverage:
    """Find which parts of a body the markers of some recordings determine.

    Distrusted markers count as used, but determine no part.

    Parameters
    ----------
    subject : Subject
        The body.
    layout : MarkerLayout
        Where on the body the markers sit.
    motions : sequence of Motion
        One for each recording.
    markers : sequence of MarkerSequence
        The recordings.
    """
    skeleton, body = subject.skeleton, subject.template
    used = {label for motion in motions for label, column in zip(motion.labels, motion.residuals.T, strict=True)
            if np.isfinite(column).any()}
    # a trajectory counts as a marker when it is seen in a tenth of the frames
    lasting = {label for one in markers for label, share in zip(one.labels, one.seen.mean(axis=0), strict=True)
               if share >= 0.1 and label in marker_labels(one.labels)}
    keypoints = find_keypoints([label for one in markers for label in one.labels], used, measure_hips(markers))
    doubted = {label for motion in motions for label in motion.distrusted}
    # parts with a trusted marker, and those between two of them
    known = {layout.aliases.get(label, label) for label in used - doubted}
    part_of_marker = skeleton.part_of_vertex(body)[layout.nearest]
    seen = np.unique(part_of_marker[np.isin(layout.labels, sorted(known))])
    told = between(skeleton, seen)
    area = np.bincount(skeleton.part_of_face, body.face_areas, minlength=len(told))
    names = np.array(skeleton.names)
    return Coverage(tuple(sorted(used)), len(lasting | used), told, tuple(names[seen].tolist()),
                    tuple(names[~told].tolist()), float(area[~told].sum() / area.sum()), keypoints)


def marker_labels(labels: Iterable[str]) -> set[str]:
    """Return the labels of markers, without unnamed trajectories and points that Plug-in Gait computed.

    Examples
    --------
    >>> sorted(marker_labels(["C7", "*12", "PELO", "PELA", "PELL", "PELP", "LTHP", "CentreOfMass"]))
    ['C7', 'LTHP']
    """
    every = set(labels)
    segments = {label[:-1] for label in every if all(label[:-1] + axis in every for axis in AXES)}
    axes = {stem + axis for stem in segments for axis in AXES}
    # unnamed trajectories as Vicon, Motive and Qualisys write them
    unnamed = r"\*\d+|U_?\d+|Unlabell?ed.*|Unidentified.*"
    return {label for label in every - axes if not re.fullmatch(f"{unnamed}|{COMPUTED}", label.rpartition(":")[2])}


def between(skeleton: Skeleton, seen: np.ndarray) -> np.ndarray:
    """Return a mask (J,) of some parts (n,) and all parts between them in the tree."""
    found, ways = np.zeros(len(skeleton.parents), dtype=bool), [above(skeleton.parents, part) for part in seen.tolist()]
    if not ways:
        return found
    # from every part up to the first ancestor that all have in common
    top = next(part for part in ways[0] if all(part in way for way in ways))
    for way in ways:
        found[way[:way.index(top) + 1]] = True
    return found
