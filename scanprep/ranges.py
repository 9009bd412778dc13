"""Ranges of numbers that users choose: said once, beside the type, and checked in one place.

A number without a mark is finite and not negative. A mark stands in the annotation, as in `rate: Positive = 30.0`.
"""
from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np

FLAG = "flag"                           # marks a field of settings that is a flag of the command line too
TINY, LARGE = 1e-12, 1e9                # nearer to 0, or larger, is no setting of anything: their squares overflow


class OutOfRange(ValueError):
    """A number that a user chose is not in its range; its arguments are whose number, and what is wrong with it."""

    def __str__(self) -> str:
        return ": ".join(self.args)


@dataclasses.dataclass(frozen=True)
class Range:
    """From the lowest to the highest number that is allowed; NaN and infinity never are."""

    low: float = 0.0
    high: float = LARGE

    def check(self, value: Any, name: str) -> None:
        """OutOfRange if the number, or one of a tuple or array of them, is outside; what is no number passes."""
        if isinstance(value, np.ndarray):
            value = value[~((value >= self.low) & (value <= self.high))][:1].tolist()
        for part in value if isinstance(value, tuple | list) else ():
            self.check(part, name)
        if isinstance(value, int | float | np.number) and not self.low <= value <= self.high:
            raise OutOfRange(name, f"expected {self}, got {value}")

    def __str__(self) -> str:
        if self.low == TINY:
            return "above 0" if self.high == LARGE else f"above 0, at most {self.high:.10g}"
        return f"at least {self.low:.10g}" if self.high == LARGE else f"{self.low:.10g} to {self.high:.10g}"


NOT_NEGATIVE = Range()
BETAS = Range(-20, 20)          # standard deviations
TURNS = Range(-1000, 1000)      # radians

Positive = Annotated[float, Range(TINY)]
Signed = Annotated[float, Range(-LARGE)]
Share = Annotated[float, Range(0, 1)]
SomeShare = Annotated[float, Range(TINY, 1)]
Cosine = Annotated[float, Range(-1, 1)]
Cell = Annotated[float, Range(1e-4, 1e3)]           # space is divided into pieces of this size
Beta = Annotated[float, BETAS]
Count = Annotated[int, Range(1, 10_000_000)]
Faces = Annotated[int, Range(4, 100_000_000)]
Seed = Annotated[int, Range(0, 2**32 - 1)]
Processes = Annotated[int | str, Range(0, 1000)]    # of this machine, or the address of others


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of settings: a frozen dataclass whose numbers are in their ranges, or it is not made."""

    def __post_init__(self) -> None:
        owner: Any = type(self)
        for name, allowed in ranges(owner).items():
            allowed.check(getattr(self, name), name)


@functools.cache
def ranges(owner: Any) -> dict[str, Range]:
    """The range of every argument of a function or field of settings."""
    return {name: range_of(annotation) for name, annotation in get_type_hints(owner, include_extras=True).items()}


def range_of(annotation: Any) -> Range:
    """The range that stands beside the type in an annotation."""
    return next((mark for mark in marks(annotation) if isinstance(mark, Range)), NOT_NEGATIVE)


def marks(annotation: Any) -> Iterator[Any]:
    """What stands beside the types in an annotation, at any depth."""
    yield from getattr(annotation, "__metadata__", ())
    for part in get_args(annotation):
        yield from marks(part)
