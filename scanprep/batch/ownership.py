"""What in an output is scapekit's own, and what is not and is left alone."""
from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from ..geometry import storage
from .digests import Digests

HOME = ".scapekit"


class ForeignFileError(ValueError):
    """Something stands where an output should go, and scapekit did not write it."""


def add_written(known: dict[str, set[str]], files: Mapping[str, str], place: Path) -> None:
    """Add files, from a place in the output on, with the digests that they were written with."""
    for file, digest in files.items():
        known.setdefault((place / file).as_posix(), set()).add(digest)


def report_path(output: Path) -> Path:
    """Where the report of an output stands: in a folder; beside a file, as `walk.glb.report.json`.

    With the whole name: files that differ in their endings only, `walk.glb` and `walk.bvh`, keep a report each.
    """
    return output / "report.json" if output.is_dir() else output.with_name(f"{output.name}.report.json")


def digests_in_report(output: Path) -> dict[str, str]:
    """File -> digest of all that a command wrote for an output, as its report tells; nothing where there is none.

    Paths are from the folder of the report on. Reports of files were once named without the ending, and count too.
    """
    earlier = [] if output.is_dir() else [output.with_suffix(".report.json")]
    for report in (report_path(output), *earlier):
        try:
            with storage.taking_apart(report, "a report"):
                told = storage.read_json(report, "a report")["written"]
        except storage.StorageError:
            continue
        if isinstance(told, dict) and (report not in earlier or output.name in told):
            for file in told:
                storage.path_inside(report.parent, file, report)
            return {**told, report.name: Digests().of_file(report)}
    return {}


def refuse_any(folder: Path) -> None:
    """Refuse a folder that holds anything but hidden files."""
    inside = sorted(path for path in folder.iterdir() if not path.name.startswith(".")) if folder.is_dir() else []
    if inside:
        raise ForeignFileError(refusal(*inside))


def refusal(*taken: Path) -> str:
    more = f" and {len(taken) - 3} more" if len(taken) > 3 else ""
    return (f"{', '.join(str(path) for path in taken[:3])}{more}: in the way of the output, and not as scapekit "
            "wrote it; nothing was touched: name another output, or move it away")
