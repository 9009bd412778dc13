import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior

from model.fitting.free_space import find_camera
from model.fitting.scan import prepare_scan, spread_points
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

TOWARD = np.array([0.2, 1.0, 0.4])


@pytest.fixture(scope="module")
def body():
    model = worm_with_prior()
    return model.template.with_vertices(model.vertices(model.pose_mean))


@pytest.fixture(scope="module")
def view(body):
    return half_view(body, TOWARD, noise=0.001)


def wrong_sides(body, cloud):
    found = Surface(body).closest(cloud.points)
    return np.einsum("nd,nd->n", body.face_normals[found.faces], cloud.normals) < 0.5


def test_normals_of_a_bare_half_view_point_outward(body, view):
    cloud = prepare_scan(view[0])
    assert wrong_sides(body, cloud).mean() < 0.02
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
    assert not cloud.border.any()


def test_normals_turn_with_the_scan(view):
    R, t = rotations.exp(np.array([0.4, 1.0, -0.7])), np.array([1.0, 2, -3])
    here, there = prepare_scan(view[0]), prepare_scan(view[0] @ R.T + t)
    agree = np.einsum("nd,nd->n", here.normals @ R.T, there.normals)
    assert (agree > 0.999).mean() > 0.99


def test_a_viewpoint_turns_normals_towards_it(body, view):
    camera = body.vertices.mean(axis=0) + 3 * TOWARD / np.linalg.norm(TOWARD)
    cloud = prepare_scan(view[0], camera)
    assert (np.einsum("nd,nd->n", cloud.normals, camera - cloud.points) >= 0).all()


def border_points(body, faces):
    half = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, uses = np.unique(half, axis=0, return_counts=True)
    return body.vertices[np.unique(edges[uses == 1])]


def test_a_mesh_brings_normals_and_borders(body):
    faces = body.faces[body.corners.mean(axis=1)[:, 1] > -0.2]
    cloud = prepare_scan(Mesh(np.vstack([body.vertices, [[9, 9, 9]]]), faces))
    assert len(cloud.points) == len(np.unique(faces))                # what belongs to no triangle is dropped
    np.testing.assert_array_equal(np.sort(np.linalg.norm(cloud.points[cloud.border], axis=1)),
                                  np.sort(np.linalg.norm(border_points(body, faces), axis=1)))


@pytest.mark.parametrize("scan, message", [
    (np.zeros((0, 3)), "expected more than 16 points, got 0"),
    (np.zeros((40, 2)), r"expected points of shape \(n, 3\)"),
    (np.full((40, 3), np.nan), "40 points are not finite"),
])
def test_scans_that_cannot_be_used_are_refused(scan, message):
    with pytest.raises(ValueError, match=message):
        prepare_scan(scan)


def test_spread_points_cover_the_whole_evenly(body):
    points = body.sample(6000, np.random.default_rng(0))[0]
    kept = points[spread_points(points, 500)]
    assert 400 < len(kept) < 600
    gap = np.linalg.norm(points[:, None] - kept[None], axis=2).min(axis=1)
    assert gap.max() < 4 * np.sqrt(body.face_areas.sum() / 500)


def test_the_viewpoint_of_a_single_view_is_found(body, view):
    camera = find_camera(prepare_scan(view[0]))
    away = camera.viewpoint - view[0].mean(axis=0)
    assert away @ TOWARD / np.linalg.norm(away) / np.linalg.norm(TOWARD) > np.cos(np.radians(8))


def test_a_scan_from_all_sides_has_no_viewpoint(body):
    assert find_camera(prepare_scan(body.sample(4000, np.random.default_rng(0))[0])) is None


def test_nothing_stands_beside_or_in_front_of_what_was_seen(body, view):
    camera = body.vertices.mean(axis=0) + 3 * TOWARD / np.linalg.norm(TOWARD)
    seen_from = find_camera(prepare_scan(view[0], camera), camera)
    assert seen_from.violation(body.vertices).excess.max() < 1e-3       # the true body is nowhere denied
    middle = view[0].mean(axis=0)
    seen = view[0][np.argmin(np.linalg.norm(view[0] - middle, axis=1))]
    ahead = (camera - seen) / np.linalg.norm(camera - seen)
    up = np.cross(ahead, [1.0, 0, 0])
    points = seen + np.array([0.1 * ahead, -0.1 * ahead, 0.5 * up / np.linalg.norm(up)])
    excess, normal, target = seen_from.violation(points)
    np.testing.assert_allclose(excess[:2], [0.07, 0], atol=0.01)
    assert excess[2] > 0.2
    np.testing.assert_allclose(points - excess[:, None] * normal, target, atol=1e-12)
    assert (seen_from.violation(target).excess <= 0.3 * excess + 1e-9).all()


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_a_hollow_patch_is_turned_to_the_camera_that_saw_the_rest(share):
    rng = np.random.default_rng(0)
    n, hollow = 6000, int(share * 6000)
    ball = rng.normal(size=(n, 3))
    ball[:, 1] = -np.abs(ball[:, 1])                                     # what a camera at -y sees of a ball
    ball *= 0.3 / np.linalg.norm(ball, axis=1, keepdims=True)
    bowl = rng.normal(size=(hollow, 3)) * [0.5, 0, 0.5] + [0, 1, 0]      # and of a bowl beside it
    bowl *= 0.1 / np.linalg.norm(bowl, axis=1, keepdims=True)
    cloud = prepare_scan(np.concatenate([ball[ball[:, 1] < -0.1], bowl + [0.6, 0, 0]]))
    toward = cloud.normals[:, 1] < 0
    assert toward[cloud.points[:, 0] < 0.4].mean() > 0.98
    assert toward[cloud.points[:, 0] > 0.4].mean() > 0.98 if share < 0.1 else ~toward[cloud.points[:, 0] > 0.4].any()
