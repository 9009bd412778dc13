"""Models of women, of men and of everybody from one training set, and the plane that separates their betas."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from scanprep.batch.room import Step, run_uncached
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.upright import find_up
from scanprep.skeleton.tree import Skeleton
from scanprep.threads import one_thread

from ..blending import BlendedTemplate, rigid_weights
from ..body import BodyModel
from ..scape import ScapeModel
from ..shape_space import ShapeSpace, body_volumes, learn_shape_space
from ..shape_statistics import PLANE, SEXES
from .config import LearnConfig
from .prior import TemplatePrior
from .scape import (
    POSES,
    Progress,
    ProgressShares,
    check_training,
    describe_bodies,
    learn_pose_with,
    shape_deformations,
    training_metadata,
)


@one_thread()
def learn_by_sex(template: Mesh, poses: np.ndarray, shapes: np.ndarray, sexes: Sequence[str], skeleton: Skeleton,
                 config: LearnConfig | None = None, progress: Progress | None = None, step: Step = run_uncached,
                 prior: TemplatePrior | None = None) -> dict[str, ScapeModel]:
    """Learn a model of everybody and one of each sex, with one common pose space.

    Parameters
    ----------
    template, poses, shapes, skeleton, config, progress, step
        As for `learn_scape`.
    sexes : S strings
        "female", "male", or "" where it is not known; those count only in the model of everybody.
    prior : TemplatePrior, optional
        Prior of the pose space; shapes are learned from the people alone.

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
    poses, people = check_training(template, skeleton, poses, shapes, prior)
    template = find_up(template, poses)
    assert people is not None
    sex, groups = np.array(list(sexes), dtype=object), _groups(sexes, len(people))
    parts = BlendedTemplate(template, skeleton, rigid_weights(skeleton))
    work = ProgressShares(progress, step)
    learned = learn_pose_with(prior, parts, poses, config, work)

    def learn(inner: ProgressShares) -> tuple[dict[str, ShapeSpace], dict[str, object] | None]:
        S = shape_deformations(parts, learned.space, people, inner)
        volumes = body_volumes(template, people)
        spaces = {name: learn_shape_space(S[chosen], config.components, volumes[chosen])
                  for name, chosen in groups.items()}
        if not all(name in groups for name in SEXES):
            return spaces, None
        known = np.isin(sex, SEXES)
        return spaces, learn_sex_plane(spaces["neutral"].betas_of(S[known]), sex[known].tolist()).to_arrays()

    spaces, plane = work.step("shape components", (parts, learned.space, people, config.components, list(sexes)),
                               1 - POSES, learn)
    common = training_metadata(template, skeleton, learned, poses, people, config, prior)
    if prior is not None:
        common["info"]["prior_people"] = 0.0                 # shapes are those of the people alone
    models = {}
    for name, chosen in groups.items():
        info = {**common["info"], **describe_bodies(template, poses, people[chosen]), "sex": name}
        if name == "neutral" and plane is not None:
            info[PLANE] = plane
        models[name] = ScapeModel(template, skeleton, learned.space, spaces[name], **{**common, "info": info})
    return models


def _groups(sexes: Sequence[str], count: int) -> dict[str, np.ndarray]:
    """List the people of every model that can be learned; ValueError for wrong sexes."""
    if isinstance(sexes, str) or len(sexes) != count:
        raise ValueError(f"sexes: expected {count}, one a person, got {len(sexes)}")
    unknown = sorted({sex for sex in sexes if sex not in (*SEXES, "")})
    if unknown:
        raise ValueError(f"sexes: expected 'female', 'male' or '', got {', '.join(map(repr, unknown))}")
    groups = {"neutral": np.arange(count)}
    for sex in SEXES:
        chosen = np.flatnonzero(np.array(list(sexes), dtype=object) == sex)
        # one person spans no shape space
        if len(chosen) >= 2:
            groups[sex] = chosen
    return groups


@dataclass(frozen=True, eq=False)
class SexPlane:
    """A plane between the betas of women and men.

    `weights` (K,) is its unit normal, towards the men; the signed distance is `weights @ betas + bias`. It was learned
    from `count` people. The probability of a man is `1 / (1 + exp(-slope distance))`.
    """

    weights: np.ndarray
    bias: float
    count: int
    slope: float

    def to_arrays(self) -> dict[str, Any]:
        """Return what a model keeps of it."""
        return {**vars(self), "weights": self.weights.tolist()}


