"""Every number that a user chooses has a range, and a number outside it ends a command before it begins."""
import dataclasses
import functools
import importlib
import inspect
import json
import pkgutil
import re
import typing

import numpy as np
import pytest

import completion
import model
import scanprep
from completion.__main__ import COMMANDS
from completion.mocap.mosh.mosh import MoshConfig
from completion.mocap.subject.person import PersonConfig
from scanprep import command_line, config_files
from scanprep.console import Metric, Outcome
from scanprep.geometry import storage
from scanprep.judgement import Judgement
from scanprep.ranges import LARGE, OutOfRangeError, Range, Settings, ranges


def commands(listed=COMMANDS, prog="scape"):
    for name, (_, target) in listed.items():
        module, function = target.split(":")
        found = importlib.import_module(module)
        if function == "group":
            yield from commands(found.COMMANDS, f"{prog} {name}")
        else:
            yield f"{prog} {name}", getattr(found, function)


def all_settings():
    for package in (scanprep, model, completion):
        for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
            # PyTorch is optional, and its room has no settings
            if not module.name.endswith("__main__") and module.name != "model.torch":
                importlib.import_module(module.name)

    def below(cls):
        for sub in cls.__subclasses__():
            yield from {sub, *below(sub)}
    return sorted({c for c in below(Settings) if c.__module__.split(".")[0] in ("scanprep", "model", "completion")},
                  key=lambda c: c.__qualname__)


CALLS = dict(commands())
SETTINGS = all_settings()


def kinds(annotation):
    """Types of the numbers in an annotation, one of each kind, and how many values the flag takes."""
    if annotation in (int, float):
        return [annotation]
    if typing.get_origin(annotation) is typing.Literal or annotation is np.ndarray:
        return []
    return list(dict.fromkeys(k for part in typing.get_args(annotation) for k in kinds(part)))


def of_command(function):
    """(flag, type, range, default, annotation) of every number of a command."""
    hints, shown = typing.get_type_hints(function), inspect.signature(function).parameters
    settings = {name: p.default for name, p in shown.items() if isinstance(p.default, Settings)}
    owners = [(name, function, p.default) for name, p in shown.items() if name not in settings]
    for path, flag in ((f.path, f) for f in config_files.flags(settings).values()):
        owner = settings[path[0]]
        for step in path[1:-1]:
            owner = getattr(owner, step)
        owners.append((path[-1], type(owner), flag.value))
    flags = {argument.name: argument.flag for argument in command_line.Arguments(function, "scape", []).listed}
    for name, owner, default in owners:
        hints = typing.get_type_hints(owner)
        for kind in kinds(hints[name]) if name in hints else ():
            yield flags[name], kind, ranges(owner)[name], default, hints[name]


def needed(function):
    """What a command cannot do without."""
    words = []
    for argument in command_line.Arguments(function, "scape", []).listed:
        if argument.required:
            value = (str(argument.choices[0]) if argument.choices else "100" if argument.type is int else
                     "out" if argument.group == "output" else "there")
            words = [value, *words] if argument.place else [*words, argument.flag, value]
    return words


def wrong(kind, allowed):
    """Numbers that no such option takes, as a user would write them."""
    if kind is int:
        return [str(int(allowed.low) - 1), str(10**30)]
    return ["nan", "inf", "0" if allowed.low == 1e-12 else f"{allowed.low - 1:.12g}"]


def usages():
    for prog, function in CALLS.items():
        for flag, kind, allowed, _, hint in of_command(function):
            for value in wrong(kind, allowed):
                yield prog, flag, value, hint


def written(flag, value, hint):
    """A flag and as many values as it takes."""
    kinds = [hint, *typing.get_args(hint)]
    tuples = [typing.get_args(kind) for kind in kinds if typing.get_origin(kind) is tuple]
    fixed = max((len(a) for a in tuples if Ellipsis not in a and all(x in (int, float, str) for x in a)), default=1)
    texts = any(str in a for a in tuples)
    return [flag, *(["part"] if texts else []), *[value] * (fixed - texts)] if fixed > 1 else [flag, value]


