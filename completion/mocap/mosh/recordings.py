"""Which marker files belong to whom."""
from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast, get_args

from scanprep.arguments import UsageError
from scanprep.batch.workspace import HOME
from scanprep.geometry import storage, tables

from ..files.markers import READERS, label_prefixes, marker_subjects
from ..files.text import MarkerFileError

By = Literal["auto", "name", "label", "each", "all"]
TABLE = "subjects.csv"


@dataclass(frozen=True)
class Recording:
    """One sequence of one person: its file, the name of its output folder, and whose markers in it, if of several."""

    path: Path
    name: str
    who: str | None = None


@dataclass(frozen=True)
class Actor:
    """A person, by a name fit for a folder, the recordings of it, and the rule by which these are thought to be so."""

    name: str
    recordings: tuple[Recording, ...]
    rule: str = field(metadata={"digest": False})


@dataclass(frozen=True)
class Grouping:
    """How recordings are given to people: by a rule, see --subjects of `scape mosh`, or by a table.

    "auto" is, of files that were named, "all"; of a folder its sub-folders, and of files that lie side by side "name"
    where the name is two numbers, as in 85_02, else "label", else "each". Several people in one file are kept apart,
    by their labels, whatever the rule.
    """

    by: By = "auto"
    table: Path | None = None            # CSV with the columns file and subject, or JSON {file: subject}
    who: str | None = None               # whose markers, in files with several people

    @staticmethod
    def of(subjects: str) -> Grouping:
        """By a rule that is named, by a table, or whose markers they are."""
        if subjects in get_args(By):
            return Grouping(cast(By, subjects))
        if Path(subjects).suffix.lower() in (".csv", ".json"):
            return Grouping("auto", Path(subjects))
        if Path(subjects).suffix or "/" in subjects:
            raise UsageError(f"--subjects: expected a file .csv or .json, one of {', '.join(get_args(By))}, or what "
                             f"stands before the colon of labels, got '{subjects}'")
        return Grouping("auto", None, subjects)


def find_actors(markers: Iterable[Path], grouping: Grouping, output: Path | None = None) -> list[Actor]:
    """The people of some files and folders; what lies in `output` is no recording. ValueError for what cannot be."""
    given = list(markers)
    for place in given:
        if output is not None and place.is_dir() and output.resolve() in (place.resolve(), *place.resolve().parents):
            raise ValueError(f"{output}: expected a folder for the output that does not hold the recordings, {place}")
    found = list(_files(given, output, grouping))
    if grouping.who is not None and found:
        there = set().union(*(label_prefixes(file.path) for file in found))
        if not there & set(grouping.who.split(",")):
            raise UsageError(f"--subjects: expected a file .csv or .json, one of {', '.join(get_args(By))}, or what "
                             f"stands before the colon of labels ({', '.join(sorted(there)) or 'here: none'}), "
                             f"got '{grouping.who}'")
    if not found:
        raise ValueError(f"{', '.join(map(str, given))}: expected files ending in {', '.join(READERS)}, found none")
    whole = grouping.by == "all" or (grouping.by == "auto" and all(path.is_file() for path in given)
                                     and not any(len(f.people) > 1 for f in found))
    if grouping.table is not None:
        said = _read_table(grouping.table, [f.path for f in found])
        rows = []
        for f, subject in [(file, subject) for file in found for subject in said.get(file.path, ())]:
            # of several people in a file the one whom the table names
            named = (who for who in f.people if folder_name(who) == folder_name(subject))
            who = grouping.who or (next(named, None) if len(f.people) > 1 else None)
            rows.append((folder_name(subject), f, who, f"as {grouping.table} says"))
    elif whole:
        name = next(_people(found[0], grouping))[0]
        if len(given) == 1 and given[0].is_dir():
            name = given[0].resolve().name
        rows = [(folder_name(name), f, grouping.who, "files that were named together") for f in found]
    else:
        rows = [(folder_name(name), f, who, rule) for f in found for name, who, rule in _people(f, grouping)]
    return [Actor(person, _name_recordings(person, [(f, who) for name, f, who, _ in rows if name == person]),
                  next(rule for name, *_, rule in rows if name == person))
            for person in sorted({name for name, *_ in rows})]


