"""What a result is worth, in one word and with its reasons; and what the functions that judge have in common."""
from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .geometry.mesh import Mesh

Verdict = Literal["good", "check", "failed"]

HAND = 0.06                 # of a body's size, the root of its area: a hand's width, 8 cm on a man

# ANSUR II, 6,068 soldiers: 1.41 to 1.99 m, 36 to 144 kg, 15 to 43 kg/m²; one litre of a person weighs about a kilogram.
# Everybody is more varied than soldiers; beyond 1.40 to 2.10 m or 35 to 200 litres somebody should look.
ADULTS, VOLUMES = (1.40, 2.10), (35.0, 200.0)          # metres, litres
# litres per square metre of stature, of people and of anybody; 400 synthetic people have 14 to 31, a chair's body 8.6
BUILD, ANY_BUILD = (13.0, 55.0), (9.0, 90.0)
# Squared lengths of the betas of K components are chi-square distributed: one person of so many is beyond the first
# limit, 7.0 of 18. It is no less than `USUAL` times the root of K: completions of people have up to 1.4 times that, of
# a chair and a cylinder, which other limits refuse, 2.1 and 2.3. `mosh` with a model of other people than the recorded
# one finds up to 12 of 18 where the motion is right but the body is not; recordings scaled by 1.6 and 2.54 end at 20
# and 46. The second limit is so many times the first.
ONE_OF, USUAL, TOO_LONG = 10_000, 1.6, 1.8
NAMED = 3                                              # results that one judgement of many names


@dataclass(frozen=True)
class Judgement:
    """What a result is worth: `good`; `check`, look at it before it is used; `failed`, it means nothing.

    `reasons` say why in words, the gravest first; a good result has none.
    """

    verdict: Verdict = "good"
    reasons: tuple[str, ...] = ()

    @staticmethod
    def of(failed: str | Iterable[str] | None = None, check: Iterable[str] = ()) -> Judgement:
        """The judgement from reasons why a result failed, and reasons to look at it; each reason once."""
        # "; " stands between reasons in one line, so never within one: what follows it there is the cause
        grave, light = (tuple(dict.fromkeys(reason.replace("; ", ": ") for reason in reasons)) for reasons in
                        ((failed,) if isinstance(failed, str) else failed or (), check))
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

    @property
    def problems(self) -> tuple[str, ...]:
        """The reasons where it failed."""
        return self.reasons if self.verdict == "failed" else ()

    @property
    def doubts(self) -> tuple[str, ...]:
        """The reasons where it is to be looked at."""
        return self.reasons if self.verdict == "check" else ()

    def merge(self, *others: Judgement) -> Judgement:
        """The judgement of something of which all these speak: the gravest verdict, its reasons first."""
        every = (self, *others)
        return Judgement.of([reason for one in every for reason in one.problems],
                            [reason for one in every for reason in one.doubts])

    def __str__(self) -> str:
        return f"{self.verdict}: {self.why}" if self.reasons else self.verdict


def judge_many(results: Mapping[str, Judgement], failures: int = 0) -> Judgement:
    """What many results are worth together.

    It failed where none of them means anything; it is to be looked at where one does not, or is to be looked at, or
    where so many `failures` made no result at all.
    """
    bad = {name: one for name, one in results.items() if one.verdict != "good"}
    failed = failures + sum(one.verdict == "failed" for one in bad.values())
    gravest = sorted(bad.items(), key=lambda item: item[1].verdict != "failed")
    reasons = [f"{name}: {one.reasons[0]}" for name, one in gravest[:NAMED]]
    reasons += [f"{len(bad) - NAMED} more of {len(results)} to be looked at"] if len(bad) > NAMED else []
    if failed:
        reasons.insert(0, f"{failed} of {len(results) + failures} failed")
    whole = failed == len(results) + failures
    return Judgement.of(reasons) if failed and whole else Judgement.of(check=reasons)


def read_judgement(result: Path) -> Judgement | None:
    """What the report beside a result says of it; None without a report, or where the file is no longer that result.

    `result` is a file that a command wrote, or a folder, or a file in such a folder.
    """
    from .batch.digests import Digests
    from .batch.ownership import report_path
    from .geometry import storage

    beside = report_path(result)
    report = beside if beside.is_file() or result.is_dir() else result.parent / "report.json"
    try:
        told: Any = storage.read_json(report, "a report")
        found = told["judgement"]
        written = told.get("written", {}).get(result.name)
        judgement = Judgement(found["verdict"], tuple(str(reason) for reason in found["reasons"]))
    except (storage.StorageError, AttributeError, KeyError, TypeError):
        return None
    changed = written is not None and written != Digests().of_file(result)
    return None if changed or judgement.verdict not in ("good", "check", "failed") else judgement


