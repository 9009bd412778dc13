"""What every kind of body model must do, whatever it is made of; the kinds are listed in `conformance_bodies`."""
from dataclasses import replace

import numpy as np
import pytest
import toy_kind
from completion_bodies import half_view
from conformance_bodies import KINDS, scape_worm, stiff_bodies
from derivatives import differences
from model_bodies import random_poses

from completion.mocap.files.markers import MarkerSequence
from completion.mocap.marker_sets.layout import MarkerLayout
from completion.mocap.pose.follow import animate
from completion.partial.completion import complete
from completion.partial.settings import CompletionConfig
from model import files
from model.body import BodyModel
from model.cli import group
from model.files import load_model
from model.fitting.vertices import FitConfig, fit_pose, fit_shape
from model.resolution.change import resolution_gap
from scanprep.geometry import rotations, storage
from scanprep.geometry.surface import Surface

BETAS = np.array([0.7, -1.2, 0.4])
BODIES = pytest.mark.parametrize("betas", [None, BETAS, BETAS[:2]], ids=["own", "three betas", "two betas"])


@pytest.fixture(scope="module", params=list(KINDS))
def model(request):
    with pytest.MonkeyPatch.context() as patch:
        for kind, line in toy_kind.TABLE.items():
            patch.setitem(files.KINDS, kind, line)
        yield KINDS[request.param]()


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def at_random(model, rng, count, size=0.5):
    return random_poses(model, count, rng, size), rng.normal(size=(count, 3))


def test_it_says_what_it_is(model):
    assert isinstance(model, BodyModel) and model.n_betas == 3
    assert model.kind in repr(model).lower() and len(repr(model)) < 200
    assert (np.diff(model.explained) >= 0).all() and model.explained[-1] == pytest.approx(1)


def test_at_rest_it_is_the_template(model):
    rest = np.zeros((4, 3))
    for y in (model.vertices(rest), model.vertices(rest, None, np.zeros(3)), model.subject().vertices(rest)):
        np.testing.assert_allclose(y, model.template.vertices, rtol=0, atol=1e-9)


@BODIES
@pytest.mark.parametrize("size", [0.0, 0.5, 2.5])                # at rest, usual, and beyond π
def test_fast_path_is_the_exact_one(model, rng, betas, size):
    poses, trans = at_random(model, rng, 4, size)
    exact = model.vertices(poses, betas, trans)
    assert np.abs(exact - model.template.vertices).max() > 0.01
    np.testing.assert_allclose(model.subject(betas).vertices(poses, trans), exact, rtol=0, atol=1e-12)
    single = model.subject(betas, dtype=np.float32).vertices(poses, trans)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, exact, rtol=0, atol=2e-6)


@BODIES
@pytest.mark.parametrize("dtype", [np.int32, np.float16, bool, complex, str])
def test_a_subject_of_whole_metres_is_refused(model, betas, dtype):
    with pytest.raises(ValueError, match="dtype: expected float32 or float64, got "):
        model.subject(betas, dtype=dtype)


def test_batch_is_the_loop(model, rng):
    poses, trans = at_random(model, rng, 3)
    betas = rng.normal(size=(3, 3))
    subject = model.subject(BETAS)
    every, one, fast = model.vertices(poses, betas, trans), model.vertices(poses, BETAS, trans[0]), \
        subject.vertices(poses, trans)
    for b in range(3):
        np.testing.assert_array_equal(every[b], model.vertices(poses[b], betas[b], trans[b]))
        np.testing.assert_array_equal(one[b], model.vertices(poses[b], BETAS, trans[0]))
        np.testing.assert_allclose(fast[b], subject.vertices(poses[b], trans[b]), rtol=0, atol=1e-13)
    np.testing.assert_allclose(subject.vertices(poses, trans[0])[2], subject.vertices(poses[2], trans[0]), atol=1e-13)
    N = len(model.template.vertices)
    assert model.vertices(poses[:0]).shape == subject.vertices(poses[:0]).shape == (0, N, 3)


