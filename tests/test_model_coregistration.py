"""Co-registration of a scan: a model leads the template where plain registration fails."""
from dataclasses import replace

import numpy as np
import pytest
from coregistered import QUICK
from crab_scans import COARSE, FAR, PLAIN, crab_body, crab_skeleton, mean_mm, scan_of  # noqa: F401 -- fixtures
from derivatives import differences
from jointed_bodies import bent
from model_bodies import random_poses, worm_model

from model import learn_scape, register_with_model
from model.fitting.bodies import ResizedBody, as_body
from scanprep.geometry.surface import Surface
from scanprep.registration.nonrigid import register

NEAR = np.array([0, 0.1, 0.05]), np.array([0.1, 0.0, -0.15])


@pytest.fixture(scope="module")
def crab_model(body, skeleton):
    turns = np.random.default_rng(0).normal(0, 0.6, (14, 2, 3)) * [0.3, 1, 1]
    return learn_scape(body, np.stack([body.vertices, *(bent(body, *t) for t in turns)]), None, skeleton, QUICK.learn)


@pytest.mark.slow
def test_a_scan_that_plain_registration_gets_wrong_is_right_with_the_model(body, crab_model):
    truth = bent(body, *FAR)
    scan = scan_of(body, truth)
    plain = register(body, scan, config=PLAIN)
    found = register_with_model(crab_model.subject(), scan, start=plain.mesh.vertices, config=QUICK)
    assert mean_mm(plain.mesh.vertices, truth) > 30 and mean_mm(found.mesh.vertices, truth) < 4
    assert 1 - QUICK.failed < found.explained
    assert found.seen.mean() > 0.8 and found.rms < 1e-3 and found.inverted == 0


def test_without_any_start_or_landmark_the_pose_is_found(body, crab_model):
    truth = bent(body, *FAR) @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]).T + [3, 1, -2]
    found = register_with_model(crab_model.subject(), scan_of(body, truth), config=QUICK)
    assert mean_mm(found.mesh.vertices, truth) < 4 and found.starts > 1


@pytest.mark.slow
def test_a_good_registration_stays_on_the_data(body, crab_model):
    """The body has a bump that the model does not know; it is there where it was scanned."""
    bump = np.exp(-((body.vertices[:, 0] - 0.05) / 0.05) ** 2)[:, None] * 0.01 * body.vertex_normals
    truth = bent(body, *NEAR) + bump
    scan = scan_of(body, truth)
    plain = register(body, scan, config=PLAIN).mesh.vertices
    found = register_with_model(crab_model.subject(), scan, start=plain, config=QUICK)
    off = Surface(body.with_vertices(truth)).closest(found.mesh.vertices).distances
    predicted = Surface(body.with_vertices(truth)).closest(found.predicted.vertices).distances
    assert off[found.seen].mean() < 1e-3 and predicted.max() > 5e-3
    assert mean_mm(found.mesh.vertices, truth) < 4


@pytest.mark.slow
def test_what_was_not_seen_follows_the_model(body, crab_model):
    truth = bent(body, *FAR)
    scan = scan_of(body, truth, lambda points, normals: normals[:, 1] > 0)
    found = register_with_model(crab_model.subject(), scan, start=np.zeros((3, 3)), config=QUICK)
    unseen = body.with_vertices(truth).vertex_normals[:, 1] < -0.3
    assert not found.seen[unseen].any()
    assert mean_mm(found.mesh.vertices[unseen], truth[unseen]) < 8
    assert mean_mm(found.mesh.vertices[unseen], found.predicted.vertices[unseen]) < 4


def test_landmarks_alone_can_start_the_search(body, crab_model):
    truth = bent(body, *FAR) + [0.3, 0.2, 0.1]
    marks = np.array([np.argmin(body.vertices[:, 0]), np.argmax(body.vertices[:, 0]), np.argmax(body.vertices[:, 1]),
                      np.argmin(body.vertices[:, 2])])
    found = register_with_model(crab_model.subject(), scan_of(body, truth), (marks, truth[marks]), config=QUICK)
    assert mean_mm(found.mesh.vertices, truth) < 4 and found.landmark_rms < 6e-3


def test_betas_are_found_with_the_pose():
    worm = worm_model()
    rng = np.random.default_rng(1)
    pose, betas = 0.3 * random_poses(worm, 1, rng)[0], np.array([1.5, -1.0, 0.5])
    truth = worm.vertices(pose, betas, [0.02, 0, 0.01])
    sharp = replace(COARSE, fit=replace(QUICK.fit, scan_sd=0.001, landmark_sd=0.001))
    marks = np.arange(0, 398, 40)
    found = register_with_model(worm, scan_of(worm.template, truth), (marks, truth[marks]), pose, sharp)
    assert found.betas is not None and found.betas == pytest.approx(betas, abs=0.3)
    assert mean_mm(found.mesh.vertices, truth) < 5


@pytest.mark.parametrize("known", [True, False], ids=["subject", "betas"])
def test_a_body_of_another_size_has_the_same_pose_and_betas(known):
    """Points times a factor about where the root stands; derivatives agree with finite differences."""
    worm = worm_model()
    person = as_body(worm.subject([1.0, 0, 0]) if known else worm)
    large, x = ResizedBody(person, 2.5), np.random.default_rng(3).normal(0, 0.3, person.n_angles + 3 + person.n_betas)
    stand = person.subject.origin + person.split(x)[1]
    np.testing.assert_allclose(large.vertices(x) - stand, 2.5 * (person.vertices(x) - stand), atol=1e-6)
    ids = np.array([3, 50, 200, 390])
    points = large.near(ids, x)
    y, columns = points.columns(x)
    np.testing.assert_allclose(y, large.vertices(x)[ids], atol=1e-6)
    np.testing.assert_allclose(np.swapaxes(columns, 0, 2), differences(points.positions, x), atol=1e-6)
    np.testing.assert_allclose(large.fix_shape(x).vertices(x[:person.n_angles + 3]), large.vertices(x), atol=1e-6)
    own, factor = large.in_metres(x)
    np.testing.assert_allclose(person.vertices(own), factor * large.vertices(x), atol=1e-6)


@pytest.mark.parametrize("given, words", [
    ({"start": np.zeros((4, 3))}, "start: expected"),
    ({"landmarks": (np.array([5000]), np.zeros((1, 3)))}, "0..821"),
    ({"landmarks": (np.array([1, 2]), np.zeros((1, 3)))}, "landmarks: expected points of shape .2, 3."),
    ({"landmarks": (np.array([1]), np.full((1, 3), np.nan))}, "finite")])
def test_one_scan_refuses_what_it_cannot_use(body, crab_model, given, words):
    with pytest.raises(ValueError, match=words):
        register_with_model(crab_model.subject(), body, config=QUICK, **given)
