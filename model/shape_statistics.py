"""Statistics of the betas of people: a Gaussian, one for each sex where a model tells women from men."""
from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scanprep.synthetic.anatomy import Sex

from .body import BodyModel

SEXES: tuple[Sex, Sex] = ("female", "male")
PLANE = "sex_plane"                  # the plane between women and men, in a model's info
WORDS = {"female": "women", "male": "men"}


@dataclass(frozen=True, eq=False)
class ShapeStatistics:
    """A Gaussian of betas.

    Attributes
    ----------
    mean : (K,) float
    covariance : (K, K) float
    """

    mean: np.ndarray
    covariance: np.ndarray

    @cached_property
    def root(self) -> np.ndarray:
        """(K, K) square root of the covariance: `mean + root @ z` are betas for standard normal z."""
        variance, axes = np.linalg.eigh(self.covariance)
        return axes * np.sqrt(np.maximum(variance, 0))


def list_sexes(model: BodyModel) -> tuple[Sex, ...]:
    """List the sexes whose statistics a model holds; most models hold none."""
    return tuple(sex for sex in SEXES if sex in model.info.get("sexes", {}))


def shape_statistics(model: BodyModel, sex: Sex | None = None) -> ShapeStatistics:
    """Return mean and covariance of the betas of people, or of one sex.

    Parameters
    ----------
    model : BodyModel
        A model with shape components.
    sex : {"female", "male"}, optional
        A model of one sex alone (`learn_by_sex`) knows only its own.

    Returns
    -------
    ShapeStatistics
        `mean` (K,) and `covariance` (K, K). Without a sex they are 0 and 1: betas are standardised over all people
        that the model was learned from.

    Raises
    ------
    ValueError
        Another word, a model that does not tell women from men, or damaged statistics.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> men, women = (shape_statistics(load_built_in_model(), sex) for sex in ("male", "female"))
    >>> bool(men.mean[0] > women.mean[0])               # the first beta is stature
    True

    [SCAPE] Eq. 7
    """
    K = model.n_betas
    if sex is None or model.info.get("sex") == sex:
        return ShapeStatistics(np.zeros(K), np.eye(K))
    if sex not in SEXES:
        raise ValueError(f"sex: expected 'female' or 'male', got {sex!r}")
    if sex not in list_sexes(model):
        raise ValueError(f"sex: the model does not tell women from men, so it has no {WORDS[sex]}; leave it out, or "
                         "take the built-in model, which is named people")
    moments = model.info["sexes"][sex]
    try:
        mean, covariance = (np.array(moments[name], dtype=np.float64) for name in ("mean", "covariance"))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"model: its statistics of {WORDS[sex]} are damaged ({error})") from None
    if mean.shape != (K,) or covariance.shape != (K, K) or not np.isfinite([*mean, *covariance.ravel()]).all():
        raise ValueError(f"model: its statistics of {WORDS[sex]} are damaged: expected finite numbers of {K} betas")
    return ShapeStatistics(mean, covariance)


def draw_betas(model: BodyModel, count: int, rng: np.random.Generator, sex: Sex | None = None
               ) -> tuple[np.ndarray, tuple[Sex | None, ...]]:
    """Draw betas (n, K) of random people, and their sexes.

    Without a sex, every other person of a model that knows both is a woman; one Gaussian over both would draw people in
    between. A model that knows no sexes draws standard normal betas, with None as the sex.

    Examples
    --------
    >>> from model import load_built_in_model
    >>> betas, sexes = draw_betas(load_built_in_model(), 4, np.random.default_rng(0))
    >>> betas.shape, sexes
    ((4, 30), ('female', 'male', 'female', 'male'))
    """
    z = rng.normal(size=(count, model.n_betas))
    both = list_sexes(model)
    if sex is not None or len(both) < 2:
        people = shape_statistics(model, sex)
        # without a sex the covariance is 1: the numbers stay as drawn, so that a seed always gives the same bodies
        return (z if sex is None else people.mean + z @ people.root.T), (sex,) * count
    of = {one: shape_statistics(model, one) for one in both}
    sexes = tuple(both[i % 2] for i in range(count))
    return np.array([of[one].mean + of[one].root @ z[i] for i, one in enumerate(sexes)]), sexes
