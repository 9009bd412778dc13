"""One scan of a folder: read it, register the template, measure the result, take its picture."""
from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from ..batch.room import Progress, TaskContext
from ..cleaning.clean_scan import CleanScanConfig, clean_scan, take_clutter
from ..correspondence.search import CorrelatedConfig
from ..geometry.files import read_scan, write_mesh
from ..geometry.landmarks import check_on_surface, read_landmarks, try_match_landmarks
from ..geometry.mesh import Mesh
from ..plausible import WrongScaleError, check_unit, implausible_body
from ..ranges import FLAG, Settings
from ..registration.figures import ScanFigures, figures_of
from ..registration.ground import with_soles
from ..registration.lead import Lead
from ..registration.limbs import PlausibilityIssue, find_exchanged_sides, hidden_doubts, limb_doubts
from ..registration.nonrigid import LedRegistration, register, registration_problem
from ..registration.person import PersonParts, stature
from ..registration.repair import repair_limbs
from ..registration.schedule import RegistrationConfig
from ..registration.unit import resolve_unit
from ..registration.unmarked import doubt_worn, register_by_any
from ..registration.verdict import explain_by_landmarks
from ..threads import one_thread
from .rivals import RIVALS, TWO_BODIES, rival_file, save_figures
from .scans import ScanTask

Landmarks = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class ScanSettings(Settings):
    """How one scan is registered.

    Attributes
    ----------
    registration : RegistrationConfig
    unit : 'm', 'mm', 'cm', 'in' or 'unknown', optional
        Of the scan and its landmarks, where the files cannot tell; 'unknown': it is found together with the person.
    through : str
        What leads the template to scans without landmarks, or with fewer than seven: 'auto', the built-in people where
        the template is a person; the file of a model; 'none', correspondences; or 'pose', nothing on any scan, all of
        which must be near the template's pose.
    correspondences : CorrelatedConfig
        How correspondences are found.
    clean : CleanScanConfig, optional
        Take floor, furniture and specks off the scan before. Without it scans that have no landmarks are cleaned too,
        where a fifth of the points at most is taken off.
    """

    registration: RegistrationConfig = field(default_factory=RegistrationConfig)
    unit: Annotated[Literal["m", "mm", "cm", "in", "unknown"] | None, FLAG] = None
    through: Annotated[str, FLAG] = "auto"
    correspondences: CorrelatedConfig = field(default_factory=CorrelatedConfig)
    clean: CleanScanConfig | None = None


@dataclass(frozen=True, eq=False)
class RegisteredScan:
    """The result of registering one scan."""

    vertices: np.ndarray            # (N, 3), metres
    figures: ScanFigures
    picture: bytes                  # strip of small pictures as WebP
    scene: bytes                    # the same for the browser
    rival: RegisteredScan | None = None     # second body that explains the scan equally well


def register_scan(task: ScanTask, template: Mesh, template_landmarks: dict[str, int], settings: ScanSettings,
                  parts: PersonParts | None = None, progress: Progress | None = None, lead: Lead | None = None
                  ) -> RegisteredScan:
    """Read and register one scan, and repair twisted limbs where the template has the parts of a person.

    A `lead` finds the body on scans without landmarks, or with few.

    Raises
    ------
    ValueError
        Files that cannot be read, the wrong unit, or a registration that does not lie on the scan.
    """
    start = time.perf_counter()
    with one_thread():
        unit = resolve_unit(task.scan, settings.unit)
        scan, removed = read_scan(task.scan, unit), 0.0
        check_unit(scan, template.vertices, f"{task.scan}: it is")
        landmarks = None if settings.through == "pose" else _landmarks(task, scan, template_landmarks, unit)
        # remove floor and clutter, if asked for or if there are no landmarks to keep the body apart
        if settings.clean is not None:
            cleaned = clean_scan(scan, settings.clean, None if landmarks is None else landmarks[1])
            scan, removed = cleaned.scan, 1 - float(cleaned.kept.mean())
        elif landmarks is None and settings.through != "pose":
            scan, removed = take_clutter(scan)
        # register: from the template's own pose, or led by landmarks, a model or correspondences
        if settings.through == "pose":
            fit = register(template, scan, None, settings.registration, progress)
            if not registration_problem(template, scan, fit, marked=False):
                fit = repair_limbs(template, scan, fit, parts, None, settings.registration)
            led = LedRegistration(fit, "pose")
        else:
            try:
                led = register_by_any(template, scan, landmarks, lead, parts, settings.registration,
                                      settings.correspondences, progress, task.model)
            except WrongScaleError as error:
                raise WrongScaleError(f"{task.scan}: {error}") from None
            except ValueError as error:
                raise ValueError(f"{error} (landmarks beside the scan need no ends of limbs)") from None
        # refuse a registration that is not on the scan, or has left and right limbs exchanged; landmarks that are wrong
        # are the cause, which comes first
        wrong = explain_by_landmarks(template, scan, led.fit, landmarks, template_landmarks, parts,
                                     settings.registration)
        problem = registration_problem(template, scan, led.fit, landmarks is not None) or (
            None if parts is None else find_exchanged_sides(template, parts, led.fit.mesh.vertices))
        if problem:
            raise ValueError(f"{task.scan}: {f'{wrong}: ' if wrong else ''}the template is not on it: {problem}")
        registered = finish_scan(task.name, template, scan, led, parts, removed)
        doubts = (*([] if wrong is None else [PlausibilityIssue(100.0, wrong)]), *registered.figures.doubts,
                  *([] if registered.rival is None else [TWO_BODIES]))
    return replace(registered, figures=replace(registered.figures, doubts=doubts, seconds=time.perf_counter() - start))


