from dataclasses import replace

import numpy as np
import pytest
from completion_bodies import MEAN, worm_with_prior
from scipy.linalg import block_diag

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.follow import AnimateConfig, animate
from completion.mocap.pose.marked_body import MarkedBody, marker_weights
from completion.motion import Motion
from model.fitting import energy
from scanprep.geometry import rotations
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.storage import StorageError

FRAMES = 60
PLAIN = AnimateConfig()


@pytest.fixture(scope="module")
def subject():
    return worm_with_prior().subject(np.array([0.5, -0.5, 0.2]))


@pytest.fixture(scope="module")
def layout(subject):
    vertices = np.random.default_rng(4).choice(396, 30, replace=False)
    return MarkerLayout(tuple(f"M{i}" for i in range(30)), vertices, 0.012)


@pytest.fixture(scope="module")
def walk(subject, layout):
    """A motion that turns all the way round, and its markers, as the layout puts them on the meshes."""
    t = np.arange(FRAMES) / 100
    swing = np.sin(2 * np.pi * t[:, None, None] + np.arange(4)[:, None]) * np.array([0.05, 0.3, 0.2])
    poses = MEAN + swing
    poses[:, 0] = np.stack([0 * t, 0 * t, 7.5 * t], axis=1)          # through half a turn, where the chart ends
    trans = np.stack([1.2 * t, 0.1 * np.sin(4 * t), 0 * t], axis=1)
    meshes = subject.vertices(poses, trans)
    positions = np.stack([layout.place(subject.template.with_vertices(v)) for v in meshes])
    return meshes, MarkerSequence(positions, layout.labels, 100.0)


def surface_error(subject, motion, meshes):
    return np.linalg.norm(motion.vertices(subject) - meshes, axis=2).mean(axis=1)


def by_small_turns(x):
    """Derivative (P, P) of unknowns by turns of the joints from the right."""
    return block_diag(*rotations.inverse_right_jacobian(x[:-3].reshape(-1, 3)), np.eye(3))


def changed(sequence, positions):
    return MarkerSequence(positions, sequence.labels, sequence.rate)


def test_the_motion_comes_back_from_its_markers(subject, layout, walk):
    meshes, sequence = walk
    ticks = []
    motion = animate(subject, sequence, layout, PLAIN, lambda done, total: ticks.append((done, total)))
    assert surface_error(subject, motion, meshes).max() < 0.006
    assert motion.residuals.shape == (FRAMES, 30) and np.nanmean(motion.residuals) < 0.004
    assert motion.poses.shape == (FRAMES, 4, 3) and motion.labels == layout.labels and motion.rate == 100
    assert np.linalg.norm(motion.poses, axis=2).max() < np.pi + 0.1
    assert ticks[-1] == (FRAMES, FRAMES)


def test_a_frame_has_converged_where_the_last_round_left_it(subject, layout, walk):
    """From far beside the motion the last round still moves frames; from its end it moves none."""
    _, sequence = walk
    found = animate(subject, sequence, layout, near=animate(subject, sequence, layout))
    beside = replace(found, poses=found.poses + [0, 1.2, 0])
    assert not animate(subject, sequence, layout, near=beside).converged.all()
    assert animate(subject, sequence, layout, near=found).converged.all()


def test_a_body_ten_times_as_large_settles_as_well(subject, layout, walk):
    """The limit was 5 mm for everybody: large animals never settled, and small ones always."""
    model, (_, sequence) = worm_with_prior(), walk
    skeleton = replace(model.skeleton, joints=10 * model.skeleton.joints)
    large = replace(model, template=Mesh(10 * model.template.vertices, model.template.faces), skeleton=skeleton)
    found = animate(subject, sequence, layout, near=animate(subject, sequence, layout))
    beside = replace(found, poses=found.poses + 0.15 * np.sin(np.arange(FRAMES))[:, None, None] ** 8)
    once = animate(subject, sequence, layout, near=beside)
    again = animate(large.subject(np.array([0.5, -0.5, 0.2])), changed(sequence, 10 * sequence.positions),
                    MarkerLayout(layout.labels, layout.vertices, 0.12), AnimateConfig(marker_sd=0.1, outlier=0.6),
                    near=replace(beside, trans=10 * beside.trans))
    assert once.converged.all() and again.converged.all()
    np.testing.assert_allclose(again.poses, once.poses, atol=0.01)


def test_missing_markers_are_left_out(subject, layout, walk):
    meshes, sequence = walk
    whole = surface_error(subject, animate(subject, sequence, layout, PLAIN), meshes).mean()
    rng = np.random.default_rng(0)
    positions = sequence.positions.copy()
    for marker in rng.choice(30, 6, replace=False):                  # a fifth, for half a second each
        first = rng.integers(FRAMES - 50)
        positions[first:first + 50, marker] = np.nan
    positions[:3] = np.nan                                           # it begins before anything is seen
    motion = animate(subject, changed(sequence, positions), layout, PLAIN)
    assert surface_error(subject, motion, meshes)[3:].mean() < 1.33 * whole + 1e-3
    np.testing.assert_array_equal(np.isnan(motion.residuals), np.isnan(positions[..., 0]))
    assert np.isfinite(motion.poses).all() and not motion.converged[:3].any()


