"""A small model of the built-in people, for the tests of markers: learned once a run, in a few seconds."""
from __future__ import annotations

import os
import sys
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from model.body import BodyModel
from model.files import load_model
from model.learning.config import LearnConfig
from scanprep.synthetic.population import population

sys.path.insert(0, str(Path(__file__).with_name("people")))
import make_model

SHARED = "SCAPEKIT_TESTS"            # the folder of the run, see conftest


@lru_cache(maxsize=1)
def small_people() -> BodyModel:
    """16 parts, four betas, 1,500 vertices; from the folder of the run, for its other processes."""
    path = Path(os.environ[SHARED]) / "small_people.npz"
    # two processes that begin at once make the same file, and a file is never there in part
    if not path.exists():
        make_model.learn_people_model(24, 3000, LearnConfig(refinements=0), n_betas=4).save(path)
    return load_model(path)


def with_sexes(model: BodyModel) -> BodyModel:
    """A small model that tells women from men, as the built-in one does."""
    k = model.n_betas
    sexes = {sex: {"mean": mean[:k].tolist(), "covariance": C[:k, :k].tolist()}
             for sex, (mean, C) in population().moments.items()}
    return replace(model, info={**model.info, "sexes": sexes})


def kept() -> np.ndarray:
    """The vertices of `Person` that the model kept."""
    return np.array(small_people().info["people_vertices"])
