from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import half_view, worm_with_prior
from test_completion_partial import MARKS, QUICK

from completion import Motion, TrackConfig, smoothing, track
from completion.smoothing import inertia, predict, smooth_frames
from completion.tracking.frames import prepare_frame
from completion.tracking.sequence import BodyTracker
from scanprep.batch.values import load_value, save_value
from scanprep.geometry import rotations
from scanprep.geometry.files import PointCloud
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface

RATE, FRAMES = 30.0, 18
BETAS = np.array([1.2, -0.8, 0.5])
SETTINGS = TrackConfig(frame_points=700, shape_frames=6, start=QUICK)


@pytest.fixture(scope="module")
def model():
    return worm_with_prior()


def motion(frames=FRAMES):
    """Poses (T, 4, 3) that turn as a whole beyond a half turn while the joints swing, and trans (T, 3)."""
    t = np.arange(frames) / RATE
    poses = np.zeros((frames, 4, 3))
    poses[:, 0] = np.array([0.0, 0.0, 1.0]) * (2.9 + 0.9 * t)[:, None]
    poses[:, 1:] = 0.35 * np.sin(5 * t[:, None, None] + np.arange(9).reshape(3, 3))
    return poses, np.stack([0.8 * t, 0.3 * np.sin(3 * t), 1.0 + 0 * t], axis=1)


def record(bodies, noise=0.002):
    """Two cameras on opposite sides."""
    return [[half_view(body, side, count=900, noise=noise, seed=2 * i + k)[0] for k, side in
             enumerate(np.array([[0.2, -1, 0.4], [-0.3, 1, 0.3]]))] for i, body in enumerate(bodies)]


def bodies_of(model, betas):
    poses, trans = motion()
    return [model.template.with_vertices(v) for v in model.subject(betas).vertices(poses, trans)]


@pytest.fixture(scope="module")
def known(model):
    bodies = bodies_of(model, None)
    return bodies, record(bodies)


def errors(model, found, bodies):
    """Distance of vertices to their true places; a round limb may turn about itself unseen."""
    vertices = found.vertices(model.subject(found.betas))
    return np.array([np.linalg.norm(v - b.vertices, axis=1).mean() for v, b in zip(vertices, bodies, strict=True)])


def off(model, found, bodies):
    """Distance to the true surface."""
    vertices = found.vertices(model.subject(found.betas))
    return np.array([Surface(b).closest(v).distances.mean() for v, b in zip(vertices, bodies, strict=True)])


def test_a_known_body_is_followed_through_a_half_turn(model, known):
    bodies, frames = known
    ticks, surfaces = [], []
    found = track(model.subject(None), frames, SETTINGS, (MARKS, bodies[0].vertices[MARKS]), rate=RATE,
                  progress=lambda done, total: ticks.append((done, total)),
                  surfaces=lambda i, mesh: surfaces.append((i, mesh)))
    assert isinstance(found, Motion) and found.converged.all() and found.betas is None and found.rate == RATE
    assert off(model, found, bodies).max() < 0.005 and errors(model, found, bodies).mean() < 0.01
    assert found.labels == ("surface",) and (found.residuals < 0.004).all() and (found.residuals > 0.0005).all()
    assert ticks == [(i + 1, FRAMES) for i in range(FRAMES)] and [i for i, _ in surfaces] == list(range(FRAMES))
    far = [Surface(bodies[i]).closest(mesh.vertices).distances.mean() for i, mesh in surfaces]
    assert max(far) < 0.006


@pytest.mark.slow
def test_a_gap_and_a_jump_are_survived(model, known):
    bodies, frames = known
    frames = [None if 6 <= i < 9 else views for i, views in enumerate(frames)]
    jump = np.array([1.5, 0.4, -0.3])
    frames[13:] = [[view + jump for view in views] for views in frames[13:]]
    found = track(model.subject(None), frames, SETTINGS, (MARKS, bodies[0].vertices[MARKS]), rate=RATE)
    assert not found.converged[6:9].any() and np.isnan(found.residuals[6:9]).all()
    assert found.converged[[*range(6), *range(9, 13), *range(15, FRAMES)]].all()
    lag = off(model, found, bodies)
    assert lag[:6].max() < 0.005 and lag[6:9].max() < 0.03 and lag[9:12].max() < 0.008
    assert off(model, replace(found, trans=found.trans - jump), bodies)[16:].max() < 0.008


