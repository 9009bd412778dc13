"""A small model of the synthetic people, for the tests of markers: made once a run, in a few seconds."""
from __future__ import annotations

from functools import lru_cache

import numpy as np

from completion.synthetic_people import SyntheticRecipe, synthetic_model
from model.body import BodyModel
from model.learning.config import LearnConfig

SMALL = SyntheticRecipe(poses=12, people=8, faces=3000, learn=LearnConfig(components=4, refinements=0))


@lru_cache(maxsize=1)
def small_people() -> BodyModel:
    """16 parts, four betas, a thousand vertices; from the cache of the run, for its other processes."""
    return synthetic_model(recipe=SMALL)


def kept() -> np.ndarray:
    """The vertices of `Person` that the model kept."""
    return np.array(small_people().info["people_vertices"])
