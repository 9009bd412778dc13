"""Long work in steps that are kept, so that a run that was killed or changed does not begin anew."""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from .workspace import Workspace

T = TypeVar("T")


class Step(Protocol):
    """What `make` returns, or returned when it was last called for the same inputs: `Room.step`, or `KeptSteps`."""

    def __call__(self, name: str, inputs: Any, make: Callable[[], T]) -> T: ...


def once(name: str, inputs: Any, make: Callable[[], T]) -> T:
    """A step that is not kept."""
    return make()


def inside(step: Step, outer: str) -> Step:
    """Steps of which a larger one consists."""
    def inner(name: str, inputs: Any, make: Callable[[], T]) -> T:
        return step(f"{outer}/{name}", inputs, make)

    return inner


@dataclass(frozen=True, eq=False)
class KeptSteps:
    """Steps that are kept in an output; when a step is done, those `inside` it are forgotten."""

    space: Workspace
    found: list[str] = field(default_factory=list)          # the steps that had been done before this run
    made: set[str] = field(default_factory=set)             # those that were done now

    def __call__(self, name: str, inputs: Any, make: Callable[[], T]) -> T:
        fresh = False

        def now(folder: Path) -> T:
            nonlocal fresh
            fresh = True
            return make()

        value = self.space.step(name, inputs, now)
        if fresh:
            self.made.add(name)
        elif name not in self.made:
            self.found.append(name)
        self.space.drop_others(f"{name}/")
        return value
