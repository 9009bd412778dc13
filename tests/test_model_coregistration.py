"""Co-registration: a model leads the template where plain registration fails, and the data where there are some."""
import csv
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from matching_bodies import bent, crab
from model_bodies import random_poses, worm_model

import model.coregistration.cli as cli_module
import model.coregistration.rounds as rounds_module
from model import CoregistrationConfig, ModelRegistration, coregister, learn_scape, load_model, register_with_model
from model.coregistration.attraction import apart, attraction, towards
from model.coregistration.cli import coregister_scans
from model.coregistration.config import ModelFitConfig
from model.coregistration.first import explained_share
from model.coregistration.folder import RoundsFolder
from model.coregistration.modelfit import ModelFit
from model.coregistration.posed import posed_points, typical_poses, whitening
from model.learning.scape import LearnConfig
from scanprep import RegisteredSet, write_mesh
from scanprep.geometry.landmarks import write_landmarks
from scanprep.geometry.mesh import Mesh
from scanprep.geometry.surface import Surface
from scanprep.matching.matches import target_of
from scanprep.matching.nonrigid import register
from scanprep.matching.schedule import GraphStage, RegistrationConfig, ShellStage
from scanprep.skeleton.tree import Skeleton

QUICK = CoregistrationConfig(
    fit=ModelFitConfig(axes=2, turns=2),
    registration=RegistrationConfig(graph=(GraphStage(80, 0.09, 0.009, 0.7, 0.01, 0.08),
                                           GraphStage(80, 0.06, 0.006, 0.7, 0.01, 0.05)),
                                    shell=(ShellStage(0.02, 0.007, 0.0002, 0.02),), settle=None),
    learn=LearnConfig(refinements=1, steps=1), rounds=2, workers=1)
PLAIN = replace(QUICK.registration, graph=(GraphStage(80, 0.2, 0.02, 0.7, 0.01, 0.21),
                                           GraphStage(80, 0.13, 0.013, 0.7, 0.01, 0.15), *QUICK.registration.graph))
FAR = np.array([0, -1.3, 0.1]), np.array([0.1, 1.3, 0.2])          # both arms far from the template's
NEAR = np.array([0, 0.1, 0.05]), np.array([0.1, 0.0, -0.15])


@pytest.fixture(scope="module")
def body():
    return crab()


@pytest.fixture(scope="module")
def skeleton(body):
    part = np.select([body.corners.mean(axis=1)[:, 0] < -0.2, body.corners.mean(axis=1)[:, 0] > 0.2], [1, 2], 0)
    joints = np.array([[0, 0, 0], [-0.2, 0, 0], [0.2, 0, 0]])
    joints[0] = body.vertices[Skeleton(part, [-1, 0, 0], joints).part_of_vertex(body) == 0].mean(axis=0)
    return Skeleton(part, [-1, 0, 0], joints)


@pytest.fixture(scope="module")
def crab_model(body, skeleton):
    turns = np.random.default_rng(0).normal(0, 0.6, (14, 2, 3)) * [0.3, 1, 1]
    return learn_scape(body, np.stack([body.vertices, *(bent(body, *t) for t in turns)]), None, skeleton, QUICK.learn)


def scan_of(body, vertices, keep=None, seed=0):
    """Noisy points all over, or where `keep` says of points and normals."""
    rng = np.random.default_rng(seed)
    truth = body.with_vertices(vertices)
    points, face, _ = truth.sample(3900, rng)
    chosen = np.ones(len(points), dtype=bool) if keep is None else keep(points, truth.face_normals[face])
    return (points + rng.normal(0, 5e-4, points.shape))[chosen]


def mean_mm(found, truth):
    return 1e3 * np.linalg.norm(found - truth, axis=1).mean()


def test_a_scan_that_plain_registration_gets_wrong_is_right_with_the_model(body, crab_model):
    truth = bent(body, *FAR)
    scan = scan_of(body, truth)
    plain = register(body, scan, config=PLAIN)
    found = register_with_model(crab_model.subject(), scan, start=plain.mesh.vertices, config=QUICK)
    assert mean_mm(plain.mesh.vertices, truth) > 30 and mean_mm(found.mesh.vertices, truth) < 4
    assert explained_share(plain.mesh, scan, QUICK) < 1 - QUICK.failed < found.explained
    assert found.seen.mean() > 0.8 and found.rms < 1e-3 and found.flipped == 0


