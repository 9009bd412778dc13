"""Several views of one body, points with normals, scans of unknown unit."""
from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MARKS, POSE, QUICK, TRANS, half_view, worm_with_prior
from derivatives import differences

from completion.partial.completion import complete
from model.fitting.bodies import as_body
from model.fitting.free_space import find_cameras, free_space_violation
from model.fitting.scale import LOOSE, ScaledBody, landmark_scale, rough_scale
from model.fitting.scan import prepare_scan
from scanprep.geometry.files import PointCloud
from scanprep.geometry.surface import Surface

BETAS = np.array([1.2, -0.8, 0.5])
FROM = (np.array([0.3, -1, 0.5]), np.array([-0.9, 0.6, 0.1]))


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


@pytest.fixture(scope="module")
def body(model):
    return model.template.with_vertices(model.vertices(POSE, None, TRANS))


@pytest.fixture(scope="module")
def views(body):
    return [half_view(body, toward, count=3000, noise=0.001) for toward in FROM]


def cameras(body):
    return np.array([body.vertices.mean(axis=0) + 3 * toward / np.linalg.norm(toward) for toward in FROM])


def outward(body, cloud):
    found = Surface(body).closest(cloud.points)
    return (np.einsum("nd,nd->n", body.face_normals[found.faces], cloud.normals) > 0.5).mean()


def test_two_views_are_one_scan(body, views):
    scan = prepare_scan([points for points, _ in views])
    assert scan.views == 2 and outward(body, scan) > 0.98
    np.testing.assert_array_equal(scan.points, np.vstack([points for points, _ in views]))
    np.testing.assert_array_equal(scan.index, np.arange(len(scan.points)))
    np.testing.assert_array_equal(np.bincount(scan.view), [len(points) for points, _ in views])
    thin = scan.thin(500)
    np.testing.assert_array_equal(scan.points[np.isin(scan.index, thin.index)], thin.points)


def test_a_border_is_none_where_another_view_goes_on(body):
    x = body.vertices[body.faces].mean(axis=1)[:, 0]
    low, high = np.quantile(x, [0.4, 0.6])
    left, right = (body.submesh(keep)[0] for keep in (x < high, x > low))
    whole = prepare_scan([left, right])
    assert prepare_scan(left).border.any() and not whole.border.any()
    apart = body.submesh(x < low)[0], body.submesh(x > high)[0]
    assert prepare_scan(apart).border.sum() == sum(prepare_scan(part).border.sum() for part in apart)


def test_two_views_complete_what_one_leaves_open(model, body, views):
    marks = (MARKS, body.vertices[MARKS])
    subject = model.subject(None)
    both = complete(subject, [points for points, _ in views], marks, QUICK)
    one = complete(subject, views[0][0], marks, QUICK)
    apart = [np.linalg.norm(result.completed.vertices - body.vertices, axis=1) for result in (both, one)]
    second = views[1][1] & ~views[0][1]
    assert both.seen.mean() > 0.75 > one.seen.mean() and both.scale == 1
    assert apart[0].mean() < 0.004 and apart[0][second].mean() < 0.9 * apart[1][second].mean()


def test_every_view_has_its_own_camera(body, views):
    points = [points for points, _ in views]
    known = find_cameras(prepare_scan(points, cameras(body)))
    assert len(known) == 2
    for camera, at, mine in zip(known, cameras(body), points, strict=True):
        np.testing.assert_array_equal(camera.viewpoint, at)
        np.testing.assert_array_equal(camera.points, mine)
    found = find_cameras(prepare_scan(points))
    for camera, toward in zip(found, FROM, strict=True):
        away = camera.viewpoint - body.vertices.mean(axis=0)
        assert away @ toward / np.linalg.norm(away) / np.linalg.norm(toward) > np.cos(np.radians(15))


def test_what_one_camera_denies_is_denied(body, views):
    both = find_cameras(prepare_scan([points for points, _ in views], cameras(body)))
    places = body.vertices + np.random.default_rng(0).normal(0, 0.15, body.vertices.shape)
    excess, normal, target = free_space_violation(both, places)
    single = [camera.violation(places) for camera in both]
    np.testing.assert_array_equal(excess, np.maximum(single[0][0], single[1][0]))
    np.testing.assert_allclose(target, places - excess[:, None] * normal, atol=1e-12)
    assert free_space_violation(both, body.vertices).excess.max() < 2e-3
    assert (excess > 0).sum() > max((one[0] > 0).sum() for one in single)


def test_normals_that_are_given_are_used(body):
    points, face, _ = body.sample(2000, np.random.default_rng(0))
    normals = body.face_normals[face]
    for scan in (PointCloud(points, 2.5 * normals), np.hstack([points, normals])):
        np.testing.assert_allclose(prepare_scan(scan).normals, normals, atol=1e-12)


