"""Names of landmarks to click: a good ten, joints and points of the face, or those of a file."""
from __future__ import annotations

from pathlib import Path

from ..arguments import UsageError
from ..geometry import storage
from ..geometry.landmark_names import FACE, TEN
from ..geometry.sides import other_side

# joints of the generic humanoid of `scape statue` and points of the face, and what to aim at
HUMANOID = ("l_shoulder", "r_shoulder", "l_elbow", "r_elbow", "l_wrist", "r_wrist", "l_hip", "r_hip", "l_knee",
            "r_knee", "l_ankle", "r_ankle", "skullbase", "vl5", "l_sternoclavicular", "r_sternoclavicular", *FACE)
AIMS = {"shoulder": "middle of the rounded end of the shoulder",
        "hip": "a hand's width above the crotch, half way out, "
               "and a little nearer to the front than the middle",
        "skullbase": "middle of the neck, just below the chin", "vl5": "middle of the trunk, just below the navel",
        "sternoclavicular": "inner end of the collar bone"}

# words that stand for a list on the command line
LISTS = {"ten": TEN}


def read_names(word: str) -> tuple[str, ...]:
    """Return the names of a list, or of a text file with one in each line; ValueError for a file without any."""
    if word in LISTS:
        return LISTS[word]
    path = Path(word)
    if not path.exists():
        raise UsageError(f"--names: expected {', '.join(LISTS)}, or a text file with one name in each line; there is "
                         f"no file {word}")
    with storage.taking_apart(path, "one name in each line"):
        text = storage.read_bytes(path, "one name in each line").decode("utf-8-sig")
    names = [" ".join(line.split()) for line in text.splitlines()]
    names = [name for name in names if name and not name.startswith("#")]
    if not names:
        raise ValueError(f"{path}: expected one name in each line, found none")
    return tuple(dict.fromkeys(names))


def next_name(names: tuple[str, ...], done: set[str], last: str | None) -> str | None:
    """Return the name to offer after `last`: its other side, else the next that is not done; None when all are done."""
    mirrored = other_side(last) if last else None
    if mirrored in names and mirrored not in done:
        return mirrored
    # search from the last name on, and then from the beginning
    start = names.index(last) + 1 if last in names else 0
    return next((name for name in (*names[start:], *names[:start]) if name not in done), None)
