"""What has no flag comes from a file: every command writes one, reads it again, and says what is wrong with it."""
import dataclasses
import functools
import inspect
import json
from typing import Annotated, Literal

import pytest
from config_files import config_file
from test_scanprep_ranges import CALLS, SETTINGS

from scanprep import command_line, config_files
from scanprep.console import Metric, Outcome
from scanprep.ranges import FLAG, Count, Settings, Share


@dataclasses.dataclass(frozen=True)
class Inner(Settings):
    """Inner.

    Attributes
    ----------
    weight : float
        How much.
    """

    weight: float = 1.0


@dataclasses.dataclass(frozen=True)
class Outer(Settings):
    """Outer.

    Attributes
    ----------
    rounds : int
        How often; a long sentence of many words, which has to be broken into several lines of comment to be read.
    share : float
        Which part.
    way : "near" or "far"
        Where to.
    steps : tuple of float
        How far.
    inner : Inner
        More.
    cleaning : Inner, optional
        Off without it.
    """

    rounds: Annotated[Count, FLAG] = 3
    share: Share = 0.5
    way: Literal["near", "far"] = "near"
    steps: tuple[float, ...] = (4.0, 1.0)
    inner: Inner = Inner()
    cleaning: Inner | None = None

    @classmethod
    def from_paper(cls):
        """As on paper.

        Not as there: nothing.
        """
        return cls(share=0.25)


def work(words: str = "", config: Outer = Outer(), *, times: Count = 1) -> Outcome:
    """Does nothing.

    Example: scape work

    Args:
        words: Words.
        times: Times.
    """


def run(argv, capsys):
    """The settings that the command gets, and what it says when there are none."""
    seen = []

    @functools.wraps(work)
    def spy(words="", config=None, *, times=1):
        seen.append(config)
        return Outcome(None, [Metric("done", 1)], judgement=None)

    code = command_line.run(spy, "scape work", [str(word) for word in argv])
    said = capsys.readouterr()
    return (seen[0] if seen else None), code, said


def test_a_file_changes_what_it_names(tmp_path, capsys):
    path = config_file(tmp_path, share=1, steps=[3, 2.5], way="far", inner={"weight": 2}, cleaning={})
    assert run(["--config", path], capsys)[0] == Outer(share=1, steps=(3.0, 2.5), way="far", inner=Inner(2.0),
                                                       cleaning=Inner())


def test_a_flag_wins_over_the_file_and_the_file_over_the_preset(tmp_path, capsys):
    path = config_file(tmp_path, rounds=5)
    assert run(["--config", path], capsys)[0].rounds == 5
    assert run(["--config", path, "--rounds", 7], capsys)[0].rounds == 7
    assert run(["--preset", "published"], capsys)[0] == Outer.from_paper()
    assert run(["--preset", "published", "--config", config_file(tmp_path, share=0.75)], capsys)[0].share == 0.75


@pytest.mark.parametrize("text, told", [
    ("rounds = 3\nshares = 0.5\n", r":2: shares: expected a setting of this command; did you mean share?"),
    ("\n[inner]\nweigth = 1\n", r":3: inner.weigth: expected a setting of this command; did you mean weight?"),
    ("rounds = 'often'\n", ":1: rounds: Expected int, got str"),
    ("way = 'up'\n", ":1: way: Invalid enum value 'up'"),
    ("# so\nshare = 1.5\n", ":2: share: expected 0 to 1, got 1.5"),
    ("[inner]\nweight = nan\n", ":2: inner.weight: expected at least 0, got nan"),
    ("\ncolours = 2\n", ":2: colours: this setting is gone: all are grey"),
    ("[inner]\nweight = 2\nheight = 1\nwidth = 1\n",
     ":3: inner.height: this setting is gone: it is 3 mm; {path}:4: inner.width: this setting is gone: use the height"),
    ("inner = 3\n", ":1: inner: expected a table, got 3"),
    ("steps = [1, 'two']\n", ":1: steps: Expected float, got str"),
    ("rounds 3\n", ":1: expected TOML"),
])
def test_what_is_wrong_with_a_file(tmp_path, capsys, monkeypatch, text, told):
    gone = tmp_path / "removed.json"
    gone.write_text(json.dumps({"Outer.colours": "all are grey", "Inner.height": "it is 3 mm",
                                "inner.width": "use the height"}))
    monkeypatch.setattr(config_files, "REMOVED", gone)
    path = tmp_path / "my.toml"
    path.write_text(text)
    config, code, said = run(["--config", path], capsys)
    assert config is None and code == 2 and f"{path}{told.format(path=path)}" in said.err
    assert len(said.err.splitlines()) == 1


def test_settings_that_left_are_told_in_one_sentence_each(tmp_path, capsys):
    """They are not there any more, whether their class is or not; also in a file of a command of several groups."""
    classes = {cls.__name__: {field.name for field in dataclasses.fields(cls)} for cls in SETTINGS}
    for key, sentence in json.loads(config_files.REMOVED.read_text()).items():
        owner, _, name = key.rpartition(".")
        assert name not in classes.get(owner, ()) and 1 < len(sentence.split()) <= 25 and sentence[-1] != "."
    path = config_file(tmp_path, scan={"pictures": False, "registration": {}})
    code = command_line.run(CALLS["scape prep run"], "scape prep run", ["scans", "--config", str(path)])
    assert code == 2 and capsys.readouterr().err == (
        f"scape prep run: {path}:2: scan.pictures: this setting is gone: every scan of a set has its picture on the "
        "page\n")


def test_the_written_file_says_what_everything_means(capsys):
    config, code, said = run(["--write-config", "--preset", "published"], capsys)
    assert config is None and code == 0
    assert said.out.startswith("# As on paper.\n#\n# Not as there: nothing.\n\n")
    assert "# Which part.\nshare = 0.25\n" in said.out and "# cleaning = (not set)" in said.out
    assert max(map(len, said.out.splitlines())) <= 102


def settings_of(prog):
    """The settings of a command by the names of its arguments."""
    return {p.name: p.default for p in inspect.signature(CALLS[prog]).parameters.values()
            if isinstance(p.default, Settings)}


@pytest.mark.parametrize("prog", CALLS)
def test_every_command_writes_its_settings_and_reads_them_again(prog, tmp_path):
    settings = settings_of(prog)
    path = tmp_path / "all.toml"
    path.write_text(config_files.write_settings(settings), encoding="utf-8")
    assert config_files.read_settings(path, settings) == settings
    for config in settings.values():
        assert set(config_files.settings_sentences(type(config))) == {f.name for f in dataclasses.fields(config)}


@pytest.mark.parametrize("prog", [prog for prog in CALLS if hasattr(next(iter(settings_of(prog).values()), None),
                                                                    "from_paper")])
def test_the_preset_of_every_command_is_in_force(prog):
    """Also where the command's own settings are not the usual ones, as the size of a statue's images is not."""
    values = settings_of(prog)
    found = command_line._Settings(values, ["--preset", "published"])
    name, usual = next(iter(values.items()))
    paper = type(usual).from_paper()
    own = {f.name for f in dataclasses.fields(usual) if getattr(usual, f.name) != getattr(type(usual)(), f.name)}
    assert found.presets and found.values[name] != usual and own <= {"size"}
    for field in dataclasses.fields(usual):
        source = usual if field.name in own else paper
        assert getattr(found.values[name], field.name) == getattr(source, field.name)
