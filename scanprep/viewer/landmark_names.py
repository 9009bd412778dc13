"""Names of landmarks that people click: a good ten, CAESAR's 73, those of a file."""
from __future__ import annotations

from pathlib import Path

from ..arguments import UsageError
from ..geometry import storage
from ..geometry.landmark_names import TEN
from ..geometry.sides import other_side

_MIDDLE = ("Sellion", "Supramenton", "Nuchale", "Suprasternale", "Substernale", "Cervicale", "10th Rib Midspine",
           "Waist, Preferred, Post.", "Crotch")
_PAIRED = ("Infraorbitale", "Tragion", "Gonion", "Clavicale", "Thelion/Bustpoint", "10th Rib", "ASIS", "Iliocristale",
           "Trochanterion", "PSIS", "Acromion", "Axilla, Ant.", "Axilla, Post.", "Radial Styloid", "Ulnar Styloid",
           "Olecranon", "Humeral Lateral Epicn.", "Humeral Medial Epicn.", "Radiale", "Metacarpal Phal. II",
           "Metacarpal Phal. V", "Dactylion", "Knee Crease", "Femoral Lateral Epicn.", "Femoral Medial Epicn.",
           "Metatarsal Phal. I", "Metatarsal Phal. V", "Lateral Malleolus", "Medial Malleolus", "Sphyrion",
           "Calcaneous, Post.", "Digit II")
CAESAR = (*_MIDDLE, *(f"{side} {name}" for name in _PAIRED for side in ("Rt.", "Lt.")))

LISTS = {"ten": TEN, "caesar": CAESAR}


def read_names(given: str) -> tuple[str, ...]:
    """The names of a list, or of a text file with one in each line; ValueError for a file without any."""
    if given in LISTS:
        return LISTS[given]
    path = Path(given)
    if not path.exists():
        raise UsageError(f"--names: expected {', '.join(LISTS)}, or a text file with one name in each line; there is "
                         f"no file {given}")
    with storage.taking_apart(path, "one name in each line"):
        text = storage.read_bytes(path, "one name in each line").decode("utf-8-sig")
    names = [" ".join(line.split()) for line in text.splitlines()]
    names = [name for name in names if name and not name.startswith("#")]
    if not names:
        raise ValueError(f"{path}: expected one name in each line, found none")
    return tuple(dict.fromkeys(names))


def next_name(names: tuple[str, ...], done: set[str], last: str | None) -> str | None:
    """The name to offer after `last`: its other side, else the next in the list that is not done; None when all are."""
    mirrored = other_side(last) if last else None
    if mirrored in names and mirrored not in done:
        return mirrored
    start = names.index(last) + 1 if last in names else 0
    return next((name for name in (*names[start:], *names[:start]) if name not in done), None)
