"""A folder of scans to a registered set: one task a scan, resumable, and one bad scan stops no other.

    scans/name.ply, its landmarks, scans.csv  ->  set/meshes/name.ply, set.csv, registration.csv, skeleton.json
"""
from __future__ import annotations

import csv
import io
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from .dataset import RegisteredSet
from .geometry import storage
from .geometry.files import list_meshes, read_mesh, read_points
from .geometry.landmarks import match_landmarks, read_landmarks, write_landmarks
from .geometry.mesh import Mesh, check_template
from .matching.nonrigid import RegistrationConfig, register
from .skeleton.find import SkeletonConfig, find_skeleton

Progress = Callable[[int, int], None]

LANDMARK_ENDINGS = (".json", ".mrk.json", ".landmarks.json", ".pp", "_picked_points.pp", ".lnd", ".landmarks.txt")
TABLE = "scans.csv"


@dataclass(frozen=True)
class ScanTask:
    """One scan of a folder and what is known of it.

    Attributes
    ----------
    name : str
    scan : Path
    landmarks : Path or None
    subject, pose, sex : str
        Empty where not known.
    """

    name: str
    scan: Path
    landmarks: Path | None = None
    subject: str = ""
    pose: str = ""
    sex: str = ""


@dataclass(frozen=True)
class ScanFigures:
    """How well the template lies on one scan: a row of `registration.csv`.

    Attributes
    ----------
    name : str
    distance, rms : float, metres
        Of the vertices with data to the surface of the scan.
    seen : float
        Share of the vertices with data.
    landmarks : float, metres
        RMS distance of the landmarks.
    flipped : int
        Triangles that face against their surroundings.
    converged : bool
    seconds : float
    """

    name: str
    distance: float
    rms: float
    seen: float
    landmarks: float
    flipped: int
    converged: bool
    seconds: float


@dataclass(frozen=True)
class PrepareConfig:
    """Settings of `prepare`.

    Attributes
    ----------
    registration : RegistrationConfig
    skeleton : SkeletonConfig
    unit : 'm', 'mm', 'cm' or 'in', optional
        Of the scans and their landmarks, where the files cannot tell.
    min_poses : int
        A skeleton is sought when one subject has at least so many meshes.
    workers : int
        Processes; 0 for one a core.
    """

    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    skeleton: SkeletonConfig = field(default_factory=SkeletonConfig)
    unit: str | None = None
    min_poses: int = 5
    workers: int = 0


@dataclass(frozen=True, eq=False)
class Prepared:
    """What `prepare` did.

    Attributes
    ----------
    registered : RegisteredSet
    figures : tuple of ScanFigures, of all scans in the set
    failures : tuple of str
        One line a scan that could not be registered: which file, and why.
    """

    registered: RegisteredSet
    figures: tuple[ScanFigures, ...]
    failures: tuple[str, ...]


def find_scans(folder: str | Path, landmarks: str | Path | None = None, subject: str = "") -> list[ScanTask]:
    """The scans of a folder, their landmark files, and what `scans.csv` says of them.

    Parameters
    ----------
    folder : path
        Meshes or point clouds. `scans.csv`, where there is one, has the columns name, subject, pose, sex (any of
        the last three may be missing).
    landmarks : path, optional
        Folder of the landmark files, by default `landmarks` inside the folder or the folder itself. A file
        belongs to the scan of the same name.
    subject : str
        Whose scans they are, where `scans.csv` does not say; when empty, every scan is a subject of its own.

    Raises
    ------
    ValueError
        No such folder, no scans, a table without names.
    """
    folder = Path(folder)
    paths = list_meshes(folder)
    about = _read_table(folder / TABLE)
    unknown = sorted(set(about) - {path.name.split(".")[0] for path in paths})
    if unknown:
        raise ValueError(f"{folder / TABLE}: no scan is called {', '.join(unknown[:5])}")
    places = [Path(landmarks)] if landmarks else [folder / "landmarks", folder]
    tasks = []
    for path in paths:
        name = path.name.split(".")[0]
        row = about.get(name, {})
        candidates = [place / (name + ending) for place in places for ending in LANDMARK_ENDINGS]
        tasks.append(ScanTask(name, path, next((c for c in candidates if c.is_file()), None),
                              row.get("subject") or subject or name, row.get("pose", ""), row.get("sex", "")))
    return tasks


