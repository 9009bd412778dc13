"""Group marker files by person."""
from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from scanprep.arguments import UsageError
from scanprep.batch.workspace import HOME
from scanprep.geometry import storage, tables
from scanprep.words import check_names, fold_name

from ..files.markers import READERS, label_prefixes, marker_subjects
from ..files.text import MarkerFileError

TABLE = "subjects.csv"


@dataclass(frozen=True)
class Recording:
    """One sequence of one person: its file, its output folder, and the prefix of labels if it has several people."""

    path: Path
    name: str
    who: str | None = None


@dataclass(frozen=True)
class Actor:
    """A person: a name fit for a folder, and its recordings."""

    name: str
    recordings: tuple[Recording, ...]


def subjects_table(subjects: str) -> Path | None:
    """Return the table that a value of --subjects names; None for "auto", or for what stands before labels."""
    if Path(subjects).suffix.lower() in (".csv", ".json"):
        return Path(subjects)
    if Path(subjects).suffix or "/" in subjects:
        raise UsageError(f"--subjects: expected a file .csv or .json, or what stands before the colon of labels, got "
                         f"'{subjects}'")
    return None


def find_actors(markers: Iterable[Path], subjects: str = "auto", output: Path | None = None) -> list[Actor]:
    """Find the people of some files and folders, outside `output`; ValueError where there is none.

    Files that were named are of one person, and so is a sub-folder of a folder; a file that lies beside others in a
    folder is of a person by itself. Several people in one file are always kept apart by their labels. `subjects` is a
    table of files and subjects, .csv or .json, or what stands before the labels of one person.
    """
    sources, table = list(markers), subjects_table(subjects)
    prefix = None if table is not None or subjects == "auto" else subjects
    for place in sources:
        if output is not None and place.is_dir() and output.resolve() in (place.resolve(), *place.resolve().parents):
            raise ValueError(f"{output}: expected a folder for the output that does not hold the recordings, {place}")
    files = list(_files(sources, output, table, prefix))
    # a named prefix has to occur
    if prefix is not None and files:
        prefixes = set().union(*(label_prefixes(file.path) for file in files))
        if not prefixes & set(prefix.split(",")):
            raise UsageError("--subjects: expected a file .csv or .json, or what stands before the colon of labels "
                             f"({', '.join(sorted(prefixes)) or 'here: none'}), got '{prefix}'")
    if not files:
        raise ValueError(f"{', '.join(map(str, sources))}: expected files ending in {', '.join(READERS)}, found none")
    # rows of person, file and prefix: by the table, all together, or file by file
    if table is not None:
        subject_of = _read_table(table, [f.path for f in files])
        rows = []
        for f, subject in [(file, subject) for file in files for subject in subject_of.get(file.path, ())]:
            # in a file with several people, the one whom the table names
            named = (who for who in f.people if folder_name(who) == folder_name(subject))
            who = next(named, None) if len(f.people) > 1 else None
            rows.append((folder_name(subject), f, who))
    elif all(path.is_file() for path in sources) and not any(len(f.people) > 1 for f in files):
        name = folder_name(prefix or files[0].path.stem)
        rows = [(name, f, prefix) for f in files]
    else:
        rows = [(folder_name(name), f, who) for f in files for name, who in _people(f, prefix)]
    return [Actor(person, _name_recordings(person, [(f, who) for name, f, who in rows if name == person]))
            for person in sorted({name for name, *_ in rows})]


def write_grouping(path: Path, actors: Iterable[Actor]) -> None:
    """Write the people and their files as CSV, in the form that --subjects takes."""
    tables.write_table(path, ("file", "subject"),
                       ((r.path, actor.name) for actor in actors for r in actor.recordings))


