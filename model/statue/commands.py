"""The commands of `scape statue`: one scan of one person becomes a character that moves, with all its detail."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from scanprep.batch.pool import Workers
from scanprep.batch.workspace import Task, Workspace
from scanprep.cli import MM, Output, ScanArg, Unit
from scanprep.console import Metric, Outcome, bar, failures_of, problem_of
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.pictures.gltf import write_animated_glb
from scanprep.pictures.sheets import write_gif
from scanprep.pipeline.scans import find_scans
from scanprep.ranges import Positive

from ..export.cli import read_motion
from ..files import load_model
from .cli import LevelArg, MotionArg, StatueArg
from .control.files import read_control
from .control.humanoid import humanoid
from .control.model import Statue
from .detail.displacement import DisplacementConfig
from .detail.errors import inverted_triangles
from .detail.reconstruction import Reconstruction, displaced_surface
from .detail.subdivision import subdivide, subdivide_adaptive
from .files import load_statue, write_statue_glb
from .fit import StatueConfig
from .motion.follow import follower_of
from .motion.motions import read_statue_motion, write_motion
from .report import motion_pictures
from .work import Inputs, Work

FINE = StatueConfig(displacement=DisplacementConfig(size=2048))


def fit(scan: ScanArg, output: Output, features: Path | None = None, control: Path | None = None,
        unit: Unit | None = None, config: StatueConfig = FINE, workers: Workers = Workers(), *,           # noqa: B008
        space: Workspace) -> Outcome:
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
        unit: Unit of the scan and the features; else metres with --features, and without them that in which the body
            would be as tall as a person.
        workers: Who fits the scans of a folder.
    """
    work = Work(humanoid() if control is None else read_control(control), config, unit)
    if not scan.is_dir():
        if features is None and control is not None:
            raise ValueError("--control: expected --features with the joints of that control model; only the generic "
                             "humanoid is found by itself")
        with bar("fitting the statue") as progress:
            done = space.run(work, [Task("statue", Inputs(scan, features))], inside=progress).only
        return Outcome(output, done, {"statue": config}, problem=problem_of(done))
    if features is not None and not features.is_dir():
        raise ValueError(f"--features: expected a folder for a folder of scans, got {features}")
    work = replace(work, command=f"scape statue fit {scan}")
    found = {one.name: Inputs(one.scan, one.landmarks if features else None) for one in find_scans(scan, features)}
    with bar("fitting statues") as progress:
        results = space.run(work, [Task(name, one, name) for name, one in found.items()], workers, progress)
    return Outcome(output, [Metric("scans", len(found)), Metric("statues", len(results.values))], {"statue": config},
                   failures_of(results))


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
    fine = subdivide(control.mesh, control.chart, level) if tolerance is None else subdivide_adaptive(
        control.mesh, control.chart, displaced_surface(control, loaded.map), tolerance / MM, level)
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
    return Outcome(output, rows)


def animate(statue: StatueArg, motion: MotionArg, output: Output, model: Path | None = None,
            registered: Path | None = None, level: LevelArg = 2, meshes: bool = False) -> Outcome:
    """A statue in motion: its skeleton moves the control mesh, the detail stands on the moving normals.

    The motion is BVH; or .npz of the synthetic people, or of the statue's own body.npz, as scape animate writes it from
    markers. With --model the control mesh follows a learned model instead of plain skinning, with all that the model
    knows of how skin moves; the motion is then one of that model.

    Example: scape statue animate statue walk.bvh -o walking

    Args:
        statue: Folder of scape statue fit.
        motion: .bvh, or .npz with poses, trans and mocap_frame_rate.
        output: Folder to write: statue.glb, motion.npz, motion.gif, and meshes on demand.
        model: Learned model (.npz) that the control mesh follows.
        registered: The model's template on the scan, in its triangles; else it is brought there.
        level: Level of detail of the files.
        meshes: Write the exact mesh of every frame.
    """
    loaded = load_statue(statue)
    control, up = loaded.control, loaded.upright_axis
    fine = subdivide(control.mesh, control.chart, level)
    detailed = Reconstruction(control, loaded.map, fine)
    if model is None:
        if registered is not None:
            raise ValueError("--registered: expected --model with it")
        moved = read_statue_motion(loaded, motion)
        bodies, rate = control.rig.vertices(moved.poses, moved.trans), moved.rate
        output.mkdir(parents=True, exist_ok=True)
        write_statue_glb(output / "statue.glb", control, detailed(control.mesh.vertices), fine, loaded.texture,
                         motion=moved, up=up)
        write_motion(output / "motion.npz", control, moved)
        rows = [Metric("joints that follow the motion", len(moved.matched)),
                *([Metric("joints without one in the motion", ", ".join(moved.lacking))] if moved.lacking else [])]
    else:
        bodies, rate = _following(loaded, motion, model, registered)
        keys = bodies[::max(1, len(bodies) // 120)]
        write_animated_glb(output / "statue.glb", fine.faces, np.stack([detailed(body) for body in keys]),
                           rate * len(keys) / len(bodies), up=up, keys=len(keys))
        rows = [Metric("follows", str(model))]
    shown = bodies[::max(1, len(bodies) // 24)]
    with bar("rendering") as progress:
        write_gif(output / "motion.gif", motion_pictures(loaded, detailed, shown, progress),
                  rate * len(shown) / len(bodies))
    if meshes:
        with bar("writing meshes") as progress:
            for t, body in enumerate(bodies):
                write_mesh(output / "meshes" / f"{t:05d}.ply", detailed.mesh(body))
                progress(t + 1, len(bodies))
    inverted = [len(inverted_triangles(control, body, fine, detailed(body))) for body in shown]
    return Outcome(output, [Metric("frames", len(bodies)), Metric("rate", rate, "1/s"), *rows,
                            Metric("inverted triangles in a frame, most", max(inverted))], {"level": level})


def _following(statue: Statue, motion: Path, model: Path, registered: Path | None) -> tuple[np.ndarray, float]:
    """The control mesh (T, N, 3) in a motion of a learned model, and its rate."""
    learned = load_model(model)
    moves = read_motion(motion, learned)
    there = None
    if registered is not None:
        body = read_mesh(registered)
        if not np.array_equal(body.faces, learned.template.faces):
            raise ValueError(f"{registered}: expected the triangles of the model ({learned.template}), found {body}")
        there = body.vertices
    with bar("registering the model") as progress:
        follower = follower_of(statue, learned, there, progress)
    return follower.vertices(moves.poses, moves.trans), moves.rate
