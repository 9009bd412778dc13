"""The command that runs all benchmarks: what is kept, what is told where one cannot run, and its catalogue."""
import ast
import importlib.util
import json
import re
import shlex
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent / "benchmarks"


@pytest.fixture(scope="module")
def benchmarks():
    """The module of `all.py`, with its neighbours importable."""
    sys.path.insert(0, str(FOLDER))
    try:
        found = importlib.util.spec_from_file_location("run_benchmarks", FOLDER / "all.py")
        module = importlib.util.module_from_spec(found)
        found.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(FOLDER))


@pytest.fixture()
def runner(benchmarks, tmp_path, monkeypatch):
    """One with scripts, results and work in folders of its own, and no data."""
    monkeypatch.setattr(benchmarks, "HERE", tmp_path)
    monkeypatch.setattr(benchmarks, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(benchmarks, "digest_of_packages", lambda: "the packages as they are")
    monkeypatch.delenv("SCAPEKIT_DATA", raising=False)
    (tmp_path / "results").mkdir()
    (tmp_path / "good.py").write_text("import sys; open(sys.argv[-1], 'w').write('{\"rows\": 3}')")
    (tmp_path / "bad.py").write_text("raise SystemExit('no such scans')")
    return benchmarks.Runner(tmp_path / "work", quick=False)


def entry(benchmarks, name, arguments, quick=None):
    return benchmarks.Benchmark(name, f"Title of {name}", arguments, lambda report: f"table of {report['rows']}",
                                quick=quick)


def test_what_cannot_run_says_so_and_the_others_run(benchmarks, runner, capsys):
    chosen = [entry(benchmarks, name, arguments) for name, arguments in
              (("bad", "bad.py"), ("dataless", "good.py C3D"), ("modelless", "good.py -m MEN"), ("good", "good.py"))]
    benchmarks.run_all(runner, chosen, 2)
    assert "good, " in capsys.readouterr().out
    sections = [benchmarks.shown(one, runner) for one in chosen]
    assert "no such scans" in sections[0]
    assert "C3D is not there" in sections[1]
    assert "MEN is not there" in sections[2]
    assert "table of 3" in sections[3]


def test_a_result_is_kept_until_the_code_changes(benchmarks, runner, tmp_path):
    one = entry(benchmarks, "good", "good.py")
    benchmarks.run_all(runner, [one], 1)
    assert runner.is_done(one)
    (tmp_path / "results" / "good.json").write_text(json.dumps({"rows": 4}))
    benchmarks.run_all(runner, [one], 1)
    assert "table of 4" in benchmarks.shown(one, runner)
    with (tmp_path / "good.py").open("a") as script:
        script.write("\nchanged = True")
    assert not runner.is_done(one)
    assert "a result of earlier code" in benchmarks.shown(one, runner)
    benchmarks.run_all(runner, [one], 1)
    assert "table of 3" in benchmarks.shown(one, runner)


@pytest.mark.parametrize("quick", ["good.py --few", ""])
def test_a_whole_result_is_better_than_a_quick_one(benchmarks, runner, tmp_path, quick):
    one, hurried = entry(benchmarks, "good", "good.py", quick), benchmarks.Runner(runner.work, quick=True)
    assert hurried.arguments(one) == quick
    benchmarks.run_all(runner, [one], 1)
    assert hurried.arguments(one) == "good.py" and hurried.is_done(one)
    with (tmp_path / "good.py").open("a") as script:
        script.write("\nchanged = True")
    assert hurried.arguments(one) == quick and not hurried.is_done(one)


def test_every_benchmark_names_a_script_and_options_that_it_has(benchmarks):
    names = [one.name for one in benchmarks.BENCHMARKS]
    assert len(set(names)) == len(names)
    for one in benchmarks.BENCHMARKS:
        for arguments in filter(None, (one.arguments, one.quick)):
            script, *words = shlex.split(arguments)
            text = (FOLDER / script).read_text()
            for word in (*words, "-o"):
                option = word.replace("--no-", "--")
                assert not re.match("-[a-z-]", word) or f'"{option}"' in text, f"{arguments}: {script} has no {word}"


@pytest.mark.parametrize("script", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_a_script_reads_only_options_that_it_has(script):
    nodes = list(ast.walk(ast.parse(script.read_text())))
    calls = [node for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]
    options = {word.value.lstrip("-").replace("-", "_") for call in calls if call.func.attr == "add_argument"
               for word in (*call.args, *(k.value for k in call.keywords if k.arg == "dest"))}
    given = {node.targets[0].id for node in nodes if isinstance(node, ast.Assign) and node.value in calls
             and node.value.func.attr == "parse_args"}
    used = [node for node in nodes if isinstance(node, ast.Attribute) and getattr(node.value, "id", "") in given]
    added = {node.attr for node in used if isinstance(node.ctx, ast.Store)}
    assert {node.attr for node in used} <= options | added


def test_every_mutation_has_its_place_in_the_code_and_its_tests(benchmarks):
    """The table of `mutations.py` goes with the code: each text that it changes is found there, and once."""
    from mutations import MUTATIONS, stands_once

    assert [f"{m.path}: {m.name}" for m in MUTATIONS if not stands_once(m)] == []
    names = [(m.path, m.name) for m in MUTATIONS]
    assert len(set(names)) == len(names)
    assert not {word for m in MUTATIONS for word in m.tests.split() if not (FOLDER.parent / f"test_{word}.py").exists()}


def test_words_about_the_code_do_not_outdate_results(benchmarks):
    code = benchmarks.without_words(b'def f(x):\n    """Twice."""\n    return 2 * x\n')
    assert benchmarks.without_words(b'def f(x):\n    return 2 * x  # twice\n') == code
    assert benchmarks.without_words(b'def f(x):\n    return 3 * x\n') != code


def test_every_headline_is_of_a_benchmark(benchmarks):
    assert set(benchmarks.IN_README) <= set(benchmarks.HEADLINES) <= {one.name for one in benchmarks.BENCHMARKS}


def test_every_result_makes_its_table_and_its_headlines(benchmarks):
    for one in benchmarks.BENCHMARKS:
        report = json.loads((FOLDER / "results" / f"{one.name}.json").read_text())
        assert "|" in one.table(report), one.name
        for line in benchmarks.HEADLINES.get(one.name, lambda report: [])(report):
            what, figure = line
            assert what and re.fullmatch(r"[\d.,]+( of \d+)?( ?(mm|s|MB|MiB|%|°))?", figure), (one.name, line)
