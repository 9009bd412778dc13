"""`scape learn`: a body model from registered meshes."""
from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import numpy as np

from scanprep.arguments import UsageError
from scanprep.batch.opening import FileWorkspace
from scanprep.batch.room import Step, substeps
from scanprep.batch.workspace import KeptSteps
from scanprep.cli import Output, Person, Unit, read_poses
from scanprep.console import Metric, Outcome, bar, details
from scanprep.dataset import RegisteredSet
from scanprep.geometry.files import list_meshes, name_of
from scanprep.geometry.landmarks import read_landmark_vertices
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.tables import read_table
from scanprep.judgement import WrongScaleError, carry_judgements
from scanprep.registration.person import has_limbs
from scanprep.skeleton.names import note_numbered_parts
from scanprep.skeleton.roles import joint_in_words
from scanprep.skeleton.tree import Skeleton

from ..body import BodyModel
from ..cli import about, read_bodies
from ..digests import body_digests
from ..files import BUILT_IN, load_model
from ..fitting.search import ModelMismatchError
from .config import LearnConfig
from .large import Resolutions
from .mixing import MIX, learn_scape_mix
from .parts import choose_skeleton
from .prior import TemplatePrior, bring_prior
from .scape import judge_model, learn_blendscape, learn_scape
from .sexes import learn_by_sex
from .skinning import SkinConfig, learn_skinning

# From 40 poses and 40 people on no prior is needed. With 20 poses the skeleton left 11.4 mm in held-out poses, with a
# prior 7.6 mm; with 57 poses 6.0 mm, with a prior 6.4 mm.
ENOUGH = 40

Kind = Literal["scape", "blendscape", "skinning", "mixed"]
WITH_PRIOR = "scape", "blendscape"


