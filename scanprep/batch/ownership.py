"""Which files of an output scapekit wrote itself, and which are foreign and must not be touched."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ..geometry import storage
from .digests import Digests

HOME = ".scapekit"              # folder with our records, hidden so that it does not mix with results


class ForeignFileError(ValueError):
    """A file stands where the output should go, and scapekit did not write it."""


def add_written(known: dict[str, set[str]], files: Mapping[str, str], place: Path) -> None:
    """Add files, with paths from `place` on, and the digests that they were written with."""
    for file, digest in files.items():
        known.setdefault((place / file).as_posix(), set()).add(digest)


def report_path(output: Path) -> Path:
    """Return where the report of an output is: inside a folder, or beside a file, as `walk.glb.report.json`.

    The whole file name is used, so that `walk.glb` and `walk.bvh` have separate reports.
    """
    return output / "report.json" if output.is_dir() else output.with_name(f"{output.name}.report.json")


def digests_in_report(output: Path) -> dict[str, str]:
    """Return file -> digest of everything a command wrote for an output, as its report says; empty without report.

    Paths start at the folder of the report.
    """
    report = report_path(output)
    try:
        with storage.taking_apart(report, "a report"):
            written = dict(storage.read_json(report, "a report")["written"])
    except storage.StorageError:
        return {}
    for file in written:
        storage.path_inside(report.parent, file, report)
    return {**written, report.name: Digests().of_file(report)}


def refuse_any(folder: Path) -> None:
    """Raise ForeignFileError for a folder that holds anything but hidden files."""
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []
    if inside:
        raise ForeignFileError(refusal(*inside))


def refusal(*taken: Path) -> str:
    """Return the message about files in the way of an output: three by name, the rest as a number."""
    more = f" and {len(taken) - 3} more" if len(taken) > 3 else ""
    return (f"{', '.join(str(path) for path in taken[:3])}{more}: in the way of the output, and not as scapekit "
            "wrote it; nothing was touched: name another output, or move it away")