def prepare(tasks: Sequence[ScanTask], template: Mesh, template_landmarks: dict[str, int], folder: str | Path,
            config: PrepareConfig | None = None, progress: Progress | None = None,
            skeleton_progress: Progress | None = None) -> Prepared:
    """Register the template to every scan and find the skeleton.

    Scans that the folder already holds are not registered again, so the same call goes on where it was
    interrupted. A scan that cannot be read or registered is listed and the others go on.

    Parameters
    ----------
    tasks : from `find_scans`
    template : Mesh
        One connected manifold component.
    template_landmarks : name -> vertex
    folder : path
        Of the registered set.

    Raises
    ------
    ValueError
        A template that cannot serve, or a folder that holds a set made with another template or settings.
    """
    config = config or PrepareConfig()
    folder = Path(folder)
    check_template(template)
    registered = _open_set(folder, template, config)
    write_landmarks(folder / "landmarks.json", {name: int(v) for name, v in template_landmarks.items()})
    figures = {f.name: f for f in _read_figures(folder)}
    wanted = [task for task in tasks if task.name not in figures or task.name not in registered.names]
    failures = []
    done = len(tasks) - len(wanted)
    if progress:
        progress(done, len(tasks))
    for task, outcome in _run(wanted, template, template_landmarks, config):
        if isinstance(outcome, str):
            failures.append(outcome)
        else:
            vertices, row = outcome
            registered = registered.add(task.name, vertices, task.subject, task.pose, task.sex)
            figures[row.name] = row
            _write_figures(folder, figures.values())
        done += 1
        if progress:
            progress(done, len(tasks))
    registered = _with_skeleton(registered, config, skeleton_progress)
    return Prepared(registered, tuple(figures[n] for n in registered.names if n in figures), tuple(failures))


def register_scan(task: ScanTask, template: Mesh, template_landmarks: dict[str, int], config: RegistrationConfig,
                  unit: str | None = None) -> tuple[np.ndarray, ScanFigures]:
    """Read and register one scan: vertices (N, 3) in metres, and how well they lie.

    Raises
    ------
    ValueError
        A file that cannot be read, landmarks that do not match.
    """
    start = time.perf_counter()
    scan = read_scan(task.scan, unit)
    landmarks = None
    if task.landmarks is not None:
        mesh = scan if isinstance(scan, Mesh) else None
        found = read_landmarks(task.landmarks, mesh, unit)
        try:
            landmarks = match_landmarks(template_landmarks, found)[1:]
        except ValueError as error:
            raise ValueError(f"{task.landmarks}: {error}") from None
    fit = register(template, scan, landmarks, config)
    return fit.mesh.vertices, ScanFigures(
        task.name, float(np.nanmean(fit.distances)) if fit.seen.any() else np.nan, fit.rms, float(fit.seen.mean()),
        fit.landmark_rms, fit.flipped, fit.converged, time.perf_counter() - start)


def read_scan(path: str | Path, unit: str | None = None) -> Mesh | np.ndarray:
    """A scan as a mesh, or as points (n, 3) where the file has no triangles."""
    cloud = read_points(path, unit)
    if Path(path).suffix.lower() in (".xyz", ".pcd", ".txt", ".pts"):
        return cloud.points
    try:
        return read_mesh(path, unit)
    except ValueError as error:
        if "no faces" in str(error):
            return cloud.points
        raise


