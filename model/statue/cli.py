"""`scape statue`: one scan of one person becomes a layered character that moves, with all its detail."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from scanprep.batch.pool import Workers
from scanprep.batch.workspace import Task, Workspace
from scanprep.cli import MM, Output, ScanArg, Unit, WorkersArg
from scanprep.console import Metric, Outcome, bar, dispatch, failures_of, problem_of
from scanprep.geometry.files import write_mesh
from scanprep.pipeline.scans import SCAN_ENDINGS

from .control import ControlModel
from .files import load_statue
from .fit import StatueConfig
from .humanoid import humanoid
from .reconstruction import Reconstruction, displaced_surface
from .subdivision import subdivide, subdivide_adaptive
from .work import Inputs, Work

StatueArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="STATUE")]
MotionArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MOTION")]
LevelArg = Literal[0, 1, 2, 3, 4]
FEATURE_ENDINGS = (".features.json", ".json", ".pp", ".mrk.json")

COMMANDS = {
    "fit": ("A scan -> control model, displacement map and texture.", "model.statue.cli:fit"),
    "reconstruct": ("The detailed surface of a statue at any level, of an edited map too.",
                    "model.statue.cli:reconstruct"),
    "animate": ("A statue in motion: of markers, BVH, or a learned model.", "model.statue.cli:animate"),
}


def group(argv: list[str]) -> int:
    """The commands of `scape statue`."""
    return dispatch(COMMANDS, "scape statue", argv,
                    "One scan of one person becomes a layered character that moves, with all its detail.")


def fit(scan: ScanArg, output: Output, features: Path | None = None, control: Path | None = None,
        unit: Unit | None = None, size: Annotated[int, tyro.conf.arg(metavar="PIXELS")] = 2048, vectors: bool = False,
        workers: WorkersArg = Workers(), *, space: Workspace) -> Outcome:                            # noqa: B008
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
        unit: Unit of the scan and the features; else that in which the body would have a plausible height.
        size: Pixels of the images, each way.
        vectors: Store displacements of any direction, which also hold where the scan is folded.
        workers: Who fits the scans of a folder.
    """
    config = StatueConfig()
    config = replace(config, displacement=replace(config.displacement, size=size, vectors=vectors))
    work = Work(_control(control), config, unit)
    if not scan.is_dir():
        if features is None and control is not None:
            raise ValueError("--control: expected --features with the joints of that control model; only the generic "
                             "humanoid is found by itself")
        with bar("fitting the statue") as progress:
            done = space.run(work, [Task("statue", Inputs(scan, features))], inside=progress).only
        return Outcome(output, done, {"statue": config}, problem=problem_of(done))
    work = replace(work, command=f"scape statue fit {scan}")
    found = {path.name.split(".")[0]: Inputs(path, _features_of(path, features)) for path in sorted(scan.iterdir())
             if path.name.lower().endswith(SCAN_ENDINGS)}
    if not found:
        raise ValueError(f"{scan}: expected scans ({', '.join(SCAN_ENDINGS)}), found none")
    with bar("fitting statues") as progress:
        results = space.run(work, [Task(name, one, name) for name, one in found.items()], workers, progress)
    return Outcome(output, [Metric("scans", len(found)), Metric("statues", len(results.values))], {"statue": config},
                   failures_of(results))


def reconstruct(statue: StatueArg, output: Output, level: LevelArg = 3, tolerance: float | None = None,
                image: Path | None = None) -> Outcome:
    """The surface of a statue with its detail, as a mesh at any level.

    Example: scape statue reconstruct statue --level 4 -o detailed.ply

    Args:
        statue: Folder of scape statue fit.
        output: Mesh to write.
        level: How often the triangles of the control mesh are divided by four.
        tolerance: Divide only where the detail is off by more than this, millimetres; at most as often as the level.
        image: Edited copy of the statue's displacement.png, of the same size and depth.
    """
    loaded = load_statue(statue, image)
    control = loaded.control
    fine = subdivide(control.mesh, control.chart, level) if tolerance is None else subdivide_adaptive(
        control.mesh, control.chart, displaced_surface(control, loaded.map), tolerance / MM, level)
    mesh = Reconstruction(control, loaded.map, fine).mesh()
    write_mesh(output, mesh)
    rows = [Metric("vertices", len(mesh.vertices)), Metric("triangles", len(mesh.faces)),
            Metric("closed", "yes" if mesh.is_closed else "no")]
    if image is not None:
        before = Reconstruction(control, load_statue(statue).map, fine)(control.mesh.vertices)
        moved = np.linalg.norm(mesh.vertices - before, axis=1)
        rows += [Metric("vertices moved by the edited image", int((moved > 1e-6).sum())),
                 Metric("largest of these moves", MM * float(moved.max()), "mm")]
    return Outcome(output, rows)


def _control(path: Path | None) -> ControlModel:
    from .control_files import read_control

    return humanoid() if path is None else read_control(path)


def _features_of(scan: Path, features: Path | None) -> Path | None:
    """The file of a scan's name in a folder of features."""
    if features is None:
        return None
    if not features.is_dir():
        raise ValueError(f"--features: expected a folder for a folder of scans, got {features}")
    stem = scan.name.split(".")[0]
    return next((features / (stem + ending) for ending in FEATURE_ENDINGS if (features / (stem + ending)).is_file()),
                None)
