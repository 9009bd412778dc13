"""Learning a body model in one call, as `scape learn` does: prior, number of parts, model, full resolution."""
from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from scanprep.batch.room import Step, run_uncached, substeps
from scanprep.geometry.members import ONE_BODY, measure_scales
from scanprep.geometry.mesh import Mesh, take_any_mesh
from scanprep.geometry.upright import find_up
from scanprep.judgement import Judgement
from scanprep.plausible import WrongScaleError
from scanprep.registration.person import has_limbs
from scanprep.skeleton.joints import joint_gaps
from scanprep.skeleton.tree import Skeleton
from scanprep.words import describe_result

from ..body import BodyModel, Progress
from ..digests import body_digests, check_bodies
from ..files import BUILT_IN, load_model
from ..fitting.search import ModelMismatchError
from .config import LearnConfig
from .large import Resolutions
from .mixing import MIX, learn_scape_mix
from .parts import ChosenSkeleton, choose_skeleton
from .prior import TemplatePrior, bring_prior
from .scape import judge_model, learn_blendscape, learn_scape
from .sexes import learn_by_sex
from .skinning import SkinConfig, learn_skinning

# From 40 poses and 40 people on no prior is needed. With 20 poses the skeleton left 11.4 mm in held-out poses, with a
# prior 7.6 mm; with 57 poses 6.0 mm, with a prior 6.4 mm.
ENOUGH = 40

Kind = Literal["scape", "blendscape", "skinning", "mixed"]
Stage = Callable[[str], AbstractContextManager[Progress]]


@dataclass(frozen=True, eq=False)
class LearnedBody:
    """Result of `learn_body`.

    Attributes
    ----------
    models : dict of str to BodyModel
        "neutral"; with sexes also "female" and "male".
    choice : ChosenSkeleton, optional
        How the number of parts was chosen; None where a skeleton was given.
    learned_on : int
        Number of vertices that the model was learned on; fewer than the template's of large meshes.
    people : (S, N, 3) float, metres, optional
        The shapes that were learned.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> LearnedBody({"neutral": load_built_in_model()}, None, 1500, None).judgement.verdict
    'good'
    """

    models: dict[str, BodyModel]
    choice: ChosenSkeleton | None
    learned_on: int
    people: np.ndarray | None
    __repr__ = describe_result

    @property
    def model(self) -> BodyModel:
        """The model of everybody."""
        return self.models["neutral"]

    @property
    def judgement(self) -> Judgement:
        """Whether the model is usable, and what it lacks, as `scape learn` says."""
        return judge_model(self.model, self.people)

    def with_info(self, **more: Any) -> LearnedBody:
        """Add to the info of every model."""
        return replace(self, models={name: replace(model, info={**model.info, **more})   # type: ignore[type-var]
                                     for name, model in self.models.items()})


def be_quiet(stage: str) -> AbstractContextManager[Progress]:
    """Show no progress of a stage."""
    return nullcontext(lambda done, total: None)


