"""The commands of `scape statue`: one scan of one person becomes a character that moves, with all its detail."""
from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from shlex import quote

import numpy as np

from scanprep.arguments import UsageError
from scanprep.batch.pool import Workers
from scanprep.batch.room import TaskContext
from scanprep.batch.workspace import HOME, Task, Workspace
from scanprep.cleaning.clean_scan import clean_scan, cleaning_doubts
from scanprep.cli import MM, Output, PersonUnit, ScanArg
from scanprep.console import Metric, Outcome, bar, judgement_of, judgement_row, write_report
from scanprep.folders import FolderCommand, do_one, figure
from scanprep.geometry.files import name_of, write_mesh
from scanprep.geometry.format_common import UNITS, metres_of
from scanprep.geometry.landmark_names import FACE
from scanprep.geometry.landmark_writing import CLICKED_JOINTS
from scanprep.geometry.landmarks import write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.sanitise import sanitise
from scanprep.judgement import Judgement
from scanprep.pictures.sheets import save_png
from scanprep.pictures.textures import Texture, read_texture
from scanprep.pipeline.scans import ScanTask, find_scans
from scanprep.ranges import Positive
from scanprep.registration.unit import resolve_unit
from scanprep.surfaces.cloud import read_sound_surface

from ..body import Progress, share_progress
from ..export.names import Names, names_of
from .cli import LevelArg, MotionArg, StatueArg
from .control.files import humanoid, read_control
from .control.model import ControlModel
from .detail.displacement import coverage_shares
from .detail.reconstruction import (
    Reconstruction,
    displace_surface,
    find_inverted,
    in_folds,
    measure_levels,
    remaining_error,
)
from .detail.subdivision import divide_long_edges, subdivide_adaptive, subdivide_uniform
from .detail.texels import bake_texture, scan_look
from .files import BODY, body_model, load_statue, save_statue, write_body, write_for_programs, write_statue_glb
from .fit import FittedStatue, StatueConfig, UnplacedError, fit_statue
from .motion.motions import read_statue_motion, write_body_motion
from .outer import cut_plinth, find_plinth, keep_outer
from .own_mesh import OWN_MESH, animate_own_mesh, read_pieces, write_own_mesh
from .registration.automatic import nearest_unit, person_unit
from .registration.clicks import read_features
from .report import in_motion, parts_without_data, statue_page, statue_picture
from .verdict import judge_statue

FEATURES = "features.json"           # joints and points of the face of a statue, to be mended in scape pick --joints
LEFT_BY_MAP = "error left by the map where it is one-to-one, mean"
SPLIT = 60        # longest side of triangles in the height of a figure: 3 cm on a person, as floors are near soles
FINE = StatueConfig(size=2048)


