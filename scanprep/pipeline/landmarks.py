"""`scape prep landmarks`: named landmarks for scans that nobody clicked, each with its expected error.

    OUTPUT/NAME.landmarks.json    of each scan, or in another format: the landmarks where it has data
    OUTPUT/landmarks.csv          all landmarks of all scans, those without data too, with expected errors
    OUTPUT/set/                   the template on every scan, as `scape prep run` makes it, with its page
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from ..batch.opening import workspace
from ..batch.room import Progress, TaskContext
from ..batch.workspace import NothingMadeError, Task, Workspace
from ..cli import MM, Output, Unit
from ..console import Metric, Outcome, bar
from ..geometry import tables
from ..geometry.files import name_of, read_mesh, read_scan
from ..geometry.landmark_names import landmark_name, translate_landmarks
from ..geometry.landmark_writing import Format, landmark_ending
from ..geometry.landmarks import landmarks_beside, read_template_landmarks, write_landmarks
from ..geometry.mesh import Mesh, check_template
from ..geometry.surface import OrientedPoints, Surface
from ..geometry.target import orient_by_mesh, target_of
from ..judgement import size
from ..registration.matches import NORMALS
from ..registration.person import average_person, find_landmarks
from ..synthetic.landmarks import landmarks as landmarks_of_people
from .cli import ScansArg
from .page import judge_set, judge_whole
from .prepare import PrepareConfig, prepare
from .scan import ScanSettings
from .scans import ScanTask, find_scans

SET, TABLE = "set", "landmarks.csv"
POINTS = "points/"               # before the names of the results that are landmarks of a scan
# Names whose places end or bend sharply, so that the surface holds a landmark there; along other skin it slides.
ENDS = {"toe", "heel", "finger", "thumb", "nose", "mouth", "chin", "eye", "ear", "neck"}
# Metres, on a body of the size of a man. Two of three landmarks were within these on six men who are not the template;
# joints and trunk were alike. And the share of the way to the nearest data by which errors grow, on poses from the
# front. Both by tests/benchmarks/found_landmarks.py FOLDER --set tuning.
ERRORS, MAN, ACROSS = {"end": 0.005, "skin": 0.026}, 1.4, 0.3
COLUMNS = ("scan", "landmark", "x", "y", "z", "expected_error_mm", "data", "verdict")


@dataclass(frozen=True, eq=False)
class ScanLandmarks:
    """The landmarks of one scan.

    Attributes
    ----------
    names : tuple of str
    points : (L, 3) float, metres
        On the scan where it has data, else on the template that was registered to it.
    gaps : (L,) float, metres
        From the nearest place with data; 0 where the scan has data.
    size : float, metres
        Of the body, the root of its area.
    """

    names: tuple[str, ...]
    points: np.ndarray
    gaps: np.ndarray
    size: float

    @property
    def seen(self) -> np.ndarray:
        """(L,) bool: the scan has data there."""
        return self.gaps == 0


def landmark_scans(scans: ScansArg, output: Output, template: Path | None = None, format: Format = "json",
                   unit: Unit | None = None, *, space: Workspace) -> Outcome:
    """Named landmarks for scans that nobody clicked, with expected errors, in files of the program that you use.

    A template is registered to every scan, and its landmarks go along. Files have only landmarks where the scan has
    data, landmarks.csv has all: those without data are marked as guessed. A scan whose registration failed gets no
    file. One that is to be looked at gets one, and the table says so. Open set/report.html: such scans come first.

    Example: scape prep landmarks scans -o points

    Args:
        scans: Folder of meshes or point clouds, or one of them.
        output: Folder of the landmark files, which scape prep run takes as --landmarks.
        template: Mesh whose landmarks are wanted, in the file of its name beside it. A person gets the built-in
            landmarks that are not in that file, too; without a template it is the built-in people's average body.
        format: Of the landmark files: json, pp (MeshLab), mrk.json and fcsv (3D Slicer), scalismo.json, csv,
            lnd (CAESAR), txt.
        unit: Unit of the scans, and of the landmark files; the table is in metres.
    """
    tasks = find_scans(scans) if scans.is_dir() else [ScanTask(name_of(scans), scans, subject=name_of(scans))]
    with ExitStack() as bars:
        naming, registering, finding, writing = (bars.enter_context(bar(what)) for what in (
            "finding the parts of a person", "registering scans", "finding landmarks of the template",
            "writing landmarks"))
        body, marks = template_and_landmarks(template, space, finding)
        config = PrepareConfig(ScanSettings(unit=unit))
        return write_all(tasks, body, marks, config, format, space, registering, naming, writing)


def template_and_landmarks(template: Path | None, space: Workspace, progress: Progress) -> tuple[Mesh, dict[str, int]]:
    """A template and its named vertices: those of its file, then the built-in ones that it lacks, if it is a person.

    Without a template it is the average of the built-in people. ValueError for one that has no landmarks.
    """
    if template is None:
        return average_person().mesh, landmarks_of_people()
    body = read_mesh(template)
    check_template(body)
    known = read_template_landmarks(template, body) if landmarks_beside(template) else {}
    named = translate_landmarks(known)
    more = space.step("template", (body, known), lambda folder: find_landmarks(body, known, progress))
    # names stay as they are spelt in the file
    marks = known | {name: vertex for name, vertex in more.items() if name not in named}
    if not marks:
        raise ValueError(f"{template}: expected landmarks in {name_of(template)}.landmarks.json beside it, or the body "
                         "of a person; found neither: click them with scape pick, or leave out --template")
    return body, marks


def write_all(tasks: Sequence[ScanTask], template: Mesh, marks: Mapping[str, int], config: PrepareConfig,
              format: Format, space: Workspace, *tell: Progress) -> Outcome:
    """Register a template to scans, and write its landmarks as they lie on each, into an output that is open.

    What is done already is not done again. `tell` is the progress of scans, of parts of a person, and of files.
    """
    registering, naming, writing = tell or (None, None, None)
    # landmarks that somebody clicked are left out; nobody has so many poses, so that no skeleton is sought and no
    # model of the set learned: landmarks of one scan do not depend on the others
    tasks = [replace(task, landmarks=None) for task in tasks]
    config = replace(config, min_poses=10_000_000)
    place = space.folder / SET
    with workspace(place, space.force) as set_space:
        done = prepare(tasks, template, marks, place, config, registering, None, naming)
        verdicts = {verdict.name: verdict for verdict in judge_set(place)}
        failed = [task.name for task in tasks if verdicts[task.name].failed]
        if len(failed) == len(tasks) and set_space.is_new and space.is_new:
            raise NothingMadeError(done.failures)

    # a scan that failed now may have a file of an earlier run
    for name in failed:
        space.drop(POINTS + name)
    work, meshes = FindPoints(dict(marks)), {entry.name: entry.file for entry in done.registered.entries}
    found = space.run(work, [Task(POINTS + task.name, ScanAndBody(
        task.scan, place / meshes[task.name], task.name + landmark_ending(format), config.scan.unit))
        for task in tasks if task.name not in failed], config.workers, writing)

    # the table has the scans of earlier calls too, as the set has
    words = {name: verdict.judgement.verdict for name, verdict in verdicts.items()}
    kept = space.results(work)
    every = {name: kept[POINTS + name] for name in words if POINTS + name in kept}
    with space.staging("table") as staged:
        tables.write_table(staged.folder / TABLE, COLUMNS, list(landmark_rows(every, words)))
    rows = [Metric("scans with landmarks", f"{len(found.values)} of {len(tasks)}"),
            Metric("registered in this run", done.fresh), Metric("landmarks of each", len(marks)),
            *error_rows({task.name: every[task.name] for task in tasks if task.name in every}, words),
            Metric("scans that need a look", sum(verdict.suspect for verdict in verdicts.values())),
            Metric("unit assumed", config.scan.unit or "m")]
    return Outcome(space.folder, rows, {"prepare": config}, [*done.failures, *found.failures.values()],
                   judgement=judge_whole(list(verdicts.values()), None),
                   following=f"open {place / 'report.html'}: scans that need a look come first")


@dataclass(frozen=True)
class ScanAndBody:
    """A scan, the template on it, the landmark file to write, and the unit of scan and file."""

    scan: Path
    mesh: Path
    file: str
    unit: str | None


@dataclass(frozen=True, eq=False)
class FindPoints:
    """The work on each scan that is registered: its landmark file, of these vertices of the template."""

    landmarks: Mapping[str, int]

    def __call__(self, given: ScanAndBody, room: TaskContext) -> ScanLandmarks:
        scan, body = read_scan(given.scan, given.unit), read_mesh(given.mesh, unit="m")
        points, gaps = points_on_scan(scan, body, np.array(list(self.landmarks.values())))
        found = ScanLandmarks(tuple(self.landmarks), points, gaps, size(body))
        if found.seen.any():                                 # no reader takes a file without landmarks
            write_landmarks(room.folder / given.file, {name: point for name, point, there in zip(
                found.names, points, found.seen, strict=True) if there}, given.unit)
        return found


def points_on_scan(scan: Mesh | np.ndarray, body: Mesh, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where vertices of a body that lies on a scan are on the scan, and how far from data.

    Parameters
    ----------
    scan : Mesh or (n, 3) float, metres
    body : Mesh
        The template, registered to the scan.
    vertices : (L,) int
        Of the body.

    Returns
    -------
    points : (L, 3) float, metres
        The nearest point of the scan; the body's vertex where there are no data.
    gaps : (L,) float, metres
        To the nearest vertex of the body that has data: 0 for those that have some, infinite where none has.

    Examples
    --------
    >>> from scanprep.synthetic.people import Person
    >>> body = Person().mesh
    >>> points, gaps = points_on_scan(body, body, np.array([711, 4616]))
    >>> np.allclose(points, body.vertices[[711, 4616]]), gaps.tolist()
    (True, [0.0, 0.0])
    """
    # the other side of a thin limb is near too: points count that face as the body does
    scale = size(body)
    target = orient_by_mesh(target_of(scan), body, NORMALS * scale)
    # of the body's size: as far off, the scan has no data; `Registration.uncovered` has it
    match = OrientedPoints(target.points, target.normals, NORMALS * scale).match(
        body.vertices, body.vertex_normals, 0.01 * scale)
    seen, points = match.valid[vertices], body.vertices[vertices]
    gaps = np.where(seen, 0.0, np.inf)
    if match.valid.any():
        gaps[~seen] = cKDTree(body.vertices[match.valid]).query(points[~seen])[0]
    if isinstance(scan, Mesh) and len(scan.faces):
        points[seen] = Surface(scan).closest(points[seen]).points
    else:
        points[seen] = target.points[match.index[vertices][seen]]
    return points, gaps