def learn(poses: Path, output: Output, shapes: Path | None = None, template: Path | None = None,
          skeleton: Path | None = None, landmarks: Path | None = None, subject: Annotated[str | None, Person] = None,
          unit: Unit | None = None, kind: Kind = "scape", by_sex: bool = False,
          prior: str = "auto", scape: LearnConfig = LearnConfig(), skinning: SkinConfig = SkinConfig(),
          mixed: LearnConfig = MIX, *, space: FileWorkspace) -> Outcome:
    """Learn a body model from one person in many poses and many people in about one pose, or from a mix.

    From few scans it is a known model, adapted: what they do not show, how joints bend and how people differ, is as
    there. One registered scan is enough. Killed and started again it goes on where it was; what does not depend on a
    change is not learned again. A picture of the parts and one of the shape components lie beside the model. From
    60,000 vertices on it is learned on 20,000 and finished at full resolution.

    Example: scape learn --poses set --shapes set -o model.npz

    Args:
        poses: Folder of meshes of one person that share their triangles, or a registered set.
        output: Model file to write.
        shapes: Folder of meshes of many people, or a registered set; without it the model has no shape of its own.
        template: The mesh that the others are deformations of; else the first of the poses, or the set's own.
        skeleton: JSON of `scape prep skeleton`; else the set's own, where there is no prior or 40 poses. Else it is
            found from the poses and those of the prior, with as many parts as predict left-out poses best. For a given
            number of parts: `scape prep skeleton --parts`.
        landmarks: Landmarks of the template, kept in the model for `scape complete`; else the set's own.
        subject: Of a registered set, whose meshes are the poses; else of the one with the most.
        unit: Unit of the meshes.
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
    if kind == "mixed":
        if not (poses / "set.json").exists():
            raise ValueError(f"{poses}: expected a registered set, which says whose mesh each is, found a plain folder")
        whole = RegisteredSet.load(poses)
        body, posed, who = whole.template, whole.vertices(), [one.subject or one.name for one in whole.entries]
    else:
        (body, posed), who = read_poses(poses, template, subject, unit), []
    people = None if shapes is None else _read_people(shapes, body, unit)
    sexes = None if not by_sex or shapes is None else _read_sexes(shapes)
    marks = landmarks or poses / "landmarks.json"
    named = read_landmark_vertices(marks, body) if landmarks or marks.exists() else {}
    # large meshes are learned on fewer vertices; the given bodies are only needed for their digests then
    digests, sizes = body_digests(posed, people), Resolutions(body)
    body, posed, people = sizes.learned, sizes.reduce(posed), people if people is None else sizes.reduce(people)
    # a prior where poses or people are few, the skeleton where none is given, and the model
    step, many = KeptSteps(space), len(posed) >= ENOUGH
    if not with_prior or (prior == "auto" and many and people is not None and len(people) >= ENOUGH):
        prior = "none"
    known = _bring_prior(body, prior, step)
    # the poses of a prior show joints that few scans do not bend
    shown = None if known is None or many else known.poses[1:]
    tree = None if shown is not None and skeleton is None else _read_skeleton(skeleton, poses, sizes)
    if tree is None:
        if kind == "mixed":
            raise ValueError(f"{poses}: a mix of people shows no skeleton; name one with --skeleton")
        tree = _find_skeleton(body, posed, shown, step)
    with bar("learning the model") as progress:
        how = progress, step
        models: Mapping[str, BodyModel] = (
            {"neutral": learn_scape_mix(body, posed, who, tree, mixed, *how)} if kind == "mixed" else
            learn_by_sex(body, posed, people, sexes, tree, scape, *how, known) if people is not None and sexes else
            {"neutral": learn_blendscape(body, posed, people, tree, scape, *how, known)} if kind == "blendscape" else
            {"neutral": learn_skinning(body, posed, people, tree, skinning, *how)} if kind == "skinning" else
            {"neutral": learn_scape(body, posed, people, tree, scape, *how, known)})
    for name, model in _finish(sizes, models, digests, named).items():
        path = output if name == "neutral" else output.with_suffix(f".{name}.npz")
        model.save(path)
        _draw(model, path)
    return Outcome(output, [
        *about(models["neutral"]), Metric("poses", len(posed)), *_about_size(sizes),
        Metric("people", 0 if people is None else len(people)), Metric("parts of the skeleton", len(tree.parents)),
        *_about_prior(models["neutral"]),
        *[Metric(f"people of the {name} model", model.info["shapes"]) for name, model in models.items() if by_sex],
        *details([Metric("kind", models["neutral"].kind), Metric("triangles", len(sizes.full.faces)),
                  *_about_steps(step)])],
                   {"scape": scape, "skinning": skinning, "mixed": mixed},
                   judgement=judge_model(models["neutral"], people).merge(of_scans),
                   following=f"look at it: scape view {quote(str(output))}")


def _read_people(shapes: Path, body: Mesh, unit: Unit | None) -> np.ndarray:
    """Read the people (n, N, 3) whose differences are learned; one alone is refused before the skeleton is sought."""
    people = read_bodies(shapes, body, unit)[0]
    if len(people) < 2:
        raise ValueError(f"shapes: expected at least 2 people, got {len(people)} in {shapes}; a model of the poses of "
                         "one person needs none")
    return people


def _finish(sizes: Resolutions, models: Mapping[str, BodyModel], digests: list[str], landmarks: dict[str, int]
            ) -> dict[str, BodyModel]:
    """Bring models that were learned on fewer vertices to all of them; they keep the landmarks of the template."""
    with bar("finishing at full resolution") as progress:
        finished = sizes.finish(models, digests, progress)
    return {name: replace(model, info={**model.info, "landmarks": landmarks})            # type: ignore[type-var]
            for name, model in finished.items()}


def _about_size(sizes: Resolutions) -> list[Metric]:
    """Say on how many vertices large meshes were learned; no row for others."""
    few, many = len(sizes.learned.vertices), len(sizes.full.vertices)
    return [] if few == many else [Metric("learned on", f"{few} of {many} vertices")]


def _about_steps(step: KeptSteps) -> list[Metric]:
    """List the seconds of every step; of a step that an earlier call had begun, those of the rest."""
    begun = {name.split("/")[0] for name in step.found if "/" in name}
    return [*(Metric(f"time: {name}", "done before") for name in step.found if "/" not in name),
            *(Metric(f"time: {name}", value, "s, of what was left" if name in begun else "s")
              for name, value in step.seconds.items() if "/" not in name)]


def _find_skeleton(body: Mesh, poses: np.ndarray, shown: np.ndarray | None, step: Step) -> Skeleton:
    """Find the skeleton in poses (M, N, 3), and in those of a prior; note parts without names."""
    with bar("finding the skeleton") as progress:
        tree = step("skeleton", (body, poses, shown),
                    lambda: choose_skeleton(body, poses, progress, substeps(step, "skeleton"), shown).skeleton)
    note_numbered_parts(tree)
    return tree


def _bring_prior(body: Mesh, prior: str, step: Step) -> TemplatePrior | None:
    """Bring the named prior to the template's triangles; None for "none", and for "auto" where there is no person."""
    if prior == "none" or (prior == "auto" and not has_limbs(body)):
        return None
    name = BUILT_IN if prior == "auto" else prior
    model = load_model(name)
    try:
        with bar(f"bringing the model {name} to the template") as progress:
            return step("prior", (body, name, model.template, model.info, model.pose_examples),
                        lambda: bring_prior(model, body, progress))
    except (ModelMismatchError, WrongScaleError) as error:
        if prior == "auto":
            warnings.warn(f"learned without the built-in people: {error}", stacklevel=2)
            return None
        raise ValueError(f"--prior {prior}: {error}") from error


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


def _read_skeleton(given: Path | None, poses: Path, sizes: Resolutions) -> Skeleton | None:
    """Read the skeleton of the template and bring it to the vertices that are learned on; None where there is none."""
    path = given or poses / "skeleton.json"
    if given is None and not path.exists():
        return None
    tree = Skeleton.load(path)
    if len(tree.part_of_face) != len(sizes.full.faces):
        raise ValueError(f"{path}: expected a skeleton of {len(sizes.full.faces)} triangles as the meshes have, "
                         f"found {len(tree.part_of_face)}")
    return sizes.reduce_skeleton(tree)


def _draw(model: BodyModel, output: Path) -> None:
    from scanprep.pictures.shading import save_png

    from ..report import picture_components, picture_parts

    save_png(output.with_suffix(".parts.png"), picture_parts(model.template, model.skeleton))
    if model.n_betas:
        save_png(output.with_suffix(".components.png"), picture_components(model))
