import json
from pathlib import Path

import numpy as np
import pytest
from model_bodies import worm_model

from model.files import load_model
from scanprep.geometry import rotations, storage

FILES = Path(__file__).parent / "files"


@pytest.fixture(scope="module")
def model():
    return worm_model()


def test_betas_zero_is_the_mean_person(model):
    y = model.vertices(np.zeros((4, 3)), np.zeros(3))
    centre = model.skeleton.joints[0]
    expected = (model.template.vertices - centre) * np.float32([1.02, 0.95, 1.05]) + centre
    np.testing.assert_allclose(y, expected, atol=1e-9)


def test_parts_far_from_the_joints_turn_rigidly():
    stiff = worm_model(bulge=0.0)
    pose = np.zeros((4, 3))
    pose[1] = [0, 0.8, 0]
    y = stiff.vertices(pose)
    far = stiff.template.vertices[:, 0] - 0.3 < -0.8
    R, _ = rotations.procrustes(stiff.template.vertices[far], y[far])
    # what the border disagrees on is spread by stitching and fades along the part
    np.testing.assert_allclose(R, rotations.exp(pose[1]), atol=0.01)
    root = stiff.skeleton.part_of_vertex(stiff.template) == 0
    R, _ = rotations.procrustes(stiff.template.vertices[root], y[root])
    assert np.linalg.norm(rotations.log(R)) < 0.1 * 0.8


def rewritten(path, target, header=None, drop=None):
    """A model file with another header, or one array less."""
    with np.load(path) as data:
        arrays = {k: data[k] for k in data.files if k != drop}
    arrays["header"] = np.array(json.dumps({**json.loads(str(arrays["header"])), **(header or {})}))
    np.savez(target, **arrays)
    return target


def test_refuses_files_it_does_not_know(model, tmp_path):
    path = tmp_path / "worm.npz"
    model.save(path)
    with pytest.raises(storage.StorageError, match="version 99"):
        load_model(rewritten(path, tmp_path / "a.npz", {"version": 99}))
    with pytest.raises(storage.StorageError, match="'motion'"):
        load_model(rewritten(path, tmp_path / "b.npz", {"kind": "motion"}))
    with pytest.raises(storage.StorageError, match="parents"):
        load_model(rewritten(path, tmp_path / "c.npz", drop="parents"))
    with pytest.raises(storage.StorageError, match="no such file"):
        load_model(tmp_path / "none.npz")
    (tmp_path / "cut.npz").write_bytes(path.read_bytes()[:5000])
    with pytest.raises(storage.StorageError, match=r"cut\.npz"):
        load_model(tmp_path / "cut.npz")


def test_a_file_of_version_1_stays_readable():
    """Written by the first release, which had linear features only; what it gave then is kept beside it."""
    old = load_model(FILES / "scape_version_1.npz")
    expected = np.load(FILES / "scape_version_1_expected.npz")
    pose, betas, trans = expected["pose"], expected["betas"], expected["trans"]
    np.testing.assert_allclose(old.vertices(pose, betas, trans), expected["vertices"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(old.subject(None).vertices(pose, trans), expected["own"], rtol=0, atol=1e-9)
    assert old.kind == "scape" and old.info["landmarks"] == {"nose": 3} and old.n_betas == 3
