"""What messages for users are made of: numbers with their nouns, and the warnings that are notes for them."""
from __future__ import annotations

OUR_MODULES = r"(scanprep|model|completion)(\.|$)"     # whose warnings are notes for users


def number_of(count: int, one: str, several: str = "") -> str:
    """A count with its noun: the plural is the singular with an s where `several` does not say it.

    Examples
    --------
    >>> number_of(1, "flap"), number_of(1200, "flap"), number_of(3, "person", "people")
    ('1 flap', '1,200 flaps', '3 people')
    """
    return f"{count:,} {one if count == 1 else several or one + 's'}"