def test_without_any_start_or_landmark_the_pose_is_found(body, crab_model):
    truth = bent(body, *FAR) @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]).T + [3, 1, -2]
    turned = replace(QUICK, fit=replace(QUICK.fit, turns=4, up=(0.0, 0.0, 1.0)))
    found = register_with_model(crab_model.subject(), scan_of(body, truth), config=turned)
    assert mean_mm(found.mesh.vertices, truth) < 4 and found.starts > 1


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
    config = replace(QUICK, fit=replace(QUICK.fit, shape_prior=1e-5, search=(), refine=(
        *QUICK.fit.refine, replace(QUICK.fit.refine[-1], reach=0.02, prior=1e-5, rounds=20, slide=0.01))))
    marks = np.arange(0, 398, 40)
    found = register_with_model(worm, scan_of(worm.template, truth), (marks, truth[marks]), pose, config)
    assert found.betas is not None and found.betas == pytest.approx(betas, abs=0.3)
    assert mean_mm(found.mesh.vertices, truth) < 5


def test_residual_is_the_energy_of_all_matches(body):
    """Two matches of one point make one quadratic of the same value up to a constant."""
    target = target_of(body)
    x, n = body.vertices[::7] + 0.01 * body.vertex_normals[::7], body.vertex_normals[::7]
    share = np.full(len(x), 1 / len(x))
    wanted = attraction(x, n, share, target, 0.1, 0.3, 0.05)
    assert np.sum(wanted.residual(wanted.place)**2) == pytest.approx(0)
    across = attraction(x, n, share, target, 0.1, 1e-4, 0.05)
    along = np.cross(n, [0.3, 0.5, 0.8])
    slid, lifted = (np.sum(across.residual(across.place + 0.005 * d)**2) for d in (along, n))
    assert slid < 0.2 * lifted
    assert np.sum(towards(x, share).residual(x + [0, 0, 0.1])**2) == pytest.approx(0.01)


def test_what_faces_away_does_not_explain(body):
    target = target_of(body)
    turned = replace(target, normals=-target.normals)
    assert apart(body, target, 0.05).max() < 1e-6 and (apart(body, turned, 0.05) == 0.05).all()


@pytest.mark.parametrize("known", [True, False], ids=["subject", "betas"])
def test_derivatives_agree_with_finite_differences(known):
    worm = worm_model()
    points = posed_points(worm.subject([1.0, 0, 0]) if known else worm, np.array([3, 50, 200, 390]), 3)
    x = np.random.default_rng(2).normal(0, 0.4, points.J3 + 3 + points.n_betas)
    y, columns = points.columns(x)
    np.testing.assert_allclose(y, points.positions(x), atol=1e-12)
    for k in range(len(x)):
        h = 1e-6 * np.eye(len(x))[k]
        numeric = (points.positions(x + h) - points.positions(x - h)) / 2e-6
        np.testing.assert_allclose(columns[k], numeric, atol=1e-7)


def test_vertices_without_weight_do_not_count(body, crab_model):
    fit = ModelFit(crab_model.subject(), target_of(body), None, QUICK.fit)
    pose = np.array([[0.1, 0, 0.2], [0, 0.5, 0.1], [0.1, -0.4, 0]])
    vertices = np.asarray(crab_model.subject().vertices(pose, np.array([0.1, 0, 0])))
    wrong = body.vertices[:, 1] > 0.02
    spoilt = vertices + 0.3 * wrong[:, None]
    x = fit.taken_from(spoilt, (~wrong).astype(float), np.zeros(12), 1e-6, 40)
    np.testing.assert_allclose(fit.split(x)[0], pose, atol=2e-3)
    np.testing.assert_allclose(fit.split(x)[1], [0.1, 0, 0], atol=1e-3)


def test_prior_is_the_shrunk_gaussian(crab_model):
    W = whitening(crab_model.pose_covariance)
    assert not W[:, :3].any() and np.linalg.matrix_rank(W) == 6
    poses = typical_poses(crab_model.pose_mean, crab_model.pose_covariance, 2)
    assert poses.shape == (5, 3, 3)
    np.testing.assert_allclose(poses[1] + poses[3], 2 * crab_model.pose_mean, atol=1e-12)
    assert np.trace(crab_model.pose_covariance) * 1.5**2 > np.sum((poses[1] - poses[0]) ** 2) > 0


