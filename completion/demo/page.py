"""The page of the demonstration, with a picture of every stage."""
from __future__ import annotations

from collections.abc import Callable, Iterator
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
    for i, (title, text, panes) in enumerate((*_show_scans(demo), *_show_model(demo), *_show_unseen(demo))):
        page.section(title, text).bodies(panes, height=HEIGHT if len(panes) < 4 else 340)
        report_progress(i + 1, 8)
    write_glb(to / "animation" / "walk.glb", demo.motion, demo.subject)
    page.text("animation/walk.glb, beside this page, plays in any viewer of glTF.").write(to / "report.html")


def _pane(demo: Demo, shape: Mesh | Solid, fits: np.ndarray, label: str) -> Pane:
    """Make a pane of a shape, framed like the vertices `fits`."""
    solid = shape if isinstance(shape, Solid) else Solid(shape)
    # 15,000 triangles are enough for one of many bodies on the page
    return Pane([thin_solid(solid, 15_000)], look_around(demo.template, fits, (25,))[0], label)


def _show_scans(demo: Demo) -> Iterator[tuple[str, str, list[Pane]]]:
    """Yield title, text and panes of the scans, the template with its error, and the worst registration."""
    chosen = demo.scans[:2] + [one for one in demo.scans if one.subject != "subject"][:2]
    meshes = {one.name: read_mesh(one.path) for one in chosen}
    yield ("Scans", "Four range views of each person, as a scanner sees them: 2 mm noise, holes under the arms, "
           "between the legs and wherever nothing was in sight. Seen from behind, a surface is dark.",
           [_pane(demo, mesh, mesh.vertices, name) for name, mesh in meshes.items()])
    template = demo.template
    error = Solid(template, Heat(surface_error(template, demo.rest), 0, FAR, "distance to the true surface"))
    yield ("Template", "A careful scan of the subject at rest: its views merged in a volume, its holes filled, "
           "decimated to well-shaped triangles. All other scans are described by bending it.",
           [Pane([error], look_around(template, turns=(25,))[0], f"{len(template.faces):,} triangles")])
    means = {name: 1000 * mean_over_area(off, template) for name, (off, _) in demo.off.items()}
    worst = max(means, key=means.__getitem__)
    body = template.with_vertices(demo.prepared.registered.vertices([worst])[0])
    off = Solid(body, Heat(demo.off[worst][0], 0, FAR, "distance to the truth"), shades={"plain": np.array(CLAY)})
    yield ("Registration", "The worst scan, and the template on it: first bent by the landmarks, then drawn to the "
           "scan, at last following it to its noise.",
           [_pane(demo, read_mesh(demo.folder / "scans" / f"{worst}.ply"), body.vertices, worst),
            _pane(demo, off, body.vertices, f"{means[worst]:.2f} mm from the truth")])


def _show_model(demo: Demo) -> Iterator[tuple[str, str, list[Pane]]]:
    """Yield title, text and panes of the parts with their joints, and of the shape components."""
    yield ("Skeleton", "The parts that move rigidly, found from the registered poses of the subject without being told "
           "how many, and the joints between them.", parts_panes(demo.template, demo.model.skeleton))
    yield ("Body shape", "The mean person and the first principal components of the shape deformations, each at two "
           "standard deviations to either side.", component_panes(demo.model))


def _show_unseen(demo: Demo) -> Iterator[tuple[str, str, list[Pane]]]:
    """Yield title, text and panes of a held-out pose, the completed half view, and the walk."""
    wanted = demo.true_places(demo.held_out[0])
    fitted = demo.fit_pose(wanted)
    error = Heat(distance(fitted, wanted), 0, 3 * FAR, "distance of corresponding points")
    yield ("Poses that were never scanned", "A held-out pose, and the model in it, coloured by its error.",
           [_pane(demo, demo.held_out[0].mesh, fitted, "truth"),
            _pane(demo, Solid(demo.template.with_vertices(fitted), error), fitted, "model")])
    half, marks, truth = demo.half_scan
    done = demo.completion
    names, vertices, points = match_landmarks(demo.template_landmarks, marks)
    scan, whole = completion_panes(half, done, demo.template, landmarks=(vertices, points),
                                   names=dict(zip(vertices.tolist(), names, strict=True)))
    error = Heat(distance(done.completed.vertices, demo.true_places(truth)), 0, 3 * FAR,
                 "distance of corresponding points")
    yield ("Completion", "One camera saw the person from one side, in a pose that is in no training scan. Blue was "
           "measured, yellow was filled in by the model.",
           [scan, whole, Pane([Solid(done.completed, error, name="error")], whole.camera, "how far it is off")])
    yield ("Animation", f"{len(demo.walk.labels)} markers of a walk, 3% of them missing at any time, and the body that "
           "follows them.",
           [pane_with_dots(demo.motion, demo.subject, demo.walk.positions, "measured markers", demo.walk.labels)])
