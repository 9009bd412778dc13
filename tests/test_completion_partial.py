from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MARKS, POSE, TRANS, half_view, worm_with_prior

from completion.partial.completion import complete
from completion.partial.settings import CompletionConfig
from model.fitting.bodies import FixedBody
from model.fitting.free_space import Contact
from model.fitting.limbs import limb_runs, redrawn
from model.priors import FLOOR, gaussian_prior
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

BETAS = np.array([1.2, -0.8, 0.5])
QUICK = CompletionConfig(random_starts=12, rounds=6, scan_points=800, model_points=300)


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


def case(model, betas, noise=0.001):
    body = model.template.with_vertices(model.vertices(POSE, betas, TRANS))
    points, seen = half_view(body, np.array([0.3, -1, 0.5]), noise=noise)
    return body, points, seen, (MARKS, body.vertices[MARKS])


def errors(body, result, seen):
    distance = np.linalg.norm(result.completed.vertices - body.vertices, axis=1)
    near = Surface(body).closest(result.completed.vertices[seen]).distances
    return near.mean(), distance[~seen].mean()


@pytest.fixture(scope="module")
def known(model):
    body, points, seen, landmarks = case(model, None)
    ticks = []
    result = complete(model.subject(None), points, landmarks, QUICK, lambda done, total: ticks.append((done, total)))
    return body, points, seen, landmarks, result, ticks


def test_half_a_scan_gives_the_whole_body(known):
    body, _, seen, _, result, _ = known
    at_seen, at_unseen = errors(body, result, seen)
    assert at_seen < 0.002 and at_unseen < 0.008
    np.testing.assert_allclose(result.trans, TRANS, atol=0.01)
    assert result.rms < 0.003 and result.explained > 0.97 and result.landmark_rms < 0.01
    assert result.converged and result.betas is None and result.iterations > 0
    assert (result.seen == seen).mean() > 0.85                       # the rim may go either way
    assert set(result.energies) >= {"landmarks", "pose_prior", "scan_planes"}


def test_the_completed_mesh_follows_the_scan_where_the_model_cannot(model, known):
    """A dent that no pose of the model makes is there in the completed mesh and not in the predicted one."""
    body, points, _, landmarks, _, _ = known
    middle = points[np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1))]
    dent = 0.012 * np.exp(-((points - middle)**2).sum(axis=1) / 0.15**2)
    inward = Surface(body).closest(points)
    dented = points - dent[:, None] * body.face_normals[inward.faces]
    result = complete(model.subject(None), dented, landmarks, QUICK)
    deep = dent > 0.008

    def at(mesh):
        return Surface(mesh).closest(dented[deep]).distances.mean()

    assert at(result.completed) < 0.003 < 0.006 < at(result.predicted)


def test_a_mesh_with_borders_serves_as_scan(model, known):
    body, _, seen, landmarks, _, _ = known
    view, _ = body.submesh(seen[body.faces].all(axis=1))
    result = complete(model.subject(None), view, landmarks, QUICK)
    assert max(errors(body, result, seen)) < 0.01


def test_unknown_shape_is_found_with_the_pose(model):
    body, points, seen, landmarks = case(model, BETAS)
    result = complete(model, points, landmarks, QUICK)
    at_seen, at_unseen = errors(body, result, seen)
    assert at_seen < 0.002 and at_unseen < 0.012
    assert result.betas.shape == (3,)
    stranger = complete(model.subject(-BETAS), points, landmarks, QUICK)
    assert errors(body, stranger, seen)[1] > 2 * at_unseen           # the shape it found is worth something
    np.testing.assert_array_equal(stranger.betas, -BETAS)


def test_the_same_scan_gives_the_same_body(model, known):
    _, points, _, landmarks, result, _ = known
    again = complete(model.subject(None), points, landmarks, QUICK)
    np.testing.assert_array_equal(again.completed.vertices, result.completed.vertices)


def test_a_scan_turned_and_moved_gives_the_body_turned_and_moved(model, known):
    _, points, _, (marks, at), result, _ = known
    R, t = rotations.exp(np.array([0.7, -1.1, 0.4])), np.array([3.0, -2, 1])
    moved = complete(model.subject(None), points @ R.T + t, (marks, at @ R.T + t), QUICK)
    off = np.linalg.norm(moved.completed.vertices - (result.completed.vertices @ R.T + t), axis=1)
    assert off.mean() < 0.004


