"""The commands of the README and of the pages of tasks, as they stand, one after the other: minutes and verdicts.

    python tests/benchmarks/journeys.py WORK [--fresh] [-o FILE]

`scape sample` writes the files; nothing is edited, no landmark is clicked. With `--fresh` the package is installed into
an environment of its own first. Told are the minutes and the verdict of each command, and every command that failed,
with its last line. Commands that open the browser are left out.
"""
from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from protocols import machine, write_report

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", *(f".docs/pages/tasks/{name}.md" for name in
                        ("researcher", "anthropometrist", "biomechanist", "animator")))
IN_BROWSER = "pick", "view"


class Step(NamedTuple):
    """One command of a journey."""

    command: str
    minutes: float
    code: int
    verdict: str
    last: str


def written_commands() -> list[list[str]]:
    """The words after `scape` of every command of the pages, each command once."""
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    blocks = re.findall(r"```bash\n(.*?)```", text, re.DOTALL)
    lines = dict.fromkeys(line for block in blocks for line in block.splitlines() if line.startswith("scape "))
    commands = [shlex.split(line)[1:] for line in lines]
    return [words for words in commands if words[0] not in IN_BROWSER]


def carried_out(python: str, words: tuple[str, ...], work: Path) -> Step:
    """One command in the folder of the journeys."""
    begun = time.perf_counter()
    done = subprocess.run([python, "-m", "completion", *words], cwd=work, capture_output=True, text=True, check=False)
    minutes = (time.perf_counter() - begun) / 60
    verdict = ""
    if "-o" in words and done.returncode == 0:
        output = work / words[words.index("-o") + 1]
        report = output / "report.json" if output.is_dir() else output.with_name(f"{output.name}.report.json")
        judged = json.loads(report.read_text(encoding="utf-8"))["judgement"] if report.exists() else None
        verdict = f"{judged['verdict']}: {'; '.join(judged['reasons'])}" if judged else ""
    last = (done.stderr.strip().splitlines() or [""])[-1]
    command = " ".join(f'"{word}"' if " " in word else word for word in ("scape", *words))
    return Step(command, minutes, done.returncode, verdict, last)


def fresh_python(work: Path) -> tuple[str, float]:
    """The Python of a new environment with the package in it, and the minutes that took."""
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-m", "venv", work / "environment"], check=True)
    python = str(work / "environment" / "bin" / "python")
    subprocess.run([python, "-m", "pip", "install", "--quiet", str(ROOT)], check=True)
    return python, (time.perf_counter() - begun) / 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", type=Path)
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    asked.work.mkdir(parents=True, exist_ok=True)
    python, install = fresh_python(asked.work) if asked.fresh else (sys.executable, 0.0)
    if not asked.fresh:
        os.environ["PYTHONPATH"] = str(ROOT)
    steps, minutes = [], install
    to: dict[str, float] = {}
    for words in written_commands():
        step = carried_out(python, words, asked.work if words == ["sample"] else asked.work / "sample")
        steps.append(step)
        minutes += step.minutes
        if step.code == 0:
            to.setdefault(words[0], minutes)
        print(f"{step.minutes:5.1f} min  {'done' if step.code == 0 else f'EXIT {step.code}':7}  {step.command}\n"
              f"           {step.verdict or step.last}", flush=True)
    told = {"installed": install, "to the first measures": to.get("measure"), "to the model": to.get("learn")}
    print(told, f"{sum(step.code != 0 for step in steps)} of {len(steps)} commands failed")
    if asked.output:
        write_report(asked.output, {"machine": machine(), "minutes": told, "steps": [step._asdict() for step in steps]})


if __name__ == "__main__":
    main()