def _attempt(task: ScanTask, template: Mesh, template_landmarks: dict[str, int], config: RegistrationConfig,
             unit: str | None) -> tuple[np.ndarray, ScanFigures] | str:
    try:
        return register_scan(task, template, template_landmarks, config, unit)
    except (ValueError, OSError, MemoryError) as error:
        text = " ".join(str(error).split()) or type(error).__name__
        return text if str(task.scan) in text or str(task.landmarks) in text else f"{task.scan}: {text}"


def _run(tasks: Sequence[ScanTask], template: Mesh, template_landmarks: dict[str, int], config: PrepareConfig
         ) -> Iterator[tuple[ScanTask, tuple[np.ndarray, ScanFigures] | str]]:
    """Each task with its vertices and figures, or with the reason of its failure, as they come in."""
    from joblib import Parallel, delayed, parallel_config

    workers = min(config.workers or os.cpu_count() or 1, max(len(tasks), 1))
    rest = (template, template_landmarks, config.registration, config.unit)
    # one thread for linear algebra in each process, so that they do not take each other's cores
    with parallel_config("loky", n_jobs=workers, inner_max_num_threads=1):
        jobs = (delayed(_numbered)(i, _absolute(task), *rest) for i, task in enumerate(tasks))
        for i, outcome in Parallel(return_as="generator_unordered", batch_size=1)(jobs):
            yield tasks[i], outcome


def _absolute(task: ScanTask) -> ScanTask:
    """With whole paths: a process may have been started in another folder."""
    return replace(task, scan=task.scan.absolute(), landmarks=task.landmarks and task.landmarks.absolute())


def _numbered(i: int, *task) -> tuple[int, tuple[np.ndarray, ScanFigures] | str]:  # type: ignore[no-untyped-def]
    return i, _attempt(*task)


def _open_set(folder: Path, template: Mesh, config: PrepareConfig) -> RegisteredSet:
    settings = {"registration": asdict(config.registration), "unit": config.unit}
    registered = RegisteredSet.create(folder, template, {"settings": settings})
    # through JSON, as the stored settings have been
    if storage.as_json(registered.info.get("settings")) != storage.as_json(settings):
        raise ValueError(f"{folder}: the set was begun with other settings; name another folder, or remove it")
    return registered


def _with_skeleton(registered: RegisteredSet, config: PrepareConfig, progress: Progress | None) -> RegisteredSet:
    subjects = [entry.subject for entry in registered.entries]
    if registered.skeleton is not None or not subjects or max(map(subjects.count, subjects)) < config.min_poses:
        return registered
    skeleton = find_skeleton(registered.template, registered.poses(), config.skeleton, progress=progress)
    return registered.with_skeleton(skeleton)


def _read_table(path: Path) -> dict[str, dict[str, str]]:
    if not path.exists():
        return {}
    rows = list(csv.DictReader(io.StringIO(path.read_text(encoding="utf-8-sig"))))
    if rows and "name" not in rows[0]:
        raise ValueError(f"{path}: line 1: expected a column 'name' beside subject, pose and sex, "
                         f"found {', '.join(rows[0])}")
    return {row["name"]: row for row in rows}


def _read_figures(folder: Path) -> list[ScanFigures]:
    path = folder / "registration.csv"
    names = [f.name for f in fields(ScanFigures)]
    if not path.exists():
        return []
    rows = csv.DictReader(io.StringIO(path.read_text(encoding="utf-8")))
    read: dict[str, Callable[[str], Any]] = {"str": str, "float": float, "int": int, "bool": "True".__eq__}
    try:
        return [ScanFigures(*(read[str(f.type)](row[f.name]) for f in fields(ScanFigures))) for row in rows]
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: expected the columns {', '.join(names)} ({error})") from None


def _write_figures(folder: Path, figures: Iterable[ScanFigures]) -> None:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow([f.name for f in fields(ScanFigures)])
    table.writerows(astuple(row) for row in figures)
    with storage.writing(folder / "registration.csv") as beside:
        beside.write_text(text.getvalue(), encoding="utf-8")
