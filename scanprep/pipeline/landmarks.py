"""`scape prep landmarks`: named landmarks for scans without clicked ones, each with its expected error.

    OUTPUT/NAME.landmarks.json    of each scan, or in another format: the landmarks where the scan has data
    OUTPUT/landmarks.csv          all landmarks of all scans, also those without data, with expected errors
    OUTPUT/set/                   the template on every scan, as `scape prep run` writes it, with its page
"""
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from shlex import quote

import numpy as np
from scipy.spatial import cKDTree

from ..batch.opening import workspace
from ..batch.room import Progress, TaskContext
from ..batch.workspace import NothingMadeError, Task, Workspace
from ..cli import MM, Output, PersonUnit
from ..console import Metric, Outcome, bar
from ..geometry import tables
from ..geometry.files import name_of, read_mesh, read_scan
from ..geometry.landmark_names import landmark_name, translate_landmarks
from ..geometry.landmark_writing import Format, landmark_ending
from ..geometry.landmarks import find_template_landmarks, write_landmarks
from ..geometry.mesh import Mesh, check_template
from ..geometry.surface import OrientedPoints, Surface
from ..geometry.target import orient_by_mesh, target_of
from ..judgement import size
from ..ranges import Axis
from ..registration.lead import lead_of
from ..registration.matches import NORMALS
from ..registration.person import average_person
from ..registration.schedule import RegistrationConfig
from ..registration.unit import resolve_unit
from ..synthetic.landmarks import landmarks as landmarks_of_people
from .cli import ScansArg
from .page import judge_set, judge_whole
from .prepare import PrepareConfig, prepare
from .scan import ScanSettings
from .scans import ScanTask, find_scans

# folder of the registered set and file of the table, inside the output
SET, TABLE = "set", "landmarks.csv"
POINTS = "points/"               # prefix of the names under which landmarks of a scan are kept
# Words in names of landmarks at tips and sharp bends: there the shape fixes a landmark; on smooth skin it slides.
ENDS = {"toe", "heel", "finger", "thumb", "nose", "mouth", "chin", "eye", "ear", "neck"}
# ERRORS: metres, on a body of the size of a man; on six men who are not the template, two of three landmarks were
# nearer than this, at joints and trunk alike. MAN: size of that man, the root of his skin area, in metres.
# ACROSS: errors grow by this share of the distance to the nearest data, measured on poses seen from the front.
# Measured with tests/benchmarks/found_landmarks.py FOLDER --set tuning.
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
        Distance to the nearest place with data; 0 where the scan has data.
    size : float, metres
        Size of the body: the square root of its surface area.
    """

    names: tuple[str, ...]
    points: np.ndarray
    gaps: np.ndarray
    size: float

    @property
    def seen(self) -> np.ndarray:
        """(L,) bool: whether the scan has data at the landmark."""
        return self.gaps == 0


def landmark_scans(scans: ScansArg, output: Output, template: Path | None = None, format: Format = "json",
                   unit: PersonUnit | None = None, up: Axis | None = None, *, space: Workspace) -> Outcome:
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
        format: Of the landmark files: json, csv, pp (MeshLab), mrk.json (3D Slicer).
        unit: Unit of the scans, and of the landmark files; "unknown": it is found together with the person. The table
            is in metres.
        up: The axis of the scans that points up, where it is known.
    """
    tasks = find_scans(scans) if scans.is_dir() else [ScanTask(name_of(scans), scans, subject=name_of(scans))]
    with ExitStack() as bars:
        naming, registering, finding, writing = (bars.enter_context(bar(what)) for what in (
            "finding the parts of a person", "registering scans", "finding landmarks of the template",
            "writing landmarks"))
        body, marks = template_and_landmarks(template, space, finding)
        config = PrepareConfig(ScanSettings(RegistrationConfig(up=up), unit))
        return write_all(tasks, body, marks, config, format, space, registering, naming, writing)


def template_and_landmarks(template: Path | None, space: Workspace, progress: Progress) -> tuple[Mesh, dict[str, int]]:
    """Read a template and its named vertices; a person also gets the built-in landmarks that its file lacks.

    Without a template it is the average of the built-in people. ValueError for one that has no landmarks.
    """
    if template is None:
        return average_person().mesh, landmarks_of_people()
    body = read_mesh(template)
    check_template(body)
    known = find_template_landmarks(template, body)
    named = translate_landmarks(known)
    built_in = space.step("template", body, lambda folder: landmarks_of_person(body, progress))
    # names keep the spelling of the file
    landmarks = known | {name: vertex for name, vertex in built_in.items() if name not in named}
    if not landmarks:
        raise ValueError(f"{template}: expected landmarks in {name_of(template)}.landmarks.json beside it, or the body "
                         "of a person; found neither: click them with scape pick, or leave out --template")
    return body, landmarks


