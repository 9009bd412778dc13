"""The files of `scape mosh`: of a person, and of each sequence."""
from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scanprep.console import plain
from scanprep.geometry import storage
from scanprep.geometry.storage import writing

from ...motion import spread_frames
from ..artefacts.virtual import fault_table, write_virtual
from ..files.motion_files import write_glb, write_motion, write_residuals
from ..results import MarkerFaults, MoshResult
from .takes import Take


def write_person(folder: Path, result: MoshResult, about: Mapping[str, Any]) -> None:
    """subject.json with the betas and how they were found, layout.json with where the markers sat.

    Parameters
    ----------
    about : what JSON can hold
        The model, the layout that was given, held-out markers.
    """
    person = result.person
    moved = dict(zip(result.layout.labels, person.moved.tolist(), strict=True))
    storage.write_json(folder / "subject.json", {
        "betas": result.betas.tolist(), **plain(about), "frames": person.frames.tolist(), "moved": moved,
        "residual": person.residual, "energies": plain(person.energies), "converged": bool(person.converged)})
    result.layout.save(folder / "layout.json")


def write_take(folder: Path, take: Take, keys: int, factor: float = 1.0) -> None:
    """All files of a sequence but its page.

    Parameters
    ----------
    keys : int
        Largest number of key frames in a GLB.
    factor : float
        On the change of shape in exaggerated.glb, which is written where it is not 1.
    """
    motion, body, soft = take.motion, take.subject, take.soft
    write_motion(folder, motion, body)
    shown = spread_frames(len(motion.poses), keys)
    write_glb(folder / "animation.glb", motion, body, keys, None if soft is None else take.bodies(shown))
    if soft is not None:
        soft.save(folder / "soft_tissue.npz")
        write_residuals(folder / "residuals_soft.csv", soft.motion)
        if factor != 1:
            write_glb(folder / "exaggerated.glb", soft.motion, body, keys, soft.vertices(take.model, shown, factor))
    c3d = take.path.suffix.lower() == ".c3d"
    write_virtual(folder / "virtual.c3d", take.faults, take.path if c3d else None, take.who, take.unit)
    write_faults(folder, take.faults)


def write_faults(folder: Path, faults: MarkerFaults) -> None:
    """faults.json with exchanged labels, bad spans and how much was filled in, and the spans as faults.csv."""
    storage.write_json(folder / "faults.json", fault_table(faults))
    rows: list[tuple[str, str, int, int, str]] = [
        *(("exchanged", f"{e.first} {e.second}", e.begin, e.end, "") for e in faults.exchanges),
        *((b.kind, b.label, b.begin, b.end, f"{b.distance:.4g}") for b in faults.bad)]
    with writing(folder / "faults.csv") as beside, open(beside, "w", newline="", encoding="utf-8") as out:
        table = csv.writer(out)
        table.writerow(["fault", "markers", "begin", "end", "distance"])
        rows.sort(key=lambda row: (row[2], row[1]))
        table.writerows(rows)
