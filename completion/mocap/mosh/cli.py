"""The command `scape mosh`."""
from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated

import numpy as np

from scanprep.arguments import Alias, Called, Place, UsageError
from scanprep.batch.pool import Progress, Workers
from scanprep.batch.workspace import Results, Task, Workspace
from scanprep.cli import Output, PersonUnit
from scanprep.console import JUDGEMENT, Metric, Outcome, bar, details, judgement_of, say
from scanprep.folders import FolderCommand, as_line, figure
from scanprep.ranges import Positive

from ..files.markers import resolve_marker_unit
from ..marker_sets.named import choose_layout
from .call import MoshCall
from .mosh import MoshConfig
from .recordings import TABLE, subjects_table, write_grouping
from .work import ERRORS, FIXED, MoshTask

MarkersArg = Annotated[tuple[Path, ...], Place("MARKERS [MARKERS ...]")]
Models = Annotated[tuple[Path, ...], Alias("-m", each=True)]


def mosh_markers(markers: MarkersArg, output: Output, model: Models = (), layout: str | None = None,
                 subject_prefix: Annotated[str, Called("--subjects")] = "auto",
                 retarget_to: Annotated[Path | None, Called("--character")] = None, unit: PersonUnit | None = None,
                 rate: Positive | None = None, unlabelled: bool = False, static: Path | None = None,
                 config: MoshConfig = MoshConfig(),
                 workers: Workers = Workers(), *, space: Workspace) -> Outcome:
    """Body shape, marker places, motion and soft tissue of people from markers alone.

    Example: scape mosh walk.c3d -o out

    Nothing is needed but a file. With a model of your own:

    Example: scape mosh 85_02.c3d 85_03.c3d -m model.npz --layout cmu41 -o out

    Begin with report.html in the output. Each person has a folder with subject.json (betas), layout.json (where the
    markers sat), report.html, and in it a folder for each sequence: motion.npz and soft_tissue.npz, animation.glb,
    motion.bvh, anatomical_angles.csv (joint angles, degrees, and their expected errors), joint_angles.csv (of the
    skeleton), joint_centres.csv, residuals.csv and residuals_soft.csv (metres), for OpenSim
    motion.trc and motion.mot (joint angles), virtual.c3d (labels put right, gaps filled by the body, joint
    centres), artefacts.json and artefacts.csv, report.html. Of somebody who walks also gait_events.csv (foot strikes
    and foot offs, those of the C3D file if it has them) and gait_cycles.csv (joint angles over the gait cycle). Of a
    C3D file with force plates also grf.mot (forces for OpenSim).

    Files that are named are of one person. In a folder every sub-folder is a person, and so is every file beside
    them. Several people in one file, Ann:LKNE and Bob:LKNE, have a folder each; a prop beside them is left out. What
    was found is printed, and kept in subjects.csv, which --subjects takes when it is mended. Called again, the command
    leaves alone what is done and has not changed; killed, it goes on where it was.

    Args:
        markers: C3D, TRC, CSV or TSV files, or folders of these.
        output: Folder to write to.
        model: Model of `scape learn`; without it that of the built-in people. Given three
            times, a model of both sexes, one of women and one of men: the markers tell the sex, by the first.
        layout: Where the markers usually sit: one of `scape layout list`, or a JSON file {"markersets":
            [{"distance_from_skin": metres, "indices": {label: vertex}}]}. Without it the named one that fits best.
        subject_prefix: Who is who: a CSV file with the columns file and subject, or JSON {file: subject}, where files
            that are left out are not used. Or whose markers, in files with several people: what stands before the
            colon of the labels, as Ann; several, as Head,Trunk, are of one person.
        retarget_to: Model whose mean is a character, which makes the motion too: character.glb.
        unit: Unit of the markers, where the file cannot tell; "unknown": that in which they span a person.
        rate: Frames a second, where a file does not say or says it wrongly.
        unlabelled: The markers have no names: they are labelled first, as by `scape label`; --layout says which are
            worn.
        static: Recording of the same person who stands upright and still, in which the joint angles are then 0.
        config: Settings.
        workers: Who does the work, a person at a time.
    """
    if not markers:
        raise ValueError("MARKERS: expected at least one file or folder")
    if unlabelled and layout is None:
        raise UsageError("--unlabelled: expected --layout: which markers are worn, of scape layout list")
    units = resolve_marker_unit(markers, unit)
    call = MoshCall(markers, model, layout, subject_prefix, retarget_to, units, rate, unlabelled, static, config)
    with bar("people") as people, bar("one of them") as inside:
        return carry_out(call, space, workers, f"scape mosh {' '.join(sys.argv[2:])}", people, inside)


