"""Files of marker sequences: C3D, TRC, CSV and TSV."""
from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.format_common import FARTHEST, UNITS, metres_of, unit_named
from scanprep.words import number_of

from .c3d import read_c3d, write_c3d
from .exports import OTHERS, read_marker_table
from .text import MarkerFileError, RawMarkers, encode_csv, encode_trc, read_trc

READERS = {".c3d": read_c3d, ".trc": read_trc, ".csv": read_marker_table, ".tsv": read_marker_table}
WRITTEN = (".c3d", ".trc", ".csv")
__all__ = ["MarkerFileError", "MarkerSequence", "read_markers", "write_markers"]


@dataclass(frozen=True, eq=False)
class MarkerSequence:
    """Markers on their way through time.

    Parameters
    ----------
    positions : (T, L, 3) float, metres
        NaN where a marker was not seen.
    labels : L strings, each different
    rate : float, frames per second

    Raises
    ------
    ValueError
        Shapes that do not agree, a label that comes twice, a rate that is not positive, an infinite position.
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
        twice = [label for label, times in Counter(labels).items() if times > 1]
        if twice:
            raise ValueError(f"labels: expected each once, {', '.join(twice)} comes more often")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise ValueError(f"rate: expected a positive number of frames per second, got {self.rate}")
        if np.isinf(positions).any():
            raise ValueError("positions: expected finite numbers, or NaN for a marker that was not seen")
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
        """(T, L) bool: where a marker was seen."""
        return ~np.isnan(self.positions[..., 0])

    @property
    def times(self) -> np.ndarray:
        """(T,) seconds from the first frame."""
        return np.arange(len(self.positions)) / self.rate

    def select(self, labels: Sequence[str]) -> MarkerSequence:
        """The markers of these labels, in this order.

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
        """A stretch of the sequence; a step in the slice lowers the rate."""
        step = which.step or 1
        if step < 1:
            raise ValueError(f"which: expected a slice that goes forward, got {which}")
        return MarkerSequence(self.positions[which], self.labels, self.rate / step)


def read_markers(path: str | Path, unit: str | None = None, subject_prefix: str | None = None,
                 rate: float | None = None, usual_rate: float | None = None) -> MarkerSequence:
    """Read a marker sequence.

    What a file says wrongly of itself and what was done about it is told in a UserWarning each: another number of
    frames, a label that comes twice, a number that stands for a marker that was not seen.

    Parameters
    ----------
    path : str or Path
        C3D; TRC; CSV as Motive exports it; TSV as Qualisys does; or CSV with the columns `time, LABEL_x, LABEL_y,
        LABEL_z, ...`, an empty cell where a marker is missing. Instead of `time`, seconds, there may be `frame`; then
        `rate` is needed.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the file. When it is not given: what the file says, or millimetres; metres for CSV.
    subject_prefix : str, optional
        Whose markers, in a file with several people: labels read `Subject:Label` there. Several, `Head,Trunk`, are of
        one person.
    rate : float, optional
        Frames per second, where the file does not say or says it wrongly.
    usual_rate : float, optional
        Frames per second to assume, with a warning, where the file does not say; without it such a file is refused.

    Returns
    -------
    MarkerSequence
        In metres, labels without `Subject:`.

    Raises
    ------
    MarkerFileError
        Missing, truncated or of another format; several people of whom none is named; no rate.

    Examples
    --------
    >>> read_markers("walk.c3d", subject_prefix="Ann").labels[:2]
    ('LFHD', 'RFHD')
    """
    path = Path(path)
    metres_of(unit)                      # another word is refused before the file is read
    raw = _read_raw(path)
    columns, labels = subject_columns(path, raw.labels, subject_prefix)
    together, notes = people_of(raw.labels), list(raw.notes)
    if subject_prefix is None and together and len(together[0]) > 1:
        most = Counter(label.rpartition(":")[0] for label in raw.labels if ":" in label).most_common(1)[0][0]
        notes.append(f"the labels of {', '.join(together[0])} are taken as those of one person; those of one only are "
                     f"taken with subject_prefix={most}")
    return _in_metres(path, raw, columns, labels, unit, rate, usual_rate, notes)


def read_marker_points(path: str | Path, unit: str | None = None, rate: float | None = None) -> MarkerSequence:
    """Read all points of a file, whoever's they are: labels as they stand there, with what is before a colon.

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
    >>> read_points("two_people.c3d").labels[:2]
    ('Ann:LFHD', 'Ann:RFHD')
    """
    path = Path(path)
    metres_of(unit)
    raw = _read_raw(path)
    return _in_metres(path, raw, range(len(raw.labels)), raw.labels, unit, rate, None, list(raw.notes))


