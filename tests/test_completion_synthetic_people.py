import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from model_bodies import worm_model

from completion import synthetic_people
from completion.cli import read_landmark_pairs, read_model
from completion.synthetic_people import SyntheticRecipe, cache_folder, synthetic_model, synthetic_path
from model import LearnConfig, fit_pose
from scanprep.synthetic.data_set import SUBJECT
from scanprep.synthetic.landmarks import landmarks, markers
from scanprep.synthetic.people import Person, random_pose

SMALL = SyntheticRecipe(poses=6, people=3, faces=2400, learn=LearnConfig(components=2, refinements=0))


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder, ticks = tmp_path_factory.mktemp("cache"), []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SCAPEKIT_CACHE", str(folder))
        model = synthetic_model(lambda done, total: ticks.append((done, total)), SMALL)
    return folder, model, ticks


@pytest.fixture
def cache(built, monkeypatch):
    monkeypatch.setenv("SCAPEKIT_CACHE", str(built[0]))
    return built[0]


def test_the_model_is_that_of_the_synthetic_people(built):
    _, model, ticks = built
    person, rng = Person(SUBJECT), np.random.default_rng(3)
    kept = np.array(model.info["people_vertices"])
    np.testing.assert_allclose(model.template.vertices, person.mesh.vertices[kept], atol=1e-9)
    assert model.template.is_closed and len(model.template.faces) <= SMALL.faces
    assert model.n_betas == 2 and model.skeleton.names == person.names
    for named, mine in ((landmarks(), model.info["landmarks"]), (markers(), model.info["markers"])):
        assert {name: kept[v] for name, v in mine.items()} == named
    truth = person.posed(0.5 * random_pose(rng))[kept]
    assert np.linalg.norm(fit_pose(model.subject(None), truth).vertices - truth, axis=1).mean() < 0.012
    done, total = zip(*ticks, strict=True)
    assert list(done) == sorted(done) and done[-1] == total[-1] and len(set(total)) == 1


def test_it_is_built_once(cache, built, monkeypatch):
    monkeypatch.setattr(synthetic_people, "build_synthetic", lambda *_: pytest.fail("built again"))
    again = synthetic_model(recipe=SMALL)
    np.testing.assert_array_equal(again.template.vertices, built[1].template.vertices)
    assert again.info["built"] == built[1].info["built"]
    assert [p.name for p in cache.iterdir()] == [synthetic_path(SMALL).name]


def test_another_recipe_is_built_anew(cache, built, monkeypatch):
    calls = []
    monkeypatch.setattr(synthetic_people, "build_synthetic", lambda recipe, progress: calls.append(recipe) or built[1])
    other = SyntheticRecipe(seed=6)
    assert synthetic_path(other) != synthetic_path(SMALL)
    for _ in range(2):
        synthetic_model(recipe=other)
    assert calls == [other]
    synthetic_path(other).unlink()


def other_numbers(model):
    return replace(model, shape_space=replace(model.shape_space, mean=1.01 * model.shape_space.mean))


@pytest.mark.parametrize("damaged", [
    lambda path, model: path.write_bytes(b"half a file"),
    lambda path, model: path.write_bytes(path.read_bytes()[:-2000]),
    lambda path, model: path.write_bytes(path.read_bytes()[:5000] + b"xxxx" + path.read_bytes()[5004:]),
    lambda path, model: other_numbers(model).save(path),
    lambda path, model: replace(model, info={**model.info, "landmarks": {}}).save(path),
    lambda path, model: worm_model().save(path)], ids=["text", "cut", "bytes", "numbers", "landmarks", "other"])
