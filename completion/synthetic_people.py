"""A small model of the synthetic people, for those who have no model of their own: built on first use, then kept."""
from __future__ import annotations

import datetime
import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from model.body import BodyModel, versions
from model.files import load_model
from model.learning.config import LearnConfig
from model.learning.scape import learn_scape
from model.scape import ScapeModel
from scanprep.batch.digests import Digests
from scanprep.batch.opening import locked
from scanprep.decimation.registered_set import DecimatedSet, decimate_set
from scanprep.synthetic.data_set import SUBJECT, near_rest, subject_pose
from scanprep.synthetic.landmarks import landmarks, markers
from scanprep.synthetic.people import BodyShape, Person

Progress = Callable[[int, int], None]

CACHE = "SCAPEKIT_CACHE"             # environment variable that names another folder
SEAL = "seal"                        # its place in the model's info
VERSION = 5                          # raised when the same recipe makes another model


@dataclass(frozen=True)
class SyntheticRecipe:
    """What the model of the synthetic people is made of.

    Attributes
    ----------
    poses : int
        Of one man: rest, the named everyday poses, then random ones.
    people : int
        Women and men in turn, near rest.
    faces : int
        Triangles; the vertices are some of those that all synthetic people share.
    learn : LearnConfig
    seed : int
    """

    poses: int = 40
    people: int = 120
    faces: int = 10000
    learn: LearnConfig = field(default_factory=lambda: LearnConfig(components=30, refinements=2))
    seed: int = 5

    @property
    def digest(self) -> str:
        """Twelve digits that change with the recipe and with the program that carries it out."""
        told = [VERSION, versions()["scapekit"], asdict(self)]
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:12]


def synthetic_model(progress: Progress | None = None, recipe: SyntheticRecipe | None = None) -> BodyModel:
    """The model of the synthetic people, from the cache or built now, which takes most of a minute.

    All synthetic people share one triangulation and their skeleton is known, so nothing has to be registered.
    `info` says when it was built ("built") and names landmarks and markers of its template; "people_vertices" are
    the vertices of `Person` that it kept.

    Parameters
    ----------
    progress : callable, optional
        Called with (done, total) while the model is built.
    recipe : SyntheticRecipe, optional

    Notes
    -----
    Synthetic people are made, not measured: the model gives a first answer, no more. Of a half view of one real man
    (SPRING), the completed mesh lay 15 mm from the true surface on average and 27 mm where nothing had been seen; of
    a synthetic woman not among those it was learned from, 1 and 2 mm.

    Raises
    ------
    ValueError
        A cache folder that cannot be written.

    [SCAPE] §5
    """
    recipe = recipe or SyntheticRecipe()
    path = synthetic_path(recipe)
    model = _cached(path, recipe)
    if model is not None:
        return model
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path.with_name(f".{path.name}.lock"), path, wait=True):
            model = _cached(path, recipe)                   # another process may have built it meanwhile
            if model is None:
                for left in path.parent.glob(f".{path.stem}.*.part.npz"):       # by one that was killed
                    left.unlink()
                model = build_synthetic(recipe, progress)
                model = replace(model, info={**model.info, SEAL: _seal(model, recipe)})
                model.save(path)
    except OSError as error:
        raise ValueError(f"{path.parent}: cannot keep the model of the synthetic people there ({error}); "
                         f"name another folder in {CACHE}, or a model with -m") from None
    return model


def _cached(path: Path, recipe: SyntheticRecipe) -> ScapeModel | None:
    """The model of a recipe as it was built, or None where it is not there, damaged, or something else."""
    try:
        model = load_model(path)
        return model if isinstance(model, ScapeModel) and model.info.get(SEAL) == _seal(model, recipe) else None
    except Exception:                    # whatever is wrong with the file, it is made anew
        return None


def _seal(model: ScapeModel, recipe: SyntheticRecipe) -> str:
    """A digest of a model, by which it is known to be whole and of the recipe."""
    info = {name: value for name, value in model.info.items() if name != SEAL}
    return Digests().of(recipe.digest, replace(model, info=info))


def synthetic_path(recipe: SyntheticRecipe | None = None) -> Path:
    """Where the model of a recipe is kept."""
    return cache_folder() / f"synthetic-people-{(recipe or SyntheticRecipe()).digest}.npz"


def cache_folder() -> Path:
    """The folder for what can be made again: the one that SCAPEKIT_CACHE names, or the user's cache."""
    if os.environ.get(CACHE):
        return Path(os.environ[CACHE])
    try:
        from platformdirs import user_cache_path
    except ModuleNotFoundError:
        raise ModuleNotFoundError(f"the user's cache folder is found by platformdirs: pip install platformdirs, "
                                  f"or name a folder in {CACHE}") from None
    return user_cache_path("scapekit", appauthor=False)


def build_synthetic(recipe: SyntheticRecipe, progress: Progress | None = None) -> ScapeModel:
    """Learn the model of a recipe, without the cache."""
    rng = np.random.default_rng(recipe.seed)
    made, learning = recipe.poses + recipe.people, (recipe.learn.refinements + 1) * recipe.poses + recipe.people
    tell = progress or (lambda done, total: None)
    person = Person(SUBJECT)
    poses, shapes = [], []
    for k in range(recipe.poses):
        poses.append(person.posed(subject_pose(k, rng)[1]))
        tell(k + 1, made + learning)
    for k in range(recipe.people):
        shapes.append(Person(BodyShape.random(rng, sex=("female", "male")[k % 2])).posed(near_rest(rng)))
        tell(recipe.poses + k + 1, made + learning)
    small = _decimated(person, np.stack(poses), recipe.faces)
    assert small.skeleton is not None, "a skeleton was given"
    model = learn_scape(small.template, small.transfer(np.stack(poses)), small.transfer(np.stack(shapes)),
                        small.skeleton, recipe.learn,
                        lambda done, total: tell(made + learning * done // total, made + learning))
    return replace(model, info={
        **model.info, "name": "synthetic people", "built": datetime.date.today().isoformat(),
        "landmarks": small.landmarks(landmarks()), "markers": small.landmarks(markers()),
        "people_vertices": small.vertex_map.tolist()})


def _decimated(person: Person, poses: np.ndarray, faces: int) -> DecimatedSet:
    """The person with fewer triangles; landmarks and markers stay where they are."""
    kept = np.unique([*landmarks().values(), *markers().values()])
    return decimate_set(person.mesh, poses, faces, keep=kept, skeleton=person.skeleton)
