"""The page of the demonstration, with a picture of every stage."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from model.report import component_panes, parts_panes
from scanprep.console import Metric
from scanprep.geometry.files import read_mesh
from scanprep.geometry.landmarks import match_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.judgement import Judgement
from scanprep.pictures.camera import look_around
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import CLAY, Heat, Solid
from scanprep.pictures.thinning import thin_solid

from ..mocap.files.motion_files import write_glb
from ..motion_pictures import pane_with_dots
from ..partial.report import HEIGHT, completion_panes
from .chain import Demo
from .truth import distance, mean_over_area, surface_error

FAR = 0.01                 # metres at the dark end of the heat maps


def write_page(demo: Demo, metrics: list[Metric], judgement: Judgement,
               report_progress: Callable[[int, int], None], to: Path) -> None:
    """Write `report.html` and the animated GLB into a folder."""
    page = Page("From raw scans to a moving person",
                "Every stage of the chain on the built-in people, whose true shape, pose and correspondence are known.")
    page.verdict(judgement, "Next, your own scans: `scape prep run scans --template template.ply -o set`")
    page.figures(metrics, ("measured against the truth", "value", "unit"))
    stages: tuple[Callable[[Demo, Page], None], ...] = (
        _scans, _template, _registration, _skeleton, _shapes, _poses, _completion, partial(_animation, to=to))
    for i, stage in enumerate(stages):
        stage(demo, page)
        report_progress(i + 1, len(stages))
    page.write(to / "report.html")


def _pane(demo: Demo, shape: Mesh | Solid, fits: np.ndarray, label: str, turn: float = 25.0) -> Pane:
    """Make a pane of a shape, framed like the vertices `fits`, seen from `turn` degrees beside the front."""
    solid = shape if isinstance(shape, Solid) else Solid(shape)
    # 15,000 triangles are enough for one of many bodies on the page
    return Pane([thin_solid(solid, 15_000)], look_around(demo.template, fits, (turn,))[0], label)


def _in_rows(page: Page, panes: Sequence[Pane], caption: str) -> None:
    """Add panes in figures of two pairs each."""
    for i in range(0, len(panes), 4):
        page.bodies(panes[i:i + 4], caption, 340)


def _scans(demo: Demo, page: Page) -> None:
    """Add six scans."""
    page.section("Scans", "Four range views of each person, as a scanner sees them: 2 mm noise, holes under the arms, "
                 "between the legs and wherever nothing was in sight. Seen from behind, a surface is dark.")
    chosen = demo.scans[:3] + [s for s in demo.scans if s.subject != "subject"][:3]
    meshes = [read_mesh(one.path) for one in chosen]
    page.bodies([_pane(demo, mesh, mesh.vertices, one.name) for one, mesh in zip(chosen, meshes, strict=True)],
                "six of the scans", 340)


def _template(demo: Demo, page: Page) -> None:
    """Add the template and its error."""
    page.section("Template", "A careful scan of the subject at rest: its views merged in a volume, its holes filled, "
                 "decimated to well-shaped triangles. All other scans are described by bending it.")
    mesh = demo.template
    error = Heat(surface_error(mesh, demo.rest), 0, FAR, "distance to the true surface")
    page.bodies([Pane([Solid(mesh, smooth=False)], look_around(mesh, turns=(25,))[0], f"{len(mesh.faces):,} triangles"),
                 Pane([Solid(mesh, error)], look_around(mesh, turns=(25,))[0], "error of the template")])


def _registration(demo: Demo, page: Page) -> None:
    """Add the worst registrations."""
    page.section("Registration", "The template on the scans: first bent by the landmarks, then drawn to the scan, at "
                 "last following it to its noise.")
    registered = demo.prepared.registered
    meshes = {name: demo.template.with_vertices(vertices)
              for name, vertices in zip(registered.names, registered.vertices(), strict=True)}
    means = {name: 1000 * mean_over_area(off, demo.template) for name, (off, _) in demo.off.items()}
    order = sorted(means, key=lambda name: -means[name])
    panes = []
    for name in order[:4]:
        fits, off = meshes[name].vertices, Heat(demo.off[name][0], 0, FAR, "distance to the truth")
        panes += [_pane(demo, read_mesh(demo.folder / "scans" / f"{name}.ply"), fits, name),
                  _pane(demo, Solid(meshes[name], off, shades={"plain": np.array(CLAY)}), fits,
                        f"{means[name]:.2f} mm from the truth")]
    _in_rows(page, panes, "the worst: the scan, and the template on it")


def _skeleton(demo: Demo, page: Page) -> None:
    """Add parts and joints."""
    page.section("Skeleton", "The parts that move rigidly, found from the registered poses of the subject without "
                 "being told how many, and the joints between them.")
    skeleton = demo.model.skeleton
    page.bodies(parts_panes(demo.template, skeleton), "parts and joints")


def _shapes(demo: Demo, page: Page) -> None:
    """Add the mean body and the first shape components."""
    page.section("Body shape", "The mean person and the first principal components of the shape deformations, each at "
                 "two standard deviations to either side.")
    page.bodies(component_panes(demo.model), "mean and components", 300)


def _poses(demo: Demo, page: Page) -> None:
    """Add the held-out poses, each beside the truth."""
    page.section("Poses that were never scanned", "The model in held-out poses, coloured by the distance of "
                 "corresponding points to the truth.")
    panes = []
    for truth in demo.held_out:
        wanted = demo.truth_map.vertices(truth)
        fitted = demo.fit_pose(wanted)
        error = distance(fitted, wanted)
        error_shade = Heat(error, 0, 3 * FAR, "distance of corresponding points")
        panes += [_pane(demo, truth.mesh, fitted, "truth"),
                  _pane(demo, Solid(demo.template.with_vertices(fitted), error_shade), fitted,
                        f"model, {1000 * mean_over_area(error, demo.template):.1f} mm")]
    _in_rows(page, panes, "the truth, and the model beside it")


def _completion(demo: Demo, page: Page) -> None:
    """Add the half view, the completed body, and its error."""
    page.section("Completion", "One camera saw the person from one side, in a pose that is in no training scan. Blue "
                 "was measured, yellow was filled in by the model.")
    half, marks, truth = demo.half_scan
    done = demo.completion
    error = distance(done.completed.vertices, demo.truth_map.vertices(truth))
    names, vertices, points = match_landmarks(demo.template_landmarks, marks)
    scan, whole = completion_panes(half, done, demo.template, landmarks=(vertices, points),
                                   names=dict(zip(vertices.tolist(), names, strict=True)))
    off = Solid(done.completed, Heat(error, 0, 3 * FAR, "distance of corresponding points"), name="error")
    page.bodies([scan, whole, Pane([off], whole.camera, "how far it is from the truth")],
                f"{len(marks)} landmarks and the scan, what became of it, and its error", HEIGHT)


def _animation(demo: Demo, page: Page, to: Path) -> None:
    """Add the walk with its markers."""
    sequence, motion, subject = demo.walk, demo.motion, demo.subject
    page.section("Animation", f"{len(sequence.labels)} markers of a walk, 3% of them missing at any time, and the body "
                 "that follows them.")
    write_glb(to / "animation" / "walk.glb", motion, subject)
    page.bodies([pane_with_dots(motion, subject, sequence.positions, "measured markers", sequence.labels)],
                "the walk with the measured markers", 480)
    page.text("animation/walk.glb, beside this page, plays in any viewer of glTF.")
