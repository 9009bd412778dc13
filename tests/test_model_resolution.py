from dataclasses import replace

import numpy as np
import pytest
from model_bodies import random_poses, worm_model
from posing_bodies import skinned, symmetric_worm

from model import BodyModel, load_model
from model.cli import group
from model.features import linear_features
from model.pose_space import PoseSpace
from model.resolution.change import change_resolution, resolution_gap, subdivide_at_middles
from model.scape import ScapeModel
from model.shape_space import ShapeSpace
from scanprep import decimate, write_mesh
from scanprep.geometry.carrier import mount
from scanprep.geometry.mesh import Mesh


@pytest.fixture(scope="module")
def model():
    given = worm_model()
    return replace(given, pose_covariance=np.diag([0.0] * 3 + [0.1] * 9), info={"digest": "d", "landmarks": {"tip": 3}})


@pytest.fixture(scope="module")
def finer(model):
    return change_resolution(model, subdivide_at_middles(model.template))


def apart(a, b, pose, betas=None):
    """Mean and largest distance of the vertices of b from the points of a on which they lie at rest, metres."""
    ridden = mount(a.template, b.template).positions(a.vertices(pose, betas))
    far = np.linalg.norm(ridden - b.vertices(pose, betas), axis=-1)
    return far.mean(), far.max()


def typical(model, count=6, seed=5):
    poses = random_poses(model, count, np.random.default_rng(seed), 0.3)
    return poses


def test_the_same_triangles_give_the_same_model(model):
    same = change_resolution(model, model.template, rounds=0)
    pose = typical(model, 1)[0]
    np.testing.assert_allclose(same.vertices(pose), model.vertices(pose), rtol=0, atol=1e-6)
    # S is carried as the shapes that the parts have in the mean pose, which is a little less than all of S
    mean, betas = model.pose_mean, [1.0, -1.0, 0.5]
    np.testing.assert_allclose(same.vertices(mean, betas), model.vertices(mean, betas), rtol=0, atol=1e-6)
    np.testing.assert_allclose(same.vertices(pose, betas), model.vertices(pose, betas), rtol=0, atol=1e-3)
    np.testing.assert_array_equal(same.skeleton.part_of_face, model.skeleton.part_of_face)


@pytest.mark.parametrize("faces", [None, 500])
def test_a_model_deformed_alike_everywhere_stays_exact(model, faces):
    """One affine map for all triangles is the gradient of a displacement at any resolution."""
    skeleton = model.skeleton
    features = linear_features(skeleton, tuple(np.zeros((3, 0)) for _ in skeleton.parents))
    A = np.eye(3) + np.random.default_rng(1).normal(0, 0.1, (3, 3))
    B = np.random.default_rng(2).normal(0, 0.1, (3, 3))
    sizes = np.bincount(skeleton.part_of_face)
    alike = ScapeModel(
        model.template, skeleton, PoseSpace(features, tuple(np.tile(A, (1, n, 1, 1)) for n in sizes)),
        ShapeSpace(np.tile(np.eye(3) + B, (sizes.sum(), 1, 1)), np.tile(B, (1, sizes.sum(), 1, 1)), np.ones(1), 1.0),
        np.zeros((4, 3)), np.zeros((12, 12)))
    template = subdivide_at_middles(model.template) if faces is None else decimate(model.template, faces)
    carried = change_resolution(alike, template, rounds=0)
    centre = skeleton.joints[0]
    for betas, M in ((None, A), ([2.0], (np.eye(3) + 3 * B) @ A)):
        y = carried.vertices(np.zeros((4, 3)), betas)
        np.testing.assert_allclose(y, (template.vertices - centre) @ M.T + centre, atol=1e-9)


def test_finer_and_coarser_mean_the_same_body(model, finer):
    assert (len(finer.template.faces), finer.skeleton.names) == (4 * len(model.template.faces), model.skeleton.names)
    coarser = change_resolution(model, decimate(model.template, 500))
    for pose in typical(model):
        for betas in (None, [1.0, -0.5, 1.0]):
            assert apart(model, finer, pose, betas)[0] < 2.5e-3
            assert apart(model, coarser, pose, betas)[0] < 8e-3