class Memory:
    """A store that counts what is made anew."""

    def __init__(self):
        self.kept, self.models = {}, {}

    def found(self, turn, scan):
        return self.kept.get((turn, scan))

    def keep(self, turn, scan, registration):
        assert (turn, scan) not in self.kept
        self.kept[turn, scan] = registration

    def model(self, turn):
        return self.models.get(turn)

    def keep_model(self, turn, learned):
        self.models[turn] = learned


def made_of(template, vertices, explained=1.0):
    """A registration as it would have come, without the work."""
    mesh, N = template.with_vertices(vertices), len(vertices)
    return ModelRegistration(mesh, mesh, np.zeros((4, 3)), np.zeros(3), None, np.ones(N, dtype=bool), np.zeros(N), 0.0,
                             explained, 0.0, np.nan, 0, np.ones(N), 0.0, 1)


def test_the_person_with_most_scans_teaches_poses_and_others_shapes():
    worm = worm_model()
    rng = np.random.default_rng(3)
    who = ["b", "a", "a", "b", "a", "c", "a", "d"]
    store = Memory()
    for i, name in enumerate(who):
        pose = 0.3 * random_poses(worm, 1, rng)[0]
        betas = None if name == "a" else np.full(3, "bcd".index(name) - 1.0)
        store.kept[0, i] = made_of(worm.template, worm.vertices(pose, betas), 0.5 if i == 6 else 1.0)
    done = coregister(worm, [worm.template] * 8, None, replace(QUICK, rounds=1), subjects=who, store=store)
    assert done.model.info["poses"] == 1 + 3 and done.model.info["shapes"] == 3      # the template; not the one failed
    assert done.good.tolist() == [True] * 6 + [False, True] and done.history[0].failed == 1
    assert done.model.n_betas == 2


@pytest.fixture(scope="module")
def story(body, skeleton):
    """A poor model from near poses; scans of which plain registration fails on two; what became of them."""
    turns = np.random.default_rng(5).normal(0, 0.25, (3, 2, 3)) * [0.3, 1, 1]
    truths = np.stack([*(bent(body, *t) for t in turns), bent(body, *FAR), bent(body, *[-t for t in FAR])])
    scans = [scan_of(body, truth, seed=i) for i, truth in enumerate(truths)]
    plain = np.stack([register(body, scan, config=PLAIN).mesh.vertices for scan in scans])
    first = learn_scape(body, np.stack([body.vertices, *plain[:3]]), None, skeleton, QUICK.learn)
    store = Memory()
    return truths, scans, plain, first, coregister(first, scans, None, QUICK, list(plain), store=store), store


def test_rounds_mend_what_failed_and_better_the_model(story, body):
    truths, _, plain, _, done, store = story
    before = np.array([mean_mm(v, t) for v, t in zip(plain, truths, strict=True)])
    after = np.array([mean_mm(r.mesh.vertices, t) for r, t in zip(done.registrations, truths, strict=True)])
    assert (before > 25).sum() == 2 and (after < 6).all() and done.good.all()
    assert after[:3].mean() < before[:3].mean() + 0.5
    assert done.rounds == 2 and [turn.failed for turn in done.history] == [0, 0]
    assert np.isnan(done.history[0].change) and done.history[1].change < 3e-3
    assert len(store.kept) == 10 and done.model is store.models[1] and done.model.info["poses"] == 6


def test_a_settled_folder_stops_early_and_reports_it(story):
    _, scans, _, _, done, _ = story
    store = Memory()
    again = coregister(done.model, scans[:2], None, replace(QUICK, tolerance=0.02, rounds=4),
                       [r.mesh.vertices for r in done.registrations[:2]], store=store)
    assert again.converged and again.rounds == 2 and len(store.kept) == 4


