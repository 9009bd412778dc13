"""From scans and range views to a clean mesh: `scape prep template`, `repair`, `views`, `merge`, `fill`, ..."""
from __future__ import annotations

import warnings
from pathlib import Path
from typing import Annotated

import numpy as np

from ..alignment.views import AlignViewsConfig, align_views, views_doubts, views_problem
from ..arguments import Place, UsageError
from ..cleaning.clean_scan import CleanScanConfig, clean_scan
from ..cli import MM, MeshArg, Output, PersonUnit, ScanArg, Unit, about_mesh
from ..console import Metric, Outcome, bar
from ..dataset import RegisteredSet
from ..decimation.decimate import DecimateConfig, decimate
from ..decimation.registered_set import write_decimated_set
from ..fusion.tsdf import MergeConfig, merge_views
from ..geometry import storage
from ..geometry.files import (
    PointCloud,
    common_unit,
    is_scan,
    list_files,
    list_meshes,
    name_of,
    read_mesh,
    read_points,
    read_scan,
    read_scan_mesh,
    write_mesh,
    write_points,
)
from ..geometry.format_common import metres_of
from ..geometry.landmarks import landmarks_beside, read_landmark_vertices, read_landmarks, write_landmarks
from ..geometry.mesh import Mesh, template_problem
from ..judgement import Judgement
from ..ranges import Faces
from ..registration.lead import find_scanned_person
from ..registration.unit import resolve_unit
from ..repair.hole_filling import FillConfig, fill_report, filling_judgement
from ..repair.manifold import repair
from ..words import number_of
from .cloud import read_sound_surface
from .template import carry_landmarks, template_of_scan, template_of_views, views_without_cameras

ScansArg = Annotated[tuple[Path, ...], Place("SCAN ...")]
ViewsArg = Annotated[Path, Place("VIEWS")]


def template(scans: ScansArg, output: Output, faces: Faces = 14000, landmarks: Path | None = None,
             unit: PersonUnit | None = None) -> Outcome:
    """Make a template of your best scan: the body alone, repaired, its holes filled, decimated.

    Landmarks are carried to it. Several files are views of one moment, which are aligned and merged; point clouds are
    meshed.

    Example: scape prep template "2024.05.01 anna.ply" -o template.ply

    Args:
        scans: One scan of the whole body, mesh or point cloud; or several views of it; or a folder of views, with
            cameras.json: {file name without ending: [x, y, z]} where the cameras are known.
        output: Mesh to write; its landmarks go beside it.
        faces: Triangles of the template.
        landmarks: Landmarks of the scan; else the file of its name beside it.
        unit: Unit of the scans, their cameras and landmarks; "unknown": it is found together with the person in the
            first scan.
    """
    if not scans:
        raise ValueError("SCAN: expected a scan of the whole body, or views of it, got none")
    notes: tuple[str, ...] = ()
    rows, doubts, marks = list[Metric](), list[str](), dict[str, int]()
    # views with known cameras are merged; anything else is aligned, meshed or taken as it is
    if len(scans) == 1 and (scans[0] / "cameras.json").exists():
        seen = _read_views(scans[0], resolve_unit(list_meshes(scans[0])[0], unit))
        with bar("making the template") as progress:
            made = template_of_views(seen, faces, progress=progress)
        rows = [Metric("views", len(seen))]
    else:
        paths = [path for given in scans for path in ([given] if not given.is_dir() else list_files(
            given, lambda path: is_scan(path) and ".landmarks." not in path.name, "views, meshes or point clouds"))]
        # meshing point clouds needs their normals
        units = resolve_unit(paths[0], unit)
        views = [found if isinstance(found := read_scan(path, units), Mesh) else read_points(path, units)
                 for path in paths]
        scan = views[0] if len(views) == 1 else views_without_cameras(views)
        path = landmarks or (landmarks_beside(paths[0]) if len(paths) == 1 else None)
        surface = scan if isinstance(scan, Mesh) else scan.points
        places = {} if path is None else read_landmarks(path, surface, units)
        with bar("making the template") as progress:
            person = find_scanned_person(surface)
            done = template_of_scan(scan, faces, landmarks=np.array(list(places.values())) if places else None,
                                    progress=progress, person=None if person is None else person[0])
        if person is not None and not places:
            body, named = person
            places = {name: body.vertices[vertex] for name, vertex in named.items()}
            notes = ("the landmarks are those of the built-in people, who lie on the scan: some centimetres from where "
                     "you would click",)
        made, notes, doubts = done.mesh, (*done.notes, *notes), list(done.doubts)
        rows = [Metric("files", len(paths)),
                Metric("filled, where nothing was scanned", 100 * done.filled, "% of the surface")]
        if done.balance is not None:
            rows.append(Metric("triangles on the left side", 100 * done.balance, "%"))
        marks, far = carry_landmarks(places, made)
        if path is not None:            # what nobody clicked, nobody can correct: the note says how near it is
            doubts += [f"landmark {name} is {MM * away:.0f} mm from the template" for name, away in far.items()]
    write_mesh(output, made)
    if marks:
        write_landmarks(output.with_name(f"{name_of(output)}.landmarks.json"), marks)
    for note in notes:
        warnings.warn(f"{output.name}: {note}", stacklevel=2)
    return Outcome(output, [*rows, Metric("landmarks carried", len(marks)), *about_mesh(made)],
                   judgement=_as_template(made).merge(Judgement.of(check=doubts)))


