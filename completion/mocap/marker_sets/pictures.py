"""Pictures and report page of a marker layout on a body."""
from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Rays
from scanprep.pictures.camera import look_around
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import Dots, Solid, contact_sheet, render
from scanprep.pictures.sheets import font, webp_bytes
from scanprep.skeleton.tree import Skeleton
from scanprep.words import printable

from .layout import MarkerLayout
from .symmetry import label_pairs

HEIGHT = 1000                        # pixels, so that labels are legible
FIXED, LOOSE = (0.86, 0.24, 0.20), (0.93, 0.62, 0.12)


def picture_layout(body: Mesh, layout: MarkerLayout) -> np.ndarray:
    """Render a body with its markers from four sides as (H, W, 3) uint8; visible markers have their label.

    Loose markers have another colour.
    """
    from PIL import Image, ImageDraw

    cameras, height, images = look_around(body), HEIGHT, []
    width, size = int(height * max(c.width / c.height for c in cameras)) + 100, font(12)
    points, radius = layout.place(body), 0.0055 * float(np.ptp(body.vertices, axis=0).max())
    labels = [printable(label) for label in layout.labels]
    colors = np.array([LOOSE if label in layout.loose else FIXED for label in layout.labels])
    for camera in cameras:
        image = Image.fromarray(render([Solid(body), Dots(points, colors, radius)], camera, width, height))
        draw, taken = ImageDraw.Draw(image), list[tuple[float, float, float, float]]()
        # markers behind the body get no label
        towards = camera.position - points
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        hidden = Rays(body).test_occlusion(points + 1e-4 * towards, towards)
        places = camera.project(points, width, height)
        # a label beside each marker, at the first of six places without another label
        for i in np.argsort(places[:, 1]):
            if hidden[i]:
                continue
            wide, (x, y) = draw.textlength(labels[i], font=size), places[i]
            boxes = [(a, b, a + wide, b + 13) for a, b in (
                (x + 7, y - 7), (x - 7 - wide, y - 7), (x + 5, y - 20), (x + 5, y + 6), (x - 5 - wide, y - 20),
                (x - 5 - wide, y + 6))]
            free = [box for box in boxes if not any(
                box[0] < other[2] and other[0] < box[2] and box[1] < other[3] and other[1] < box[3]
                for other in taken)]
            taken.append((free or boxes)[0])
            draw.text(taken[-1][:2], labels[i], fill=(24, 40, 92), font=size)
        images.append(np.asarray(image))
    return contact_sheet(images, ("front", "its left", "back", "its right"))


def layout_rows(body: Mesh, layout: MarkerLayout, skeleton: Skeleton | None = None) -> list[tuple[str, ...]]:
    """Return for every marker: label, other labels, part of the body, partner, distance from the skin, and kind."""
    pairs = label_pairs(layout.labels)
    parts = None if skeleton is None else skeleton.part_of_vertex(body)
    others: dict[str, list[str]] = {}
    for alias, label in layout.aliases.items():
        others.setdefault(label, []).append(alias)
    vertices = layout.nearest
    rows: list[tuple[str, ...]] = []
    for i, label in enumerate(layout.labels):
        partner = "-" if pairs[i] < 0 else "middle" if pairs[i] == i else layout.labels[pairs[i]]
        part = "" if skeleton is None or parts is None else skeleton.names[parts[vertices[i]]]
        rows.append((label, ", ".join(others.get(label, [])), part, partner,
                     f"{1000 * np.asarray(layout.distances)[i]:.1f} mm", "loose" if label in layout.loose else "fixed"))
    return rows


def layout_pane(body: Mesh, layout: MarkerLayout) -> Pane:
    """Return a body with its markers, fixed and loose ones as separate objects."""
    points, loose = layout.place(body), np.isin(layout.labels, layout.loose)
    radius = 0.0055 * float(np.ptp(body.vertices, axis=0).max())
    dots = [Dots(points[which], color, radius, name=name, labels=np.array(layout.labels)[which].tolist())
            for name, color, which in (("fixed", FIXED, ~loose), ("loose", LOOSE, loose)) if which.any()]
    return Pane([Solid(body), *dots], look_around(body, turns=(20,))[0])


def layout_page(name: str, body: Mesh, layout: MarkerLayout, picture: np.ndarray, figures: Mapping[str, str],
                skeleton: Skeleton | None = None) -> Page:
    """Make the page of `scape layout show`; the picture is shown until the body is loaded."""
    page = Page(f"Markers: {name}", "Red markers sit on a point of the anatomy, yellow ones anywhere on their limb.")
    page.bodies([layout_pane(body, layout)], "", 640, webp_bytes(picture))
    page.table(list(figures.items()), ("", ""))
    page.section("Markers").table(
        layout_rows(body, layout, skeleton), ("label", "also", "part", "partner", "from the skin", "place"))
    return page
