"""What a result is worth, in one word and with its reasons; and what the functions that judge have in common."""
from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from .geometry.mesh import Mesh

Verdict = Literal["good", "check", "failed"]

HAND = 0.06                 # of a body's size, the root of its area: a hand's width, 8 cm on a man


@dataclass(frozen=True)
class Judgement:
    """What a result is worth: `good`; `check`, look at it before it is used; `failed`, it means nothing.

    `reasons` say why in words, the gravest first; a good result has none.
    """

    verdict: Verdict = "good"
    reasons: tuple[str, ...] = ()

    @staticmethod
    def of(failed: str | Iterable[str] | None = None, check: Iterable[str] = ()) -> Judgement:
        """The judgement from reasons why a result failed, and reasons to look at it."""
        grave = (failed,) if isinstance(failed, str) else tuple(failed or ())
        light = tuple(check)
        return Judgement("failed" if grave else "check" if light else "good", (*grave, *light))

    @staticmethod
    def read(text: str) -> Judgement:
        """The judgement of a line `str` has made."""
        word, _, reasons = text.partition(": ")
        if word not in ("good", "check", "failed"):
            raise ValueError(f"judgement: expected good, check or failed, got {word!r}")
        return Judgement(word, tuple(reasons.split("; ")) if reasons else ())        # type: ignore[arg-type]

    @property
    def why(self) -> str:
        """All reasons in one line."""
        return "; ".join(self.reasons)

    def __str__(self) -> str:
        return f"{self.verdict}: {self.why}" if self.reasons else self.verdict


def size(body: Mesh) -> float:
    """The root of the surface area of a body, metres."""
    return float(np.sqrt(body.face_areas.sum()))


def extent(points: np.ndarray) -> float:
    """Diagonal of the box around points (n, 3), in their unit; NaN without any that are finite."""
    found = points[np.isfinite(points).all(axis=-1)]
    return float(np.linalg.norm(np.ptp(found, axis=0))) if len(found) else np.nan


def unit_problem(found: float, expected: float, what: str, least: float = 0.2) -> str | None:
    """Why data `found` metres large, for a body of `expected`, may be in another unit; None where they are not.

    `what` is the data as they stand in the sentence; `least` is how small data of a part of a body may be.
    """
    if not np.isfinite(found) or least <= found / expected <= 2.5:
        return None
    return f"{what} {found / expected:.3g} times as large as the body: the wrong unit? (--unit)"
