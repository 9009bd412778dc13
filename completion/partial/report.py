"""Pictures and report page of a completed scan."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from model.fitting.scan import View, all_points, as_views, scale_view
from scanprep.console import Metric
from scanprep.geometry import rotations
from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.camera import Camera, stance
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane, picture_panes
from scanprep.pictures.shading import Dots, Heat, Shape, Solid
from scanprep.pictures.sheets import webp_bytes

from .completion import Completion

MEASURED, COMPLETED = (0.55, 0.67, 0.80), (0.93, 0.75, 0.42)         # blue and yellow, as the page says
HEIGHT = 520                         # pixels of the pictures and of the page's bodies
ERROR, OFF = "expected error", "distance of the scan to the {} body"


def picture_completion(panes: Sequence[Pane], completion: Completion, template: Mesh) -> np.ndarray:
    """Render the panes of `completion_panes`, and the completed body from behind."""
    behind = view_of(completion, template, -1.0)
    return picture_panes([*panes, replace(panes[1], camera=behind, label="completed, from behind")], HEIGHT)


def view_of(completion: Completion, template: Mesh, way: float = 1.0) -> Camera:
    """Return a camera before the side of the completed body that was seen; with -1, behind it."""
    body = completion.completed
    vertical, ahead = stance(template, rotations.exp(completion.pose[0]))
    # mean normal of the observed surface, made horizontal
    towards = (body.vertex_areas * completion.seen) @ body.vertex_normals
    towards -= (towards @ vertical) * vertical
    # a scan from all sides has hardly any mean normal: then the front is first
    side = towards / np.linalg.norm(towards) if np.linalg.norm(towards) > 0.05 * body.vertex_areas.sum() else ahead
    return Camera.from_side(body, way * side, vertical)


def scan_shapes(scan: View | Sequence[View], masked: np.ndarray | None = None, metres: float = 1.0
                ) -> list[Solid | Dots]:
    """Return the shapes of a scan for a picture: each view in its own shade, masked points in violet."""
    out: list[Solid | Dots] = []
    start = 0
    for number, view in enumerate(scale_view(view, metres) for view in as_views(scan)):
        points = view.vertices if isinstance(view, Mesh) else view.points if isinstance(view, PointCloud) \
            else view[:, :3]
        hidden = np.zeros(len(points), dtype=bool) if masked is None else masked[start:start + len(points)]
        shade = np.array(MEASURED) * (1.0, 0.82, 1.12, 0.7)[number % 4]
        colors = np.where(hidden[:, None], (0.62, 0.48, 0.66), np.clip(shade, 0, 1))        # clothing is violet
        start += len(points)
        if isinstance(view, Mesh) and len(view.faces):
            out.append(Solid(view, colors))
        else:
            thinned = slice(None, None, max(1, len(points) // 9000))
            out.append(Dots(points[thinned], colors[thinned], radius=0.005))
    return out


def completion_panes(scan: View | Sequence[View], completion: Completion, template: Mesh,
                     masked: np.ndarray | None = None, landmarks: tuple[np.ndarray, np.ndarray] | None = None,
                     names: Mapping[int, str] | None = None) -> list[Pane]:
    """Return panes of the scan and of the completed body, which can show the scan and the predicted body as well.

    `masked` and `landmarks` are those of `complete`, in the unit of the scan; `names` are those of landmark vertices.
    """
    camera, scan_parts = view_of(completion, template), scan_shapes(scan, masked, completion.scale)
    marks: list[Shape] = []
    if landmarks is not None:
        labels = [(names or {}).get(int(v), "") for v in landmarks[0]]
        marks = [Dots(completion.scale * np.asarray(landmarks[1]), (0.80, 0.12, 0.10), 0.010, True, name="landmarks",
                      labels=labels)]
    over = [replace(shape, name="scan over it", visible=False, color=(0.45, 0.42, 0.50)) for shape in scan_parts]
    # other colours of the bodies: the scan's own, its distance as seen at the vertices (NaN without data), the error
    body, shades = completion.completed, dict[str, np.ndarray | Heat]()
    if body.colors is not None:
        shades["colours of the scan"] = body.colors
    points = completion.scale * all_points(scan)
    points = points if masked is None else points[~masked]
    off, near = cKDTree(points).query(body.vertices, 3)
    # 5 and 15 mm end the colour scales: the completed body is nearer to the scan than the model's own
    for mesh, high, which in ((body, 0.005, "completed"), (completion.predicted, 0.015, "predicted")):
        far = Surface(mesh).closest(points).distances[near].mean(axis=1)
        title = OFF.format(which)
        shades[title] = Heat(np.where(completion.seen & (off[:, 0] < 0.05), far, np.nan), 0.0, high, title)
    if completion.expected_error is not None:
        high = float(np.ceil(200 * np.nanquantile(completion.expected_error, 0.98)) / 200)
        shades[ERROR] = Heat(completion.expected_error, 0.0, max(high, 0.005), ERROR)
    # the two bodies with their colours, the predicted one hidden at first
    whole = Solid(Mesh(body.vertices, body.faces), np.where(completion.seen[:, None], MEASURED, COMPLETED),
                  name="completed body", shades=shades)
    predicted = Solid(completion.predicted, (0.62, 0.74, 0.62), name="predicted body", visible=False,
                      shades={title: shades[title] for title in (OFF.format("predicted"), ERROR) if title in shades})
    return [Pane([*scan_parts, *marks], camera, "scan"), Pane([whole, *over, predicted, *marks], camera, "completed")]


def completion_page(panes: Sequence[Pane], name: str, metrics: Sequence[Metric], picture: np.ndarray,
                    masked: bool = False) -> Page:
    """Write the page of `scape complete` from its panes, the scan's name, the figures and a picture."""
    page = Page(f"{name}, completed", "Blue was measured, yellow was filled in by the body model."
                + (" Violet is clothing or hair: the body is somewhere inside." if masked else ""))
    page.bodies(panes, "Drag to turn. The list of colours shows how far the scan is from the body, and how far each "
                "part of the surface may be off.", HEIGHT, webp_bytes(picture))
    page.figures(metrics)
    return page.section("What the colours say").text(
        "Distance of the scan: grey has no data. The completed body follows the scan, up to its noise; the predicted "
        "body is the model's own, and where it is far off the model cannot follow.\n\n"
        "Expected error: small where it was measured, larger the further it is from what was, and the less the model "
        "and the usual poses say of it.\n\n"
        "Colours of the scan: carried over where it was seen; elsewhere grey, or spread smoothly when "
        "fill_colors = true in a --config file asks for it.")