def place_of(name: str) -> str:
    """Of what kind the place of a landmark is: "end" or "skin"; that of an unknown name is skin.

    Examples
    --------
    >>> place_of("Rt. Dactylion"), place_of("left knee")
    ('end', 'skin')
    """
    return "end" if set(landmark_name(name).split()) & ENDS else "skin"


def landmark_errors(found: ScanLandmarks, verdict: str) -> np.ndarray:
    """How far off each landmark may be, (L,) metres, mostly along the skin: two of three are nearer.

    Off is from where the template's landmark belongs on that body. Somebody who clicks has an own idea of that, so from
    clicks it is farther. `verdict` is that on the scan: "good" or "check".
    """
    # an end without data is not held by its shape: hands seen from the front came out short
    places = np.where(found.seen, [place_of(name) for name in found.names], "skin")
    errors = np.array([ERRORS[place] for place in places]) * found.size / MAN + ACROSS * found.gaps
    # on a scan to be looked at, where a limb or the head may be elsewhere
    return errors * (2.0 if verdict == "check" else 1.0)


def landmark_rows(found: Mapping[str, ScanLandmarks], verdicts: Mapping[str, str]) -> Iterator[tuple[object, ...]]:
    """The lines of the table of all landmarks, metres, by the names of their scans."""
    for scan in sorted(found):
        one = found[scan]
        errors = MM * landmark_errors(one, verdicts[scan])
        for name, point, error, seen in zip(one.names, one.points, errors, one.seen, strict=True):
            yield (scan, name, *(f"{value:.6f}" for value in point), f"{error:.0f}", "seen" if seen else "guessed",
                   verdicts[scan])


def error_rows(found: Mapping[str, ScanLandmarks], verdicts: Mapping[str, str]) -> list[Metric]:
    """The rows of the closing table on data and expected errors, over the landmarks of some scans."""
    if not found:
        return []
    errors = np.concatenate([MM * landmark_errors(one, verdicts[name]) for name, one in found.items()])
    seen = np.concatenate([one.seen for one in found.values()])
    return [Metric("landmarks with data", 100 * float(seen.mean()), "%"),
            Metric("expected error, mean of those", float(errors[seen].mean()) if seen.any() else np.nan, "mm"),
            Metric("expected error, mean of guesses", float(errors[~seen].mean()) if not seen.all() else np.nan, "mm")]
