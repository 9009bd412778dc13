"""How good a result is, in one word with reasons; and what the functions that judge have in common."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .geometry.mesh import Mesh

Verdict = Literal["good", "check", "failed"]

HAND = 0.06                 # share of a body's size (root of its surface area): the width of a hand, 8 cm on a man
NAMED = 3                   # results that a judgement about many names: more would not be read


@dataclass(frozen=True)
class Judgement:
    """How good a result is: `good`; `check`, look at it before use; `failed`, it means nothing.

    Parameters
    ----------
    verdict : 'good', 'check' or 'failed'
        The judgement in one word.
    reasons : tuple of str
        Why, the gravest first; a good result has none.
    """

    verdict: Verdict = "good"
    reasons: tuple[str, ...] = ()

    @staticmethod
    def of(failed: str | Iterable[str] | None = None, check: Iterable[str] = ()) -> Judgement:
        """Make a judgement from reasons why a result failed, and reasons to look at it; each reason once."""
        # "; " separates reasons in one line, so it must not occur inside one
        grave, light = (tuple(dict.fromkeys(reason.replace("; ", ": ") for reason in reasons)) for reasons in
                        ((failed,) if isinstance(failed, str) else failed or (), check))
        return Judgement("failed" if grave else "check" if light else "good", (*grave, *light))

    @staticmethod
    def read(text: str) -> Judgement:
        """Read a judgement from the text that `str` makes of it."""
        word, _, reasons = text.partition(": ")
        if word not in ("good", "check", "failed"):
            raise ValueError(f"judgement: expected good, check or failed, got {word!r}")
        return Judgement(word, tuple(reasons.split("; ")) if reasons else ())        # type: ignore[arg-type]

    @property
    def why(self) -> str:
        """All reasons in one line."""
        return "; ".join(self.reasons)

    @property
    def problems(self) -> tuple[str, ...]:
        """The reasons, where the result failed."""
        return self.reasons if self.verdict == "failed" else ()

    @property
    def doubts(self) -> tuple[str, ...]:
        """The reasons, where the result needs a look."""
        return self.reasons if self.verdict == "check" else ()

    def merge(self, *others: Judgement) -> Judgement:
        """Merge judgements about one thing: the gravest verdict, and its reasons first."""
        every = (self, *others)
        return Judgement.of([reason for one in every for reason in one.problems],
                            [reason for one in every for reason in one.doubts])

    def put_first(self, cause: str | None) -> Judgement:
        """Put the cause of a judgement before its other reasons: at least `check`; None changes nothing."""
        causes = [] if cause is None else [cause]
        return Judgement.of(causes if self.problems else [], causes).merge(self)

    def __str__(self) -> str:
        return f"{self.verdict}: {self.why}" if self.reasons else self.verdict


UNJUDGED = Judgement.of(check=["no judgement was made"])


def judge_many(results: Mapping[str, Judgement], failures: int = 0) -> Judgement:
    """Judge many results together.

    All failed: failed. One failed or needs a look, or `failures` made no result at all: check.
    """
    bad = {name: judgement for name, judgement in results.items() if judgement.verdict != "good"}
    failed = failures + sum(judgement.verdict == "failed" for judgement in bad.values())
    # the first reason of each, failures first, and how many more there are
    gravest = sorted(bad.items(), key=lambda item: item[1].verdict != "failed")
    reasons = [f"{name}: {judgement.reasons[0]}" for name, judgement in gravest[:NAMED]]
    reasons += [f"{len(bad) - NAMED} more of {len(results)} to be looked at"] if len(bad) > NAMED else []
    if failed:
        reasons.insert(0, f"{failed} of {len(results) + failures} failed")
    all_failed = failed == len(results) + failures
    return Judgement.of(reasons) if failed and all_failed else Judgement.of(check=reasons)


def read_judgement(result: Path) -> Judgement | None:
    """Read the judgement on a result from its report; None without report, or if the file has changed since.

    `result` is a file that a command wrote, a folder, or a file in such a folder.
    """
    from .batch.digests import Digests
    from .batch.ownership import report_path
    from .geometry import storage

    beside = report_path(result)
    report = beside if beside.is_file() or result.is_dir() else result.parent / "report.json"
    try:
        contents: Any = storage.read_json(report, "a report")
        stored = contents["judgement"]
        written = contents.get("written", {}).get(result.name)
        judgement = Judgement(stored["verdict"], tuple(str(reason) for reason in stored["reasons"]))
    except (storage.StorageError, AttributeError, KeyError, TypeError):
        return None
    changed = written is not None and written != Digests().of_file(result)
    return None if changed or judgement.verdict not in ("good", "check", "failed") else judgement


def carry_judgements(inputs: Iterable[Path], used: Iterable[Path] = ()) -> Judgement:
    """Derive a judgement from those of the inputs: their failures, and their doubts.

    `used` are inputs that are merely used, like a model: their failures count, but not their doubts.
    """
    problems, doubts, made_of = list[str](), list[str](), list(dict.fromkeys(inputs))
    for i, path in enumerate([*made_of, *dict.fromkeys(used)]):
        judgement = read_judgement(path)
        if judgement and judgement.problems:
            problems.append(f"{path}: its own report says that it failed: {', '.join(judgement.reasons)}")
        if judgement and judgement.doubts and i < len(made_of):
            doubts.append(f"{path}: its own report says to look at it: {', '.join(judgement.reasons)}")
        if judgement is None and i < len(made_of) and path.is_dir():
            # a folder of results without a report of its own: judge the results inside
            within = {p.parent.name: read_judgement(p.parent) for p in sorted(path.glob("*/report.json"))}
            whole = judge_many({name: each for name, each in within.items() if each is not None})
            problems += [f"{path}: {reason}" for reason in whole.problems]
            doubts += [f"{path}: {reason}" for reason in whole.doubts]
    return Judgement.of(problems, doubts)


def size(body: Mesh) -> float:
    """Compute the size of a body: the square root of its surface area, metres."""
    return float(np.sqrt(body.face_areas.sum()))


def extent(points: np.ndarray) -> float:
    """Compute the diagonal of the box around points (n, 3), in their unit; NaN without finite points."""
    finite = points[np.isfinite(points).all(axis=-1)]
    return float(np.linalg.norm(np.ptp(finite, axis=0))) if len(finite) else np.nan