@take_any_mesh
def learn_body(template: Mesh, poses: np.ndarray, shapes: np.ndarray | None = None, skeleton: Skeleton | None = None,
               kind: Kind = "scape", config: LearnConfig | SkinConfig | None = None, prior: str = "auto", *,
               own_skeleton: Skeleton | None = None, sexes: Sequence[str] = (), people: Sequence[str] = (),
               landmarks: Mapping[str, int] | None = None, stage: Stage = be_quiet, step: Step = run_uncached
               ) -> LearnedBody:
    """Learn a body model as `scape learn` does, to the same bytes.

    A known model stands in where poses or people are few, the number of parts is chosen by left-out poses, and large
    meshes are learned on fewer vertices.

    Parameters
    ----------
    template : Mesh
        One of the poses, N vertices.
    poses : (M, N, 3) float, metres
        One person in M poses; for the kind "mixed" bodies of many.
    shapes : (S, N, 3) float, metres, optional
        Other people in about one pose.
    skeleton : Skeleton, optional
        Of the template; by default it is found.
    kind : {"scape", "blendscape", "skinning", "mixed"}
        What is learned; "mixed" is SCAPE from a mix of people in poses.
    config : LearnConfig or SkinConfig, optional
        Settings of that kind.
    prior : str
        A model file, "people", "none", or "auto": the built-in people for a template that is a person, unless there are
        40 poses and 40 people.
    own_skeleton : Skeleton, optional
        One that is there already: taken where there is no prior, or from 40 poses on.
    sexes : sequence of str, optional
        "female", "male" or "" of every shape, for a model of each sex too.
    people : sequence of str, optional
        For the kind "mixed": whose body each of the poses is.
    landmarks : dict of str to int, optional
        Vertices of the template that the model keeps, for `complete`.
    stage : callable, optional
        Gives for a stage's name a context manager of the callback that is called with (done, total), as
        `scanprep.console.bar`.
    step : callable, optional
        Keeps intermediate results, as `scanprep.batch.room.Step`.

    Returns
    -------
    LearnedBody
        With `model` and `judgement`.

    Raises
    ------
    ModelMismatchError
        A prior that does not fit.
    ValueError
        As `learn_scape` and `choose_skeleton`.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> people = load_built_in_model()
    >>> poses = people.subject(None).vertices(people.pose_examples[:4])
    >>> quick = LearnConfig(refinements=0, prunings=(0.01,), ridges=(0.01,))
    >>> learn_body(people.template, poses, None, people.skeleton, "scape", quick, "none").model.kind
    'scape'

    [SCAPE] §3
    """
    poses = check_bodies(template, poses, "poses")
    template = find_up(template, poses)
    config = config or (MIX if kind == "mixed" else SkinConfig() if kind == "skinning" else LearnConfig())
    # large meshes are learned on fewer vertices; the given bodies are only needed for their digests then
    digests, sizes = body_digests(poses, shapes), Resolutions(template)
    body, poses, shapes = sizes.learned, sizes.reduce(poses), None if shapes is None else sizes.reduce(shapes)
    # a prior where poses or people are few
    many = len(poses) >= ENOUGH
    enough = many and shapes is not None and len(shapes) >= ENOUGH
    by_paper = config == LearnConfig.from_paper()
    if kind not in ("scape", "blendscape") or by_paper or (prior == "auto" and enough):
        prior = "none"
    known = _bring_prior(body, prior, stage, step)
    # the skeleton where none is given; the poses of a prior show joints that few scans do not bend
    shown = None if known is None or many else known.poses[1:]
    scale = float(np.median(measure_scales(body, poses)))
    if shown is not None and not 1 / ONE_BODY < scale < ONE_BODY:
        raise ValueError(f"poses: the bodies are {scale:.3g} times as large as the template, to which a prior adds its "
                         "own poses; expected the template's person: the wrong unit, or a template of somebody else?")
    tree, choice = skeleton or (own_skeleton if shown is None else None), None
    if tree is not None:
        tree = sizes.reduce_skeleton(tree)
    elif kind == "mixed":
        raise ValueError("skeleton: a mix of people shows none, so one has to be given")
    else:
        with stage("finding the skeleton") as progress:
            choice = step("skeleton", (body, poses, shown),
                          lambda: choose_skeleton(body, poses, progress, substeps(step, "skeleton"), shown))
        tree = choice.skeleton
    # the model, at full resolution
    with stage("learning the model") as progress:
        models = _learn_kind(kind, (body, poses, shapes, tree), config, sexes, people, known, (progress, step))
    with stage("finishing at full resolution") as progress:
        models = sizes.finish(models, digests, progress)
    gaps = [round(float(gap), 3) for gap in joint_gaps(body, poses, tree)]
    learned = LearnedBody(models, choice, len(body.vertices), shapes)
    return learned.with_info(joint_gaps=gaps, landmarks=dict(landmarks or {}))


def _learn_kind(kind: Kind, bodies: tuple[Mesh, np.ndarray, np.ndarray | None, Skeleton], config: Any,
                sexes: Sequence[str], people: Sequence[str], known: TemplatePrior | None, how: tuple[Progress, Step]
                ) -> dict[str, BodyModel]:
    """Learn the model of a kind from template, poses, shapes and skeleton, and those of women and men."""
    template, poses, shapes, tree = bodies
    if kind == "mixed":
        return {"neutral": learn_scape_mix(template, poses, people, tree, config, *how)}
    if kind == "skinning":
        return {"neutral": learn_skinning(*bodies, config, *how)}
    if kind == "blendscape":
        return {"neutral": learn_blendscape(*bodies, config, *how, known)}
    if sexes and shapes is not None:
        return dict(learn_by_sex(template, poses, shapes, sexes, tree, config, *how, known))
    return {"neutral": learn_scape(*bodies, config, *how, known)}


def _bring_prior(body: Mesh, prior: str, stage: Stage, step: Step) -> TemplatePrior | None:
    """Bring the named prior to the template's triangles; None for "none", and for "auto" where there is no person."""
    if prior == "none" or (prior == "auto" and not has_limbs(body)):
        return None
    name = BUILT_IN if prior == "auto" else prior
    model = load_model(name)
    try:
        with stage(f"bringing the model {name} to the template") as progress:
            return step("prior", (body, name, model.template, model.info, model.pose_examples),
                        lambda: bring_prior(model, body, progress))
    except (ModelMismatchError, WrongScaleError) as error:
        if prior == "auto":
            warnings.warn(f"learned without the built-in people: {error}", stacklevel=2)
            return None
        raise ModelMismatchError(f"prior {prior}: {error}") from error