def test_every_command_is_here():
    assert len(CALLS) >= 33 and len(SETTINGS) >= 25
    assert len(list(usages())) > 60


@pytest.mark.parametrize("prog", CALLS)
def test_wrong_numbers_end_a_command_before_it_begins(prog, capsys, tmp_path, monkeypatch):
    """One line that names the option, exit code 2, nothing written, the command itself never called."""
    monkeypatch.chdir(tmp_path)
    function, called = CALLS[prog], []

    @functools.wraps(function)
    def spy(*args, **named):
        called.append(named)

    for _, flag, value, hint in (u for u in usages() if u[0] == prog):
        words = [w for w in needed(function)]
        if flag in words:
            at = words.index(flag)
            del words[at:at + 2]
        code = command_line.run(spy, prog, [*words, *written(flag, value, hint)])
        said = capsys.readouterr().err
        assert code == 2, (flag, value, code, said)
        assert re.fullmatch(rf"{prog}: {re.escape(flag)}: expected [^\n]*, got [^\n]*\n", said), (flag, value, said)
    assert not called and not list(tmp_path.iterdir())


def flags(function):
    """How many flags a command has, those that every command has too; what is given by its place is none."""
    return sum(not argument.place for argument in command_line.Arguments(function, "scape", []).listed)


def test_commands_have_few_flags():
    """Eight of all are --up, of commands that turn a scan or a model; one is --static of mosh.

    Seven are of figures: --own-mesh and --names of two commands, --cut, and --joints and --start of `pick`.
    """
    counted = {prog: flags(function) for prog, function in CALLS.items()}
    assert {prog: n for prog, n in counted.items() if n > 14} == {} and sum(counted.values()) <= 302, counted


@pytest.mark.parametrize("prog", CALLS)
def test_defaults_are_in_their_ranges(prog, monkeypatch, tmp_path):
    function, called = CALLS[prog], []
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").touch()

    @functools.wraps(function)
    def spy(*args, **named):
        called.append(named)
        return Outcome(None, [Metric("done", 1)], judgement=Judgement())

    assert command_line.run(spy, prog, needed(function)) == 0 and len(called) == 1


@pytest.mark.parametrize("cls", SETTINGS, ids=lambda c: c.__qualname__)
def test_no_number_of_settings_may_be_nan_or_infinite(cls):
    """Nor from Python."""
    hints = typing.get_type_hints(cls)
    given = {f.name: 1 for f in dataclasses.fields(cls)
             if f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING}
    good = cls(**given)
    for field in dataclasses.fields(cls):
        for kind in kinds(hints[field.name]):
            assert ranges(cls)[field.name].high <= LARGE * 10
            for value in (np.nan, np.inf, -np.inf, 1e300) if kind is float else (-10**12, 10**12):
                with pytest.raises(OutOfRangeError, match=rf"^{field.name}: expected"):
                    dataclasses.replace(good, **{field.name: value})
                with pytest.raises(OutOfRangeError, match=rf"^{field.name}: expected"):
                    dataclasses.replace(good, **{field.name: (value,)})


def test_all_settings_are_checked():
    """A frozen dataclass that is called a config is one of `Settings`, or its numbers would go unchecked."""
    for module in {c.__module__ for c in SETTINGS}:
        for name, cls in vars(importlib.import_module(module)).items():
            if isinstance(cls, type) and dataclasses.is_dataclass(cls) and name.endswith(("Config", "Settings")):
                assert issubclass(cls, Settings), name


def test_ranges_in_words():
    assert [str(r) for r in (Range(), Range(1e-12), Range(1e-12, 1), Range(-20, 20), Range(1))] == [
        "at least 0", "above 0", "above 0, at most 1", "-20 to 20", "at least 1"]
    with pytest.raises(OutOfRangeError, match=r"^annealing: expected above 0, got 0\.0$"):
        PersonConfig(annealing=(1.0, 0.0))
    with pytest.raises(OutOfRangeError, match="outlier"):
        dataclasses.replace(MoshConfig().poses, outlier=float("nan"))


def test_settings_survive_json():
    assert json.loads(json.dumps(storage.as_json(PersonConfig())))["frames"] == PersonConfig().frames
