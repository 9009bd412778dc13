"""`scape learn`: a body model from registered meshes."""
from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from scanprep.arguments import UsageError
from scanprep.batch.opening import FileWorkspace
from scanprep.batch.room import Step, inside
from scanprep.batch.workspace import KeptSteps
from scanprep.cli import Output, Person, Unit, read_poses
from scanprep.console import Metric, Outcome, bar, details
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import list_meshes, name_of
from scanprep.geometry.landmarks import read_landmark_vertices
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.tables import read_table
from scanprep.ranges import Count
from scanprep.skeleton.find import find_skeleton
from scanprep.skeleton.parts import SkeletonConfig
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel
from ..cli import about, read_bodies
from .config import LearnConfig
from .mixing import MIX, learn_scape_mix
from .parts import choose_skeleton
from .scape import Progress, judge_model, learn_blendscape, learn_scape
from .sexes import learn_by_sex
from .skinning import SkinConfig, learn_skinning

SEXES = "sexes.csv"                  # in a plain folder of shapes
Kind = Literal["scape", "blendscape", "skinning", "mixed"]


def learn(poses: Path, output: Output, shapes: Path | None = None, template: Path | None = None,
          skeleton: Path | None = None, landmarks: Path | None = None, subject: Annotated[str | None, Person] = None,
          unit: Unit | None = None, parts: Count | None = None, kind: Kind = "scape", by_sex: bool = False,
          scape: LearnConfig = LearnConfig(), skinning: SkinConfig = SkinConfig(), mixed: LearnConfig = MIX,
          *, space: FileWorkspace) -> Outcome:
    """Learn a body model from one person in many poses and many people in about one pose, or from a mix.

    Killed and started again it goes on where it was; what does not depend on a change is not learned again. A picture
    of the parts and one of the shape components lie beside the model.

    Example: scape learn --poses set --shapes set -o model.npz

    Args:
        poses: Folder of meshes of one person that share their triangles, or a registered set.
        output: Model file to write.
        shapes: Folder of meshes of many people, or a registered set; without it the model has no shape of its own.
        template: The mesh that the others are deformations of; else the first of the poses, or the set's own.
        skeleton: JSON of `scape prep skeleton`; else the set's own, else found from the poses, with as many parts as
            predict left-out poses best.
        landmarks: Landmarks of the template, kept in the model for `scape complete`; else the set's own.
        subject: Of a registered set, whose meshes are the poses; else of the one with the most.
        unit: Unit of the meshes.
        parts: Find a skeleton with so many parts, whatever skeleton there is.
        kind: SCAPE, BlendSCAPE, linear blend skinning with pose-corrective shapes, or SCAPE from a mix: the poses are
            then those of many people, a registered set that says whose mesh each is.
        by_sex: Also a model of the women and one of the men, beside the neutral one, where the set says the sex; of a
            plain folder of shapes, sexes.csv in it with the columns name,sex.
        scape: Settings of SCAPE and BlendSCAPE.
        skinning: Settings of skinning.
        mixed: Settings of a mix.
    """
    if kind == "mixed" and (shapes is not None or by_sex):
        raise UsageError("--kind mixed: it learns one SCAPE model of --poses alone, without --shapes and --by-sex")
    if by_sex and (shapes is None or kind != "scape"):
        raise UsageError("--by-sex: it needs --shapes and the kind scape")
    if kind not in ("scape", "blendscape") and scape == LearnConfig.published():
        raise UsageError(f"--kind {kind}: the paper of --preset published has SCAPE alone")
    # what is learned from, and what the model is to know besides
    if kind == "mixed":
        if not (poses / "set.json").exists():
            raise ValueError(f"{poses}: expected a registered set, which says whose mesh each is, found a plain folder")
        whole = RegisteredSet.load(poses)
        body, posed, who = whole.template, whole.vertices(), [one.subject or one.name for one in whole.entries]
    else:
        (body, posed), who = read_poses(poses, template, subject, unit), []
    people = None if shapes is None else read_bodies(shapes, body, unit)[0]
    sexes = None if not by_sex or shapes is None else _read_sexes(shapes)
    tree = None if parts is not None else _read_skeleton(skeleton, poses, body)
    marks = landmarks or poses / "landmarks.json"
    named = read_landmark_vertices(marks, body) if landmarks or marks.exists() else {}
    # the parts, where none are given, and the model
    step = KeptSteps(space)
    if tree is None:
        if kind == "mixed":
            raise ValueError(f"{poses}: a mix of people shows no skeleton; name one with --skeleton")
        with bar("finding the skeleton") as progress:
            tree = step("skeleton", (body, posed, parts), lambda: _find_skeleton(body, posed, parts, step, progress))
    with bar("learning the model") as progress:
        more = progress, step
        models: Mapping[str, BodyModel] = (
            {"neutral": learn_scape_mix(body, posed, who, tree, mixed, *more)} if kind == "mixed" else
            learn_by_sex(body, posed, people, sexes, tree, scape, *more) if people is not None and sexes else
            {"neutral": learn_blendscape(body, posed, people, tree, scape, *more)} if kind == "blendscape" else
            {"neutral": learn_skinning(body, posed, people, tree, skinning, *more)} if kind == "skinning" else
            {"neutral": learn_scape(body, posed, people, tree, scape, *more)})
    for name, model in models.items():
        path = output if name == "neutral" else output.with_suffix(f".{name}.npz")
        kept = dataclasses.replace(model, info={**model.info, "landmarks": named})     # type: ignore[type-var]
        kept.save(path)
        _draw(kept, path)
    # seconds of every step; of one that had been begun before, of what was left
    begun = {name.split("/")[0] for name in step.found if "/" in name}
    times = [*(Metric(f"time: {name}", "done before") for name in step.found if "/" not in name),
             *(Metric(f"time: {name}", value, "s, of what was left" if name in begun else "s")
               for name, value in step.seconds.items() if "/" not in name)]
    return Outcome(output, [
        *about(models["neutral"]), Metric("poses", len(posed)),
        Metric("people", 0 if people is None else len(people)), Metric("parts of the skeleton", len(tree.parents)),
        *[Metric(f"people of the {name} model", model.info["shapes"]) for name, model in models.items() if by_sex],
        *details([Metric("kind", models["neutral"].kind), Metric("triangles", len(body.faces)), *times])],
        {"scape": scape, "skinning": skinning, "mixed": mixed}, judgement=judge_model(models["neutral"], people),
        following=f"look at it: scape view {output}")


