"""The command `scape layout design`, and its page."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from model.body import BodyModel
from model.fitting.bodies import at_rest
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.dataset import RegisteredSet
from scanprep.geometry import storage
from scanprep.geometry.files import read_registered
from scanprep.judgement import Judgement
from scanprep.pictures.camera import look_around
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import Dots

from ...cli import ModelOrNone, read_model
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.named import choose_layout
from .candidates import candidate_layout
from .design import MarkerDesign, design_markers
from .fits import DesignConfig
from .linear import check_marker_bodies, example_poses, in_poses


def design(bodies: Path, output: Output, model: ModelOrNone = None, candidates: str | None = None,
           keep: str | None = None, unit: Unit | None = None, config: DesignConfig = DesignConfig()) -> Outcome:
    """Choose the markers from which bodies are estimated best.

    Of the candidates markers are taken away, and added, one by one or in pairs of left and right, always the one that
    serves best; every body is estimated from each set, and compared with the registered mesh over its whole surface.

    Example: scape layout design --bodies registered -m model.npz --keep vicon47 --count 67 -o markers

    Written are layout.json (for --layout of other commands), curve.csv and report.html.

    Args:
        bodies: Folder of meshes in the model's triangles, in any poses, or a registered set.
        output: Folder to write to.
        model: Model of `scape learn`; without it that of the built-in people.
        candidates: Layout whose markers may be chosen, one of `scape layout list` or a file; without it 114 places,
            left and right the same, spread between the markers of --keep, or of vicon47.
        keep: Layout whose markers stay in the set.
        unit: Unit of the meshes.
        config: Settings.
    """
    loaded, name = read_model(model)
    # the candidates, those that are kept among them
    kept = None if keep is None else choose_layout(loaded, keep, ())[0]
    if candidates is None:
        among = candidate_layout(loaded, choose_layout(loaded, "vicon47", ())[0] if kept is None else kept)
    else:
        among = choose_layout(loaded, candidates, ())[0]
        if kept is not None and not set(kept.labels) <= set(among.labels):
            among = among.merge(kept.without([label for label in kept.labels if label in among.labels]))
    labels = () if kept is None else kept.labels
    # bodies, posed if wanted
    found, people = _read_bodies(loaded, bodies, unit)
    if config.poses:
        with bar("posing the bodies") as progress:
            found = in_poses(loaded, found, example_poses(loaded, config.poses), progress).reshape(-1, *found.shape[1:])
        people = np.repeat(people, config.poses)
    with bar("choosing markers") as progress:
        result = design_markers(loaded, found, among, config, progress, keep=labels, people=people)
    metrics = [Metric("model", name), Metric("bodies", len(found)), Metric("candidates", len(among.labels)),
               Metric("markers", len(result.layout.labels)), Metric("RMSE of all vertices", 1000 * result.rmse, "mm"),
               Metric("the same by full refits", 1000 * result.full, "mm"),
               Metric("chosen on the other half of the people", 1000 * result.other_half, "mm"),
               Metric("with the whole surface seen", 1000 * result.floor, "mm")]
    output.mkdir(parents=True, exist_ok=True)
    result.layout.save(output / "layout.json")
    # the curves as CSV: name, markers, RMSE in millimetres, and the labels that were added or removed
    lines = ["curve,markers,rmse_mm,labels"]
    for curve in result.curves:
        steps = zip(((), *curve.steps), curve.counts.tolist(), (1000 * curve.rmse).tolist(), strict=True)
        lines += [f'"{curve.name}",{count},{rmse:.4f},"{" ".join(markers)}"' for markers, count, rmse in steps]
    storage.write_file(output / "curve.csv", "\n".join(lines) + "\n")
    design_page(result, loaded, among, labels, metrics).write(output / "report.html")
    settings = {"design": config, "model": name, "candidates": candidates, "keep": keep}
    return Outcome(output, metrics, settings, judgement=Judgement())


def _read_bodies(model: BodyModel, folder: Path, unit: Unit | None) -> tuple[np.ndarray, np.ndarray]:
    """Read vertices (Z, N, 3) from a folder or a set, and the person (Z,) of each body."""
    if (folder / "set.json").exists():
        whole = RegisteredSet.load(folder)
        faces, vertices = whole.template.faces, whole.vertices(tuple(entry.name for entry in whole.entries))
        people = np.unique([entry.subject for entry in whole.entries], return_inverse=True)[1]
    else:
        faces, vertices, *_ = read_registered(folder, unit)
        people = np.arange(len(vertices))
    if not np.array_equal(faces, model.template.faces):
        raise ValueError(f"{folder}: expected the triangles of the model ({model.template}); these have {len(faces)} "
                         f"faces and {vertices.shape[1]} vertices")
    return check_marker_bodies(model, vertices), people


def chart_curve(design: MarkerDesign) -> Any:
    """Plot the error over the number of markers."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator, ScalarFormatter

    figure = Figure(figsize=(7.5, 3.4))
    axes = figure.add_subplot()
    for curve in design.curves:
        axes.plot(curve.counts, 1000 * curve.rmse, linewidth=1.4, label=curve.name)
    axes.plot(len(design.layout.labels), 1000 * design.rmse, "o", color="black", markersize=5, label="chosen")
    axes.axhline(1000 * design.floor, color="0.6", linewidth=0.8, linestyle=":", label="whole surface seen")
    axes.set(xlabel="markers", ylabel="RMSE of all vertices (mm)", yscale="log")
    low, high = axes.get_ylim()
    axes.set_yticks([tick for power in range(-2, 5) for tick in np.array([1, 1.5, 2, 3, 5, 7]) * 10.0**power
                     if low <= tick <= high], minor=False)
    axes.yaxis.set_major_formatter(ScalarFormatter())
    axes.yaxis.set_minor_locator(NullLocator())
    axes.legend(frameon=False)
    return figure


def design_page(design: MarkerDesign, model: BodyModel, candidates: MarkerLayout, keep: tuple[str, ...],
                metrics: Sequence[Metric]) -> Page:
    """Make the page of `scape layout design`."""
    page = Page(f"{len(design.layout.labels)} markers", "Chosen so that bodies estimated from them are near the true "
                "ones over their whole surface. Red: chosen; blue: kept; grey: left out.")
    body, labels = at_rest(model), np.array(candidates.labels)
    skin = MarkerLayout(candidates.labels, candidates.vertices, 0.0, candidates.weights).place(body)
    kept, used = np.isin(labels, keep), np.isin(labels, design.layout.labels)
    size = 0.0075 * float(np.ptp(body.vertices, axis=0).max())
    dots = [Dots(skin[which], color, radius, name=name, labels=labels[which].tolist()) for name, color, radius, which in
            (("chosen", (0.80, 0.16, 0.14), size, used & ~kept), ("kept", (0.16, 0.32, 0.62), size, kept),
             ("left out", (0.72, 0.72, 0.70), 0.6 * size, ~used)) if which.any()]
    page.bodies([Pane([body, *dots], look_around(body, turns=(20,))[0])], height=560)
    chosen = [label for label in design.layout.labels if label not in keep]
    page.text(f"Chosen: {', '.join(chosen) or 'none'}." + (f" Kept: {', '.join(keep)}." if keep else ""))
    page.section("Error and number of markers").chart(chart_curve(design), "root mean squared distance of all vertices "
                                                      "of all bodies; linearised")
    return page.section("Figures").figures(metrics)