def fit(scan: ScanArg, output: Output, features: Path | None = None, control: Path | None = None,
        unit: PersonUnit | None = None, cut: Positive | None = None, own_mesh: bool = False, names: Names | None = None,
        config: StatueConfig = FINE, workers: Workers = Workers(), *, space: Workspace) -> Outcome:
    """A scan of one person becomes a statue: a control model that moves, with the detail of the scan as an image.

    A person who stands upright is found by itself. For other poses and other bodies, name joint centres and points of
    the face with --features. A folder of scans is fitted scan by scan, each into a folder of its name.

    Example: scape statue fit scan.ply -o statue

    Args:
        scan: Mesh of the whole body, or a folder of such scans.
        output: Folder to write: control.npz, displacement.png and .tif, texture.png, statue.glb, report.html.
        features: Joint centres and points of the surface by name, any landmark file; for a folder of scans, the folder
            of such files.
        control: Control model of your own: a skinned GLB, or control.npz of another statue; else the generic humanoid.
        unit: Unit of the scan and the features; "unknown": it is found together with the person. Else that in which
            the body would be as tall as a person, and metres with --control.
        cut: Height of a plinth above the lowest point of the scan, in the numbers of its file; what lies below is left
            out. Up is the axis along which the scan is longest. Else a plinth is found where it is a clear block.
        own_mesh: Write own.glb too: the file's own vertices, materials and textures on the skeleton.
        names: Whose names the bones of own.glb have: mixamo, unity, unreal, vrm, h-anim or opensim.
        workers: Who fits the scans of a folder.
    """
    if names and not own_mesh:
        raise UsageError("--names: expected --own-mesh with it; scape statue animate gives statue.glb other names")
    work = Work(humanoid() if control is None else read_control(control), config, unit, cut, own_mesh, names, output)
    if names:
        names_of(work.control.skeleton, names)                       # a horse has none: said before the fit
    if not scan.is_dir():
        if features is None and control is not None:
            raise UsageError("--control: expected --features with joints of that control model, as only the generic "
                             "humanoid is found by itself; write the names of some into names.txt and click them: "
                             "scape pick SCAN --joints --names names.txt. It has "
                             f"{', '.join(work.control.skeleton.names)}")
        return do_one("fitting the statue", space, work, Task("statue", ScanTask("statue", scan, features)),
                      {"statue": config}, f"open {quote(str(output / 'report.html'))}; if joints are in wrong places: "
                      f"scape pick {quote(str(scan))} --joints --start {quote(str(output / FEATURES))}; "
                      f"a BVH file of yours moves it: scape statue animate {quote(str(output))} walk.bvh -o walking")
    if features is not None and not features.is_dir():
        raise UsageError(f"--features: expected a folder for a folder of scans, got {features}")
    tasks = [Task(one.name, one if features else replace(one, landmarks=None), one.name)
             for one in find_scans(scan, features)]
    work = replace(work, command=f"scape statue fit {scan}")
    return FolderCommand(
        ("scan",), "{} fitted", lambda results, count: [Metric("scans", count), Metric("statues", len(results.values))],
        lambda rows: figure(rows, LEFT_BY_MAP), {"statue": config},
    ).carry_out("fitting statues", space, work, tasks, workers)


@dataclass(frozen=True, eq=False)
class Work:
    """What the scans of one call have in common."""

    control: ControlModel
    config: StatueConfig
    unit: str | None = None                                       # of scans and features, where files cannot tell
    cut: float | None = None                                      # height of a plinth, in the numbers of the file
    own_mesh: bool = False                                        # whether own.glb is written
    names: Names | None = None                                    # of its bones
    output: Path = field(default=Path(), metadata={"digest": False})
    command: str = field(default="", metadata={"digest": False})  # for the report of each scan of a folder

    def __call__(self, inputs: ScanTask, context: TaskContext) -> list[Metric]:
        """Fit the statue of some files into the folder of a room; the figures."""
        start = time.perf_counter()
        context.report_progress(0, 100)
        if self.own_mesh:                    # what cannot be written is said before the fit
            read_pieces(inputs.scan, 2, 1.0)
        unit = resolve_unit(inputs.scan, self.unit)
        person = self.control.skeleton.names == humanoid().skeleton.names
        scan, texture, rows, doubts, metres = read_scan(inputs, unit, person, self.cut)
        scale = metres / metres_of(unit)     # what the unit of the file was multiplied by
        joints = points = None
        if inputs.landmarks is not None:
            joints, points = read_features(inputs.landmarks, self.control, scan, unit, scale)
            rows += [Metric("joints given", len(joints)), Metric("surface points given", len(points))]
            if len(joints) + len(points) < 3:
                raise ValueError(f"{inputs.landmarks}: expected at least three joints or points, got "
                                 f"{len(joints) + len(points)}; click more: {_pick(inputs.scan)}")
        try:
            statue = fit_statue(scan, joints, points, self.control, self.config,
                                share_progress(context.report_progress, 5, 80), context.step)
        except UnplacedError as error:
            # a part of a person is shorter than a person: then a usual unit may be right
            nearest = nearest_unit(scan.vertices / metres)
            if unit is None and person and metres != UNITS[nearest]:
                return replace(self, unit=nearest)(inputs, context)
            # a result that failed leaves no file: what was found lies with the records of the output
            found = {name: place / scale for name, place in {**error.features.joints, **error.features.points}.items()}
            file = self.output / HOME / "refused" / f"{name_of(inputs.scan)}.json"
            if found:
                write_landmarks(file, found, unit)
            clicked = inputs.scan.with_name(name_of(inputs.scan) + CLICKED_JOINTS)
            raise ValueError(f"{inputs.scan}: {str(error).removeprefix('scan: ')}; click its joints: "
                             f"{_pick(inputs.scan, file if found else None)}, then fit it with --features "
                             f"{quote(str(clicked))}") from None
        if texture is not None or scan.colors is not None:
            image = context.step("texture", (self, inputs), lambda: bake_texture(
                statue.control, statue.map, scan_look(texture or scan)))
            statue = replace(statue, texture=image)
        metrics = write_statue(context.folder, inputs.scan.name, scan, statue, rows, doubts,
                               share_progress(context.report_progress, 80, 100))
        write_landmarks(context.folder / FEATURES, {name: place / scale for name, place in features_of(statue).items()},
                        unit)
        if self.own_mesh:
            metrics += write_own_mesh(context.folder / OWN_MESH, inputs.scan, metres, statue, self.names)
        if self.command:
            write_report(Outcome(context.folder, metrics, {"statue": self.config}, judgement=judgement_of(metrics)),
                         self.command, time.perf_counter() - start)
        return metrics


