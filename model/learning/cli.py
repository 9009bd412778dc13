"""`scape learn`: a body model from registered meshes."""
from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated

import numpy as np

from scanprep.arguments import UsageError
from scanprep.batch.opening import FileWorkspace
from scanprep.batch.workspace import KeptSteps
from scanprep.cli import Output, Person, Unit, read_poses
from scanprep.console import Metric, Outcome, bar, details
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import list_meshes, name_of
from scanprep.geometry.landmarks import read_landmark_vertices
from scanprep.geometry.members import ONE_BODY, check_members, find_doubtful_members
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.tables import read_table
from scanprep.judgement import carry_judgements
from scanprep.skeleton.names import note_numbered_parts
from scanprep.skeleton.roles import joint_in_words
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel, Up
from ..cli import about, read_bodies
from ..fitting.search import ModelMismatchError
from .body import Kind, learn_body
from .config import LearnConfig
from .mixing import MIX
from .skinning import SkinConfig

WITH_PRIOR = "scape", "blendscape"


def learn(poses: Path, output: Output, shapes: Path | None = None, skeleton: Path | None = None,
          landmarks: Path | None = None, subject: Annotated[str | None, Person] = None, unit: Unit | None = None,
          up: Up | None = None, kind: Kind = "scape", by_sex: bool = False, prior: str = "auto",
          scape: LearnConfig = LearnConfig(), skinning: SkinConfig = SkinConfig(), mixed: LearnConfig = MIX, *,
          space: FileWorkspace) -> Outcome:
    """Learn a body model from one person in many poses and many people in about one pose, or from a mix.

    From few scans it is a known model, adapted: what they do not show, how joints bend and how people differ, is as
    there. One registered scan is enough. Killed and started again it goes on where it was; what does not depend on a
    change is not learned again. A picture of the parts and one of the shape components lie beside the model. From
    60,000 vertices on it is learned on 20,000 and finished at full resolution.

    Example: scape learn --poses set --shapes set -o model.npz

    Args:
        poses: Folder of meshes of one person that share their triangles, or a registered set. The template is the
            first of the meshes, or the set's own.
        output: Model file to write.
        shapes: Folder of meshes of many people, or a registered set; without it the model has no shape of its own.
        skeleton: JSON of `scape prep skeleton`; else the set's own, where there is no prior or 40 poses. Else it is
            found from the poses and those of the prior, with as many parts as predict left-out poses best. For a given
            number of parts: `scape prep skeleton --parts`.
        landmarks: Landmarks of the template, kept in the model for `scape complete`; else the set's own.
        subject: Of a registered set, whose meshes are the poses; else of the one with the most.
        unit: Unit of the meshes.
        up: Axis of the meshes that points up, kept in the model; else as the files say (GLB: y), else that along which
            the poses stand on their feet, else that of the largest extent.
        kind: SCAPE, BlendSCAPE, linear blend skinning with pose-corrective shapes, or SCAPE from a mix: the poses are
            then those of many people, a registered set that says whose mesh each is.
        prior: Where scans say little, as in this model: a file, "people", "none", or "auto", the built-in people for a
            template that is a person, unless there are 40 poses and 40 people. For SCAPE and BlendSCAPE; with --by-sex
            for the movement alone.
        by_sex: Also a model of the women and one of the men, beside the neutral one, where the set says the sex; of a
            plain folder of shapes, sexes.csv in it with the columns name,sex.
        scape: Settings of SCAPE and BlendSCAPE.
        skinning: Settings of skinning.
        mixed: Settings of a mix.
    """
    # what was said about the scans of the sets holds for the model; read it first, as the output may lie in a set
    of_scans = carry_judgements([poses] if shapes is None else [poses, shapes])
    # options that exclude each other
    if kind == "mixed" and (shapes is not None or by_sex):
        raise UsageError("--kind mixed: it learns one SCAPE model of --poses alone, without --shapes and --by-sex")
    if by_sex and (shapes is None or kind != "scape"):
        raise UsageError("--by-sex: it needs --shapes and the kind scape")
    if kind not in ("scape", "blendscape") and scape == LearnConfig.from_paper():
        raise UsageError(f"--kind {kind}: the paper of --preset published has SCAPE alone")
    with_prior = kind in WITH_PRIOR and scape != LearnConfig.from_paper()
    if prior not in ("auto", "none") and not with_prior:
        raise UsageError(f"--prior {prior}: expected the kind {' or '.join(WITH_PRIOR)} and not --preset published")
    # bodies to learn from, and the landmarks that the model keeps
    (body, posed, names), who = (_read_mix(poses) if kind == "mixed" else
                                 (read_poses(poses, None, subject, unit), []))
    body = body if up is None else replace(body, up="xyz".index(up))
    people = None
    doubts = find_doubtful_members(body, posed, str(poses), names, np.inf if kind == "mixed" else ONE_BODY)
    if shapes is not None:
        people, names = _read_people(shapes, body, unit)
        doubts += find_doubtful_members(body, people, str(shapes), names)
    sexes = None if not by_sex or shapes is None else _read_sexes(shapes)
    marks = landmarks or poses / "landmarks.json"
    named = read_landmark_vertices(marks, body) if landmarks or marks.exists() else {}
    own = _read_skeleton(poses / "skeleton.json", body, missing_ok=True)
    if kind == "mixed" and skeleton is None and own is None:
        raise ValueError(f"{poses}: a mix of people shows no skeleton; name one with --skeleton")
    step = KeptSteps(space)
    config = mixed if kind == "mixed" else skinning if kind == "skinning" else scape
    try:
        learned = learn_body(body, posed, people, _read_skeleton(skeleton, body), kind, config, prior, own_skeleton=own,
                             sexes=sexes or (), people=who, landmarks=named, stage=bar, step=step)
    except ModelMismatchError as error:
        raise ValueError(f"--{error}") from error
    learned = learned.with_info(spikes=doubts)
    tree = learned.model.skeleton
    if learned.choice is not None:
        note_numbered_parts(tree)
    for name, model in learned.models.items():
        path = output if name == "neutral" else output.with_suffix(f".{name}.npz")
        model.save(path)
        _draw(model, path)
    few, many = learned.learned_on, len(body.vertices)
    return Outcome(output, [
        *about(learned.model), Metric("poses", len(posed)),
        *([] if few == many else [Metric("learned on", f"{few} of {many} vertices")]),
        Metric("people", 0 if people is None else len(people)), Metric("parts of the skeleton", len(tree.parents)),
        *_about_prior(learned.model),
        *[Metric(f"people of the {name} model", model.info["shapes"]) for name, model in learned.models.items()
          if by_sex],
        *details([Metric("kind", learned.model.kind), Metric("triangles", len(body.faces))])],
                   {"scape": scape, "skinning": skinning, "mixed": mixed},
                   judgement=learned.judgement.merge(of_scans),
                   following=f"look at it: scape view {quote(str(output))}")


