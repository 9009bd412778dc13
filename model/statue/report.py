"""The page of a statue: what was fitted, the map, the error at every level, and the character in motion."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.camera import Camera
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Bones, Dots, Shape, Solid, color_bar, heat, part_colors, render, side_by_side
from scanprep.synthetic.people import named_pose, walk

from .control.files import humanoid
from .control.model import FOLDED, HOLE, MEASURED, OUTSIDE, DisplacementMap, Statue
from .detail.reconstruction import Level, Reconstruction, coverage_at
from .detail.subdivision import subdivide
from .motion.motions import people_motion

HEIGHT = 520                         # pixels of the pictures
WORST = 0.003                        # metres: the end of the colours of errors
KINDS = {MEASURED: (0.62, 0.70, 0.78), FOLDED: (0.86, 0.36, 0.22), HOLE: (0.93, 0.75, 0.42), OUTSIDE: (1.0, 1.0, 1.0)}


def cameras(statue: Statue, subject: Any, turns: Sequence[float] = (0, 90, 180, 270)) -> list[Camera]:
    """Cameras around a subject (Mesh or points) from the front on; the front is where the control model looks."""
    front, axis = -statue.control.skeleton.part_rotations(statue.pose)[0][:, 1], statue.upright_axis
    first, second = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]]
    azimuth = float(np.degrees(np.arctan2(front @ second, front @ first)))
    return [Camera.around(subject, azimuth + turn, up=axis) for turn in turns]


def statue_picture(scan: Mesh, statue: Statue, level: Level) -> np.ndarray:
    """Scan, control mesh and reconstruction from the front, and the scan and the reconstruction from behind."""
    front, back = cameras(statue, scan, (20, 200))
    bare = Mesh(scan.vertices, scan.faces)
    control = Solid(statue.control.mesh, part_colors(statue.control.skeleton.part_of_face), smooth=False)
    return _row([(bare, front), (control, front), (level.mesh, front), (bare, back), (level.mesh, back)],
                ("scan", "control mesh", f"reconstruction, {level.name}", "scan", "reconstruction"))


def statue_page(name: str, scan: Mesh, statue: Statue, levels: Sequence[Level], rows: list[tuple[str, Any, str]],
                adaptive: Level, frames: Sequence[tuple[str, Mesh]], picture: np.ndarray) -> Page:
    """The page of `scape statue fit`: levels, coarsest first, rows of the table, the statue in other poses."""
    finest = levels[-1]
    page = Page(f"{name}, a statue that moves", "A control mesh with a skeleton was fitted to the scan; the detail of "
                "the scan is an image over it.")
    page.picture(picture)
    page.table(rows, ("metric", "value", "unit"))
    _fit(page, scan, statue)
    _map(page, statue, scan)
    _errors(page, scan, statue, levels)
    page.section("Level of detail", "The same map on ever fewer triangles, and on triangles that are small only where "
                 "the displacement asks for it.")
    shown = [*reversed(levels), adaptive]
    camera = cameras(statue, scan, (20,))[0]
    page.picture(_row([(Solid(one.mesh, smooth=one is not finest), camera) for one in shown],
                      [f"{one.name}: {len(one.mesh.faces):,} triangles" for one in shown]))
    if frames:
        page.section("In motion", "The skeleton moves the control mesh, and the detail stands on its moving normals.")
        page.picture(side_by_side([_picture(mesh, cameras(statue, mesh, (20,))[0]) for _, mesh in frames],
                                  [label for label, _ in frames]))
    return page


def _fit(page: Page, scan: Mesh, statue: Statue) -> None:
    control, joints = statue.control, statue.control.skeleton.joints
    marks = control.mesh.vertices[list(control.landmarks.values())]
    inside: list[Shape] = [Solid(Mesh(scan.vertices, scan.faces), opacity=0.35),
                           Bones(joints[control.skeleton.parents[1:]], joints[1:], on_top=True),
                           Dots(joints, on_top=True), Dots(marks, (0.15, 0.45, 0.75), 0.006, True)]
    page.section("Joints and control mesh", "Red: joint centres. Blue: feature points of the control model. Below, the "
                 "control mesh; its colours are the parts of the skeleton.")
    page.picture(_row([(inside, camera) for camera in cameras(statue, scan)], ("front", "left", "back", "right")))
    parts = Solid(control.mesh, part_colors(control.skeleton.part_of_face), smooth=False)
    page.picture(_row([(parts, camera) for camera in cameras(statue, scan)], ("front", "left", "back", "right")))


def _map(page: Page, statue: Statue, scan: Mesh) -> None:
    page.section("Displacement map", "White: the scan lies outside the control mesh, black: inside. Right: blue was "
                 "measured; red is folded, not one-to-one with the control mesh; yellow is a hole of the scan. Red and "
                 "yellow were filled smoothly.")
    page.picture(side_by_side(map_pictures(statue.map), ("displacement", "coverage")))
    colors = np.array([KINDS[kind] for kind in coverage_of_vertices(statue)])
    page.picture(_row([(Solid(statue.control.mesh, colors), camera) for camera in cameras(statue, scan)],
                      ("front", "left", "back", "right")))


def _errors(page: Page, scan: Mesh, statue: Statue, levels: Sequence[Level]) -> None:
    page.section("Distance to the scan", "From the reconstruction at each level to the scan; grey in its holes, which "
                 "do not count.")
    page.table([(one.name, len(one.mesh.vertices), f"{1000 * one.mean:.2f}", f"{1000 * one.rms:.2f}")
                for one in levels], ("level", "vertices", "mean, mm", "RMS, mm"))
    surface, camera = Surface(scan), cameras(statue, scan, (20,))[0]
    colored = [(Solid(one.mesh, heat(np.where(one.shown, surface.closest(one.mesh.corners.mean(axis=1)).distances,
                                              np.nan), 0.0, WORST), smooth=False), camera) for one in levels]
    page.picture(side_by_side([_row(colored, [one.name for one in levels]),
                               color_bar(0.0, WORST, "distance to the scan")], columns=1))


def map_pictures(map_: DisplacementMap, size: int = 640) -> tuple[np.ndarray, np.ndarray]:
    """The heights as grey values (white out, black in, the middle grey zero), and the coverage in colours."""
    step = max(1, len(map_.heights) // size)
    heights, coverage = map_.heights[::step, ::step], map_.coverage[::step, ::step]
    covered = coverage != OUTSIDE
    most = float(np.quantile(np.abs(heights[covered]), 0.995)) if covered.any() else 1.0
    grey = np.where(covered, 127.5 + 127.5 * np.clip(heights / max(most, 1e-9), -1, 1), 255)
    colors = np.zeros((256, 3))
    colors[list(KINDS)] = list(KINDS.values())
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1), (255 * colors[coverage]).astype(np.uint8)


def coverage_of_vertices(statue: Statue) -> np.ndarray:
    """(N,) what the map says at each vertex of the control mesh: MEASURED, FOLDED or HOLE."""
    whole = subdivide(statue.control.mesh, statue.control.chart, 0)
    return coverage_at(statue.control, statue.map, whole.parent, whole.bary)


def _row(shown: Sequence[tuple[Shape | Sequence[Shape], Camera]], labels: Sequence[str]) -> np.ndarray:
    return side_by_side([_picture(shapes, camera) for shapes, camera in shown], labels)


def _picture(shapes: Shape | Sequence[Shape], camera: Camera) -> np.ndarray:
    return render(shapes, camera, int(HEIGHT * camera.width / camera.height) + 10, HEIGHT)


def parts_without_data(statue: Statue) -> list[str]:
    """Names of the parts of which less than half was measured."""
    kind = coverage_of_vertices(statue)
    part = statue.control.skeleton.part_of_vertex(statue.control.mesh)
    hole = np.bincount(part, kind == HOLE) / np.maximum(np.bincount(part), 1)
    return [name for name, share in zip(statue.control.skeleton.names, hole, strict=True) if share > 0.5]


def in_motion(statue: Statue) -> list[tuple[str, Mesh]]:
    """The statue in a walk, a squat and with its arms overhead; none for a control model with other joints."""
    if statue.control.skeleton.names != humanoid().skeleton.names:
        return []
    poses = np.stack([walk(80)[0][20], named_pose("squat"), named_pose("arms_up")])
    moved = people_motion(statue.control, statue.pose, poses)
    detailed = Reconstruction(statue.control, statue.map, subdivide(statue.control.mesh, statue.control.chart, 3))
    bodies = statue.control.rig.vertices(moved.poses, moved.trans)
    return [(name, detailed.mesh(body)) for name, body in zip(("walking", "squatting", "arms overhead"), bodies,
                                                              strict=True)]


def motion_pictures(statue: Statue, detailed: Reconstruction, bodies: np.ndarray,
                    progress: Callable[[int, int], None] | None = None) -> list[np.ndarray]:
    """A picture of each of some frames of control vertices (T, N, 3), all seen from one place in front."""
    camera, out = cameras(statue, bodies.reshape(-1, 3), (25,))[0], []
    for t, body in enumerate(bodies):
        out.append(render(detailed.mesh(body), camera, int(360 * camera.width / camera.height) + 10, 360))
        if progress:
            progress(t + 1, len(bodies))
    return out
