"""The command `scape measure`."""
from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from model.body import BodyModel
from model.built_in import load_built_in_model
from model.files import load_model
from model.measurement.catalogue import CATALOGUE, plain
from model.measurement.measure import Measurements, measure
from model.measurement.plausible import implausible_measures
from model.measurement.survey import ordinal, percentiles
from model.measurement.tapes import Tapes
from model.measurement.wanted import WantedBody, body_with_measurements, check_wanted
from model.people import stature_and_volume
from model.posing.standing import StandingModel
from model.shape_statistics import WORDS, Sex, shape_statistics
from scanprep.arguments import Place, UsageError
from scanprep.cli import MM, Output, PersonUnit
from scanprep.console import Metric, Outcome, bar
from scanprep.geometry.files import write_mesh
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import write_json
from scanprep.geometry.tables import write_table
from scanprep.judgement import Judgement
from scanprep.plausible import implausible_body
from scanprep.words import number_of

from ..cli import ModelOrNone, read_model
from .bodies import Body, model_of, read_bodies
from .page import likely_section, measures_page
from .template import measure_body, tape_template

BodiesArg = Annotated[tuple[Path, ...], Place("[BODY ...]")]


def measure_bodies(bodies: BodiesArg = (), *, output: Output, model: ModelOrNone = None,
                   landmarks: Path | None = None, unit: PersonUnit | None = None, to: tuple[str, ...] = (),
                   sex: Sex | None = None) -> Outcome:
    """Stature, girths, lengths, widths and weight of bodies, or the body that has some.

    Example: scape measure completed -m model.npz -o measures.csv

    Example: scape measure body.ply --sex female -o measures.csv

    Example: scape measure --to stature=1.80 weight=78 waist=0.85 --sex male -o body.ply

    Args:
        bodies: Meshes in the triangles of one template or model, folders of them, registered sets, folders of scape
            complete and mosh, or betas of a model (JSON, .npz).
        output: Table to write (.csv), in metres and kilograms, one line a body; beside it a page of the same name
            (.html) with the tapes on the bodies. With --to the mesh of the body; its betas are written beside it, for
            --subject.
        model: Model of the bodies, else the one that their report names; everybody is brought into its pose first.
            Without any the template is that of the set, else the first body, and the built-in people are laid on it.
        landmarks: Where the landmarks are on the template, else those that the model keeps, or of the file beside the
            bodies, or of the built-in people.
        unit: Unit of meshes; "unknown": it is found together with the person.
        to: Measurements that a body is to have, in metres, and its weight in kilograms, such as stature=1.80 weight=78;
            the rest is as probable as it can be, and told with its range. Needs a model, or takes the built-in one.
        sex: Also tell percentiles among the 4,082 men or 1,986 women of ANSUR II, of measurements that were taken in
            the same way there. They were soldiers of 17 to 58 years, who are leaner than everybody. With --to the
            body is of that sex, else of the more probable one, if the model tells women from men, as the built-in
            one does.
    """
    if to:
        if bodies:
            raise UsageError("--to makes a body from measurements: expected no BODY with it")
        return _make_body(to, output, *read_model(model), landmarks, sex)
    if not bodies:
        raise ValueError("BODY: expected at least one body to measure, or --to with measurements of one to make")
    if output.suffix.lower() != ".csv":
        raise ValueError(f"{output}: expected the name of a table, such as measures.csv")
    named = model or model_of(bodies)
    loaded = None if named is None else load_model(named)
    read = read_bodies(bodies, loaded, unit)
    if loaded is None and np.array_equal(read[0].mesh.faces, load_built_in_model().template.faces):
        loaded = load_built_in_model()
    tapes, standing_model = tape_template(landmarks, read, loaded)
    measured = measure_all(read, tapes, standing_model)
    standing, names = [one.body for one in measured], [body.name for body in read]
    write_measures(output, names, measured, sex)
    measures_page(names, standing, measured, tapes, sex).write(output.with_suffix(".html"))
    return Outcome(output, _figures(names, measured, sex), {"model": None if named is None else str(named)},
                   judgement=judge_bodies(names, measured, [tapes.template.with_vertices(body) for body in standing]))


def measure_all(bodies: Sequence[Body], tapes: Tapes, standing: StandingModel | None) -> list[Measurements]:
    """Measure bodies; each with `Measurements.body` as it was measured."""
    measured = list[Measurements]()
    with bar("measuring") as progress:
        for body in bodies:
            measured.append(measure_body(body, tapes, standing))
            progress(len(measured), len(bodies))
    return measured