@pytest.mark.parametrize("change, message", [
    (lambda v, p: (v[:2], p[:2]), "at least 3 different ones, got 2"),
    (lambda v, p: (np.r_[v[:6], 9999], p), "expected vertices of 0..397"),
    (lambda v, p: (v, p[:5]), "expected points of shape .7, 3."),
    (lambda v, p: (v.astype(float), p), "expected vertex numbers"),
    (lambda v, p: (v, 1000 * p), "expected the scan in metres"),
    (lambda v, p: (v, np.where(np.arange(7)[:, None] == 3, np.nan, p)), "expected finite points"),
])
def test_landmarks_that_cannot_be_used_are_refused(model, known, change, message):
    _, points, _, landmarks, _, _ = known
    with pytest.raises(ValueError, match=message):
        complete(model.subject(None), points, change(*landmarks))


def test_an_empty_scan_is_refused(model, known):
    with pytest.raises(ValueError, match="scan: expected more than 16 points, got 0"):
        complete(model.subject(None), Mesh(np.zeros((0, 3)), np.zeros((0, 3))), known[3])


def test_a_body_as_small_as_a_hand_is_completed_as_well_as_a_large_one(model):
    """Distances of matches and limits are those of a person, so a worm of 15 cm is searched at that size."""
    small = replace(model, template=model.template.with_vertices(model.template.vertices / 20),
                    skeleton=replace(model.skeleton, joints=model.skeleton.joints / 20))
    body, subject = small.template.with_vertices(small.vertices(POSE, None, TRANS)), small.subject(None)
    points, seen = half_view(body, np.array([0.3, -1, 0.5]))
    result = complete(subject, points, None, QUICK)
    at_seen, at_unseen = errors(body, result, seen)
    assert 20 * at_seen < 0.002 and 20 * at_unseen < 0.012
    assert at_unseen < result.expected_error[~seen].mean() < 0.012 / 20
    # a fit that goes on starts where the first one ended
    again = complete(subject, points, None, QUICK, start=result)
    np.testing.assert_allclose(again.trans, result.trans, atol=2e-4)
    assert again.scale == pytest.approx(1) and errors(body, again, seen)[1] < 1.1 * at_unseen


def test_limbs_are_drawn_from_the_prior_given_the_rest(model):
    body = FixedBody(model.subject(None))
    covariance = np.zeros((12, 12))
    root = np.random.default_rng(0).normal(size=(9, 9))
    covariance[3:, 3:] = root @ root.T / 20
    prior = gaussian_prior(model.pose_mean, covariance - FLOOR**2 * np.diag(np.arange(12) > 2), 0)
    x = np.random.default_rng(1).normal(0, 0.3, 15)
    assert limb_runs(model.skeleton) == [[2, 3], [1]]
    drawn = redrawn(body, x, 2, prior, 20000, np.random.default_rng(2))
    moved, rest = np.arange(6, 12), np.arange(3, 6)
    np.testing.assert_array_equal(drawn[:, [0, 1, 2, 3, 4, 5, 12, 13, 14]], np.tile(x[[0, 1, 2, 3, 4, 5, 12, 13, 14]],
                                                                                    (20000, 1)))
    gain = covariance[np.ix_(moved, rest)] @ np.linalg.inv(covariance[np.ix_(rest, rest)])
    mean = prior.mean[moved] + gain @ (x[rest] - prior.mean[rest])
    wanted = covariance[np.ix_(moved, moved)] - gain @ covariance[np.ix_(rest, moved)]
    np.testing.assert_allclose(drawn[:, moved].mean(axis=0), mean, atol=0.03)
    np.testing.assert_allclose(np.cov(drawn[:, moved].T), wanted, atol=0.04)


def test_a_part_inside_another_is_pushed_out(model):
    subject, part = model.subject(None), model.skeleton.part_of_vertex(model.template)
    rest = model.template.with_vertices(subject.vertices(np.zeros((4, 3))))
    contact = Contact(model.skeleton, part, rest.vertices, rest.vertex_normals)
    assert contact.violation(rest.vertices, rest.vertex_normals)[0].max() == 0
    moved = rest.vertices.copy()
    moved[part == 3] += rest.vertices[part == 0].mean(axis=0) - rest.vertices[part == 3].mean(axis=0)
    mesh = rest.with_vertices(moved)
    depth, normal, target = contact.violation(mesh.vertices, mesh.vertex_normals)
    inside = (part == 3) & (depth > 0)
    assert inside.sum() > 0.5 * (part == 3).sum() and not depth[(part == 1) | (part == 2)].any()
    np.testing.assert_allclose(target, mesh.vertices + depth[:, None] * normal)
    # what is inside at rest, as bones of a finger with a short one between, says nothing
    folded = Contact(model.skeleton, part, mesh.vertices, mesh.vertex_normals)
    assert not folded.violation(mesh.vertices, mesh.vertex_normals).excess.any()
