"""Rounds of co-registration: each learns from the one before, and what has not changed is not made again."""
import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from coregistered import QUICK
from coregistered import run as run_coregistration
from crab_scans import COARSE, FAR, PLAIN, crab_body, crab_skeleton, mean_mm, scan_of  # noqa: F401 -- fixtures
from jointed_bodies import bent
from model_bodies import random_poses, worm_model
from trees import tree

import model.coregistration.rounds as rounds_module
from model import ModelRegistration, coregister, learn_scape, load_model
from scanprep import RegisteredSet, write_mesh
from scanprep.batch.opening import workspace
from scanprep.geometry.landmarks import write_landmarks
from scanprep.registration.nonrigid import register


def made_of(template, vertices, explained=1.0):
    """A registration as it would have come, without the work."""
    mesh, N = template.with_vertices(vertices), len(vertices)
    return ModelRegistration(mesh, mesh, np.zeros((4, 3)), np.zeros(3), None, np.ones(N, dtype=bool), np.zeros(N), 0.0,
                             explained, 0.0, np.nan, 0, np.ones(N), 1)


def test_the_person_with_most_scans_teaches_poses_and_others_shapes(monkeypatch):
    worm = worm_model()
    rng = np.random.default_rng(3)
    who = ["b", "a", "a", "b", "a", "c", "a", "d"]
    bodies = [worm.vertices(0.3 * random_poses(worm, 1, rng)[0],
                            None if name == "a" else np.full(3, "bcd".index(name) - 1.0)) for name in who]

    def ready(body, scan, *_):
        return made_of(worm.template, scan, 0.5 if scan is bodies[6] else 1.0)

    monkeypatch.setattr(rounds_module, "register_with_model", ready)
    done = coregister(worm, bodies, None, replace(COARSE, rounds=1), subjects=who)
    assert done.model.info["poses"] == 1 + 3 and done.model.info["shapes"] == 3      # the template; not the one failed
    assert done.good.tolist() == [True] * 6 + [False, True] and done.failed[0] == 1
    assert done.model.n_betas == 2


@pytest.fixture(scope="module")
def begun(body, skeleton):
    """A poor model from near poses, and scans of which plain registration fails on two."""
    turns = np.random.default_rng(5).normal(0, 0.25, (3, 2, 3)) * [0.3, 1, 1]
    truths = np.stack([*(bent(body, *t) for t in turns), bent(body, *FAR), bent(body, *[-t for t in FAR])])
    scans = [scan_of(body, truth, seed=i) for i, truth in enumerate(truths)]
    plain = np.stack([register(body, scan, config=PLAIN).mesh.vertices for scan in scans])
    first = learn_scape(body, np.stack([body.vertices, *plain[:3]]), None, skeleton, QUICK.learn)
    return truths, scans, plain, first


@pytest.fixture(scope="module")
def story(begun, tmp_path_factory):
    """What became of them."""
    truths, scans, plain, first = begun
    with workspace(tmp_path_factory.mktemp("story") / "kept") as space:
        done = coregister(first, scans, None, COARSE, list(plain), space=space)
    return truths, scans, plain, first, done, space.folder


@pytest.mark.slow
def test_rounds_mend_what_failed_and_better_the_model(story, body):
    truths, _, plain, _, done, _ = story
    before = np.array([mean_mm(v, t) for v, t in zip(plain, truths, strict=True)])
    after = np.array([mean_mm(r.mesh.vertices, t) for r, t in zip(done.registrations, truths, strict=True)])
    assert (before > 25).sum() == 2 and done.good.all()
    # those that failed end at 5.6 to 6.9 mm by the noise of their scans (four draws), and once at 126 in earlier code
    assert (after[:3] < 3).all() and (after[3:] < 8).all()
    assert after[:3].mean() < before[:3].mean() + 0.5
    assert done.rounds == 2 and done.failed[0] <= 1 and done.failed[1] == 0     # 2 had failed without
    assert np.isnan(done.changes[0]) and done.changes[1] < 3e-3
    assert done.model.info["poses"] == 6 and not done.failures


@pytest.mark.slow
def test_a_settled_folder_stops_early_and_reports_it(story):
    _, scans, _, _, done, _ = story
    again = coregister(done.model, scans[:2], None, replace(COARSE, rounds=4),
                       [r.mesh.vertices for r in done.registrations[:2]])
    assert again.converged and again.rounds == 3


@pytest.fixture
def asked(monkeypatch):
    """The scans that are registered, in place of the work: the start, and how often the model learned."""
    calls = []

    def ready(body, scan, marks, start, config):
        calls.append(scan)
        return made_of(body.template, np.asarray(start) + 0.1 * scan[:1])

    monkeypatch.setattr(rounds_module, "register_with_model", ready)
    return calls


