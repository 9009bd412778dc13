"""Models of women, of men and of everybody, from one training set."""
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from scanprep.batch.steps import Step, once
from scanprep.geometry.mesh import Mesh, check_template
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..carriers import rigid_weights
from ..scape import ScapeModel
from ..shape_space import ShapeSpace, learn_shape_space
from .carriage import Carriage
from .pose import Ticks
from .scape import (
    LearnConfig,
    Progress,
    check_skeleton,
    checked_bodies,
    from_shapes,
    how_learned,
    pose_examples,
    pose_prior,
    pose_space,
)
from .sex_plane import PLANE, SexPlane, learn_sex_plane

SEXES = ("female", "male")
FEWEST = 2                           # people that span a space of shapes


@one_thread()
def learn_by_sex(template: Mesh, poses: np.ndarray, shapes: np.ndarray, sexes: Sequence[str], skeleton: Skeleton,
                 config: LearnConfig | None = None, progress: Progress | None = None, step: Step = once
                 ) -> dict[str, ScapeModel]:
    """Learn a model of everybody and one of each sex: one pose space, and a space of shapes a group.

    Parameters
    ----------
    template, poses, shapes, skeleton, config, progress, step
        As for `learn_scape`.
    sexes : S strings
        "female", "male", or "" where it is not known; those count in the model of everybody alone.

    Returns
    -------
    dict
        "neutral", and "female" and "male" where there are at least two people of that sex. `info["sex"]` of each
        model is its key. Where there are both, `info["sex_plane"]` of the neutral one tells them apart by their betas
        (`guess_sex`).

    Raises
    ------
    ValueError
        As `learn_scape`, and sexes of another count or of another name.

    [SCAPE] Eq. 4, Eq. 5, Eq. 7, Eq. 8
    """
    config = config or LearnConfig()
    check_template(template)
    check_skeleton(template, skeleton)
    poses, shapes = checked_bodies(template, poses, "poses"), checked_bodies(template, shapes, "shapes")
    groups = _groups(sexes, len(shapes))
    carriage = Carriage(template, skeleton, rigid_weights(skeleton))
    tick = Ticks(progress, (config.refinements + 1) * len(poses) + len(shapes))
    learned = pose_space(carriage, poses, config, tick, step)

    def learn(S: np.ndarray) -> tuple[dict[str, ShapeSpace], dict[str, Any] | None]:
        spaces = {sex: learn_shape_space(S[chosen], config.components) for sex, chosen in groups.items()}
        return spaces, _plane(spaces["neutral"], S, sexes).kept() if all(sex in groups for sex in SEXES) else None

    spaces, plane = from_shapes(carriage, learned.space, shapes, config, tick, step, list(sexes), learn)
    examples = pose_examples(template, skeleton, learned.poses, shapes)
    prior = pose_prior(examples, len(poses))
    models = {}
    for sex, chosen in groups.items():
        info = {**how_learned(template, learned, poses, shapes[chosen], config), "sex": sex}
        if sex == "neutral" and plane is not None:
            info[PLANE] = plane
        models[sex] = ScapeModel(template, skeleton, learned.space, spaces[sex], *prior, info, pose_examples=examples)
    return models


def _plane(space: ShapeSpace, S: np.ndarray, sexes: Sequence[str]) -> SexPlane:
    """What tells the sexes of people (P, F, 3, 3) apart."""
    known = np.isin(np.array(list(sexes), dtype=object), SEXES)
    return learn_sex_plane(space.betas_of(S[known]), [sex for sex in sexes if sex in SEXES])


def _groups(sexes: Sequence[str], count: int) -> dict[str, np.ndarray]:
    """The people of every model that can be learned, or ValueError."""
    if isinstance(sexes, str) or len(sexes) != count:
        raise ValueError(f"sexes: expected {count}, one a person, got {len(sexes)}")
    unknown = sorted({sex for sex in sexes if sex not in (*SEXES, "")})
    if unknown:
        raise ValueError(f"sexes: expected 'female', 'male' or '', got {', '.join(map(repr, unknown))}")
    groups = {"neutral": np.arange(count)}
    for sex in SEXES:
        chosen = np.flatnonzero(np.array(list(sexes), dtype=object) == sex)
        if len(chosen) >= FEWEST:
            groups[sex] = chosen
    return groups
