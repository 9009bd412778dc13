"""The page of measurements: tapes drawn on the bodies, and a table."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.measurement.catalogue import CATALOGUE
from model.measurement.measure import Measurements
from model.measurement.tapes import Girth, Height, Tapes
from scanprep.cli import MM
from scanprep.pictures.camera import Camera
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import Bones, Dots, Shape, Solid

SHOWN = 6                            # bodies that turn on the page, and columns of its table
SKIN, TAPE, WAY, HEIGHT = (0.86, 0.83, 0.79), (0.80, 0.20, 0.16), (0.10, 0.38, 0.66), (0.25, 0.30, 0.38)
THICK = 0.003                        # metres
BESIDE = 0.045                       # metres between the lines of heights


def measures_page(names: Sequence[str], bodies: Sequence[np.ndarray], found: Sequence[Measurements], tapes: Tapes
                  ) -> Page:
    """The page of `scape measure`, of bodies (N, 3) as they were measured."""
    several = f"{len(names)} bodies" if len(names) > 1 else names[0]
    page = Page(f"{several}, measured", "Where the tape ran on each body. Metres in the table file, millimetres here.")
    shown = range(min(SHOWN, len(names)))
    page.bodies([_pane(names[k], bodies[k], found[k], tapes) for k in shown],
                "Red: girths, a tape that spans hollows. Blue: lengths along the skin and widths. Grey, beside the "
                "body: heights. Drag to turn; the list hides and shows them.", 560)
    if len(names) > SHOWN:
        page.text(f"The first {SHOWN} of {len(names)} bodies; all are in the table file.")
    rows = [(name.replace("_", " "), *(_cell(found[k], name) for k in shown), CATALOGUE[name].standard)
            for name in CATALOGUE if any(name in found[k].readings for k in shown)]
    page.table(rows, ("mm", *(names[k] for k in shown), "term and standard"))
    notes = [(names[k], line) for k in shown for line in (
        *found[k].turned, *(f"no {name.replace('_', ' ')}: {why}" for name, why in found[k].missing.items()))]
    if notes:
        page.section("To be looked at").table(notes)
    return page.section("How it is measured").text(
        "Where each tape runs was found once on the template, from its landmarks and its shape, and goes with the "
        "vertices: the centre of every girth is the centre of the same ring of skin, and its plane is cut anew on each "
        "body. Trunk, head and thighs are measured level, arms, shins and neck across their own axis. Lengths along "
        "the skin are exact shortest ways over the same landmarks.\n\n"
        "± is the error to be expected from what the scan showed of the body, root mean square; it is known of "
        "completed bodies. It does not tell how far a landmark is from the bone that the standard names.")


def _cell(mine: Measurements, name: str) -> str:
    if name not in mine.readings:
        return "–"
    error = f" ± {MM * mine.errors[name]:.0f}" if name in mine.errors else ""
    return f"{MM * mine.values[name]:,.0f}{error}"


def _pane(name: str, vertices: np.ndarray, mine: Measurements, tapes: Tapes) -> Pane:
    """A body with its tapes; the lines of heights stand beside it."""
    mesh = tapes.template.with_vertices(vertices)
    up, left, ahead = mine.axes
    girths, ways, heights = ([mine.readings[n].curve for n in mine.readings if kind(n)] for kind in (
        lambda n: isinstance(tapes.found[n], Girth),
        lambda n: not isinstance(tapes.found[n], Girth | Height),
        lambda n: isinstance(tapes.found[n], Height)))
    side = float((vertices @ left).max()) + BESIDE
    beside = [curve + (side + k * BESIDE - curve @ left)[:, None] * left for k, curve in enumerate(heights)]
    shapes: list[Shape] = [Solid(mesh, SKIN, name="body")]
    for curves, color, what in ((girths, TAPE, "girths"), (ways, WAY, "lengths and widths"),
                                (beside, HEIGHT, "heights")):
        if curves:
            shapes.append(Bones(np.concatenate([c[:-1] for c in curves]), np.concatenate([c[1:] for c in curves]),
                                color, THICK, name=what))
    if beside:
        words = [n.replace("_", " ") for n in mine.readings if isinstance(tapes.found[n], Height)]
        shapes.append(Dots(np.array([c[-1] for c in beside]), HEIGHT, 0.008, labels=words))
    points = np.concatenate([vertices, *beside])
    return Pane(shapes, Camera.from_side(points, ahead, up), name)