def folder_name(text: str) -> str:
    """Turn a text into the name of a folder: letters, digits and - _ . only."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._") or "person"


@dataclass(frozen=True)
class _File:
    """A marker file, its folders below the one that was named, and the people in its labels."""

    path: Path
    folders: tuple[str, ...]
    people: tuple[str, ...]              # empty where a prefix was named


def _files(sources: list[Path], output: Path | None, table: Path | None, prefix: str | None) -> Iterator[_File]:
    """Yield the files that were named and the marker files of named folders, each once."""
    seen = set() if table is None else {table.resolve()}
    outputs = {output.resolve()} if output is not None else set()
    for place in sources:
        if not place.exists():
            raise ValueError(f"{place}: no such file or folder")
        if place.is_dir():                             # outputs of earlier calls are no recordings
            outputs |= {made.parent.resolve() for made in place.rglob(TABLE)
                        if (made.parent / "report.html").exists() or (made.parent / HOME).exists()}
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            parts, whole = path.relative_to(place).parts, path.resolve()
            if place.is_dir() and (path.suffix.lower() not in READERS or any(part.startswith(".") for part in parts)
                                   or outputs & set(whole.parents)):
                continue
            if whole not in seen:
                seen.add(whole)
                try:
                    people = marker_subjects(path) if prefix is None else ()
                except MarkerFileError:  # reported when the file is read as a whole
                    people = ()
                yield _File(path, parts[:-1], people)


def _people(file: _File, prefix: str | None) -> Iterator[tuple[str, str | None]]:
    """Yield name and prefix of labels for the people in a file of a folder."""
    if len(file.people) > 1:
        for who in file.people:
            yield who, who
    else:
        yield file.folders[0] if file.folders else prefix or file.path.stem, prefix


def _name_recordings(person: str, files: list[tuple[_File, str | None]]) -> tuple[Recording, ...]:
    """Name the recordings of a person by their files, with the ending where names would be equal."""
    def name(file: _File, ending: bool) -> str:
        folders = file.folders[1:] if file.folders and folder_name(file.folders[0]) == person else file.folders
        return folder_name("_".join((*folders, file.path.name if ending else file.path.stem)))

    short = [name(file, False) for file, _ in files]
    alike = [fold_name(each) for each in short]
    names = [name(file, alike.count(fold_name(s)) > 1) for s, (file, _) in zip(short, files, strict=True)]
    for one in names:
        if names.count(one) > 1:
            paths = " and ".join(str(f.path) for n, (f, _) in zip(names, files, strict=True) if n == one)
            raise ValueError(f"{paths}: expected files of different names for one person, {person}")
    check_names(names, person)
    return tuple(Recording(f.path, n, who) for n, (f, who) in zip(names, files, strict=True))


def _read_table(table: Path, found: list[Path]) -> dict[Path, list[str]]:
    """Read which people each file has; the table names files by path, by name or without ending."""
    out: dict[Path, list[str]] = {}
    for file, subject in _table_rows(table):
        wanted = Path(file)
        hits = [path for path in found if path == wanted or path.parts[-len(wanted.parts):] == wanted.parts
                or path.with_suffix("").parts[-len(wanted.parts):] == wanted.parts]
        if not hits:
            raise ValueError(f"{table}: no marker file '{file}' among those that were given")
        if len(hits) > 1:
            raise ValueError(f"{table}: '{file}' may be {' or '.join(map(str, hits))}; write more of the path")
        out.setdefault(hits[0], []).append(subject)
    return out


def _table_rows(table: Path) -> list[tuple[str, str]]:
    """Read pairs of file and subject from JSON or CSV."""
    if table.suffix.lower() == ".json":
        tree = storage.read_json(table, "the subjects {file: subject}")
        if not isinstance(tree, dict) or not all(isinstance(v, str | int) for v in tree.values()):
            raise ValueError(f"{table}: expected JSON {{file: subject}}, found something else")
        return [(file, str(subject)) for file, subject in tree.items()]
    rows = tables.read_table(table, ("file", "subject"))
    empty = [line for line, row in rows if not row["file"] or not row["subject"]]
    if empty or not rows:
        raise storage.StorageError(f"{table}: line {(empty or [2])[0]}: expected a file and its subject, found neither")
    return [(row["file"], row["subject"]) for _, row in rows]
