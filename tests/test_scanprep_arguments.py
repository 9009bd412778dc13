"""The command line: help that reads well, errors in one line before anything is done, completion in the shell."""
import json
import re
import subprocess
import warnings
from pathlib import Path

import pytest

from completion.__main__ import COMMANDS, main
from scanprep import command_line
from scanprep.console import Outcome
from scanprep.judgement import Judgement

PATHS = command_line.list_commands(COMMANDS, "scape")


def parsed(path):
    return command_line.Arguments(command_line.load_command(PATHS[path]), path, [])


@pytest.mark.parametrize("path", PATHS)
def test_help_reads_well(path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit) as stop:
        main([*path.split()[1:], "--help"])
    shown = capsys.readouterr().out
    assert stop.value.code == 0 and shown.startswith(f"usage: {path} ") and f"\nExample: {path}" in shown
    assert "None" not in shown and "--no-" not in shown and max(map(len, shown.splitlines())) <= 120
    assert all(argument.sentence for argument in parsed(path).listed)


def test_one_flag_has_one_kind_of_value():
    """A flag takes a file, a number, a word or nothing, in whatever command it is."""
    kinds = {}
    for path in PATHS:
        for argument in parsed(path).listed:
            if argument.flags and argument.flag not in KNOWN:
                kinds.setdefault(argument.flag, set()).add(kind(argument))
    assert {flag: found for flag, found in kinds.items() if len(found) > 1} == {}


KNOWN = {"--subject", "--pose"}     # a mesh or also the word template; a file, and how a character stands


def kind(argument):
    one = argument.parts[0] if argument.parts else argument.type
    return "word" if argument.choices or one is str else one


@pytest.mark.parametrize("words, told", [
    ("complete", "expected SCAN and --output, as in: scape complete SCAN [SCAN ...] -o PATH [options]"),
    ("prep merge -o a.ply", "expected VIEWS, as in: scape prep merge VIEWS -o PATH [options]"),
    ("complete a.ply --outptu b", "--outptu: no such flag; did you mean --output?"),
    ("complete a.ply -o b --unit yard", "--unit: expected one of m, mm, cm, in, unknown, got yard"),
    ("complete a.ply -o b --workers two",
     "--workers: expected a whole number, or an address such as tcp://host:8786, got two"),
    ("complete a.ply -o", "--output: expected one argument"),
    ("prep align a.ply b.ply c.ply -o d.ply", "c.ply: one argument too many"),
    ("mosh a.c3d -o b -m", "--model: expected one argument"),
    ("merge views", "no command 'merge'; did you mean scape prep merge?"),
    ("complte", "no command 'complte'; did you mean complete?"),
    ("demo --quick --full", "--quick, --full: expected at most one of the two"),
])
def test_wrong_usage_is_one_line(words, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    assert re.fullmatch(rf"scape[a-z ]*: {re.escape(told)}\n", capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


def test_a_file_that_is_not_there_is_said_before_anything_else(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "half_view.ply").touch()
    assert main(["complete", "half_veiw.ply", "-o", "out"]) == 1
    assert capsys.readouterr().err == \
        "scape complete: half_veiw.ply: no such file or folder; did you mean half_view.ply?\n"


@pytest.mark.parametrize("words", ["--up -y", "--up=-y", "--betas -1.5 2", "--old_name x", "--renamed x"])
def test_values_may_begin_with_a_dash_and_names_in_python_are_understood(words):
    from pathlib import Path
    from typing import Annotated, Literal

    from scanprep.arguments import Called
    from scanprep.ranges import Signed

    got = {}

    def work(up: Literal["y", "-y"] = "y", betas: tuple[Signed, ...] = (),
             old_name: Annotated[Path | None, Called("--renamed")] = None) -> Outcome:
        got.update(up=up, betas=betas, old_name=old_name)
        return Outcome(None, [], judgement=None)

    work.__annotations__ = {"up": Literal["y", "-y"], "betas": tuple[Signed, ...],
                            "old_name": Annotated[Path | None, Called("--renamed")]}
    Path("x").touch()
    assert command_line.run(work, "scape work", words.split()) == 0
    assert got == {"up": "-y" if "up" in words else "y", "betas": (-1.5, 2.0) if "betas" in words else (),
                   "old_name": Path("x") if "name" in words else None}


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def test_messages_of_python_name_flags(capsys, tmp_path):
    def work(times: int = 2) -> Outcome:
        raise ValueError("a.c3d: in which unit is it? say times='mm'")

    work.__annotations__ = {"times": int}
    assert command_line.run(work, "scape work", []) == 1
    assert capsys.readouterr().err == "scape work: a.c3d: in which unit is it? say --times mm\n"


def test_notes_and_failures_name_flags_too(capsys):
    """Notes are kept in the report."""
    def work(output: Path, times: int = 2) -> Outcome:
        warnings.warn("a.bvh: 30 are assumed; say times=", stacklevel=1)
        output.mkdir()
        return Outcome(output, [], failures=["b.c3d: which of the two? say times=3"], judgement=Judgement())

    work.__annotations__, work.__module__ = {"output": Path, "times": int}, "scanprep.tried"
    work.__globals__["__name__"], before = "scanprep.tried", work.__globals__["__name__"]
    try:
        command_line.run(work, "scape work", ["--output", "out"])
    finally:
        work.__globals__["__name__"] = before
    assert json.loads(Path("out/report.json").read_text())["notes"] == ["a.bvh: 30 are assumed; say --times"]
    said = capsys.readouterr().err
    assert "scape work: note: a.bvh: 30 are assumed; say --times\n" in said
    assert "scape work: failed: b.c3d: which of the two? say --times 3\n" in said


def test_version_and_help_of_a_command(capsys):
    assert main(["--version"]) == 0
    assert re.fullmatch(r"scapekit \d+\.\d+\.\d+\n", capsys.readouterr().out)
    with pytest.raises(SystemExit):
        main(["help", "prep", "merge"])
    assert capsys.readouterr().out.startswith("usage: scape prep merge VIEWS -o PATH")


def test_bash_completes_commands_flags_and_values(capsys, tmp_path):
    assert main(["completion", "bash"]) == 0
    (tmp_path / "scape.bash").write_text(capsys.readouterr().out)

    def offered(*words):
        code = f"source scape.bash; COMP_WORDS=({' '.join(words)} ''); COMP_CWORD={len(words)}; _scape; " \
               'echo "${COMPREPLY[@]}"'
        return subprocess.run(["bash", "-c", code], capture_output=True, text=True, cwd=tmp_path).stdout.split()

    assert {"demo", "prep", "complete"} <= {*offered("scape")} and {"merge", "views"} <= {*offered("scape", "prep")}
    assert offered("scape", "complete", "a.ply", "--up") == ["x", "-x", "y", "-y", "z", "-z"]