def _read_mix(poses: Path) -> tuple[tuple[Mesh, np.ndarray, tuple[str, ...]], list[str]]:
    """Read template, bodies (M, N, 3) and names of a registered set of many people, and whose body each is."""
    if not (poses / "set.json").exists():
        raise ValueError(f"{poses}: expected a registered set, which says whose mesh each is, found a plain folder")
    whole = RegisteredSet.load(poses)
    bodies = whole.vertices()
    check_members(whole.template, bodies, str(poses), whole.names)
    return (whole.template, bodies, whole.names), [entry.subject or entry.name for entry in whole.entries]


def _read_people(shapes: Path, body: Mesh, unit: Unit | None) -> tuple[np.ndarray, tuple[str, ...]]:
    """Read people (n, N, 3), whose differences are learned, and names; one alone is refused before the long work."""
    people, names = read_bodies(shapes, body, unit)
    if len(people) < 2:
        raise ValueError(f"shapes: expected at least 2 people, got {len(people)} in {shapes}; a model of the poses of "
                         "one person needs none")
    check_members(body, people, str(shapes), names)
    return people, names


def _about_prior(model: BodyModel) -> list[Metric]:
    """List what a model took from its prior; no rows where it has none."""
    if "prior" not in model.info:
        return []
    count, evidence = model.info["prior_people"], model.info["joint_evidence"]
    own = [f"{joint_in_words(name)} {100 * share:.0f}%" for name, share in
           list(zip(model.skeleton.names, evidence, strict=True))[1:]]
    return [Metric("prior", model.info["prior"]),
            Metric("joints as in the prior, as no scan bends them", model.info["joints_of_prior"] or "none"),
            Metric("people of the prior count as", count, "people"),
            *details([Metric("share of each joint's movement that is of your scans", ", ".join(own))])]


def _read_sexes(folder: Path) -> list[str]:
    """Read the sex of every person, in the order of `read_bodies`; empty where not known."""
    if (folder / "set.json").exists():
        whole = RegisteredSet.load(folder)
        first = {entry.subject: entry.sex for entry in reversed(whole.entries)}
        return [first[subject] for subject in whole.subjects]
    sexes = "sexes.csv"  # in a plain folder of shapes
    path = folder / sexes
    if not path.exists():
        raise ValueError(f"{folder}: a plain folder does not say the sex; write {sexes} in it, with the columns "
                         "name,sex")
    table = {row["name"]: row["sex"] for _, row in read_table(path, ("name", "sex"))}
    names = [name_of(mesh) for mesh in list_meshes(folder)]
    if not any(name in table for name in names):
        raise ValueError(f"{path}: none of its names is a mesh of {folder}")
    return [table.get(name, "") for name in names]


def _read_skeleton(path: Path | None, body: Mesh, missing_ok: bool = False) -> Skeleton | None:
    """Read a skeleton of the template; None for no path, and for a file that is not there where that is allowed."""
    if path is None or (missing_ok and not path.exists()):
        return None
    tree = Skeleton.load(path)
    if len(tree.part_of_face) != len(body.faces):
        raise ValueError(f"{path}: expected a skeleton of {len(body.faces)} triangles as the meshes have, "
                         f"found {len(tree.part_of_face)}")
    return tree


def _draw(model: BodyModel, output: Path) -> None:
    from scanprep.pictures.shading import save_png

    from ..report import picture_components, picture_parts

    save_png(output.with_suffix(".parts.png"), picture_parts(model.template, model.skeleton))
    if model.n_betas:
        save_png(output.with_suffix(".components.png"), picture_components(model))
