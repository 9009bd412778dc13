"""The page of a registered set: every scan with its pictures and figures, worst first."""
from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import numpy as np

from ..dataset import RegisteredSet, SetEntry
from ..geometry.mesh import Mesh
from ..pictures.page import Page, data_uri
from .figures import Limits, ScanFigures, Verdict, read_failures, read_figures, review

PICTURES, PAGE = "pictures", "report.html"

_STYLE = """
main { max-width: 76rem; }
.scan { display: grid; grid-template-columns: minmax(0, 1fr) 16rem; gap: .2rem 1.4rem; padding: 1rem 0 1.1rem;
  border-top: 1px solid var(--line); content-visibility: auto; contain-intrinsic-size: auto 300px; }
.scan h3 { grid-column: 1 / -1; margin: 0; font-size: 1.08rem; }
.scan h3 small { font-weight: 400; color: var(--soft); margin-left: .6rem; }
.scan ul { grid-column: 1 / -1; margin: .1rem 0 .5rem; padding: 0; list-style: none; font-size: .95rem; }
.scan li { display: inline-block; margin-right: 1.1rem; overflow-wrap: anywhere; }
.scan img { background: #fff; border-radius: 8px; width: 100%; }
.scan .panels { display: grid; grid-auto-flow: column; grid-auto-columns: 1fr; color: var(--soft); font-size: .82rem;
  text-align: center; }
.scan table { font-size: .86rem; width: 100%; align-self: start; }
.scan td { padding: .16rem 0; }
.dot { display: inline-block; width: .62em; height: .62em; border-radius: 50%; margin-right: .4em;
  background: #4f9d69; }
.look .dot, .dot.look { background: #e09a2b; } .failed .dot, .dot.failed { background: #cf3f36; }
.index { display: flex; flex-wrap: wrap; gap: .25rem 1.5rem; font-size: .93rem; }
.index a { margin-right: .7em; white-space: nowrap; }
.index b { margin-right: .6em; font-weight: 600; }
@media (max-width: 760px) { .scan { grid-template-columns: minmax(0, 1fr); } }
"""


def write_set_page(folder: str | Path, limits: Limits | None = None, to: Path | None = None) -> Path:
    """Write `report.html` of a set, from what lies in its folder, there or into another folder; returns its path."""
    folder, limits = Path(folder), limits or Limits()
    whole, verdicts = RegisteredSet.load(folder), judge_set(folder, limits)
    size = float(np.sqrt(whole.template.face_areas.sum()))
    entries = {entry.name: entry for entry in whole.entries}
    page = Page(f"Scans of {folder.absolute().name}", _lead(verdicts))
    page.markup("", _STYLE)
    page.table(_summary(verdicts), ("", "median", "worst", "unit"))
    page.section("Subjects", "Every scan, by subject: green is fine, amber needs a look, red could not be registered.")
    page.markup(_index(verdicts, entries))
    page.section("Worst first", _explanation(limits, size))
    page.picture(_legend(size))
    for verdict in verdicts:
        page.markup(_card(folder, verdict, entries.get(verdict.name)))
    if whole.skeleton is not None:
        page.section("Skeleton", f"{len(whole.skeleton.parents)} parts: {', '.join(whole.skeleton.names)}.")
        page.picture(_parts_picture(whole.template, whole.skeleton.part_of_face), "parts, front and back")
    page.write((to or folder) / PAGE)
    return (to or folder) / PAGE


def judge_set(folder: str | Path, limits: Limits | None = None) -> list[Verdict]:
    """The verdicts on all scans of a set, worst first."""
    folder = Path(folder)
    whole = RegisteredSet.load(folder)
    size = float(np.sqrt(whole.template.face_areas.sum()))
    figures = [f for f in read_figures(folder) if f.name in whole.names]
    return review(figures, read_failures(folder), size, len(whole.template.faces), limits)


def _lead(verdicts: Sequence[Verdict]) -> str:
    failed = sum(v.failed for v in verdicts)
    suspect = sum(v.suspect and not v.failed for v in verdicts)
    parts = [f"{failed} could not be registered"] * bool(failed) + [f"{suspect} need a look"] * bool(suspect)
    return f"{len(verdicts)} scans: {', '.join(parts) or 'all within their limits'}."


def _summary(verdicts: Sequence[Verdict]) -> list[tuple[str, float, float, str]]:
    known = [v.figures for v in verdicts if v.figures is not None and not v.failed]
    rows = (("distance to the scan, mean", 1000, "distance", "mm", max), ("vertices with data", 100, "seen", "%", min),
            ("scan off the template", 100, "missed", "%", max), ("stretched or shrunk", 100, "stretch", "%", max),
            ("inverted triangles", 1, "inverted", "", max), ("landmarks off, RMS", 1000, "landmarks", "mm", max))
    out = []
    for text, scale, name, unit, worst in rows:
        values = [scale * float(getattr(f, name)) for f in known]
        values = [value for value in values if np.isfinite(value)]
        if values:
            out.append((text, float(np.median(values)), worst(values), unit))
    return out


