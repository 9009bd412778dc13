"""The commands of this package: `scape demo`, `scape complete`, `scape animate`."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from model.body import BodyModel
from model.cli import read_subject
from model.files import load_model
from model.linear import Subject
from scanprep.cli import MM, Output, ScanArg, Unit
from scanprep.console import Metric, Outcome, bar, say
from scanprep.geometry.landmarks import match_landmarks, read_landmark_vertices, read_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pipeline import LANDMARK_ENDINGS, read_scan

from .animation import AnimateConfig, animate
from .demo.chain import QUICK, Demo, DemoConfig
from .fit import CompletionConfig
from .markers.files import read_markers
from .markers.layout import MarkerLayout
from .partial import complete
from .results import save_completion

ModelFile = Annotated[Path, tyro.conf.arg(aliases=["-m"])]
MarkersArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MARKERS")]
Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


def demo(out: Out = Path("scape_demo"), quick: bool = False, seed: int = DemoConfig.seed) -> Outcome:
    """The whole chain on embedded people: scans, registration, skeleton, model, completion, animation.

    Example: scape demo --quick

    Interrupted and started again, it goes on where it was.

    Args:
        out: Folder to write to; report.html in it is the page to open.
        quick: A small run.
        seed: Another seed scans other people.
    """
    from .demo.figures import figures
    from .demo.page import write_page

    run = Demo(out, replace(QUICK if quick else DemoConfig(), seed=seed), bar)
    run.begin()
    metrics = figures(run)
    with bar("drawing the report") as progress:
        write_page(run, metrics, progress)
    say(f"open {out / 'report.html'} in a browser; {out / 'animation' / 'walk.glb'} in any 3D viewer")
    return Outcome(out, metrics, {"demo": run.config})


def complete_scan(scan: ScanArg, model: ModelFile, output: Output, landmarks: Path | None = None,
                  subject: str | None = None, template_landmarks: Path | None = None, unit: Unit | None = None,
                  config: Annotated[CompletionConfig, tyro.conf.arg(name="")] = CompletionConfig()  # noqa: B008
                  ) -> Outcome:
    """The whole body from a scan of some of it.

    Example: scape complete half.ply -m model.npz --landmarks half.landmarks.json -o completed

    Args:
        scan: Mesh or point cloud.
        model: Model of `scape learn`.
        output: Folder to write completed.ply, predicted.ply, completion.npz and report.html to.
        landmarks: 4 to 10 named points on the scan; else the file of the scan's name beside it.
        subject: Whose body it is: "template" for the one the model's poses were learned from, betas in JSON or .npz,
            or a mesh in the model's triangles. Without it the shape is found too.
        template_landmarks: Where these landmarks are on the model's template; else those kept in the model.
        unit: Unit of the scan and landmarks.
        config: Settings.
    """
    from .report import completion_page

    loaded, data = load_model(model), read_scan(scan, unit)
    given = landmarks or _beside(scan)
    found = read_landmarks(given, data if isinstance(data, Mesh) else None, unit)
    try:
        _, vertices, points = match_landmarks(_template_landmarks(loaded, template_landmarks, model), found)
    except ValueError as error:
        raise ValueError(f"{given}: {error}") from None
    body: BodyModel | Subject = loaded
    if subject is not None or not loaded.n_betas:
        body = read_subject(loaded, None if subject in (None, "template") else Path(subject), unit)
    with bar("completing") as progress:
        done = complete(body, data, (vertices, points), config, progress)
    save_completion(output, done)
    metrics = [
        Metric("distance of the scan to the completed mesh, RMS", MM * done.rms, "mm"),
        Metric("scan points explained", 100 * done.explained, "%"),
        Metric("vertices with data", 100 * float(done.seen.mean()), "%"),
        Metric("landmarks used", len(vertices)),
        Metric("distance of landmarks, predicted mesh, RMS", MM * done.landmark_rms, "mm"),
        Metric("converged", str(done.converged)), Metric("rounds", done.iterations)]
    page = completion_page(data, done, loaded.template, scan.name, _rows(metrics))
    page.write(output / "report.html")
    return Outcome(output, metrics, {"complete": config})


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
    motion_page(motion, body, sequence, markers.name, _rows(metrics)).write(output / "report.html")
    return Outcome(output, metrics, {"animate": config})


def _rows(metrics: list[Metric]) -> list[tuple[str, Any, str]]:
    return [(m.name, m.value, m.unit) for m in metrics]


def _beside(scan: Path) -> Path:
    stem = scan.name.split(".")[0]
    places = [scan.with_name(stem + ending) for ending in LANDMARK_ENDINGS]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise ValueError(f"{scan}: expected its landmarks in {stem}.landmarks.json beside it; "
                         "name the file with --landmarks")
    return found


def _template_landmarks(model: BodyModel, given: Path | None, path: Path) -> dict[str, int]:
    if given is not None:
        return read_landmark_vertices(given, model.template)
    kept = model.info.get("landmarks")
    if not kept:
        raise ValueError(f"{path}: the model keeps no landmarks of its template; name them with --template-landmarks")
    return {name: int(vertex) for name, vertex in kept.items()}
