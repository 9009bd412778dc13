"""Models of women, of men and of everybody, from one training set."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scanprep.batch.room import Step, once
from scanprep.geometry.mesh import Mesh
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blending import BlendedTemplate, rigid_weights
from ..scape import ScapeModel
from ..shape_space import ShapeSpace, learn_shape_space
from .config import LearnConfig
from .pose import learn_pose
from .scape import amount, checked_training, how_learned, pose_examples, pose_prior, shape_deformations
from .sex_plane import PLANE, learn_sex_plane
from .work import Progress, Work, timed

SEXES = ("female", "male")


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
    poses, people = checked_training(template, skeleton, poses, shapes)
    assert people is not None
    sex, groups = np.array(list(sexes), dtype=object), _groups(sexes, len(people))
    parts = BlendedTemplate(template, skeleton, rigid_weights(skeleton))
    work = Work(progress, amount(poses, people, config), step)
    learned = learn_pose(parts, poses, config, work)

    def learn(inner: Work) -> tuple[dict[str, ShapeSpace], dict[str, object] | None]:
        S = shape_deformations(parts, learned.space, people, config, inner)
        with timed("shape components"):
            spaces = {name: learn_shape_space(S[chosen], config.components) for name, chosen in groups.items()}
            if not all(name in groups for name in SEXES):
                return spaces, None
            known = np.isin(sex, SEXES)
            return spaces, learn_sex_plane(spaces["neutral"].betas_of(S[known]), sex[known].tolist()).kept()

    spaces, plane = work.step("shape components", (parts, learned.space, people, config.smoothness, config.components,
                                                   list(sexes)), len(people), learn)
    examples = pose_examples(template, skeleton, learned.poses, people)
    prior = pose_prior(examples, len(poses))
    models = {}
    for name, chosen in groups.items():
        info = {**how_learned(template, learned, poses, people[chosen], config), "sex": name}
        if name == "neutral" and plane is not None:
            info[PLANE] = plane
        models[name] = ScapeModel(template, skeleton, learned.space, spaces[name], *prior, info, pose_examples=examples)
    return models


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
        # people that span a space of shapes
        if len(chosen) >= 2:
            groups[sex] = chosen
    return groups
