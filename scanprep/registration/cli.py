"""`scape prep align`, `correspond` and `register`: one mesh onto another."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from ..alignment.icp import RigidConfig, align_landmarks, align_rigid, alignment_problem
from ..arguments import Place
from ..cleaning.clean_scan import take_clutter
from ..cli import MM, MeshArg, Output, PersonUnit, ScanArg, Unit
from ..console import Metric, Outcome, bar
from ..correspondence.correlated import find_correspondences
from ..correspondence.correspondences import read_correspondences, write_correspondences
from ..correspondence.search import CorrelatedConfig
from ..geometry.files import read_mesh, read_scan, write_mesh
from ..geometry.landmarks import (
    find_template_landmarks,
    landmarks_beside,
    match_landmarks,
    read_landmarks,
    read_template_landmarks,
    try_match_landmarks,
)
from ..geometry.mesh import Mesh
from ..judgement import Judgement
from ..plausible import check_unit
from .ground import soles_row, with_soles
from .lead import lead_of
from .matches import Landmarks
from .nonrigid import LedRegistration, register
from .person import person_parts
from .repair import repair_limbs
from .schedule import RegistrationConfig
from .unit import resolve_unit
from .unmarked import FEW, register_by_any
from .verdict import explain_by_landmarks, judge_registration


def align(source: MeshArg, target: Annotated[Path, Place("TARGET")], output: Output, landmarks: Path | None = None,
          unit: Unit | None = None, config: RigidConfig = RigidConfig()) -> Outcome:
    """Move a mesh rigidly onto another: by landmarks where both have them, then by their surfaces.

    Example: scape prep align front.ply back.ply -o front_aligned.ply

    Args:
        source: Mesh to move.
        target: Mesh that stays.
        output: Mesh to write, the moved one.
        landmarks: Landmarks of the mesh that is moved, with the names of those that lie beside the target.
        unit: Unit of both meshes and of their landmarks.
        config: Settings.
    """
    moving, fixed = read_mesh(source, unit), read_mesh(target, unit)
    T = np.eye(4)
    if landmarks:
        beside = landmarks_beside(target)
        if beside is None:
            raise ValueError(f"{landmarks}: {target} has no landmarks; expected a file of its name beside it")
        _, source_points, target_points = match_landmarks(read_landmarks(landmarks, moving, unit),
                                                          read_landmarks(beside, fixed, unit))
        T = align_landmarks(source_points, target_points).T_target_source
    # refine by the surfaces, from where the landmarks put the mesh
    placed = moving.with_vertices(moving.vertices @ T[:3, :3].T + T[:3, 3])
    alignment = align_rigid(placed, fixed, config=config)
    T = alignment.T_target_source @ T
    write_mesh(output, moving.with_vertices(moving.vertices @ T[:3, :3].T + T[:3, 3]))
    return Outcome(output, [
        Metric("RMS distance", MM * alignment.rms, "mm"), Metric("converged", str(alignment.converged)),
        Metric("T_target_source", np.array2string(T, precision=6).replace("\n", " "))], {"align": config},
                   judgement=Judgement.of(alignment_problem(moving.vertices, fixed.vertices, alignment),
                                          [] if alignment.converged else [
            f"it did not converge, at {MM * alignment.rms:.0f} mm RMS: a start far from the target?"]))


def _read_landmarks(template: Path, body: Mesh, scan: Path, data: Mesh | np.ndarray, landmarks: Path | None,
                    template_landmarks: Path | None, unit: str | None) -> tuple[Landmarks | None, list[Metric]]:
    """Read the landmarks that template and scan share, and the table rows that report them.

    The scan's landmarks come from the named file, else from the file beside the scan; the word none means no landmarks.
    """
    file = None if landmarks == Path("none") and not landmarks.exists() else landmarks or landmarks_beside(scan)
    if file is None:
        return None, [Metric("landmarks", 0)]
    known = read_landmarks(file, data, unit)
    pairs = try_match_landmarks(file, read_template_landmarks(template, body, template_landmarks), known
                                ) if known else None
    return pairs, [Metric("landmarks", len(pairs[0]) if pairs else 0), Metric("landmark file", file.name)]


def correspond(scan: ScanArg, template: Path, output: Output, landmarks: Path | None = None,
               template_landmarks: Path | None = None, unit: PersonUnit | None = None,
               config: CorrelatedConfig = CorrelatedConfig()) -> Outcome:
    """From a few landmarks, or none, to nearly two hundred pairs of places on template and scan.

    Example: scape prep correspond scan.ply --template template.ply --landmarks scan.json -o pairs.json

    Args:
        scan: Mesh or point cloud.
        template: Mesh to find on the scan.
        output: JSON file of vertices of the template, points of the scan in metres, and confidence.
        landmarks: Landmarks of the scan: three at least, spread over the body; else the file of its name beside it.
            With none, or the word none, the ends of the limbs are looked for.
        template_landmarks: Landmarks of the template; else the file of its name beside it.
        unit: Unit of the scan and its landmarks; "unknown": it is found together with the person.
        config: Settings.
    """
    body, units = read_mesh(template), resolve_unit(scan, unit)
    data = read_scan(scan, units)
    check_unit(data, body.vertices, f"{scan}: it is")
    pairs, led_by = _read_landmarks(template, body, scan, data, landmarks, template_landmarks, units)
    with bar("finding correspondences") as progress:
        pairs_found = find_correspondences(body, data, pairs, config, progress)
    write_correspondences(output, pairs_found)
    return Outcome(output, [
        Metric("method", pairs_found.method), *led_by, Metric("correspondences", len(pairs_found)),
        Metric("confidence, median", float(np.median(pairs_found.confidence))),
        Metric("converged", str(pairs_found.converged))], {"correspond": config},
                   judgement=pairs_found.judgement)


def register_one(scan: ScanArg, template: Path, output: Output, landmarks: Path | None = None,
                 template_landmarks: Path | None = None, through: str = "auto", unit: PersonUnit | None = None,
                 config: RegistrationConfig = RegistrationConfig()) -> Outcome:
    """Bend the template onto one scan.

    Example: scape prep register scan.ply --template template.ply --landmarks scan.json -o registered.ply

    Args:
        scan: Mesh or point cloud.
        template: Mesh to bring onto it.
        output: Mesh to write.
        landmarks: Landmarks of the scan; else the file of its name beside it, where no correspondences are given;
            the word none leaves it out.
        template_landmarks: Landmarks of the template; else the file of its name beside it.
        through: What leads the template where landmarks are fewer than seven: a model file that finds the body on the
            scan; auto, the built-in people where the template is a person, else pose; a .json file of
            scape prep correspond; none, correspondences; pose: without landmarks it must be near the template's pose.
        unit: Unit of the scan and its landmarks; "unknown": it is found together with the person.
        config: Settings.
    """
    body, units = read_mesh(template), resolve_unit(scan, unit)
    data = read_scan(scan, units)
    check_unit(data, body.vertices, f"{scan}: it is")
    correspondence_file = Path(through) if through.endswith(".json") else None
    pairs, led_by = (None, [Metric("landmarks", 0)]) if correspondence_file and landmarks is None else _read_landmarks(
        template, body, scan, data, landmarks, template_landmarks, units)
    # with too few landmarks a body model proposes where the body is
    lead = None
    if correspondence_file is None and through != "pose" and (pairs is None or len(pairs[0]) < FEW):
        with bar("laying the model on the template") as progress:
            lead = lead_of(body, through, progress)
    # a model of people knows the body parts already
    parts = None if lead is None else lead.parts
    if parts is None:
        with bar("finding the parts of a person") as progress:
            parts = person_parts(body, progress)
    # register: from the pose as it is or from correspondences; else led by the model or few landmarks
    rival: LedRegistration | None = None
    worn: tuple[str, ...] = ()
    if correspondence_file or through == "pose" or (pairs is None and lead is None and through == "auto"):
        hints = read_correspondences(correspondence_file) if correspondence_file else None
        with bar("registering") as progress:
            fit = register(body, data, pairs, config=config, progress=progress, correspondences=hints)
        with bar("trying other rolls of limbs") as progress:
            fit = repair_limbs(body, data, fit, parts, pairs, config, progress, hints)
    else:
        if pairs is None:
            data, removed = take_clutter(data)
            led_by.append(Metric("points of the scan taken off as clutter", 100 * removed, "%"))
        with bar("registering") as progress:
            led = register_by_any(body, data, pairs, lead, parts, config, progress=progress)
        fit, rival, worn = led.fit, led.rival, led.worn
        led_by.append(Metric("led by", led.way))
    # rest the soles on the floor if the scan ends flat there
    fit = with_soles(body, data, fit, parts)
    known = find_template_landmarks(template, body, template_landmarks)
    wrong = explain_by_landmarks(body, data, fit, pairs, known, parts, config)
    write_mesh(output, fit.mesh)
    return Outcome(output, [
        *led_by, Metric("distance to the scan, RMS", MM * fit.rms, "mm"),
        Metric("surface with data", 100 * fit.measured, "%"),
        Metric("confidence, mean", float(fit.confidence.mean())),
        Metric("scan off the template", 100 * fit.uncovered, "%"),
        Metric("distance of landmarks, RMS", MM * fit.landmark_rms, "mm"),
        Metric("inverted triangles", fit.inverted), Metric("limbs rolled otherwise", str(fit.rolled)),
        *soles_row(fit.soles),
        Metric("converged", str(fit.converged))], {"register": config},
                   judgement=judge_registration(scan.name, body, data, fit, pairs, parts, rival is not None, worn,
                                                    wrong))
