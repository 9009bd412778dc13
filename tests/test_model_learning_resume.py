"""`scape learn` killed, started again, and with inputs that change: nothing lost, nothing stale, nothing done twice."""
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from config_files import config_file
from model_bodies import random_poses, worm_model

from completion.__main__ import main
from model import report
from model.learning import body
from model.learning.parts import ChosenSkeleton
from scanprep import read_mesh, write_mesh
from scanprep.batch.opening import beside

QUICK = {"refinements": 1, "components": 4, "prunings": [0.01], "ridges": [1e-3]}
STEPS = {"skeleton", "pose space", "shape components"}


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
        person = truth.vertices(random_poses(truth, 1, rng, 0.1)[0], rng.normal(size=3))
        write_mesh(tmp_path / "people" / f"person{i}.ply", truth.template.with_vertices(person))
    truth.skeleton.save(tmp_path / "skeleton.json")
    return tmp_path


@pytest.fixture
def searched(monkeypatch):
    """A search for a skeleton that takes no time, for words without --skeleton."""
    chosen = ChosenSkeleton(worm_model().skeleton, {4: 0.001}, False)
    monkeypatch.setattr(body, "choose_skeleton", lambda *given: chosen)


def words(bodies, output, *more, search=False, **settings):
    known = [] if search else ["--skeleton", str(bodies / "skeleton.json")]
    return ["learn", "--poses", str(bodies / "poses"), "--shapes", str(bodies / "people"), "-o", str(bodies / output),
            "--config", str(config_file(bodies, scape={**QUICK, **settings})), *known, *map(str, more)]


def learned(bodies, output, *more, **how):
    """The bytes of the model."""
    assert main(words(bodies, output, *more, **how)) == 0
    return (bodies / output).read_bytes()


def made(bodies, output):
    """When each step that is kept was made."""
    return {path.stem: path.stat().st_mtime_ns for path in (bodies / f".{output}.scapekit" / "done").glob("*.npz")}


@pytest.mark.slow
def test_killed_and_started_again_it_goes_on_and_ends_with_the_same_bytes(bodies):
    undisturbed = learned(bodies, "a.npz")
    child = subprocess.Popen([sys.executable, "-m", "completion", *words(bodies, "b.npz")], stderr=subprocess.DEVNULL,
                             cwd=Path(__file__).parents[1])
    deadline = time.monotonic() + 120
    while "pose space" not in made(bodies, "b.npz"):
        assert child.poll() is None and time.monotonic() < deadline
        time.sleep(0.005)
    os.kill(child.pid, signal.SIGKILL)
    child.wait()
    before = made(bodies, "b.npz")
    assert not (bodies / "b.npz").exists() and learned(bodies, "b.npz") == undisturbed
    after = made(bodies, "b.npz")                              # what later steps are made of has gone
    assert after.keys() == {"pose space", "shape components"} and after["pose space"] == before["pose space"]
    assert not list(bodies.glob(".b.npz.scapekit/making/*")) and not list(bodies.glob(".*.part*"))


@pytest.mark.slow
@pytest.mark.parametrize("change, kept", [
    (["--landmarks", "marks.json"], STEPS), ({"components": 2}, {"skeleton", "pose space"}),
    ({"refinements": 2}, {"skeleton"}), (["--force"], set()), ("poses/pose3.ply", set()),
    ("people/person3.ply", {"skeleton", "pose space"})])
def test_only_what_depends_on_a_change_is_made_anew(bodies, searched, monkeypatch, change, kept):
    monkeypatch.chdir(bodies)
    (bodies / "marks.json").write_text('{"nose": 3}')
    learned(bodies, "m.npz", search=True)
    before = made(bodies, "m.npz")
    if isinstance(change, str):
        mesh = read_mesh(bodies / change)
        write_mesh(bodies / change, mesh.with_vertices(mesh.vertices * [1, 1, 1.01]))
    more, settings = change if isinstance(change, list) else [], change if isinstance(change, dict) else {}
    found = learned(bodies, "m.npz", *more, search=True, **settings)
    assert {step for step, time in made(bodies, "m.npz").items() if before[step] == time} == kept
    assert found == learned(bodies, "fresh.npz", *more, search=True, **settings)


@pytest.mark.parametrize("step", sorted(STEPS))
def test_a_damaged_step_is_made_anew(bodies, searched, step):
    undisturbed = learned(bodies, "m.npz", search=True)
    path = bodies / ".m.npz.scapekit/done" / f"{step}.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    assert learned(bodies, "m.npz", search=True) == undisturbed


def test_what_is_not_ours_stays(bodies, capsys):
    for name in ("m.npz", "m.parts.png"):
        (bodies / name).write_text("mine")
        assert main(words(bodies, "m.npz")) == 1
        assert name in capsys.readouterr().err and (bodies / name).read_text() == "mine"
        assert not (bodies / "m.npz.report.json").exists()
        (bodies / name).unlink()
    learned(bodies, "m.npz")


def test_pictures_of_another_run_go_and_come(bodies):
    both = {"m.parts.png", "m.components.png"}
    learned(bodies, "m.npz")
    assert {p.name for p in bodies.glob("*.png")} == both
    without = words(bodies, "m.npz")
    del without[without.index("--shapes"):without.index("--shapes") + 2]
    assert main(without) == 0 and {p.name for p in bodies.glob("*.png")} == {"m.parts.png"}
    learned(bodies, "m.npz", components=2)
    assert {p.name for p in bodies.glob("*.png")} == both


def test_a_second_run_on_one_output_leaves(bodies, capsys):
    with beside(bodies / "m.npz"):
        assert main(words(bodies, "m.npz")) == 1
    assert "another run" in capsys.readouterr().err
    learned(bodies, "m.npz")
