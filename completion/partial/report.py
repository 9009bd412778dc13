"""Pictures and the page of a completed scan."""
from __future__ import annotations

from typing import Any

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import Camera
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, Shape, Solid, color_bar, heat, render, side_by_side
from scanprep.pictures.views import upright

from .completion import Completion

MEASURED, COMPLETED = (0.55, 0.67, 0.80), (0.93, 0.75, 0.42)
HEIGHT = 520


def picture_completion(scan: Mesh | np.ndarray, completion: Completion, template: Mesh, height: int = HEIGHT
                       ) -> np.ndarray:
    """The scan, and the completed body in two colours from the side that was seen and from behind.

    Parameters
    ----------
    template : Mesh
        At rest: says which axis is up.
    """
    body = completion.completed
    up, _ = upright(template)
    weights = body.vertex_areas * completion.seen
    towards = np.roll((weights @ body.vertex_normals), -up)[1:]
    azimuth = float(np.degrees(np.arctan2(towards[1], towards[0])))
    views = [Camera.around(body, azimuth + turn, up=up) for turn in (0, 180)]
    colors = np.where(completion.seen[:, None], MEASURED, COMPLETED)
    given: Shape = Solid(scan, MEASURED) if isinstance(scan, Mesh) else Dots(scan, MEASURED, radius=0.003)
    shown: list[tuple[Shape, Camera, str]] = [
        (given, views[0], "scan, from the camera"), (given, views[1], "scan, from behind"),
        (Solid(body, colors), views[0], "completed"), (Solid(body, colors), views[1], "completed, from behind"),
        (Solid(completion.predicted), views[1], "predicted, from behind")]
    width = int(height * max(v.width / v.height for v in views)) + 10
    return side_by_side([render(shape, view, width, height) for shape, view, _ in shown],
                        [label for _, _, label in shown])


def picture_distance(mesh: Mesh, distance: np.ndarray, views: list[Camera], high: float = 0.01,
                     height: int = HEIGHT, title: str = "distance") -> np.ndarray:
    """A mesh coloured by a distance (N,) in metres from several sides, with its colour bar."""
    width = int(height * max(v.width / v.height for v in views)) + 10
    colored = Solid(mesh, heat(distance, 0.0, high))
    images = [render(colored, view, width, height) for view in views]
    return side_by_side([side_by_side(images), color_bar(0.0, high, title)], columns=1)


def completion_page(scan: Mesh | np.ndarray, completion: Completion, template: Mesh, name: str,
                    rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape complete`."""
    page = Page(f"{name}, completed", "Blue was measured, yellow was filled in by the body model.")
    page.picture(picture_completion(scan, completion, template))
    return page.table(rows, ("metric", "value", "unit"))