def test_trans_moves_and_pose_0_turns_about_the_root(model, rng):
    pose, trans = (x[0] for x in at_random(model, rng, 1))
    R = rotations.exp([0.4, 2.0, -1.0])
    turned = pose.copy()
    turned[0] = rotations.log(R @ rotations.exp(pose[0]))
    centre = model.skeleton.joints[0] + trans
    ring, share = model.skeleton.joint_weights(model.template, 0)
    for betas in (None, BETAS):
        y = model.vertices(pose, betas, trans)
        np.testing.assert_allclose(y, model.vertices(pose, betas) + trans, rtol=0, atol=1e-12)
        np.testing.assert_allclose(share @ y[ring], centre, rtol=0, atol=1e-12)
        np.testing.assert_allclose(model.vertices(turned, betas, trans), (y - centre) @ R.T + centre, rtol=0,
                                   atol=1e-12)


def test_a_turn_of_two_pi_changes_nothing_but_its_name(model, rng):
    pose = random_poses(model, 1, rng, 0.5)[0]
    other = pose * (1 - 2 * np.pi / np.linalg.norm(pose, axis=1, keepdims=True))
    np.testing.assert_allclose(model.vertices(other, BETAS), model.vertices(pose, BETAS), rtol=0, atol=1e-12)


@BODIES
def test_points_are_the_vertices_they_are_made_of(model, rng, betas):
    pose, trans = (x[0] for x in at_random(model, rng, 1))
    y = model.vertices(pose, betas, trans)
    corners, weights = rng.choice(len(y), (9, 3)), rng.dirichlet(np.ones(3), 9)
    mixed, subject = np.einsum("lk,lkd->ld", weights, y[corners]), model.subject(betas)
    for some, few in ((subject.points(corners[:, 0]), subject.points(corners, weights)),
                      (model.points(corners[:, 0]).operator(betas), model.points(corners, weights).operator(betas))):
        np.testing.assert_allclose(some.evaluate(pose, trans), y[corners[:, 0]], rtol=0, atol=1e-12)
        np.testing.assert_allclose(few.evaluate(pose, trans), mixed, rtol=0, atol=1e-12)
    fewer = model.points(corners, weights, n_betas=1)
    np.testing.assert_allclose(fewer.operator(BETAS[:1]).evaluate(pose, trans),
                               model.points(corners, weights).operator(BETAS[:1]).evaluate(pose, trans), atol=1e-12)
    assert fewer.shape_jacobian(pose).shape == (9, 3, 1)


@pytest.mark.parametrize("size", [0.0, 0.5, 2.5])
def test_jacobian_matches_differences(model, rng, size):
    pose, trans = (x[0] for x in at_random(model, rng, 1, size))
    few = np.array([3, 77, 200, 301, 397])
    everything = model.jacobian(pose, BETAS, trans)
    np.testing.assert_allclose(everything.vertices, model.vertices(pose, BETAS, trans), rtol=0, atol=1e-9)
    np.testing.assert_allclose(everything.pose, differences(lambda x: model.vertices(x, BETAS, trans), pose), atol=2e-9)
    np.testing.assert_allclose(everything.betas, differences(lambda b: model.vertices(pose, b, trans), BETAS, 1e-3),
                               atol=1e-9)
    some = model.jacobian(pose, BETAS, trans, vertex_ids=few)
    for name in ("vertices", "pose", "betas"):
        np.testing.assert_allclose(getattr(some, name), getattr(everything, name)[few], rtol=0, atol=1e-12)
    own = model.jacobian(pose, None, trans, vertex_ids=few)
    assert own.betas.shape == (5, 3, 0) and own.pose.shape == (5, 3, 12)
    np.testing.assert_allclose(own.pose, differences(lambda x: model.vertices(x, None, trans)[few], pose), atol=2e-9)
    np.testing.assert_allclose(differences(lambda t: model.vertices(pose, BETAS, t), trans, 1e-3),
                               np.broadcast_to(np.eye(3), (398, 3, 3)), atol=1e-9)


