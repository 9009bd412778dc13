"""Pictures and the page of a completed scan."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from scanprep.geometry import rotations
from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.pictures.camera import Camera, upright
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, Solid, color_bar, heat, render, side_by_side

from .completion import Completion
from .scan import View, all_points, as_views, in_metres

MEASURED, COMPLETED = (0.55, 0.67, 0.80), (0.93, 0.75, 0.42)
CLOTHING, MARK = (0.62, 0.48, 0.66), (0.80, 0.12, 0.10)
HEIGHT = 520
WIDEST = 2.0                         # times as wide as high a picture of one side may be
SIDES = ("from the camera", "from the right of it", "from the other side", "from the left of it")
FEW = 9000                           # points of a bare cloud that a picture shows


def picture_completion(scan: View | Sequence[View], completion: Completion, template: Mesh,
                       height: int | None = None, masked: np.ndarray | None = None) -> np.ndarray:
    """The scan, and the completed body in two colours from the side that was seen and from behind.

    `masked` (n,) bool.
    """
    views = [sides(completion, template)[turn] for turn in (0, 2)]
    body, colors = completion.completed, _two_colors(completion)
    given = scan_shapes(scan, masked, completion.scale)
    shown: list[tuple[Sequence[Shape], Camera, str]] = [
        (given, views[0], "scan, from the camera"), (given, views[1], "scan, from behind"),
        ([Solid(body, colors)], views[0], "completed"), ([Solid(body, colors)], views[1], "completed, from behind"),
        ([Solid(completion.predicted)], views[1], "predicted, from behind")]
    width, height = _size(views, height or HEIGHT)
    return side_by_side([render(shape, view, width, height) for shape, view, _ in shown],
                        [label for _, _, label in shown])


def sides(completion: Completion, template: Mesh) -> list[Camera]:
    """Cameras around the completed body, from the side that was seen and on by quarters."""
    body = completion.completed
    up = _up(completion, template)
    weights = body.vertex_areas * completion.seen
    towards = np.roll((weights @ body.vertex_normals), -up)[1:]
    azimuth = float(np.degrees(np.arctan2(towards[1], towards[0])))
    return [Camera.around(body, azimuth + turn, up=up) for turn in (0, 90, 180, 270)]


def scan_shapes(scan: View | Sequence[View], masked: np.ndarray | None = None, metres: float = 1.0) -> list[Shape]:
    """What a picture shows of a scan: its views, each in its own shade, and what is masked."""
    out: list[Shape] = []
    start = 0
    for number, view in enumerate(in_metres(view, metres) for view in as_views(scan)):
        points = view.vertices if isinstance(view, Mesh) else view.points if isinstance(view, PointCloud) \
            else view[:, :3]
        hidden = np.zeros(len(points), dtype=bool) if masked is None else masked[start:start + len(points)]
        shade = np.array(MEASURED) * (1.0, 0.82, 1.12, 0.7)[number % 4]
        colors = np.where(hidden[:, None], CLOTHING, np.clip(shade, 0, 1))
        start += len(points)
        if isinstance(view, Mesh) and len(view.faces):
            out.append(Solid(view, colors))
        else:
            some = slice(None, None, max(1, len(points) // FEW))
            out.append(Dots(points[some], colors[some], radius=0.005))
    return out


def picture_distance(mesh: Mesh, distance: np.ndarray, views: Sequence[Camera], high: float = 0.01,
                     title: str = "distance", labels: Sequence[str] | None = None, height: int | None = None
                     ) -> np.ndarray:
    """A mesh coloured by a distance (N,) in metres from several sides, with its colour bar; grey where it is NaN."""
    width, height = _size(views, height or HEIGHT)
    images = [render([Solid(mesh, heat(distance, 0.0, high))], view, width, height) for view in views]
    return side_by_side([side_by_side(images, labels), color_bar(0.0, high, title)], columns=1)


def scan_distances(points: np.ndarray, mesh: Mesh, body: Mesh, seen: np.ndarray) -> np.ndarray:
    """How far the scan is from a mesh, metres, as seen at the vertices (N,) of the body; NaN without data."""
    far = Surface(mesh).closest(points).distances
    off, near = cKDTree(points).query(body.vertices, 3)
    return np.where(seen & (off[:, 0] < 0.05), far[near].mean(axis=1), np.nan)


def completion_page(scan: View | Sequence[View], completion: Completion, template: Mesh, name: str,
                    rows: list[tuple[str, Any, str]], picture: np.ndarray, masked: np.ndarray | None = None,
                    landmarks: tuple[np.ndarray, np.ndarray] | None = None) -> Page:
    """The page of `scape complete`: name of the scan, rows (metric, value, unit), its `picture_completion`.

    `masked` and `landmarks` are those of `complete`, in the unit of the scan.
    """
    cameras, body = sides(completion, template), completion.completed
    plain, (width, height) = Mesh(body.vertices, body.faces), _size(cameras, HEIGHT)

    def all_sides(*shapes: Shape) -> np.ndarray:
        return side_by_side([render(list(shapes), view, width, height) for view in cameras], SIDES)

    page = Page(f"{name}, completed", "Blue was measured, yellow was filled in by the body model."
                + (" Violet is clothing or hair: the body is somewhere inside." if masked is not None else ""))
    page.picture(picture)
    page.table(rows, ("metric", "value", "unit"))
    marks = [] if landmarks is None else [Dots(completion.scale * np.asarray(landmarks[1]), MARK, 0.012, True)]
    page.section("From all sides", "The completed body." + (" Red: where the landmarks are on the scan."
                                                            if marks else ""))
    page.picture(all_sides(Solid(plain, _two_colors(completion)), *marks))
    if body.colors is not None:
        page.section("Colours", "Carried over from the scan where it was seen; elsewhere grey, or spread smoothly when "
                     "fill_colors = true in a --config file asks for it.")
        page.picture(all_sides(Solid(body)))
    page.section("Distance of the scan", "Grey: no data. The completed mesh follows the scan, up to its noise; the "
                 "predicted mesh is the model's own, and where it is far off the model cannot follow.")
    points = completion.scale * all_points(scan)
    points = points if masked is None else points[~masked]
    for mesh, high, which in ((body, 0.005, "completed"), (completion.predicted, 0.015, "predicted")):
        far = scan_distances(points, mesh, plain, completion.seen)
        page.picture(picture_distance(plain, far, cameras, high, f"distance of the scan to the {which} mesh",
                                      SIDES))
    if completion.expected_error is not None:
        page.section("Expected error", "Of each vertex: small where it was measured, larger the further it is from "
                     "what was, and the less the model and the usual poses say of it.")
        high = float(np.ceil(200 * np.nanquantile(completion.expected_error, 0.98)) / 200)
        page.picture(picture_distance(plain, completion.expected_error, cameras, max(high, 0.005), "expected error",
                                      SIDES))
    return page


def _two_colors(completion: Completion) -> np.ndarray:
    return np.where(completion.seen[:, None], MEASURED, COMPLETED)


def _up(completion: Completion, template: Mesh) -> int:
    """The axis that is up in the scan: the template's, unless the body as a whole was turned over to another."""
    up, _ = upright(template)
    turned = rotations.exp(completion.pose[0])[:, up]
    return up if turned[up] > 0.6 else int(np.argmax(turned))


def _size(views: Sequence[Camera], height: int) -> tuple[int, int]:
    """Width and height of a picture in which all views fit; one of something long is less high."""
    aspect = max(view.width / view.height for view in views)
    height = max(1, min(height, round(WIDEST * height / aspect)))
    return int(height * aspect) + 10, height
