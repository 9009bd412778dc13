from dataclasses import replace

import numpy as np
import pytest
from model_bodies import random_poses, worm_model
from posing_bodies import skinned, symmetric_worm

from model import fit_pose
from model.cli import group
from model.features import linear_features
from model.fitting.vertices import PoseFit, ShapeFit
from model.posing.transfer import own_body, subject_from_body
from scanprep import read_mesh, write_mesh


@pytest.fixture(scope="module")
def model():
    return replace(worm_model(), pose_covariance=0.1 * np.eye(12))


def repose(model, body, poses, trans=None, fit=None):
    return own_body(model, body, fit).subject.vertices(poses, trans)


def fit_of(pose, betas=None):
    """A fit that says so."""
    if betas is None:
        return PoseFit(pose, np.zeros(3), None, 0.0, 0.0, True, 0)
    return ShapeFit(pose, np.zeros(3), None, 0.0, 0.0, True, 0, betas)


def lumpy(model):
    """The template with detail that the shape components do not have."""
    x = model.template.vertices
    lump = 0.02 * np.sin(9 * x[:, :1]) * model.template.vertex_normals
    return x + lump


def test_of_a_body_of_the_model_it_is_that_person(model):
    rng = np.random.default_rng(0)
    pose, others = random_poses(model, 1, rng, 0.3)[0], random_poses(model, 4, rng, 0.3)
    betas, trans = np.array([1.0, -1.0, 0.5]), np.array([0.3, 1.0, -2.0])
    found = own_body(model, model.vertices(pose, betas, trans), fit_of(pose, betas))
    assert found.largest < 1e-9
    np.testing.assert_allclose(found.trans, trans, atol=1e-9)
    np.testing.assert_allclose(found.subject.vertices(others), model.vertices(others, betas), rtol=0, atol=1e-9)
    # with betas that say less, the rest of S is known only as far as one pose shows it
    found = own_body(model, model.vertices(pose, betas, trans), fit_of(pose, np.zeros(3)))
    assert found.mean < 1e-3
    far, average = (np.linalg.norm(y - model.vertices(others, betas), axis=-1).mean()
                    for y in (found.subject.vertices(others), model.vertices(others, np.zeros(3))))
    assert far < 0.25 * average


def test_detail_that_betas_do_not_have_is_kept(model):
    body, rest = lumpy(model), np.zeros((4, 3))
    pose = random_poses(model, 1, np.random.default_rng(1), 0.3)[0]
    lumps = body - model.template.vertices
    found = own_body(model, body, fit_of(rest))
    assert found.mean < 1e-3 and found.largest < 5e-3 < np.abs(lumps).max()
    there = repose(model, body, pose, fit=fit_of(rest)) - model.vertices(pose)
    R = model.skeleton.part_rotations(pose)[model.skeleton.part_of_vertex(model.template)]
    turned = np.einsum("nij,nj->ni", R, lumps)
    # far from the borders a lump turns with its part
    x = model.template.vertices[:, 0] - 0.3
    middle = np.abs(x[:, None] - [-0.35, 0.35, 0.7]).min(axis=1) > 0.12
    share = (there * turned)[middle].sum() / (turned[middle] ** 2).sum()
    assert 0.8 < share < 1.2
    np.testing.assert_allclose(repose(model, body, rest, fit=fit_of(rest)), found.vertices - found.trans, atol=1e-12)


def test_the_pose_is_found(model):
    rng = np.random.default_rng(2)
    pose = random_poses(model, 1, rng, 0.2)[0]
    body = model.vertices(pose, [0.5, -0.5, 0.5], [1.0, 0, 0]) + 1e-3 * rng.normal(size=model.template.vertices.shape)
    found = own_body(model, body)
    assert found.mean < 1e-3
    np.testing.assert_allclose(found.subject.betas, [0.5, -0.5, 0.5], atol=0.1)
    again = fit_pose(found.subject, body)
    np.testing.assert_allclose(again.pose, found.pose, atol=0.02)
    subject = subject_from_body(model, body)
    np.testing.assert_array_equal(subject.operator.products.basis, found.subject.operator.products.basis)
    assert subject.pose_covariance is model.pose_covariance


def test_skinning_is_undone_exactly():
    template, skeleton, _ = symmetric_worm()
    model = skinned(template, skeleton)
    rng = np.random.default_rng(6)
    features = linear_features(skeleton, (np.zeros((3, 0)), *[np.eye(3)] * 4))
    bends = rng.normal(0, 0.01, (features.count - 5, len(template.vertices), 3))
    bent = replace(model, features=features, correctives=bends)
    pose, other = rng.normal(0, 0.5, (2, 5, 3))
    person = template.vertices + 0.02 * rng.normal(size=template.vertices.shape)
    trans = np.array([1.0, -1.0, 0.5])
    own = replace(bent, rest=person)
    found = own_body(bent, own.vertices(pose, None, trans), fit_of(pose))
    assert found.largest < 1e-9
    np.testing.assert_allclose(found.trans, trans, atol=1e-9)
    np.testing.assert_allclose(found.subject.vertices(other), own.vertices(other), rtol=0, atol=1e-9)


def test_refuses_other_bodies(model):
    rest = fit_of(np.zeros((4, 3)))
    with pytest.raises(ValueError, match="vertices"):
        repose(model, np.zeros((5, 3)), np.zeros((4, 3)), fit=rest)
    with pytest.raises(ValueError, match="vertices"):
        subject_from_body(model, np.full(model.template.vertices.shape, np.nan))
    with pytest.raises(ValueError, match="pose"):
        repose(model, model.template.vertices, np.zeros((3, 3)), fit=rest)
    with pytest.raises(ValueError, match="vertices"):
        own_body(model, np.full(model.template.vertices.shape, np.nan), rest)


def test_from_the_command_line(model, tmp_path):
    model.save(tmp_path / "worm.npz")
    write_mesh(tmp_path / "body.ply", model.template.with_vertices(lumpy(model)))
    poses = random_poses(model, 3, np.random.default_rng(8), 0.3)
    np.savez(tmp_path / "motion.npz", poses=poses.reshape(3, 12), trans=np.ones((3, 3)), mocap_frame_rate=30.0,
             betas=np.zeros(3), surface_model_type="scape")
    arguments = ["repose", str(tmp_path / "worm.npz"), str(tmp_path / "body.ply"), "--poses",
                 str(tmp_path / "motion.npz"), "-o", str(tmp_path / "out")]
    assert group(arguments) == 0
    expected = repose(model, lumpy(model), poses, np.ones((3, 3)))
    for t in range(3):
        np.testing.assert_allclose(read_mesh(tmp_path / "out" / f"{t:05d}.ply").vertices, expected[t], atol=1e-5)
    write_mesh(tmp_path / "body.ply", model.template.submesh(np.arange(100))[0])
    assert group(arguments) == 1