def test_jacobian_of_points_matches_differences(model, rng):
    poses, trans = at_random(model, rng, 3)
    corners, weights = rng.choice(398, (9, 3)), rng.dirichlet(np.ones(3), 9)
    operator = model.points(corners, weights).operator(BETAS)
    y, d_pose = operator.jacobian(poses, trans)
    assert d_pose.shape == (3, 9, 3, 12)
    np.testing.assert_allclose(y, operator.evaluate(poses, trans), rtol=0, atol=1e-12)
    for b in range(3):
        np.testing.assert_allclose(d_pose[b], differences(lambda x, t=trans[b]: operator.evaluate(x, t), poses[b]),
                                   atol=2e-9)
        np.testing.assert_allclose(operator.jacobian(poses[b], trans[b])[1], d_pose[b], rtol=0, atol=1e-12)


def test_shape_jacobian_matches_differences(model, rng):
    pose = random_poses(model, 1, rng)[0]
    expected = differences(lambda b: model.vertices(pose, b), BETAS, 1e-3)
    slope = model.shape_jacobian(pose)
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(model.shape_jacobian(pose, [3, 5]), slope[[3, 5]], rtol=0, atol=1e-12)
    corners, weights = rng.choice(398, (8, 3)), rng.dirichlet(np.ones(3), 8)
    np.testing.assert_allclose(model.points(corners, weights).shape_jacobian(pose),
                               np.einsum("lk,lkdc->ldc", weights, slope[corners]), rtol=0, atol=1e-12)
    at_rest = np.zeros_like(pose)
    np.testing.assert_allclose(model.rest_shape_jacobian, model.shape_jacobian(at_rest), rtol=0, atol=1e-12)
    np.testing.assert_allclose(model.mean_subject.vertices(at_rest), model.vertices(at_rest, 0 * BETAS), atol=1e-9)
    # affine in betas: one slope serves them all
    np.testing.assert_allclose(model.vertices(pose, 3 * BETAS) - model.vertices(pose, BETAS), slope @ (2 * BETAS),
                               rtol=0, atol=1e-9)


def test_survives_the_file_bit_for_bit(model, rng, tmp_path):
    model.save(tmp_path / "worm.npz")
    back = load_model(tmp_path / "worm.npz")
    assert type(back) is type(model) and back.kind == model.kind and back.info == model.info
    pose, trans = (x[0] for x in at_random(model, rng, 1))
    for betas in (None, BETAS):
        np.testing.assert_array_equal(back.vertices(pose, betas, trans), model.vertices(pose, betas, trans))
        np.testing.assert_array_equal(back.subject(betas).vertices(pose), model.subject(betas).vertices(pose))
    for name in ("pose_mean", "pose_covariance", "explained"):
        np.testing.assert_array_equal(getattr(back, name), getattr(model, name))
    np.testing.assert_array_equal(back.skeleton.parents, model.skeleton.parents)
    assert back.skeleton.names == model.skeleton.names
    back.save(tmp_path / "again.npz")
    with np.load(tmp_path / "worm.npz") as a, np.load(tmp_path / "again.npz") as b:
        assert a.files == b.files
        for name in a.files:
            assert a[name].dtype == b[name].dtype and a[name].tobytes() == b[name].tobytes()


def test_a_damaged_file_is_refused(model, tmp_path):
    model.save(tmp_path / "worm.npz")
    with np.load(tmp_path / "worm.npz") as data:
        arrays = {name: data[name] for name in data.files}
    for name in arrays:
        if name != "header":
            np.savez(tmp_path / "lacks.npz", **{k: v for k, v in arrays.items() if k != name})
            with pytest.raises(ValueError, match=r"lacks\.npz.*"):
                load_model(tmp_path / "lacks.npz")