def test_an_unknown_shape_is_found_from_the_first_frames(model):
    bodies = bodies_of(model, BETAS)
    frames = [None, *record(bodies)[:9]]
    stream = iter(frames)
    found = track(model, stream, SETTINGS, (MARKS, bodies[0].vertices[MARKS]), rate=RATE)
    assert len(found.poses) == 10 and not found.converged[0] and found.converged[1:].all()
    assert np.linalg.norm(found.betas - BETAS) < 0.6
    assert off(model, found, [bodies[0], *bodies[:9]])[1:].max() < 0.006
    assert off(model, found, [bodies[0], *bodies[:9]])[0] < 0.02         # stands where it is first seen


def test_frames_are_taken_one_by_one(model, known):
    bodies, frames = known
    taken, done = [], []

    def camera():
        for i, views in enumerate(frames[:4]):
            taken.append(i)
            yield [PointCloud(view) for view in views]

    track(model.subject(None), camera(), replace(SETTINGS, smoothing=0), (MARKS, bodies[0].vertices[MARKS]),
          progress=lambda i, total: done.append((i, total, len(taken))))
    assert done == [(i, i, i) for i in range(1, 5)]


@pytest.mark.slow
def test_a_tracker_that_goes_on_from_what_another_knew_ends_the_same(model, tmp_path):
    """Before the shape is known, right after, and between frames that are searched from scratch."""
    bodies = bodies_of(model, BETAS)
    settings = replace(SETTINGS, shape_frames=3, start=replace(QUICK, random_starts=3))
    frames = [None, *record(bodies[:8])]
    frames[4:8] = [[view * [1, 1, 0.3] for view in views] for views in frames[4:8]]     # nothing the body could be
    marks = MARKS, bodies[0].vertices[MARKS]
    first = BodyTracker(model, settings, RATE, marks)
    done, states = [], [first.state]
    for frame in frames:
        done += first.push(frame)
        states.append(first.state)
    done += first.finish()
    assert [f.found for f in done] == [False, *[True] * 3, *[False] * 4, True]
    assert states[2].kept and not states[2].shape_known and states[3].shape_known
    assert states[4].random_state != states[6].random_state
    for cut, end in ((1, 4), (2, 4), (6, 9)):
        save_value(tmp_path / "state.npz", states[cut], {})
        other = BodyTracker(model, settings, RATE, marks)
        other.resume(load_value(tmp_path / "state.npz"))
        rest = [f for frame in frames[cut:end] for f in other.push(frame)] + other.finish()
        assert rest[-1].number == end - 1
        for found in rest:
            same(found, done[found.number])
        np.testing.assert_array_equal(other.state.betas, first.state.betas)
        assert other.state.random_state == states[end].random_state


def same(ours, theirs):
    """Bit by bit."""
    for name in ("number", "x", "found", "residual", "explained", "gradient", "precision"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), name)


def test_a_sequence_without_anything_is_refused(model):
    with pytest.raises(ValueError, match="at least one that shows something"):
        track(model.subject(None), [None, np.zeros((0, 3)), []], SETTINGS)
    with pytest.raises(ValueError, match="rate"):
        track(model.subject(None), [], SETTINGS, rate=0)
    with pytest.raises(ValueError, match=r"view 1.*\(n, 3\)"):
        track(model.subject(None), [[np.zeros((50, 3)), np.zeros((50, 4))]], SETTINGS)