def carry_out(call: MoshCall, space: Workspace, workers: Workers, command: str, *report_progress: Progress) -> Outcome:
    """Run what has changed of a call in an open output; `tell` reports progress over people, and within one."""
    actors, loaded = call.actors(space.folder), call.models()
    work = MoshTask(loaded.neutral, loaded.name, loaded.sexes, loaded.character,
                    None if call.layout is None else choose_layout(loaded.neutral, call.layout, ()),
                    call.unit, call.rate, call.unlabelled, call.static, call.config, command)
    # write the grouping to subjects.csv; one that the user edited stays, and has to be named with --subjects
    table = space.folder / TABLE
    if not table.exists() or space.is_ours(TABLE):
        with space.staging("people") as staged:
            write_grouping(staged.folder / TABLE, actors)
    elif subjects_table(call.subjects) is not None:
        warnings.warn(f"{table}: left as it was mended", stacklevel=2)
    else:
        raise ValueError(f"{table}: was mended; go by it with --subjects {table}, or move it away")
    # say who is who, for 20 people and 4 files of each
    for actor in actors[:20]:
        files, more = ", ".join(r.path.name for r in actor.recordings[:4]), len(actor.recordings) - 4
        say(f"{actor.name}: {files}{f' and {more} more' if more > 0 else ''}")
    if len(actors) > 20:
        say(f"and {len(actors) - 20} more people")
    # the work, then table, page and judgement
    done = space.run(work, [Task(actor.name, actor, actor.name) for actor in actors], workers, *report_progress)
    results = Results({name: rows for name, (rows, _) in done.values.items()},
                      {name: line if line.startswith(f"{name}: ") else f"{name}: {line}"
                       for name, line in done.failures.items()}, done.fresh)
    lost = [f"{name}: {line}" for name, (_, failed) in done.values.items() for line in failed]
    outcome = describe(call, loaded.name).write(space, results, len(actors), lost)
    judged = [judgement_of(rows) for rows in results.values.values()]
    return replace(outcome, judgement=judged[0] if judged and len(actors) == 1 else outcome.judgement,
                   following=f"open {quote(str(space.folder / 'report.html'))}; "
                   f"then scape view {quote(str(space.folder))}, "
                   f"or scape view --mend {quote(str(space.folder))} to correct markers")


def describe(call: MoshCall, model: str) -> FolderCommand:
    """Return the wording of table and page for the people of a call; `model` is its name."""
    def lines(name: str, rows: Sequence[Metric]) -> list[str]:
        return [as_line(m) for m in rows if m.name in (JUDGEMENT, *ERRORS, "sequences", "frames", "sex")]

    return FolderCommand(
        ("person", "people"), "{} from markers", _summary, lambda rows: figure(rows, FIXED),
        {"mosh": call.config, "model": model, "layout": call.layout}, lines,
        "A marker that sits elsewhere than the layout has it, labels that are exchanged, a marker that should not be "
        "used: `scape view --mend FOLDER` puts them right and runs again.", call)


def _summary(results: Results, count: int) -> list[Metric]:
    """Return the rows of the closing table: those of one person, or means over several."""
    before = len(results.values) - len(results.fresh)
    if count == 1 and results.values:
        (name, only), = results.values.items()
        return [*(m for m in only if m.name != JUDGEMENT),
                *details([Metric("person", name), Metric("done before", before)])]
    values = {person: {m.name: m for m in rows} for person, rows in results.values.items()}
    rows = list[Metric]()
    for name in ERRORS:
        found = {person: float(v[name].value) for person, v in values.items() if name in v}
        if found:
            worst = max(found, key=found.__getitem__)
            rows += [Metric(f"{name}, mean of the people", float(np.mean(list(found.values()))), "mm"),
                     Metric(f"the same, worst ({worst})", found[worst], "mm")]
    counts = [Metric(name, sum(int(v[name].value) for v in values.values()))
              for name in ("sequences", "frames", "swaps", "bad spans")]
    return [*rows, Metric("people", count), Metric("failed", count - len(results.values)),
            *details([Metric("done before", before), *counts])]
