"""Ranges of numbers that users choose: declared once, beside the type, and checked in one place.

A number without a mark must be finite and not negative. A mark is in the annotation, as in `rate: Positive = 30.0`.
"""
from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Annotated, Any, Literal, get_args, get_type_hints

import numpy as np

FLAG = "flag"                           # marks a field of settings that is also a command-line flag
NO_FLAGS = "no flags"                   # marks settings inside others: their fields are no flags of that command
TINY, LARGE = 1e-12, 1e9                # no setting is closer to 0 or larger; squares could overflow


class OutOfRangeError(ValueError):
    """A number that a user chose is out of range; its arguments are the name, and what is wrong."""

    def __str__(self) -> str:
        return ": ".join(self.args)


@dataclasses.dataclass(frozen=True)
class Range:
    """Lowest and highest allowed number; NaN and infinity are never allowed."""

    low: float = 0.0
    high: float = LARGE

    def check(self, value: Any, name: str) -> None:
        """Raise OutOfRangeError if a number, or one in a tuple or array, is outside; other values pass."""
        if isinstance(value, np.ndarray):
            value = value[~((value >= self.low) & (value <= self.high))][:1].tolist()
        for part in value if isinstance(value, tuple | list) else ():
            self.check(part, name)
        if isinstance(value, int | float | np.number) and not self.low <= value <= self.high:
            raise OutOfRangeError(name, f"expected {self}, got {value}")

    def __str__(self) -> str:
        if self.low == TINY:
            return "above 0" if self.high == LARGE else f"above 0, at most {self.high:.10g}"
        return f"at least {self.low:.10g}" if self.high == LARGE else f"{self.low:.10g} to {self.high:.10g}"


NOT_NEGATIVE = Range()
BETAS = Range(-20, 20)          # standard deviations: far beyond any person, so that experiments are possible
TURNS = Range(-1000, 1000)      # radians: many turns, as recordings may count them on

Positive = Annotated[float, Range(TINY)]
Signed = Annotated[float, Range(-LARGE)]
Share = Annotated[float, Range(0, 1)]
SomeShare = Annotated[float, Range(TINY, 1)]
Cosine = Annotated[float, Range(-1, 1)]
Cell = Annotated[float, Range(1e-4, 1e3)]           # edge of cells that divide space, metres
Beta = Annotated[float, BETAS]
Count = Annotated[int, Range(1, 10_000_000)]
Faces = Annotated[int, Range(4, 100_000_000)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Axis = Literal["x", "-x", "y", "-y", "z", "-z"]     # a direction along an axis of a scan


def direction_of(axis: Axis) -> tuple[float, float, float]:
    """Return the unit vector of a direction along an axis.

    Examples
    --------
    >>> direction_of("-y")
    (0.0, -1.0, 0.0)
    """
    sign, at = (-1.0 if axis.startswith("-") else 1.0), "xyz".index(axis[-1])
    x, y, z = (sign if i == at else 0.0 for i in range(3))
    return x, y, z
Processes = Annotated[int | str, Range(0, 1000)]    # number of processes, or the address of a scheduler


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of settings: a frozen dataclass that checks the ranges of its numbers when it is created."""

    def __post_init__(self) -> None:
        owner: Any = type(self)
        for name, allowed in ranges(owner).items():
            allowed.check(getattr(self, name), name)


@functools.cache
def ranges(owner: Any) -> dict[str, Range]:
    """Return the range of every argument of a function, or field of settings."""
    return {name: range_of(annotation) for name, annotation in get_type_hints(owner, include_extras=True).items()}


def range_of(annotation: Any) -> Range:
    """Return the range beside the type in an annotation."""
    return next((mark for mark in marks(annotation) if isinstance(mark, Range)), NOT_NEGATIVE)


def marks(annotation: Any) -> Iterator[Any]:
    """Yield everything beside the types in an annotation, at any depth."""
    yield from getattr(annotation, "__metadata__", ())
    for part in get_args(annotation):
        yield from marks(part)
