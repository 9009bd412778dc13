"""Texts of messages for users: numbers with nouns, and the modules whose warnings are shown."""
from __future__ import annotations

import errno
import unicodedata
from collections.abc import Iterable
from dataclasses import fields
from typing import Any

OUR_MODULES = r"(scanprep|model|completion)(\.|$)"     # modules whose warnings are notes for users


def number_of(count: int, one: str, several: str = "") -> str:
    """Return a count with its noun; the plural is `several`, by default the singular with an s.

    Examples
    --------
    >>> number_of(1, "flap"), number_of(1200, "flap"), number_of(3, "person", "people")
    ('1 flap', '1,200 flaps', '3 people')
    """
    return f"{count:,} {one if count == 1 else several or one + 's'}"


def printable(text: str) -> str:
    """Write what has no visible form, as control characters and line ends in names, as `\\x1b`.

    Examples
    --------
    >>> print(printable("left knee\\n"))
    left knee\\n
    """
    # Unicode categories: control, format (also writing direction), surrogates, separators
    return "".join(c.encode("unicode_escape", "surrogatepass").decode("ascii")
                   if unicodedata.category(c) in {"Cc", "Cf", "Cs", "Zl", "Zp"} else c for c in text)


def explain_os_error(error: OSError, place: object) -> str:
    """Say in a line which file the system could not read or write, and why; `place` is named where it tells no file.

    Examples
    --------
    >>> explain_os_error(OSError(28, "No space left on device"), "out.ply")
    'out.ply: the disk is full; make room there, then run the same command again'
    """
    if error.strerror is None:                     # made by our code or a library, with a text of its own
        return " ".join(str(error).split())
    full = error.errno in (errno.ENOSPC, getattr(errno, "EDQUOT", None))
    reason = "the disk is full; make room there, then run the same command again" if full else error.strerror
    return f"{error.filename or place}: {reason}"


def fold_name(name: str) -> str:
    """Return the form that names share which are one file or folder on some disks, those of Windows and macOS.

    Examples
    --------
    >>> fold_name("Ann\\u00e9") == fold_name("anne\\u0301")
    True
    """
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def check_names(names: Iterable[str], source: str) -> None:
    """Raise ValueError for names that cannot all be files beside each other on every disk; `source` says whose."""
    known = dict[str, str]()
    for name in names:
        if printable(name) != name:                # names appear in tables, pages and messages
            raise ValueError(f"{source}: expected names without control characters, found {name!a}; rename it")
        # most disks take 255 bytes; names of records and temporary files are longer
        if len(name.encode()) > 200:
            raise ValueError(f"{source}: expected names of at most 200 bytes, found {name[:40]}... of "
                             f"{len(name.encode())}; rename it")
        if (other := known.setdefault(fold_name(name), name)) != name:
            raise ValueError(f"{source}: '{other}' and '{name}' are one name on the disks of Windows and macOS; "
                             "rename one")


def describe_result(result: Any) -> str:
    """Describe a dataclass in one line, to be its `__repr__`: its verdict, numbers, shapes of arrays, and counts.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @dataclass
    ... class Fit:
    ...     rms: float
    ...     parts: tuple[str, ...]
    ...     __repr__ = describe_result
    >>> Fit(0.00123456, ("head", "chest"))
    Fit(rms=0.00123, parts=2)
    """
    told = list[str]()
    for field in fields(result):
        value = getattr(result, field.name)
        kind = type(value)
        if hasattr(value, "verdict"):
            told.insert(0, value.verdict)
        elif getattr(value, "shape", ()):
            told.append(f"{field.name}={value.shape}")
        elif isinstance(value, float):
            told.append(f"{field.name}={value:.3g}")
        elif isinstance(value, dict | list | tuple):
            told += [f"{field.name}={len(value)}"] if value else []
        elif value is not None and not callable(value) and not hasattr(kind.__repr__, "__wrapped__"):
            told.append(f"{field.name}={value!r}")
    return f"{type(result).__name__}({', '.join(told)})"
