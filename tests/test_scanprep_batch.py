"""Work that is done once: what is kept, what is done anew, what is whole, and what is left alone."""
import dataclasses
import json
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from trees import die_at_move, tree

from scanprep import Mesh
from scanprep.batch import digests as digests_module
from scanprep.batch.digests import Digests
from scanprep.batch.opening import workspace
from scanprep.batch.ownership import HOME, ForeignFileError
from scanprep.batch.pool import Workers
from scanprep.batch.room import Job, TaskContext, attempt
from scanprep.batch.values import load_value, save_value
from scanprep.batch.workspace import Task
from scanprep.console import Metric
from scanprep.geometry import storage

TRIANGLE = Mesh(np.eye(3), [[0, 1, 2]])


@dataclasses.dataclass(frozen=True)
class Copy:
    """Copies files in capitals, and counts how often in a file of its own."""

    count: Path = dataclasses.field(metadata={"digest": False})
    ending: str = "!"

    def __call__(self, given, room):
        with open(self.count, "a") as out:
            out.write("x")
        text = given.read_text()
        if "bad" in text:
            raise ValueError(f"{given}: bad")
        if "told" in text:
            warnings.warn_explicit(text, UserWarning, str(given), 1, "scanprep.told")
        length = room.step("length", given, lambda: len(text))
        (room.folder / "copy.txt").write_text(text.upper() + self.ending)
        return length


