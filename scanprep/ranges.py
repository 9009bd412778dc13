"""Ranges of numbers that users choose: said once, beside the type, and checked in one place.

A number without a mark is finite and not negative. A mark stands in the annotation, as in `rate: Positive = 30.0`.
"""
from __future__ import annotations

import contextvars
import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, TypeVar, get_args, get_type_hints

import numpy as np

Result = TypeVar("Result")

FLAG = "flag"                           # marks a field of settings that is a flag of the command line too
TINY, LARGE = 1e-12, 1e9                # nearer to 0, or larger, is no setting of anything: their squares overflow


class OutOfRange(ValueError):
    """A number that a user chose is not in its range."""


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
            raise OutOfRange(f"{name}: expected {self}, got {value}")

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
Processes = Annotated[int, Range(0, 1000)]


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of settings: a frozen dataclass whose numbers are in their ranges, or it is not made."""

    def __post_init__(self) -> None:
        if not _reading.get():
            _check(vars(self), type(self), "")


def read(function: Callable[..., Result], parse: Callable[[Callable[..., Any]], Any]) -> Callable[[], Result]:
    """The call that a command line stands for, with every number in its range and nothing done yet.

    `parse` calls the function that it gets, which has the signature of `function`, with what the user wrote.
    OutOfRange names the option.
    """
    @functools.wraps(function)
    def later(*args: Any, **named: Any) -> Any:
        return inspect.signature(function).bind(*args, **named)

    token = _reading.set(True)          # a parser would frame what the settings say, without the name of the option
    try:
        given = parse(later)
    finally:
        _reading.reset(token)
    _check(given.arguments, function, "--")
    return functools.partial(function, *given.args, **given.kwargs)


_reading = contextvars.ContextVar("reading", default=False)


def _check(values: Mapping[str, Any], owner: Any, prefix: str) -> None:
    """All numbers of a function's arguments or of settings, those inside other settings too."""
    for name, (allowed, unnamed) in ranges(owner).items():
        value = values.get(name)
        flag = prefix + (name.replace("_", "-") if prefix else name)
        allowed.check(value, flag)
        for inner in value if isinstance(value, tuple) else (value,):
            if dataclasses.is_dataclass(inner) and not isinstance(inner, type):
                _check(vars(inner), type(inner), prefix if unnamed or not prefix else f"{flag}.")


@functools.cache
def ranges(owner: Any) -> dict[str, tuple[Range, bool]]:
    """Of every argument of a function or field of settings: its range, and whether flags leave its name out."""
    found = {}
    for name, annotation in get_type_hints(owner, include_extras=True).items():
        told = list(marks(annotation))
        found[name] = (next((m for m in told if isinstance(m, Range)), NOT_NEGATIVE),
                       any(getattr(m, "name", None) == "" for m in told))
    return found


def marks(annotation: Any) -> Iterator[Any]:
    """What stands beside the types in an annotation, at any depth."""
    yield from getattr(annotation, "__metadata__", ())
    for part in get_args(annotation):
        yield from marks(part)