def _pick(scan: Path, start: Path | None = None) -> str:
    """Return the command that opens a scan to click its joints, beginning with those of a file."""
    if start is None:
        return f"scape pick {quote(str(scan))} --joints"
    return f"scape pick {quote(str(scan))} --joints --start {quote(str(start))}"


def features_of(statue: FittedStatue) -> dict[str, np.ndarray]:
    """Return joint centres and points of the face of a statue (3,), metres: a start to mend them from."""
    control = statue.control
    joints = dict(zip(control.skeleton.names[1:], control.skeleton.joints[1:], strict=True))
    return joints | {name: control.mesh.vertices[control.landmarks[name]] for name in FACE if name in control.landmarks}


def write_statue(folder: Path, name: str, scan: Mesh, statue: FittedStatue, rows: list[Metric],
                 doubts: Sequence[str] = (), progress: Progress | None = None) -> list[Metric]:
    """Write a statue with its files for other programs and its page; the figures."""
    posed, surface, control = statue.posed, statue.surface, statue.control
    assert posed is not None and surface is not None, "made by fit_statue"
    save_statue(folder, statue)
    report_progress = progress or (lambda done, total: None)
    levels, fine = measure_levels(statue, scan)
    report_progress(1, 3)
    write_mesh(folder / "reconstruction.ply", levels[-1].mesh)
    write_body(folder, statue)
    write_for_programs(folder, statue, levels[-1].mesh.vertices, fine, statue.upright_axis)
    report_progress(2, 3)
    # 1. how well the control model was registered to the scan
    rows = [judgement_row(judge_statue(statue, scan, levels[-1], doubts)), *rows,
            *([Metric("not seen in the scan", ", ".join(posed.missing))] if posed.missing else []),
            *([Metric("look at it", posed.problem)] if posed.problem else []),
            Metric("points of the face that shaped the head", posed.face),
            Metric("joints of the posed control model to the features, RMS", MM * posed.features.joint_rms, "mm"),
            Metric("surface points of it, RMS", MM * posed.features.point_rms, "mm"),
            Metric("control mesh to the scan, RMS", MM * surface.rms, "mm"),
            Metric("inverted triangles of the control mesh", surface.inverted)]
    # 2. what the map holds, and how far the reconstructed surface is from the scan
    shares, lacking = coverage_shares(control, statue.map), parts_without_data(statue)
    errors = remaining_error(control, statue.map, scan)
    left = float(errors.mean()) if len(errors) else np.nan
    inverted = find_inverted(control, control.mesh.vertices, fine, levels[-1].mesh.vertices)
    outside = ~in_folds(control, statue.map, fine)[inverted]
    rows += [Metric("one-to-one", 100 * shares["measured"], "% of the surface"),
             Metric("folded", 100 * shares["folded"], "% of the surface"),
             Metric("holes", 100 * shares["hole"], "% of the surface"),
             *([Metric("parts without data", ", ".join(lacking))] if lacking else []),
             Metric(LEFT_BY_MAP, MM * left, "mm"),
             *(Metric(f"{one.name} to the scan, {what}", MM * value, "mm") for one in levels
               for what, value in (("mean", one.mean), ("RMS", one.rms))),
             Metric(f"inverted triangles at {levels[-1].name}", len(inverted)),
             Metric("of these outside folds and holes", int(outside.sum()))]
    picture = statue_picture(scan, statue, levels[-1])
    save_png(folder / "picture.png", picture)
    statue_page(name, scan, statue, levels, rows, in_motion(statue), picture).write(folder / "report.html")
    report_progress(3, 3)
    return rows