def write_measures(path: Path, names: Sequence[str], measured: Sequence[Measurements], sex: Sex | None = None) -> None:
    """Write a table with one line per body.

    Columns are name, measurements in metres and kilograms, expected errors, percentiles among people of a sex if given,
    and notes on what is missing.
    """
    columns = list(CATALOGUE)
    compared = list(percentiles(dict.fromkeys(columns, 1.0), sex)) if sex else []

    def line(name: str, measurements: Measurements) -> list[str]:
        """Return the line of one body."""
        values, errors = measurements.values, measurements.errors
        shares = percentiles(values, sex) if sex else {}
        notes = [*measurements.turned, *(f"{word}: {why}" for word, why in measurements.missing.items())]
        return [name, *(f"{values[c]:.4f}" if c in values else "" for c in columns),
                *(f"{errors[c]:.4f}" if c in errors else "" for c in columns),
                *(f"{shares[c]:.1f}" if c in shares else "" for c in compared), "; ".join(notes)]

    write_table(path, ["body", *columns, *(f"{c}_error" for c in columns), *(f"{c}_percentile" for c in compared),
                       "note"], map(line, names, measured))


def judge_bodies(names: Sequence[str], all_measured: Sequence[Measurements], bodies: Sequence[Mesh]) -> Judgement:
    """Judge whether bodies were measured properly: in the standard pose, completely, as people are, in the unit."""
    absurd, doubts = list[str](), list[str]()
    for name, one, body in zip(names, all_measured, bodies, strict=True):
        if "stature" in one.values:
            known = implausible_body(one.values["stature"], stature_and_volume(body)[1])
            absurd += [f"{name}: {reason}" for reason in known.problems]
            doubts += [f"{name}: {reason}" for reason in known.doubts]
        # measurements more than 30% beyond the range of people
        out = [word for word, value in one.values.items() if word != "weight" and      # judged by volume above
               not 0.7 * CATALOGUE[word].low <= value <= 1.3 * CATALOGUE[word].high]
        if len(out) > len(one.values) / 2:
            absurd.append(f"{name}: no person measures so, {out[0]} {one.values[out[0]]:.3g} m: the wrong unit "
                          "(--unit), or other landmarks?")
        elif out:
            usual = CATALOGUE[out[0]]
            doubts.append(f"{name}: {out[0].replace('_', ' ')} is {usual.text(one.values[out[0]])}, people have "
                          f"{usual.text(usual.low)} to {usual.text(usual.high)}: look at its tape on the page")
        doubts += [f"{name}: {turned}; name the model with -m" for turned in one.turned[:1]]
        doubts += [f"{name}: {reason}" for reason in implausible_measures(one.values, one.errors)[:1]]
        # an open surface has no volume, so no weight: not a fault
        missing = [word for word in one.missing if word in CATALOGUE and word != "weight"]
        if missing:
            doubts.append(f"{name}: no {missing[0].replace('_', ' ')}, {one.missing[missing[0]]}"
                          + (f", and {number_of(len(missing) - 1, 'other')}" if len(missing) > 1 else ""))
    # all bodies impossible: failed; else three reasons to look at them
    if absurd and len({line.partition(": ")[0] for line in absurd}) == len(names):
        return Judgement.of(absurd[:3])
    reasons = [*absurd, *doubts]
    more = [f"{len(reasons) - 3} more, see the table"] if len(reasons) > 3 else []
    return Judgement.of(check=[*reasons[:3], *more])


def _figures(names: Sequence[str], measured: Sequence[Measurements], sex: Sex | None) -> list[Metric]:
    """Return all measurements of one body, or totals for several."""
    if len(measured) > 1:
        return [Metric("bodies", len(names)),
                Metric("measurements of all bodies", sum(len(each.readings) for each in measured)),
                Metric("left out", sum(len(each.missing) for each in measured)),
                Metric("stature, mean", MM * float(np.mean([each.values["stature"] for each in measured])), "mm")]
    single = measured[0]
    errors = {name: f" (± {_number(name, error)})" for name, error in single.errors.items()}
    return [_row(name, value, sex, errors.get(name, "")) for name, value in single.values.items()]


def _number(name: str, value: float) -> str:
    """Return a value in the unit that people use, without its name."""
    return CATALOGUE[name].text(value).rpartition(" ")[0]


