"""Marker sequences and their files: C3D, TRC, CSV and TSV."""
from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.format_common import FARTHEST, UNITS, UNKNOWN, guess_unit, metres_of, unit_named
from scanprep.words import number_of

from .c3d import read_c3d, write_c3d
from .exports import OTHERS, read_marker_table
from .text import MarkerFileError, RawMarkers, encode_csv, encode_trc, read_trc

READERS = {".c3d": read_c3d, ".trc": read_trc, ".csv": read_marker_table, ".tsv": read_marker_table}
WRITTEN = (".c3d", ".trc", ".csv")
__all__ = ["MarkerFileError", "MarkerSequence", "read_markers", "write_markers"]


@dataclass(frozen=True, eq=False)
class MarkerSequence:
    """Positions of labelled markers over time.

    Parameters
    ----------
    positions : (T, L, 3) float, metres
        NaN where a marker was not seen.
    labels : sequence of L strings
        All different.
    rate : float, frames per second
        Above 0.

    Raises
    ------
    ValueError
        Shapes that do not agree, a label that comes twice, a rate that is not positive, an infinite position.

    Examples
    --------
    >>> MarkerSequence(np.zeros((50, 2, 3)), ("C7", "T10"), 100.0)
    MarkerSequence(50 frames of 2 markers at 100 Hz, 0% missing)

    [MoSh]
    """

    positions: np.ndarray
    labels: tuple[str, ...]
    rate: float

    def __post_init__(self) -> None:
        positions = np.array(self.positions, dtype=np.float64)
        labels = tuple(self.labels)
        if positions.ndim != 3 or positions.shape[1:] != (len(labels), 3):
            raise ValueError(f"positions: expected shape (T, {len(labels)}, 3) for {len(labels)} labels, "
                             f"got {positions.shape}")
        # no label twice, a positive rate, no infinite position
        twice = [label for label, times in Counter(labels).items() if times > 1]
        if twice:
            raise ValueError(f"labels: expected each once, {', '.join(twice)} comes more often")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise ValueError(f"rate: expected a positive number of frames per second, got {self.rate}")
        if np.isinf(positions).any():
            raise ValueError("positions: expected finite numbers, or NaN for a marker that was not seen")
        # a marker with one missing coordinate is missing; stored arrays are read-only
        positions[np.isnan(positions).any(axis=2)] = np.nan
        positions.flags.writeable = False
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "labels", labels)
        object.__setattr__(self, "rate", float(self.rate))

    def __repr__(self) -> str:
        return (f"MarkerSequence({len(self.positions)} frames of {len(self.labels)} markers at {self.rate:g} Hz, "
                f"{100 * (1 - self.seen.mean()) if self.seen.size else 0:.2g}% missing)")

    @property
    def seen(self) -> np.ndarray:
        """Mask (T, L) of where a marker was seen."""
        return ~np.isnan(self.positions[..., 0])

    @property
    def times(self) -> np.ndarray:
        """Times (T,), seconds from the first frame."""
        return np.arange(len(self.positions)) / self.rate

    def select(self, labels: Sequence[str]) -> MarkerSequence:
        """Return the markers of some labels, in that order.

        Raises
        ------
        ValueError
            A label that is not there.
        """
        unknown = [label for label in labels if label not in self.labels]
        if unknown:
            raise ValueError(f"labels: {', '.join(unknown)} not among {', '.join(self.labels)}")
        columns = [self.labels.index(label) for label in labels]
        return MarkerSequence(self.positions[:, columns], tuple(labels), self.rate)

    def frames(self, which: slice) -> MarkerSequence:
        """Return a stretch of the sequence; a step in the slice lowers the rate."""
        step = which.step or 1
        if step < 1:
            raise ValueError(f"which: expected a slice that goes forward, got {which}")
        return MarkerSequence(self.positions[which], self.labels, self.rate / step)


