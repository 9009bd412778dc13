"""The command `scape complete`."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from model.body import BodyModel
from model.cli import read_subject
from model.files import load_model
from model.linear import Subject
from scanprep.cli import MM, Output, ScanArg, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.geometry.landmarks import match_landmarks, read_landmark_vertices, read_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pipeline import LANDMARK_ENDINGS, read_scan

from ..cli import ModelFile, rows
from .completion import complete
from .results import save_completion
from .settings import CompletionConfig


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
    page = completion_page(data, done, loaded.template, scan.name, rows(metrics))
    page.write(output / "report.html")
    return Outcome(output, metrics, {"complete": config})


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