def landmarks_of_person(template: Mesh, progress: Progress) -> dict[str, int]:
    """Find the landmarks of the built-in people on a template, by laying them on it; none where they do not fit."""
    lead = lead_of(template, "auto", progress)
    return {} if lead is None else dict(lead.landmarks)


def write_all(tasks: Sequence[ScanTask], template: Mesh, landmarks: Mapping[str, int], config: PrepareConfig,
              format: Format, space: Workspace, *progress: Progress) -> Outcome:
    """Register a template to scans, and write its landmarks on each scan into an open output.

    Finished scans are not computed again. `progress` are callbacks for scans, for parts of a person, and for files.
    """
    registering, naming, writing = progress or (None, None, None)
    # clicked landmarks are ignored. No subject has this many poses, so no skeleton is found and no model of the set is
    # learned: the landmarks of one scan must not depend on the other scans
    tasks = [replace(task, landmarks=None) for task in tasks]
    config = replace(config, min_poses=10_000_000)
    place = space.folder / SET
    # register the template to all scans, in a set inside the output
    with workspace(place, space.force) as set_space:
        done = prepare(tasks, template, landmarks, place, config, registering, None, naming)
        verdicts = {verdict.name: verdict for verdict in judge_set(place)}
        failed = [task.name for task in tasks if verdicts[task.name].failed]
        if len(failed) == len(tasks) and set_space.is_new and space.is_new:
            raise NothingMadeError(done.failures)

    # a scan that failed now may have landmarks of an earlier run
    for name in failed:
        space.drop(POINTS + name)
    work, meshes = FindPoints(dict(landmarks)), {entry.name: entry.file for entry in done.registered.entries}
    located = space.run(work, [Task(POINTS + task.name, ScanAndBody(
        task.scan, place / meshes[task.name], task.name + landmark_ending(format), config.scan.unit))
        for task in tasks if task.name not in failed], config.workers, writing)

    # like the set, the table also lists the scans of earlier calls
    words = {name: verdict.judgement.verdict for name, verdict in verdicts.items()}
    stored = space.results(work)
    by_scan = {name: stored[POINTS + name] for name in words if POINTS + name in stored}
    with space.staging("table") as staged:
        tables.write_table(staged.folder / TABLE, COLUMNS, list(landmark_rows(by_scan, words)))
    rows = [Metric("scans with landmarks", f"{len(located.values)} of {len(tasks)}"),
            Metric("registered in this run", done.fresh), Metric("landmarks of each", len(landmarks)),
            *error_rows({task.name: by_scan[task.name] for task in tasks if task.name in by_scan}, words),
            Metric("scans that need a look", sum(verdict.suspect for verdict in verdicts.values())),
            Metric("unit assumed", config.scan.unit or "m")]
    return Outcome(space.folder, rows, {"prepare": config}, [*done.failures, *located.failures.values()],
                   judgement=judge_whole(list(verdicts.values()), None),
                   following=f"open {quote(str(place / 'report.html'))}: scans that need a look come first")


@dataclass(frozen=True)
class ScanAndBody:
    """A scan, the registered template, the landmark file to write, and the unit of scan and file."""

    scan: Path
    mesh: Path
    file: str
    unit: str | None


@dataclass(frozen=True, eq=False)
class FindPoints:
    """The work on each registered scan: find the landmarks on it and write them to a file."""

    landmarks: Mapping[str, int]

    def __call__(self, inputs: ScanAndBody, context: TaskContext) -> ScanLandmarks:
        """Find the landmarks of one scan."""
        unit = resolve_unit(inputs.scan, inputs.unit)
        scan, body = read_scan(inputs.scan, unit), read_mesh(inputs.mesh, unit="m")
        points, gaps = points_on_scan(scan, body, np.array(list(self.landmarks.values())))
        landmarks = ScanLandmarks(tuple(self.landmarks), points, gaps, size(body))
        write_landmarks(context.folder / inputs.file, {name: point for name, point, there in zip(
            landmarks.names, points, landmarks.seen, strict=True) if there}, unit)
        return landmarks


