"""The command `scape animate`."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from model.cli import read_subject
from model.files import load_model
from scanprep.cli import MM, Output, Unit
from scanprep.console import Metric, Outcome, bar

from ..cli import ModelFile, rows
from ..markers.files import read_markers
from ..markers.layout import MarkerLayout
from .follow import AnimateConfig, animate

MarkersArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MARKERS")]


def animate_markers(markers: MarkersArg, model: ModelFile, output: Output, layout: Path, subject: Path | None = None,
                    unit: Unit | None = None, keys: int = 120,
                    config: Annotated[AnimateConfig, tyro.conf.arg(name="")] = AnimateConfig()) -> Outcome:  # noqa: B008
    """The motion of a known subject from markers.

    Example: scape animate walk.c3d -m model.npz --layout layout.json -o walk

    Args:
        markers: C3D, TRC or CSV.
        model: Model of `scape learn`.
        output: Folder to write motion.npz, animation.glb and report.html to.
        layout: JSON that says on which vertices the markers sit.
        subject: Betas in JSON or .npz, or a mesh in the model's triangles; else the model's template itself.
        unit: Unit of the markers, where the file cannot tell.
        keys: Largest number of key frames in the GLB.
        config: Settings.
    """
    from scanprep.pictures.animation import write_animated_glb
    from scanprep.pictures.views import upright

    from .report import motion_page

    loaded = load_model(model)
    sequence = read_markers(markers, unit)
    placed = MarkerLayout.load(layout, len(loaded.template.vertices))
    body = read_subject(loaded, subject, unit)
    with bar("following the markers") as progress:
        motion = animate(body, sequence, placed, config, progress)
    motion.save(output / "motion.npz")
    chosen = np.unique(np.linspace(0, len(motion.poses) - 1, min(keys, len(motion.poses))).round().astype(int))
    rate = motion.rate * len(chosen) / len(motion.poses)
    write_animated_glb(output / "animation.glb", body.template.faces, motion.vertices(body, chosen), rate,
                       up=upright(body.template)[0], keys=keys)
    seen = np.isfinite(motion.residuals)
    metrics = [
        Metric("frames", len(motion.poses)), Metric("rate", motion.rate, "1/s"),
        Metric("markers used", f"{int(seen.any(axis=0).sum())} of {len(sequence.labels)}"),
        Metric("distance of markers, mean", MM * float(motion.residuals[seen].mean()), "mm"),
        Metric("distance of markers, 95th percentile", MM * float(np.percentile(motion.residuals[seen], 95)), "mm"),
        Metric("markers missing", 100 * float(1 - seen[:, seen.any(axis=0)].mean()), "%"),
        Metric("frames that settled", 100 * float(motion.converged.mean()), "%")]
    motion_page(motion, body, sequence, markers.name, rows(metrics)).write(output / "report.html")
    return Outcome(output, metrics, {"animate": config})