def test_a_damaged_file_is_refused_or_the_body_can_be_posed(model, tmp_path, rng):
    model.save(tmp_path / "worm.npz")
    arrays, path = storage.load_arrays(tmp_path / "worm.npz"), tmp_path / "damaged.npz"
    for name in sorted(arrays.keys() - {"header"}):
        whole = arrays[name]
        for damaged in (np.zeros_like(whole), -whole, rng.permutation(whole.ravel()).reshape(whole.shape)):
            np.savez(path, **{**arrays, name: damaged})
            try:
                found = load_model(path)
            except storage.StorageError as error:
                assert "damaged.npz" in str(error)
                continue
            pose = random_poses(found, 1, rng, 0.3)[0]
            assert np.isfinite([*found.vertices(pose, BETAS), *found.rest_joints(BETAS)]).all()


@pytest.mark.parametrize(("name", "value"), [("landmarks", [1]), ("sexes", 3), ("poses", "many"), ("digests", 1.5),
                                             ("left_out_error", "small"), ("joint_gaps", {"a": 1})])
def test_a_file_with_other_notes_of_its_training_is_refused(tmp_path, name, value):
    model = scape_worm()
    replace(model, info={**model.info, name: value}).save(tmp_path / "worm.npz")
    with pytest.raises(storage.StorageError, match=rf"worm\.npz.*{name}"):
        load_model(tmp_path / "worm.npz")


def test_known_poses_are_recovered(model, rng):
    subject = model.subject(BETAS)
    poses, trans = at_random(model, rng, 3, 0.5)
    for pose, t in zip(poses, trans, strict=True):
        fit = fit_pose(subject, model.vertices(pose, BETAS, t), FitConfig(tolerance=1e-9))
        assert fit.converged and fit.rms < 1e-6
        np.testing.assert_allclose(rotations.exp(fit.pose), rotations.exp(pose), atol=1e-4)
        np.testing.assert_allclose(fit.trans, t, atol=1e-5)


def test_known_people_are_recovered(model, rng):
    pose, betas, trans = random_poses(model, 1, rng, 0.3)[0], rng.normal(size=3), rng.normal(size=3)
    fit = fit_shape(model, model.vertices(pose, betas, trans), FitConfig(tolerance=1e-9))
    assert fit.converged and fit.rms < 1e-5
    np.testing.assert_allclose(fit.betas, betas, atol=1e-3)
    np.testing.assert_allclose(rotations.exp(fit.pose), rotations.exp(pose), atol=1e-3)
    np.testing.assert_allclose(fit.trans, trans, atol=1e-4)


MARKS = np.array([6, 75, 130, 200, 255, 330, 396])
POSE = np.array([[0.3, -0.5, 0.8], [0.2, 0.5, -0.4], [-0.1, -0.6, 0.3], [0.3, 0.1, 0.5]])


@pytest.mark.parametrize("known", [True, False], ids=["known", "unknown"])
def test_half_a_scan_is_completed(model, known):
    quick = CompletionConfig(random_starts=8, rounds=5, scan_points=500, model_points=200)
    body = model.template.with_vertices(model.vertices(POSE, BETAS, np.array([0.4, -0.3, 1.1])))
    points, seen = half_view(body, np.array([0.3, -1, 0.5]), count=2000, noise=0.001)
    result = complete(model.subject(BETAS) if known else model, points, (MARKS, body.vertices[MARKS]), quick)
    far = np.linalg.norm(result.completed.vertices - body.vertices, axis=1)
    assert Surface(body).closest(result.completed.vertices[seen]).distances.mean() < 0.003
    assert far[~seen].mean() < 0.02


