"""Label a recording, and write it again with everything else that was in it."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.linear import Subject
from scanprep.console import Metric, details, judgement_row
from scanprep.geometry import storage
from scanprep.judgement import Judgement

from ...motion import Progress
from ..files.c3d_points import rename_points
from ..files.markers import MarkerSequence, people_of, write_markers
from ..marker_sets.layout import MarkerLayout
from .corrections import read_corrections, write_labels
from .label import SURE, UNKNOWN, LabelledMarkers, label_people
from .tracks import link_points

LABELLED_SHARE, DOUBTFUL = "points with a label", "labels that are doubtful"
NAMELESS = "*"                       # first letter of the labels of points that are no marker


@dataclass(frozen=True, eq=False)
class LabelledRecording:
    """A recording with the labels of one person or several.

    Attributes
    ----------
    path : Path
        Of the recording.
    points : MarkerSequence
        Its original points.
    people : list of LabelledMarkers
    names : strings
        Labels of all people, `Person1:LKNE` where there are several, or as the recording calls them, if it has labels
        of as many.
    known : (T, C) int
        Known labels, from the file or a table of corrections.
    """

    path: Path
    points: MarkerSequence
    people: list[LabelledMarkers]
    names: tuple[str, ...]
    known: np.ndarray

    @property
    def columns(self) -> np.ndarray:
        """Column (T, L) of each marker of all people, -1 without one."""
        return np.concatenate([one.columns for one in self.people], axis=1)

    @property
    def confidence(self) -> np.ndarray:
        """Confidence (T, L) of each label."""
        return np.concatenate([one.confidence for one in self.people], axis=1)

    @property
    def judgement(self) -> Judgement:
        """Judgement of the labels of all people."""
        if len(self.people) == 1:
            return self.people[0].judgement
        return Judgement().merge(*(Judgement.of([f"person {k}: {why}" for why in one.judgement.problems],
                                                [f"person {k}: {why}" for why in one.judgement.doubts])
                                   for k, one in enumerate(self.people, start=1)))

    def write(self, output: Path) -> None:
        """Write the labelled recording: markers first, then other points, packed as `*1`, `*2`, ...

        From C3D to C3D, analog channels, events, parameters and points without positions stay.
        """
        loose = pack_tracks(self.people[0].tracks, self.people[0].unlabelled)
        source = np.concatenate([self.columns, loose], axis=1)
        labels = (*self.names, *(f"{NAMELESS}{i}" for i in range(1, loose.shape[1] + 1)))
        if output.suffix.lower() == self.path.suffix.lower() == ".c3d":
            data = self.path.read_bytes()
            with storage.writing(output) as beside:
                beside.write_bytes(rename_points(self.path, data, labels, source))
            return
        taken = np.take_along_axis(self.points.positions, np.maximum(source, 0)[..., None], axis=1)
        taken[source < 0] = np.nan
        write_markers(output, MarkerSequence(taken, labels, self.points.rate))

    def write_table(self, path: Path) -> None:
        """Write the table of labels, for corrections."""
        rows, sure = np.full(self.known.shape, -1), np.zeros(self.known.shape)
        frames, markers = np.nonzero(self.columns >= 0)
        columns = self.columns[frames, markers]
        rows[frames, columns], sure[frames, columns] = markers, self.confidence[frames, markers]
        write_labels(path, self.points.labels, self.people[0].tracks, rows, self.names, sure, self.known != UNKNOWN)

    def metrics(self) -> list[Metric]:
        """Return the figures of the closing table."""
        there = self.columns >= 0
        points, sure = int(self.points.seen.sum()), self.confidence[there]
        missing = [self.names[i] for i in np.flatnonzero(~there.any(axis=0))]
        tracks = self.people[0].tracks
        return [judgement_row(self.judgement), Metric(LABELLED_SHARE, 100 * there.sum() / max(points, 1), "%"),
                Metric(DOUBTFUL, 100 * float((sure < SURE).mean()) if len(sure) else 100.0, "%"),
                Metric("markers found in a frame, mean", float(there.sum(axis=1).mean())),
                *([Metric("markers of the layout without any point", ", ".join(missing))] if missing else []),
                *details([Metric("people", len(self.people)), Metric("frames", len(there)),
                          Metric("points", points), Metric("tracks", int(tracks.max() + 1)),
                          Metric("labels that were known", int((self.known >= 0).sum()))])]


def label_recording(path: Path, points: MarkerSequence, model: BodyModel | Subject, layout: MarkerLayout,
                    people: int = 1, corrections: Path | None = None, relabel: bool = False,
                    progress: Progress | None = None) -> LabelledRecording:
    """Label the points of a recording, as `read_marker_points` gives them.

    Labels of the recording that are in the layout count as known, unless `relabel`. Those of the table `corrections`
    have priority. Other arguments are those of `label_people`.
    """
    # names of the markers, with a prefix for each of several people
    who = people_of(points.labels)
    prefixes = [f"{prefix[0]}:" for prefix in who] if people > 1 and len(who) == people else \
        [f"Person{k}:" for k in range(1, people + 1)] if people > 1 else [""]
    names = tuple(prefix + label for prefix in prefixes for label in layout.labels)
    known = np.full(points.positions.shape[:2], UNKNOWN)
    if not relabel:
        known = columns_of_labels(points, layout, prefixes)
    if corrections is not None:
        said = read_corrections(corrections, link_points(points.positions, points.rate), names)
        for row in np.unique(said[said >= 0]):                         # the file's label is dropped in these frames
            known[(known == row) & (said == row).any(axis=1, keepdims=True)] = UNKNOWN
        known = np.where(said == UNKNOWN, known, said)
    try:
        found = label_people([(model, layout)] * people, points, known, progress)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return LabelledRecording(path, points, found, names, known)


def columns_of_labels(points: MarkerSequence, layout: MarkerLayout, prefixes: Sequence[str] = ("",)) -> np.ndarray:
    """Return known labels (T, C), as rows of the layout, from the labels of a recording; others are `UNKNOWN`.

    Rows are numbered through all people; `prefixes` are those of their labels, with the colon. For one person the only
    prefix of the recording, or none, will do.
    """
    spelled = layout.with_spellings([label.rpartition(":")[2] for label in points.labels])
    rows = {label: i for i, label in enumerate(layout.labels)}
    rows |= {alias: rows[label] for alias, label in spelled.aliases.items() if label in rows}
    only = len(prefixes) == 1 and len(people_of(points.labels)) < 2     # one person, under any prefix
    known, taken = np.full(points.positions.shape[:2], UNKNOWN), set[int]()
    for column, label in enumerate(points.labels):
        who, colon, bare = label.rpartition(":")
        if bare not in rows or not (only or who + colon in prefixes):
            continue
        row = rows[bare] + (0 if only else list(prefixes).index(who + colon) * len(layout.labels))
        if row not in taken:                                            # the first of two spellings
            taken.add(row)
            known[points.seen[:, column], column] = row
    return known


def drop_unnamed(markers: MarkerSequence) -> MarkerSequence:
    """Return the markers of a labelled recording, without other points."""
    return markers.select([label for label in markers.labels if not label.startswith(NAMELESS)])


def pack_tracks(tracks: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Pack wanted points (T, C) into few columns (T, n), one track after the other.

    Examples
    --------
    >>> pack_tracks(np.array([[0, -1], [0, 1], [-1, 1]]), np.array([[True, False], [False, True], [False, True]]))
    array([[0],
           [1],
           [1]])
    """
    frames, columns = np.nonzero(wanted)
    number = tracks[frames, columns]
    order = np.lexsort((frames, number))
    # pieces of tracks, in order of time, each into the first series that is free
    pieces = np.split(order, np.flatnonzero(np.diff(number[order])) + 1) if len(order) else []
    ends, series = list[int](), list[np.ndarray]()
    for piece in sorted(pieces, key=lambda each: int(frames[each[0]])):
        begin = int(frames[piece[0]])
        free = next((i for i, end in enumerate(ends) if end < begin), len(ends))
        if free == len(ends):
            ends.append(-1)
            series.append(np.full(len(tracks), -1))
        ends[free] = int(frames[piece[-1]])
        series[free][frames[piece]] = columns[piece]
    return np.stack(series, axis=1) if series else np.empty((len(tracks), 0), dtype=int)
