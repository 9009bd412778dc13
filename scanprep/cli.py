"""`scape prep`: the stages from raw scans to a registered set, and all of them in one."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from .cleaning.decimate import DecimateConfig, decimate
from .cleaning.fill import FillConfig, fill_holes
from .cleaning.merge import MergeConfig, merge_views
from .cleaning.template import make_template
from .console import Metric, Outcome, bar, dispatch, read_json, say
from .dataset import RegisteredSet
from .geometry.files import UNITS, list_meshes, read_mesh, read_registered, write_mesh
from .geometry.landmarks import match_landmarks, read_landmark_vertices, read_landmarks
from .geometry.mesh import Mesh, template_problem
from .matching.nonrigid import register
from .matching.rigid import RigidConfig, align_landmarks, align_rigid
from .pipeline import PrepareConfig, find_scans, prepare, read_scan
from .skeleton.find import SkeletonConfig, find_skeleton

Unit = Literal["m", "mm", "cm", "in"]
ScansArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCANS")]
ScanArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCAN")]
ViewsArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIEWS")]
MeshArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MESH")]
TargetArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="TARGET")]
PosesArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="POSES")]
Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
MM = 1000.0

COMMANDS = {
    "run": ("Scans -> registered set with a skeleton; goes on where it was interrupted.", "scanprep.cli:run_all"),
    "template": ("Range views with known cameras -> a closed template.", "scanprep.cli:template_of_views"),
    "merge": ("Range views with known cameras -> one surface.", "scanprep.cli:merge"),
    "fill": ("Close the holes of a mesh.", "scanprep.cli:fill"),
    "decimate": ("Fewer triangles for the same surface.", "scanprep.cli:reduce"),
    "align": ("Move one scan rigidly onto another.", "scanprep.cli:align"),
    "register": ("Bend the template onto one scan.", "scanprep.cli:register_one"),
    "skeleton": ("Rigid parts, joints and a tree from registered poses.", "scanprep.cli:skeleton"),
}


def group(argv: list[str]) -> int:
    """The commands of `scape prep`."""
    return dispatch(COMMANDS, "scape prep", argv, "From raw scans to registered meshes and a skeleton.")


def run_all(scans: ScansArg, template: Path, output: Output, landmarks: Path | None = None,
            template_landmarks: Path | None = None, subject: str = "", unit: Unit | None = None,
            min_poses: int = PrepareConfig.min_poses, workers: int = PrepareConfig.workers) -> Outcome:
    """Register a template to every scan of a folder and find the skeleton.

    Example: scape prep run scans --template template.ply -o set

    Args:
        scans: Folder of meshes or point clouds. scans.csv in it may say more: name,subject,pose,sex.
        template: Mesh to bring onto the scans: one closed or bordered manifold component.
        output: Folder of the registered set.
        landmarks: Folder of landmark files with the names of the scans; else scans/landmarks, or beside the scans.
        template_landmarks: Landmarks of the template; else the file of its name beside it.
        subject: Whose scans they are, where scans.csv does not say; else each is a person of its own.
        unit: Unit of the scans and landmarks, where the files cannot tell.
        min_poses: A skeleton is sought when one subject has at least so many scans.
        workers: Processes; 0 for one a core.
    """
    body = read_mesh(template)
    marks = read_landmark_vertices(template_landmarks or _beside(template), body)
    tasks = find_scans(scans, landmarks, subject)
    without = [task.name for task in tasks if task.landmarks is None]
    if without:
        say(f"note: no landmarks for {len(without)} of {len(tasks)} scans ({', '.join(without[:5])}); "
            "they must be near the template's pose")
    config = PrepareConfig(unit=unit, min_poses=min_poses, workers=workers)
    with bar("registering scans") as registering, bar("finding the skeleton") as finding:
        done = prepare(tasks, body, marks, output, config, registering, finding)
    mean = [float(np.mean([getattr(f, name) for f in done.figures] or [np.nan]))
            for name in ("distance", "seen", "landmarks", "seconds")]
    worst = max(done.figures, key=lambda f: f.distance, default=None)
    tree = done.registered.skeleton
    return Outcome(output, [
        Metric("scans registered", f"{len(done.figures)} of {len(tasks)}"),
        Metric("distance to the scan, mean", MM * mean[0], "mm"),
        Metric("worst scan: " + (worst.name if worst else "none"), MM * worst.distance if worst else "", "mm"),
        Metric("vertices with data, mean", 100 * mean[1], "%"),
        Metric("distance of landmarks, mean RMS", MM * mean[2], "mm"),
        Metric("flipped triangles", sum(f.flipped for f in done.figures)),
        Metric("time a scan, mean", mean[3], "s"),
        Metric("parts of the skeleton", len(tree.parents) if tree else "none sought"),
        Metric("unit assumed", unit or "m")], {"prepare": config}, list(done.failures))


def template_of_views(views: ViewsArg, output: Output, cameras: Path | None = None, faces: int = 14000,
                      unit: Unit | None = None) -> Outcome:
    """Merge range views, close the holes, and decimate to a template.

    Example: scape prep template views --faces 12000 -o template.ply

    Args:
        views: Folder of range meshes in one frame.
        output: Mesh to write.
        cameras: JSON {file name without ending: [x, y, z]}; else cameras.json in the folder.
        faces: Triangles of the template.
        unit: Unit of the views and cameras.
    """
    seen = _read_views(views, cameras, unit)
    with bar("making the template") as progress:
        made = make_template(seen, faces, progress=progress)
    write_mesh(output, made)
    return Outcome(output, [Metric("views", len(seen)), *_about(made)])


def merge(views: ViewsArg, output: Output, cameras: Path | None = None, unit: Unit | None = None,
          config: Annotated[MergeConfig, tyro.conf.arg(name="")] = MergeConfig()) -> Outcome:  # noqa: B008
    """Merge range views into one surface, open where nothing was seen.

    Example: scape prep merge views -o body.ply

    Args:
        views: Folder of range meshes in one frame.
        output: Mesh to write.
        cameras: JSON {file name without ending: [x, y, z]}; else cameras.json in the folder.
        unit: Unit of the views and cameras.
        config: Settings.
    """
    seen = _read_views(views, cameras, unit)
    with bar("merging views") as progress:
        merged = merge_views(seen, config, progress)
    write_mesh(output, merged)
    return Outcome(output, [Metric("views", len(seen)), *_about(merged)], {"merge": config})


def fill(mesh: MeshArg, output: Output, unit: Unit | None = None,
         config: Annotated[FillConfig, tyro.conf.arg(name="")] = FillConfig()) -> Outcome:  # noqa: B008
    """Close the holes of a mesh; what was there stays as it was.

    Example: scape prep fill body.ply -o closed.ply
    """
    before = read_mesh(mesh, unit)
    with bar("filling holes") as progress:
        after = fill_holes(before, config, progress)
    write_mesh(output, after)
    return Outcome(output, [Metric("holes before", len(before.boundary_loops)), *_about(after)], {"fill": config})


def reduce(mesh: MeshArg, output: Output, faces: int, unit: Unit | None = None,
           config: Annotated[DecimateConfig, tyro.conf.arg(name="")] = DecimateConfig()) -> Outcome:  # noqa: B008
    """Fewer triangles for the same surface.

    Example: scape prep decimate closed.ply --faces 14000 -o template.ply
    """
    before = read_mesh(mesh, unit)
    after = decimate(before, faces, config)
    write_mesh(output, after)
    return Outcome(output, [Metric("triangles before", len(before.faces)), *_about(after)], {"decimate": config})


def align(source: MeshArg, target: TargetArg, output: Output, landmarks: Path | None = None,
          target_landmarks: Path | None = None, unit: Unit | None = None,
          config: Annotated[RigidConfig, tyro.conf.arg(name="")] = RigidConfig()) -> Outcome:  # noqa: B008
    """Move a mesh rigidly onto another: by landmarks where both have them, then by their surfaces.

    Example: scape prep align front.ply back.ply -o front_aligned.ply
    """
    moving, fixed = read_mesh(source, unit), read_mesh(target, unit)
    T = np.eye(4)
    if landmarks or target_landmarks:
        if not (landmarks and target_landmarks):
            raise ValueError("landmarks: expected --landmarks and --target-landmarks together")
        _, mine, theirs = match_landmarks(read_landmarks(landmarks, moving, unit),
                                          read_landmarks(target_landmarks, fixed, unit))
        T = align_landmarks(mine, theirs).T_target_source
    placed = moving.with_vertices(moving.vertices @ T[:3, :3].T + T[:3, 3])
    found = align_rigid(placed, fixed, config=config)
    T = found.T_target_source @ T
    write_mesh(output, moving.with_vertices(moving.vertices @ T[:3, :3].T + T[:3, 3]))
    return Outcome(output, [
        Metric("RMS distance", MM * found.rms, "mm"), Metric("converged", str(found.converged)),
        Metric("T_target_source", np.array2string(T, precision=6).replace("\n", " "))], {"align": config})


def register_one(scan: ScanArg, template: Path, output: Output, landmarks: Path | None = None,
                 template_landmarks: Path | None = None, unit: Unit | None = None) -> Outcome:
    """Bend the template onto one scan.

    Example: scape prep register scan.ply --template template.ply --landmarks scan.json -o registered.ply
    """
    body, data = read_mesh(template), read_scan(scan, unit)
    pairs = None
    if landmarks:
        marks = read_landmark_vertices(template_landmarks or _beside(template), body)
        found = read_landmarks(landmarks, data if isinstance(data, Mesh) else None, unit)
        pairs = match_landmarks(marks, found)[1:]
    with bar("registering") as progress:
        fit = register(body, data, pairs, progress=progress)
    write_mesh(output, fit.mesh)
    return Outcome(output, [
        Metric("distance to the scan, RMS", MM * fit.rms, "mm"),
        Metric("vertices with data", 100 * float(fit.seen.mean()), "%"),
        Metric("distance of landmarks, RMS", MM * fit.landmark_rms, "mm"),
        Metric("flipped triangles", fit.flipped), Metric("converged", str(fit.converged))])


def skeleton(poses: PosesArg, output: Output, template: Path | None = None, subject: str | None = None,
             unit: Unit | None = None,
             config: Annotated[SkeletonConfig, tyro.conf.arg(name="")] = SkeletonConfig()) -> Outcome:  # noqa: B008
    """Rigid parts, joints and a tree from meshes of one person that share their triangles.

    Example: scape prep skeleton set -o skeleton.json

    Args:
        poses: Folder of meshes, or a registered set.
        output: JSON file to write.
        template: The mesh whose joints are wanted; else the first of the folder, or the set's own.
        subject: Of a registered set, whose meshes; else of the one with the most.
        unit: Unit of the meshes.
        config: Settings.
    """
    body, vertices = read_poses(poses, template, subject, unit)
    with bar("finding the skeleton") as progress:
        found = find_skeleton(body, vertices, config, progress=progress)
    found.save(output)
    shares = np.bincount(found.part_of_face, body.face_areas) / body.face_areas.sum()
    return Outcome(output, [Metric("poses", len(vertices)), Metric("parts", len(found.parents)),
                            *(Metric(f"{name}, share of the surface", 100 * float(share), "%")
                              for name, share in zip(found.names, shares, strict=True))], {"skeleton": config})


def read_poses(folder: Path, template: Path | None, subject: str | None, unit: Unit | None
               ) -> tuple[Mesh, np.ndarray]:
    """Template and vertices (M, N, 3) of one person from a registered set or a folder of meshes."""
    if (folder / "set.json").exists():
        whole = RegisteredSet.load(folder)
        return whole.template, whole.poses(subject)
    found = read_registered(folder, unit)
    body = read_mesh(template, unit) if template else Mesh(found.vertices[0], found.faces)
    if not np.array_equal(body.faces, found.faces):
        raise ValueError(f"{template}: expected the triangles of the meshes in {folder}; it has other ones")
    return body, found.vertices


def _read_views(folder: Path, cameras: Path | None, unit: Unit | None) -> list[tuple[Mesh, np.ndarray]]:
    """The range meshes of a folder with the positions of their cameras."""
    given = cameras or folder / "cameras.json"
    where = read_json(given, "camera positions {name: [x, y, z]}")
    paths = list_meshes(folder)
    missing = [path.stem for path in paths if np.shape(where.get(path.stem)) != (3,)]
    if missing:
        raise ValueError(f"{given}: expected a camera position [x, y, z] for each view, none for {', '.join(missing)}")
    scale = UNITS[unit or "m"]
    return [(read_mesh(path, unit), scale * np.array(where[path.stem], dtype=np.float64)) for path in paths]


def _beside(template: Path) -> Path:
    """The landmark file of a template: that of its name, or `landmarks.json`, beside it."""
    stem = template.name.split(".")[0]
    for ending in (".landmarks.json", ".json", ".pp", "_picked_points.pp", ".mrk.json"):
        if (template.parent / (stem + ending)).is_file():
            return template.parent / (stem + ending)
    if (template.parent / "landmarks.json").is_file():
        return template.parent / "landmarks.json"
    raise ValueError(f"{template}: expected its landmarks in {stem}.landmarks.json beside it; "
                     "name the file with --template-landmarks")


def _about(mesh: Mesh) -> list[Metric]:
    problem = template_problem(mesh)
    return [Metric("vertices", len(mesh.vertices)), Metric("triangles", len(mesh.faces)),
            Metric("holes", len(mesh.boundary_loops)),
            Metric("largest extent", float(np.ptp(mesh.vertices, axis=0).max()), "m"),
            Metric("usable as a template", "yes" if problem is None else f"no, {problem}")]
