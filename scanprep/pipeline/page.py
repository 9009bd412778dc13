"""The page of a registered set: every scan with pictures and figures, worst first; and how the pictures are made."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ..dataset import RegisteredSet, SetEntry
from ..geometry import rotations
from ..geometry.farthest_points import thin
from ..geometry.members import find_several_people, measure_scales
from ..geometry.mesh import Mesh
from ..judgement import Judgement, judge_many
from ..judgement import size as size_of
from ..pictures.camera import Camera, look_around
from ..pictures.page import Page
from ..pictures.scene import SMALL, Pane, small_scene, worst_that_turn
from ..pictures.shading import CLAY, Dots, Heat, Shape, Solid, color_bar, part_colors, render
from ..pictures.sheets import webp_bytes
from ..pictures.thinning import thin_solid
from ..registration.figures import (
    UNSEEN,
    Limits,
    Verdict,
    read_doubts,
    read_failures,
    read_figures,
    review,
)
from ..registration.nonrigid import Registration
from ..skeleton.names import skeleton_doubts
from ..words import number_of
from .rivals import RIVALS, doubt_rivals

PICTURES, PAGE = "pictures", "report.html"     # folder and file inside the set
WIDTH, HEIGHT = 150, 216    # pixels of one picture: five side by side fit on the page, of a standing person
FAR = 0.005                 # share of the template's size at the dark end of the distance colours, 7 mm on a person
TURN = 20.0                 # degrees from the front: shows depth, and the face

# titles of the pictures in a strip, in the order of `pictures_of`
PANELS = ("the scan", "the template on it", "distance, front", "distance, back", "dark: not sure")


def write_set_page(folder: str | Path, limits: Limits | None = None, to: Path | None = None) -> Path:
    """Write `report.html` of a set from the files in its folder, there or into another folder; return its path."""
    folder, limits = Path(folder), limits or Limits()
    registered, verdicts = RegisteredSet.load(folder), judge_set(folder, limits)
    size = size_of(registered.template)
    entries = {entry.name: entry for entry in registered.entries}
    # head of the page: how many scans need a look, the verdict, and figures over all scans
    failed = sum(v.failed for v in verdicts)
    suspect = sum(v.suspect and not v.failed for v in verdicts)
    parts = [f"{failed} could not be registered"] * bool(failed) + [f"{suspect} need a look"] * bool(suspect)
    page = Page(f"Scans of {folder.absolute().name}",
                f"{number_of(len(verdicts), 'scan')}: {', '.join(parts) or 'all within their limits'}.")
    page.verdict(judge_whole(verdicts, registered, limits))
    page.markup(f"<style>{Path(__file__).with_name('page.css').read_text(encoding='utf-8')}</style>")
    page.table(_summary(verdicts), ("", "median", "worst", "unit"))
    page.section("Worst first", "Green is fine, amber needs a look, red could not be registered.\n\n"
                 + _explanation(limits, size))
    page.picture(color_bar(0, FAR * size, "distance to the scan; grey: no data there"))
    # scenes of the worst scans are carried by the page, as far as its size allows
    shots = [folder / pictures_place(entries.get(verdict.name)) / verdict.name for verdict in verdicts]
    scenes = worst_that_turn([shot.with_name(f"{shot.name}.scene") for shot in shots])
    # every scan that needs a look can be turned, and at least six
    look = max(6, sum(verdict.suspect or verdict.failed for verdict in verdicts))
    for number, (verdict, scene) in enumerate(zip(verdicts, scenes, strict=True)):
        entry = entries.get(verdict.name)
        view = _scan_view(page, folder, pictures_place(entry), verdict.name, scene if number < look else None)
        rival = _scan_view(page, folder, pictures_place(entry).with_name(RIVALS), verdict.name, None)
        page.markup(_card(verdict, entry, view, rival))
    if registered.skeleton is not None:
        page.section("Skeleton", f"{len(registered.skeleton.parents)} parts: {', '.join(registered.skeleton.names)}.")
        page.bodies([Pane([Solid(registered.template, part_colors(registered.skeleton.part_of_face))],
                          look_around(registered.template, turns=(TURN,))[0])], "parts")
    page.write((to or folder) / PAGE)
    return (to or folder) / PAGE


def pictures_place(entry: SetEntry | None) -> Path:
    """Return the folder of a scan's pictures inside the set: beside the folder of its mesh."""
    return Path(PICTURES) if entry is None else Path(entry.file).parent.parent / PICTURES


