"""What commands write: whole or not at all, and nothing of the user's is lost."""
import json
import os
from dataclasses import dataclass

import pytest
from trees import die_at_move, tree

from scanprep import command_line
from scanprep.batch.opening import FileWorkspace, beside
from scanprep.batch.ownership import HOME
from scanprep.batch.workspace import Task, Workspace
from scanprep.cli import Output
from scanprep.console import Metric, Outcome
from scanprep.judgement import Judgement


def write(output: Output, text: str = "text") -> Outcome:
    """Write."""
    if text == "fail":
        output.write_text("half")
        raise ValueError(f"{output}: failed")
    output.write_text(text)
    output.with_suffix(".more.txt").write_text(text)
    return Outcome(output, [Metric("letters", len(text))], judgement=Judgement())


def write_alone(output: Output, text: str = "text") -> Outcome:
    """Write nothing beside it."""
    output.write_text(text)
    return Outcome(output, [Metric("letters", len(text))], judgement=Judgement())


def write_folder(output: Output) -> Outcome:
    """Write a folder."""
    (output / "inner").mkdir(parents=True)
    (output / "inner" / "a.txt").write_text("a")
    return Outcome(output, [], judgement=Judgement())


def resumed(output: Output, text: str = "text", *, space: Workspace) -> Outcome:
    """Write in steps."""
    length = space.step("s", text, lambda folder: (folder / "a.txt").write_text(text))
    return Outcome(output, [Metric("letters", length)], judgement=Judgement())


def learned(output: Output, text: str = "text", *, space: FileWorkspace) -> Outcome:
    """Write a file in steps."""
    length = space.step("s", text, lambda folder: len(text))
    output.write_text(text)
    return Outcome(output, [Metric("letters", length)], judgement=Judgement())


def command(function, output, *words):
    return command_line.run(function, "scape x", ["--output", str(output), *words])


def test_an_output_file_that_is_not_ours_stays(tmp_path, capsys):
    out = tmp_path / "a.txt"
    assert command(write, out) == 0 and out.read_text() == "text"
    assert command(write, out, "--text", "other") == 0 and out.read_text() == "other"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.more.txt", "a.txt", "a.txt.report.json"]
    report = json.loads((tmp_path / "a.txt.report.json").read_text())
    assert set(report["written"]) == {"a.txt", "a.more.txt"}
    for name in ("a.txt", "a.more.txt"):
        before = {**tree(tmp_path), name: b"edited"}
        (tmp_path / name).write_text("edited")
        assert command(write, out, "--text", "third") == 1
        assert f"{tmp_path / name}: in the way of the output" in capsys.readouterr().err
        assert tree(tmp_path) == before
        (tmp_path / name).write_text("other")


@pytest.mark.parametrize("at", range(8))
def test_a_command_killed_between_any_two_moves(tmp_path, monkeypatch, at):
    out = tmp_path / "a.txt"
    assert command(write, out) == 0
    die_at_move(monkeypatch, at, lambda: command(write, out, "--text", "other"))
    assert command(write, out, "--text", "other") == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.more.txt", "a.txt", "a.txt.report.json"]
    assert out.read_text() == (tmp_path / "a.more.txt").read_text() == "other"


def test_a_command_that_fails_writes_nothing(tmp_path, capsys):
    assert command(write, tmp_path / "new" / "a.txt", "--text", "fail") == 1
    assert capsys.readouterr().err == f"scape x: {tmp_path / 'new' / 'a.txt'}: failed\n"
    assert not list(tmp_path.iterdir())


def test_an_output_folder_that_is_not_ours_stays(tmp_path, capsys):
    out = tmp_path / "out"
    assert command(write_folder, out) == 0 and command(write_folder, out) == 0
    assert set(tree(out)) == {"inner/a.txt", "report.json"} and sorted(os.listdir(tmp_path)) == ["out"]
    foreign = tmp_path / "mine"
    (foreign / "inner").mkdir(parents=True)
    (foreign / "note.txt").write_text("mine")
    for function in (write_folder, resumed):
        assert command(function, foreign) == 1
        assert tree(foreign) == {"note.txt": b"mine"} and not (foreign / HOME).exists()
    assert "in the way of the output" in capsys.readouterr().err


def test_a_report_in_the_way_is_one_line(tmp_path, capsys):
    assert command(resumed, tmp_path / "out") == 0
    (tmp_path / "out" / "report.json").unlink()
    (tmp_path / "out" / "report.json").mkdir()
    assert command(resumed, tmp_path / "out") == 1
    assert "report.json: in the way of the output" in capsys.readouterr().err


def test_steps_of_a_file_are_kept_beside_it(tmp_path):
    out = tmp_path / "m.npz"
    assert command(learned, out) == 0
    home = tmp_path / f".m.npz{HOME}"
    when = (home / "done" / "s.npz").stat().st_mtime_ns
    assert command(learned, out) == 0 and (home / "done" / "s.npz").stat().st_mtime_ns == when
    assert command(learned, out, "--force") == 0 and (home / "done" / "s.npz").stat().st_mtime_ns != when
    with beside(out) as space:
        space.drop_record("s")
    assert not home.exists() and out.exists()


def test_files_that_differ_in_their_endings_keep_their_reports(tmp_path):
    """A second output neither takes the report of the first nor, as not made by it, the file itself."""
    for name in ("walk.glb", "walk.bvh", "walk.glb"):
        assert command(write_alone, tmp_path / name, "--text", name) == 0
    for name in ("walk.glb", "walk.bvh"):
        assert (tmp_path / name).read_text() == name
        assert set(json.loads((tmp_path / f"{name}.report.json").read_text())["written"]) == {name}
    assert len(os.listdir(tmp_path)) == 4


@dataclass(frozen=True)
class Refuse:
    works: bool

    def __call__(self, number, room):
        if not (self.works and number == 1):
            raise ValueError(f"task {number} is not done")
        return number


def failing(output: Output, works: bool = False, *, space: Workspace) -> Outcome:
    """Prepare, then fail at all tasks but one, if that."""
    space.step("prepared", 0, lambda folder: (folder / "a.txt").write_text("a"))
    done = space.run(Refuse(works), [Task("1", 1, "1"), Task("2", 2, "2")])
    return Outcome(output, [], failures=list(done.failures.values()), judgement=Judgement())


def test_where_all_tasks_fail_no_output_of_the_command_stays(tmp_path, capsys):
    out = tmp_path / "new" / "out"
    assert command(failing, out) == 1
    assert capsys.readouterr().err.splitlines() == [
        "scape x: failed: task 1 is not done", "scape x: failed: task 2 is not done",
        "scape x: all failed; nothing was written"]
    assert sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")) == []
    assert command(failing, out, "--works") == 1 and (out / "a.txt").exists()
    assert command(failing, out) == 1 and (out / "a.txt").exists()                  # what was there before stays
