"""The command `scape layout design`."""
from __future__ import annotations

from pathlib import Path

import numpy as np

from model.body import BodyModel
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.dataset import RegisteredSet
from scanprep.geometry import storage
from scanprep.geometry.files import read_registered

from ...cli import ModelOrNone, read_model, rows
from ..animate.work import choose_layout
from ..marker_sets.layout import MarkerLayout
from ..marker_sets.symmetry import label_pairs, marker_pairs
from .candidates import candidate_layout
from .linear import check_bodies
from .posed import example_poses, in_poses
from .report import chart_rows, design_page
from .results import MarkerDesign
from .sets import design_markers
from .settings import DesignConfig

USUAL = "vicon47"                    # around which candidates are made where none are named


def design(bodies: Path, output: Output, model: ModelOrNone = None, candidates: str | None = None,
           keep: str | None = None, poses: int = 0, unit: Unit | None = None,
           config: DesignConfig = DesignConfig()) -> Outcome:      # noqa: B008
    """Choose the markers from which bodies are estimated best.

    Of the candidates markers are taken away, and added, one by one or in pairs of left and right, always the one that
    serves best; every body is estimated from each set, and compared with the registered mesh over its whole surface.

    Example: scape layout design --bodies registered -m model.npz --keep vicon47 --count 67 -o markers

    Written are layout.json (for --layout of other commands), curve.csv and report.html.

    Args:
        bodies: Folder of meshes in the model's triangles, in any poses, or a registered set.
        output: Folder to write to.
        model: Model of `scape learn`; without it that of the synthetic people, which is made on first use.
        candidates: Layout whose markers may be chosen, one of `scape layout list` or a file; without it 114 places,
            left and right the same, spread between the markers of --keep, or of vicon47.
        keep: Layout whose markers stay in the set.
        poses: Put each body into so many different poses that the model was learned from; 0 takes them as they are.
        unit: Unit of the meshes.
        config: Settings.
    """
    loaded, name = read_model(model)
    kept = None if keep is None else choose_layout(loaded, keep, ())[0]
    among = _candidates(loaded, candidates, kept)
    labels = () if kept is None else kept.labels
    found, people = _read_bodies(loaded, bodies, unit)
    if poses:
        with bar("posing the bodies") as progress:
            found = in_poses(loaded, found, example_poses(loaded, poses), progress).reshape(-1, *found.shape[1:])
        people = np.repeat(people, poses)
    partners = label_pairs(among.labels)
    if (partners == np.arange(len(partners))).all():                 # labels that name no sides at all
        partners = marker_pairs(among, loaded.template)
    with bar("choosing markers") as progress:
        result = design_markers(loaded, found, among, config, progress, keep=labels, partners=partners, people=people)
    metrics = [Metric("model", name), *_figures(result, len(found), len(among.labels))]
    output.mkdir(parents=True, exist_ok=True)
    result.layout.save(output / "layout.json")
    with storage.writing(output / "curve.csv") as part:
        part.write_text(chart_rows(result), encoding="utf-8")
    design_page(result, loaded, among, labels, rows(metrics)).write(output / "report.html")
    settings = {"design": config, "model": name, "candidates": candidates, "keep": keep, "poses": poses}
    return Outcome(output, metrics, settings)


def _candidates(model: BodyModel, given: str | None, kept: MarkerLayout | None) -> MarkerLayout:
    """The candidates, those that are kept among them."""
    if given is None:
        return candidate_layout(model, choose_layout(model, USUAL, ())[0] if kept is None else kept)
    among = choose_layout(model, given, ())[0]
    if kept is None or set(kept.labels) <= set(among.labels):
        return among
    own = kept.without([label for label in kept.labels if label in among.labels])
    (ids, weights), (others, shares) = _on_triangles(among), _on_triangles(own)
    return MarkerLayout((*among.labels, *own.labels), np.vstack([ids, others]),
                        np.r_[np.asarray(among.distances), np.asarray(own.distances)], np.vstack([weights, shares]),
                        {**own.aliases, **among.aliases}, (*among.loose, *own.loose))


def _on_triangles(layout: MarkerLayout) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and weights (L, 3)."""
    if layout.weights is not None:
        return layout.vertices, layout.weights
    return np.repeat(layout.vertices[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (len(layout.labels), 1))


def _read_bodies(model: BodyModel, folder: Path, unit: Unit | None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (Z, N, 3) of a folder or a set, and whose each is (Z,)."""
    if (folder / "set.json").exists():
        whole = RegisteredSet.load(folder)
        faces, vertices = whole.template.faces, whole.vertices(tuple(entry.name for entry in whole.entries))
        people = np.unique([entry.subject for entry in whole.entries], return_inverse=True)[1]
    else:
        faces, vertices, _ = read_registered(folder, unit)
        people = np.arange(len(vertices))
    if not np.array_equal(faces, model.template.faces):
        raise ValueError(f"{folder}: expected the triangles of the model ({model.template}); these have {len(faces)} "
                         f"faces and {vertices.shape[1]} vertices")
    return check_bodies(model, vertices), people


def _figures(result: MarkerDesign, bodies: int, candidates: int) -> list[Metric]:
    said = [Metric("bodies", bodies), Metric("candidates", candidates), Metric("markers", len(result.layout.labels)),
            Metric("RMSE of all vertices", 1000 * result.rmse, "mm")]
    if result.full is not None:
        said.append(Metric("the same by full refits", 1000 * result.full, "mm"))
    said += [Metric("chosen on the other half of the people", 1000 * result.other_half, "mm"),
             Metric("with the whole surface seen", 1000 * result.floor, "mm")]
    return said + [Metric(f"{c.count} markers by full refits", 1000 * c.full, "mm") for c in result.checks]