def repair_mesh(mesh: MeshArg, output: Output, unit: Unit | None = None) -> Outcome:
    """Make a mesh manifold: degenerate, repeated and inverted triangles, sheets that touch, and loose pieces go.

    Holes stay open, and where a fault is cut out there is one more: scape prep fill closes them.

    Example: scape prep repair scan.ply -o repaired.ply

    Args:
        mesh: Mesh.
        output: Mesh to write.
        unit: Unit of the mesh.
    """
    before = read_mesh(mesh, unit)
    after = repair(before)
    write_mesh(output, after)
    return Outcome(output, [Metric("fault found first", template_problem(before) or "none"),
                            Metric("triangles before", len(before.faces)), *about_mesh(after)],
                   judgement=_as_template(after))


def _manifold(mesh: Mesh, path: Path) -> Mesh:
    """Return the mesh, repaired and reported if it is not manifold."""
    if mesh.is_edge_manifold and mesh.is_vertex_manifold:
        return mesh
    mended = repair(mesh, 0.0)
    warnings.warn(f"{path} is not manifold; it is repaired first, as scape prep repair does: "
                  f"{len(mesh.faces) - len(mended.faces)} of {len(mesh.faces)} triangles go", stacklevel=2)
    return mended


def clean(scan: ScanArg, output: Output, landmarks: Path | None = None, unit: PersonUnit | None = None,
          config: CleanScanConfig = CleanScanConfig()) -> Outcome:
    """Keep the body of a raw scan; floor, furniture and specks go.

    Example: scape prep clean raw.ply -o body.ply

    Args:
        scan: Mesh or point cloud.
        output: File to write, a mesh or a point cloud as the scan is.
        landmarks: Landmarks of the scan, where the body is not its largest piece.
        unit: Unit of the scan and its landmarks; "unknown": it is found together with the person.
        config: Settings.
    """
    units = resolve_unit(scan, unit)
    raw = read_scan(scan, units)
    mesh = raw if isinstance(raw, Mesh) else None
    places = read_landmarks(landmarks, mesh, units) if landmarks else {}
    found = clean_scan(raw, config, np.array(list(places.values())) if places else None)
    if isinstance(found.scan, Mesh):
        write_mesh(output, found.scan)
    else:
        write_points(output, PointCloud(found.scan, None, None))
    pieces: dict[str, list[int]] = {}                       # one row per reason: a noisy cloud has hundreds of pieces
    for piece in found.components:
        pieces.setdefault(f"{'kept' if piece.kept else 'dropped'}: {piece.reason}", []).append(piece.points)
    return Outcome(output, [
        Metric("points before", len(found.kept)), Metric("points", int(found.kept.sum())),
        *(Metric(f"{why}, {len(points)} pieces" if len(points) > 1 else why, sum(points), "points")
          for why, points in pieces.items())], {"clean": config}, judgement=found.judgement)


