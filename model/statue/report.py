"""The page of a statue: what was fitted, the map, the error at every level, and the character in motion."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scanprep.console import Metric
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.judgement import size
from scanprep.pictures.camera import Camera
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane, picture_panes
from scanprep.pictures.shading import CLAY, Bones, Dots, Heat, Solid, part_colors
from scanprep.pictures.sheets import webp_bytes
from scanprep.pictures.thinning import MOST, thin_solid
from scanprep.synthetic.people import find_pose, synthesise_walk

from .control.files import humanoid
from .control.model import HOLE, Statue
from .detail.reconstruction import Level, Reconstruction, coverage_at
from .detail.subdivision import subdivide_uniform
from .motion.motions import people_motion

HEIGHT = 520                         # pixels of the pictures
MOVED = MOST // 2                    # triangles of a body that is shown beside others


def place_camera(statue: Statue, subject: Any, turn: float) -> Camera:
    """Place a camera around a subject (Mesh or points), turned by degrees from where the control model looks."""
    front, axis = -statue.control.skeleton.part_rotations(statue.pose)[0][:, 1], statue.upright_axis
    first, second = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]]
    azimuth = float(np.degrees(np.arctan2(front @ second, front @ first)))
    return Camera.around(subject, azimuth + turn, up=axis)


def statue_picture(scan: Mesh, statue: Statue, level: Level) -> np.ndarray:
    """Picture scan, control mesh and reconstruction."""
    return picture_panes(first_panes(scan, statue, level), HEIGHT)


def first_panes(scan: Mesh, statue: Statue, level: Level) -> list[Pane]:
    """Draw the scan, the control mesh in the colours of its parts, and the reconstruction."""
    camera = place_camera(statue, scan, 20)
    control = Solid(statue.control.mesh, part_colors(statue.control.skeleton.part_of_face), smooth=False)
    return [Pane([Mesh(scan.vertices, scan.faces)], camera, "scan"), Pane([control], camera, "control mesh"),
            Pane([level.mesh], camera, f"reconstruction, {level.name}")]


def statue_page(name: str, scan: Mesh, statue: Statue, levels: Sequence[Level], metrics: Sequence[Metric],
                frames: Sequence[tuple[str, Mesh]], picture: np.ndarray) -> Page:
    """Make the page of `scape statue fit`: levels, coarsest first, the figures, the statue in other poses."""
    page = Page(f"{name}, a statue that moves", "A control mesh with a skeleton was fitted to the scan; the detail of "
                "the scan is an image over it.")
    thinned = "Shown with fewer triangles than it has."
    page.bodies(first_panes(scan, statue, levels[-1]), thinned, HEIGHT, webp_bytes(picture))
    page.figures(metrics)
    page.section("Joints", "Red: joint centres. Blue: feature points of the control model.")
    control, joints = statue.control, statue.control.skeleton.joints
    marks, names = list(control.landmarks.values()), list(control.landmarks)
    page.bodies([Pane([
        thin_solid(Solid(Mesh(scan.vertices, scan.faces), opacity=0.35, name="scan"), MOVED),
        Bones(joints[control.skeleton.parents[1:]], joints[1:], on_top=True, name="skeleton"),
        Dots(joints, radius=0.0085 * size(control.mesh), on_top=True, name="joints", labels=control.skeleton.names),
        Dots(control.mesh.vertices[marks], (0.15, 0.45, 0.75), 0.006, True, name="feature points", labels=names)],
                      place_camera(statue, scan, 20))], height=HEIGHT)
    page.section("Distance to the scan", "Grey: holes of the scan, which do not count.")
    finest = levels[-1]
    far = Surface(scan).closest(finest.mesh.vertices).distances
    far[finest.mesh.faces[~finest.shown]] = np.nan
    # to 3 mm, the end of the colours
    solid = Solid(finest.mesh, Heat(far, 0.0, 0.003, "distance to the scan"), shades={"plain": np.array(CLAY)})
    page.bodies([Pane([thin_solid(solid, MOVED)], place_camera(statue, scan, 20), finest.name)], thinned, HEIGHT)
    if frames:
        page.section("In motion", "The skeleton moves the control mesh, and the detail stands on its moving normals.")
        page.bodies([Pane([thin_solid(Solid(mesh), MOVED)], place_camera(statue, mesh, 20), label)
                     for label, mesh in frames], thinned, HEIGHT)
    return page


def coverage_of_vertices(statue: Statue) -> np.ndarray:
    """Look up the coverage (N,) at each vertex of the control mesh: MEASURED, FOLDED or HOLE."""
    whole = subdivide_uniform(statue.control.mesh, statue.control.chart, 0)
    return coverage_at(statue.control, statue.map, whole.parent, whole.bary)


def parts_without_data(statue: Statue) -> list[str]:
    """List the names of the parts that are holes by more than half."""
    kind = coverage_of_vertices(statue)
    part = statue.control.skeleton.part_of_vertex(statue.control.mesh)
    hole = np.bincount(part, kind == HOLE) / np.maximum(np.bincount(part), 1)
    return [name for name, share in zip(statue.control.skeleton.names, hole, strict=True) if share > 0.5]


def in_motion(statue: Statue) -> list[tuple[str, Mesh]]:
    """Pose the statue in a walk, a squat and with its arms overhead; none for a control model with other joints."""
    if statue.control.skeleton.names != humanoid().skeleton.names:
        return []
    poses = np.stack([synthesise_walk(80)[0][20], find_pose("squat"), find_pose("arms_up")])
    moved = people_motion(statue.control, statue.pose, poses)
    detailed = Reconstruction(statue.control, statue.map,
                              subdivide_uniform(statue.control.mesh, statue.control.chart, 3))
    bodies = statue.control.rig.vertices(moved.poses, moved.trans)
    return [(name, detailed.mesh(body)) for name, body in zip(("walking", "squatting", "arms overhead"), bodies,
                                                              strict=True)]
