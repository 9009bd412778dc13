"""Files of marker sequences: C3D, TRC and CSV."""
from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from scanprep.geometry import storage
from scanprep.geometry.format_common import FARTHEST, UNITS

from .c3d import read_c3d, write_c3d
from .text import MarkerFileError, RawMarkers, encode_csv, encode_trc, read_csv, read_trc

READERS = {".c3d": read_c3d, ".trc": read_trc, ".csv": read_csv}
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


def read_markers(path: str | Path, unit: str | None = None, subject: str | None = None,
                 rate: float | None = None) -> MarkerSequence:
    """Read a marker sequence.

    Parameters
    ----------
    path : str or Path
        C3D; TRC; or CSV with the columns `time, LABEL_x, LABEL_y, LABEL_z, ...`, an empty cell where a marker
        is missing. Instead of `time`, seconds, there may be `frame`; then `rate` is needed.
    unit : 'm', 'mm', 'cm' or 'in', optional
        Unit of the file. When it is not given: what a C3D or TRC file says, or millimetres; metres for CSV.
    subject : str, optional
        Whose markers, in a C3D file with several: labels read `Subject:Label` there.
    rate : float, optional
        Frames per second, where the file does not say or says it wrongly.

    Returns
    -------
    MarkerSequence
        In metres, labels without `Subject:`.

    Raises
    ------
    MarkerFileError
        Missing, truncated or of another format, several subjects and none named, a label that comes twice.
    """
    path = Path(path)
    if unit is not None and unit not in UNITS:
        raise ValueError(f"unit: expected one of {', '.join(UNITS)}, got {unit!r}")
    raw = _read_raw(path)
    own_unit = unit or raw.unit
    if own_unit not in UNITS:
        raise MarkerFileError(f"{path}: expected a unit of {', '.join(UNITS)}, found '{raw.unit}'; "
                              f"say unit=")
    if rate is None and raw.rate is None:
        raise MarkerFileError(f"{path}: expected a column time, found frame numbers only; say rate=")
    columns, labels = _of_subject(path, raw.labels, subject)
    positions = UNITS[own_unit] * raw.positions[:, columns]
    positions[(positions == 0).all(axis=2)] = np.nan
    if (np.abs(positions) > FARTHEST).any():
        raise MarkerFileError(f"{path}: expected positions that are finite and below {FARTHEST:g} m, found "
                              f"{np.nanmax(np.abs(positions)):.3g}")
    try:
        return MarkerSequence(positions, labels, rate or raw.rate or 0.0)
    except ValueError as error:
        raise MarkerFileError(f"{path}: {error}") from None


def marker_subjects(path: str | Path) -> tuple[str, ...]:
    """Whose markers are in a file: what stands before the colon of its labels; none where there is no colon."""
    split = (label.rpartition(":") for label in _read_raw(Path(path)).labels)
    return tuple(dict.fromkeys(who for who, colon, _ in split if colon))


def _read_raw(path: Path) -> RawMarkers:
    """What a file holds, by its ending."""
    data = storage.read_bytes(path, "a file of markers", MarkerFileError)
    if path.suffix.lower() not in READERS:
        raise MarkerFileError(f"{path}: expected a name ending in {', '.join(READERS)}, found '{path.suffix}'")
    if not data:
        raise MarkerFileError(f"{path}: the file is empty")
    return READERS[path.suffix.lower()](path, data)


def _of_subject(path: Path, labels: tuple[str, ...], subject: str | None) -> tuple[list[int], tuple[str, ...]]:
    """Columns and bare labels of the only subject, or of the one that is named."""
    split = [label.rpartition(":") for label in labels]
    subjects = list(dict.fromkeys(who for who, colon, _ in split if colon))
    if subject is not None and subject not in subjects:
        raise MarkerFileError(f"{path}: expected the subject '{subject}', found {', '.join(subjects) or 'none'}")
    if subject is None and len(subjects) > 1:
        raise MarkerFileError(f"{path}: expected one subject, found {', '.join(subjects)}; say subject=")
    columns = [i for i, (who, _, _) in enumerate(split) if subject is None or who == subject]
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
    if suffix not in READERS:
        raise MarkerFileError(f"{path}: expected a name ending in {', '.join(READERS)}, found '{path.suffix}'")
    told = sequence.positions, sequence.labels, sequence.rate
    with storage.writing(path) as beside:
        if suffix == ".c3d":
            write_c3d(beside, *told)
        else:
            beside.write_bytes(encode_csv(*told) if suffix == ".csv" else encode_trc(*told, path.name))