def carry_judgements(inputs: Iterable[Path], used: Iterable[Path] = ()) -> Judgement:
    """What results made of others have from them: a failure of any, a doubt of the `inputs` that they are made of.

    `used` are things that are taken along, as a model: what is doubtful in them is not in all that is made with them.
    """
    problems, doubts, made_of = list[str](), list[str](), list(dict.fromkeys(inputs))
    for i, path in enumerate([*made_of, *dict.fromkeys(used)]):
        one = read_judgement(path)
        if one and one.problems:
            problems.append(f"{path}: its own report says that it failed: {', '.join(one.reasons)}")
        if one and one.doubts and i < len(made_of):
            doubts.append(f"{path}: its own report says to look at it: {', '.join(one.reasons)}")
        if one is None and i < len(made_of) and path.is_dir():
            within = {p.parent.name: read_judgement(p.parent) for p in sorted(path.glob("*/report.json"))}
            whole = judge_many({name: judgement for name, judgement in within.items() if judgement is not None})
            problems += [f"{path}: {reason}" for reason in whole.problems]
            doubts += [f"{path}: {reason}" for reason in whole.doubts]
    return Judgement.of(problems, doubts)


def implausible_body(stature: float, volume: float | None = None, betas: np.ndarray | None = None, cause: str = ""
                     ) -> Judgement:
    """Whether a body is one that a person can have, with the likely cause where it is not.

    Parameters
    ----------
    stature : float, metres
    volume : float, litres, optional
    betas : (K,) float, standard deviations, optional
    cause : str
        Why it may not be, where that is known; else that of a scan or a recording.

    Examples
    --------
    >>> beyond_people(1.75, 74.0, np.ones(10)).verdict
    'good'
    >>> beyond_people(2.61, 290.0).reasons[0]
    'the person is 2.61 m tall: the wrong unit or scale? (--unit)'
    """
    failed, check = [], []
    anybody = (1.00, 2.30)  # metres: from a child of about four
    if not anybody[0] <= stature <= anybody[1]:
        failed.append(f"the person is {stature:.2f} m tall: {cause or 'the wrong unit or scale? (--unit)'}")
    elif not ADULTS[0] <= stature <= ADULTS[1]:
        who = "a child" if stature < ADULTS[0] else "a giant"
        check.append(f"the person is {stature:.2f} m tall: {cause or who + ', or the wrong scale?'}")
    if volume is not None and not failed:
        build = volume / stature**2
        little = "flattened, or something else than a person?"
        words = f"the person has {volume:.0f} litres at {stature:.2f} m"
        if not ANY_BUILD[0] <= build <= ANY_BUILD[1]:
            what = "something else than a person, or several?" if build > BUILD[0] else little
            failed.append(f"{words}, as nobody has: {cause or what}")
        elif not BUILD[0] <= build <= BUILD[1] or (stature >= ADULTS[0] and not VOLUMES[0] <= volume <= VOLUMES[1]):
            much = "clothes, a second person, or the wrong scale?"
            check.append(f"{words}: {cause or (much if build > BUILD[0] else little)}")
    if betas is not None and len(betas):
        length, usual = float(np.linalg.norm(betas)), float(np.sqrt(len(betas)))
        most = longest_betas(len(betas))
        words = f"the shape is {length:.0f} standard deviations from the mean, {usual:.0f} are usual"
        if length > TOO_LONG * most:
            failed.append(f"{words}: {cause or 'something else than a person, or the wrong scale?'}")
        elif length > most:
            check.append(f"{words}: {cause or 'a body that the model does not know, or markers that stand off?'}")
    return Judgement.of(failed, check)


def longest_betas(count: int) -> float:
    """The length of so many betas, standard deviations, beyond which one person of `ONE_OF` is, or fewer.

    [MoSh] Eq. 20
    """
    from scipy.special import gammainccinv

    return float(np.sqrt(max(2 * gammainccinv(count / 2, 1 / ONE_OF), USUAL**2 * count)))


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
