"""`scape prep template`, `merge`, `fill` and `decimate`: from range views to a clean mesh."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from ..cli import MeshArg, Output, Unit, about_mesh
from ..console import Metric, Outcome, bar, read_json
from ..geometry.files import UNITS, list_meshes, read_mesh, write_mesh
from ..geometry.mesh import Mesh
from .decimate import DecimateConfig, decimate
from .fill import FillConfig, fill_holes
from .merge import MergeConfig, merge_views
from .template import make_template

ViewsArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="VIEWS")]


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
    return Outcome(output, [Metric("views", len(seen)), *about_mesh(made)])


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
    return Outcome(output, [Metric("views", len(seen)), *about_mesh(merged)], {"merge": config})


def fill(mesh: MeshArg, output: Output, unit: Unit | None = None,
         config: Annotated[FillConfig, tyro.conf.arg(name="")] = FillConfig()) -> Outcome:  # noqa: B008
    """Close the holes of a mesh; what was there stays as it was.

    Example: scape prep fill body.ply -o closed.ply
    """
    before = read_mesh(mesh, unit)
    with bar("filling holes") as progress:
        after = fill_holes(before, config, progress)
    write_mesh(output, after)
    return Outcome(output, [Metric("holes before", len(before.boundary_loops)), *about_mesh(after)], {"fill": config})


def reduce(mesh: MeshArg, output: Output, faces: int, unit: Unit | None = None,
           config: Annotated[DecimateConfig, tyro.conf.arg(name="")] = DecimateConfig()) -> Outcome:  # noqa: B008
    """Fewer triangles for the same surface.

    Example: scape prep decimate closed.ply --faces 14000 -o template.ply
    """
    before = read_mesh(mesh, unit)
    after = decimate(before, faces, config)
    write_mesh(output, after)
    return Outcome(output, [Metric("triangles before", len(before.faces)), *about_mesh(after)], {"decimate": config})


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
