"""The page of measurements: tapes drawn on the bodies, and a table."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from model.measurement.catalogue import CATALOGUE
from model.measurement.measure import Measurements
from model.measurement.reading import DENSITY, DENSITY_SPREAD
from model.measurement.survey import ordinal, percentiles, survey
from model.measurement.tapes import Girth, Height, Tapes
from model.measurement.wanted import WantedBody
from model.shape_statistics import WORDS, Sex
from scanprep.pictures.camera import Camera
from scanprep.pictures.page import Page
from scanprep.pictures.scene import Pane
from scanprep.pictures.shading import Bones, Dots, Shape, Solid

DRAWN, BESIDE_EACH_OTHER = 24, 3     # bodies that are drawn, 0.1 MB each: more make the page slow; bodies in one figure
COLUMNS = 6                          # bodies in one table: more do not fit on the page
HEIGHT = (0.25, 0.30, 0.38)          # colour of the lines of heights: neutral, as they are beside the body


def measures_page(names: Sequence[str], bodies: Sequence[np.ndarray], measured: Sequence[Measurements], tapes: Tapes,
                  sex: Sex | None = None) -> Page:
    """Build the page of `scape measure`, of bodies (N, 3) as measured, compared with people of a sex."""
    several = f"{len(names)} bodies" if len(names) > 1 else names[0]
    page = Page(f"{several}, measured", "Where the tape ran on each body. Metres in the table file, millimetres here; "
                "the weight is in kilograms.")
    every, drawn = range(len(names)), range(min(DRAWN, len(names)))
    for first in drawn[::BESIDE_EACH_OTHER]:
        group = drawn[first:first + BESIDE_EACH_OTHER]
        caption = "" if first else ("Red: girths, a tape that spans hollows. Blue: lengths along the skin and widths. "
                                    "Grey, beside the body: heights. Drag to turn; the list hides and shows them.")
        page.bodies([_pane(names[k], bodies[k], measured[k], tapes, len(group) == 1) for k in group], caption,
                    560 if len(group) < 3 else 420)
    if len(names) > DRAWN:
        page.text(f"Drawn are the first {DRAWN} of {len(names)} bodies.")
    for first in every[::COLUMNS]:
        group = every[first:first + COLUMNS]
        page.table([(_words(both), *(_cell(measured[k], both, sex) for k in group)) for both in _pairs()
                    if any(name in measured[k].readings for k in group for name in both)],
                   ("mm", *(names[k] for k in group)))
    if sex:
        page.text(f"In brackets: the percentile among {survey(sex).people:,} {WORDS[sex]} of ANSUR II, the survey of "
                  "US Army personnel of 2012. Soldiers are leaner and younger than everybody. "
                  "Measures that the survey took in another way have none.")
    notes = [(names[k], line) for k in every for line in (
        *measured[k].turned, *(f"no {name.replace('_', ' ')}: {why}" for name, why in measured[k].missing.items()))]
    if notes:
        page.section("To be looked at").table(notes)
    page.section("How it is measured").text(
        "Where each tape runs was found once on the template, from its landmarks and its shape, and goes with the "
        "vertices. The waist is as high as the navel, the bust as the nipples, and hips are the widest of each body. "
        "Trunk, head and thighs are measured level, arms, shins and neck across their own axis. Heights are those of "
        "legs that are straight and upright. Lengths along the skin are exact shortest ways over the same "
        "landmarks.\n\n"
        "± is the error to be expected, root mean square. It has three sources: the surface, as far as the scan showed "
        "it; the place of the tape along the body; and the pose, where the body was brought into another one. It does "
        "not tell how far a landmark is from the bone that the standard names. The weight is "
        f"{DENSITY:.0f} kilograms for every cubic metre inside the skin, with lungs half full; people differ from that "
        f"by {100 * DENSITY_SPREAD:.0f}%, which is its ± at least.")
    return page.table([(_words(both), CATALOGUE[both[0]].standard) for both in _pairs()], ("here", "term and standard"))


def likely_section(page: Page, made: WantedBody) -> Page:
    """Add the likely values of measurements that were not asked for."""
    who = WORDS[made.sex] if made.sex else "people"
    return page.section("What was not asked for").text(
        f"Of the {who} that the model knows, those who have what was asked for: what is most likely, which is this "
        "body, and between which values nine of ten of them are.").table(
        [(name.replace("_", " "), _number(name, value), _number(name, low), _number(name, high))
         for name in CATALOGUE if name in made.likely for low, value, high in [made.likely[name]]],
        ("mm", "this body", "5%", "95%"))


def _pairs() -> list[tuple[str, ...]]:
    """List the measurements, left and right together."""
    return [(name, name.replace("_left", "_right")) if name.endswith("_left") else (name,) for name in CATALOGUE
            if not name.endswith("_right")]


def _words(sides: tuple[str, ...]) -> str:
    """Return names as they are in the table, in one line."""
    return sides[0].replace("_left", ", left / right").replace("_", " ").replace(" ", "\u00a0")


def _number(name: str, value: float) -> str:
    """Return millimetres without unit, which is in the head of the table; kilograms with it."""
    return CATALOGUE[name].text(value).removesuffix(" mm")


def _cell(read: Measurements, sides: tuple[str, ...], sex: Sex | None) -> str:
    """Return one measurement, or left and right, with percentiles among people of a sex."""
    shares = percentiles(read.values, sex) if sex else {}

    def text(name: str) -> str:
        """Return one value with its expected error and percentile."""
        if name not in read.values:
            return "–"
        error = f" ± {_number(name, read.errors[name])}" if name in read.errors else ""
        return f"{_number(name, read.values[name])}{error}" + (f" ({ordinal(shares[name])})" if name in shares else "")

    return " / ".join(map(text, sides))


def _pane(name: str, vertices: np.ndarray, measured: Measurements, tapes: Tapes, labelled: bool) -> Pane:
    """Draw a body with its tapes; the lines of heights are beside it, named where there is room."""
    mesh = tapes.template.with_vertices(vertices)
    up, left, ahead = measured.axes
    curves: dict[str, list[np.ndarray]] = {"girths": [], "lengths and widths": [], "heights": []}
    line_gap = 0.045  # metres between the lines of heights
    words, side = list[str](), float((vertices @ left).max()) + line_gap
    # sort the tapes into kinds; each line of height goes a little further beside the body
    for term, reading in measured.readings.items():
        tape, curve = tapes.found[term], reading.curve
        if isinstance(tape, Height):
            curve = curve + (side + len(words) * line_gap - curve @ left)[:, None] * left
            words.append(term.replace("_", " "))
        curves["girths" if isinstance(tape, Girth) else "heights" if isinstance(tape, Height)
               else "lengths and widths"].append(curve)
    beside = curves["heights"]
    shapes: list[Shape] = [Solid(mesh, (0.86, 0.83, 0.79), name="body")]
    for (what, lines), color in zip(curves.items(), ((0.80, 0.20, 0.16), (0.10, 0.38, 0.66), HEIGHT), strict=True):
        if lines:
            shapes.append(Bones(np.concatenate([c[:-1] for c in lines]), np.concatenate([c[1:] for c in lines]),
                                color, 0.003, name=what))
    if beside and labelled:
        shapes.append(Dots(np.array([c[-1] for c in beside]), HEIGHT, 0.008, labels=words))
    points = np.concatenate([vertices, *beside])
    return Pane(shapes, Camera.from_side(points, ahead, up), name)
