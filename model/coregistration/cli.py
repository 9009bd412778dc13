"""`scape model coregister`: a folder of scans registered with a model, and the model learned again."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from scanprep.arguments import Place
from scanprep.batch.workspace import Workspace
from scanprep.cli import Output, Person, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.dataset import RegisteredSet, SetEntry, write_set
from scanprep.geometry.files import write_mesh
from scanprep.geometry.landmarks import read_landmarks, try_match_landmarks, write_landmarks
from scanprep.geometry.tables import write_table
from scanprep.judgement import Judgement
from scanprep.pipeline.scan import mesh_file
from scanprep.pipeline.scans import ScanTask, find_scans

from ..body import BodyModel
from ..cli import ModelArg
from ..files import load_model
from .config import CoregistrationConfig
from .rounds import Coregistration, coregister, coregistration_doubts, coregistration_problem

ScansArg = Annotated[Path, Place("SCANS")]


def coregister_scans(model: ModelArg, scans: ScansArg, output: Output, landmarks: Path | None = None,
                     first: Path | None = None, subject: Annotated[str, Person] = "template", unit: Unit | None = None,
                     config: CoregistrationConfig = CoregistrationConfig(), *, space: Workspace) -> Outcome:
    """Register every scan of a folder with a model as prior, learn the model again, and so on until it settles.

    Writes a registered set with model.npz in it. Killed and started again it goes on where it was. Of a scan that has
    changed the first registration is made anew, and of all others those after it, as the model has learned from it.

    Example: scape model coregister model.npz scans --first set -o better

    Args:
        model: A first model, learned from whatever registrations there are.
        scans: Folder of meshes or point clouds. scans.csv in it may say more: name,subject,pose,sex.
        output: Folder of the new registered set.
        landmarks: Folder of landmark files with the names of the scans; else scans/landmarks, or beside the scans.
        first: Registered set of the same scans, where each search begins; bad ones do no harm.
        subject: Whose scans they are, where scans.csv does not say; else all of the template's person.
        unit: Unit of the scans and landmarks, where the files cannot tell.
        config: Settings.
    """
    from scanprep.geometry.files import read_scan

    loaded, tasks = load_model(model), find_scans(scans, landmarks, subject)
    # a scan that cannot be read is reported and stops no other
    read, marks, kept, failures = [], [], [], []
    for task in tasks:
        try:
            scan, known = read_scan(task.scan, unit), loaded.info.get("landmarks")
            marks.append(try_match_landmarks(task.landmarks, known, read_landmarks(task.landmarks, scan, unit))
                         if task.landmarks and known else None)
        except (ValueError, OSError) as error:
            text = " ".join(str(error).split())
            failures.append(text if str(task.scan) in text or str(task.landmarks) in text else f"{task.scan}: {text}")
            continue
        read.append(scan)
        kept.append(task)
    if not kept:
        raise ValueError(f"{scans}: none of {len(tasks)} scans can be read; the first: {failures[0]}")
    names = [task.name for task in kept]
    # the earlier registrations of scans, where a set has them
    earlier = None if first is None else RegisteredSet.load(first)
    if earlier is not None and not np.array_equal(earlier.template.faces, loaded.template.faces):
        raise ValueError(f"{first}: expected the triangles of the model ({loaded.template}), found {earlier.template}")
    starts = [earlier.vertices([name])[0] if earlier is not None and name in earlier.names else None for name in names]
    with bar("co-registering") as progress:
        done = coregister(loaded, read, marks, config, starts, [task.subject for task in kept], progress, names, space)
    with space.staging("set") as staged:
        write_coregistered(staged.folder, loaded, kept, done)
    return Outcome(output, _figures(done, names), {"coregistration": config}, [*failures, *done.failures.values()],
                   judgement=Judgement.of(coregistration_problem(done, read), coregistration_doubts(done, names)))


def write_coregistered(folder: Path, first: BodyModel, tasks: Sequence[ScanTask], done: Coregistration) -> None:
    """Write a registered set of the scans, the model learned from it, and a table of figures."""
    registered = {task: r for task, r in zip(tasks, done.registrations, strict=True) if r is not None}
    write_set(folder, first.template, [SetEntry(t.name, t.subject, t.pose, t.sex, mesh_file(t.name))
                                       for t in registered])
    for task, r in registered.items():
        write_mesh(folder / mesh_file(task.name), r.mesh)
    done.model.skeleton.save(folder / "skeleton.json")
    write_landmarks(folder / "landmarks.json", first.info.get("landmarks", {}))
    # figures of every registration, and the model of the last round
    figures = ("rms", "explained", "apart", "landmark_rms", "inverted", "starts")
    write_table(folder / "coregistration.csv", ["name", "good", *figures], [
        [task.name, bool(fine), *(getattr(r, figure) for figure in figures)]
        for task, fine, r in zip(tasks, done.good, done.registrations, strict=True) if r is not None])
    done.model.save(folder / "model.npz")


def _figures(done: Coregistration, names: Sequence[str]) -> list[Metric]:
    made = [r for r in done.registrations if r is not None]
    bad = [name for name, fine in zip(names, done.good, strict=True) if not fine]
    return [Metric("scans registered", f"{int(done.good.sum())} of {len(done.good)}"),
            Metric("failed", ", ".join(bad) or "none"),
            Metric("rounds", done.rounds), Metric("converged", done.converged),
            *(Metric(f"round {i}: failed", failed) for i, failed in enumerate(done.failed, 1)),
            *(Metric(f"round {i}: mean vertex moved", 1e3 * change, "mm")
              for i, change in enumerate(done.changes, 1) if i > 1),
            Metric("distance to the scan, median RMS", 1e3 * float(np.median([r.rms for r in made])), "mm"),
            Metric("scan explained, mean", 100 * float(np.mean([r.explained for r in made])), "%"),
            Metric("distance from the model, median RMS", 1e3 * float(np.median([r.apart for r in made])), "mm"),
            Metric("inverted triangles", sum(r.inverted for r in made))]
