"""Pictures and the page of a marker set."""
from __future__ import annotations

from typing import Any

import numpy as np

from model.body import BodyModel
from scanprep.geometry.mesh import Mesh
from scanprep.pictures.camera import look_around
from scanprep.pictures.page import Page
from scanprep.pictures.shading import Dots, render, side_by_side

from ..marker_sets.layout import MarkerLayout
from .results import MarkerDesign

CHOSEN, KEPT, LEFT = (0.80, 0.16, 0.14), (0.16, 0.32, 0.62), (0.72, 0.72, 0.70)
SIDES = ("front", "left", "back", "right")


def picture_design(design: MarkerDesign, body: Mesh, candidates: MarkerLayout, keep: tuple[str, ...] = (),
                   height: int = 620) -> np.ndarray:
    """The body from four sides: chosen markers red, those kept blue, those left out small and grey.

    Parameters
    ----------
    body : Mesh
        Standing.
    """
    skin = MarkerLayout(candidates.labels, candidates.vertices, 0.0, candidates.weights).place(body)
    rows = {name: [i for i, label in enumerate(candidates.labels) if pick(label)] for name, pick in {
        "chosen": lambda label: label in design.layout.labels and label not in keep,
        "kept": lambda label: label in keep,
        "left": lambda label: label not in design.layout.labels}.items()}
    size = 0.0075 * float(np.ptp(body.vertices, axis=0).max())
    shapes = [body] + [Dots(skin[rows[name]], color, radius) for name, color, radius in
                       (("chosen", CHOSEN, size), ("kept", KEPT, size), ("left", LEFT, 0.6 * size)) if rows[name]]
    cameras = look_around(body)
    wide = max(camera.width / camera.height for camera in cameras)
    return side_by_side([render(shapes, camera, int(wide * height) + 10, height) for camera in cameras], SIDES)


def chart_curve(design: MarkerDesign) -> Any:
    """A matplotlib figure: the error over the number of markers."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator, ScalarFormatter

    figure = Figure(figsize=(7.5, 3.4))
    axes = figure.add_subplot()
    for curve in design.curves:
        axes.plot(curve.counts, 1000 * curve.rmse, linewidth=1.4, label=curve.name)
    axes.plot(len(design.layout.labels), 1000 * design.rmse, "o", color="black", markersize=5, label="chosen")
    if design.checks:
        axes.plot([c.count for c in design.checks], [1000 * c.full for c in design.checks], "x", color="black",
                  label="by full refits")
    axes.axhline(1000 * design.floor, color="0.6", linewidth=0.8, linestyle=":", label="whole surface seen")
    axes.set(xlabel="markers", ylabel="RMSE of all vertices (mm)", yscale="log")
    low, high = axes.get_ylim()
    axes.set_yticks([tick for power in range(-2, 5) for tick in np.array([1, 1.5, 2, 3, 5, 7]) * 10.0**power
                     if low <= tick <= high], minor=False)
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_locator(NullLocator())
    axes.legend(frameon=False)
    return figure


def chart_rows(design: MarkerDesign) -> str:
    """The curves as CSV: which one, markers, RMSE in millimetres, and the labels that came or went."""
    lines = ["curve,markers,rmse_mm,labels"]
    for curve in design.curves:
        steps = zip(((), *curve.steps), curve.counts.tolist(), (1000 * curve.rmse).tolist(), strict=True)
        lines += [f'"{curve.name}",{count},{rmse:.4f},"{" ".join(labels)}"' for labels, count, rmse in steps]
    return "\n".join(lines) + "\n"


def mean_person(model: BodyModel) -> Mesh:
    """The mean person as the template stands."""
    return model.template.with_vertices(model.vertices(np.zeros((len(model.skeleton.parents), 3)),
                                                       np.zeros(model.n_betas)))


def design_page(design: MarkerDesign, model: BodyModel, candidates: MarkerLayout, keep: tuple[str, ...],
                rows: list[tuple[str, Any, str]]) -> Page:
    """The page of `scape layout design`."""
    page = Page(f"{len(design.layout.labels)} markers", "Chosen so that bodies estimated from them are near the true "
                "ones over their whole surface. Red: chosen; blue: kept; grey: left out.")
    page.picture(picture_design(design, mean_person(model), candidates, keep))
    chosen = [label for label in design.layout.labels if label not in keep]
    page.text(f"Chosen: {', '.join(chosen) or 'none'}." + (f" Kept: {', '.join(keep)}." if keep else ""))
    page.section("Error and number of markers").chart(chart_curve(design), "root mean squared distance of all vertices "
                                                      "of all bodies; linearised, crosses by full refits")
    page.section("Figures").table(rows, ("metric", "value", "unit"))
    page.section("Order", "In which markers, or pairs, came or went, and the error after each.")
    for curve in design.curves:
        steps = zip(curve.steps, curve.counts[1:].tolist(), (1000 * curve.rmse[1:]).tolist(), strict=True)
        page.text(f"{curve.name}:")
        page.table([(count, " ".join(labels), f"{rmse:.2f}") for labels, count, rmse in steps],
                   ("markers", "came" if curve.name == "added" else "went", "RMSE (mm)"))
    return page