def test_what_was_kept_is_not_made_again(story, body, tmp_path, monkeypatch):
    _, scans, plain, first, done, memory = story
    names, marks = [f"s{i}" for i in range(5)], [f"{i}" for i in range(5)]
    store = RoundsFolder(tmp_path, first, names, marks, QUICK)
    for (turn, scan), registration in memory.kept.items():
        store.keep(turn, scan, registration)
    store.keep_model(0, memory.models[0])                     # killed before the second model was learned

    def forbidden(*args, **kwargs):
        raise AssertionError("made again")

    monkeypatch.setattr(rounds_module, "register_with_model", forbidden)
    again = coregister(first, scans, None, QUICK, list(plain), store=RoundsFolder(tmp_path, first, names, marks, QUICK))
    for a, b in zip(again.registrations, done.registrations, strict=True):
        np.testing.assert_array_equal(a.mesh.vertices, b.mesh.vertices)
        np.testing.assert_array_equal(a.distances, b.distances)
        assert (a.explained, a.flipped, a.betas) == (b.explained, b.flipped, None)
    pose = done.registrations[4].pose
    np.testing.assert_allclose(again.model.vertices(pose), done.model.vertices(pose), atol=1e-9)
    changed = RoundsFolder(tmp_path, first, names, ["new", *marks[1:]], QUICK)
    assert changed.found(0, 0) is None and changed.found(0, 1) is not None
    assert changed.found(1, 1) is None and changed.model(0) is None
    with pytest.raises(ValueError, match="other settings"):
        RoundsFolder(tmp_path, first, names, marks, replace(QUICK, failed=0.5))


def test_command_writes_a_set_and_a_model(story, body, tmp_path, monkeypatch):
    truths, _, plain, first, _, _ = story
    marks = {"left": int(np.argmin(body.vertices[:, 0])), "right": int(np.argmax(body.vertices[:, 0])),
             "top": int(np.argmax(body.vertices[:, 1]))}
    replace(first, info={**first.info, "landmarks": marks}).save(tmp_path / "first.npz")
    (tmp_path / "scans").mkdir()
    for i in (0, 4):
        write_mesh(tmp_path / "scans" / f"s{i}.ply", body.with_vertices(truths[i]))
        write_landmarks(tmp_path / "scans" / f"s{i}.json", {n: truths[i][v] for n, v in marks.items()})
    (tmp_path / "scans" / "broken.ply").write_text("not a mesh")
    earlier = RegisteredSet.create(tmp_path / "set", body)
    earlier.add("s0", plain[0])

    monkeypatch.setattr(cli_module, "CoregistrationConfig", partial(replace, QUICK))        # quick settings

    def run():
        return coregister_scans(tmp_path / "first.npz", tmp_path / "scans", tmp_path / "out", first=tmp_path / "set",
                                rounds=1, workers=2, failed=0.05)

    done = run()
    assert len(done.failures) == 1 and "broken.ply" in done.failures[0]
    assert {m.name: m.value for m in done.metrics}["scans registered"] == "2 of 2"
    found = RegisteredSet.load(tmp_path / "out")
    assert found.names == ("s0", "s4") and found.skeleton is not None
    assert all(mean_mm(v, truths[i]) < 6 for v, i in zip(found.vertices(), (0, 4), strict=True))
    assert load_model(tmp_path / "out" / "model.npz").info["landmarks"] == marks
    rows = list(csv.DictReader((tmp_path / "out" / "coregistration.csv").open()))
    assert [row["name"] for row in rows] == ["s0", "s4"] and float(rows[1]["explained"]) > 0.95
    monkeypatch.setattr(rounds_module, "register_with_model", None)
    assert run().metrics[0].value == "2 of 2"


@pytest.mark.parametrize("given, words", [
    ({"start": np.zeros((4, 3))}, "start: expected"),
    ({"landmarks": (np.array([5000]), np.zeros((1, 3)))}, "0..821"),
    ({"landmarks": (np.array([1, 2]), np.zeros((1, 3)))}, "landmarks: expected vertices"),
    ({"landmarks": (np.array([1]), np.full((1, 3), np.nan))}, "finite")])
def test_one_scan_refuses_what_it_cannot_use(body, crab_model, given, words):
    with pytest.raises(ValueError, match=words):
        register_with_model(crab_model.subject(), body, config=QUICK, **given)


def test_rounds_refuse_what_they_cannot_use(body, crab_model):
    with pytest.raises(ValueError, match="subjects: expected 2"):
        coregister(crab_model, [body, body], subjects=["a"])
    strict = replace(QUICK, rounds=1, fit=replace(QUICK.fit, axes=0, turns=1))
    elsewhere = Mesh(np.random.default_rng(0).normal(0, 0.4, (3000, 3)), np.zeros((0, 3), dtype=np.int64))
    with pytest.raises(ValueError, match="only 0 of 2"):
        coregister(crab_model, [elsewhere.vertices, elsewhere.vertices], None, strict)
