import json
from pathlib import Path

import numpy as np
import pytest
from model_bodies import random_poses, worm_model

from model.files import load_model
from model.scape import ScapeModel
from scanprep.geometry import rotations, storage

FILES = Path(__file__).parent / "files"


@pytest.fixture(scope="module")
def model():
    return worm_model()


def test_at_rest_it_is_the_template(model):
    rest = np.zeros((4, 3))
    np.testing.assert_allclose(model.vertices(rest, None, np.zeros(3)), model.template.vertices, rtol=0, atol=1e-9)
    np.testing.assert_allclose(model.subject().vertices(rest), model.template.vertices, rtol=0, atol=1e-9)


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


def test_shape_jacobian_matches_differences(model):
    pose = random_poses(model, 1, np.random.default_rng(0))[0]
    betas = np.array([0.5, -1, 2.0])
    J = model.shape_jacobian(pose)
    for k in range(3):
        step = 1e-3 * np.eye(3)[k]
        slope = (model.vertices(pose, betas + step) - model.vertices(pose, betas - step)) / 2e-3
        np.testing.assert_allclose(J[..., k], slope, atol=1e-10)
    np.testing.assert_array_equal(model.shape_jacobian(pose, [3, 5]), J[[3, 5]])


def test_survives_the_file_unchanged(model, tmp_path):
    path = tmp_path / "worm.npz"
    given = ScapeModel(model.template, model.skeleton, model.pose_space, model.shape_space,
                       np.random.default_rng(1).normal(size=(4, 3)), model.pose_covariance, {"ridge": 0.1})
    given.save(path)
    back = load_model(path)
    assert isinstance(back, ScapeModel) and back.kind == "scape" and back.info == {"ridge": 0.1}
    pose, trans = random_poses(model, 1, np.random.default_rng(2))[0], np.ones(3)
    for betas in (None, [1.0, -0.5, 0.2]):
        np.testing.assert_array_equal(back.vertices(pose, betas, trans), given.vertices(pose, betas, trans))
    np.testing.assert_array_equal(back.pose_mean, given.pose_mean)
    np.testing.assert_array_equal(back.skeleton.parents, given.skeleton.parents)
    np.testing.assert_array_equal(back.shape_space.variances, given.shape_space.variances)
    again = tmp_path / "again.npz"
    back.save(again)
    with np.load(path) as a, np.load(again) as b:
        assert sorted(a.files) == sorted(b.files)
        for name in a.files:
            np.testing.assert_array_equal(a[name], b[name])


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


def test_a_batch_by_the_solve_is_the_loop(model):
    poses = random_poses(model, 3, np.random.default_rng(3))
    y = model.vertices(poses, [0.5])
    for b in range(3):
        np.testing.assert_array_equal(y[b], model.vertices(poses[b], [0.5]))


def test_a_file_of_version_1_stays_readable():
    """Written by the first release, which had linear features only; what it gave then is kept beside it."""
    old = load_model(FILES / "scape_version_1.npz")
    expected = np.load(FILES / "scape_version_1_expected.npz")
    pose, betas, trans = expected["pose"], expected["betas"], expected["trans"]
    np.testing.assert_allclose(old.vertices(pose, betas, trans), expected["vertices"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(old.subject(None).vertices(pose, trans), expected["own"], rtol=0, atol=1e-9)
    assert old.kind == "scape" and old.info["landmarks"] == {"nose": 3} and old.n_betas == 3