def test_markers_are_animated(model):
    subject, t = model.subject(BETAS), np.arange(20) / 100
    poses = POSE + 0.3 * np.sin(2 * np.pi * t[:, None, None] + np.arange(4)[:, None]) * [0.2, 1, 0.6]
    trans = np.stack([1.2 * t, 0.1 * np.sin(4 * t), 0 * t], axis=1)
    meshes = subject.vertices(poses, trans)
    layout = MarkerLayout(tuple(f"M{i}" for i in range(30)), np.random.default_rng(4).choice(396, 30, replace=False),
                          0.012)
    positions = np.stack([layout.place(subject.template.with_vertices(v)) for v in meshes])
    motion = animate(subject, MarkerSequence(positions, layout.labels, 100.0), layout)
    assert np.linalg.norm(motion.vertices(subject) - meshes, axis=2).mean(axis=1).max() < 0.01


def test_a_model_passes_through_the_commands(model, tmp_path, monkeypatch):
    """What a kind must say is enough for all of them; `complete` and `animate` are above."""
    file, out = tmp_path / "worm.npz", tmp_path / "out"
    model.save(file)
    for argv in (["info"], ["mesh", "--betas", "1", "-o", "out/a.ply"], ["sample", "-n", "2", "-o", "out/b"],
                 ["export", "-o", "out/c.glb"], ["export", "-o", "out/d.bvh"], ["export", "-o", "out/e.npz"],
                 ["resample", "--vertices", "300", "-o", "out/f.npz"]):
        monkeypatch.chdir(tmp_path)
        assert group([argv[0], str(file), *argv[1:]]) == 0, argv
    back = load_model(out / "f.npz")
    assert type(back) is type(model) and len(back.template.vertices) == pytest.approx(300, abs=5)
    apart = resolution_gap(model, back, 0.3 * POSE[None], BETAS[None])
    assert apart.max() < 0.02 and {path.name for path in out.iterdir()} >= {"a.ply", "b", "c.glb", "d.bvh", "e.npz"}


@pytest.mark.parametrize("kind", ["scape", "skinning"])
def test_a_body_of_one_part_turns_stiffly(kind, rng):
    stiff = stiff_bodies()[kind]
    pose, x, centre = np.array([[0.3, 0.2, -0.5]]), stiff.template.vertices, stiff.template.vertices.mean(axis=0)
    expected = (x - centre) @ rotations.exp(pose[0]).T + centre
    np.testing.assert_allclose(stiff.vertices(pose), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(stiff.subject().vertices(pose), expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(stiff.jacobian(pose, vertex_ids=[3, 7]).pose,
                               differences(lambda q: stiff.vertices(q)[[3, 7]], pose), atol=2e-9)


@pytest.mark.parametrize("pose, trans, word", [
    (np.zeros((3, 3)), None, "pose"), (np.zeros(12), None, "pose"), (np.full((4, 3), np.nan), None, "finite"),
    (np.zeros((4, 3)), np.zeros(2), "trans"), (np.zeros((2, 4, 3)), np.zeros((3, 3)), "trans"),
    (np.zeros((4, 3)), np.array([np.inf, 0, 0]), "finite")])
def test_bad_poses_are_refused(model, pose, trans, word):
    subject = model.subject()
    for call in (subject.vertices, lambda p, t: model.vertices(p, None, t), subject.points([0]).evaluate):
        with pytest.raises(ValueError, match=word):
            call(pose, trans)


@pytest.mark.parametrize("betas, word", [(np.zeros(4), "betas: expected at most 3"), (np.array([0, np.nan]), "finite")])
def test_bad_betas_are_refused(model, betas, word):
    for call in (model.subject, lambda b: model.vertices(np.zeros((4, 3)), b)):
        with pytest.raises(ValueError, match=word):
            call(betas)
    with pytest.raises(ValueError, match="betas"):
        model.vertices(np.zeros((2, 4, 3)), np.zeros((3, 3)))


@pytest.mark.parametrize("ids, weights", [([-1], None), ([10**6], None), ([[0, 1, 2]], None), ([0], [[1.0]]),
                                          ([[0, 1]], [[0.5, 0.6]])])
def test_bad_points_are_refused(model, ids, weights):
    for call in (model.points, model.subject().points):
        with pytest.raises(ValueError, match=r"vertex_ids|weights"):
            call(ids, weights)
