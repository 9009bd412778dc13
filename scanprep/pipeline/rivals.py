"""Rivals: where two bodies explain a scan equally well, the second one is also kept until the user chooses.

    set/meshes/NAME.ply  the registration;  set/rivals/NAME.ply  its rival, with pictures and figures
"""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from ..batch.values import load_step_header, load_value, save_value
from ..dataset import SetEntry
from ..registration.figures import ScanFigures, Verdict
from ..registration.limbs import PlausibilityIssue
from ..registration.unmarked import RIVAL

RIVALS = "rivals"           # folder beside that of the meshes
CHOSEN = "chosen"           # key in the header of a rival's figures
# 1, where a doubt just begins: both bodies fit the scan, and one of them is right
TWO_BODIES = PlausibilityIssue(1.0, f"{RIVAL}: choose between the two with scape pick SET")


def rival_file(name: str) -> str:
    """Return the path of a scan's second body inside a set."""
    return f"{RIVALS}/{name}.ply"


def save_figures(folder: Path, rival: ScanFigures, chosen: bool) -> None:
    """Write the figures of a rival into a folder, and whether the user chose between the two bodies."""
    save_value(folder / RIVALS / f"{rival.name}.npz", rival, {CHOSEN: chosen})


def load_figures(folder: Path, name: str) -> ScanFigures:
    """Read the figures of the rival of a scan; StorageError where they are missing or damaged."""
    figures = load_value(folder / RIVALS / f"{name}.npz")
    assert isinstance(figures, ScanFigures), "only figures are kept there"
    return figures


def has_rival(folder: Path, name: str) -> bool:
    """Return whether a scan has a rival in a folder, chosen or not."""
    return (folder / rival_file(name)).is_file()


def is_chosen(folder: Path, name: str) -> bool:
    """Return whether the user chose between the two bodies of a scan."""
    header = load_step_header(folder / RIVALS / f"{name}.npz")
    return header is not None and bool(header.get(CHOSEN))


def doubt_rivals(verdicts: Iterable[Verdict], folder: Path, entries: Iterable[SetEntry]) -> list[Verdict]:
    """Return verdicts on the scans of a set, worst first; one more doubt where the user has to choose of two bodies."""
    # the folder of both bodies: that of a later round, if that was better
    places = {entry.name: (folder / entry.file).parents[1] for entry in entries}
    doubted = [doubt_rival(verdict, places.get(verdict.name, folder)) for verdict in verdicts]
    return sorted(doubted, key=lambda verdict: (-verdict.badness, verdict.name))


def doubt_rival(verdict: Verdict, folder: Path) -> Verdict:
    """Return the verdict, with a doubt added where the scan has a rival and nobody chose."""
    if verdict.failed or not has_rival(folder, verdict.name) or is_chosen(folder, verdict.name) \
            or TWO_BODIES.words in verdict.reasons:
        return verdict
    return replace(verdict, badness=max(verdict.badness, TWO_BODIES.excess),
                   reasons=(*verdict.reasons, TWO_BODIES.words))
