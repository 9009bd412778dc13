"""The command `scape mosh`."""
from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import tyro

from model.body import BodyModel
from model.files import load_model
from scanprep.batch.pool import Workers
from scanprep.batch.workspace import Workspace
from scanprep.cli import Output, Unit
from scanprep.console import Outcome, bar, say
from scanprep.ranges import Count

from ...cli import ModelOrNone, read_model
from ..marker_sets.named import choose_layout
from ..settings import MoshConfig
from .folder import keep_table, mosh_people, summary
from .recordings import Actor, By, Grouping, find_actors
from .work import Work

MarkersArg = Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="MARKERS [MARKERS ...]")]
TOLD = 20                            # people that are listed before the work begins


def mosh_markers(markers: MarkersArg, output: Output, model: ModelOrNone = None, layout: str | None = None,
                 subjects: Path | None = None, by: By = "auto", name: str | None = None, who: str | None = None,
                 hold_out: tuple[str, ...] = (), female: Path | None = None, male: Path | None = None,
                 character: Path | None = None, factor: float = 1.0, unit: Unit | None = None, keys: Count = 120,
                 config: MoshConfig = MoshConfig(),               # noqa: B008
                 workers: Workers = Workers(), *, space: Workspace) -> Outcome:                   # noqa: B008
    """Body shape, marker places, motion and soft tissue of people from markers alone.

    Files that are named are of one person. In a folder every sub-folder is a person; of files that lie side by side
    those are, whose names begin with the same number, as 85_02.c3d and 85_03.c3d, or else whose labels begin with the
    same `Subject:`. What was found is printed, and kept in subjects.csv, which --subjects takes when it is mended.
    Called again, the command leaves alone what is done and has not changed; killed, it goes on where it was.

    Example: scape mosh 85_02.c3d 85_03.c3d -m model.npz --layout cmu41 -o out

    Each person has a folder with subject.json (betas), layout.json (where the markers sat), report.html, and in it a
    folder for each sequence: motion.npz and soft_tissue.npz, animation.glb, motion.bvh, joint_angles.csv,
    joint_centres.csv, residuals.csv and residuals_soft.csv (metres), virtual.c3d (labels put right, gaps filled by
    the body), faults.json and faults.csv, report.html. Begin with report.html in the output.

    Args:
        markers: C3D, TRC or CSV files, or folders of these.
        output: Folder to write to.
        model: Model of `scape learn`; without it that of the synthetic people, which is made on first use.
        layout: Where the markers usually sit: one of `scape layout list`, or a JSON file {"markersets":
            [{"distance_from_skin": metres, "indices": {label: vertex}}]}. Without it the named one that fits best.
        subjects: Who is who: CSV with the columns file and subject, or JSON {file: subject}; other files are left out.
        by: How files are given to people: "name", by what stands before the first _, - or blank of the file name;
            "label", by what stands before the colon of the labels; "each", every file is of another person; "all".
        name: Name of the only person.
        who: Whose markers, in C3D files with several people.
        hold_out: Labels of markers that no stage sees, which then tell how well the body predicts.
        female: Model of women, with --male; the markers tell the sex, by MODEL, which is of both.
        male: Model of men.
        character: Model whose mean is a character, which makes the motion too: character.glb.
        factor: Exaggerates soft tissue, in exaggerated.glb and on the character; 0 leaves it out there.
        unit: Unit of the markers, where the file cannot tell.
        keys: Largest number of key frames in a GLB.
        config: Settings.
        workers: Who does the work, a person at a time.
    """
    if not markers:
        raise ValueError("MARKERS: expected at least one file or folder")
    grouping = Grouping(by, subjects, name, who)
    actors = find_actors(markers, grouping, output)
    held = tuple(label for words in hold_out for label in words.split(",") if label)
    loaded, model_name = read_model(model)
    work = Work(loaded, model_name, _sexes(female, male, character),
                None if character is None else _character(character, loaded),
                None if layout is None else choose_layout(loaded, layout, ()), held, unit, keys, factor, config,
                f"scape mosh {' '.join(sys.argv[2:])}")
    keep_table(space, actors, subjects is not None)
    _tell(actors)
    with bar("people") as people, bar("one of them") as inside:
        done = mosh_people(work, actors, space, workers, people, inside)
    settings = {"mosh": config, "model": model_name, "layout": layout, "held out": held}
    return Outcome(output, summary(done, len(actors)), settings, done.failures)


def _tell(actors: list[Actor]) -> None:
    """Who is taken to be who."""
    for actor in actors[:TOLD]:
        files = ", ".join(r.path.name for r in actor.recordings[:4])
        more = len(actor.recordings) - 4
        say(f"{actor.name}: {files}{f' and {more} more' if more > 0 else ''} ({actor.rule})")
    if len(actors) > TOLD:
        say(f"and {len(actors) - TOLD} more people")


def _sexes(female: Path | None, male: Path | None, character: Path | None) -> dict[str, BodyModel]:
    if (female is None) != (male is None):
        raise ValueError("--female and --male: expected both or none")
    if character is not None and female is not None:
        raise ValueError("--character: it is made of one model; expected it without --female and --male")
    return {} if female is None or male is None else {"female": load_model(female), "male": load_model(male)}


def _character(path: Path, model: BodyModel) -> BodyModel:
    character = load_model(path)
    if character.kind != model.kind or character.template.faces.shape != model.template.faces.shape:
        raise ValueError(f"{path}: expected a character made of the model, with its {len(model.template.faces)} "
                         f"triangles, found {character.kind} with {len(character.template.faces)}")
    return character