def align_cameras(views: ViewsArg, output: Output, landmarks: Path | None = None,
                  unit: Unit | None = None,
                  config: AlignViewsConfig = AlignViewsConfig()) -> Outcome:
    """Bring range views into one frame, all of them together.

    Example: scape prep views views -o aligned

    Args:
        views: Folder of range meshes, roughly in one frame unless landmarks place them, and cameras.json:
            {file name without ending: [x, y, z]}, each in the frame of its view.
        output: Folder for the moved meshes and their cameras.json.
        landmarks: Folder of landmark files with the names of the views, which place them first.
        unit: Unit of the views, cameras and landmarks.
        config: Settings.
    """
    seen, names, marks = _read_views(views, unit), list[str](), list[dict[str, np.ndarray]]()
    for path, (mesh, _) in zip(list_meshes(views), seen, strict=True):
        names.append(name_of(path))
        beside = landmarks_beside(path, landmarks) if landmarks else None
        marks.append(read_landmarks(beside, mesh, unit) if beside else {})
    found = align_views(seen, config, landmarks=marks if landmarks else None)
    placed = dict(zip(names, found.views, strict=True))
    for name, (mesh, _) in placed.items():
        write_mesh(output / f"{name}.ply", mesh)
    storage.write_json(output / "cameras.json", {name: camera.tolist() for name, (_, camera) in placed.items()})
    doubts = views_doubts(found, names)
    return Outcome(output, [
        Metric("views", len(seen)), Metric("distance between views, RMS", MM * found.rms, "mm"),
        Metric("converged", str(found.converged)),
        Metric("seen by others too, least of a view", 100 * float(found.overlap.min()), "%"),
        Metric("looked through by others, most of a view", 100 * float(found.conflict.max()), "%")],
                   {"views": config}, doubts,
                   judgement=Judgement.of(views_problem(found), doubts))


def merge(views: ViewsArg, output: Output, unit: Unit | None = None, config: MergeConfig = MergeConfig()) -> Outcome:
    """Merge range views into one surface, open where nothing was seen.

    Example: scape prep merge views -o body.ply

    Args:
        views: Folder of range meshes in one frame, and cameras.json: {file name without ending: [x, y, z]}.
        output: Mesh to write.
        unit: Unit of the views and cameras.
        config: Settings.
    """
    seen = _read_views(views, unit)
    with bar("merging views") as progress:
        merged = merge_views(seen, config, progress)
    write_mesh(output, merged)
    return Outcome(output, [Metric("views", len(seen)), *about_mesh(merged)], {"merge": config},
                   judgement=Judgement.of(None if len(merged.faces) else "the views have no surface in common"))