def _find_skeleton(body: Mesh, posed: np.ndarray, parts: int | None, step: Step, progress: Progress) -> Skeleton:
    within = inside(step, "skeleton")
    if parts is None:
        return choose_skeleton(body, posed, progress=progress, step=within).skeleton
    return find_skeleton(body, posed, SkeletonConfig(parts=parts), progress, within)


def _read_sexes(folder: Path) -> list[str]:
    """The sex of every person, in the order of `read_bodies`; empty where not known."""
    if (folder / "set.json").exists():
        whole = RegisteredSet.load(folder)
        first = {entry.subject: entry.sex for entry in reversed(whole.entries)}
        return [first[subject] for subject in whole.subjects]
    path = folder / SEXES
    if not path.exists():
        raise ValueError(f"{folder}: a plain folder does not say the sex; write {SEXES} in it, with the columns "
                         "name,sex")
    table = {row["name"]: row["sex"] for _, row in read_table(path, ("name", "sex"))}
    names = [name_of(mesh) for mesh in list_meshes(folder)]
    if not any(name in table for name in names):
        raise ValueError(f"{path}: none of its names is a mesh of {folder}")
    return [table.get(name, "") for name in names]


def _read_skeleton(given: Path | None, poses: Path, body: Mesh) -> Skeleton | None:
    path = given or poses / "skeleton.json"
    if given is None and not path.exists():
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