def judge_set(folder: str | Path, limits: Limits | None = None) -> list[Verdict]:
    """Judge all scans of a set; return the verdicts, worst first."""
    folder = Path(folder)
    whole = RegisteredSet.load(folder)
    figures = [f for f in read_figures(folder) if f.name in whole.names]
    verdicts = review(figures, read_failures(folder), size_of(whole.template), len(whole.template.faces), limits,
                      read_doubts(folder))
    return doubt_rivals(verdicts, folder, whole.entries)


def judge_whole(verdicts: Sequence[Verdict], registered: RegisteredSet | None, limits: Limits | None = None,
                parts: int | None = None) -> Judgement:
    """Judge a set: its scans, whether most of the surface has data, and the skeleton, which was to have `parts` parts.

    Without a `registered` set, or one that has no skeleton, only the scans are judged.

    A gap that all scans share is no fault of one scan. Of twenty real people seen from the front 16 are good one by
    one, though in every second man one limb, unseen, is more than 45 mm off.
    """
    unseen = [1 - verdict.figures.seen for verdict in verdicts if verdict.figures is not None]
    usual, most = float(np.median(unseen)) if unseen else 0.0, UNSEEN + (limits or Limits()).unseen
    doubts = [f"{100 * usual:.0f}% of a body has no data in these scans: what is there is a guess"] if usual > most \
        else []
    if registered is not None and registered.skeleton is not None:
        # people who were taken for one are the cause of what their skeleton lacks
        scales = measure_scales(registered.template, registered.poses())
        doubts += find_several_people(scales, str(registered.folder))
        doubts += skeleton_doubts(registered.skeleton, parts)
    return judge_many({verdict.name: verdict.judgement for verdict in verdicts}).merge(Judgement.of(check=doubts))


def _summary(verdicts: Sequence[Verdict]) -> list[tuple[str, float, float, str]]:
    """Return rows of median and worst value of each figure over the registered scans."""
    known = [v.figures for v in verdicts if v.figures is not None and not v.failed]
    rows = (("distance to the scan, mean", 1000, "distance", "mm", max), ("surface with data", 100, "seen", "%", min),
            ("scan off the template", 100, "missed", "%", max), ("stretched or shrunk", 100, "stretch", "%", max),
            ("inverted triangles", 1, "inverted", "", max), ("landmarks off, RMS", 1000, "landmarks", "mm", max))
    table = []
    for text, scale, name, unit, worst in rows:
        values = [scale * float(getattr(f, name)) for f in known]
        values = [value for value in values if np.isfinite(value)]
        if values:
            table.append((text, float(np.median(values)), worst(values), unit))
    return table


def _explanation(limits: Limits, size: float) -> str:
    """Return the text that explains the limits."""
    return (
        "Scans that could not be registered come first, then the others by the figure that is furthest over its "
        "limit: that multiple is the number beside the name, and from 1 on a scan needs a look. The limits: "
        f"{100 * limits.missed:.3g}% of the scan more than {10 * size:.0f} mm off the template (an arm that it does "
        f"not cover, or clutter), {1000 * limits.distance * size:.1f} mm mean distance where there are data, "
        f"{100 * limits.unseen:.3g} points more surface without data than is usual in this set or in one view, "
        f"{100 * limits.stretch:.3g}% of the surface stretched to the double or shrunk to the half (a third of "
        "it where the template is no person), "
        f"{100 * limits.inverted:.3g}% of the triangles inverted, landmarks {1000 * limits.landmarks * size:.0f} mm "
        f"off. A registration that did not converge counts {limits.not_converged:.3g}. On a template that is a person, "
        "joints that roll or bend as no person's do, limbs whose skin is out of shape and limbs that no view shows "
        "count too: a rolled limb lies on the scan as well as the right one. All figures together make a probability "
        "that it is right within 20 mm; "
        f"below {100 * limits.right:.0f}% a scan needs a look.\n\n"
        "To mend a scan, correct its landmarks or click more of them where it went wrong and run the same command "
        "again: only scans whose files have changed are registered anew. `scape pick` with the folder of this set "
        "does both in the browser.")


