"""Run every benchmark on today's code, in the order of `catalogue.py`, and write BENCHMARKS.md.

    SCAPEKIT_DATA=... python tests/benchmarks/all.py WORK [--quick] [--only NAME ...] [--at-once N]

WORK is a folder outside the checkout, where models and logs stay. Results (`results/NAME.json`), BENCHMARKS.md and the
README's table of figures are written here. `$SCAPEKIT_DATA` holds the real scans, and the recordings in `cmu_c3d`.
Called again, it goes on: what was measured with the sources as they are is kept. A benchmark that cannot run, because
data or a program are missing or it fails, says so, and the others run. Peers are measured where they are installed:
`pip install ".[benchmarks]"`, Bayesian coherent point drift as the program `bcpd`, `$BPY` and `$NPM` as
`other_programs.py` says.

`--quick` takes fewer bodies where there are many, but keeps a whole result of today's code. `--at-once` runs so many
benchmarks beside each other, each on one thread; those that time whole commands always run alone, on all cores. With
`--tables` nothing is run.
"""
from __future__ import annotations

import argparse
import ast
import concurrent.futures
import hashlib
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from catalogue import BENCHMARKS, Benchmark
from headlines import HEADLINES, IN_README
from protocols import machine
from tables_scans import Rows, table

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RESULTS = HERE / "results"
MARKS = "<!-- figures -->", "<!-- end of figures -->"       # in the README
MODELS = {"MEN": "learning", "FOLD_0": "scape_5fold"}      # and the benchmarks that learn them
PEERS = ("open3d", "pymeshlab", "trimesh", "meshmonk", "pycpd", "pyfmaps", "py-dem-bones", "pymeshfix", "pyfqmr",
         "pymomentum-core", "opensim")


@cache
def digest_of_packages() -> str:
    """Of the sources of the three packages and their tables; comments and docstrings measure nothing."""
    told = hashlib.sha256()
    for path in sorted(p for name in ("scanprep", "model", "completion") for p in (ROOT / name).rglob("*")
                       if p.suffix in {".py", ".json", ".npz"}):
        told.update(str(path.relative_to(ROOT)).encode())
        told.update(without_words(path.read_bytes()) if path.suffix == ".py" else path.read_bytes())
    return told.hexdigest()


def without_words(source: bytes) -> bytes:
    """What a program does: its syntax tree without docstrings."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return ast.dump(tree).encode()


def scripts_of(script: Path) -> list[Path]:
    """A benchmark's script, and those beside it that it imports."""
    found, seen = [script], {script}
    for path in found:
        for name in re.findall(r"^\s*(?:from|import) (\w+)", path.read_text(), re.M):
            beside = next((p for folder in (HERE, HERE.parent) if (p := folder / f"{name}.py").exists()), None)
            if beside is not None and beside not in seen:
                found.append(beside)
                seen.add(beside)
    return found


def code_of(arguments: str) -> str:
    """Of a script with these arguments, on the sources as they are."""
    text = b"".join(without_words(path.read_bytes()) for path in scripts_of(HERE / arguments.split()[0]))
    return hashlib.sha256(digest_of_packages().encode() + text + arguments.encode()).hexdigest()[:16]


