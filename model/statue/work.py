"""One scan of `scape statue fit`: read, fitted, mapped, written with its page."""
from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from scanprep.batch.room import Room
from scanprep.cleaning.clean_scan import clean_scan
from scanprep.cli import MM, Unit
from scanprep.console import Metric, Outcome, write_report
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.format_common import UNITS
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.sheets import save_png
from scanprep.pictures.textures import Texture, read_texture

from .control.model import HOLE, ControlModel, Statue
from .detail.displacement import bake, coverage_shares
from .detail.reconstruction import (
    Reconstruction,
    SurfaceError,
    coverage_at,
    displaced_surface,
    in_folds,
    inverted_triangles,
    remaining_error,
    surface_error,
)
from .detail.subdivision import Subdivision, subdivide, subdivide_adaptive
from .detail.textures import bake_texture, scan_look
from .files import save_statue, write_body, write_for_programs
from .fit import Posed, StatueConfig, fitted_control, posed_automatically, posed_by_features
from .registration.automatic import Features, find_features, likely_unit
from .registration.clicks import read_features
from .registration.surface_fit import SurfaceFit, fit_surface
from .report import Level, in_motion, parts_without_data, statue_page, statue_picture, upright_axis

LEVELS = 4                           # 0 to 3 are measured, the last is written
TOLERANCE = 0.0005                   # metres: of adaptive subdivision in the report
LOST, EMPTY = 0.25, 0.1              # share of the control mesh in folds, and with data, that mean nothing


@dataclass(frozen=True)
class Inputs:
    """The files of one scan."""

    scan: Path
    features: Path | None = None


@dataclass(frozen=True, eq=False)
class Work:
    """What the scans of one call have in common."""

    control: ControlModel
    config: StatueConfig
    unit: Unit | None = None                                      # of the scans and features, where the files cannot
                                                                  # tell
    command: str = field(default="", metadata={"digest": False})  # for the report of each scan of a folder; one scan's
                                                                  # is written by the console

    def __call__(self, inputs: Inputs, room: Room) -> list[Metric]:
        """Fit the statue of some files into the folder of a room; the figures."""
        start = time.perf_counter()
        metrics = self._fit(inputs, room)
        if self.command:
            write_report(Outcome(room.folder, metrics, {"statue": self.config}), self.command,
                         time.perf_counter() - start)
        return metrics

    def _fit(self, inputs: Inputs, room: Room) -> list[Metric]:
        scan, texture, rows = read_scan(inputs, self.unit)
        same = (self.control, self.config, self.unit, inputs)
        if inputs.features is None:
            found = room.step("features", (self.control, self.unit, inputs), lambda: find_features(self.control, scan))
            posed, more = posed_automatically(self.control, found), _found(found)
        else:
            joints, points = read_features(inputs.features, self.control, scan, self.unit)
            posed = posed_by_features(self.control, joints, points, self.config.features)
            more = [Metric("joints given", len(joints)), Metric("surface points given", len(points)),
                    Metric("points of the face that shaped the head", posed.face)]
        surface = room.step("surface", same, lambda: fit_surface(self.control.mesh, posed.start, scan,
                                                                 self.config.surface, room.tell, posed.hidden))
        control = room.step("control", same, lambda: fitted_control(self.control, posed.features, surface, scan,
                                                                    self.config.displacement))
        map_ = room.step("map", same, lambda: bake(control, scan, self.config.displacement, room.tell))
        statue = Statue(control, posed.features.pose, map_)
        if texture is not None or scan.colors is not None:
            image = room.step("texture", same, lambda: bake_texture(control, map_, scan_look(texture or scan)))
            statue = replace(statue, texture=image)
        return self._written(statue, scan, surface, [*rows, *more, *_posed(posed)], inputs, room)

    def _written(self, statue: Statue, scan: Mesh, surface: SurfaceFit, rows: list[Metric], inputs: Inputs, room: Room
                 ) -> list[Metric]:
        folder = room.folder
        save_statue(folder, statue)
        levels, fine = measured_levels(statue, scan)
        adaptive = _adaptive(statue, scan)
        write_mesh(folder / "reconstruction.ply", levels[-1].mesh)
        write_body(folder, statue)
        write_for_programs(folder, statue, levels[-1].mesh.vertices, fine, upright_axis(statue))
        rows = [*rows, *_figures(statue, scan, surface, levels, adaptive, fine), *_sizes(folder, scan)]
        problem = statue_problem(statue)
        rows = [*([Metric("problem", problem)] if problem else []), *rows]
        picture = statue_picture(scan, statue, levels[-1])
        save_png(folder / "picture.png", picture)
        page = statue_page(inputs.scan.name, scan, statue, levels, [(m.name, m.value, m.unit) for m in rows], adaptive,
                           in_motion(statue), picture)
        page.write(folder / "report.html")
        return rows


def measured_levels(statue: Statue, scan: Mesh) -> tuple[list[Level], Subdivision]:
    """The reconstruction at every level with its distance to the scan, and the finest subdivision. [Statues] Eq. 22, 23
    """
    levels = []
    for number in range(LEVELS):
        fine = subdivide(statue.control.mesh, statue.control.chart, number)
        levels.append(_level(f"level {number}", statue, fine, scan))
    return levels, fine


