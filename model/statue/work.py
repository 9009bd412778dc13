"""One scan of `scape statue fit`: read, fitted, mapped, written with its page."""
from __future__ import annotations

import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

from scanprep.batch.room import Room
from scanprep.cleaning.clean_scan import clean_scan
from scanprep.cli import MM, Unit
from scanprep.console import Metric, Outcome, write_report
from scanprep.geometry.files import read_mesh, write_mesh
from scanprep.geometry.format_common import UNITS
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.sheets import save_png
from scanprep.pictures.textures import Texture, read_texture

from .control.model import ControlModel, Statue
from .detail.displacement import coverage_shares
from .detail.errors import Level, adaptive_level, in_folds, inverted_triangles, measured_levels, remaining_error
from .detail.subdivision import Subdivision
from .detail.texels import bake_texture, scan_look
from .files import save_statue, write_body, write_for_programs
from .fit import FittedStatue, StatueConfig, fit_statue
from .registration.automatic import likely_unit
from .registration.clicks import read_features
from .report import in_motion, parts_without_data, statue_page, statue_picture


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
    unit: Unit | None = None                                      # of scans and features, where files cannot tell
    command: str = field(default="", metadata={"digest": False})  # for the report of each scan of a folder

    def __call__(self, inputs: Inputs, room: Room) -> list[Metric]:
        """Fit the statue of some files into the folder of a room; the figures."""
        start = time.perf_counter()
        scan, texture, rows = read_scan(inputs, self.unit)
        joints = points = None
        if inputs.features is not None:
            joints, points = read_features(inputs.features, self.control, scan, self.unit)
            rows += [Metric("joints given", len(joints)), Metric("surface points given", len(points))]
        statue = fit_statue(scan, joints, points, self.control, self.config, room.tell, room.step)
        if texture is not None or scan.colors is not None:
            image = room.step("texture", (self, inputs), lambda: bake_texture(
                statue.control, statue.map, scan_look(texture or scan)))
            statue = replace(statue, texture=image)
        metrics = write_statue(room.folder, inputs.scan.name, scan, statue, rows)
        if self.command:
            write_report(Outcome(room.folder, metrics, {"statue": self.config}), self.command,
                         time.perf_counter() - start)
        return metrics


def write_statue(folder: Path, name: str, scan: Mesh, statue: FittedStatue, rows: list[Metric]) -> list[Metric]:
    """Write a statue with its files for other programs and its page; the figures."""
    save_statue(folder, statue)
    levels, fine = measured_levels(statue, scan)
    adaptive = adaptive_level(statue, scan)
    write_mesh(folder / "reconstruction.ply", levels[-1].mesh)
    write_body(folder, statue)
    write_for_programs(folder, statue, levels[-1].mesh.vertices, fine, statue.upright_axis)
    problem = statue_problem(statue)
    rows = [*([Metric("problem", problem)] if problem else []), *rows, *_of_the_fit(statue),
            *_of_the_map(statue, scan, levels, adaptive, fine), *_sizes(folder, scan)]
    picture = statue_picture(scan, statue, levels[-1])
    save_png(folder / "picture.png", picture)
    page = statue_page(name, scan, statue, levels, [(m.name, m.value, m.unit) for m in rows], adaptive,
                       in_motion(statue), picture)
    page.write(folder / "report.html")
    return rows


def statue_problem(statue: Statue) -> str | None:
    """Why a statue means nothing; None where it means something."""
    shares = coverage_shares(statue.control, statue.map)
    if shares["folded"] <= 0.25 and shares["measured"] >= 0.1:
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


def _of_the_fit(statue: FittedStatue) -> list[Metric]:
    """How well control model and scan were brought together."""
    posed, surface = statue.posed, statue.surface
    assert posed is not None and surface is not None, "made by fit_statue"
    return [*([Metric("not seen in the scan", ", ".join(posed.missing))] if posed.missing else []),
            *([Metric("look at it", posed.problem)] if posed.problem else []),
            Metric("points of the face that shaped the head", posed.face),
            Metric("joints of the posed control model to the features, RMS", MM * posed.features.joint_rms, "mm"),
            Metric("surface points of it, RMS", MM * posed.features.point_rms, "mm"),
            Metric("control mesh to the scan, RMS", MM * surface.rms, "mm"),
            Metric("inverted triangles of the control mesh", surface.inverted)]


def _of_the_map(statue: Statue, scan: Mesh, levels: list[Level], adaptive: Level, fine: Subdivision) -> list[Metric]:
    """What the map holds and how far the surface made from it lies from the scan."""
    shares = coverage_shares(statue.control, statue.map)
    left = remaining_error(statue.control, statue.map, scan)
    inverted = inverted_triangles(statue.control, statue.control.mesh.vertices, fine, levels[-1].mesh.vertices)
    outside = ~in_folds(statue.control, statue.map, fine)[inverted]
    lacking = parts_without_data(statue)
    return [Metric("one-to-one", 100 * shares["measured"], "% of the surface"),
            Metric("folded", 100 * shares["folded"], "% of the surface"),
            Metric("holes", 100 * shares["hole"], "% of the surface"),
            *([Metric("parts without data", ", ".join(lacking))] if lacking else []),
            Metric("error left by the map where it is one-to-one, mean", MM * left.mean, "mm"),
            *(Metric(f"{one.name} to the scan, {what}", MM * value, "mm") for one in [*levels, adaptive]
              for what, value in (("mean", one.mean), ("RMS", one.rms))),
            Metric("triangles of the adaptive subdivision", len(adaptive.mesh.faces)),
            Metric(f"inverted triangles at {levels[-1].name}", len(inverted)),
            Metric("of these outside folds and holes", int(outside.sum()))]


def _sizes(folder: Path, scan: Mesh) -> list[Metric]:
    stored = sum((folder / name).stat().st_size for name in ("control.npz", "displacement.png", "coverage.png"))
    return [Metric("control model and map on disk", stored / 1e6, "MB"),
            Metric("scan on disk as binary PLY", (12 * len(scan.vertices) + 13 * len(scan.faces)) / 1e6, "MB")]
