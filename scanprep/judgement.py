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

# ANSUR II, 6,068 soldiers: 1.41 to 1.99 m, 36 to 144 kg, 15 to 43 kg/m²; a litre of a person weighs about a kilogram.
# The population varies more than soldiers: bodies beyond 1.40 to 2.10 m or 35 to 200 litres need a look.
ADULTS, VOLUMES = (1.40, 2.10), (35.0, 200.0)          # metres, litres
# litres per square metre of stature: beyond the first range a look is needed, beyond the second nobody is so built;
# 400 synthetic people have 14 to 31, a body completed from the scan of a chair 8.6
BUILD, ANY_BUILD = (13.0, 55.0), (9.0, 90.0)
# The squared length of K betas is chi-square distributed. ONE_OF: one person in this number is beyond the first limit,
# which is 7.0 for 18 betas. USUAL: the limit is at least this times the root of K. Completions of people reach 1.4
# times that root, those of a chair and a cylinder, which other limits refuse, 2.1 and 2.3. TOO_LONG: the second limit
# is this times the first. `mosh` with a model of other people finds up to 12 for 18 betas where the motion is right
# but the body is not; recordings scaled by 1.6 and 2.54 end at 20 and 46.
ONE_OF, USUAL, TOO_LONG = 10_000, 1.6, 1.8
# Metres: a toddler of one year, and taller than almost anybody. Children below an adult's size need a look.
ANYBODY = (0.65, 2.30)
WRONG_UNIT = "the wrong unit or scale? (--unit, or --unit unknown)"
NAMED = 3                   # results that a judgement about many names: more would not be read


class WrongScaleError(ValueError):
    """A scan shows a person of a size that nobody has: its unit is another one."""


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


def implausible_body(stature: float, volume: float | None = None, betas: np.ndarray | None = None, cause: str = ""
                     ) -> Judgement:
    """Judge whether a person can have such a body, with the likely cause where not.

    Parameters
    ----------
    stature : float, metres
        Height of the body.
    volume : float, litres, optional
        Volume of the body.
    betas : (K,) float, standard deviations, optional
        Shape coefficients.
    cause : str
        Why the body may be implausible, where that is known; by default the causes for scans and recordings.

    Returns
    -------
    Judgement

    Examples
    --------
    >>> implausible_body(1.75, 74.0, np.ones(10)).verdict
    'good'
    >>> implausible_body(2.61, 290.0).reasons[0]
    'the person is 2.61 m tall: the wrong unit or scale? (--unit, or --unit unknown)'
    """
    failed, check = [], []
    if not ANYBODY[0] <= stature <= ANYBODY[1]:
        failed.append(f"the person is {stature:.2f} m tall: {cause or WRONG_UNIT}")
    elif not ADULTS[0] <= stature <= ADULTS[1]:
        who = "a child" if stature < ADULTS[0] else "a giant"
        check.append(f"the person is {stature:.2f} m tall: {cause or f'{who}, or {WRONG_UNIT}'}")
    if volume is not None and not failed:
        # build: volume relative to stature, as the body-mass index
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
        # length of the betas: their root mean square is 1 in the population
        length, usual = float(np.linalg.norm(betas)), float(np.sqrt(len(betas)))
        most = longest_betas(len(betas))
        words = f"the shape is {length:.0f} standard deviations from the mean, {usual:.0f} are usual"
        if length > TOO_LONG * most:
            failed.append(f"{words}: {cause or 'something else than a person, or the wrong scale?'}")
        elif length > most:
            check.append(f"{words}: {cause or 'a body that the model does not know, or markers that stand off?'}")
    return Judgement.of(failed, check)


def longest_betas(count: int) -> float:
    """Compute the largest plausible length of betas, standard deviations: at most one person in `ONE_OF` is beyond.

    [MoSh] Eq. 20
    """
    from scipy.special import gammainccinv

    return float(np.sqrt(max(2 * gammainccinv(count / 2, 1 / ONE_OF), USUAL**2 * count)))


def size(body: Mesh) -> float:
    """Compute the size of a body: the square root of its surface area, metres."""
    return float(np.sqrt(body.face_areas.sum()))


def extent(points: np.ndarray) -> float:
    """Compute the diagonal of the box around points (n, 3), in their unit; NaN without finite points."""
    finite = points[np.isfinite(points).all(axis=-1)]
    return float(np.linalg.norm(np.ptp(finite, axis=0))) if len(finite) else np.nan


def check_unit(scan: Mesh | np.ndarray, body: np.ndarray, what: str) -> None:
    """Raise WrongScaleError for a scan that cannot show a body (N, 3), metres, before minutes of work on it.

    A hand has a tenth of a body's size, and a room around it five times that size. `what` is the subject of the
    sentence.
    """
    points = scan.vertices if isinstance(scan, Mesh) else scan
    if problem := unit_problem(extent(points), extent(body), what, 1 / 30, 10):
        raise WrongScaleError(problem)


def unit_problem(found: float, expected: float, what: str, least: float = 0.2, most: float = 2.5) -> str | None:
    """Return why data `found` metres large, for a body of `expected` metres, are in another unit; None if they are not.

    `what` is the subject of the sentence; `least` and `most` are the smallest and the largest share of a body's extent
    that the data may have.
    """
    if not np.isfinite(found) or least <= found / expected <= most:
        return None
    return (f"{what} {found:.3g} m from corner to corner, {found / expected:.3g} times as large as the body: the wrong "
            "unit? (--unit)")