def fill(mesh: MeshArg, output: Output, views: Path | None = None, unit: Unit | None = None,
         config: FillConfig = FillConfig()) -> Outcome:
    """Close the holes of a mesh; what was there stays as it was.

    Example: scape prep fill body.ply -o closed.ply

    Args:
        mesh: Mesh with holes, or point cloud.
        output: Mesh to write.
        views: Folder of the range meshes it was merged from, and their cameras.json: space that they look through is
            left empty.
        unit: Unit of the mesh, the views and the cameras.
        config: Settings.
    """
    found = read_sound_surface(mesh, unit)
    before = found if found.is_edge_manifold else _manifold(found, mesh)
    seen = _read_views(views, unit) if views else ()
    with bar("filling holes") as progress:
        report = fill_report(before, config, progress, seen)
    after, holes = report.mesh, report.holes
    write_mesh(output, after)
    loops = len(after.boundary_loops)
    still_open = [f"{number_of(loops, 'hole is', 'holes are')} still open"] if loops else []
    judgement = filling_judgement(holes, len(after.faces) - len(before.faces)).merge(Judgement.of(check=still_open))
    return Outcome(output, [
        Metric("holes before", len(before.boundary_loops)),
        *(Metric(f"{way} patches", sum(hole.method == way for hole in holes)) for way in ("fair", "diffusion")),
        Metric("triangles that run through others", sum(hole.intersections for hole in holes)),
        *about_mesh(after)], {"fill": config}, judgement=judgement)


def reduce(mesh: MeshArg, output: Output, faces: Faces, landmarks: Path | None = None, unit: Unit | None = None,
           config: DecimateConfig = DecimateConfig()) -> Outcome:
    """Fewer triangles for the same surface: of a mesh, or of a registered set, whose parts and landmarks stay in step.

    Example: scape prep decimate closed.ply --faces 14000 -o template.ply

    Args:
        mesh: Mesh, or folder of a registered set.
        output: Mesh to write; of a set a folder, which also holds the map between the two in decimation.npz.
        faces: How many triangles are wanted.
        landmarks: Landmarks of the mesh, whose vertices stay where they are; a set has its own.
        unit: Unit of the mesh and its landmarks.
        config: Settings for a mesh.
    """
    # a registered set: all meshes by one map
    if mesh.is_dir():
        wrong = [name for name, given in (("landmarks", landmarks), ("unit", unit),
                                          ("method", config.method != DecimateConfig().method)) if given]
        if wrong:
            raise UsageError(f"--{wrong[0]}: it says nothing about a registered set, which {mesh} is")
        whole = RegisteredSet.load(mesh)
        with bar("decimating") as progress:
            done = write_decimated_set(whole, output, faces, progress)
        return Outcome(output, [
            Metric("meshes", len(done.entries)), Metric("triangles before", len(whole.template.faces)),
            *about_mesh(done.template)], judgement=_as_template(done.template))
    given = read_scan_mesh(mesh, unit)
    before, keep = _manifold(given, mesh), None
    if landmarks and (named := read_landmark_vertices(landmarks, given, unit)):
        places = {name: given.vertices[v] for name, v in named.items()}
        keep = np.array(list(carry_landmarks(places, before)[0].values()))
    with bar("decimating") as progress:
        after = decimate(before, faces, config, keep, progress=progress)
    write_mesh(output, after)
    return Outcome(output, [Metric("triangles before", len(before.faces)), *about_mesh(after)], {"decimate": config},
                   judgement=_as_template(after))


def _as_template(mesh: Mesh) -> Judgement:
    """Judge whether a mesh can serve as a template."""
    problem = template_problem(mesh)
    return Judgement.of(check=[] if problem is None else [f"not usable as a template: {problem}"])


def _read_views(folder: Path, unit: str | None) -> list[tuple[Mesh, np.ndarray]]:
    """Read the range meshes of a folder with the positions (3,), metres, of their cameras."""
    cameras = folder / "cameras.json"
    where = storage.read_json(cameras, "camera positions {name: [x, y, z]}")
    paths = list_meshes(folder)
    with storage.taking_apart(cameras, "camera positions {name: [x, y, z]} in JSON"):
        missing = [name_of(path) for path in paths if name_of(path) not in where]
        if missing:
            raise ValueError(f"none for {', '.join(missing)}")
        where = {name: np.array(place, dtype=np.float64) for name, place in where.items()}
        common = common_unit(paths, unit)
        places = [metres_of(common) * storage.numbers(where, name_of(path), 3) for path in paths]
    return [(read_mesh(path, common), place) for path, place in zip(paths, places, strict=True)]