def _level(name: str, statue: Statue, fine: Subdivision, scan: Mesh) -> Level:
    mesh = Reconstruction(statue.control, statue.map, fine).mesh()
    shown = (_kinds(statue, fine) != HOLE).all(axis=1)
    error = surface_error(mesh.submesh(shown)[0], scan) if shown.any() else SurfaceError(np.nan, np.nan, np.nan)
    return Level(name, mesh, error.mean, error.rms, shown)


def _kinds(statue: Statue, fine: Subdivision) -> np.ndarray:
    """(f, 3) what the map says at the corners of fine triangles."""
    return coverage_at(statue.control, statue.map, fine.parent, fine.bary)[fine.faces]


def _adaptive(statue: Statue, scan: Mesh) -> Level:
    control = statue.control
    fine = subdivide_adaptive(control.mesh, control.chart, displaced_surface(control, statue.map), TOLERANCE, LEVELS)
    return _level(f"adaptive, {MM * TOLERANCE:g} mm", statue, fine, scan)


def statue_problem(statue: Statue) -> str | None:
    """Why a statue means nothing; None where it means something."""
    shares = coverage_shares(statue.control, statue.map)
    if shares["folded"] <= LOST and shares["measured"] >= EMPTY:
        return None
    return (f"{100 * shares['folded']:.0f}% of the control mesh is folded against the scan, "
            f"{100 * shares['measured']:.0f}% has data one-to-one; the control model is not where the person is; "
            "features given by hand (--features) may help")


def read_scan(inputs: Inputs, unit: Unit | None) -> tuple[Mesh, Texture | None, list[Metric]]:
    """The body of a scan and its texture in metres, and what was left out.

    Without a unit it is metres where features are given, which may be on anything, else that of a person.
    """
    sought = unit is None and inputs.features is None
    with warnings.catch_warnings():
        if sought:
            warnings.filterwarnings("ignore", ".*when read as metres", UserWarning)
        scan, texture = read_mesh(inputs.scan, unit), read_texture(inputs.scan, unit)
    rows = [Metric("scan, triangles", len(scan.faces))]
    metre = UNITS[likely_unit(scan.vertices)] if sought else 1.0
    cleaned = clean_scan(scan.with_vertices(metre * scan.vertices))
    body = cleaned.mesh
    if sought:                               # once more of the body alone: a floor may be of any size
        likely = likely_unit(body.vertices / metre)
        body, metre = body.with_vertices(UNITS[likely] / metre * body.vertices), UNITS[likely]
        rows.append(Metric("unit of the scan", f"{likely}, from the height of the body"))
    left = 1 - float(cleaned.kept.mean())
    if left > 0:
        rows.append(Metric("left out as floor, furniture, specks", 100 * left, "% of the points"))
    return body, texture and texture.scaled(metre), rows


def _found(found: Features) -> list[Metric]:
    """What was found without a click."""
    return [*([Metric("not seen in the scan", ", ".join(found.missing))] if found.missing else []),
            *([Metric("look at it", found.problem)] if found.problem else [])]


def _posed(posed: Posed) -> list[Metric]:
    fit = posed.features
    return [Metric("joints of the posed control model to the features, RMS", MM * fit.joint_rms, "mm"),
            Metric("surface points of it, RMS", MM * fit.point_rms, "mm")]


def _figures(statue: Statue, scan: Mesh, surface: SurfaceFit, levels: list[Level], adaptive: Level,
             fine: Subdivision) -> list[Metric]:
    """The rows of the closing table."""
    shares = coverage_shares(statue.control, statue.map)
    left = remaining_error(statue.control, statue.map, scan)
    turned = inverted_triangles(statue.control, statue.control.mesh.vertices, fine, levels[-1].mesh.vertices)
    outside = ~in_folds(statue.control, statue.map, fine)[turned]
    lacking = parts_without_data(statue)
    return [Metric("control mesh to the scan, RMS", MM * surface.rms, "mm"),
            Metric("inverted triangles of the control mesh", surface.inverted),
            Metric("one-to-one", 100 * shares["measured"], "% of the surface"),
            Metric("folded", 100 * shares["folded"], "% of the surface"),
            Metric("holes", 100 * shares["hole"], "% of the surface"),
            *([Metric("parts without data", ", ".join(lacking))] if lacking else []),
            Metric("error left by the map where it is one-to-one, mean", MM * left.mean, "mm"),
            *(Metric(f"{one.name} to the scan, {what}", MM * value, "mm") for one in [*levels, adaptive]
              for what, value in (("mean", one.mean), ("RMS", one.rms))),
            Metric("triangles of the adaptive subdivision", len(adaptive.mesh.faces)),
            Metric(f"inverted triangles at {levels[-1].name}", len(turned)),
            Metric("of these outside folds and holes", int(outside.sum()))]


def _sizes(folder: Path, scan: Mesh) -> list[Metric]:
    stored = sum((folder / name).stat().st_size for name in ("control.npz", "displacement.png", "coverage.png"))
    return [Metric("control model and map on disk", stored / 1e6, "MB"),
            Metric("scan on disk as binary PLY", (12 * len(scan.vertices) + 13 * len(scan.faces)) / 1e6, "MB")]