def test_smoothing_takes_noise_away(subject, layout, walk):
    meshes, sequence = walk
    noisy = changed(sequence, sequence.positions + np.random.default_rng(1).normal(0, 0.01, (FRAMES, 30, 3)))
    rough = animate(subject, noisy, layout, AnimateConfig(angle_acceleration=1e5, published=True))
    smooth = animate(subject, noisy, layout)
    assert surface_error(subject, smooth, meshes).mean() < 0.9 * surface_error(subject, rough, meshes).mean()

    def jerk(motion):
        return np.abs(np.diff(motion.vertices(subject), 3, axis=0)).mean()

    assert jerk(smooth) < 0.3 * jerk(rough)


@pytest.fixture(scope="module")
def body(subject, layout):
    return MarkedBody(subject, layout, PLAIN.prior_weight, PLAIN.prior_shrinkage)


def test_one_smoothing_step_is_the_dense_gauss_newton_step(body, walk):
    targets, stiffness = walk[1].positions[:5], PLAIN.inertia(100.0, 15)
    x = np.random.default_rng(0).normal(0, 0.05, (5, 15))            # small angles: rotations add
    weights, _ = marker_weights(body.positions(x), targets, PLAIN.marker_sd, PLAIN.outlier)
    rows, values = [], []
    for t in range(5):
        prior = energy.pose_prior_term(x[t][None], body.prior, PLAIN.prior_weight)
        markers = body.shapes.columns(x[t, :-3].reshape(1, 4, 3), x[t, -3:][None])[1][0]              # (15, 3, 30)
        root = np.sqrt(weights[t])
        residual = root * (body.positions(x[t]) - targets[t]).T
        for jacobian, value in (((root * markers).reshape(15, -1).T, residual.ravel()),
                                (prior.jacobian[0] @ by_small_turns(x[t]), prior.values[0])):
            block = np.zeros((value.size, 75))
            block[:, 15 * t:15 * t + 15] = jacobian
            rows.append(block)
            values.append(value)
    D = np.kron(np.array([[1, -2, 1, 0, 0], [0, 1, -2, 1, 0], [0, 0, 1, -2, 1.0]]), np.diag(np.sqrt(stiffness)))
    rows.append(D)
    values.append((np.sqrt(stiffness) * np.diff(body.step_to(x[:-1], x[1:]), axis=0)).ravel())
    step = -np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0].reshape(5, 15)
    got = body.smooth_step(x, stiffness, body.system, targets, weights)
    assert np.abs(step).max() > 0.01
    np.testing.assert_allclose(got[:, -3:] - x[:, -3:], step[:, -3:], atol=1e-5)


def test_a_layout_that_shares_too_few_labels_is_refused(subject, layout, walk):
    sequence = MarkerSequence(walk[1].positions[:, :5], ("M0", "M1", "X", "Y", "Z"), 100.0)
    with pytest.raises(ValueError, match="expected at least 3 markers of the layout, found 2"):
        animate(subject, sequence, layout)
    blind = changed(walk[1], np.where(np.arange(30)[:, None] < 2, walk[1].positions, np.nan))
    with pytest.raises(ValueError, match="expected a frame with at least 3 known markers, the best has 2"):
        animate(subject, blind, layout)
    other = MarkerLayout(("M0", "M1", "M2"), np.array([1, 2, 9999]))
    with pytest.raises(ValueError, match=r"expected vertices of 0\.\.397, got 9999"):
        animate(subject, walk[1], other)


@pytest.fixture
def motion():
    rng = np.random.default_rng(0)
    residuals = rng.random((6, 2))
    residuals[1, 1] = np.nan
    return Motion(rng.normal(size=(6, 4, 3)), rng.normal(size=(6, 3)), np.array([0.1, -2]), 120.0, residuals,
                  ("LSHO", "RSHO"), "male", np.arange(6) > 0, residuals > 0.5)


def test_a_motion_is_read_as_it_was_written(motion, tmp_path):
    motion.save(tmp_path / "walk.npz")
    back = Motion.load(tmp_path / "walk.npz")
    for name in ("poses", "trans", "betas", "residuals", "converged", "trusted"):
        np.testing.assert_array_equal(getattr(back, name), getattr(motion, name))
    assert (back.rate, back.labels, back.gender) == (120.0, ("LSHO", "RSHO"), "male")
    with np.load(tmp_path / "walk.npz", allow_pickle=False) as data:
        assert data["poses"].shape == (6, 12) and str(data["surface_model_type"]) == "scape"
        assert float(data["mocap_frame_rate"]) == 120


def test_a_motion_with_the_other_spelling_of_its_rate_is_read(tmp_path):
    np.savez(tmp_path / "m.npz", poses=np.zeros((2, 9)), trans=np.zeros((2, 3)), betas=np.zeros(0),
             mocap_framerate=60, surface_model_type="scape")
    back = Motion.load(tmp_path / "m.npz")
    assert back.rate == 60 and back.poses.shape == (2, 3, 3) and back.betas is None and back.labels == ()


@pytest.mark.parametrize("content, message", [
    ({"poses": np.zeros((2, 9))}, "it lacks trans"),
    ({"poses": np.zeros((2, 9)), "trans": np.zeros((2, 3)), "surface_model_type": "other"},
     "expected surface_model_type 'scape', found 'other'"),
    ({"poses": np.zeros((2, 9)), "trans": np.zeros((3, 3)), "surface_model_type": "scape", "mocap_frame_rate": 1},
     "trans: expected shape"),
])
def test_files_that_are_no_motion_are_refused(tmp_path, content, message):
    np.savez(tmp_path / "m.npz", **content)
    with pytest.raises(StorageError, match=message):
        Motion.load(tmp_path / "m.npz")
