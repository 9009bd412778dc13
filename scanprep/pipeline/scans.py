"""The scans of a folder, their landmark files, and the table about them."""
from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

from ..geometry import storage, tables
from ..geometry.files import SCAN_ENDINGS, MeshFileError, advice, is_scan, list_files, name_of
from ..geometry.landmarks import landmarks_beside, names_no_landmark
from ..words import check_names

TABLE = "scans.csv"               # optional table beside the scans
ABOUT = {"digest": False}         # fields that only go into tables, so changing them registers nothing again


@dataclass(frozen=True)
class ScanTask:
    """One scan of a folder and what is known of it; empty where nothing is."""

    name: str
    scan: Path
    landmarks: Path | None = None
    subject: str = field(default="", metadata=ABOUT)
    pose: str = field(default="", metadata=ABOUT)
    sex: str = field(default="", metadata=ABOUT)
    model: Path | None = None         # file of the model that leads the template; None: the built-in people


def find_scans(folder: str | Path, landmarks: str | Path | None = None, subject: str = "") -> list[ScanTask]:
    """Find the scans of a folder sorted by name, their landmark files, and what `scans.csv` says of them.

    The name is the file name without ending. A landmark file has the same name. It is in the folder `landmarks` that is
    given, else in one of that name inside, or beside the scan. The word none means no landmarks. A scan whose subject
    is not in `scans.csv` (name, subject, pose, sex) is of `subject`, else of a person of its own.

    Raises
    ------
    ValueError
        No scans, two of the same name, or a table about other scans.
    """
    folder = Path(folder)
    for path in list_files(folder, lambda path: bool(advice(path))):
        warnings.warn(f"{path}: it is left out, its format is not read here; {advice(path)}", stacklevel=2)
    paths: dict[str, Path] = {}
    for path in list_files(folder, is_scan):
        name = name_of(path)
        if name in paths:
            raise ValueError(f"{folder}: expected one file a scan, found {paths[name].name} and {path.name}, both "
                             f"of the name '{name}'; rename one, or merge them where they are views of one scan")
        paths[name] = path
    if not paths:
        # a hint for somebody who named the folder above
        inner = [place.name for place in sorted(folder.iterdir()) if place.is_dir() and list_files(place, is_scan)]
        hint = f"; there are some in its folders {', '.join(inner[:5])}: name one of them" if inner else ""
        raise MeshFileError(f"{folder}: expected scans ({', '.join(SCAN_ENDINGS)}), found none{hint}")
    check_names(paths, str(folder))
    about = _read_table(folder / TABLE)
    unknown = sorted(set(about) - set(paths))
    if unknown:
        raise ValueError(f"{folder / TABLE}: no scan is called {', '.join(unknown[:5])}; the scans are called "
                         f"{', '.join(list(paths)[:5])}")
    if landmarks and not means_none(landmarks) and not Path(landmarks).is_dir():
        raise ValueError(f"landmarks: expected a folder, there is none at {landmarks}")
    # what is clicked is written there, so a link that leads out of the folder has to be named
    places = [storage.path_inside(folder, "landmarks", "--landmarks"), folder] if not landmarks else \
        [] if means_none(landmarks) else [Path(landmarks)]
    # join each file with its row of the table and its landmark file
    tasks = []
    for name, path in sorted(paths.items()):
        row = about.get(name, {})
        beside = next(filter(None, (landmarks_beside(path, place) for place in places)), None)
        tasks.append(ScanTask(name, path, None if beside is None or names_no_landmark(beside) else beside,
                              row.get("subject") or subject or name, row.get("pose") or "", row.get("sex") or ""))
    return tasks


def means_none(landmarks: str | Path | None) -> bool:
    """Return whether a landmarks argument is the word none, and no folder of that name."""
    return landmarks is not None and Path(landmarks).name == "none" and not Path(landmarks).exists()


def _read_table(path: Path) -> dict[str, dict[str, str]]:
    """Read `scans.csv`: name -> row; empty where there is none."""
    if not path.exists():
        return {}
    about: dict[str, dict[str, str]] = {}
    for line, row in tables.read_table(path, ("name", "subject", "pose", "sex"), ("name",)):
        if row["name"] in about:
            raise storage.StorageError(f"{path}: line {line}: the name {row['name']} comes twice")
        about[row["name"]] = row
    return about
