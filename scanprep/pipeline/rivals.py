"""Two bodies that explain a scan as well: the other one lies in the set too, until somebody chooses.

    set/meshes/NAME.ply  the registration;  set/rivals/NAME.ply  its rival, with pictures and figures
"""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..batch.values import load_step_header, load_value, save_value
from ..registration.figures import ScanFigures, Verdict
from ..registration.limbs import PlausibilityIssue
from ..registration.unmarked import RIVAL

RIVALS = "rivals"
CHOSEN = "chosen"
# 1 is where a doubt begins: both bodies lie on the scan, and neither is wrong for having a rival
TWO_BODIES = PlausibilityIssue(1.0, f"{RIVAL}: choose between the two with scape pick SET")


def rival_file(name: str) -> str:
    """Where the mesh of the other body of a scan stands in a set."""
    return f"{RIVALS}/{name}.ply"


def save_figures(folder: Path, rival: ScanFigures, chosen: bool) -> None:
    """Keep the figures of a rival in a folder, and whether somebody chose between the two bodies."""
    save_value(folder / RIVALS / f"{rival.name}.npz", rival, {CHOSEN: chosen})


def load_figures(folder: Path, name: str) -> ScanFigures:
    """The figures of the rival of a scan; StorageError where they are missing or damaged."""
    found = load_value(folder / RIVALS / f"{name}.npz")
    assert isinstance(found, ScanFigures), "only figures are kept there"
    return found


def has_rival(folder: Path, name: str) -> bool:
    """Whether a scan has a rival in a folder, chosen or not."""
    return (folder / rival_file(name)).is_file()


def is_chosen(folder: Path, name: str) -> bool:
    """Whether somebody chose between the two bodies of a scan in a folder."""
    header = load_step_header(folder / RIVALS / f"{name}.npz")
    return header is not None and bool(header.get(CHOSEN))


def doubt_rival(verdict: Verdict, folder: Path) -> Verdict:
    """The same verdict, doubted where the scan has a rival in a folder and nobody chose."""
    if verdict.failed or not has_rival(folder, verdict.name) or is_chosen(folder, verdict.name) \
            or TWO_BODIES.words in verdict.reasons:
        return verdict
    return replace(verdict, badness=max(verdict.badness, TWO_BODIES.excess),
                   reasons=(*verdict.reasons, TWO_BODIES.words))