def read_scan(inputs: ScanTask, unit: str | None, person: bool = True, cut: float | None = None
              ) -> tuple[Mesh, Texture | None, list[Metric], list[str], float]:
    """Read the body of a scan and its texture in metres, with figures, doubts of the cleaning, and metres a unit.

    Without a unit it is the one in which a person is as tall as a person, and where none gives such a size the body is
    brought to 1.7 m; anything else than a person is in metres. `cut` is the height of a plinth in the file's numbers.
    """
    sought = unit is None and person
    unit = unit or "m"
    scan, texture = read_sound_surface(inputs.scan, unit), read_texture(inputs.scan, unit)
    rows = [Metric("scan, triangles", len(scan.faces))]
    scan, inside = keep_outer(scan)
    if inside:
        rows.append(Metric("inside the surface, left out", 100 * inside, "% of the surface"))
    # what follows looks at vertices: a plinth of twelve triangles needs more of them
    scan = divide_long_edges(scan, float(np.ptp(scan.vertices, axis=0).max(initial=0)) / SPLIT)
    plinth = find_plinth(sanitise(scan)) if cut is None else cut * metres_of(unit)
    if plinth is not None:
        scan, cut_off = cut_plinth(scan, plinth)
        rows.append(Metric("plinth, left out", 100 * cut_off, "% of the surface"))
    metre = person_unit(scan.vertices)[0] if sought else 1.0
    cleaned = clean_scan(scan.with_vertices(metre * scan.vertices))
    doubts = cleaning_doubts(cleaned)
    body = cleaned.mesh
    if sought:                               # guess again from the body alone, since a floor may have any size
        likely, words = person_unit(body.vertices / metre)
        body, metre = body.with_vertices(likely / metre * body.vertices), likely
        rows.append(Metric("unit of the scan", words))
    left = 1 - float(cleaned.kept.mean())
    if left > 0:
        rows.append(Metric("left out as floor, furniture, specks", 100 * left, "% of the points"))
    return body, texture and texture.scale_by(metre), rows, doubts, metres_of(unit) * metre


def reconstruct(statue: StatueArg, output: Output, level: LevelArg = 3, tolerance: Positive | None = None,
                image: Path | None = None) -> Outcome:
    """The surface of a statue with its detail, as a mesh at any level.

    Example: scape statue reconstruct statue --level 4 -o detailed.ply

    Args:
        statue: Folder of scape statue fit.
        output: Mesh to write; a .glb hangs on the skeleton and has the texture.
        level: How often the triangles of the control mesh are divided by four.
        tolerance: Divide only where the detail is off by more than this, millimetres; at most as often as the level.
        image: Edited copy of the statue's displacement.png, of the same size and depth.
    """
    loaded = load_statue(statue, image)
    control = loaded.control
    fine = subdivide_uniform(control.mesh, control.chart, level) if tolerance is None else subdivide_adaptive(
        control.mesh, control.chart, displace_surface(control, loaded.map), tolerance / MM, level)
    mesh = Reconstruction(control, loaded.map, fine).mesh()
    if output.suffix.lower() == ".glb":
        write_statue_glb(output, control, mesh.vertices, fine, loaded.texture, up=loaded.upright_axis)
    else:
        write_mesh(output, mesh)
    rows = [Metric("vertices", len(mesh.vertices)), Metric("triangles", len(mesh.faces)),
            Metric("closed", "yes" if mesh.is_closed else "no")]
    if image is not None:
        before = Reconstruction(control, load_statue(statue).map, fine)(control.mesh.vertices)
        moved = np.linalg.norm(mesh.vertices - before, axis=1)
        rows += [Metric("vertices moved by the edited image", int((moved > 1e-6).sum())),
                 Metric("largest of these moves", MM * float(moved.max()), "mm")]
    return Outcome(output, rows, judgement=Judgement())