def _in_metres(path: Path, raw: RawMarkers, columns: Sequence[int], labels: tuple[str, ...], unit: str | None,
               rate: float | None, usual_rate: float | None, notes: list[str]) -> MarkerSequence:
    """Some columns of a file as a sequence; what was done about what it says wrongly is told."""
    own_unit = unit or unit_named(raw.unit)
    if own_unit is None:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(UNITS)}, found '{raw.unit}'; say unit=")
    if rate is None and raw.rate is None:
        if usual_rate is None:
            raise MarkerFileError(f"{path}: expected the frames per second, it does not say them; say rate=")
        notes.append(f"it does not say its frames per second, {usual_rate:g} are assumed")
    # not seen: 0 0 0, or one number three times, as 9999999, that lies beyond all places
    places = raw.positions[:, columns]
    places = np.where((places == 0).all(axis=2, keepdims=True), np.nan, places)
    same = (places == places[..., :1]).all(axis=2)
    others = np.abs(places[~same & np.isfinite(places).all(axis=2)])
    fill = same & (np.abs(places[..., 0]) > others.max(initial=0)) & bool(others.size)
    if fill.any():
        values = ", ".join(f"{value:.9g}" for value in np.unique(places[fill, 0])[:3])
        notes.append(f"{number_of(int(fill.sum()), 'position')} of {values} three times taken as missing")
        places = np.where(fill[..., None], np.nan, places)
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
    """The people whose markers are in a file, by what stands before the colon of its labels.

    None where there is no colon, nor where several prefixes are parts of one person, as `people_of` says. Beside
    several people a prefix of fewer than eight labels, of which nobody else has one, is a prop: it is left out, with a
    warning.
    """
    labels = _read_raw(Path(path)).labels
    people = tuple(prefixes[0] for prefixes in people_of(labels) if len(prefixes) == 1)
    if len(people) < 2:
        return people
    bare = {who: {label.rpartition(":")[2] for label in labels if label.rpartition(":")[0] == who} for who in people}
    times = Counter(label for own in bare.values() for label in own)
    props = [who for who, own in bare.items() if len(own) < 8 and all(times[label] == 1 for label in own)]
    if props:
        warnings.warn(f"{path}: {', '.join(props)} taken for props beside people and left out; taken all the same with "
                      f"subject_prefix={props[0]}", stacklevel=2)
    return tuple(who for who in people if who not in props)


def label_prefixes(path: str | Path) -> set[str]:
    """What stands before the colon of the labels of a file; none of one that cannot be read."""
    try:
        labels = _read_raw(Path(path)).labels
    except MarkerFileError:
        return set()
    return {label.rpartition(":")[0] for label in labels if ":" in label}


def people_of(labels: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """The prefixes of each person's labels, `Subject:Label`.

    Where no bare label comes twice, prefixes are those of clusters, rigid bodies or a prop beside one person; where
    some do, each prefix is that of a person.

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
    """What a file holds, by its ending."""
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
    """Columns and bare labels of the only person, or of the prefixes that are named, with commas between several."""
    split = [label.rpartition(":") for label in labels]
    people = people_of(labels)
    known = {who for prefixes in people for who in prefixes}
    if subject_prefix is None and len(people) > 1:
        raise MarkerFileError(f"{path}: expected one subject, found {', '.join(who for who, in people)}; say "
                              f"subject_prefix={people[0][0]}")
    wanted = known | {""} if subject_prefix is None else \
        {subject_prefix} if subject_prefix in known else set(subject_prefix.split(","))
    missing = wanted - known - {""}
    if missing:
        raise MarkerFileError(f"{path}: expected the subject '{', '.join(sorted(missing))}', found "
                              f"{', '.join(sorted(known)) or 'none'}")
    columns = [i for i, (who, _, _) in enumerate(split) if who in wanted]
    return columns, tuple(split[i][2] for i in columns)


def write_markers(path: str | Path, sequence: MarkerSequence) -> None:
    """Write a sequence, whole or not at all: `.csv` in metres, `.trc` or, single precision, `.c3d` in millimetres.

    Raises
    ------
    MarkerFileError
        A name that ends in none of these.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WRITTEN:
        raise MarkerFileError(f"{path}: expected a name ending in {', '.join(WRITTEN)}, found '{path.suffix}'")
    told = sequence.positions, sequence.labels, sequence.rate
    with storage.writing(path) as beside:
        if suffix == ".c3d":
            write_c3d(beside, *told)
        else:
            beside.write_bytes(encode_csv(*told) if suffix == ".csv" else encode_trc(*told, path.name))