def _row(name: str, value: float, sex: Sex | None, more: str = "", detail: bool = False) -> Metric:
    """Return a measurement as a row of figures, with its percentile among people of a sex."""
    factor, unit, _ = CATALOGUE[name].shown
    share = percentiles({name: value}, sex).get(name) if sex else None
    compared = f", {ordinal(share)} of {WORDS[sex]}" if sex and share is not None else ""
    return Metric(name.replace("_", " ") + more, round(factor * value, 1), unit + compared, detail)


def _make_body(to: Sequence[str], output: Path, model: BodyModel, name: str, landmarks: Path | None, sex: Sex | None
               ) -> Outcome:
    """Make the most probable body with given measurements: its mesh, betas and page."""
    wanted = check_wanted(read_measurements(to))
    shape_statistics(model, sex)              # raises at once for a sex that the model does not know
    tapes, _ = tape_template(landmarks, [], model)
    made = body_with_measurements(model, tapes, wanted, sex)
    write_mesh(output, model.template.with_vertices(made.vertices))
    betas = output.with_name(f"{output.stem}.betas.json")
    write_json(betas, {"betas": made.betas, "measurements": made.reached, "deviations": made.deviations,
                       "likely": made.likely, "sex": made.sex})
    title = output.stem
    page = measures_page([title], [made.vertices], [measure(made.vertices, tapes, tapes.axes)], tapes, made.sex)
    likely_section(page, made).write(output.with_suffix(".html"))
    warnings.warn(f"the betas are in {betas.name}; scape complete --subject takes them", stacklevel=2)
    # the table: what was asked for, how usual that is, and other common measurements
    rows = [_row(word, made.reached[word], made.sex, f", wanted {_number(word, value)}")
            for word, value in made.wanted.items()]
    if made.sex is not None and sex is None:
        rows.append(Metric("sex", f"{made.sex} ({100 * made.sex_probability:.0f}%)"))
        warnings.warn("nobody said the sex, so the more probable one is taken; name it with --sex, and the body and "
                      "the ranges are those of that sex", stacklevel=2)
    rows += [Metric("from the mean person", made.deviations, "sd"),
             Metric("people as far from the mean in these measurements", 100 * made.rarer, "%")]
    # other measurements in the closing table; page and report have all of them
    asked_most = ("stature", "weight", "chest_girth", "waist_girth", "hip_girth", "thigh_girth_left", "crotch_height")
    first = [word for word in asked_most if word in made.likely]
    rows += [_row(word, made.likely[word][1], made.sex, f", likely {_number(word, made.likely[word][0])} to "
                  f"{_number(word, made.likely[word][2])}", word not in first)
             for word in [*first, *(word for word in CATALOGUE if word in made.likely and word not in first)]]
    return Outcome(output, rows, {"model": name, "sex": sex}, judgement=judge_wanted(made))


def judge_wanted(made: WantedBody) -> Judgement:
    """Judge whether the body has what was asked for, and whether people do; name what fits least."""
    def words(name: str) -> str:
        """Return a name as words."""
        return name.replace("_", " ")

    missed = [f"{words(name)} is {CATALOGUE[name].text(made.reached[name])}, not "
              f"{_number(name, made.wanted[name])}: the measurements contradict each other, or nobody whom the model "
              "knows has them" for name, off in made.missed.items()
              if abs(off) > 10 * CATALOGUE[name].exact]                # 2 mm: two people who measure differ by more
    rare = [f"fewer than one person in {1 / max(made.rarer, 1e-6):,.0f} is so far from the mean, by what the model "
            "knows"] if made.rarer < 1e-3 else []
    if not missed and not rare:
        return Judgement()
    name = made.oddest
    low, high = made.usual[name]
    who = f"{WORDS[made.sex]}" if made.sex else "people"
    with_it = " with the other measurements" if len({plain(word) for word in made.wanted}) > 1 else ""
    # if no person can have that, the other measurements are as much the cause
    possible = low < CATALOGUE[name].high and high > CATALOGUE[name].low
    odd = [f"{words(name)} {CATALOGUE[name].text(made.wanted[name])} fits least: most {who}{with_it} have "
           f"{_number(name, low)} to {CATALOGUE[name].text(high)}"] if possible else []
    return Judgement.of(check=[*missed, *odd, *rare])


def read_measurements(words: Sequence[str]) -> dict[str, float]:
    """Read `name=value` words as they are typed: metres or kilograms by name; UsageError for anything else."""
    measurements = dict[str, float]()
    for word in words:
        name, sign, value = word.partition("=")
        try:
            measurements[name] = float(value)
        except ValueError:
            sign = ""
        if not sign or not np.isfinite(measurements[name]):
            raise UsageError(f"--to: expected name=metres, such as waist=0.85, got {word}")
    return measurements
