"""Left and right in the names of landmarks, markers and joints."""
from __future__ import annotations

import re

_WORDS = re.compile(r"(?<![A-Za-z])(?i:left|right|lt|rt)(?![A-Za-z])|(?<![A-Za-z])(?:[Ll]eft|[Rr]ight)(?=[A-Z])"
                    r"|(?<=[a-z0-9])(?:Left|Right)(?![a-z])")
_LETTER = re.compile(r"^[LR](?=[A-Z0-9._ -])|^[lr](?=[._ -])|(?<=[._ -])[LRlr]$|(?<=[a-z0-9])[LR]$")
_OTHER = {"L": "R", "R": "L", "l": "r", "r": "l", "left": "right", "right": "left", "lt": "rt", "rt": "lt"}


def other_side(label: str) -> str | None:
    """Return the label of the same place on the other side; None for a label without a side.

    Sides are an L or R in front (LELB, L.Knee), one at the end (elbow_l, KneeR), or the words left, right,
    Lt. and Rt. (knee_left, LeftKnee).
    """
    if _WORDS.search(label):
        return _WORDS.sub(lambda found: _like(found[0]), label, count=1)
    if _LETTER.search(label):
        return _LETTER.sub(lambda found: _OTHER[found[0]], label, count=1)
    return None


def side_of(label: str) -> int:
    """Return 1 for a label of the left, -1 of the right, 0 without a side."""
    found = _WORDS.search(label) or _LETTER.search(label)
    return 0 if found is None else 1 if found[0][0] in "lL" else -1


def split_side(label: str) -> tuple[str, str]:
    """Split a label into name and side, "left", "right" or "": ("hand", "left") for l_hand and hand_left."""
    found = _WORDS.search(label) or _LETTER.search(label)
    if found is None:
        return label, ""
    before, behind = label[:found.start()].rstrip(" ._-,"), label[found.end():].lstrip(" ._-,")
    return " ".join(filter(None, (before, behind))), "left" if found[0][0] in "lL" else "right"


def _like(word: str) -> str:
    """Return the word for the other side, in the same case."""
    other = _OTHER[word.lower()]
    return other.upper() if word.isupper() else other.capitalize() if word[0].isupper() else other