CHANGES = {          # what is changed -> scans that are made anew in the first round, and how many after it
    "nothing": ("", 0), "a scan": ("1", 5), "landmarks": ("2", 1), "a start": ("0", 5), "settings": ("01234", 5),
    "the model": ("01234", 0),                  # the stand-in does not use it, so the lessons stay and what follows
    "what fails": ("", 0), "learning": ("", 5), "more rounds": ("", 5)}


@pytest.mark.slow
@pytest.mark.parametrize("what", CHANGES)
def test_only_what_depends_on_a_change_is_made_anew(story, asked, tmp_path, what):
    _, scans, plain, first, _, _ = story
    scans, starts, marks, model, config = list(scans), list(plain), [None] * 5, first, QUICK
    with workspace(tmp_path / "kept") as space:
        before = coregister(model, scans, marks, config, starts, space=space)
        assert len(asked) == 10
        del asked[:]
        if what == "a scan":
            scans[1] = scans[1] + [0, 0, 1e-9]
        elif what == "landmarks":
            marks[2] = np.array([0, 1, 2]), np.zeros((3, 3))
        elif what == "a start":
            starts[0] = starts[0] + [0, 0, 1e-9]
        elif what == "the model":
            model = replace(first, pose_mean=first.pose_mean + 1e-9)        # of the same training set
        elif what == "settings":
            config = replace(config, fit=replace(QUICK.fit, rounds=QUICK.fit.rounds + 1))
        elif what == "what fails":
            config = replace(config, failed=0.5 * QUICK.failed)
        elif what == "learning":
            config = replace(config, learn=replace(QUICK.learn, refinements=2))
        elif what == "more rounds":
            config = replace(config, rounds=3)
        again = coregister(model, scans, marks, config, starts, space=space)
    anew, after = CHANGES[what]
    assert len(asked) == len(anew) + after
    assert all(scan is scans[int(i)] for i, scan in zip(anew, asked, strict=False))
    assert again.good.all() and before.good.all()


@pytest.mark.slow
def test_a_scan_that_cannot_be_registered_stops_no_other(story):
    _, scans, plain, first, _, _ = story
    spoilt = [*scans[:2], np.full((40, 3), np.nan)]
    starts = [*plain[:2], None]
    done = coregister(first, spoilt, None, replace(QUICK, rounds=1), starts, names=["a", "b", "c"])
    assert list(done.failures) == ["c"] and "c" in done.failures["c"]
    assert done.good.tolist() == [True, True, False] and done.registrations[2] is None
    assert done.failed[0] == 1
    with pytest.raises(ValueError, match=r"only 0 of 2.*scan 0: "):
        coregister(first, spoilt[2:] * 2, None, replace(QUICK, rounds=1))


@pytest.fixture(scope="module")
def folders(begun, body, tmp_path_factory):
    """A model, a folder of two scans and a broken one, earlier registrations, and what came of it undisturbed."""
    truths, _, plain, first = begun
    folder = tmp_path_factory.mktemp("folders")
    marks = {"left": int(np.argmin(body.vertices[:, 0])), "right": int(np.argmax(body.vertices[:, 0])),
             "top": int(np.argmax(body.vertices[:, 1]))}
    replace(first, info={**first.info, "landmarks": marks}).save(folder / "first.npz")
    for i in (0, 4):
        write_mesh(folder / "scans" / f"s{i}.ply", body.with_vertices(truths[i]))
        write_landmarks(folder / "scans" / f"s{i}.json", {n: truths[i][v] for n, v in marks.items()})
    (folder / "scans" / "broken.ply").write_text("not a mesh")
    RegisteredSet.create(folder / "set", body).add("s0", plain[0])
    assert coregister_quickly(folder, folder / "whole", 2) == 1
    return folder


def coregister_quickly(folder, output, workers):
    return run_coregistration(["--first", str(folder / "set"), "--workers", str(workers), "-o", str(output),
                               str(folder / "first.npz"), str(folder / "scans")])


def test_command_writes_a_set_and_a_model(begun, folders):
    truths = begun[0]
    told = json.loads((folders / "whole" / "report.json").read_text())
    assert len(told["failures"]) == 1 and "broken.ply" in told["failures"][0]
    assert told["metrics"][0] == {"metric": "scans registered", "value": "2 of 2", "unit": ""}
    found = RegisteredSet.load(folders / "whole")
    assert found.names == ("s0", "s4") and found.skeleton is not None
    assert all(mean_mm(v, truths[i]) < 6 for v, i in zip(found.vertices(), (0, 4), strict=True))
    assert set(load_model(folders / "whole" / "model.npz").info["landmarks"]) == {"left", "right", "top"}
    rows = list(csv.DictReader((folders / "whole" / "coregistration.csv").open()))
    assert [row["name"] for row in rows] == ["s0", "s4"] and float(rows[1]["explained"]) > 0.95


@pytest.mark.slow
def test_one_worker_makes_the_same_bytes_as_two(folders, tmp_path):
    assert coregister_quickly(folders, tmp_path / "out", 1) == 1
    assert tree(tmp_path / "out", "report.json") == tree(folders / "whole", "report.json")
