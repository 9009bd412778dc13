"""Coverage: how many markers of a recording were used, and which parts of the body they determine."""
from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from model.linear import Subject
from scanprep.console import Metric
from scanprep.judgement import Judgement
from scanprep.skeleton.tree import Skeleton

from ...motion import Motion
from ..files.markers import MarkerSequence
from ..marker_sets.keypoints import USE, find_keypoints, measure_hips
from ..marker_sets.layout import MarkerLayout

# points that Plug-in Gait computes: centres of mass, and for every segment its origin and the ends of three axes
COMPUTED, AXES = r"CentreOfMass(Floor)?", "OALP"             # PELO, PELA, PELL, PELP of the pelvis
BRIDGED = 0.2                        # seconds without markers over which the motion before and after tells of a part


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
        Parts that are told in some frame, as `find_told_parts` says; the poses of the others are guesses.
    parts : tuple of str
        Names of the parts that carry a marker.
    unseen : tuple of str
        Names of the parts whose poses are guesses.
    skin : float
        Share of the skin on the unseen parts.
    never : tuple of str
        Markers of the layout that the recordings name and never show.
    hidden : tuple of str
        Names of the parts that carry as many of these as of the others.
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
    never: tuple[str, ...] = ()
    hidden: tuple[str, ...] = ()

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
        # who wears another set beside a whole one has other labels too
        elif len(self.used) < 0.5 * self.count and self.unseen and not self.keypoints:
            check.append(f"{used}: other labels than the marker set's? (scape layout show)")
        # 0.25 of the markers: one of 42 in a right recording; half of them leave girths to guess, 11% of the volume
        every = len(self.never) + len(self.used)
        if len(self.never) > 0.25 * every:
            check.append(f"{len(self.never)} of {every} markers were never seen: the pose or the girth of "
                         f"{', '.join(self.hidden)} is a guess")
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
    # parts with a trusted marker, and those that follow from them
    known = {layout.aliases.get(label, label) for label in used - doubted}
    part_of_marker = skeleton.part_of_vertex(body)[layout.nearest]
    seen = np.unique(part_of_marker[np.isin(layout.labels, sorted(known))])
    # markers that the recordings name and never show, and the parts with as many of them as of others
    named = {layout.aliases.get(label, label) for one in markers for label in one.labels}
    never = np.isin(layout.labels, sorted(named - {layout.aliases.get(label, label) for label in used}))
    lost, kept = (np.bincount(part_of_marker[some], minlength=len(skeleton.parents)) for some in
                  (never, np.isin(layout.labels, sorted(known))))
    told = np.any([find_told_parts(subject, layout, motion).any(axis=0) for motion in motions], axis=0)
    area = np.bincount(skeleton.part_of_face, body.face_areas, minlength=len(told))
    names = np.array(skeleton.names)
    return Coverage(tuple(sorted(used)), len(lasting | used), told, tuple(names[seen].tolist()),
                    tuple(names[~told].tolist()), float(area[~told].sum() / area.sum()), keypoints,
                    tuple(np.array(layout.labels)[never].tolist()),
                    tuple(names[(lost > 0) & (lost >= kept)].tolist()))


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


def find_told_parts(subject: Subject, layout: MarkerLayout, motion: Motion) -> np.ndarray:
    """Find in which frames the markers determine which parts of a body, (T, J) bool.

    A part is told by a trusted marker of its own, over short gaps too, and where `between` says so. Distrusted markers
    determine nothing.
    """
    skeleton = subject.skeleton
    columns, known = layout.match_columns(motion.labels, 0)
    doubted = np.isin(np.array(motion.labels, dtype=object)[columns], motion.distrusted)
    trusted = motion.trusted[:, columns] & ~doubted
    part = skeleton.part_of_vertex(subject.template)[known.nearest]
    seen = np.stack([trusted[:, part == p].any(axis=1) for p in range(len(skeleton.parents))], axis=1)
    # frames in a gap that is short
    frames, T = np.arange(len(seen))[:, None], len(seen)
    before = np.maximum.accumulate(np.where(seen, frames, -T), axis=0)
    after = np.minimum.accumulate(np.where(seen, frames, 2 * T)[::-1], axis=0)[::-1]
    seen |= (after - before - 1) / motion.rate <= BRIDGED
    rows, row = np.unique(seen, axis=0, return_inverse=True)
    return np.stack([between(skeleton, one) for one in rows])[row.ravel()]


def between(skeleton: Skeleton, seen: np.ndarray) -> np.ndarray:
    """Add to some parts (J,) bool those with two neighbours among them, which determine what is between.

    Two links of a limb in a row, as thigh and shank without markers, are not: a knee may bend either way.
    """
    told, parents = seen.copy(), np.asarray(skeleton.parents)
    child = np.flatnonzero(parents >= 0)
    while True:
        count = np.bincount(child, told[parents[child]], len(told)) + np.bincount(parents[child], told[child],
                                                                                 len(told))
        more = told | (count >= 2)
        if (more == told).all():
            return told
        told = more


def untold_spans(skeleton: Skeleton, told: np.ndarray, rate: float) -> list[Metric]:
    """Return the row of parts that some frames of (T, J) bool do not tell, with their longest span, if there is one."""
    rows = []
    for name, column in zip(skeleton.names, told.T, strict=True):
        if column.any() and not column.all():
            edges = np.flatnonzero(np.diff(np.concatenate([[True], column, [True]]).astype(int)))
            begin, end = max(edges.reshape(-1, 2).tolist(), key=lambda span: span[1] - span[0])
            rows.append(f"{name} {(~column).sum() / rate:.1f} s, from {begin / rate:.2f} to {end / rate:.2f} s")
    return [Metric("not seen for a time, empty cells there", "; ".join(rows))] if rows else []
