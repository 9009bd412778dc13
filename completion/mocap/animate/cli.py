"""The command `scape animate`."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated

import numpy as np

from model.body import Up
from model.linear import Subject
from model.posing.cli import read_subject
from scanprep.arguments import Place, UsageError
from scanprep.batch.pool import Workers
from scanprep.batch.workspace import Results, Task, Workspace
from scanprep.cli import Output, PersonUnit
from scanprep.console import JUDGEMENT, Metric, Outcome
from scanprep.folders import FolderCommand, as_line, do_one, figure
from scanprep.geometry.files import list_files
from scanprep.geometry.storage import read_json
from scanprep.ranges import BETAS, Positive

from ...cli import ModelOrNone, body_of, read_model
from ..angle_conventions import AngleConfig
from ..files.markers import READERS, resolve_marker_unit
from ..marker_sets.named import layout_or_file
from ..pose.follow import AnimateConfig
from ..subject.person import PersonConfig
from .motions import ENDINGS, MEAN_DISTANCE, motion_among, names_motion
from .work import MEAN_ERROR, AnimateTask, BetasTo

MarkersArg = Annotated[Path, Place("MARKERS")]


def animate_markers(markers: MarkersArg, output: Output, model: ModelOrNone = None, layout: str | None = None,
                    subject: str | None = None, unit: PersonUnit | None = None, rate: Positive | None = None,
                    retarget_to: Path | None = None, betas_to: Path | None = None, unlabelled: bool = False,
                    ground: bool = False, up: Up | None = None, config: AnimateConfig = AnimateConfig(),
                    person: PersonConfig = PersonConfig(), angles: AngleConfig = AngleConfig(),
                    workers: Workers = Workers(), *, space: Workspace) -> Outcome:
    """The motion of a person from markers, and the person; or a motion of another skeleton on a body.

    A folder is worked through file by file, each into a folder of its name; called again, it goes on where it was,
    and does anew what has changed.

    Example: scape animate walk.c3d -m model.npz --layout cmu41 -o walk

    A motion of another skeleton is BVH, or AMASS (.npz): segments point where they pointed, travel is as long as the
    legs are, and the report says how far joint centres and segments are off. scape animate walk.bvh -m model.npz -o out

    Key poses are a table (.csv) with the columns time, in seconds, and PART_rx, PART_ry, PART_rz, in degrees, as
    joint_angles.csv has them, and trans_x, trans_y, trans_z, in metres, if the body moves. Parts without columns stay
    at rest, empty cells are no key. scape animate keys.csv -m model.npz -o out

    Written are motion.npz (poses, trans, betas, rate), animation.glb, motion.bvh, joint_angles.csv (rotation vectors
    of every part against its parent, in degrees), joint_centres.csv (metres), residuals.csv, for OpenSim motion.trc
    (markers, joint centres) and motion.mot (joint angles), and report.html; of a subject that was found also
    subject.json and layout.json, with loose markers where they are on this person.

    Args:
        markers: C3D, TRC, CSV or TSV of markers, BVH or .npz of a motion, CSV of key poses, or a folder of these.
        output: Folder to write to.
        model: Model of `scape learn`; without it that of the built-in people.
        layout: Where the markers sit: cmu41, plugingait39, biomech57, helenhayes29, or a JSON file {"markersets":
            [{"distance_from_skin": metres, "indices": {label: vertex}}]}. Without it the named one that fits best.
        subject: Whose body it is: "markers" to find it from them, "template" for the one the model's poses were learned
            from, betas in JSON or .npz, or a mesh in the model's triangles. Without it "markers" where the model has
            betas.
        unit: Unit of the markers, where the file cannot tell; "unknown": that in which they span a person. Of a BVH,
            else cm.
        rate: Frames a second, where the file does not say or says it wrongly; of key poses, else 30.
        retarget_to: Another person who makes the motion too, as betas or a mesh: onto.npz, onto.glb.
        betas_to: Betas into which the body changes, in JSON: those at the end [b1, b2, ...], keys in seconds
            {"0": [...], "2.5": [...]}, or [[b1, b2, ...], ...] of every frame: morph.glb.
        unlabelled: The markers have no names: they are labelled first, as by `scape label`; --layout says which are
            worn.
        ground: Foot contact: feet do not sink into the floor and do not slide while they stand on it.
        up: Axis of the model that points up, which GLB and BVH turn to y; else as the model says.
        config: Settings.
        person: Settings of the person from markers.
        angles: Settings of the joint angles.
        workers: Who works through the files of a folder.
    """
    found = list_files(markers, lambda path: path.suffix.lower() in READERS or motion_among(path),
                       f"files ending in {', '.join(READERS)}, or motions ({', '.join(ENDINGS)})"
                       ) if markers.is_dir() else []
    names = [path.stem for path in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):      # written over each other
        raise ValueError(f"{markers}: expected files of different names, {twice[0]} comes with several endings")
    # flags that contradict each other
    if markers.is_file() and names_motion(markers) and (layout or unlabelled):
        raise ValueError(f"{markers}: a motion has no markers; leave out --layout and --unlabelled")
    if unlabelled and layout is None:
        raise UsageError("--unlabelled: expected --layout: which markers are worn, of scape layout list")
    # model, subject and all that the files share
    config = replace(config, ground=ground or config.ground)
    units = resolve_marker_unit([markers], unit)
    loaded, name = read_model(model)
    loaded = loaded.with_up(up)
    body = loaded if subject == "markers" else body_of(loaded, subject, unit)
    work = AnimateTask(loaded, name, None if layout is None else layout_or_file(layout),
                       body if isinstance(body, Subject) else None,
                       None if retarget_to is None else read_subject(loaded, retarget_to, unit),
                       None if betas_to is None else read_betas_to(betas_to, loaded.n_betas), units, rate,
                       config, person, unlabelled, angles)
    settings = {"animate": config, "person": person, "angles": angles, "model": name}
    if markers.is_file():
        return do_one("following the markers", space, work, Task("motion", markers), settings,
                      f"open {quote(str(output / 'report.html'))}; {quote(str(output / 'animation.glb'))} is for 3D "
                      "programs")
    # the figure that ranks files: distance of markers, or of joint centres of another skeleton; 0 for a copied motion
    errors = MEAN_ERROR, MEAN_DISTANCE
    return FolderCommand(
        ("file",), "{} followed", _summary, lambda rows: figure(rows, *errors), settings,
        lambda name, rows: [as_line(m) for m in rows if m.name in (JUDGEMENT, *errors)],
    ).carry_out("files", space, work, [Task(path.stem, path, path.stem) for path in found], workers)


def _summary(results: Results, count: int) -> list[Metric]:
    """Return the rows of the closing table."""
    off = {name: figure(rows, MEAN_ERROR, MEAN_DISTANCE) for name, rows in results.values.items()}
    markers = any(m.name == MEAN_ERROR for rows in results.values.values() for m in rows)
    rows = [Metric("files", count), Metric("done before", len(off) - len(results.fresh)),
            Metric("failed", len(results.failures))]
    if off:
        what = "markers" if markers else "joint centres"
        rows += [Metric(f"distance of {what}, mean of the files", float(np.mean(list(off.values()))), "mm"),
                 Metric(f"the same, worst file ({max(off, key=off.__getitem__)})", max(off.values()), "mm")]
    return rows


def read_betas_to(path: Path, n_betas: int) -> BetasTo:
    """Read betas from JSON in one of three forms.

    At the end: [b1, b2, ...] or {"betas": [...]}. Keys: {"seconds": [b1, b2, ...]}. Every frame: [[b1, b2, ...], ...].
    """
    wanted = ('betas at the end, [b1, b2, ...], keys {"0": [b1, ...], "2.5": [...]} in seconds, or [[b1, ...], ...] '
              "of every frame")
    tree = read_json(path, wanted)
    keyed = isinstance(tree, dict) and "betas" not in tree
    try:
        keys = {float(s): np.array(betas, dtype=np.float64) for s, betas in
                (tree if keyed else {0: tree["betas"] if isinstance(tree, dict) else tree}).items()}
    except (TypeError, ValueError, KeyError, OverflowError):
        keys = {}
    if not keys or any(b.ndim not in ((1,) if keyed else (1, 2)) or not b.size or b.shape[-1] > n_betas
                       or not np.isfinite(b).all() for b in keys.values()):
        raise ValueError(f"{path}: expected {wanted}, at most {n_betas} betas each")
    for betas in keys.values():
        BETAS.check(betas, f"{path}: betas")
    return keys if keyed else keys[0.0]
