"""Which scans of a set need a look: every figure over its limit, worst first."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..ranges import Settings
from .figures import Failure, ScanFigures


@dataclass(frozen=True)
class Limits(Settings):
    """Where a figure of a registration begins to be suspect.

    Lengths are multiples of the template's size, the square root of its area (1.4 m for a man), so that they hold
    for hands and horses too.

    Attributes
    ----------
    missed : float
        Share of the scan's points off the template.
    distance : float
        Mean distance of the vertices with data to the scan, over the size.
    unseen : float
        Share of vertices without data, above what is usual in the set (its median).
    stretch : float
        Share of the surface stretched or shrunk to the double or half.
    inverted : float
        Share of the triangles that face against their surroundings.
    landmarks : float
        RMS distance of the landmarks, over the size.
    not_converged : float
        What a registration that did not converge counts, as a multiple of a limit; below 1 it is not suspect for
        that alone.
    """

    missed: float = 0.005
    distance: float = 0.002
    unseen: float = 0.15
    stretch: float = 0.02
    inverted: float = 0.001
    landmarks: float = 0.015
    not_converged: float = 0.5


@dataclass(frozen=True)
class Verdict:
    """What is to be thought of one scan."""

    name: str
    badness: float                  # the largest multiple of a limit; from 1 on it needs a look; infinite: it failed
    reasons: tuple[str, ...]        # what is over its limit, worst first; for a scan that failed, why
    figures: ScanFigures | None = None

    @property
    def failed(self) -> bool:
        """Whether the scan could not be registered as its files are now."""
        return self.badness == np.inf

    @property
    def suspect(self) -> bool:
        """Whether a person should look at it."""
        return self.badness >= 1


def review(figures: Sequence[ScanFigures], failures: Sequence[Failure], size: float, faces: int,
           limits: Limits | None = None) -> list[Verdict]:
    """Judge all scans of a set, worst first: failures, then by falling badness.

    `size` is the root of the template's area in metres, `faces` its number of triangles.
    """
    limits = limits or Limits()
    usual = float(np.median([1 - f.seen for f in figures])) if figures else 0.0
    failed = {failure.name: failure.reason for failure in failures}
    known = {f.name: f for f in figures}
    verdicts = [Verdict(name, np.inf, (reason,), known.get(name)) for name, reason in sorted(failed.items())]
    judged = [_judge(f, size, faces, usual, limits) for f in figures if f.name not in failed]
    return verdicts + sorted(judged, key=lambda verdict: (-verdict.badness, verdict.name))


def _judge(f: ScanFigures, size: float, faces: int, usual: float, limits: Limits) -> Verdict:
    over = {
        f"{100 * f.missed:.1f}% of the scan lies off the template: an uncovered limb, or clutter":
            f.missed / limits.missed,
        f"{1000 * f.distance:.1f} mm from the scan on average": f.distance / (limits.distance * size),
        f"{100 * (1 - f.seen):.0f}% without data, {100 * usual:.0f}% is usual here":
            (1 - f.seen - usual) / limits.unseen,
        f"{100 * f.stretch:.1f}% of the surface stretched or shrunk to the double or half":
            f.stretch / limits.stretch,
        f"{f.inverted} triangles inverted": f.inverted / faces / limits.inverted,
        f"landmarks {1000 * f.landmarks:.0f} mm off": f.landmarks / (limits.landmarks * size),
        "not converged": 0.0 if f.converged else limits.not_converged,
        "nowhere near the scan": 0.0 if f.seen else 100.0}
    over = {reason: value for reason, value in over.items() if np.isfinite(value)}
    reasons = sorted((reason for reason, value in over.items() if value >= 1), key=lambda reason: -over[reason])
    return Verdict(f.name, max(over.values()), tuple(reasons), f)
