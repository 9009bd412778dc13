"""`scape model coregister`: a folder of scans registered with a model, and the model learned again."""
from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar
from scanprep.dataset import RegisteredSet
from scanprep.geometry.landmarks import match_landmarks, read_landmarks, write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.pipeline import find_scans
from scanprep.ranges import Count, Share, Workers

from ..body import BodyModel
from ..cli import ModelArg
from ..files import load_model
from .config import CoregistrationConfig
from .folder import TABLE, RoundsFolder, write_table
from .rounds import Coregistration, coregister
from .single import Landmarks

MM = 1000.0
OWN = "template"                     # whose scans they are where nothing says it

ScansArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCANS")]


def coregister_scans(model: ModelArg, scans: ScansArg, output: Output, landmarks: Path | None = None,
                     first: Path | None = None, subject: str = OWN, unit: Unit | None = None,
                     rounds: Count = CoregistrationConfig.rounds, workers: Workers = CoregistrationConfig.workers,
                     failed: Share = CoregistrationConfig.failed) -> Outcome:
    """Register every scan of a folder with a model as prior, learn the model again, and so on until it settles.

    Writes a registered set with model.npz in it. Killed and started again it goes on where it was.

    Example: scape model coregister model.npz scans --first set -o better

    Args:
        model: A first model, learned from whatever registrations there are.
        scans: Folder of meshes or point clouds. scans.csv in it may say more: name,subject,pose,sex.
        output: Folder of the new registered set.
        landmarks: Folder of landmark files with the names of the scans; else scans/landmarks, or beside the scans.
        first: Registered set of the same scans, where each search begins; bad ones do no harm.
        subject: Whose scans they are, where scans.csv does not say; else all of the template's person.
        unit: Unit of the scans and landmarks, where the files cannot tell.
        rounds: Most times that all scans are registered and the model is learned.
        workers: Processes; 0 for one a core.
        failed: A scan of which a larger share of points stays unexplained does not teach the model.
    """
    from scanprep.batch.tasks import read_scan

    loaded, tasks = load_model(model), find_scans(scans, landmarks, subject)
    config = CoregistrationConfig(rounds=rounds, workers=workers, failed=failed)
    read, marks, kept, failures = [], [], [], []
    for task in tasks:
        try:
            scan = read_scan(task.scan, unit)
            marks.append(_landmarks(loaded, task.landmarks, scan, unit))
        except (ValueError, OSError) as error:
            text = " ".join(str(error).split())
            failures.append(text if str(task.scan) in text or str(task.landmarks) in text else f"{task.scan}: {text}")
            continue
        read.append(scan)
        kept.append(task)
    if not kept:
        raise ValueError(f"{scans}: none of {len(tasks)} scans can be read; the first: {failures[0]}")
    names = [task.name for task in kept]
    starts = _starts(first, loaded, names)
    store = RoundsFolder(output / "rounds", loaded, names, [task.fingerprint() for task in kept], config)
    with bar("co-registering") as progress:
        done = coregister(loaded, read, marks, config, starts, [task.subject for task in kept], progress, store)
    registered = RegisteredSet.create(output, loaded.template)
    for task, found in zip(kept, done.registrations, strict=True):
        registered = registered.add(task.name, found.mesh, task.subject, task.pose, task.sex)
    registered.with_skeleton(done.model.skeleton)
    write_landmarks(output / "landmarks.json", loaded.info.get("landmarks", {}))
    write_table(output / TABLE, names, done.registrations, done.good)
    done.model.save(output / "model.npz")
    return Outcome(output, _figures(done, names), {"coregistration": config}, failures)


def _figures(done: Coregistration, names: Sequence[str]) -> list[Metric]:
    found = done.registrations
    bad = [name for name, fine in zip(names, done.good, strict=True) if not fine]
    return [Metric("scans registered", f"{int(done.good.sum())} of {len(found)}"),
            Metric("failed", ", ".join(bad) or "none"),
            Metric("rounds", done.rounds), Metric("converged", done.converged),
            *(Metric(f"round {i}: failed", turn.failed) for i, turn in enumerate(done.history, 1)),
            *(Metric(f"round {i}: mean vertex moved", MM * turn.change, "mm")
              for i, turn in enumerate(done.history, 1) if i > 1),
            Metric("distance to the scan, median RMS", MM * float(np.median([r.rms for r in found])), "mm"),
            Metric("scan explained, mean", 100 * float(np.mean([r.explained for r in found])), "%"),
            Metric("distance from the model, median RMS", MM * float(np.median([r.apart for r in found])), "mm"),
            Metric("flipped triangles", sum(r.flipped for r in found))]


def _landmarks(model: BodyModel, path: Path | None, scan: Mesh | np.ndarray, unit: Unit | None) -> Landmarks | None:
    if path is None or not model.info.get("landmarks"):
        return None
    found = read_landmarks(path, scan if isinstance(scan, Mesh) else None, unit)
    try:
        return match_landmarks(model.info["landmarks"], found)[1:]
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def _starts(first: Path | None, model: BodyModel, names: Sequence[str]) -> list[np.ndarray | None]:
    """The earlier registrations of scans, where a set has them."""
    if first is None:
        return [None for _ in names]
    earlier = RegisteredSet.load(first)
    if not np.array_equal(earlier.template.faces, model.template.faces):
        raise ValueError(f"{first}: expected the triangles of the model ({model.template}), found {earlier.template}")
    return [earlier.vertices([name])[0] if name in earlier.names else None for name in names]
