"""The page of `scape model evaluate`: heat maps, the best and the worst body; and a sheet of random bodies."""
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scanprep.console import Metric
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import look_around
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane, picture_panes
from scanprep.pictures.shading import Heat, Solid

from ..body import BodyModel
from .errors import Errors, PoseErrors, ShapeErrors
from .sampling import Samples

MM = 1000.0
Tell = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Findings:
    """All results of an evaluation and the bodies they are of; None for what was not asked for."""

    poses: PoseErrors | None = None
    pose_names: tuple[str, ...] = ()
    pose_bodies: np.ndarray | None = None
    shapes: ShapeErrors | None = None
    shape_names: tuple[str, ...] = ()
    shape_bodies: np.ndarray | None = None


def evaluation_page(name: str, model: BodyModel, found: Findings, metrics: Sequence[Metric],
                    notes: Sequence[str] = (), report_progress: Tell | None = None) -> Page:
    """Make the page, self-contained: notes, the table of metrics, and pictures."""
    page = Page(f"{name}, evaluated", f"A model of kind {model.kind} with {len(model.skeleton.parents)} parts and "
                f"{model.n_betas} shape components, measured on bodies given to it.")
    for note in notes:
        page.text(f"Note: {note}.")
    page.figures(metrics)
    wanted = [section for section, there in ((_pose_section, found.poses), (_shape_section, found.shapes)) if there]
    for i, section in enumerate(wanted):
        section(page, model, found)
        if report_progress:
            report_progress(i + 1, len(wanted))
    return page


def _pose_section(page: Page, model: BodyModel, found: Findings) -> None:
    poses, bodies, names = found.poses, found.pose_bodies, found.pose_names
    assert poses is not None and bodies is not None
    page.section("Poses", "One known body, of which only pose and place were fitted. What is left is what the model "
                 "does not know about how the body bends.")
    rest = model.template.with_vertices(model.vertices(np.zeros_like(poses.poses[0]), poses.betas))
    page.bodies([error_pane(rest, poses.errors.by_vertex, "mean over the bodies")],
                "where the error lies: mean of all bodies, shown on the body at rest")
    page.bodies(extreme_panes(model, poses.errors, names, bodies, lambda i: poses.vertices(model, i), poses.poses),
                "the best and the worst body: as given, then the fitted body coloured by its error")
    # parts, the worst first
    parts = poses.errors.by_part
    page.table([(model.skeleton.names[p], MM * float(parts[:, p].mean()), MM * float(parts[:, p].max()),
                 names[int(parts[:, p].argmax())]) for p in np.argsort(-parts.mean(axis=0))],
               ("part", "mean (mm)", "worst body (mm)", "which"))


def _shape_section(page: Page, model: BodyModel, found: Findings) -> None:
    shapes, bodies, names = found.shapes, found.shape_bodies, found.shape_names
    assert shapes is not None and bodies is not None
    page.section("People", "Of every person shape, pose and place were fitted, with more and more components.")
    page.table(generalisation_rows(shapes), ("components", "fitted (mm)", "95th percentile (mm)", "worst vertex (mm)",
                                             "vertex PCA (mm)"))
    # with all components: where the error lies, and the best and the worst person
    last, count = shapes.errors[-1], int(shapes.counts[-1])
    rest = model.template.with_vertices(model.vertices(np.zeros_like(shapes.poses[0, 0]), np.zeros(1)))
    page.bodies([error_pane(rest, last.by_vertex, f"mean over the people, {count} components")],
                "where the error lies: mean of all people, shown on the mean person")
    page.bodies(extreme_panes(model, last, names, bodies, lambda i: shapes.vertices(model, -1, i), shapes.poses[-1]),
                "the best and the worst person: as given, then the fitted body coloured by its error")


def generalisation_rows(shapes: ShapeErrors) -> list[tuple[int, float, float, float, float]]:
    """List by components: fitted, 95th percentile, worst vertex, vertex PCA (NaN without), millimetres."""
    pca = [np.nan] * len(shapes.counts) if shapes.vertex_pca is None else [MM * e.overall for e in shapes.vertex_pca]
    return [(int(k), MM * e.overall, MM * float(e.p95.mean()), MM * float(e.worst.max()), plain)
            for k, e, plain in zip(shapes.counts, shapes.errors, pca, strict=True)]


def error_pane(body: Mesh, distance: np.ndarray, title: str) -> Pane:
    """Draw a body coloured by a distance (N,) in metres."""
    high = float(np.percentile(distance, 99.5))
    return Pane([Solid(body, Heat(distance, 0.0, high, title))], look_around(body, turns=(20,))[0])


def extreme_panes(model: BodyModel, errors: Errors, names: Sequence[str], bodies: np.ndarray,
                  make: Callable[[int], np.ndarray], poses: np.ndarray) -> list[Pane]:
    """Draw the best and the worst body as given, and beside each the fitted one (`make(i)`), coloured by error.

    `poses` (M, J, 3) are those of the bodies.
    """
    shown = [("best", int(errors.mean.argmin())), ("worst", int(errors.mean.argmax()))]
    made = [make(i) for _, i in shown]
    high = max(float(np.percentile(np.linalg.norm(y - bodies[i], axis=1), 99))
               for y, (_, i) in zip(made, shown, strict=True))
    panes = []
    for (word, i), y in zip(shown, made, strict=True):
        turned = model.skeleton.part_rotations(poses[i])[0]
        camera, = look_around(model.template, bodies[i], (25,), turned)
        off = Heat(np.linalg.norm(y - bodies[i], axis=1), 0.0, high, "distance")
        panes += [Pane([model.template.with_vertices(bodies[i])], camera, f"{word}: {names[i]}"),
                  Pane([Solid(model.template.with_vertices(y), off)], camera,
                       f"{MM * errors.mean[i]:.1f} mm, up to {MM * errors.worst[i]:.0f}")]
    return panes


def picture_samples(model: BodyModel, samples: Samples) -> np.ndarray:
    """Picture random bodies on a contact sheet, numbered."""
    camera = look_around(model.template, samples.vertices, (25,))[0]
    panes = [Pane([model.template.with_vertices(v)], camera, str(i + 1)) for i, v in enumerate(samples.vertices)]
    rows = max(1, round(np.sqrt(len(panes) / 2.5)))
    return picture_panes(panes, 300, -(-len(panes) // rows))