def animate(statue: StatueArg, motion: MotionArg, output: Output, rate: Positive | None = None, level: LevelArg = 2,
            meshes: bool = False, own_mesh: bool = False, names: Names | None = None) -> Outcome:
    """A statue in motion: its skeleton moves the control mesh, the detail stands on the moving normals.

    The motion is BVH, motion.npz of any of our commands, AMASS, or a table of key poses (keys.csv). Parts are matched
    by their names, and rest poses may differ.

    Example: scape statue animate statue walk.bvh -o walking

    Args:
        statue: Folder of scape statue fit.
        motion: .bvh, .npz with poses, trans and mocap_frame_rate, or .csv with time and PART_rx, PART_ry, PART_rz in
            degrees.
        output: Folder to write: statue.glb, motion.npz with its model body.npz, and meshes on demand.
        rate: Frames a second, where the motion's file does not say or says it wrongly.
        level: Level of detail of the files.
        meshes: Write the exact mesh of every frame.
        own_mesh: Write own.glb too, the mesh of the scan's file in motion; the statue is one of fit --own-mesh.
        names: Whose names the bones have: mixamo, unity, unreal, vrm, h-anim or opensim.
    """
    loaded = load_statue(statue)
    control, up = loaded.control, loaded.upright_axis
    fine = subdivide_uniform(control.mesh, control.chart, level)
    detailed = Reconstruction(control, loaded.map, fine)
    moved, doubts = read_statue_motion(loaded, motion, rate)
    bodies = control.rig.vertices(moved.poses, moved.trans)
    output.mkdir(parents=True, exist_ok=True)
    write_statue_glb(output / "statue.glb", control, detailed(control.mesh.vertices), fine, loaded.texture,
                     motion=moved, up=up, names=names)
    if own_mesh:
        animate_own_mesh(output / OWN_MESH, statue / OWN_MESH, loaded, moved, names)
    write_body_motion(output / "motion.npz", control, moved)
    body_model(control).save(output / BODY)                  # the model of the motion, to look at it by itself
    rows = [Metric("joints that follow the motion", len(moved.matched)),
            *([Metric("joints without one in the motion", ", ".join(moved.lacking))] if moved.lacking else [])]
    shown = bodies[::max(1, len(bodies) // 24)]
    if meshes:
        with bar("writing meshes") as progress:
            for t, body in enumerate(bodies):
                write_mesh(output / "meshes" / f"{t:05d}.ply", detailed.mesh(body))
                progress(t + 1, len(bodies))
    # share of inverted triangles in a frame: 100 poses of people have up to 0.002, a real walk 0.005; random joint
    # angles have 0.010, a walk with degrees read as radians 0.012
    inverted = [len(find_inverted(control, body, fine, detailed(body))) for body in shown]
    share = max(inverted) / len(fine.faces)
    if share > 0.008:
        doubts = [f"{100 * share:.1f}% of the triangles are inverted in a frame: the pose is beyond what the skin can "
                  "follow", *doubts]
    return Outcome(output, [Metric("frames", len(bodies)), Metric("rate", moved.rate, "1/s"), *rows,
                            Metric("inverted triangles in a frame, most", max(inverted))],
                   {"level": level, "model": BODY}, judgement=Judgement.of(check=doubts))
