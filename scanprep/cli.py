"""`scape prep`: the stages from raw scans to a registered set, and all of them in one command.

Each subpackage has its commands in its own `cli.py`; here is their list, and what they share.
"""
from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np

from .arguments import Alias, Called, Place
from .command_line import dispatch
from .console import Metric

if TYPE_CHECKING:               # heavy imports are inside functions: --help must answer at once
    from .geometry.mesh import Mesh

Unit = Literal["m", "mm", "cm", "in"]
PersonUnit = Literal["m", "mm", "cm", "in", "unknown"]
ScanArg = Annotated[Path, Place("SCAN")]
MeshArg = Annotated[Path, Place("MESH")]
SetArg = Annotated[Path, Place("SET")]
Output = Annotated[Path, Alias("-o")]
Person = Called("--person")         # whose scans; in other commands `--subject` is a body
MM = 1000.0                         # millimetres in a metre

# name -> line of help, function
COMMANDS = {
    "run": ("Scans -> registered set with a skeleton; goes on where it was interrupted.",
            "scanprep.pipeline.cli:run_all"),
    "landmarks": ("Scans that nobody clicked -> named landmarks with expected errors.",
                  "scanprep.pipeline.landmarks:landmark_scans"),
    "page": ("The page of a registered set: every scan with pictures and figures, worst first.",
             "scanprep.pipeline.cli:page"),
    "clean": ("Floor, furniture and specks off a raw scan.", "scanprep.surfaces.cli:clean"),
    "template": ("Your best scan, or several views -> a closed template.", "scanprep.surfaces.cli:template"),
    "repair": ("Make a mesh manifold: degenerate, repeated and inverted triangles go.",
               "scanprep.surfaces.cli:repair_mesh"),
    "views": ("Bring range views into one frame.", "scanprep.surfaces.cli:align_cameras"),
    "merge": ("Range views with known cameras -> one surface.", "scanprep.surfaces.cli:merge"),
    "fill": ("Close the holes of a mesh.", "scanprep.surfaces.cli:fill"),
    "decimate": ("Fewer triangles for a mesh, or for a registered set.", "scanprep.surfaces.cli:reduce"),
    "align": ("Move one scan rigidly onto another.", "scanprep.registration.cli:align"),
    "correspond": ("From a few landmarks, or none, to nearly two hundred pairs of places.",
                   "scanprep.registration.cli:correspond"),
    "register": ("Bend the template onto one scan.", "scanprep.registration.cli:register_one"),
    "skeleton": ("Rigid parts, joints and a tree from registered poses.", "scanprep.skeleton.cli:skeleton"),
    "edit-skeleton": ("Merge and rename parts, move joints, by hand or from a file.",
                      "scanprep.skeleton.cli:edit"),
}


def group(argv: list[str]) -> int:
    """Run one of the commands of `scape prep`."""
    return dispatch(COMMANDS, "scape prep", argv, "From raw scans to registered meshes and a skeleton.")


def read_poses(folder: Path, template: Path | None, subject: str | None, unit: Unit | None
               ) -> tuple[Mesh, np.ndarray, tuple[str, ...]]:
    """Read template, vertices (M, N, 3) and names of one person's poses from a registered set or a folder of meshes.

    Of meshes with several components the largest is read, and the others are attached to the template.
    ValueError, with its name, for a mesh that is no pose of the others.
    """
    from .dataset import RegisteredSet
    from .geometry.attached import take_body
    from .geometry.files import read_mesh, read_registered
    from .geometry.members import ONE_BODY, check_members
    from .geometry.mesh import Mesh

    if (folder / "set.json").exists():
        registered = RegisteredSet.load(folder)
        mesh, names = registered.template, registered.names_of(subject)
        poses = registered.vertices(names)
    else:
        meshes = read_registered(folder, unit)
        whole = read_mesh(template, unit) if template else Mesh(meshes.vertices[0], meshes.faces, up=meshes.up)
        if not np.array_equal(whole.faces, meshes.faces):
            raise ValueError(f"{template}: expected the triangles of the meshes in {folder}; it has other ones")
        mesh, poses, names = take_body(whole), meshes.vertices, meshes.names
        if mesh.attached is not None:
            poses = poses[:, mesh.attached.body]
    check_members(mesh, poses, str(folder), names, ONE_BODY)
    return mesh, poses, names


def about_mesh(mesh: Mesh) -> list[Metric]:
    """Return the rows of the closing table that describe a mesh."""
    from .geometry.mesh import template_problem

    problem = template_problem(mesh)
    return [Metric("vertices", len(mesh.vertices)), Metric("triangles", len(mesh.faces)),
            Metric("holes", len(mesh.boundary_loops)),
            Metric("largest extent", float(np.ptp(mesh.vertices, axis=0).max()), "m"),
            Metric("usable as a template", "yes" if problem is None else f"no, {problem}")]