def read_markers(path: str | Path, unit: str | None = None, subject_prefix: str | None = None,
                 rate: float | None = None, usual_rate: float | None = None) -> MarkerSequence:
    """Read a marker sequence from a file.

    Errors in a file and how they were resolved are reported as a UserWarning each: a wrong number of frames, a label
    that comes twice, a number that stands for a missing marker.

    Parameters
    ----------
    path : str or Path
        C3D; TRC; CSV as Motive exports it; TSV as Qualisys does; or CSV with the columns `time, LABEL_x, LABEL_y,
        LABEL_z, ...`, with empty cells where a marker is missing. Instead of `time`, in seconds, there may be `frame`;
        then `rate` is needed.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the file. Without it: the unit in the file, or millimetres; metres for CSV.
    subject_prefix : str, optional
        Whose markers to read, in a file with several people: labels there are `Subject:Label`. Several prefixes,
        `Head,Trunk`, are of one person.
    rate : float, frames per second, optional
        Needed where the file has none or a wrong one.
    usual_rate : float, frames per second, optional
        Assumed, with a warning, where the file has no rate; without it such a file is an error.

    Returns
    -------
    MarkerSequence
        Positions (T, L, 3) in metres, labels without `Subject:`.

    Raises
    ------
    MarkerFileError
        Missing, truncated or of another format; several people of whom none is named; no rate.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = mkdtemp() + "/two_people.csv"
    >>> write_markers(path, MarkerSequence(np.ones((9, 2, 3)), ("Ann:C7", "Bob:C7"), 100.0))
    >>> read_markers(path, subject_prefix="Ann")
    MarkerSequence(9 frames of 1 markers at 100 Hz, 0% missing)

    [MoSh]
    """
    path = Path(path)
    metres_of(unit)                      # an unknown unit is an error before the file is read
    raw = _read_raw(path)
    columns, labels = subject_columns(path, raw.labels, subject_prefix)
    # several prefixes that are parts of one person are taken together, with a warning
    people, notes = people_of(raw.labels), list(raw.notes)
    if subject_prefix is None and people and len(people[0]) > 1:
        most = Counter(label.rpartition(":")[0] for label in raw.labels if ":" in label).most_common(1)[0][0]
        notes.append(f"the labels of {', '.join(people[0])} are taken as those of one person; those of one only are "
                     f"taken with subject_prefix={most}")
    return _in_metres(path, raw, columns, labels, unit, rate, usual_rate, notes)


def read_marker_points(path: str | Path, unit: str | None = None, rate: float | None = None) -> MarkerSequence:
    """Read all points of a file, of all people, with labels as they are in the file, prefixes included.

    Parameters
    ----------
    path, unit, rate
        As of `read_markers`.

    Raises
    ------
    MarkerFileError
        Missing, truncated or of another format; no rate.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = mkdtemp() + "/two_people.csv"
    >>> write_markers(path, MarkerSequence(np.ones((9, 2, 3)), ("Ann:C7", "Bob:C7"), 100.0))
    >>> read_marker_points(path).labels
    ('Ann:C7', 'Bob:C7')
    """
    path = Path(path)
    metres_of(unit)
    raw = _read_raw(path)
    return _in_metres(path, raw, range(len(raw.labels)), raw.labels, unit, rate, None, list(raw.notes))