def _explanation(limits: Limits, size: float) -> str:
    return (
        "Scans that could not be registered come first, then the others by the figure that is furthest over its "
        "limit: that multiple is the number beside the name, and from 1 on a scan needs a look. The limits: "
        f"{100 * limits.missed:.3g}% of the scan more than {10 * size:.0f} mm off the template (an arm that it does "
        f"not cover, or clutter), {1000 * limits.distance * size:.1f} mm mean distance where there are data, "
        f"{100 * limits.unseen:.3g} points more surface without data than is usual in this set, "
        f"{100 * limits.stretch:.3g}% of the surface stretched to the double or shrunk to the half, "
        f"{100 * limits.inverted:.3g}% of the triangles inverted, landmarks {1000 * limits.landmarks * size:.0f} mm "
        f"off. A registration that did not converge counts {limits.not_converged:.3g}.\n\n"
        "To mend a scan, correct its landmarks or click more of them where it went wrong and run the same command "
        "again: only scans whose files have changed are registered anew.")


def _index(verdicts: Sequence[Verdict], entries: dict[str, SetEntry]) -> str:
    groups: dict[str, list[tuple[str, Verdict]]] = {}
    for verdict in sorted(verdicts, key=lambda v: v.name):
        entry = entries.get(verdict.name)
        subject = entry.subject if entry else ""
        groups.setdefault(subject or "not registered", []).append((entry.pose if entry else "", verdict))
    parts = []
    for subject, members in sorted(groups.items()):
        links = "".join(f'<a href="#{_anchor(v)}" title="{escape(v.name)}"><span class="dot {_mark(v)}"></span>'
                        f"{escape(pose or v.name)}</a>" for pose, v in members)
        alone = len(members) == 1 and members[0][1].name == subject
        parts.append(f"<span>{'' if alone else f'<b>{escape(subject)}</b>'}{links}</span>")
    return f'<div class="index">{"".join(parts)}</div>'


def _card(folder: Path, verdict: Verdict, entry: SetEntry | None) -> str:
    path = folder / PICTURES / f"{verdict.name}.webp"
    about = " · ".join(filter(None, [entry.subject if entry and entry.subject != verdict.name else "",
                                     entry.pose if entry else "", verdict.figures.init if verdict.figures else ""]))
    badness = "failed" if verdict.failed else f"{verdict.badness:.1f}"
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in verdict.reasons)
    shown = ""
    if path.exists():
        from .pictures import HEIGHT, PANELS, WIDTH

        labels = "".join(f"<span>{escape(label)}</span>" for label in PANELS)
        shown = (f'<div><img src="{data_uri(path.read_bytes())}" alt="{escape(verdict.name)}: {", ".join(PANELS)}" '
                 f'width="{WIDTH * len(PANELS)}" height="{HEIGHT}" loading="lazy" decoding="async">'
                 f'<div class="panels">{labels}</div></div>')
    if verdict.figures and verdict.figures.removed:
        about += f" · {100 * verdict.figures.removed:.0f}% of the points cleaned off"
    table = _figure_table(verdict.figures) if verdict.figures else ""
    return (f'<section class="scan {_mark(verdict)}" id="{_anchor(verdict)}"><h3><span class="dot"></span>'
            f"{escape(verdict.name)} <small>{badness}</small><small>{escape(about)}</small></h3>"
            f"<ul>{reasons}</ul>{shown}{table}</section>")


def _figure_table(f: ScanFigures) -> str:
    rows = (("distance, mean", f"{1000 * f.distance:.2f} mm"), ("distance, RMS", f"{1000 * f.rms:.2f} mm"),
            ("with data", f"{100 * f.seen:.0f}%"), ("confidence, mean", f"{f.confidence:.2f}"),
            ("scan off the template", f"{100 * f.missed:.1f}%"),
            ("stretched or shrunk", f"{100 * f.stretch:.1f}%"), ("inverted triangles", f"{f.inverted}"),
            ("landmarks off, RMS", "–" if np.isnan(f.landmarks) else f"{1000 * f.landmarks:.1f} mm"),
            ("converged", "yes" if f.converged else "no"))
    return "<table>" + "".join(f'<tr><td>{name}</td><td class="number">{value}</td></tr>'
                               for name, value in rows) + "</table>"


def _mark(verdict: Verdict) -> str:
    return "failed" if verdict.failed else "look" if verdict.suspect else "fine"


def _anchor(verdict: Verdict) -> str:
    return "scan-" + escape(verdict.name.replace(" ", "_"))


def _legend(size: float) -> np.ndarray:
    from ..pictures.colors import color_bar
    from .pictures import FAR

    return color_bar(0, FAR * size, "distance to the scan; grey: no data there")


def _parts_picture(template: Mesh, part_of_face: np.ndarray) -> np.ndarray:
    from ..pictures.camera import look_around
    from ..pictures.shading import Solid, part_colors, render, side_by_side

    body = Solid(template, part_colors(part_of_face))
    return side_by_side([render(body, camera, 240, 340) for camera in look_around(template, turns=(20, 200))])