def test_prediction_is_exact_at_constant_velocity():
    x = np.stack([np.r_[0.5 * (t + 1) * np.array([1.0, 2, 2]) / 3, 0.2 * t, 0, -t] for t in range(8)])
    for t in range(2, 8):
        ahead = predict(x[t - 1], x[t - 2], 1.0)
        np.testing.assert_allclose(rotations.exp(ahead[:3]), rotations.exp(x[t, :3]), atol=1e-12)
        np.testing.assert_allclose(ahead[3:], x[t, 3:], atol=1e-12)
    np.testing.assert_array_equal(predict(x[3], x[3], 1.0)[3:], x[3, 3:])


def test_smoothing_is_the_least_squares_solution(monkeypatch):
    """For the place alone the problem is linear: a dense solve must agree, also where windows meet."""
    monkeypatch.setattr(smoothing, "WINDOW", 100)
    rng, T = np.random.default_rng(1), 240
    x = np.zeros((T, 6))
    x[:, 3:] = np.cumsum(rng.normal(0, 0.01, (T, 3)), axis=0)
    root = rng.normal(size=(T, 6, 6))
    precision = 1e3 * root @ np.swapaxes(root, 1, 2)
    precision[:, :3, 3:] = precision[:, 3:, :3] = 0
    gradient = np.zeros((T, 6))
    gradient[:, 3:] = rng.normal(0, 20, (T, 3))
    weights = inertia(6, RATE, 60.0, 15.0)
    D = np.zeros((T - 2, T))
    for i in range(T - 2):
        D[i, i:i + 3] = 1, -2, 1
    A = np.kron(D.T @ D, np.diag(weights[3:]))
    rhs = A @ x[:, 3:].ravel() + gradient[:, 3:].ravel()
    for t in range(T):
        A[3 * t:3 * t + 3, 3 * t:3 * t + 3] += precision[t, 3:, 3:]
    wanted = x[:, 3:] - np.linalg.solve(A, rhs).reshape(T, 3)
    out = smooth_frames(x, gradient, precision, weights, 1)
    np.testing.assert_allclose(out[:, 3:], wanted, atol=1e-6)
    np.testing.assert_array_equal(smooth_frames(x[:2], gradient[:2], precision[:2], weights, 1), x[:2])


@pytest.mark.parametrize("known_by", ["triangles", "normals", "viewpoint", "expected", "form"])
def test_normals_of_noisy_points_stand_off_the_body(model, known_by):
    body, toward = model.template, np.array([0.1, -1, 0.3])
    camera = body.vertices.mean(axis=0) + 3 * toward / np.linalg.norm(toward)
    points, _ = half_view(body, toward, count=3000, noise=0.004)
    true = Surface(body).closest(points)
    given = body.face_normals[true.faces]
    frame = {"normals": PointCloud(points, given), "triangles": np.hstack([points, given])}.get(known_by, points)
    cloud = prepare_frame(frame, 600, camera if known_by == "viewpoint" else None,
                          body if known_by == "expected" else None)
    assert 500 < len(cloud.points) < 700 and (cloud.view == 0).all() and 0.01 < cloud.spacing < 0.06
    near = Surface(body).closest(cloud.points)
    cosine = np.einsum("nd,nd->n", cloud.normals, body.face_normals[near.faces])
    assert np.median(cosine) > 0.97 and (cosine < 0).mean() < 0.02
    to = (camera - cloud.points) / np.linalg.norm(camera - cloud.points, axis=1, keepdims=True)
    seen_from = np.einsum("nd,nd->n", cloud.normals, to)
    assert cloud.border[seen_from < 0.3].mean() > 3 * cloud.border[seen_from > 0.7].mean()


def test_points_that_are_not_finite_are_left_out(model):
    points = half_view(model.template, np.array([0.1, -1, 0.3]), count=1500)[0]
    holes = np.vstack([np.full((500, 3), np.nan), points])
    np.testing.assert_array_equal(prepare_frame(holes, 400, expected=model.template).points,
                                  prepare_frame(points, 400, expected=model.template).points)
    assert prepare_frame(points[:20], 400) is None and prepare_frame(None, 400) is None
    assert prepare_frame([Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)), points[:10]], 400) is None