def test_correction_lowers_what_is_left(model, finer):
    rough = change_resolution(model, finer.template, rounds=0)
    for betas in (None, [1.0, -0.5, 1.0]):
        left = [np.mean([apart(model, m, pose, betas)[0] for pose in typical(model)]) for m in (rough, finer)]
        assert left[1] < 0.7 * left[0]


def test_what_is_kept(model, finer, tmp_path):
    assert finer.info["digest"] == "d" and finer.info["resolution_of"] == "398 vertices, 792 triangles"
    place = finer.template.vertices[finer.info["landmarks"]["tip"]]
    np.testing.assert_allclose(place, model.template.vertices[3], atol=1e-12)
    np.testing.assert_array_equal(finer.pose_covariance, model.pose_covariance)
    np.testing.assert_array_equal(finer.skeleton.joints, model.skeleton.joints)
    finer.save(tmp_path / "fine.npz")
    back = load_model(tmp_path / "fine.npz")
    pose = typical(model, 1)[0]
    np.testing.assert_array_equal(back.vertices(pose, [1.0]), finer.vertices(pose, [1.0]))


def test_refuses_what_cannot_be(model):
    with pytest.raises(ValueError, match="too coarse"):
        change_resolution(model, decimate(model.template, 20))
    with pytest.raises(ValueError, match="same place"):
        change_resolution(model, model.template.with_vertices(model.template.vertices + 1))
    with pytest.raises(ValueError, match="not usable as a template"):
        change_resolution(model, Mesh(model.template.vertices, model.template.faces[:0]))
    with pytest.raises(ValueError, match="kind 'scape'"):
        BodyModel.resample(model, model.template, model.skeleton, 0, print)


def test_skinning_models_are_carried_too():
    template, skeleton, _ = symmetric_worm()
    rng = np.random.default_rng(0)
    plain = skinned(template, skeleton)
    features = linear_features(skeleton, (np.zeros((3, 0)), *[np.eye(3)] * 4))
    waves = np.sin(3 * template.vertices)
    model = replace(
        plain, features=features, correctives=rng.normal(0, 0.02, (features.count - 5, 1, 1)) * waves,
        rest=plain.rest + 0.01 * waves, shape_mean=1.1 * plain.rest, shape_variances=np.ones(1), shape_total=1.0,
        shape_components=0.05 * waves[None, :, ::-1])
    poses = rng.normal(0, 0.3, (3, 5, 3))
    finer = change_resolution(model, subdivide_at_middles(template))
    assert isinstance(finer, type(model)) and finer.shape_total == 1586 / 398
    for betas in (None, np.ones((3, 1))):
        assert resolution_gap(model, finer, poses, betas).max() < 2e-3          # of a body 2 m long
        assert resolution_gap(model, change_resolution(model, decimate(template, 500)), poses, betas).max() < 3e-3
    same = change_resolution(model, template)
    np.testing.assert_allclose(same.vertices(poses, [1.0]), model.vertices(poses, [1.0]), atol=1e-12)


def test_from_the_command_line(model, tmp_path):
    model.save(tmp_path / "worm.npz")
    out = tmp_path / "fine.npz"
    assert group(["resample", str(tmp_path / "worm.npz"), "--vertices", "600", "-o", str(out)]) == 0
    assert abs(len(load_model(out).template.vertices) - 600) <= 2
    write_mesh(tmp_path / "t.ply", subdivide_at_middles(model.template))
    assert group(["resample", str(tmp_path / "worm.npz"), "--template", str(tmp_path / "t.ply"), "-o", str(out)]) == 0
    assert len(load_model(out).template.vertices) == 1586
    assert group(["resample", str(tmp_path / "worm.npz"), "-o", str(out)]) == 2
    assert group(["resample", str(tmp_path / "worm.npz"), "--vertices", "20", "-o", str(out)]) == 1