def test_a_damaged_or_wrong_model_is_built_anew(built, tmp_path, monkeypatch, damaged):
    monkeypatch.setenv("SCAPEKIT_CACHE", str(tmp_path))
    shutil.copy(built[0] / synthetic_path(SMALL).name, synthetic_path(SMALL))
    calls = []
    monkeypatch.setattr(synthetic_people, "build_synthetic", lambda recipe, progress: calls.append(recipe) or built[1])
    synthetic_model(recipe=SMALL)
    assert not calls
    damaged(synthetic_path(SMALL), built[1])
    for _ in range(2):
        model = synthetic_model(recipe=SMALL)
        np.testing.assert_array_equal(model.shape_space.mean, built[1].shape_space.mean)
    assert calls == [SMALL]


def test_processes_that_start_at_once_build_it_once(built, tmp_path, monkeypatch):
    """Threads here, which the lock keeps apart in the same way."""
    monkeypatch.setenv("SCAPEKIT_CACHE", str(tmp_path))
    calls = []

    def slow(recipe, progress):
        calls.append(recipe)
        time.sleep(0.5)
        return built[1]

    monkeypatch.setattr(synthetic_people, "build_synthetic", slow)
    with ThreadPoolExecutor(3) as pool:
        models = list(pool.map(lambda _: synthetic_model(recipe=SMALL), range(3)))
    assert len(models) == 3 and calls == [SMALL]
    assert [p.name for p in tmp_path.iterdir()] == [synthetic_path(SMALL).name]


def test_only_what_is_ours_goes_from_the_cache(built, tmp_path, monkeypatch):
    monkeypatch.setenv("SCAPEKIT_CACHE", str(tmp_path))
    monkeypatch.setattr(synthetic_people, "build_synthetic", lambda recipe, progress: built[1])
    stem = synthetic_path(SMALL).stem
    for name in (f".{stem}.123.part.npz", ".other.123.part.npz", f"{stem}.txt", "mine.npz"):
        (tmp_path / name).write_text("mine")
    synthetic_model(recipe=SMALL)
    assert {p.name for p in tmp_path.iterdir()} == {f"{stem}.npz", ".other.123.part.npz", f"{stem}.txt", "mine.npz"}


def test_a_cache_that_cannot_be_written_is_named(tmp_path, built, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SCAPEKIT_CACHE", str(tmp_path / "file" / "inner"))
    monkeypatch.setattr(synthetic_people, "build_synthetic", lambda *_: built[1])
    with pytest.raises(ValueError, match=r"inner.*SCAPEKIT_CACHE"):
        synthetic_model(recipe=SMALL)


def test_without_the_variable_it_is_the_users_cache(monkeypatch):
    pytest.importorskip("platformdirs")
    monkeypatch.delenv("SCAPEKIT_CACHE", raising=False)
    assert cache_folder().is_absolute() and "scapekit" in cache_folder().parts


def test_commands_name_the_model(cache, built, tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic_people, "SyntheticRecipe", lambda: SMALL)
    model, name = read_model(None)
    assert name == f"synthetic people, built {built[1].info['built']}, cached at {synthetic_path(SMALL)}"
    model.save(tmp_path / "own.npz")
    assert read_model(tmp_path / "own.npz")[1] == str(tmp_path / "own.npz")


def test_landmarks_of_a_scan_are_matched_by_name(built, tmp_path):
    model, marks = built[1], tmp_path / "marks.json"
    marks.write_text('{"navel": [0, 1, 2], "left heel": [3, 4, 5], "right heel": [6, 7, 8], "other": [0, 0, 0]}')
    vertices, points = read_landmark_pairs(model, "m", marks, None, "m")
    found = dict(zip(vertices.tolist(), points.tolist(), strict=True))
    assert found == {model.info["landmarks"][n]: p for n, p in
                     (("navel", [0, 1, 2]), ("left heel", [3, 4, 5]), ("right heel", [6, 7, 8]))}
    marks.write_text('{"navel": [0, 1, 2]}')
    with pytest.warns(UserWarning, match=r"marks\.json.*template: .*left heel.*scan: navel; going on without"):
        assert read_landmark_pairs(model, "m", marks, None, "m") is None