def write_grouping(path: Path, actors: Iterable[Actor]) -> None:
    """Who is who as CSV, in the form that `Grouping.table` takes."""
    tables.write_table(path, ("file", "subject", "rule"),
                       ((r.path, actor.name, actor.rule) for actor in actors for r in actor.recordings))


def folder_name(text: str) -> str:
    """A text as the name of a folder: letters, digits and - _ . only."""
    return re.sub(r"[^\w.-]+", "_", text).strip("._") or "person"


@dataclass(frozen=True)
class _File:
    """A marker file, the folders it lies in below the one that was given, and the people that its labels tell."""

    path: Path
    folders: tuple[str, ...]
    people: tuple[str, ...]              # none where one of them is named


def _files(given: list[Path], output: Path | None, grouping: Grouping) -> Iterator[_File]:
    """The files that were named, and the marker files of the folders that were, each once."""
    seen = set() if grouping.table is None else {grouping.table.resolve()}
    outputs = {output.resolve()} if output is not None else set()
    for place in given:
        if not place.exists():
            raise ValueError(f"{place}: no such file or folder")
        if place.is_dir():                             # nor what an earlier call has written
            outputs |= {found.parent.resolve() for found in place.rglob(TABLE)
                        if (found.parent / "report.html").exists() or (found.parent / HOME).exists()}
        for path in sorted(place.rglob("*")) if place.is_dir() else [place]:
            parts, whole = path.relative_to(place).parts, path.resolve()
            if place.is_dir() and (path.suffix.lower() not in READERS or any(part.startswith(".") for part in parts)
                                   or outputs & set(whole.parents)):
                continue
            if whole not in seen:
                seen.add(whole)
                try:
                    people = marker_subjects(path) if grouping.who is None else ()
                except MarkerFileError:  # told when the file is read in earnest
                    people = ()
                yield _File(path, parts[:-1], people)


def _people(file: _File, grouping: Grouping) -> Iterator[tuple[str, str | None, str]]:
    """Name, C3D subject and rule of the people in a file."""
    by, own = grouping.by, file.path.stem
    numbers, people = re.fullmatch(r"(\d+)[_-]\d+", own), file.people
    if len(people) > 1:
        for who in people:
            yield who, who, "by what stands before the labels"
    elif by == "auto" and file.folders:
        yield file.folders[0], grouping.who, "by the sub-folder"
    elif by == "name" or (by == "auto" and numbers):
        yield re.split(r"[_\-\s]", own)[0], grouping.who, "by the file name" + (", NUMBER_NUMBER" if numbers else "")
    elif by != "each" and people:
        yield people[0], None, "by what stands before the labels"
    else:
        yield own if grouping.who is None or by == "each" else grouping.who, grouping.who, "a file by itself"


def _name_recordings(person: str, files: list[tuple[_File, str | None]]) -> tuple[Recording, ...]:
    """The recordings of a person, each named as its file, with its ending where that is not enough."""
    def name(file: _File, ending: bool) -> str:
        folders = file.folders[1:] if file.folders and folder_name(file.folders[0]) == person else file.folders
        return folder_name("_".join((*folders, file.path.name if ending else file.path.stem)))

    short = [name(file, False) for file, _ in files]
    names = [name(file, short.count(s) > 1) for s, (file, _) in zip(short, files, strict=True)]
    for one in names:
        if names.count(one) > 1:
            paths = " and ".join(str(f.path) for n, (f, _) in zip(names, files, strict=True) if n == one)
            raise ValueError(f"{paths}: expected files of different names for one person, {person}")
    return tuple(Recording(f.path, n, who) for n, (f, who) in zip(names, files, strict=True))


def _read_table(table: Path, found: list[Path]) -> dict[Path, list[str]]:
    """Whose each file is, of those that the table names by path, by name or without ending; several of some."""
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
