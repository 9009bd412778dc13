"""One person after the other; what is finished is skipped when the same is asked again."""
from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from scanprep.console import Metric, Progress, plain
from scanprep.geometry import storage
from scanprep.pictures.page import Page

from ...animation.work import DONE, contents
from .recordings import TABLE, Actor, write_table
from .report import PICTURE
from .work import ERRORS, Work, mosh_person

_STYLE = """.person { display: grid; grid-template-columns: minmax(17rem, 1fr) 2fr; gap: 1rem; margin: 1.6rem 0; }
.person img { width: 100%; } .person p { margin: .2rem 0; }"""


@dataclass(frozen=True)
class Bars:
    """What tells of progress: people, the solution of one, and its files and pictures."""

    people: Progress
    solving: Progress
    writing: Progress


@dataclass(frozen=True)
class Finished:
    """How the people of a call fared.

    Attributes
    ----------
    metrics : name of the person -> the rows of its table
    before : int
        People that had been done before.
    failures : one line for each person or file that failed
    """

    metrics: dict[str, list[Metric]]
    before: int
    failures: list[str]


def mosh_people(work: Work, actors: Sequence[Actor], output: Path, given: Mapping[str, Any], command: str, bars: Bars
                ) -> Finished:
    """Every person into a folder of its name; one that fails stops no other.

    A person is done again when recordings, settings, or files that settings name have changed. What is written takes
    its place when it is whole.

    Parameters
    ----------
    given : what the output depends on beside the recordings and `work.config`
        Names of files stand for what they hold.
    command : str
        For report.json.
    """
    output.mkdir(parents=True, exist_ok=True)
    write_table(output / TABLE, actors)
    metrics: dict[str, list[Metric]] = {}
    failures: list[str] = []
    before = 0
    settings = {"given": {name: contents(value) for name, value in given.items()}, "config": plain(work.config),
                "model": work.name}
    for number, actor in enumerate(actors, 1):
        place, key = output / actor.name, _key(settings, actor)
        done = _known(place / DONE)
        if done.get("key") == key:
            before += 1
        else:
            try:
                with storage.writing_folder(place) as beside:
                    rows, failed = mosh_person(work, actor, beside, command, bars.solving, bars.writing)
                    done = {"key": key, "metrics": [[m.name, plain(m.value), m.unit] for m in rows],
                            "failures": failed}
                    storage.write_json(beside / DONE, done)
            except (ValueError, OSError) as error:
                failures.append(f"{actor.name}: {' '.join(str(error).split())}")
                bars.people(number, len(actors))
                continue
        metrics[actor.name] = [Metric(*row) for row in done["metrics"]]
        failures += [f"{actor.name}: {line}" for line in done["failures"]]
        bars.people(number, len(actors))
    _index(output, actors, metrics, failures)
    return Finished(metrics, before, failures)


def summary(done: Finished, count: int) -> list[Metric]:
    """The rows of the closing table: those of one person, or means over several."""
    if count == 1 and done.metrics:
        only = next(iter(done.metrics.values()))
        return [Metric("person", next(iter(done.metrics))), *only, Metric("done before", done.before)]
    values = [{m.name: m for m in rows} for rows in done.metrics.values()]
    rows = [Metric("people", count), Metric("done before", done.before), Metric("failed", count - len(done.metrics))]
    for name in ("sequences", "frames", "exchanges", "bad spans"):
        rows.append(Metric(name, sum(int(v[name].value) for v in values)))
    for name in ERRORS:
        found = {person: v[name] for person, v in zip(done.metrics, values, strict=True) if name in v}
        if found:
            worst = max(found, key=lambda person: float(found[person].value))
            rows += [Metric(f"{name}, mean of the people", float(np.mean([float(m.value) for m in found.values()])),
                            "mm"),
                     Metric(f"the same, worst ({worst})", float(found[worst].value), "mm")]
    return rows


def _known(path: Path) -> dict[str, Any]:
    """What a finished person's folder says; nothing where it cannot be read."""
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
        return tree if isinstance(tree, dict) else {}
    except (OSError, ValueError):
        return {}


def _key(settings: Mapping[str, Any], actor: Actor) -> str:
    """A digest of all that a person's output depends on."""
    told = {**settings, "recordings": [[r.name, r.who, contents(r.path)] for r in actor.recordings]}
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:24]


def _index(output: Path, actors: Sequence[Actor], metrics: Mapping[str, Sequence[Metric]], failures: Sequence[str]
           ) -> None:
    """The page of all people."""
    page = Page(f"{len(metrics)} {'person' if len(metrics) == 1 else 'people'} from markers",
                "Each picture leads to the page of the person, and that to the sequences.")
    if failures:
        page.section("Failed").table([(line,) for line in failures])
    for actor in actors:
        if actor.name not in metrics:
            continue
        told = [f"{m.name}: {m.text()} {m.unit}" for m in metrics[actor.name]
                if m.name in (*ERRORS, "sequences", "frames", "sex")]
        lines = "".join(f"<p>{escape(line)}</p>" for line in (*told, f"recordings put together: {actor.rule}"))
        link = escape(actor.name)
        page.markup(f'<div class="person"><div><a href="{link}/report.html"><b>{link}</b></a>{lines}</div>'
                    f'<a href="{link}/report.html"><img src="{link}/{PICTURE}" alt="{link}"></a></div>', _STYLE)
    page.write(output / "report.html")
