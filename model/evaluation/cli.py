"""`scape model evaluate` and `scape model sample`: how good a model is, and random bodies of it."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from scanprep.arguments import Alias, UsageError
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.geometry import storage
from scanprep.geometry.files import write_mesh
from scanprep.geometry.members import ONE_BODY, find_doubtful_members
from scanprep.geometry.tables import write_table
from scanprep.judgement import Judgement
from scanprep.ranges import Count, Seed

from ..body import BodyModel
from ..cli import ModelArg, read_bodies
from ..digests import digest, was_trained_on
from ..files import load_model
from ..posing.cli import read_subject
from ..shape_statistics import SEXES, WORDS, Sex
from .errors import Errors, errors_problem, pose_errors, shape_errors
from .page import MM, Findings, evaluation_page, generalisation_rows, picture_samples
from .sampling import sample_bodies


def evaluate(model: ModelArg, output: Output, poses: Path | None = None, shapes: Path | None = None,
             counts: tuple[Count, ...] = (10, 20, 40), train_shapes: Path | None = None, subject: Path | None = None,
             unit: Unit | None = None) -> Outcome:
    """Errors of a model on bodies that it was not trained on, with a page of pictures.

    Example: scape model evaluate model.npz --poses held_poses --shapes held_people -o evaluation

    Args:
        model: Model file.
        output: Folder for report.html, report.json, poses.csv and people.csv.
        poses: Held-out meshes of the model's own body, or a registered set.
        shapes: Held-out people, or a registered set, of which the first mesh of each subject counts.
        counts: Numbers of shape components to fit people with.
        train_shapes: The people that the model was trained on: adds plain PCA of vertices.
        subject: Whose poses they are, betas or a mesh; else the template's own body.
        unit: Unit of the meshes.
    """
    loaded = load_model(model)
    if poses is None and shapes is None:
        raise UsageError("nothing to measure: give --poses, --shapes, or both")
    if shapes is None and train_shapes is not None:
        raise UsageError("--train-shapes serves to judge people: give --shapes too")
    if shapes is not None and not loaded.n_betas:
        raise ValueError(f"{model}: it has no shape components, so it cannot be measured on people")
    # bodies to measure on, in the model's triangles; then what each kind of them is measured for
    nothing: tuple[None, tuple[str, ...]] = (None, ())
    posed, pose_names = read_bodies(poses, loaded.template, unit, one_person=True) if poses else nothing
    people, people_names = read_bodies(shapes, loaded.template, unit) if shapes else nothing
    train, _ = read_bodies(train_shapes, loaded.template, unit) if train_shapes else nothing
    poses_found = shapes_found = None
    if posed is not None:
        with bar("fitting poses") as progress:
            poses_found = pose_errors(loaded, posed, read_subject(loaded, subject, unit), progress=progress)
    if people is not None:
        with bar("fitting people") as progress:
            shapes_found = shape_errors(loaded, people, counts, train, progress=progress)
    found = Findings(poses_found, pose_names, posed, shapes_found, people_names, people)
    notes, metrics = _notes(loaded, posed, people), _metrics(loaded, found)
    metrics += [Metric("note", note) for note in notes]
    _write_tables(output, loaded, found)
    with bar("drawing the page") as progress:
        page = evaluation_page(model.stem, loaded, found, [m for m in metrics if m.name != "note"], notes, progress)
    # errors too large to be those of this model are a problem and not a result
    page.write(output / "report.html")
    measured = [(poses_found.errors, posed)] if poses_found is not None else []
    measured += [(shapes_found.errors[-1], people)] if shapes_found is not None else []
    problems = [errors_problem(errors, bodies, loaded) for errors, bodies in measured if bodies is not None]
    doubts = [] if posed is None else find_doubtful_members(
        loaded.template, posed, str(poses), pose_names, ONE_BODY if subject is None else np.inf)
    doubts += [] if people is None else find_doubtful_members(loaded.template, people, str(shapes), people_names)
    return Outcome(output, metrics, {"model": model, "poses": poses, "shapes": shapes, "counts": counts,
                                     "train_shapes": train_shapes, "subject": subject},
                   judgement=Judgement.of(filter(None, problems), doubts))


def sample(model: ModelArg, output: Output, count: Annotated[Count, Alias("-n")] = 9, seed: Seed = 0,
           pose_too: bool = False, sex: Sex | None = None) -> Outcome:
    """Write random bodies of a model, a sheet of their pictures, and their betas and poses.

    Example: scape model sample model.npz -n 9 -o random

    Example: scape model sample people --sex female -n 100 -o women

    Args:
        model: Model file, or the word people for the built-in one.
        output: Folder for body_1.ply, body_1.betas.json, body_1.pose.json ..., sheet.png.
        count: How many bodies.
        seed: The same seed gives the same bodies.
        pose_too: Random poses as well, from the Gaussian of the training poses; else all stand at rest.
        sex: Women or men alone, as many of any size as there are among them. Without it every other body is a woman,
            if the model tells women from men, as the built-in one does.
    """
    from scanprep.pictures.shading import save_png

    loaded = load_model(model)
    drawn = sample_bodies(loaded, count, np.random.default_rng(seed), pose_too, sex=sex)
    width = len(str(count))
    for i, vertices in enumerate(drawn.vertices):
        name = f"body_{i + 1:0{width}d}"
        write_mesh(output / f"{name}.ply", loaded.template.with_vertices(vertices))
        known = {"sex": drawn.sexes[i]} if drawn.sexes[i] else {}
        storage.write_json(output / f"{name}.betas.json", {"betas": drawn.betas[i].tolist(), **known})
        storage.write_json(output / f"{name}.pose.json",
                           dict(zip(loaded.skeleton.names, drawn.poses[i].tolist(), strict=True)))
    save_png(output / "sheet.png", picture_samples(loaded, drawn))
    rows = [Metric(WORDS[one], drawn.sexes.count(one)) for one in SEXES if one in drawn.sexes]
    extent = np.ptp(drawn.vertices, axis=1).max(axis=1)
    return Outcome(output, [
        Metric("bodies", count), *rows, Metric("shape components", drawn.betas.shape[1]),
        Metric("largest extent, smallest body", float(extent.min()), "m"),
        Metric("largest extent, largest body", float(extent.max()), "m")],
                   {"seed": seed, "pose_too": pose_too, "sex": sex}, judgement=Judgement())


def _notes(model: BodyModel, posed: np.ndarray | None, people: np.ndarray | None) -> list[str]:
    """Write notes where the model was trained on the bodies, as far as its file says."""
    if posed is not None and model.info.get("digest") == digest(model.template, posed, people):
        return ["these are the very bodies that the model was trained on, so the errors are not held-out errors"]
    notes = []
    for name, bodies in (("poses", posed), ("people", people)):
        known = None if bodies is None else was_trained_on(model, bodies)
        if known is not None and known.any():
            notes.append(f"{known.sum()} of the {len(known)} {name} trained the model, so the errors are not "
                         "held-out errors")
    if "digests" not in model.info:
        notes.append("the model file does not tell its training bodies one by one, so nobody checked that these are "
                     "others")
    return notes


def _metrics(model: BodyModel, found: Findings) -> list[Metric]:
    rows = []
    if found.poses is not None:
        rows += _about("poses", found.poses.errors, found.pose_names, found.poses.converged)
    if found.shapes is not None:
        rows += _about("people", found.shapes.errors[-1], found.shape_names, found.shapes.converged)
        # how much every number of components leaves, and plain PCA of vertices beside it
        for count, fitted, _, _, pca in generalisation_rows(found.shapes):
            rows.append(Metric(f"people, components {count}", fitted, "mm"))
            if found.shapes.vertex_pca is not None:
                rows.append(Metric(f"people, components {count}, vertex PCA", pca, "mm"))
            rows.append(Metric(f"variance, components {count}", 100 * float(model.explained[count - 1]), "%"))
    return rows


def _about(what: str, errors: Errors, names: Sequence[str], converged: np.ndarray) -> list[Metric]:
    return [Metric(what, len(errors.mean)), Metric(f"{what}: mean", MM * errors.overall, "mm"),
            Metric(f"{what}: 95th percentile", MM * float(errors.p95.mean()), "mm"),
            Metric(f"{what}: worst", names[int(errors.mean.argmax())]),
            Metric(f"{what}: mean of the worst", MM * float(errors.mean.max()), "mm"),
            Metric(f"{what}: worst vertex", MM * float(errors.worst.max()), "mm"),
            Metric(f"{what}: fits that converged", 100 * float(converged.mean()), "%")]


def _write_tables(output: Path, model: BodyModel, found: Findings) -> None:
    """Write tables with a row for every body, millimetres."""
    parts = [f"{name}_mm" for name in model.skeleton.names]
    if found.poses is not None:
        rows = _rows(found.pose_names, found.poses.errors, found.poses.converged)
        write_table(output / "poses.csv", ["name", "mean_mm", "p95_mm", "worst_mm", *parts, "converged"], rows)
    if found.shapes is not None:
        rows = [[count, *row] for count, errors, converged in
                zip(found.shapes.counts, found.shapes.errors, found.shapes.converged, strict=True)
                for row in _rows(found.shape_names, errors, converged)]
        write_table(output / "people.csv", ["components", "name", "mean_mm", "p95_mm", "worst_mm", *parts, "converged"],
                    rows)


def _rows(names: Sequence[str], errors: Errors, converged: np.ndarray) -> list[list[Any]]:
    table = np.column_stack([errors.mean, errors.p95, errors.worst, errors.by_part])
    return [[name, *(f"{MM * value:.4f}" for value in row), "yes" if done else "no"]
            for name, row, done in zip(names, table, converged, strict=True)]
