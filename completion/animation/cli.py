"""The command `scape animate`."""
from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from model.body import BodyModel
from model.cli import read_subject
from model.linear import Subject
from scanprep.cli import Output, Unit
from scanprep.console import Metric, Outcome, bar, plain, read_json
from scanprep.geometry import storage
from scanprep.ranges import BETAS, Count

from ..cli import ModelOrNone, read_model
from .follow import AnimateConfig
from .shape import MarkerShapeConfig
from .work import DONE, ENDINGS, BetasTo, Work, animate_file, settings_key

MarkersArg = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="MARKERS")]


def animate_markers(markers: MarkersArg, output: Output, model: ModelOrNone = None, layout: str | None = None,
                    subject: str | None = None, unit: Unit | None = None, who: str | None = None,
                    onto: Path | None = None, betas_to: Path | None = None, keys: Count = 120,
                    config: Annotated[AnimateConfig, tyro.conf.arg(name="")] = AnimateConfig(),   # noqa: B008
                    shape: MarkerShapeConfig = MarkerShapeConfig()) -> Outcome:                   # noqa: B008
    """The motion of a person from markers, and the person.

    A folder is worked through file by file, each into a folder of its name; called again, it goes on where it was,
    and does anew what has changed.

    Example: scape animate walk.c3d -m model.npz --layout cmu41 -o walk

    Written are motion.npz (poses, trans, betas, rate), animation.glb, motion.bvh, joint_angles.csv (rotation vectors
    of every part against its parent, in degrees), joint_centres.csv (metres), residuals.csv and report.html; of a
    subject that was found also subject.json and layout.json, with loose markers where they are on this person.

    Args:
        markers: C3D, TRC or CSV, or a folder of these.
        output: Folder to write to.
        model: Model of `scape learn`; without it that of the embedded people, which is made on first use.
        layout: Where the markers sit: cmu41, plugingait39, biomech57, helenhayes29, or a JSON file {"markersets":
            [{"distance_from_skin": metres, "indices": {label: vertex}}]}. Without it the named one that fits best.
        subject: Whose body it is: "markers" to find it from them, "template" for the one the model's poses were learned
            from, betas in JSON or .npz, or a mesh in the model's triangles. Without it "markers" where the model has
            betas.
        unit: Unit of the markers, where the file cannot tell.
        who: Whose markers, in a C3D file with several people.
        onto: Another person who makes the motion too, as betas or a mesh: onto.npz, onto.glb.
        betas_to: Betas into which the body changes, in JSON: those at the end [b1, b2, ...], or keys in seconds
            {"0": [...], "2.5": [...]}: morph.glb.
        keys: Largest number of key frames in a GLB.
        config: Settings.
        shape: Settings of the subject from markers.
    """
    found = _marker_files(markers)
    loaded, name = read_model(model)
    work = Work(loaded, name, layout, _subject(loaded, subject, unit),
                None if onto is None else read_subject(loaded, onto, unit),
                None if betas_to is None else read_betas_to(betas_to, loaded.n_betas), unit, who, keys, config, shape)
    settings = {"animate": config, "shape": shape, "model": name}
    with bar("finding the subject") as finding, bar("following the markers") as following:
        if markers.is_file():
            return Outcome(output, animate_file(work, markers, output, finding, following), settings)
    given = {"layout": layout, "subject": subject, "unit": unit, "who": who, "onto": onto, "betas_to": betas_to,
             "keys": keys, "model": model}
    return _folder(work, found, output, given, settings)


def _folder(work: Work, found: list[Path], output: Path, given: dict[str, Any], settings: dict[str, Any]) -> Outcome:
    """Every file into a folder of its name, those that are done with the same settings left alone."""
    means, failures, before = [], [], 0
    with bar("files") as files, bar("finding the subject") as finding, bar("following the markers") as following:
        for i, path in enumerate(found):
            place, key = output / path.stem, settings_key(work, path, given)
            done = read_json(place / DONE, "the state of a file") if (place / DONE).exists() else {}
            if done.get("key") == key:
                before += 1
            else:
                try:
                    metrics = animate_file(work, path, place, finding, following)
                except (ValueError, OSError) as error:
                    failures.append(f"{path.name}: {error}")
                    continue
                finally:
                    files(i + 1, len(found))
                done = {"key": key, "metrics": [[m.name, plain(m.value), m.unit] for m in metrics]}
                storage.write_json(place / DONE, done)
            means.append({name: value for name, value, _ in done["metrics"]}["distance of markers, mean"])
    rows = [Metric("files", len(found)), Metric("done before", before), Metric("failed", len(failures))]
    if means:
        rows += [Metric("distance of markers, mean of the files", float(np.mean(means)), "mm"),
                 Metric("the same, worst file", float(np.max(means)), "mm")]
    return Outcome(output, rows, settings, failures)


def _marker_files(markers: Path) -> list[Path]:
    """The file, or the marker files of a folder; files of one name would be written over each other."""
    if not markers.is_dir():
        return [markers]
    found = sorted(p for p in markers.iterdir() if p.suffix.lower() in ENDINGS)
    if not found:
        raise ValueError(f"{markers}: expected files ending in {', '.join(ENDINGS)}, found none")
    names = [p.stem for p in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"{markers}: expected files of different names, {twice[0]} comes with several endings")
    return found


def _subject(model: BodyModel, given: str | None, unit: Unit | None) -> Subject | None:
    """Whose body it is; None when it is to be found from the markers."""
    if given is None:
        return None if model.n_betas else model.subject(None)
    if given == "markers":
        return None
    return read_subject(model, None if given == "template" else Path(given), unit)


def read_betas_to(path: Path, n_betas: int) -> BetasTo:
    """Betas at the end, [b1, b2, ...] or {"betas": [...]}, or keys {"seconds": [b1, b2, ...]}, from JSON.

    Raises
    ------
    ValueError
        Another form, more betas than the model has.
    """
    wanted = 'betas at the end, [b1, b2, ...], or keys {"0": [b1, ...], "2.5": [...]} in seconds'
    tree = read_json(path, wanted)
    keyed = isinstance(tree, dict) and "betas" not in tree
    try:
        found = {float(s): np.array(betas, dtype=np.float64) for s, betas in
                 (tree if keyed else {0: tree["betas"] if isinstance(tree, dict) else tree}).items()}
    except (TypeError, ValueError):
        found = {}
    if not found or any(b.ndim != 1 or len(b) > n_betas or not np.isfinite(b).all() for b in found.values()):
        raise ValueError(f"{path}: expected {wanted}, at most {n_betas} betas each")
    for betas in found.values():
        BETAS.check(betas, f"{path}: betas")
    return found if keyed else found[0.0]