def points_on_scan(scan: Mesh | np.ndarray, body: Mesh, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find where vertices of a registered body are on the scan, and how far each is from data.

    Parameters
    ----------
    scan : Mesh or (n, 3) float, metres
        The raw scan.
    body : Mesh
        The template, registered to the scan.
    vertices : (L,) int
        Vertices of the body.

    Returns
    -------
    points : (L, 3) float, metres
        The nearest point of the scan; the body's own vertex where the scan has no data.
    gaps : (L,) float, metres
        Distance to the nearest vertex of the body with data: 0 where there is data, infinite if no vertex has any.

    Examples
    --------
    >>> from scanprep.synthetic.people import SyntheticPerson
    >>> body = SyntheticPerson().mesh
    >>> points, gaps = points_on_scan(body, body, np.array([711, 4616]))
    >>> np.allclose(points, body.vertices[[711, 4616]]), gaps.tolist()
    (True, [0.0, 0.0])
    """
    # only points that face the same way as the body count: the far side of a thin limb is near too
    scale = size(body)
    target = orient_by_mesh(target_of(scan), body, NORMALS * scale)
    # beyond a hundredth of the body's size there is no data, as in `Registration.uncovered`
    match = OrientedPoints(target.points, target.normals, NORMALS * scale).match(
        body.vertices, body.vertex_normals, 0.01 * scale)
    seen, points = match.valid[vertices], body.vertices[vertices]
    gaps = np.where(seen, 0.0, np.inf)
    if match.valid.any():
        gaps[~seen] = cKDTree(body.vertices[match.valid]).query(points[~seen])[0]
    if isinstance(scan, Mesh) and len(scan.faces):
        # a mesh gives the exact nearest place, a point cloud its nearest point
        points[seen] = Surface(scan).closest(points[seen]).points
    else:
        points[seen] = target.points[match.index[vertices][seen]]
    return points, gaps


def place_of(name: str) -> str:
    """Return whether a landmark is at an "end" of the body or on smooth "skin"; an unknown name is on skin.

    Examples
    --------
    >>> place_of("Rt. Dactylion"), place_of("left knee")
    ('end', 'skin')
    """
    return "end" if set(landmark_name(name).split()) & ENDS else "skin"


def landmark_errors(landmarks: ScanLandmarks, verdict: str) -> np.ndarray:
    """Compute the expected error of each landmark, (L,) metres, mostly along the skin: two of three are nearer.

    The error is relative to where the template's landmark belongs on that body. People who click disagree about
    that place, so distances to clicks are larger. `verdict` is the one on the scan: "good" or "check".
    """
    # without data an end is not fixed by shape either: hands seen from the front came out short
    places = np.where(landmarks.seen, [place_of(name) for name in landmarks.names], "skin")
    errors = np.array([ERRORS[place] for place in places]) * landmarks.size / MAN + ACROSS * landmarks.gaps
    # a doubtful registration may have a limb or the head in the wrong place
    return errors * (2.0 if verdict == "check" else 1.0)


def landmark_rows(by_scan: Mapping[str, ScanLandmarks], verdicts: Mapping[str, str]) -> Iterator[tuple[object, ...]]:
    """Yield the rows of the table of all landmarks, metres, sorted by scan."""
    for scan in sorted(by_scan):
        landmarks = by_scan[scan]
        errors = MM * landmark_errors(landmarks, verdicts[scan])
        for name, point, error, seen in zip(landmarks.names, landmarks.points, errors, landmarks.seen, strict=True):
            yield (scan, name, *(f"{value:.6f}" for value in point), f"{error:.0f}", "seen" if seen else "guessed",
                   verdicts[scan])


def error_rows(by_scan: Mapping[str, ScanLandmarks], verdicts: Mapping[str, str]) -> list[Metric]:
    """Return the rows of the closing table about data and expected errors."""
    if not by_scan:
        return []
    errors = np.concatenate([MM * landmark_errors(landmarks, verdicts[name]) for name, landmarks in by_scan.items()])
    seen = np.concatenate([landmarks.seen for landmarks in by_scan.values()])
    return [Metric("landmarks with data", 100 * float(seen.mean()), "%"),
            Metric("expected error, mean of those", float(errors[seen].mean()) if seen.any() else np.nan, "mm"),
            Metric("expected error, mean of guesses", float(errors[~seen].mean()) if not seen.all() else np.nan, "mm")]