def finish_scan(name: str, template: Mesh, scan: Mesh | np.ndarray, led: LedRegistration, parts: PersonParts | None,
                removed: float) -> RegisteredScan:
    """Press the soles to the floor, measure the registration and take its picture; the same for its rival."""
    from .page import pictures_of

    fit = with_soles(template, scan, led.fit, parts)
    picture, scene = pictures_of(template, scan, fit)
    doubts = () if parts is None else (*limb_doubts(template, parts, fit.mesh.vertices),
                                       *hidden_doubts(parts, fit.mesh, fit.seen),
                                       *size_doubts(template, parts, fit.mesh.vertices), *doubt_worn(led.worn))
    figures = replace(figures_of(name, led.way, template, fit), removed=removed, doubts=doubts)
    rival = None if led.rival is None else finish_scan(name, template, scan, led.rival, parts, removed)
    return RegisteredScan(fit.mesh.vertices, figures, picture, scene, rival)


@dataclass(frozen=True, eq=False)
class RegisterScan:
    """The work on each scan: register the template to it."""

    template: Mesh
    landmarks: Mapping[str, int]
    settings: ScanSettings
    parts: PersonParts | None = None         # of the template, where it is a person
    # finds bodies on scans with few or no landmarks; not in the digest, as it follows from template and settings
    lead: Lead | None = field(default=None, metadata={"digest": False})

    def __call__(self, task: ScanTask, context: TaskContext) -> ScanFigures:
        """Register one scan and write its files; return the figures."""
        registered = self.register(task, context)
        self.write(context.folder, task.name, registered)
        return registered.figures

    def register(self, task: ScanTask, context: TaskContext) -> RegisteredScan:
        """Register the template to a scan."""
        return register_scan(task, self.template, dict(self.landmarks), self.settings, self.parts,
                             context.report_progress,
                             self.lead)

    def write(self, folder: Path, name: str, registered: RegisteredScan) -> None:
        """Write mesh and pictures of a scan into a folder, and those of its rival with its figures."""
        from .page import PICTURES

        write_mesh(folder / mesh_file(name), self.template.with_vertices(registered.vertices))
        write_pictures(folder / PICTURES, name, registered)
        if registered.rival is not None:
            write_mesh(folder / rival_file(name), self.template.with_vertices(registered.rival.vertices))
            write_pictures(folder / RIVALS, name, registered.rival)
            save_figures(folder, registered.rival.figures, chosen=False)


def write_pictures(folder: Path, name: str, registered: RegisteredScan) -> None:
    """Write the pictures of a scan into a folder."""
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.webp").write_bytes(registered.picture)
    (folder / f"{name}.scene").write_bytes(registered.scene)


def mesh_file(name: str) -> str:
    """Return the path of a scan's mesh inside a set."""
    return f"meshes/{name}.ply"


def size_doubts(template: Mesh, parts: PersonParts, vertices: np.ndarray) -> tuple[PlausibilityIssue, ...]:
    """Return what is implausible in the size of a person, from the template's vertices (N, 3), metres, on the scan."""
    sized = implausible_body(stature(template, parts, vertices))
    return tuple(PlausibilityIssue(2.0 if sized.problems else 1.0, reason) for reason in sized.reasons)


def _landmarks(task: ScanTask, scan: Mesh | np.ndarray, template_landmarks: dict[str, int], unit: str | None
               ) -> Landmarks | None:
    """Return vertices of the template and points of the scan that correspond, or None where there are too few."""
    if task.landmarks is None:
        return None
    points = read_landmarks(task.landmarks, scan, unit)
    check_on_surface(task.landmarks, points, scan.vertices if isinstance(scan, Mesh) else scan)
    return try_match_landmarks(task.landmarks, template_landmarks, points)