@dataclass(frozen=True)
class SexGuess:
    """Result of `guess_sex`.

    `margin` is the signed distance from the plane between women and men, standard deviations, positive for a man.
    `probability` is that of `sex`, from the cross-validation of the model's own people at such margins.
    """

    sex: str
    margin: float
    probability: float


def learn_sex_plane(betas: np.ndarray, sexes: Sequence[str]) -> SexPlane:
    """Learn the plane between betas (P, K) of "female" and "male", at least two of each, by a linear SVM.

    The penalty is chosen by five-fold cross-validation; among equals the softest is taken. Only the first betas count,
    a third as many as people.
    """
    betas, men = np.asarray(betas, dtype=np.float64), np.array([sex == "male" for sex in sexes], dtype=bool)
    # three people for each beta: with as many betas as people any labels could be separated
    count, betas = betas.shape[1], betas[:, :max(1, len(betas) // 3)]
    tried = [(_unseen(betas, men, C), C) for C in (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)]       # the softest first
    right = [float(np.mean((margins > 0) == men)) for margins, _ in tried]
    margins, C = tried[int(np.argmax(right))]
    weights, bias = _plane(betas, men, C)
    weights = np.pad(weights, (0, count - len(weights)))
    return SexPlane(weights, bias, len(betas), _certainty(margins, men))


def _plane(betas: np.ndarray, men: np.ndarray, C: float) -> tuple[np.ndarray, float]:
    """Fit a support vector machine; return the unit normal (K,) and bias of its plane."""
    from sklearn.svm import SVC

    machine = SVC(kernel="linear", C=C, class_weight="balanced").fit(betas, men)
    size = np.linalg.norm(machine.coef_[0])
    return machine.coef_[0] / size, float(machine.intercept_[0] / size)


def _unseen(betas: np.ndarray, men: np.ndarray, C: float) -> np.ndarray:
    """Compute distances (P,) of people from planes that were learned without them."""
    from sklearn.model_selection import StratifiedKFold

    folds = StratifiedKFold(min(5, int(men.sum()), int((~men).sum())), shuffle=True, random_state=0)
    margins = np.empty(len(men))
    for known, new in folds.split(betas, men):
        weights, bias = _plane(betas[known], men[known], C)
        margins[new] = betas[new] @ weights + bias
    return margins


def _certainty(margins: np.ndarray, men: np.ndarray) -> float:
    """Fit how fast the log-odds of a man grow with margins (P,)."""
    from sklearn.linear_model import LogisticRegression

    found = LogisticRegression(class_weight="balanced", fit_intercept=False).fit(margins[:, None], men)
    return max(float(found.coef_[0, 0]), 0.0)


def guess_sex(model: BodyModel, betas: np.ndarray) -> SexGuess:
    """Guess whether betas of the neutral model are a woman's or a man's, by the plane that the model keeps.

    Parameters
    ----------
    model : BodyModel
        The neutral model of `learn_by_sex`, learned from people of both sexes.
    betas : (k,) float, k ≤ K
        Shape coefficients, standard deviations.

    Raises
    ------
    ValueError
        A model that keeps no plane, betas of the wrong shape or not finite.
    """
    plane = sex_plane(model)
    betas = np.asarray(betas, dtype=np.float64)
    if betas.ndim != 1 or len(betas) > len(plane.weights) or not np.isfinite(betas).all():
        raise ValueError(f"betas: expected at most {len(plane.weights)} finite numbers, got shape {betas.shape}")
    margin = float(betas @ plane.weights[:len(betas)] + plane.bias)
    sure = 1 / (1 + np.exp(-plane.slope * abs(margin)))
    return SexGuess("male" if margin > 0 else "female", margin, float(sure))


def sex_plane(model: BodyModel) -> SexPlane:
    """Read the plane that a model keeps; ValueError where it keeps none or a damaged one."""
    stored = model.info.get(PLANE)
    if stored is None:
        raise ValueError("model: it keeps nothing that tells women from men; learn one of both sexes with "
                         "learn_by_sex (scape learn --by-sex)")
    try:
        weights = np.array(stored["weights"], dtype=np.float64)
        numbers = {name: float(stored[name]) for name in ("bias", "slope")}
        if weights.shape != (model.n_betas,) or not np.isfinite([*weights, *numbers.values()]).all():
            raise ValueError(f"expected {model.n_betas} finite weights, found shape {weights.shape}")
        return SexPlane(weights, count=int(stored["count"]), **numbers)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"model: what tells women from men is damaged ({error})") from None
