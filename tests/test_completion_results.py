import json

import numpy as np
import pytest
from completion_bodies import worm_with_prior

from completion.partial.completion import Completion, load_completion, save_completion
from scanprep.geometry import storage

MODEL = worm_with_prior()


def made(betas):
    rng, pose = np.random.default_rng(0), np.full((4, 3), 0.1)
    mesh = MODEL.template.with_vertices(MODEL.vertices(pose, betas))
    error = rng.random(398)
    return Completion(mesh.with_vertices(mesh.vertices + 0.01), mesh, pose, betas, np.ones(3), error > 0.5, 0.002, 0.9,
                      0.01, True, 9, {"scan_planes": 3.5}, 0.001, error, 1 - error)


@pytest.mark.parametrize("betas", [None, np.arange(3.0)], ids=["known", "unknown"])
def test_a_completion_comes_back_from_its_folder(tmp_path, betas):
    saved = made(betas)
    again = load_completion(save_completion(tmp_path, saved))
    for name in ("pose", "trans", "seen", "expected_error", "confidence"):
        np.testing.assert_array_equal(getattr(again, name), getattr(saved, name))
    assert again.betas is None if betas is None else np.array_equal(again.betas, betas)
    for name in ("rms", "explained", "landmark_rms", "converged", "iterations", "energies", "scale"):
        assert getattr(again, name) == getattr(saved, name)
    for name in ("completed", "predicted"):
        np.testing.assert_allclose(getattr(again, name).vertices, getattr(saved, name).vertices, atol=1e-6)
        np.testing.assert_array_equal(getattr(again, name).faces, MODEL.template.faces)


def test_a_folder_of_the_first_version_is_read_without_what_it_lacks(tmp_path):
    saved = made(None)
    save_completion(tmp_path, saved)
    path = tmp_path / "completion.npz"
    with np.load(path) as kept:
        header = json.loads(str(kept["header"]))
        arrays = {name: kept[name] for name in ("pose", "trans", "seen")}
    facts = {name: header[name] for name in header if name not in ("kind", "version", "scale")}
    storage.save(path, "completion", 1, arrays, facts)
    again = load_completion(tmp_path)
    assert again.scale == 1 and again.expected_error is None and again.confidence is None and again.rms == saved.rms
    save_completion(tmp_path, again)
    assert load_completion(tmp_path).confidence is None


def test_a_folder_that_lacks_an_array_is_refused(tmp_path):
    save_completion(tmp_path, made(None))
    storage.save(tmp_path / "completion.npz", "completion", 2, {"pose": np.zeros((4, 3))}, {})
    with pytest.raises(storage.StorageError, match="it lacks"):
        load_completion(tmp_path)