def test_normals_of_mixed_sign_are_turned_outward_and_missing_ones_estimated(body, views):
    points = views[0][0]
    normals = body.face_normals[Surface(body).closest(points).faces]
    flips = np.where(np.random.default_rng(0).random(len(points)) < 0.5, -1, 1)
    assert outward(body, prepare_scan(PointCloud(points, flips[:, None] * normals))) > 0.98
    holes = normals.copy()
    holes[::7], holes[3::7] = 0, np.nan
    cloud = prepare_scan(PointCloud(points, holes))
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
    assert (np.einsum("nd,nd->n", cloud.normals, normals) > 0.9).mean() > 0.97


@pytest.mark.parametrize("scan, viewpoint, message", [
    ([], None, "at least one view, got none"),
    ([np.random.default_rng(0).normal(size=(40, 3)), np.full((40, 3), np.inf)], None,
     "view 1: 40 points are not finite"),
    ([np.random.default_rng(0).normal(size=(40, 3)), np.zeros((40, 4))], None,
     r"view 1: expected points of shape \(n, 3\), or \(n, 6\)"),
    (PointCloud(np.zeros((40, 3)), np.zeros((39, 3))), None, "expected one normal for each of 40 points"),
    ([np.eye(3)] * 2, np.zeros((3, 3)), r"viewpoint: expected 3 finite numbers, or 3 for each of the 2 views"),
])
def test_views_that_cannot_be_used_are_refused(scan, viewpoint, message):
    with pytest.raises(ValueError, match=message):
        prepare_scan(scan, viewpoint)


# ---- scans of unknown unit


@pytest.mark.parametrize("shape", [None, "free"])
def test_a_scaled_body_moves_as_its_derivative_says(model, shape):
    scaled = ScaledBody(as_body(model.subject(None) if shape is None else model))
    rng = np.random.default_rng(3)
    x = np.concatenate([POSE.ravel(), TRANS, 0.1 * rng.normal(size=scaled.n_betas - 1), [0.7]])
    follow = scaled.follow(MARKS, x)
    at, J = follow(x[None]).positions[0], follow(x[None]).jacobian[0]
    np.testing.assert_allclose(at, scaled.vertices(x)[MARKS], atol=1e-9 if shape is None else 2e-3)
    np.testing.assert_allclose(J, differences(lambda x: follow(x[None]).positions[0], x), atol=1e-7)


def test_a_scaled_body_in_metres_is_the_body(model):
    inner = as_body(model)
    scaled = ScaledBody(inner)
    x = np.concatenate([POSE.ravel(), TRANS, BETAS, [-0.6]])
    real, factor = scaled.in_metres(x)
    assert factor == pytest.approx(np.exp(-0.6 * LOOSE))
    np.testing.assert_allclose(inner.vertices(real), factor * scaled.vertices(x), atol=1e-12)
    held = scaled.fix_shape(x)
    np.testing.assert_allclose(held.vertices(x[:15]), scaled.vertices(x), atol=1e-6)


@pytest.mark.slow
def test_the_unit_is_found_with_the_pose(model, body, views):
    """The same answer whatever the unit is, and right to a few hundredths."""
    points, marks = views[0][0], body.vertices[MARKS]
    config = replace(QUICK, free_scale=True)
    results = [(f, complete(model.subject(None), points / f, (MARKS, marks / f), config))
               for f in (0.001, 0.0254, 1.7)]
    for factor, result in results:
        assert result.scale / factor == pytest.approx(1, abs=0.03)
        off = np.linalg.norm(result.completed.vertices * factor / result.scale - body.vertices, axis=1)
        assert off.mean() < 0.015
        assert np.linalg.norm(result.predicted.vertices[MARKS] - result.scale / factor * marks, axis=1).max() < 0.03
    np.testing.assert_allclose([r.scale / f for f, r in results], results[0][1].scale / 0.001, rtol=1e-6)


def test_unit_and_shape_are_found_together(model):
    person = model.template.with_vertices(model.vertices(POSE, BETAS, TRANS))
    points, _ = half_view(person, FROM[0], count=3000, noise=0.001)
    result = complete(model, points / 0.01, (MARKS, person.vertices[MARKS] / 0.01), replace(QUICK, free_scale=True))
    assert result.scale / 0.01 == pytest.approx(1, abs=0.08) and result.betas.shape == (3,)
    off = np.linalg.norm(result.completed.vertices * 0.01 / result.scale - person.vertices, axis=1)
    assert off.mean() < 0.02


def test_how_far_a_scan_extends_says_roughly_how_large_it_is(model, body, views):
    posed = as_body(model.subject(None))
    rough = [rough_scale(posed, points) for points in (views[0][0], 40 * views[0][0], body.vertices)]
    assert rough[1] == pytest.approx(rough[0] / 40, rel=1e-6)
    assert 0.75 < rough[0] < 1.3 and 0.8 < rough[2] < 1.25
    assert landmark_scale(posed, MARKS, body.vertices[MARKS] / 1.2, QUICK) == pytest.approx(1.2, rel=0.05)
