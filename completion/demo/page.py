"""The page of the demonstration: a picture of every stage."""
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from model.report import picture_components, picture_parts
from scanprep.console import Metric
from scanprep.geometry import storage
from scanprep.geometry.files import read_mesh
from scanprep.pictures.camera import look_around, upright
from scanprep.pictures.gltf import animated_glb
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Shape, Solid, heat, part_colors, render, side_by_side
from scanprep.pictures.sheets import save_png

from ..motion_pictures import animated_picture, chart_residuals, picture_frames
from ..partial.report import COMPLETED, HEIGHT, MEASURED, picture_completion, picture_distance
from .chain import PARTS, Demo
from .truth import surface_error

FAR = 0.01                 # metres at the end of the heat maps


def write_page(demo: Demo, metrics: list[Metric], tell: Callable[[int, int], None], to: Path) -> None:
    """Write `report.html`, the animated GLB and pictures into a folder."""
    page = Page("From raw scans to a moving person",
                "Every stage of the chain on synthetic people, whose true shape, pose and correspondence are known.")
    page.table([(m.name, m.text(), m.unit) for m in metrics], ("against the ground truth", "value", "unit"))
    stages: tuple[Callable[[Demo, Page], None], ...] = (
        _scans, _template, _registration, _skeleton, _shapes, _poses, partial(_completion, to=to),
        partial(_animation, to=to))
    for i, stage in enumerate(stages):
        stage(demo, page)
        tell(i + 1, len(stages))
    save_png(to / "overview.png", overview(demo))
    page.write(to / "report.html")


