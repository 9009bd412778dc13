"""The people of a call: who is who, their figures, and the page of all of them, worst first."""
from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from scanprep.batch.pool import Workers
from scanprep.batch.room import Progress
from scanprep.batch.workspace import Task, Workspace
from scanprep.console import PROBLEM, Metric
from scanprep.pictures.page import Page

from .recordings import TABLE, Actor, write_table
from .report import PICTURE
from .work import ERRORS, Work

_STYLE = """.person { display: grid; grid-template-columns: minmax(17rem, 1fr) 2fr; gap: 1rem; margin: 1.6rem 0; }
.person img { width: 100%; } .person p { margin: .2rem 0; }"""


@dataclass(frozen=True)
class Finished:
    """How the people of a call fared.

    Attributes
    ----------
    metrics : name of the person -> the rows of its table
    before : int
        People that had been done before.
    failures : one line for each person or file that failed, and for each person whose figures mean nothing
    """

    metrics: dict[str, list[Metric]]
    before: int
    failures: list[str]


def mosh_people(work: Work, actors: Sequence[Actor], space: Workspace, workers: Workers | None = None,
                progress: Progress | None = None, inside: Progress | None = None) -> Finished:
    """Every person into a folder of its name; one that fails stops no other."""
    done = space.run(work, [Task(actor.name, actor, actor.name) for actor in actors], workers, progress, inside)
    failures = [line if line.startswith(f"{name}: ") else f"{name}: {line}" for name, line in done.failures.items()]
    for name, (rows, failed) in done.values.items():
        failures += [f"{name}: {line}" for line in [*(str(m.value) for m in rows if m.name == PROBLEM), *failed]]
    metrics = {name: [m for m in rows if m.name != PROBLEM] for name, (rows, _) in done.values.items()}
    with space.staging("page") as staged:
        _page(actors, metrics, failures).write(staged.folder / "report.html")
    return Finished(metrics, len(metrics) - len(done.fresh), failures)


def keep_table(space: Workspace, actors: Sequence[Actor], named: bool) -> None:
    """Who is who into subjects.csv; one that was mended stays as it is.

    Parameters
    ----------
    named : bool
        The user said who is who in a table.

    Raises
    ------
    ValueError
        A table that was mended, and is not named.
    """
    table = space.folder / TABLE
    if not table.exists() or space.is_ours(TABLE):
        with space.staging("people") as staged:
            write_table(staged.folder / TABLE, actors)
    elif named:
        warnings.warn(f"{table}: left as it was mended", stacklevel=2)
    else:
        raise ValueError(f"{table}: was mended; go by it with --subjects {table}, or move it away")


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


def _page(actors: Sequence[Actor], metrics: Mapping[str, Sequence[Metric]], failures: Sequence[str]) -> Page:
    """All people, those with the largest error first."""
    page = Page(f"{len(metrics)} {'person' if len(metrics) == 1 else 'people'} from markers, worst first",
                "Each picture leads to the page of the person, and that to the sequences.")
    if failures:
        page.section("Failed").table([(line,) for line in failures])
    error = {name: float(next(m.value for m in rows if m.name == ERRORS[0])) for name, rows in metrics.items()}
    rules = {actor.name: actor.rule for actor in actors}
    for name in sorted(metrics, key=lambda name: (-error[name], name)):
        told = [f"{m.name}: {m.text()} {m.unit}" for m in metrics[name]
                if m.name in (*ERRORS, "sequences", "frames", "sex")]
        lines = "".join(f"<p>{escape(line)}</p>" for line in (*told, f"recordings put together: {rules[name]}"))
        link = escape(name)
        page.markup(f'<div class="person"><div><a href="{link}/report.html"><b>{link}</b></a>{lines}</div>'
                    f'<a href="{link}/report.html"><img src="{link}/{PICTURE}" alt="{link}"></a></div>', _STYLE)
    return page