@pytest.fixture
def texts(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("a", "b", "c"):
        (tmp_path / "in" / f"{name}.txt").write_text(f"text of {name}")
    return sorted((tmp_path / "in").iterdir())


def copied(tmp_path, texts, ending="!", workers=1, force=False):
    """Results, and how many were made."""
    (tmp_path / "count").write_text("")
    with workspace(tmp_path / "out", force) as space:
        done = space.run(Copy(tmp_path / "count", ending), [Task(p.stem, p, p.stem) for p in texts], Workers(workers))
    return done, len((tmp_path / "count").read_text())


@pytest.mark.parametrize("value", [
    None, True, 3, 0.1, float("nan"), "text", [1, "a"], (1, (2.5, None)), {"a": [1], 2: "b"}, Path("a/b"),
    np.arange(6.0).reshape(2, 3), np.float32(0.1), np.zeros((0, 3)), np.array(["a", "bc"]), TRIANGLE,
    [Metric("distance", np.float64(1.5), "mm")]], ids=lambda v: type(v).__name__)
def test_a_value_comes_back_as_it_was(tmp_path, value):
    save_value(tmp_path / "v.npz", value, {})
    back = load_value(tmp_path / "v.npz")
    digests = Digests()
    assert type(back) is type(value)
    assert back == value if isinstance(value, Path) else digests.of(back) == digests.of(value)


def test_values_of_other_kinds_are_refused(tmp_path):
    """When they are written, and where a file names a class of others."""
    for wrong in (object(), np.array([None]), pytest):
        with pytest.raises(TypeError):
            save_value(tmp_path / "v.npz", wrong, {})
    assert not list(tmp_path.iterdir())
    told = {"class": "subprocess:Popen", "fields": {}}
    header = json.dumps({"kind": "result", "version": 1, "value": told})
    np.savez(tmp_path / "v.npz", header=np.array(header))
    with pytest.raises(storage.StorageError, match="not of this project"):
        load_value(tmp_path / "v.npz")


def test_digests_change_with_everything(tmp_path):
    file = tmp_path / "f"
    file.write_bytes(b"one")
    values = [1, 1.0, "1", True, None, [1], [1, 1], [[1], 1], {"a": 1}, {"b": 1}, np.ones(1), np.ones(2),
              np.ones((1, 2)), np.ones(1, dtype=np.float32), file, TRIANGLE, Metric("a", 1), Metric("a", 2),
              ("ab", "c"), ("a", "bc")]
    digests = Digests()
    found = [digests.of(value) for value in values]
    assert len(set(found)) == len(values)
    assert found == [Digests().of(value) for value in values]
    file.write_bytes(b"two")
    assert digests.of(file) not in found


def test_only_what_depends_on_a_change_is_done_anew(tmp_path, texts):
    done, made = copied(tmp_path, texts)
    assert made == 3 and done.values == {"a": 9, "b": 9, "c": 9} and done.fresh == ("a", "b", "c")
    before = tree(tmp_path / "out")
    assert copied(tmp_path, texts)[1] == 0
    texts[1].write_text("longer text of b")
    done, made = copied(tmp_path, texts)
    assert made == 1 and done.values["b"] == 16 and done.fresh == ("b",)
    assert {n for n, data in tree(tmp_path / "out").items() if data != before[n]} == {"b/copy.txt"}
    assert copied(tmp_path, texts, "?")[1] == 3                  # a setting
    assert copied(tmp_path, texts, "?", force=True)[1] == 3
    shutil.move(tmp_path / "out", tmp_path / "elsewhere")
    shutil.move(tmp_path / "elsewhere", tmp_path / "out")
    (tmp_path / "out" / "a" / "copy.txt").unlink()
    assert copied(tmp_path, texts, "?")[1] == 1                  # a file that is gone
    record = tmp_path / "out" / HOME / "done" / "c.npz"
    record.write_bytes(record.read_bytes()[:-40])
    assert copied(tmp_path, texts, "?")[1] == 1                  # a result that is damaged


def test_what_another_program_made_is_made_anew(tmp_path, texts, monkeypatch):
    """Tasks, their steps and steps of commands; results stay those of their work, and files keep their digests."""
    package = tmp_path / "installed" / "model"
    (package / "layouts").mkdir(parents=True)
    monkeypatch.setattr(digests_module, "INSTALLED", package.parent)

    def made():
        """How many tasks, steps of them, and steps of the output were made; digests of a model."""
        digests_module._program_in.cache_clear()
        (tmp_path / "count").write_text("")
        steps = []
        with workspace(tmp_path / "out") as space:
            work = Copy(tmp_path / "count")
            before = list(space.results(work))
            space.run(work, [Task(p.stem, p, p.stem) for p in texts], Workers(1))
            space.step("table", 1, lambda folder: steps.append(1))
            TaskContext(tmp_path, tmp_path / "steps").step("part of a task", 1, lambda: steps.append(1))
            assert list(space.results(work)) == (before or ["a", "b", "c"])
        return len((tmp_path / "count").read_text()), len(steps), Digests().of(TRIANGLE)

    (package / "fit.py").write_text("ROUNDS = 3")
    (package / "layouts" / "cmu41.json").write_text("{}")
    first = made()
    assert first[:2] == (3, 2) and made() == (0, 0, first[2])
    (package / "__pycache__").mkdir()
    (package / "__pycache__" / "fit.pyc").write_bytes(b"compiled")
    assert made() == (0, 0, first[2])
    (package / "fit.py").write_text("ROUNDS = 4")
    assert made() == first and made() == (0, 0, first[2])
    (package / "layouts" / "cmu41.json").write_text("[]")
    assert made() == first
    (package / "fit.py").rename(package / "fits.py")
    assert made() == first


def test_results_with_the_values_of_another_program_are_no_results(tmp_path, texts):
    copied(tmp_path, texts)
    record = tmp_path / "out" / HOME / "done" / "a.npz"
    header, arrays = storage.load(record, "result", (1,))
    header["value"] = {"class": "scanprep.console:Metric", "fields": {"title": "a field that has gone"}}
    told = {name: value for name, value in header.items() if name not in ("kind", "version")}
    storage.save(record, "result", 1, arrays, told)
    with workspace(tmp_path / "out") as space:
        assert list(space.results(Copy(tmp_path / "count"))) == ["b", "c"]


def test_processes_change_nothing(tmp_path, texts):
    texts[0].write_text("told: a")
    with pytest.warns(UserWarning, match="told: a"):
        copied(tmp_path, texts)
    one = tree(tmp_path / "out")
    shutil.rmtree(tmp_path / "out")
    with pytest.warns(UserWarning, match="told: a") as caught:                # by processes as by this one
        assert copied(tmp_path, texts, workers=2)[0].values == {"a": 7, "b": 9, "c": 9}
    assert len(caught) == 1
    assert tree(tmp_path / "out") == one


def test_a_failure_stops_no_other_and_nothing_stale_stays(tmp_path, texts):
    copied(tmp_path, texts)
    texts[0].write_text("bad")
    done, _ = copied(tmp_path, texts)
    assert done.failures == {"a": f"{texts[0]}: bad"} and set(done.values) == {"b", "c"}
    assert set(tree(tmp_path / "out")) == {"b/copy.txt", "c/copy.txt"}
    missing = tmp_path / "none.txt"
    lost = attempt(Copy(tmp_path / "count"), Job("n", missing, tmp_path / "x"))
    assert "No such file" in lost.reason and str(missing) in lost.reason


def test_what_is_not_ours_stays(tmp_path, texts):
    with pytest.raises(ForeignFileError, match="nothing was touched"), workspace(tmp_path / "in"):
        pass
    assert sorted(p.name for p in (tmp_path / "in").iterdir()) == ["a.txt", "b.txt", "c.txt"]
    copied(tmp_path, texts[:2])
    (tmp_path / "out" / "c").mkdir()
    (tmp_path / "out" / "c" / "mine.txt").write_text("mine")
    (tmp_path / "out" / "a" / "notes.txt").write_text("mine too")
    (tmp_path / "out" / "b" / "copy.txt").write_text("edited")
    for path in texts:
        path.write_text("changed")
    done, made = copied(tmp_path, texts)
    assert set(done.failures) == {"b", "c"} and made == 2
    assert str(tmp_path / "out" / "c") in done.failures["c"] and "copy.txt" in done.failures["b"]
    assert tree(tmp_path / "out") == {"a/copy.txt": b"CHANGED!", "a/notes.txt": b"mine too", "b/copy.txt": b"edited",
                                      "c/mine.txt": b"mine"}


@pytest.mark.parametrize("at", range(12))
def test_killed_between_any_two_moves(tmp_path, texts, monkeypatch, at):
    """A run that ends between any two renames leaves what the next run puts right."""
    copied(tmp_path, texts)
    for path in texts:
        path.write_text("changed " + path.name)
    die_at_move(monkeypatch, at, lambda: copied(tmp_path, texts))
    done, made = copied(tmp_path, texts)
    assert not done.failures and made <= 3
    assert tree(tmp_path / "out") == {f"{p.stem}/copy.txt": f"CHANGED {p.name.upper()}!".encode() for p in texts}
    assert not any((tmp_path / "out" / HOME / place).exists() and os.listdir(tmp_path / "out" / HOME / place)
                   for place in ("ready", "making"))


def test_files_that_a_result_has_no_more_go(tmp_path):
    with workspace(tmp_path / "out") as space:
        space.step("s", 1, lambda folder: [(folder / n).write_text(n) for n in ("x", "y")])
        (tmp_path / "out" / "y").write_text("edited")
        space.step("s", 2, lambda folder: (folder / "z").write_text("z"))
    assert set(tree(tmp_path / "out")) == {"y", "z"}


def test_a_second_run_is_told_and_leaves(tmp_path):
    code = ("import sys\nfrom scanprep.batch.opening import workspace\nwith workspace(sys.argv[1]):\n"
            "    print('in', flush=True)\n    sys.stdin.read()\n")
    other = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "out")], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE)
    assert other.stdout.readline() == b"in\n"
    with pytest.raises(ValueError, match=f"another run is at work .*process {other.pid} "), \
            workspace(tmp_path / "out"):
        pass
    other.communicate()
    assert not (tmp_path / "out").exists()                       # neither of them did anything


@pytest.mark.slow
def test_workers_go_when_the_run_is_killed(tmp_path):
    code = ("import sys\nfrom pathlib import Path\nfrom scanprep.batch.pool import Workers, run_jobs\n"
            "from scanprep.batch.room import Job\n"
            "from test_scanprep_batch import Sleep\n"
            "place = Path(sys.argv[1])\n"
            "list(run_jobs(Sleep(), [Job(str(i), place, place) for i in range(2)], Workers(2)))")
    run = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=Path(__file__).parent)
    while len(pids := [int(p.name) for p in tmp_path.glob("[0-9]*")]) < 2:
        assert run.poll() is None
    run.kill()
    run.wait()
    for _ in range(100):
        if not any(Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().split()[2]
                   for pid in pids):
            break
        subprocess.run(["sleep", "0.1"], check=True)
    else:
        pytest.fail("workers outlive the run")


@dataclasses.dataclass(frozen=True)
class Sleep:
    """Says which process it is, and sleeps."""

    def __call__(self, given, room):
        (given / str(os.getpid())).touch()
        subprocess.run(["sleep", "60"], check=True)