def resolve_marker_unit(places: Iterable[Path], unit: str | None) -> str | None:
    """Return a unit as it is, and for "unknown" that in which the first recording's markers are as far apart as a body.

    Parameters
    ----------
    places : iterable of Path
        Recordings, or folders of them.
    unit : str, optional
        As of `read_markers`, or "unknown".

    Raises
    ------
    MarkerFileError
        Markers that are as far apart as on a person in no unit.
    """
    if unit != UNKNOWN:
        return unit
    files = (path for place in places for path in ([place] if place.is_file() else sorted(place.rglob("*")))
             if path.suffix.lower() in READERS)
    path = next(files, None)
    if path is None:
        raise MarkerFileError(f"{', '.join(map(str, places))}: expected recordings of markers, found none")
    raw = _read_raw(path)
    # of several people the one with most markers; the median over frames, as a ghost stretches the box of its frame
    whose = Counter(label.rpartition(":")[0] for label in raw.labels).most_common(1)[0][0]
    columns = [i for i, label in enumerate(raw.labels) if label.rpartition(":")[0] == whose]
    places_seen = np.where((raw.positions == 0).all(axis=2, keepdims=True), np.nan, raw.positions)[:, columns]
    frames = [frame[known] for frame in places_seen[::max(1, len(places_seen) // 200)]
              if (known := np.isfinite(frame).all(axis=1)).any()]
    span = float(np.median([np.ptp(frame, axis=0).max() for frame in frames])) if frames else 0.0
    likely = "m" if 0.8 <= span <= 2.3 else guess_unit(span)          # from somebody who crouches to stretched arms
    if likely is None:
        raise MarkerFileError(f"{path}: its markers span {span:.3g}, which is a person's size in no unit of "
                              f"{', '.join(UNITS)}; say unit=")
    warnings.warn(f"{path}: read with unit='{likely}', in which the markers span {span * UNITS[likely]:.2f} m",
                  stacklevel=2)
    return likely


def _in_metres(path: Path, raw: RawMarkers, columns: Sequence[int], labels: tuple[str, ...], unit: str | None,
               rate: float | None, usual_rate: float | None, notes: list[str]) -> MarkerSequence:
    """Convert some columns of a file to a sequence in metres; errors of the file are reported as warnings."""
    own_unit = unit or unit_named(raw.unit)
    if own_unit is None:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(UNITS)}, found '{raw.unit}'; say unit=")
    if rate is None and raw.rate is None:
        if usual_rate is None:
            raise MarkerFileError(f"{path}: expected the frames per second, it does not say them; say rate=")
        notes.append(f"it does not say its frames per second, {usual_rate:g} are assumed")
    # missing: 0 0 0, or one number three times, such as 9999999, that lies beyond all positions
    places = raw.positions[:, columns]
    places = np.where((places == 0).all(axis=2, keepdims=True), np.nan, places)
    same = (places == places[..., :1]).all(axis=2)
    largest = np.abs(places[~same & np.isfinite(places).all(axis=2)])
    fill = same & (np.abs(places[..., 0]) > largest.max(initial=0)) & bool(largest.size)
    if fill.any():
        values = ", ".join(f"{value:.9g}" for value in np.unique(places[fill, 0])[:3])
        notes.append(f"{number_of(int(fill.sum()), 'position')} of {values} three times taken as missing")
        places = np.where(fill[..., None], np.nan, places)
    # one warning for each note, then metres
    for note in notes:
        warnings.warn(f"{path}: {note}", stacklevel=3)
    positions = UNITS[own_unit] * places
    if (np.abs(positions) > FARTHEST).any():
        raise MarkerFileError(f"{path}: expected positions that are finite and below {FARTHEST:g} m, found "
                              f"{np.nanmax(np.abs(positions)):.3g}")
    try:
        return MarkerSequence(positions, labels, rate or raw.rate or usual_rate or 0.0)
    except ValueError as error:
        raise MarkerFileError(f"{path}: {error}") from None


def marker_subjects(path: str | Path) -> tuple[str, ...]:
    """Return the people in a file, by the prefixes of its labels, before the colon.

    It is empty without a colon, and where several prefixes are parts of one person, see `people_of`. Beside several
    people, a prefix with fewer than eight labels that nobody else has is a prop: it is left out, with a warning.
    """
    labels = _read_raw(Path(path)).labels
    people = tuple(prefixes[0] for prefixes in people_of(labels) if len(prefixes) == 1)
    if len(people) < 2:
        return people
    # labels of each prefix; a prop has few, and none in common with a person
    bare = {who: {label.rpartition(":")[2] for label in labels if label.rpartition(":")[0] == who} for who in people}
    times = Counter(label for own in bare.values() for label in own)
    props = [who for who, own in bare.items() if len(own) < 8 and all(times[label] == 1 for label in own)]
    if props:
        warnings.warn(f"{path}: {', '.join(props)} taken for props beside people and left out; taken all the same with "
                      f"subject_prefix={props[0]}", stacklevel=2)
    return tuple(who for who in people if who not in props)


def label_prefixes(path: str | Path) -> set[str]:
    """Return the prefixes of a file's labels, before the colon; empty for a file that cannot be read."""
    try:
        labels = _read_raw(Path(path)).labels
    except MarkerFileError:
        return set()
    return {label.rpartition(":")[0] for label in labels if ":" in label}


def people_of(labels: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Group the prefixes of labels, `Subject:Label`, by person.

    Where no bare label comes twice, all prefixes belong to one person: clusters, rigid bodies or a prop. Where some
    label comes twice, each prefix is a person.

    Examples
    --------
    >>> people_of(["Head:LFHD", "Trunk:C7"]), people_of(["Ann:C7", "Bob:C7"])
    ((('Head', 'Trunk'),), (('Ann',), ('Bob',)))
    """
    split = [label.rpartition(":") for label in labels]
    prefixes = tuple(dict.fromkeys(who for who, colon, _ in split if colon))
    bare = [label for _, colon, label in split if colon]
    if len(set(bare)) == len(bare):
        return (prefixes,) if prefixes else ()
    return tuple((who,) for who in prefixes)


def _read_raw(path: Path) -> RawMarkers:
    """Read the content of a file, by its ending."""
    suffix = path.suffix.lower()
    data = storage.read_bytes(path, "a file of markers", MarkerFileError)
    if suffix not in READERS:
        raise MarkerFileError(f"{path}: expected a name ending in {', '.join(READERS)}, found "
                              + (f"'{path.suffix}'" if suffix not in OTHERS else OTHERS[suffix]))
    if not data:
        raise MarkerFileError(f"{path}: the file is empty")
    return READERS[suffix](path, data)


def subject_columns(path: Path, labels: Sequence[str], subject_prefix: str | None
                    ) -> tuple[list[int], tuple[str, ...]]:
    """Return columns and bare labels of the only person, or of the named prefixes, separated by commas."""
    split = [label.rpartition(":") for label in labels]
    people = people_of(labels)
    known = {who for prefixes in people for who in prefixes}
    if subject_prefix is None and len(people) > 1:
        raise MarkerFileError(f"{path}: expected one subject, found {', '.join(who for who, in people)}; say "
                              f"subject_prefix={people[0][0]}")
    # without a prefix all labels; a prefix may itself contain a comma
    wanted = known | {""} if subject_prefix is None else \
        {subject_prefix} if subject_prefix in known else set(subject_prefix.split(","))
    missing = wanted - known - {""}
    if missing:
        raise MarkerFileError(f"{path}: expected the subject '{', '.join(sorted(missing))}', found "
                              f"{', '.join(sorted(known)) or 'none'}")
    columns = [i for i, (who, _, _) in enumerate(split) if who in wanted]
    return columns, tuple(split[i][2] for i in columns)


def write_markers(path: str | Path, sequence: MarkerSequence) -> None:
    """Write a sequence to a file, which appears whole or not at all.

    Parameters
    ----------
    path : str or Path
        `.csv` in metres; `.trc` or, in single precision, `.c3d` in millimetres.
    sequence : MarkerSequence
        Positions (T, L, 3) in metres.

    Raises
    ------
    MarkerFileError
        A name with another ending.

    Examples
    --------
    >>> from tempfile import mkdtemp
    >>> path = mkdtemp() + "/still.trc"
    >>> write_markers(path, MarkerSequence(np.ones((9, 2, 3)), ("C7", "T10"), 100.0))
    >>> read_markers(path).labels
    ('C7', 'T10')

    [MoSh]
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WRITTEN:
        raise MarkerFileError(f"{path}: expected a name ending in {', '.join(WRITTEN)}, found '{path.suffix}'")
    content = sequence.positions, sequence.labels, sequence.rate
    with storage.writing(path) as beside:
        if suffix == ".c3d":
            write_c3d(beside, *content)
        else:
            beside.write_bytes(encode_csv(*content) if suffix == ".csv" else encode_trc(*content, path.name))
