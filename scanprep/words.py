"""Texts of messages for users: numbers with nouns, and the modules whose warnings are shown."""
from __future__ import annotations

OUR_MODULES = r"(scanprep|model|completion)(\.|$)"     # modules whose warnings are notes for users


def number_of(count: int, one: str, several: str = "") -> str:
    """Return a count with its noun; the plural is `several`, by default the singular with an s.

    Examples
    --------
    >>> number_of(1, "flap"), number_of(1200, "flap"), number_of(3, "person", "people")
    ('1 flap', '1,200 flaps', '3 people')
    """
    return f"{count:,} {one if count == 1 else several or one + 's'}"