class Runner:
    """What is run where: the folder of work, the size, and what was done before."""

    def __init__(self, work: Path, quick: bool) -> None:
        self.work, self.quick = work.resolve(), quick
        data = Path(os.environ.get("SCAPEKIT_DATA", "$SCAPEKIT_DATA")).resolve()
        self.places = {"DATA": data, "C3D": data / "cmu_c3d", **{name: self.work / f"{name}.npz" for name in MODELS}}
        self.work.mkdir(parents=True, exist_ok=True)

    def arguments(self, one: Benchmark) -> str:
        """Those of the whole where that is asked for or done, else of the quick run; empty for what that leaves out."""
        if not self.quick or one.quick is None:
            return one.arguments
        state = self.state(one)
        whole = state.get("code") == code_of(one.arguments) and not state.get("failed")
        return one.arguments if whole else one.quick

    def code(self, one: Benchmark) -> str:
        """Changes with the sources, the script and its arguments."""
        return code_of(self.arguments(one))

    def state(self, one: Benchmark) -> dict:
        """Of the last run: code, seconds, and why it failed."""
        path = self.work / f"{one.name}.run.json"
        return json.loads(path.read_text()) if path.exists() else {}

    def is_done(self, one: Benchmark) -> bool:
        if not self.arguments(one):  # it is left out
            return False
        kept = all((self.work / f"{name}.npz").exists() for name, maker in MODELS.items() if maker == one.name)
        state = self.state(one)
        return kept and (RESULTS / f"{one.name}.json").exists() and state.get("code") == self.code(one) \
            and not state.get("failed")

    def command(self, one: Benchmark, scratch: Path) -> list[str]:
        """Words for the shell, paths put in; FileNotFoundError for data or a model that are not there."""
        script, *words = shlex.split(self.arguments(one))

        def place(found: re.Match) -> str:
            path = {**self.places, "SCRATCH": scratch}.get(found[0])
            if path is None or path.exists() or MODELS.get(found[0]) == one.name:
                return str(path or found[0])
            raise FileNotFoundError(f"{found[0]} is not there")

        return [sys.executable, str(HERE / script), *(re.sub(r"^[A-Z][A-Z0-9_]*", place, word) for word in words),
                "-o", str(scratch / "result.json")]

    def run(self, one: Benchmark) -> dict:
        """One benchmark in a process of its own; its state afterwards."""
        scratch = self.work / f"{one.name}.{self.code(one)}"
        scratch.mkdir(exist_ok=True)
        state = {"code": self.code(one), "wall_s": 0.0}
        try:
            state |= self.measured(one, self.command(one, scratch), scratch)
        except FileNotFoundError as missing:
            state["failed"] = str(missing)
        if "failed" not in state:
            shutil.copy(scratch / "result.json", RESULTS / f"{one.name}.json")
        (self.work / f"{one.name}.run.json").write_text(json.dumps(state))
        return state

    def measured(self, one: Benchmark, command: list[str], scratch: Path) -> dict:
        """What a benchmark took, and the last line that it said where it failed."""
        threads = {} if one.alone else dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        environment = os.environ | threads | {"PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "tests")))}
        start, log = time.time(), self.work / f"{one.name}.log"
        with log.open("w") as said:
            child = subprocess.Popen(command, stdout=said, stderr=said, env=environment, cwd=scratch,
                                     stdin=subprocess.DEVNULL)
            _, status, used = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
        took = {"wall_s": time.time() - start, "cpu_s": used.ru_utime + used.ru_stime,
                "peak_gib": used.ru_maxrss / 2**20}
        if child.returncode or not (scratch / "result.json").exists():
            lines = log.read_text(errors="replace").strip().splitlines()
            took["failed"] = lines[-1][:200] if lines else f"exit code {child.returncode}"
        return took


def run_all(runner: Runner, chosen: list[Benchmark], at_once: int) -> None:
    """All that is not done: first those that run alone, then so many at once."""
    left = [one for one in chosen if not runner.is_done(one)]

    def tell(one: Benchmark) -> None:
        print(f"{time.strftime('%H:%M:%S')} {one.name} begins", flush=True)
        state = runner.run(one)
        end = f"failed: {state['failed']}" if "failed" in state else f"{state['cpu_s']:.0f} s of processor"
        print(f"{time.strftime('%H:%M:%S')} {one.name}, {state['wall_s']:.0f} s: {end}", flush=True)

    for one in left:
        if one.alone:
            tell(one)
    makers = [one for one in left if not one.alone and one.name in MODELS.values()]
    with concurrent.futures.ThreadPoolExecutor(at_once) as pool:
        list(pool.map(tell, makers))
        list(pool.map(tell, [one for one in left if not one.alone and one not in makers]))


def versions() -> str:
    """The machine and all that was measured, in a sentence."""
    import importlib.metadata as metadata

    def version(name: str) -> str:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            return "missing"

    facts = {k: v for k, v in machine().items() if k != "threads"} | {name: version(name) for name in PEERS}
    bcpd = "found" if shutil.which("bcpd") else "missing"
    return ", ".join(f"{name} {value}" for name, value in facts.items()) + f", bcpd {bcpd}"


def shown(one: Benchmark, runner: Runner) -> str:
    """The section of a benchmark, with an older result where there is no new one; why there is none where it failed."""
    state, command = runner.state(one), f"python tests/benchmarks/{runner.arguments(one)}"
    head = f"\n## {one.title}\n\n`{command}`"
    if state.get("failed"):
        return f"{head}: no result, {state['failed']}\n"
    path = RESULTS / f"{one.name}.json"
    if not path.exists():
        return f"{head}: not measured yet.\n"
    took = f": {state['cpu_s'] / 60:.1f} minutes of the processor, {state['peak_gib']:.1f} GiB" \
        if state.get("code") == runner.code(one) else ": **a result of earlier code**, not measured with this one"
    return "\n\n".join(part for part in (head + took, one.table(json.loads(path.read_text())), one.note) if part) + "\n"


def headlines(runner: Runner, most: Mapping[str, int | None]) -> str:
    """A table of the main figures of some benchmarks, one a row, so many of each, with the command."""
    rows: Rows = []
    for one in BENCHMARKS:
        if one.name in most and runner.is_done(one):
            report = json.loads((RESULTS / f"{one.name}.json").read_text())
            rows += [(*line, f"`{runner.arguments(one)}`") for line in HEADLINES[one.name](report)[:most[one.name]]]
    return table(("what", "error or value", "command"), rows)


def into_readme(figures: str) -> None:
    """Put the table between its two marks in the README."""
    path = ROOT / "README.md"
    before, _, rest = path.read_text().partition(MARKS[0])
    _, found, after = rest.partition(MARKS[1])
    assert found, f"README.md: expected {MARKS[0]} and {MARKS[1]}"
    path.write_text(f"{before}{MARKS[0]}\n{figures}\n{MARKS[1]}{after}")


def write_tables(runner: Runner) -> None:
    """BENCHMARKS.md, and the README's figures, from the results of this code."""
    into_readme(headlines(runner, IN_README))
    here = [one for one in BENCHMARKS if runner.arguments(one)]
    out = [one for one in BENCHMARKS if not runner.arguments(one)]
    seconds = sum(runner.state(one).get("cpu_s", 0.0) for one in here)
    parts = [f"# Benchmarks\n\nWritten by `python tests/benchmarks/all.py WORK{' --quick' if runner.quick else ''}`, "
             f"{seconds / 3600:.1f} hours of the processor, on {versions()}.\n\n"
             "Real scans cannot be shipped; errors are mean vertex distances unless said otherwise. Seconds are of the "
             "processor where they say CPU. In commands MEN and FOLD_0 are models that the benchmarks before learned, "
             "DATA and C3D the folders of scans and recordings, SCRATCH an empty folder.\n"]
    if runner.quick:
        parts.append("\n`--quick` takes fewer bodies where there are many"
                     + (f", and leaves out {', '.join(one.name for one in out)}" if out else "") + ".\n")
    parts.append(f"\n## In short\n\n{headlines(runner, dict.fromkeys(HEADLINES))}\n")
    parts += [shown(one, runner) for one in here]
    (HERE / "BENCHMARKS.md").write_text("".join(parts))


def main() -> None:
    """Run what is left and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="*", choices=[one.name for one in BENCHMARKS], help="not all of them")
    parser.add_argument("--at-once", type=int, default=1)
    parser.add_argument("--tables", action="store_true", help="only write BENCHMARKS.md")
    args = parser.parse_args()
    runner = Runner(args.work, args.quick)
    RESULTS.mkdir(exist_ok=True)
    if not args.tables:
        chosen = [one for one in BENCHMARKS if runner.arguments(one) and (not args.only or one.name in args.only)]
        run_all(runner, chosen, args.at_once)
    write_tables(runner)


if __name__ == "__main__":
    main()
