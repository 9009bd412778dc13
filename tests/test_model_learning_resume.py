"""`scape learn` killed, started again, and with inputs that change: nothing lost, nothing stale, nothing done twice."""
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from config_files import config_file
from model_bodies import random_poses, worm_model

from model import report
from model.learning import body, cli, scape
from model.learning.cli import learn
from model.learning.parts import ChosenSkeleton
from scanprep import read_mesh, write_mesh
from scanprep.batch.opening import beside
from scanprep.command_line import run

STAGES = {"skeleton": (body, "choose_skeleton"), "poses": (scape, "by_edges"), "people": (scape, "shape_gradients"),
          "components": (scape, "learn_shape_space"), "pictures": (cli, "_draw")}
QUICK = {"refinements": 1, "components": 4, "prunings": [0.01], "ridges": [1e-3]}
SKIN = {"rounds": 2, "components": 4}
ALL = {"skeleton": 1, "poses": 1, "people": 6, "components": 1, "pictures": 1}

KILLED = """
import os, sys
import {package} as module
from model.learning.cli import learn
from scanprep.command_line import run

real, calls = module.{name}, []

def dying(*given, **named):
    calls.append(1)
    if len(calls) > {after}:
        os.kill(os.getpid(), 9)
    return real(*given, **named)

module.{name} = dying
run(learn, "scape learn", sys.argv[1:])
"""


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    """They are drawn in test_model_learning_cli; here they would take most of the time."""
    for name in ("picture_parts", "picture_components"):
        monkeypatch.setattr(report, name, lambda *given: np.zeros((4, 4, 3), dtype=np.uint8))


@pytest.fixture
def bodies(tmp_path):
    """Plain folders of one worm in eight poses and of six others."""
    truth, rng = worm_model(), np.random.default_rng(0)
    poses = random_poses(truth, 8, rng, 0.4)
    poses[0] = 0
    for i, vertices in enumerate(truth.subject().vertices(poses)):
        write_mesh(tmp_path / "poses" / f"pose{i}.ply", truth.template.with_vertices(vertices))
    for i in range(6):
        body = truth.vertices(random_poses(truth, 1, rng, 0.1)[0], rng.normal(size=3))
        write_mesh(tmp_path / "people" / f"person{i}.ply", truth.template.with_vertices(body))
    truth.skeleton.save(tmp_path / "skeleton.json")
    return tmp_path


@pytest.fixture
def counted(monkeypatch):
    """Calls of the stages."""
    calls = dict.fromkeys(STAGES, 0)

    def count(stage, real):
        def counting(*given, **named):
            calls[stage] += 1
            return real(*given, **named)
        return counting

    for stage, (module, name) in STAGES.items():
        monkeypatch.setattr(module, name, count(stage, getattr(module, name)))
    return calls


@pytest.fixture
def searched(monkeypatch):
    """A search for a skeleton that takes no time, for words without --skeleton."""
    chosen = ChosenSkeleton(worm_model().skeleton, {4: 0.001}, False)
    monkeypatch.setattr(body, "choose_skeleton", lambda *given: chosen)


def words(bodies, output, *more, search=False, **settings):
    file = config_file(bodies, scape={**QUICK, **settings}, skinning=SKIN)
    known = [] if search else ["--skeleton", str(bodies / "skeleton.json")]
    return ["--poses", str(bodies / "poses"), "--shapes", str(bodies / "people"), "-o", str(bodies / output),
            "--config", str(file), *known, *map(str, more)]


def learned(bodies, output, *more, search=False, **settings):
    """The bytes of the model."""
    assert run(learn, "scape learn", words(bodies, output, *more, search=search, **settings)) == 0
    return (bodies / output).read_bytes()


def killed(module, name, after, argv):
    script = KILLED.format(package=module.__name__, name=name, after=after)
    ended = subprocess.run([sys.executable, "-c", script, *argv], capture_output=True, check=False,
                           cwd=Path(__file__).parents[1])
    assert ended.returncode == -9, ended.stderr.decode()


def moved(path):
    mesh = read_mesh(path)
    write_mesh(path, mesh.with_vertices(mesh.vertices * [1, 1, 1.01]))


def anew(counted, since):
    """What was done since the calls were copied."""
    return {stage: calls - since[stage] for stage, calls in counted.items() if calls > since[stage]}