def _card(verdict: Verdict, entry: SetEntry | None, shown: str, rival: str) -> str:
    """Return HTML of one scan: its figures, reasons and pictures."""
    f, table = verdict.figures, ""
    about = " · ".join(filter(None, [entry.subject if entry and entry.subject != verdict.name else "",
                                     entry.pose if entry else "", f.init if f else ""]))
    badness = "failed" if verdict.failed else f"{verdict.badness:.1f}"
    reasons = "".join(f"<li>{escape(reason)}</li>" for reason in verdict.reasons)
    if f:
        about += f" · {100 * f.removed:.0f}% of the points cleaned off" if f.removed else ""
        # the table of figures
        rows = (("distance, mean", f"{1000 * f.distance:.2f} mm"), ("distance, RMS", f"{1000 * f.rms:.2f} mm"),
                ("with data", f"{100 * f.seen:.0f}%"), ("confidence, mean", f"{f.confidence:.2f}"),
                ("scan off the template", f"{100 * f.missed:.1f}%"),
                ("stretched or shrunk", f"{100 * f.stretch:.1f}%"), ("inverted triangles", f"{f.inverted}"),
                *([("limbs rolled otherwise", "yes")] if f.rolled else []),
                ("landmarks off, RMS", "–" if np.isnan(f.landmarks) else f"{1000 * f.landmarks:.1f} mm"),
                ("converged", "yes" if f.converged else "no"),
                *([("right within 20 mm, probability", f"{100 * verdict.right:.0f}%")] if verdict.right >= 0 else []))
        table = "<table>" + "".join(f'<tr><td>{name}</td><td class="number">{value}</td></tr>'
                                    for name, value in rows) + "</table>"
    return (f'<section class="scan {_mark(verdict)}"><h3><span class="dot"></span>'
            f"{escape(verdict.name)} <small>{badness}</small><small>{escape(about)}</small></h3>"
            f"<ul>{reasons}</ul>{shown}{table}"
            + (f"<div><h4>the other body that explains the scan</h4>{rival}</div>" if rival else "") + "</section>")


def _scan_view(page: Page, folder: Path, place: Path, name: str, scene: bytes | None) -> str:
    """Return HTML of a scan that turns, or of its picture, a file beside the page."""
    picture = folder / place / f"{name}.webp"
    if not picture.exists():
        return ""
    if scene is not None:
        return page.turning(scene, picture.read_bytes(), height=300)
    source = quote((place / f"{name}.webp").as_posix())
    labels = "".join(f"<span>{escape(label)}</span>" for label in PANELS)
    return (f'<div><img src="{source}" alt="{escape(name)}: {", ".join(PANELS)}" '
            f'width="{WIDTH * len(PANELS)}" height="{HEIGHT}" loading="lazy" decoding="async">'
            f'<div class="panels">{labels}</div></div>')


def _mark(verdict: Verdict) -> str:
    """Return the CSS class of a verdict."""
    return "failed" if verdict.failed else "look" if verdict.suspect else "fine"


def pictures_of(template: Mesh, scan: Mesh | np.ndarray, fit: Registration) -> tuple[bytes, bytes]:
    """Draw a registered scan: a strip of pictures as WebP, in the order of `PANELS`, and a packed scene.

    All are seen as the template would be from its front, whichever way the person stood in the scanner.
    """
    # turn the body back into the template's orientation
    R, _ = rotations.procrustes(fit.mesh.vertices, template.vertices)
    middle = fit.mesh.vertices.mean(axis=0)
    body = fit.mesh.with_vertices((fit.mesh.vertices - middle) @ R.T)
    front, back = (replace(c, width=1.06 * c.width, height=1.06 * c.height)
                   for c in look_around(template, body.vertices, (TURN, TURN + 180)))
    # the scan, turned like the body, with only as much detail as a small picture shows
    size = size_of(template)
    raw: Solid | Dots
    if isinstance(scan, Mesh) and len(scan.faces):
        raw = thin_solid(Solid(scan.with_vertices((scan.vertices - middle) @ R.T)), SMALL)
    else:
        points = scan.vertices if isinstance(scan, Mesh) else scan
        ball = 0.013 * size
        raw = Dots((points[thin(points, 1.25 * ball)] - middle) @ R.T, CLAY, ball)
    far = Heat(fit.distances, 0, FAR * size, "distance to the scan")
    sure = Heat(1 - fit.confidence, 0, 1)
    shown: list[tuple[Shape, Camera]] = [
        (raw, front), (Solid(body, CLAY), front), (Solid(body, far), front), (Solid(body, far), back),
        (Solid(body, sure), front)]
    strip = webp_bytes(np.concatenate([render(shape, camera, WIDTH, HEIGHT) for shape, camera in shown], axis=1))
    # for the browser: the body in several colourings, the scan over it hidden at first
    registered = Solid(body, far, name="registered template", shades={
        "not sure": Heat(1 - fit.confidence, 0, 1, "not sure", "%"), "plain": np.array(CLAY)})
    over = replace(raw, name="scan over it", visible=False)
    return strip, small_scene([Pane([raw], front, "scan"), Pane([registered, over], front, "the template on it")])
