"""A person with the model of their sex, which the markers tell."""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from model.body import BodyModel
from model.learning.sexes import SexGuess, guess_sex, sex_plane
from scanprep.batch.room import Step, inside, once
from scanprep.threads import one_thread

from ..files.markers import MarkerSequence
from ..marker_sets.layout import MarkerLayout
from ..subject.person import PersonFit, find_person
from .mosh import MoshConfig, MoshResult, Progress, mosh

SEXES = ("female", "male")


@dataclass(frozen=True, eq=False)
class SexedMosh:
    """A person and their motions with the model of their sex.

    Attributes
    ----------
    guess : SexGuess
        What the markers told.
    model : BodyModel
        The model of that sex.
    neutral : PersonFit
        The person with the neutral model, by which it was told.
    result : MoshResult
        With the model of that sex; the motions say it as their gender.
    """

    guess: SexGuess
    model: BodyModel
    neutral: PersonFit
    result: MoshResult


@one_thread()
def mosh_by_sex(models: Mapping[str, BodyModel], sequences: MarkerSequence | Sequence[MarkerSequence],
                layout: MarkerLayout, config: MoshConfig | None = None, progress: Progress | None = None,
                step: Step = once) -> SexedMosh:
    """As `mosh`, with the model of the person's sex.

    The neutral model finds a body, its betas tell the sex, and all is done with the model of that sex.

    Parameters
    ----------
    models : {"neutral", "female", "male": BodyModel}
        As `learn_by_sex` makes them, of one topology; the neutral one keeps what tells women from men.
    sequences, layout, config, progress, step
        As for `mosh`.

    Raises
    ------
    ValueError
        A model that is missing or of another topology, a neutral one that cannot tell, and as `mosh`.

    [MoSh]
    """
    checked_models(models)
    config = config or MoshConfig()
    neutral = find_person(models["neutral"], sequences, layout, config.person, None, inside(step, "neutral"))
    guess = guess_sex(models["neutral"], neutral.betas)
    result = mosh(models[guess.sex], sequences, layout, config, progress, step)
    motions = tuple(replace(motion, gender=guess.sex) for motion in result.motions)
    soft = tuple(replace(one, motion=replace(one.motion, gender=guess.sex)) for one in result.soft_tissue)
    return SexedMosh(guess, models[guess.sex], neutral, replace(result, motions=motions, soft_tissue=soft))


def checked_models(models: Mapping[str, BodyModel]) -> None:
    """ValueError for models with which a sex cannot be told or used."""
    missing = [name for name in ("neutral", *SEXES) if name not in models]
    if missing:
        raise ValueError(f"models: expected 'neutral', 'female' and 'male', {' and '.join(missing)} missing")
    sex_plane(models["neutral"])
    faces = models["neutral"].template.faces
    for name in SEXES:
        if models[name].template.faces.shape != faces.shape or (models[name].template.faces != faces).any():
            raise ValueError(f"models: expected the triangles of the neutral model in that of '{name}', found others")