@pytest.mark.slow
def test_killed_and_started_again_it_goes_on_and_ends_with_the_same_bytes(bodies, counted):
    undisturbed = learned(bodies, "a.npz")
    assert counted == {**ALL, "skeleton": 0}
    since = dict(counted)
    killed(scape, "shape_gradients", 4, words(bodies, "b.npz"))
    assert not (bodies / "b.npz").exists()
    assert learned(bodies, "b.npz") == undisturbed
    assert anew(counted, since) == {"people": 2, "components": 1, "pictures": 1}
    assert sorted(p.name for p in bodies.glob(".b.npz.scapekit/done/*")) == [
        "pose space.npz", "shape components.npz"]            # what later ones are made of has gone
    assert not list(bodies.glob(".b.npz.scapekit/making/*")) and not list(bodies.glob(".*.part*"))


@pytest.mark.slow
@pytest.mark.parametrize("more, done", [
    ([], {"pictures": 1}),
    (["--landmarks"], {"pictures": 1}),
    ({"components": 2}, {"people": 6, "components": 1, "pictures": 1}),
    ({"refinements": 2}, {"poses": 1, "people": 6, "components": 1, "pictures": 1}),
    ({"search": False}, {"pictures": 1}),              # the skeleton that was found is given: nothing follows from it
    (["--force"], ALL)])
def test_a_setting_that_changes(bodies, searched, counted, more, done):
    learned(bodies, "m.npz", search=True)
    since = dict(counted)
    if "--landmarks" in more:
        (bodies / "marks.json").write_text('{"nose": 3}')
        more = ["--landmarks", bodies / "marks.json"]
    settings, more = (more, []) if isinstance(more, dict) else ({}, more)
    settings = {"search": True, **settings}
    found = learned(bodies, "m.npz", *more, **settings)
    assert anew(counted, since) == done
    assert found == learned(bodies, "fresh.npz", *more, **settings)


@pytest.mark.slow
@pytest.mark.parametrize("file, done", [
    ("poses/pose3.ply", ALL), ("people/person3.ply", {"people": 6, "components": 1, "pictures": 1})])
def test_a_mesh_that_changes(bodies, searched, counted, file, done):
    learned(bodies, "m.npz", search=True)
    since = dict(counted)
    moved(bodies / file)
    found = learned(bodies, "m.npz", search=True)
    assert anew(counted, since) == done
    assert found == learned(bodies, "fresh.npz", search=True)


@pytest.mark.parametrize("step", ["skeleton", "pose space", "shape components"])
def test_a_damaged_step_is_made_anew(bodies, searched, counted, step):
    undisturbed, since = learned(bodies, "m.npz", search=True), dict(counted)
    path = bodies / ".m.npz.scapekit/done" / f"{step}.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    assert learned(bodies, "m.npz", search=True) == undisturbed
    assert set(anew(counted, since)) >= {{"skeleton": "skeleton", "pose space": "poses"}.get(step, "components")}


def test_what_is_not_ours_stays(bodies, capsys):
    for name in ("m.npz", "m.parts.png"):
        (bodies / name).write_text("mine")
        assert run(learn, "scape learn", words(bodies, "m.npz")) == 1
        assert name in capsys.readouterr().err and (bodies / name).read_text() == "mine"
        assert not (bodies / "m.npz.report.json").exists()
        (bodies / name).unlink()
    learned(bodies, "m.npz")


def test_pictures_of_another_run_go_and_come(bodies):
    learned(bodies, "m.npz")
    assert {p.name for p in bodies.glob("*.png")} == {"m.parts.png", "m.components.png"}
    given = words(bodies, "m.npz")
    del given[given.index("--shapes"):given.index("--shapes") + 2]
    assert run(learn, "scape learn", given) == 0
    assert {p.name for p in bodies.glob("*.png")} == {"m.parts.png"}
    learned(bodies, "m.npz", components=2)
    assert {p.name for p in bodies.glob("*.png")} == {"m.parts.png", "m.components.png"}


def test_a_second_run_on_one_output_leaves(bodies, capsys):
    with beside(bodies / "m.npz"):
        assert run(learn, "scape learn", words(bodies, "m.npz")) == 1
    assert "another run" in capsys.readouterr().err
    learned(bodies, "m.npz")