def overview(demo: Demo, height: int = 400) -> np.ndarray:
    """The chain in one row of pictures: scan, registration, parts, body shapes, completion, animation."""
    template, model, done = demo.template, demo.model, demo.completion
    name = demo.scans[1].name                       # the first pose after rest
    registered = template.with_vertices(demo.prepared.registered.vertices([name])[0])
    rest = np.zeros((len(model.skeleton.parents), 3))
    people = [template.with_vertices(model.vertices(rest, betas)) for betas in (np.array([-1.8]), np.array([1.8]))]
    walking = demo.motion.vertices(demo.subject, np.array([0, len(demo.motion.poses) // 4]))
    colors = np.where(done.seen[:, None], MEASURED, COMPLETED)
    shown: list[tuple[Shape, np.ndarray, float, str]] = [
        (read_mesh(demo.folder / "scans" / f"{name}.ply"), registered.vertices, 25, "scan"),
        (registered, registered.vertices, 25, "registered"),
        (Solid(template, part_colors(model.skeleton.part_of_face)), template.vertices, 0, "parts found"),
        *((person, np.concatenate([p.vertices for p in people]), 15.0, "body shape") for person in people),
        (Solid(demo.half_scan[0], MEASURED), done.completed.vertices, -30, "half a view"),
        (Solid(done.completed, colors), done.completed.vertices, 30, "completed"),
        *((template.with_vertices(v), v, 40.0, "animated") for v in walking)]
    images = []
    for shape, fits, turn, _ in shown:
        camera = look_around(template, fits, (turn,))[0]
        images.append(render(shape, camera, max(150, int(height * camera.width / camera.height) + 8), height))
    return side_by_side(images, [label for *_, label in shown])


def _scans(demo: Demo, page: Page) -> None:
    page.section("Scans", "Four range views of each person, as a scanner sees them: 2 mm noise, holes under the arms, "
                 "between the legs and wherever nothing was in sight. Seen from behind, a surface is dark.")
    chosen = demo.scans[:3] + [s for s in demo.scans if s.subject != "subject"][:3]
    images = []
    for one in chosen:
        mesh = read_mesh(one.path)
        images.append(render(mesh, look_around(demo.template, mesh.vertices, (25,))[0], 300, HEIGHT))
    page.picture(side_by_side(images, [s.name for s in chosen]), "six of the scans")


def _template(demo: Demo, page: Page) -> None:
    page.section("Template", "A careful scan of the subject at rest: its views merged in a volume, its holes filled, "
                 "decimated to well-shaped triangles. All other scans are described by bending it.")
    mesh, (front, side, back, _) = demo.template, look_around(demo.template)
    colored = picture_distance(mesh, surface_error(mesh, demo.rest), [front, back], FAR,
                               title="distance to the true surface")
    triangles = render(Solid(mesh, smooth=False), side.closer(1.0), 300, HEIGHT)
    page.pictures([triangles, colored], [f"{len(mesh.faces):,} triangles", "error of the template"])


def _registration(demo: Demo, page: Page) -> None:
    page.section("Registration", "The template on the scans: first bent by the landmarks, then drawn to the scan, at "
                 "last following it to its noise.")
    registered = demo.prepared.registered
    names = registered.names
    errors = {}
    meshes = {}
    for name, vertices in zip(names, registered.vertices(), strict=True):
        meshes[name] = demo.template.with_vertices(vertices)
        errors[name] = surface_error(meshes[name], demo.truths[name])
    order = sorted(names, key=lambda name: -errors[name].mean())
    images = []
    for name in order[:4]:
        camera = look_around(demo.template, meshes[name].vertices, (25,))[0]
        scan = render(read_mesh(demo.folder / "scans" / f"{name}.ply"), camera, 300, 420)
        images.append(side_by_side([scan, render(meshes[name], camera, 300, 420),
                                    render(Solid(meshes[name], heat(errors[name], 0, FAR)), camera, 300, 420)],
                                   [name, "registered", f"{1000 * errors[name].mean():.1f} mm from the truth"]))
    page.text("The four worst, with heat from 0 (light) to 10 mm (dark).")
    page.picture(side_by_side(images[:2])).picture(side_by_side(images[2:]))
    page.table([(f.name, 1000 * f.distance, 1000 * float(errors[f.name].mean()), 100 * f.seen)
                for f in sorted(demo.prepared.figures, key=lambda f: -errors[f.name].mean())],
               ("scan", "to the scan (mm)", "to the truth (mm)", "with data (%)"))


def _skeleton(demo: Demo, page: Page) -> None:
    page.section("Skeleton", f"The {PARTS} parts that move most rigidly, found from the registered "
                 "poses of the subject, and the joints between them.")
    skeleton = demo.model.skeleton
    page.picture(picture_parts(demo.template, skeleton), "parts and joints")


def _shapes(demo: Demo, page: Page) -> None:
    page.section("Body shape", "The mean person and the first principal components of the shape deformations, each at "
                 "two standard deviations to either side.")
    page.picture(picture_components(demo.model), "mean and components")


def _poses(demo: Demo, page: Page) -> None:
    page.section("Poses that were never scanned", "The model in held-out poses, coloured by the distance of "
                 "corresponding points to the truth.")
    images = []
    for truth in demo.held_out:
        wanted = demo.truth_map.vertices(truth)
        found = demo.fitted(wanted)
        error = np.linalg.norm(found - wanted, axis=1)
        camera = look_around(demo.template, found, (25,))[0]
        mesh = Solid(demo.template.with_vertices(found), heat(error, 0, 3 * FAR))
        pair = [render(truth.mesh, camera, 260, 400), render(mesh, camera, 260, 400)]
        images.append(side_by_side(pair, ["truth", f"model, {1000 * error.mean():.1f} mm"]))
    page.picture(side_by_side(images, columns=3), "heat from 0 (light) to 30 mm (dark)")


def _completion(demo: Demo, page: Page, to: Path) -> None:
    page.section("Completion", "One camera saw the person from one side, in a pose that is in no training scan. Blue "
                 "was measured, yellow was filled in by the model.")
    half, marks, truth = demo.half_scan
    image = picture_completion(half, demo.completion, demo.template)
    save_png(to / "completed" / "completion.png", image)
    error = np.linalg.norm(demo.completion.completed.vertices - demo.truth_map.vertices(truth), axis=1)
    views = look_around(demo.template, demo.completion.completed.vertices, (-30, 150))
    page.picture(image, f"{len(marks)} landmarks, then the scan itself")
    page.picture(picture_distance(demo.completion.completed, error, views, 3 * FAR,
                                  title="distance of corresponding points"))


def _animation(demo: Demo, page: Page, to: Path) -> None:
    sequence, _, _ = demo.walk
    motion, subject = demo.motion, demo.subject
    page.section("Animation", f"{len(sequence.labels)} markers of a walk, 3% of them missing at any time, and the body "
                 "that follows them.")
    glb = animated_glb(subject.template.faces, motion.vertices(subject), motion.rate, up=upright(subject.template)[0])
    with storage.writing(to / "animation" / "walk.glb") as beside:
        beside.write_bytes(glb)
    page.picture(picture_frames(motion, subject, sequence.positions), "some frames with the measured markers")
    page.picture(animated_picture(motion, subject), "the walk")
    page.chart(chart_residuals(motion), "distance of the markers to where the body puts them")
    page.download("walk.glb", glb, "the walk as an animated GLB")
